//! The frames of a run as candump text.

use std::io;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use protocol::candump::{Record, Timestamp, write_record};

use super::Candump;
use super::force::Seen;
use trace::files::LogFile;
use trace::recording::account::Written;

/// Bytes that are written together.
const PIECE: usize = 64 << 10;

/// A log that is being written. The first error ends it at its last whole line.
#[derive(Debug)]
pub struct Text {
    log: LogFile,
    failed: bool,
    /// Lines that wait to be written.
    lines: String,
    /// Frames in them.
    waiting: u64,
    /// Frames in the file.
    frames: u64,
    /// Frames that were not written.
    lost: u64,
}

impl Text {
    /// Begins a log. A FIFO is waited for until it has a reader, or until `stopped`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn create(target: &Candump, force: bool, stopped: &AtomicBool) -> io::Result<Self> {
        let log = if target.numbered && !force {
            LogFile::create_numbered(&target.path, stopped)?
        } else {
            LogFile::create(&target.path, force, stopped)?
        };
        let lines = String::with_capacity(PIECE + 256);
        Ok(Self { log, failed: false, lines, waiting: 0, frames: 0, lost: 0 })
    }

    /// Its name.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.log.path()
    }

    /// A frame.
    ///
    /// # Errors
    /// When the log cannot be written; reported once.
    pub fn frame(&mut self, interface: &str, seen: &Seen) -> io::Result<()> {
        if self.failed {
            self.lost += 1;
            return Ok(());
        }
        let time = Timestamp::six_digits(seen.at_nanos);
        let record = Record { time, interface, frame: seen.frame, direction: None };
        // A string takes everything.
        let _ = write_record(&mut self.lines, &record);
        self.waiting += 1;
        self.end_line()
    }

    /// A line that is no frame.
    ///
    /// # Errors
    /// When the log cannot be written; reported once.
    pub fn note(&mut self, text: &str) -> io::Result<()> {
        if self.failed {
            return Ok(());
        }
        self.lines.push_str(text);
        self.end_line()
    }

    fn end_line(&mut self) -> io::Result<()> {
        self.lines.push('\n');
        if self.lines.len() < PIECE { Ok(()) } else { self.flush() }
    }

    /// Hands the lines that wait to the kernel: readers that follow the log see them, and a killed run keeps them.
    ///
    /// # Errors
    /// When the log cannot be written; reported once.
    pub fn flush(&mut self) -> io::Result<()> {
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

    /// Ends the log, also after an error: the file, frames that were lost, and whether all was written.
    pub fn finish(mut self) -> (Written, u64, io::Result<()>) {
        let put = self.flush();
        let Self { log, frames, lost, .. } = self;
        let (path, bytes) = (log.path().display().to_string(), log.bytes());
        let ended = log.finish();
        let finished = put.and(ended);
        (Written { path, format: "candump", frames, messages: frames, bytes }, lost, finished)
    }

    /// Ends the log of a run that never began: the file, or none if nothing was received.
    pub fn discard(mut self) -> Option<Written> {
        // The error to report is why the run did not begin.
        let _ = self.flush();
        (self.frames > 0).then(|| self.finish().0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::can::Frame;

    fn text(path: &Path) -> Text {
        let target = Candump { path: path.to_owned(), numbered: false };
        Text::create(&target, false, &AtomicBool::new(false)).unwrap()
    }

    fn seen(at: u64) -> Seen {
        let frame = Frame::classic(0x123, &[1, 2, 3]).unwrap();
        Seen { at_nanos: at * 1_000, own: false, frame }
    }

    #[test]
    fn frames_and_notes_keep_their_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        let mut text = text(&path);
        text.frame("vcan0", &seen(1)).unwrap();
        text.note("DROPCOUNT: dropped 3 CAN frames on 'vcan0' socket (total drops 3)").unwrap();
        text.frame("vcan0", &seen(2)).unwrap();
        let (written, lost, finished) = text.finish();
        finished.unwrap();
        let log = std::fs::read_to_string(&path).unwrap();
        let expected = "(0.000001) vcan0 123#010203\n\
            DROPCOUNT: dropped 3 CAN frames on 'vcan0' socket (total drops 3)\n(0.000002) vcan0 123#010203\n";
        assert_eq!(log, expected);
        assert_eq!((written.frames, lost, written.bytes), (2, 0, log.len() as u64));
    }

    #[test]
    fn a_full_disk_is_reported_once_and_every_frame_is_counted() {
        let mut text = text(Path::new("/dev/full"));
        let errors = (0..10_000).filter(|&at| text.frame("vcan0", &seen(at)).is_err()).count();
        assert_eq!(errors, 1);
        let (written, lost, _) = text.finish();
        assert_eq!((written.frames, lost), (0, 10_000));
    }

    #[test]
    fn lines_are_in_the_file_once_they_are_flushed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        let mut log = text(&path);
        for at in 1..4 {
            log.frame("vcan0", &seen(at)).unwrap();
            log.flush().unwrap();
            let there = std::fs::read_to_string(&path).unwrap();
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
        log.frame("vcan0", &seen(1)).unwrap();
        assert_eq!(log.discard().unwrap().frames, 1);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "(0.000001) vcan0 123#010203\n");
    }
}
