//! Serial lines that speak slcan, each as a participant of a bus.
//!
//! ```text
//!              one client for each line, with its filters
//!   bus  ────> [Outgoing: queue, pacing] ────> line      t1232AABB CR
//!        <──── [Incoming: decoder, queue] <────
//! ```
//!
//! [`Outgoing`](outgoing::Outgoing), [`Incoming`](incoming::Incoming) and the account take bytes, frames and times, and
//! touch nothing. A [`Bridge`] is one thread around all lines of a bus. It never waits for a line or for the bus: what
//! does not fit a queue is dropped, and counted by reason.

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

pub use account::Account;
pub use bridge::{Bridge, BridgeError};
pub use event::Event;
pub use options::{Address, LineError, LineOptions};
pub use settings::Settings;
