//! Reads and writes captures as MCAP recordings. Frames and notes become entries; messages of other topics are only
//! counted.

mod buses;
mod foreign;
mod read;
mod state;
mod survey;
mod write;

pub(super) use buses::ForeignBusNames;
pub(super) use read::McapReader;
pub(super) use state::McapState;
pub(super) use survey::TopicSurvey;
pub(super) use write::{LOG_ORIGIN, McapWriter};
pub use write::{ORIGIN_METADATA, RecordingOrigin};

use std::io;

use thiserror::Error;

use crate::container::FormatError;

/// Returns true if messages with this encoding and type are frames that another program recorded.
pub(crate) fn is_foreign_frame(encoding: &str, schema: &str) -> bool {
    foreign::ForeignMessageType::from_schema(encoding, schema).is_some()
}

/// An error of reading a recording, without the name of the file, which the caller adds.
#[derive(Debug, Error)]
pub(super) enum ReadFault {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error(transparent)]
    Damaged(#[from] FormatError),
}
