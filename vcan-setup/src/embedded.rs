//! The embedded bus: the rules of `CAN_RAW` over a Unix socket, for machines whose kernel has no SocketCAN.
//!
//! ```text
//!   client --datagram--> [ Parcel::accept ] -> [ Router ] -> [ Queue ] per client --datagram--> client
//!                          16 or 72 bytes       filters       bounded, counts drops
//! ```
//!
//! With a [`TimedBusOptions`], a model of a real bus stands between acceptance and routing: `timed.rs`.
//!
//! Routing, queues and the timed bus are pure. [`Server`] does the input and output, with one thread and one `epoll`. Frames are
//! forwarded in the order in which the server reads them, so all clients receive them in the same order. Only the user
//! who serves the bus can connect. The bus is not an `AF_CAN` interface, so `candump` cannot attach to it.

mod client;
pub mod parcel;
pub mod place;
pub mod queue;
pub mod routing;
mod served;
pub mod server;
mod timed;
mod totals;

pub use place::BusSocketError;
pub use served::ServerThread;
pub use server::{ServeError, Server};
pub use timed::{BusRecord, TimedBusOptions, TimedReport};
pub use totals::BusTotals;

#[cfg(test)]
#[allow(unreachable_pub, reason = "the tests on a real kernel have the same table")]
#[path = "../../tests/src/can_raw.rs"]
mod cases;
