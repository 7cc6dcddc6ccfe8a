//! Foxglove's WebSocket protocol: other programs show the topics of a recording, live or as it is played.
//!
//! ```text
//!   buses ─────> LiveTopics ───┐                ┌─> queue ─> thread ─> WebSocket ─> viewer
//!                              ├─> MessageHub ──┤
//!   recording ─> PlayedTopics ─┘                └─> queue ─> thread ─> WebSocket ─> viewer
//! ```
//!
//! Viewers only receive: nothing that they send changes the bench, the robot or the playback. A slow viewer loses its
//! oldest messages and delays nobody.

mod hub;
mod live;
mod played;
mod protocol;
mod queue;
mod server;
mod viewer;

pub(crate) use live::LiveTopics;
pub(crate) use played::PlayedTopics;
pub(crate) use server::FoxgloveServer;
pub use server::{FoxgloveOptions, foxglove_url};
