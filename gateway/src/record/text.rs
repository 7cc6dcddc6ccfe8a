//! The frames of a run as candump text.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

use protocol::candump::{Record, Timestamp, write_record};

use super::account::Written;
use super::force::Seen;
use crate::run::file::WholeFile;

/// Bytes that are written together.
const PIECE: usize = 64 << 10;

/// A log that is being written. The first error ends it at its last whole line.
#[derive(Debug)]
pub struct Text {
    whole: WholeFile,
    file: File,
    failed: bool,
    /// Lines that wait to be written.
    lines: String,
    /// Frames in them.
    waiting: u64,
    /// Frames and bytes in the file.
    frames: u64,
    bytes: u64,
    /// Frames that were not written.
    lost: u64,
}

impl Text {
    /// Opens a log.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn create(path: &Path) -> io::Result<Self> {
        let (whole, file) = WholeFile::create(path)?;
        let lines = String::with_capacity(PIECE + 256);
        Ok(Self { whole, file, failed: false, lines, waiting: 0, frames: 0, bytes: 0, lost: 0 })
    }

    /// Its name.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.whole.path()
    }

    /// A frame.
    ///
    /// # Errors
    /// When the log cannot be written; said once.
    pub fn frame(&mut self, interface: &str, seen: &Seen) -> io::Result<()> {
        if self.failed {
            self.lost += 1;
            return Ok(());
        }
        let time = Timestamp { nanos: seen.at_nanos, nine_digits: false };
        let record = Record { time, interface, frame: seen.frame, direction: None };
        // A string takes everything.
        let _ = write_record(&mut self.lines, &record);
        self.waiting += 1;
        self.end_line()
    }

    /// A line that is no frame.
    ///
    /// # Errors
    /// When the log cannot be written; said once.
    pub fn note(&mut self, text: &str) -> io::Result<()> {
        if self.failed {
            return Ok(());
        }
        self.lines.push_str(text);
        self.end_line()
    }

    fn end_line(&mut self) -> io::Result<()> {
        self.lines.push('\n');
        if self.lines.len() < PIECE { Ok(()) } else { self.put() }
    }

    fn put(&mut self) -> io::Result<()> {
        let put = self.file.write_all(self.lines.as_bytes());
        match put {
            Ok(()) => {
                self.frames += self.waiting;
                self.bytes += self.lines.len() as u64;
            }
            Err(_) => {
                self.failed = true;
                self.lost += self.waiting;
                // A part of a line would be no line. What is no regular file has no length.
                let _ = self.file.set_len(self.bytes);
            }
        }
        self.waiting = 0;
        self.lines.clear();
        put
    }

    /// Ends the log and gives it its name, also when it broke off: what it came to, frames that were lost, and
    /// whether all went well.
    pub fn finish(mut self) -> (Written, u64, io::Result<()>) {
        let put = self.put();
        let Self { whole, frames, bytes, lost, .. } = self;
        let path = whole.path().display().to_string();
        let named = whole.finish();
        let finished = put.and(named);
        (Written { path, format: "candump", frames, messages: frames, bytes }, lost, finished)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::can::Frame;

    fn seen(at: u64) -> Seen {
        let frame = Frame::classic(0x123, &[1, 2, 3]).unwrap();
        Seen { at_nanos: at * 1_000, own: false, frame }
    }

    #[test]
    fn frames_and_notes_stand_in_their_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        let mut text = Text::create(&path).unwrap();
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
    fn a_full_disk_is_said_once_and_every_frame_is_counted() {
        let mut text = Text::create(Path::new("/dev/full")).unwrap();
        let errors = (0..10_000).filter(|&at| text.frame("vcan0", &seen(at)).is_err()).count();
        assert_eq!(errors, 1);
        let (written, lost, _) = text.finish();
        assert_eq!((written.frames, lost), (0, 10_000));
    }
}
