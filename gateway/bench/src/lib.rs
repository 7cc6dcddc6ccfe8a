//! Live benches: cells as processes, buses, the control loop, and what is recorded of them.
//!
//! | module | what |
//! |---|---|
//! | [`run`] | a run: processes, buses, loop, and what it came to ([`summary`]) |
//! | [`record`] | what a run records, and the thread that writes it |
//! | [`replay`] | a capture on a bus again, compared |
//! | [`view`] | what a receiver shows of a bus' cells |
//! | [`signals`] | signals that end a command |

pub mod record;
pub mod replay;
pub mod run;
mod setup;
pub mod signals;
pub mod summary;
pub mod view;
