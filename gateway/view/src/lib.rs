//! The live view of a skin: a page that draws it in a browser, and the server of the page.
//!
//! ```text
//!   buses ──> Live ── snapshot, 30 Hz ──> newest ──> a thread for each client ──> WebSocket ──> page
//!     ^         │                                            │
//!     └── stimuli ── Pressed <──────── commands ─────────────┘
//! ```
//!
//! The view only receives on the buses, like any other node. It therefore does not disturb a control loop, and shows
//! what the buses actually carry. A touch on the page becomes a stimulus on the bus, which cells in test mode obey.
//!
//! A recording is shown in the same way: [`tape`] applies its frames to [`LiveState`] up to a position in time,
//! [`index`] stores the state at intervals, and [`player`] continues from a stored state to any position.
//!
//! A skin without buses is shown as a [`StaticSkinPage`]: one HTML file with the same scene, drawn by the same scripts.
//!
//! [`foxglove`] sends the topics of a recording to other programs that show them, live or as it is played.
//!
//! [`control`] is the same for programs: commands on standard input, events on standard output.
//!
//! [`live`], [`pressed`], [`scene`], [`still`], [`surface`], [`command`], [`page_command`] and [`tape`] use neither sockets nor clocks.
//! [`server`], [`serve`] and [`play`] do the input and output for them.

pub mod command;
pub mod control;
pub mod curves;
mod followed;
pub mod foxglove;
pub mod index;
pub mod live;
pub mod page_command;
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

pub use live::LiveState;
pub use scene::Scene;
pub use still::{CellShades, FindingPart, PreviousCellPlace, StaticSkinPage};
pub use surface::RowMesh;
pub use token::Token;

/// Locks a mutex, even if a thread has panicked while it held the lock.
fn lock_ignoring_poison<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
