//! One bus on several hosts: numbers the frames of each host, sends them in batches, and accounts for each frame.
//!
//! ```text
//! bus ──> outgoing ──> message ──> transport ──> incoming ──> bus of another host
//! ```
//!
//! This module has no input or output. The program `vcan-link`, a shell with a transport, moves the bytes
//! ([`program`]). A source numbers every frame that it receives from its bus, including those that it drops afterwards.
//! The receiver therefore knows how many frames are missing and where they were lost.

pub mod incoming;
pub mod message;
pub mod options;
pub mod outgoing;
pub mod program;
pub mod report;
pub mod returned;
