//! Live benches: cells as processes, buses, the control loop, and recordings of them.
//!
//! | module | what |
//! |---|---|
//! | [`bus`] | buses: opened, served, received from |
//! | [`processes`] | processes of cells |
//! | [`cells`], [`commission`], [`sensing`] | querying cells, writing their parameters, switching what they report |
//! | [`emulate`] | cells that run a microcontroller's machine code in an emulator |
//! | [`run`] | a run: processes, buses, loop, and its result ([`summary`]) |
//! | [`record`] | what a run records, and the thread that writes it |
//! | [`remote`] | commands to a run from other processes, and the data that it sends them |
//! | [`replay`] | plays a capture on a bus again and compares the answers |
//! | [`view`] | the state of the cells of a bus, for display |
//! | [`signals`] | signals that end a command |

pub mod answers;
pub mod bus;
pub mod cells;
pub mod commission;
pub mod emulate;
mod error;
pub mod processes;
pub mod progress;
pub mod record;
pub mod remote;
pub mod replay;
pub mod run;
pub mod sensing;
mod setup;
pub mod signals;
pub mod summary;
#[expect(unsafe_code, reason = "scheduling class and timer slack have no safe wrapper")]
mod system_calls;
pub mod threads;
pub mod view;

#[cfg(test)]
mod tests;
