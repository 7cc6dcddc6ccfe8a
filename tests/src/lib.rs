//! A complete bench in virtual time: the real cells, the real table and the real loop of the gateway, on a simulated
//! bus.
//!
//! ```text
//!                  +-- Bench: one queue of events, one clock, moved by the test alone ------+
//!                  |                                                                         |
//!   cell_node::Node ──> packets ──> [ wire: one total order ] ──> [ each receiver: delay ] ──┼─> Node
//!   control::Cycle  ──> joints  ──>   faults for all receivers      faults for one of them   ├─> Table
//!   an unknown node ──> anything                                                             |
//!                  +------------------------------- an oracle compares the table's sums ----+
//! ```
//!
//! No code sleeps or reads a clock, and all randomness comes from one seed: the same seed gives the same run, byte for
//! byte. [`accounts::check`] has the invariants of every run.

pub mod accounts;
mod agenda;
#[cfg(test)]
mod architecture;
pub mod bench;
pub mod bus_time;
pub mod can_raw;
pub mod cell_slot;
#[cfg(test)]
mod circles;
#[cfg(test)]
mod comments;
#[cfg(test)]
mod documents;
pub mod fault;
pub mod fuzz;
pub mod gateway;
mod life;
pub mod network;
pub mod oracle;
pub mod process;
pub mod real_bus;
pub mod skins;
#[cfg(test)]
mod tree;
pub mod workshop;
