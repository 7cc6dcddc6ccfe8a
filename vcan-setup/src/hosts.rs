//! One bus on several hosts: its frames in numbered batches, and what has become of each.
//!
//! ```text
//!   bus ──> outgoing ──> message ──> transport ──> incoming ──> bus of another host
//! ```
//!
//! No input or output: a shell with a transport, the program `vcan-link`, moves the bytes ([`program`]). A source numbers every frame that it takes from its bus,
//! those that it then drops too, so that whoever hears it knows how many are missing and where they were lost.

pub mod incoming;
pub mod message;
pub mod options;
pub mod outgoing;
pub mod program;
pub mod report;
pub mod returned;
