//! The live view of a skin: a page that draws it in a browser, and the server of the page.
//!
//! ```text
//!   buses ──> Live ── snapshot, 30 Hz ──> newest ──> a thread for each client ──> WebSocket ──> page
//!     ^         │                                            │
//!     └── stimuli ── Pressed <──────── commands ─────────────┘
//! ```
//!
//! The view receives on the buses like any other node, so that it does not disturb a control loop beside it, and shows
//! exactly what the buses carry. Touches are stimuli on the bus, which cells in test mode obey.
//!
//! Recordings use the same path: [`tape`] applies the frames up to a moment to [`Live`], [`index`] keeps intermediate
//! states, and [`player`] continues from one of them to any moment.
//!
//! A skin without its buses is a [`Still`]: one file with the same scene, drawn by the same modules of the page.
//!
//! [`live`], [`pressed`], [`scene`], [`still`], [`surface`], [`command`] and [`tape`] use neither sockets nor clocks;
//! [`server`], [`serve`] and [`play`] are the shell around them.

pub mod command;
pub mod index;
pub mod live;
pub mod play;
pub mod player;
pub mod pressed;
pub mod scene;
pub mod serve;
pub mod server;
pub mod still;
pub mod surface;
pub mod tape;
pub mod token;
mod web;

use std::sync::{Mutex, MutexGuard, PoisonError};

pub use live::Live;
pub use scene::Scene;
pub use still::{MovedCell, Still};
pub use surface::RowMesh;
pub use token::Token;

/// Locks a mutex, also after a thread that held it has panicked.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
