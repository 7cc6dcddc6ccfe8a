//! Captures as MCAP recordings: the channels of frames and notes are read, other topics are counted.

mod foreign;
mod read;

pub(super) use read::{Fault, McapReader};
