//! Live benches: cells as processes, buses, the control loop, and what is recorded of them.
//!
//! | module | what |
//! |---|---|
//! | [`listen`] | an open bus on which others speak |
//! | [`cells`], [`commission`], [`sensing`] | asking cells, writing their parameters, switching what they tell |
//! | [`run`] | a run: processes, buses, loop, and what it came to ([`summary`]) |
//! | [`record`] | what a run records, and the thread that writes it |
//! | [`replay`] | a capture on a bus again, compared |
//! | [`view`] | what a receiver shows of a bus' cells |
//! | [`signals`] | signals that end a command |

pub mod cells;
pub mod commission;
pub mod listen;
pub mod record;
pub mod replay;
pub mod run;
pub mod sensing;
mod setup;
pub mod signals;
pub mod summary;
pub mod view;
