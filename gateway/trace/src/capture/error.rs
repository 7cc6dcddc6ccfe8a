//! Errors of reading captures.

use std::io;

use thiserror::Error;

use super::mcap::Fault;
use super::parts::PartsError;
use crate::container::Damage;

/// Why a capture cannot be read, or not further.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// It cannot be opened or read.
    #[error("{name}: {source}")]
    Io {
        /// Its name.
        name: String,
        /// Why.
        source: io::Error,
    },
    /// Several files are not the parts of one recording.
    #[error(transparent)]
    Parts(#[from] PartsError),
    /// Its first bytes say that it is something else.
    #[error("{name} is {what}, and no candump log or MCAP recording: {hint}")]
    Other {
        /// Its name.
        name: String,
        /// What it is.
        what: &'static str,
        /// What to do.
        hint: &'static str,
    },
    /// From here on it is not what it was.
    #[error(
        "{name} is damaged: {what}; {entries} frames and notes before that were read; `skinbus recover` makes a new \
         file of what is whole"
    )]
    Damaged {
        /// Its name.
        name: String,
        /// What is wrong.
        what: Damage,
        /// How many entries came before.
        entries: u64,
    },
}

impl Fault {
    /// As an error of a file of which so many entries have been read.
    pub(super) fn of(self, name: &str, entries: u64) -> CaptureError {
        let name = name.to_owned();
        match self {
            Self::Io(source) => CaptureError::Io { name, source },
            Self::Damaged(what) => CaptureError::Damaged { name, what, entries },
        }
    }
}
