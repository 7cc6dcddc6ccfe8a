//! Frames of a run as candump text.

use std::fs;
use std::io;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use protocol::candump::{Record, Timestamp, write_record};

use super::CandumpOutput;
use model::latched::LatchedFrame;
use trace::files::LogFile;
use trace::recording::account::WrittenFile;

/// Number of bytes written at once.
const WRITE_CHUNK_BYTES: usize = 64 << 10;

/// Interval between checks that the log still has its name.
const NAME_CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// A log that is being written. The first write error ends it after its last whole line.
#[derive(Debug)]
pub struct CandumpWriter {
    log: LogFile,
    failed: bool,
    /// True if another program moved or changed the file.
    moved: bool,
    /// Time of the last check that the log still has its name.
    checked_at: Instant,
    /// Lines not yet written.
    lines: String,
    /// Number of frames in `lines`.
    waiting: u64,
    /// Number of frames in the file.
    frames: u64,
    /// Number of frames that could not be written.
    lost: u64,
}

impl CandumpWriter {
    /// Starts a log. Waits for a FIFO's reader, or until `stopped`.
    ///
    /// # Errors
    /// Returns [`io::Error`] if the log cannot be written.
    pub fn create(target: &CandumpOutput, force: bool, stopped: &AtomicBool) -> io::Result<Self> {
        let log = if target.numbered && !force {
            LogFile::create_numbered(&target.path, stopped)?
        } else {
            LogFile::create(&target.path, force, stopped)?
        };
        let lines = String::with_capacity(WRITE_CHUNK_BYTES + 256);
        let (failed, moved, looked) = (false, false, Instant::now());
        Ok(Self { log, failed, moved, checked_at: looked, lines, waiting: 0, frames: 0, lost: 0 })
    }

    /// Path of the log.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.log.path()
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// Returns [`io::Error`] once if the log cannot be written.
    pub fn add_frame(&mut self, interface: &str, seen: &LatchedFrame) -> io::Result<()> {
        if self.failed {
            self.lost += 1;
            return Ok(());
        }
        let time = Timestamp::with_six_digits(seen.at_nanos);
        let record = Record { time, interface, frame: seen.frame, direction: None };
        // Writing to a string never fails.
        let _ = write_record(&mut self.lines, &record);
        self.waiting += 1;
        self.end_line()
    }

    /// Adds a line other than a frame.
    ///
    /// # Errors
    /// Returns [`io::Error`] once if the log cannot be written.
    pub fn add_note_line(&mut self, text: &str) -> io::Result<()> {
        if self.failed {
            return Ok(());
        }
        self.lines.push_str(text);
        self.end_line()
    }

    fn end_line(&mut self) -> io::Result<()> {
        self.lines.push('\n');
        if self.lines.len() < WRITE_CHUNK_BYTES { Ok(()) } else { self.flush() }
    }

    /// Returns true if the log has ended after an error.
    #[must_use]
    pub const fn has_ended(&self) -> bool {
        self.failed
    }

    /// Passes waiting lines to the kernel: readers that follow the log see them, and a killed run keeps them.
    ///
    /// # Errors
    /// Returns [`io::Error`] once if the log cannot be written or was moved or changed.
    pub fn flush(&mut self) -> io::Result<()> {
        self.write_waiting_lines()?;
        if self.checked_at.elapsed() < NAME_CHECK_INTERVAL {
            return Ok(());
        }
        self.checked_at = Instant::now();
        self.check_log_name()
    }

    fn check_log_name(&mut self) -> io::Result<()> {
        if self.moved || self.failed {
            return Ok(());
        }
        let looked = self.log.check_unchanged();
        self.moved = looked.is_err();
        looked
    }

    fn write_waiting_lines(&mut self) -> io::Result<()> {
        let put = self.log.append(&self.lines);
        if put.is_ok() {
            self.frames += self.waiting;
        } else {
            self.failed = true;
            self.lost += self.waiting;
        }
        self.waiting = 0;
        self.lines.clear();
        put
    }

    /// Ends the log, also after an error. Returns the file if it still has its name, the number of frames missing in
    /// it, and the first error.
    pub fn finish(mut self) -> (Option<WrittenFile>, u64, io::Result<()>) {
        let (put, looked) = (self.write_waiting_lines(), self.check_log_name());
        let there =
            if self.moved { self.log.count_lines_with_prefix("(").ok().flatten() } else { Some(self.frames) };
        let Self { log, frames: written, lost, .. } = self;
        let frames = there.unwrap_or(0).min(written);
        let path = log.path().display().to_string();
        let file = there.map(|_| {
            let bytes = if self.moved {
                fs::metadata(log.path()).map_or(0, |about| about.len())
            } else {
                log.bytes()
            };
            WrittenFile { path, format: "candump", frames, messages: frames, bytes }
        });
        let finished = log.finish();
        (file, lost + (written - frames), put.and(looked).and(finished))
    }

    /// Ends the log of a run that never began. Returns the file, or removes it and returns `None` if no frame was
    /// received.
    pub fn discard(mut self) -> Option<WrittenFile> {
        // The reason why the run did not begin is the error to report.
        let _ = self.flush();
        (self.frames > 0).then(|| self.finish().0).flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::can::Frame;

    fn text(path: &Path) -> CandumpWriter {
        let target = CandumpOutput { path: path.to_owned(), numbered: false };
        CandumpWriter::create(&target, false, &AtomicBool::new(false)).unwrap()
    }

    fn seen(at: u64) -> LatchedFrame {
        let frame = Frame::classic(0x123, &[1, 2, 3]).unwrap();
        LatchedFrame { at_nanos: at * 1_000, from_gateway: false, frame }
    }

    #[test]
    fn frames_and_notes_keep_their_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        let mut text = text(&path);
        text.add_frame("vcan0", &seen(1)).unwrap();
        text.add_note_line("DROPCOUNT: dropped 3 CAN frames on 'vcan0' socket (total drops 3)").unwrap();
        text.add_frame("vcan0", &seen(2)).unwrap();
        let (written, lost, finished) = text.finish();
        finished.unwrap();
        let (log, written) = (fs::read_to_string(&path).unwrap(), written.unwrap());
        let expected = "(0.000001) vcan0 123#010203\n\
            DROPCOUNT: dropped 3 CAN frames on 'vcan0' socket (total drops 3)\n(0.000002) vcan0 123#010203\n";
        assert_eq!(log, expected);
        assert_eq!((written.frames, lost, written.bytes), (2, 0, log.len() as u64));
    }

    #[test]
    fn a_full_disk_is_reported_once_and_every_frame_is_counted() {
        let mut text = text(Path::new("/dev/full"));
        let errors = (0..10_000).filter(|&at| text.add_frame("vcan0", &seen(at)).is_err()).count();
        assert_eq!(errors, 1);
        let (written, lost, _) = text.finish();
        assert_eq!((written.unwrap().frames, lost), (0, 10_000));
    }

    /// Lets another program disturb a log of five frames, then adds three. Returns the reported errors, the number of
    /// frames in the file that the summary names, if any, and the number of lost frames.
    fn disturbed(disturb: impl FnOnce(&Path)) -> (Vec<String>, Option<u64>, u64) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        let mut log = text(&path);
        let mut said = Vec::new();
        let mut frames = |log: &mut CandumpWriter, count| {
            for at in 0..count {
                log.add_frame("vcan0", &seen(at)).unwrap();
                log.checked_at = Instant::now().checked_sub(NAME_CHECK_INTERVAL).unwrap();
                said.extend(log.flush().err());
            }
        };
        frames(&mut log, 5);
        disturb(&path);
        frames(&mut log, 3);
        assert!(!log.has_ended());
        let (written, lost, finished) = log.finish();
        said.extend(finished.err());
        let is_there = written.as_ref().map(|file| (file.path.clone(), file.bytes));
        let there = fs::metadata(&path).ok().filter(|_| written.is_some());
        assert_eq!(is_there, there.map(|about| (path.display().to_string(), about.len())));
        (said.iter().map(ToString::to_string).collect(), written.map(|file| file.frames), lost)
    }

    #[test]
    fn a_log_that_another_program_moves_or_changes_is_reported_once_and_its_frames_are_counted() {
        assert_eq!(disturbed(|_| {}), (Vec::new(), Some(8), 0));
        let gone: [fn(&Path); 3] = [
            |path| fs::remove_file(path).unwrap(),
            |path| fs::rename(path, path.with_extension("old")).unwrap(),
            |path| {
                fs::rename(path, path.with_extension("old")).unwrap();
                fs::write(path, "(0.000001) vcan0 123#\n").unwrap();
            },
        ];
        for gone in gone {
            let (said, frames, lost) = disturbed(gone);
            assert_eq!((said.len(), frames, lost), (1, None, 8), "{said:?}");
            assert!(said[0].starts_with("another program renamed, removed or replaced the file"), "{said:?}");
        }
        let (said, frames, lost) = disturbed(|path| fs::write(path, "").unwrap());
        assert_eq!((said.len(), frames, lost), (1, Some(3), 5), "{said:?}");
        assert!(said[0].starts_with("another program changed the file"), "{said:?}");
    }

    #[test]
    fn lines_are_in_the_file_once_they_are_flushed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        let mut log = text(&path);
        for at in 1..4 {
            log.add_frame("vcan0", &seen(at)).unwrap();
            log.flush().unwrap();
            let there = fs::read_to_string(&path).unwrap();
            assert!(there.ends_with(&format!("(0.{at:06}) vcan0 123#010203\n")), "{there}");
        }
    }

    #[test]
    fn a_run_that_never_began_leaves_what_was_received() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        assert!(text(&path).discard().is_none());
        assert!(!path.exists());
        let mut log = text(&path);
        log.add_frame("vcan0", &seen(1)).unwrap();
        assert_eq!(log.discard().unwrap().frames, 1);
        assert_eq!(fs::read_to_string(&path).unwrap(), "(0.000001) vcan0 123#010203\n");
    }
}
