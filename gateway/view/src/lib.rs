//! The skin live in a browser: a page that draws it, and the server behind the page.
//!
//! ```text
//!   buses ──> Live ── snapshot, 30 Hz ──> newest ──> a thread for each client ──> WebSocket ──> page
//!     ^         │                                            │
//!     └── stimuli ── Pressed <──────── commands ─────────────┘
//! ```
//!
//! It listens to the buses as any other node, so that a control loop beside it is not touched: what it shows is what
//! the buses carried. Touches are stimuli on the bus, which cells in test mode obey.
//!
//! A recording goes the same way: [`tape`] takes its frames up to a moment into [`Live`], [`index`] keeps states on the way,
//! and [`player`] goes from one of them to any moment.
//!
//! A skin without its buses is a [`Still`]: one file with the same scene and the same page's modules.
//!
//! [`live`], [`pressed`], [`scene`], [`still`], [`surface`], [`command`] and [`tape`] have no socket and no clock; [`server`], [`serve`] and
//! [`play`] are the shell.

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
pub use still::{Moved, Still};
pub use surface::Shell;
pub use token::Token;

/// Locks a mutex, also after a thread that held it has panicked.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
