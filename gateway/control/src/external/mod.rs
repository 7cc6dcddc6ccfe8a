//! External controller (`kind = "external"`): another program closes the loop over a Unix datagram socket.
//!
//! ```text
//!   tick n     ── state n ──>                      one datagram a tick from the gateway,
//!              <── answer n ──   before tick n+1   one back; its command is executed in tick n+1
//! ```
//!
//! The answer to a tick must have arrived when the next tick starts, or the cycle is bad. The other program sends a
//! hello first; the sender of the last hello is the peer, and only its answers count. No datagram can stop a tick:
//! invalid ones are counted by reason. `docs/how-to/external-controller.md` describes the bytes.

mod absence;
mod datagram;
mod exchange;
mod socket;

pub use absence::{ControllerAbsence, OtherDatagrams};
pub use datagram::{AnswerDatagram, InvalidDatagram, JointCommand, StateDatagram};
pub use socket::{ExternalController, SocketError};

#[cfg(test)]
mod tests;
