//! Connects serial lines with the slcan protocol to a bus. The adapter behind each line becomes a node of the bus.
//!
//! ```text
//!              one client for each line, with its filters
//!   bus  ────> [BusToLineQueue: pacing] ──> line      t1232AABB CR
//!        <──── [LineToBusQueue: decoder] <──
//! ```
//!
//! [`BusToLineQueue`](outgoing::BusToLineQueue), [`LineToBusQueue`](incoming::LineToBusQueue) and the account process
//! bytes, frames and times without input or output. A [`Bridge`] is one thread that serves all lines of a bus. It never
//! waits for a line or for the bus: frames that do not fit into a queue are dropped, and counted by reason.

pub mod account;
mod bridge;
mod event;
pub mod incoming;
mod link;
pub mod options;
pub mod outgoing;
mod participant;
pub mod refusals;
mod settings;

pub use account::LineAccount;
pub use bridge::{Bridge, BridgeError};
pub use event::LineEvent;
pub use options::{LineAddress, LineError, LineOptions};
pub use settings::BridgeSettings;
