//! The request for the figures of a timed bus: one datagram there, one with JSON back.

use std::os::fd::OwnedFd;
use std::path::Path;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::net::{RecvFlags, SendFlags};

use super::client::connect;
use super::{HELLO_MAGIC, HELLO_VERSION};
use crate::bus::BusError;

/// First datagram of a program that requests figures instead of attaching to the bus: a hello that ends after its version.
pub const FIGURES_REQUEST: [u8; 8] = {
    let [s, k, i, n, b, u, s2] = *HELLO_MAGIC;
    [s, k, i, n, b, u, s2, HELLO_VERSION]
};
/// Maximum length of the figures in bytes.
pub const MAX_FIGURES_BYTES: usize = 1 << 17;

/// A request for the figures of an embedded bus whose answer is pending.
#[derive(Debug)]
pub struct FiguresRequest(OwnedFd);

impl FiguresRequest {
    /// Sends a request to the server of a bus in `directory`, or else in the usual one.
    ///
    /// # Errors
    /// Returns [`BusError`] if no server accepts the request.
    pub fn send(name: &str, directory: Option<&Path>) -> Result<Self, BusError> {
        let socket = connect(name, directory)?;
        rustix::net::send(&socket, &FIGURES_REQUEST, SendFlags::NOSIGNAL)
            .map_err(|errno| BusError::open_error(name, "send to", errno))?;
        Ok(Self(socket))
    }

    /// Waits for the answer. Returns `None` if it has not come. The answer is JSON; it is empty if the server has no figures,
    /// because frames take no time on its bus, or has ended.
    #[must_use]
    pub fn receive(&self, timeout: Duration) -> Option<Vec<u8>> {
        let mut polled = [PollFd::new(&self.0, PollFlags::IN)];
        let wait = Timespec::try_from(timeout).ok()?;
        if rustix::io::retry_on_intr(|| poll(&mut polled, Some(&wait))).ok()? == 0 {
            return None;
        }
        let mut bytes = vec![0; MAX_FIGURES_BYTES];
        let received = rustix::net::recv(&self.0, &mut bytes, RecvFlags::DONTWAIT);
        bytes.truncate(received.map_or(0, |(len, _)| len));
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::embedded::ClientHello;

    #[test]
    fn a_request_is_the_magic_with_the_version_and_no_hello() {
        assert_eq!(FIGURES_REQUEST, *b"skinbus\x03");
        assert_eq!(ClientHello::decode(&FIGURES_REQUEST), None);
    }
}
