//! `kind = "external"`: another program closes the loop, behind a Unix datagram socket.
//!
//! ```text
//!   tick n     ── state n ──>                      one datagram a tick from the gateway,
//!              <── answer n ──   before tick n+1   one back; its command is executed in tick n+1
//! ```
//!
//! The answer to the last tick must be there when the next one begins, else the cycle is bad. The other
//! program sends a hello first; the sender of the last hello is the peer, and only its answers count. No
//! datagram can stop a tick: others are counted, by reason. The bytes are in
//! `docs/how-to/external-controller.md`.

mod absence;
mod datagram;
mod exchange;
mod socket;

pub use absence::{Absence, Others};
pub use datagram::{Answer, Command, Nonsense, State};
pub use socket::{External, SocketError};

#[cfg(test)]
mod tests;
