//! Errors of reading captures.

use std::io;

use thiserror::Error;

use super::mcap::ReadFault;
use super::parts::PartsError;
use crate::container::FormatError;

/// An error of opening or reading a capture.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// The file cannot be opened or read.
    #[error("{name}: {source}")]
    Io {
        /// The name of the capture.
        name: String,
        /// The cause.
        source: io::Error,
    },
    /// Several files are not the parts of one recording.
    #[error(transparent)]
    Parts(#[from] PartsError),
    /// The first bytes belong to another format.
    #[error("{name} is {what}, and no candump log or MCAP recording: {hint}")]
    Other {
        /// The name of the capture.
        name: String,
        /// The format, such as `a gzip file`.
        what: &'static str,
        /// The action to take.
        hint: &'static str,
    },
    /// The rest of the file is damaged.
    #[error(
        "{name} is damaged: {what}; {entries} frames and notes before that were read; `skinbus recover` copies the \
         intact part to a new file"
    )]
    Damaged {
        /// The name of the capture.
        name: String,
        /// The damage.
        what: FormatError,
        /// The number of entries before the damage.
        entries: u64,
    },
}

impl ReadFault {
    /// Converts the fault into an error of the file `name`, of which `entries` have been read.
    pub(super) fn into_capture_error(self, name: &str, entries: u64) -> CaptureError {
        let name = name.to_owned();
        match self {
            Self::Io(source) => CaptureError::Io { name, source },
            Self::Damaged(what) => CaptureError::Damaged { name, what, entries },
        }
    }
}
