//! The frames of a run as candump text.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use protocol::candump::{Record, Timestamp, write_record};

use super::RunError;
use super::receiver::Captured;
use crate::summary::Recording;

/// A log that has its name only when it is whole: until then it is called `NAME.part`.
#[derive(Debug)]
pub(super) struct Log {
    path: PathBuf,
    part: PathBuf,
    file: BufWriter<File>,
    line: String,
    frames: u64,
}

impl Log {
    pub(super) fn create(path: &Path) -> Result<Self, RunError> {
        let mut part = path.as_os_str().to_owned();
        part.push(".part");
        let part = PathBuf::from(part);
        let file = File::create(&part).map_err(|source| RunError::Write { path: part.clone(), source })?;
        let (file, line) = (BufWriter::new(file), String::new());
        Ok(Self { path: path.to_owned(), part, file, line, frames: 0 })
    }

    pub(super) fn write(&mut self, interface: &str, captured: &Captured) -> Result<(), RunError> {
        let time = Timestamp { nanos: captured.at_nanos, nine_digits: false };
        let record = Record { time, interface, frame: captured.frame, direction: None };
        self.line.clear();
        // A string takes everything.
        let _ = write_record(&mut self.line, &record);
        let _ = self.line.write_char('\n');
        self.file.write_all(self.line.as_bytes()).map_err(|source| self.error(source))?;
        self.frames += 1;
        Ok(())
    }

    pub(super) fn finish(mut self, lost: u64) -> Result<Recording, RunError> {
        self.file.flush().map_err(|source| self.error(source))?;
        std::fs::rename(&self.part, &self.path).map_err(|source| self.error(source))?;
        Ok(Recording { path: self.path.display().to_string(), frames: self.frames, lost })
    }

    fn error(&self, source: std::io::Error) -> RunError {
        RunError::Write { path: self.part.clone(), source }
    }
}
