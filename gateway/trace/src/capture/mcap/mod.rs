//! Captures as MCAP recordings: the channels of frames and notes are read and written, other topics are counted.

mod foreign;
mod read;
mod write;

pub(super) use read::{Fault, McapReader};
pub use write::ORIGIN;
pub(super) use write::{McapWriter, SOURCE};
