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
pub mod log;
mod magic;
mod mcap;
mod parts;
mod reader;

pub use mcap::ORIGIN;
pub use reader::{CaptureError, Extras, Format, InForce, Items, Reader, SKIN, Through, Topic};

use protocol::candump::Record;

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

/// What stands between frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Note<'a> {
    /// What it is.
    pub kind: NoteKind,
    /// When, in ns since 1970; in a log, the time of the frame before it, 0 before the first one.
    pub nanos: u64,
    /// The bus, when it is about one; else empty.
    pub interface: &'a str,
    /// Its line in a log, from 1; 0 when it comes from none.
    pub line: u64,
    /// The line as it stands in the log, without its end; or words of whoever recorded it.
    pub text: &'a [u8],
}

/// What a note is.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum NoteKind {
    /// A comment, an empty line, anything that can-utils skip too.
    Text,
    /// So many frames are missing here: whoever took the capture lost them.
    Dropped(u64),
    /// A CAN XL frame, which is not read.
    CanXl,
    /// A line that begins like a frame and is none, and why.
    Unreadable(String),
}
