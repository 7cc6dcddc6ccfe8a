//! Recordings: MCAP files that are written in parts, named, found again and repaired.

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

/// What topics of frames begin with; the bus' name follows.
pub const TOPIC_OF_BUS: &str = "/can/";
/// What topics of frames begin with that were latched before the file began.
pub const TOPIC_OF_STATE: &str = "/state/";
/// What stands between frames.
pub const NOTES: &str = "/can/notes";
