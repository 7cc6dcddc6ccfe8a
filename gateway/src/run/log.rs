//! The frames of a run as candump text.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use protocol::candump::{Record, Timestamp, write_record};

use super::RunError;
use super::file::WholeFile;
use super::receiver::Captured;
use crate::summary::Recording;

/// A log that is being written.
#[derive(Debug)]
pub(super) struct Log {
    whole: WholeFile,
    file: BufWriter<File>,
    line: String,
    frames: u64,
}

impl Log {
    pub(super) fn create(path: &Path) -> io::Result<Self> {
        let (whole, file) = WholeFile::create(path)?;
        Ok(Self { whole, file: BufWriter::new(file), line: String::new(), frames: 0 })
    }

    pub(super) fn write(&mut self, interface: &str, captured: &Captured) -> Result<(), RunError> {
        let time = Timestamp { nanos: captured.at_nanos, nine_digits: false };
        let record = Record { time, interface, frame: captured.frame, direction: None };
        self.line.clear();
        // A string takes everything.
        let _ = write_record(&mut self.line, &record);
        let _ = self.line.write_char('\n');
        let written = self.file.write_all(self.line.as_bytes());
        written.map_err(|source| RunError::Write { path: self.path(), source })?;
        self.frames += 1;
        Ok(())
    }

    pub(super) fn finish(mut self, lost: u64) -> Result<Recording, RunError> {
        let (path, frames) = (self.path(), self.frames);
        let finished = self.file.flush().and_then(|()| self.whole.finish());
        finished.map_err(|source| RunError::Write { path: path.clone(), source })?;
        Ok(Recording { path: path.display().to_string(), frames, lost })
    }

    fn path(&self) -> PathBuf {
        self.whole.path().to_owned()
    }
}
