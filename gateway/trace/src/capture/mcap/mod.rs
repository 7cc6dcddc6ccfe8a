//! Captures as MCAP recordings: the channels of frames and notes are read and written, other topics are counted.

mod foreign;
mod read;
mod state;
mod write;

pub(super) use read::{Fault, McapReader};
pub(super) use state::State;
pub use write::ORIGIN;
pub(super) use write::{McapWriter, SOURCE};
