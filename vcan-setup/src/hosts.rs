//! Joins the buses of several hosts into one: numbers the frames of each host, sends them in batches, and counts every
//! frame.
//!
//! ```text
//! bus ──> outgoing ──> message ──> transport ──> incoming ──> bus of another host
//! ```
//!
//! This module has no input or output. The program `vcan-link` adds the transport that carries the bytes ([`program`]).
//! Each host numbers every frame that it receives from its bus, including frames that it drops afterwards. A receiving
//! host therefore knows how many frames are missing and where they were lost.

pub mod incoming;
pub mod message;
pub mod options;
pub mod outgoing;
pub mod program;
pub mod report;
pub mod returned;
