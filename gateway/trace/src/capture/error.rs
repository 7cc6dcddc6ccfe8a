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
    /// Several files were named that are not the parts of one recording.
    #[error(transparent)]
    Parts(#[from] PartsError),
    /// The file begins with the magic bytes of another format.
    #[error("{name} is {what}, not a candump log or MCAP recording: {hint}")]
    OtherFormat {
        /// The name of the capture.
        name: String,
        /// The format, such as `a gzip file`.
        what: &'static str,
        /// Advice to the user, such as how to convert the file.
        hint: &'static str,
    },
    /// The file is damaged after some entries that could be read.
    #[error(
        "{name} is damaged: {what}; {entries} frames and notes before the damage were read; `skinbus recover` copies the \
         intact part to a new file"
    )]
    Damaged {
        /// The name of the capture.
        name: String,
        /// The kind of damage.
        what: FormatError,
        /// The number of entries that were read before the damage.
        entries: u64,
    },
}

impl ReadFault {
    /// Adds to the fault the `name` of the file and the number of `entries` read from it before the fault.
    pub(super) fn into_capture_error(self, name: &str, entries: u64) -> CaptureError {
        let name = name.to_owned();
        match self {
            Self::Io(source) => CaptureError::Io { name, source },
            Self::Damaged(what) => CaptureError::Damaged { name, what, entries },
        }
    }
}
