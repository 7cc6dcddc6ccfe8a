//! One bus on several hosts: its frames in numbered batches, and what has become of each.
//!
//! ```text
//!   bus ──> outgoing ──> message ──> transport ──> incoming ──> bus of another host
//! ```
//!
//! No input or output: a shell with a transport moves the bytes. A source numbers every frame that it takes from its bus,
//! those that it then drops too, so that whoever hears it knows how many are missing and where they were lost.

#[cfg(feature = "link")]
pub mod event;
pub mod incoming;
#[cfg(feature = "link")]
pub mod link;
#[cfg(feature = "link")]
mod log;
pub mod message;
pub mod outgoing;
pub mod report;
pub mod returned;
#[cfg(feature = "link")]
pub mod session;
#[cfg(feature = "link")]
mod watchers;
