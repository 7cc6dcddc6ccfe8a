//! Recordings: MCAP files that are written in parts, named, found and repaired.

pub mod account;
pub mod file;
pub mod layout;
pub mod names;
mod output;
mod publish;
pub mod recover;
pub mod repair;
pub mod robot;
pub mod series;
pub mod sink;
pub mod window;

/// The prefix of topics of frames; the name of the bus follows.
pub const BUS_TOPIC_PREFIX: &str = "/can/";
/// The prefix of topics of frames that were latched before the file began.
pub const STATE_TOPIC_PREFIX: &str = "/state/";
/// The topic of notes between frames.
pub const NOTES_TOPIC: &str = "/can/notes";
