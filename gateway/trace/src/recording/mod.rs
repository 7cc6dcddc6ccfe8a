//! Recordings of runs: MCAP files, their names, how they are split, and the repair of those that were not finished.

pub mod account;
pub mod file;
pub mod layout;
pub mod message_sink;
pub mod names;
mod output;
mod publish;
pub mod recover;
pub mod repair;
pub mod robot;
pub mod series;
pub mod sink;
pub mod window;

/// The beginning of a topic of frames; the name of the bus follows.
pub const BUS_TOPIC_PREFIX: &str = "/can/";
/// The beginning of a topic of frames that were latched before the file began; the name of the bus follows.
pub const STATE_TOPIC_PREFIX: &str = "/state/";
/// The topic of notes between frames.
pub const NOTES_TOPIC: &str = "/can/notes";
