//! `kind = "external"`: somebody else's program closes the loop, behind a Unix datagram socket.
//!
//! ```text
//!   tick n     ── state n ──>                      one datagram a tick from the gateway,
//!              <── answer n ──   before tick n+1   one back; what it asks for is done in tick n+1
//! ```
//!
//! The answer to the last tick must be there when the next one begins, else the cycle is bad. The other
//! program says hello first; who said it last is the peer, and only the peer is listened to. Nothing
//! that anybody sends can stop a tick: it is counted, by reason. The bytes are in
//! `docs/reference/external-controller.md`.

mod datagram;
mod exchange;
mod socket;

pub use datagram::{Answer, Command, Nonsense, State};
pub use socket::{External, SocketError};

#[cfg(test)]
mod tests;
