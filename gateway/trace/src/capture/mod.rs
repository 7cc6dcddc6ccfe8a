//! Captures: frames of one or more buses with their times, from a candump log or an MCAP recording.
//!
//! ```text
//!   candump log ──┐                            ┌── candump log
//!                 ├──> CaptureEntry, again … ──┼── MCAP recording
//!   MCAP ─────────┘                            └── dump, replay, explain
//! ```
//!
//! An [`CaptureEntry`] keeps all information that either format holds of a frame, so that a capture survives the round
//! trip through the other format. Entries are in the order of the file, which is not always the order of their times.

pub mod convert;
mod error;
mod extras;
mod last_times;
pub mod log;
mod magic;
mod mcap;
mod messages;
mod parts;
mod place;
mod places;
mod reader;
mod text_kinds;
mod times;

pub use error::CaptureError;
pub use extras::{
    LatchedFrame, RUN_METADATA, RecordingExtras, SKIN_ATTACHMENT, Topic, bus_time_property, run_metadata,
    seconds_since,
};
pub use mcap::ORIGIN_METADATA;
pub(crate) use mcap::is_foreign_frame;
pub use messages::{ChannelDescription, MessageReader, RecordedMessage};
pub use parts::{PartsError, RecordingPart};
pub use place::{SeekIndex, SeekPoint};
pub use reader::Reader;
pub use text_kinds::SKIN_OR_SCENARIO;

pub use crate::note::{BusNote, CaptureNote, NoteKind};

use std::fs::File;
use std::io::Read;

use protocol::candump::Record;

/// A function that wraps each opened file, for example to show the progress of reading.
pub type FileWrapper = Box<dyn Fn(File) -> Box<dyn Read + Send> + Send>;

/// The format of a capture.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum CaptureFormat {
    /// Text in the format of `candump -L`.
    Candump,
    /// An MCAP recording.
    Mcap,
}

/// One entry of a capture.
#[derive(Clone, Debug, PartialEq)]
pub enum CaptureEntry<'a> {
    /// A CAN frame.
    Frame(Record<'a>),
    /// A comment, a report of lost frames, or another line between frames.
    Note(CaptureNote<'a>),
}

/// One item of a recording that is read with all its topics.
#[derive(Clone, Debug, PartialEq)]
pub enum RecordingItem<'a> {
    /// A frame or a note.
    Entry(CaptureEntry<'a>),
    /// A message of another topic.
    Other(OtherMessage<'a>),
}

/// A message that is neither a frame nor a note.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OtherMessage<'a> {
    /// The topic of the message.
    pub topic: &'a str,
    /// The type of the message.
    pub schema: &'a str,
    /// The time of the message, in ns since 1970.
    pub nanos: u64,
    /// The encoded message.
    pub message: &'a [u8],
}
