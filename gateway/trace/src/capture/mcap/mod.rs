//! Captures as MCAP recordings: the channels of frames and notes are read and written, other topics are counted.

mod foreign;
mod read;
mod state;
mod write;

pub(super) use read::McapReader;
pub(super) use state::State;
pub use write::ORIGIN;
pub(super) use write::{McapWriter, SOURCE};

use std::io;

use thiserror::Error;

use crate::container::Damage;

/// Why nothing more comes.
#[derive(Debug, Error)]
pub(super) enum Fault {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error(transparent)]
    Damaged(#[from] Damage),
}
