//! Captures as MCAP recordings: channels of frames and notes are read and written, messages of other topics are
//! counted.

mod buses;
mod foreign;
mod read;
mod state;
mod survey;
mod write;

pub(super) use buses::ForeignBuses;
pub(super) use read::McapReader;
pub(super) use state::McapState;
pub(super) use survey::TopicSurvey;
pub(super) use write::{McapWriter, SOURCE};
pub use write::{ORIGIN_METADATA, Origin};

use std::io;

use thiserror::Error;

use crate::container::FormatError;

/// Returns true if messages of an encoding and a type are frames of another program.
pub(crate) fn is_foreign_frame(encoding: &str, schema: &str) -> bool {
    foreign::ForeignType::from_schema(encoding, schema).is_some()
}

/// An error of reading a recording, before it is given the name of the file.
#[derive(Debug, Error)]
pub(super) enum ReadFault {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error(transparent)]
    Damaged(#[from] FormatError),
}
