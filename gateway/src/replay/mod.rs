//! Replay.

pub mod difference;
pub mod judge;
pub mod order;
pub mod player;
pub mod reel;
pub mod state;
pub mod survey;
