//! Captures: frames of one or more buses with their times, from a candump log or an MCAP recording.
//!
//! ```text
//!   candump log ──┐                      ┌── candump log
//!                 ├──> Entry, Entry, … ──┼── MCAP recording
//!   MCAP ─────────┘                      └── dump, replay, explain
//! ```
//!
//! An [`Entry`] keeps everything that either format says of a frame, so that a capture comes back from the other
//! one as it was. Entries stand in the order of the file, which is not always that of their times.

pub mod convert;
mod error;
mod extras;
mod last_times;
pub mod log;
mod magic;
mod mcap;
mod parts;
mod place;
mod places;
mod reader;
mod text_kinds;
mod times;

pub use error::CaptureError;
pub use extras::{Extras, Latched, RUN, SKIN, Topic, facts_of_run, seconds_since};
pub use mcap::ORIGIN;
pub(crate) use mcap::is_foreign_frame;
pub use parts::{Part, PartsError};
pub use place::{Place, Places};
pub use reader::Reader;
pub use text_kinds::DESCRIPTION;

pub use crate::note::{BusNote, Note, NoteKind};

use std::fs::File;
use std::io::Read;

use protocol::candump::Record;

/// What a file is read through.
pub type Through = Box<dyn Fn(File) -> Box<dyn Read + Send> + Send>;

/// What a capture is written in.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Format {
    /// Text of `candump -L`.
    Candump,
    /// An MCAP recording.
    Mcap,
}

/// One entry of a capture.
#[derive(Clone, Debug, PartialEq)]
pub enum Entry<'a> {
    /// A frame.
    Frame(Record<'a>),
    /// Something that is no frame, and has its place between them.
    Note(Note<'a>),
}

/// One thing of a recording that is read with all its topics.
#[derive(Clone, Debug, PartialEq)]
pub enum Item<'a> {
    /// A frame, or what stands between frames.
    Entry(Entry<'a>),
    /// A message of another topic.
    Other(Other<'a>),
}

/// A message that is neither a frame nor a note.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Other<'a> {
    /// Its topic.
    pub topic: &'a str,
    /// Its type.
    pub schema: &'a str,
    /// When, in ns since 1970.
    pub nanos: u64,
    /// The message as the recording has it.
    pub message: &'a [u8],
}
