//! The embedded bus: the rules of `CAN_RAW` over a Unix socket, for machines whose kernel has no SocketCAN.
//!
//! ```text
//!   client --datagram--> [ Parcel::accept ] -> [ Router ] -> [ Queue ] per client --datagram--> client
//!                          16 or 72 bytes       filters       bounded, counts drops
//! ```
//!
//! Routing and queues are pure; [`Server`] is the shell around them: one thread, one `epoll`. Frames are forwarded in
//! the order in which they are read, so all clients see the same order. The bus is private to the user, and it is not
//! `AF_CAN`: `candump` cannot attach to it.

mod client;
pub mod parcel;
pub mod place;
pub mod queue;
pub mod routing;
mod served;
pub mod server;
mod totals;

pub use place::BusSocketError;
pub use served::ServerThread;
pub use server::{ServeError, Server};
pub use totals::BusTotals;

#[cfg(test)]
#[allow(unreachable_pub, reason = "the tests on a real kernel have the same table")]
#[path = "../../tests/src/can_raw.rs"]
mod cases;
