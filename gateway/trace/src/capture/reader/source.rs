//! The file that a reader reads at present: a candump log or an MCAP recording.

use std::fs::File;
use std::io::{Read, Seek};
use std::path::Path;

use protocol::input;

use crate::capture::log::LogReader;
use crate::capture::magic::{self, InputFormat, is_mcap};
use crate::capture::mcap::{McapReader, McapState, ReadFault};
use crate::capture::{CaptureError, FileWrapper};

/// A file that is being read.
pub(super) enum CaptureSource {
    Log(LogReader),
    Mcap(Box<McapReader>),
}

impl CaptureSource {
    /// Opens one file. The attachments and metadata of a recording are read at once if it is a regular file.
    pub(super) fn open(
        path: &Path,
        through: &FileWrapper,
        mut state: McapState,
    ) -> Result<(String, Self), CaptureError> {
        let name = path.display().to_string();
        let failed = |source| CaptureError::Io { name: name.clone(), source };
        let mut file = input::open(path).map_err(failed)?;
        let about = file.metadata().map_err(failed)?;
        let mut regular = None;
        if about.is_file() && is_mcap(&mut file).map_err(failed)? {
            state.read_extras_ahead(&mut file).and_then(|()| file.rewind()).map_err(failed)?;
            regular = Some(file.try_clone().map_err(failed)?);
        }
        let source = Self::detect_source(&name, through(file), state, regular)?;
        Ok((name, source))
    }

    pub(super) fn detect_source(
        name: &str,
        input: impl Read + Send + 'static,
        state: McapState,
        file: Option<File>,
    ) -> Result<Self, CaptureError> {
        let (name, mut input) = (name.to_owned(), Box::new(input));
        match magic::detect_format(&mut input) {
            // The first bytes of the recording are damaged. The MCAP reader reports the damage when it reads them.
            Ok((InputFormat::Text, head)) if file.is_some() => Ok(Self::mcap(&head, input, state, file)),
            Ok((InputFormat::Text, head)) => Ok(Self::Log(LogReader::new(&head, input))),
            Ok((InputFormat::Mcap, head)) => Ok(Self::mcap(&head, input, state, file)),
            Ok((InputFormat::Other(what, hint), _)) => Err(CaptureError::OtherFormat { name, what, hint }),
            Err(source) => Err(CaptureError::Io { name, source }),
        }
    }

    fn mcap(head: &[u8], input: Box<dyn Read + Send>, state: McapState, file: Option<File>) -> Self {
        Self::Mcap(Box::new(McapReader::new(head, input, state, file)))
    }

    /// Returns true if there are no more entries in the file.
    pub(super) fn is_at_its_end(&mut self, name: &str, entries: u64) -> Result<bool, CaptureError> {
        let at_its_end = match self {
            Self::Log(log) => log.is_at_its_end().map_err(ReadFault::from),
            Self::Mcap(mcap) => mcap.is_at_its_end(),
        };
        at_its_end.map_err(|fault| fault.into_capture_error(name, entries))
    }
}
