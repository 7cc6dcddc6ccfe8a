//! The control channel of a run: commands and events of another program, one JSON object a line.
//!
//! ```text
//!   standard input ──> lines ──> [ControlState] ──> events ──> [EventQueue] ──> standard output
//!                                  │  ^    │
//!              stimuli, halts  <───┘  │    └──> commands ──> main thread of the run
//!                      │              │                          │
//!                      └──> buses ────┴──────── its state <──────┘
//! ```
//!
//! `docs/reference/control.md` describes commands and events. [`ControlState`] uses neither sockets nor clocks;
//! [`channel`] does the input and output for it.

mod bus;
pub mod channel;
pub mod event;
mod presses;
mod queue;
pub mod request;
mod state;

pub use event::ControlEvent;
pub use queue::{EventQueue, UnreadEvents};
pub use state::{ControlOutput, ControlState};
