//! A whole bench in virtual time: the real cells, the real table and the real loop of the gateway, on a
//! bus that is a variable.
//!
//! ```text
//!                  +-- Bench: one queue of events, one clock that only moves when told to --+
//!                  |                                                                         |
//!   cell_node::Node ──> packets ──> [ wire: one total order ] ──> [ each receiver: delay ] ──┼─> Node
//!   control::Cycle  ──> joints  ──>   Faults hit everybody          Faults hit one of them   ├─> Table
//!   a stranger      ──> anything                                                             |
//!                  +--------------------------------------------------- Witness looks on ---+
//! ```
//!
//! Nothing sleeps, nothing reads a clock, and everything random comes from one seed: the same seed is the
//! same run, byte for byte. [`accounts::check`] holds what must be true of every run, whatever was broken.

pub mod accounts;
mod agenda;
pub mod bench;
pub mod cell_slot;
pub mod fault;
pub mod gateway;
mod life;
pub mod network;
pub mod oracle;
pub mod real_bus;
pub mod skins;
pub mod workshop;
