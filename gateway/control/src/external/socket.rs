//! The socket of an external controller. It receives and sends datagrams; the module `exchange` handles them.

use std::io::{self, ErrorKind};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::{Path, PathBuf};

use protocol::skin::Skin;
use rustix::fs::{Mode, fchmod};
use rustix::io::Errno;
use rustix::net::SocketAddrUnix;
use thiserror::Error;

use super::absence::ControllerAbsence;
use super::datagram::{MAX_ANSWER_BYTES, StateDatagram};
use super::exchange::{DatagramExchange, DatagramSender, SendResult};
use crate::controller::{Controller, ControllerInput, ControllerOutput, SpeedLimits};

/// Maximum number of datagrams that are received per tick. Others remain in the socket's queue, so that no sender can
/// delay the tick.
const MAX_DATAGRAMS_PER_TICK: usize = 16;

/// A controller in another program.
#[derive(Debug)]
pub struct ExternalController {
    socket: UnixDatagram,
    path: PathBuf,
    /// Device and inode of the socket's file. At the end the file is removed only if it is still this one.
    file: Option<(u64, u64)>,
    peer: Option<SocketAddr>,
    exchange: DatagramExchange,
    pace: SpeedLimits,
    joints: u32,
}

/// The error for a socket on which the gateway cannot listen.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SocketError {
    /// Another program listens on this socket.
    #[error("another program listens on the socket {}; stop it, or choose another path", path.display())]
    Live {
        /// Path of the socket.
        path: PathBuf,
    },
    /// There is a file at the path, but it is not a socket.
    #[error("{} exists and is not a socket, so it was left unchanged; choose another path", path.display())]
    NotASocket {
        /// Path of the socket.
        path: PathBuf,
    },
    /// The file system gives the socket other permissions than read and write for its user only.
    #[error("the socket {} has mode {mode:04o} instead of 0600, so other users may connect; choose a path on another file system", path.display())]
    Mode {
        /// Path of the socket.
        path: PathBuf,
        /// Permission bits of the socket.
        mode: u32,
    },
    /// The system refuses the operation.
    #[error("cannot listen on the socket {}", path.display())]
    System {
        /// Path of the socket.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

impl ExternalController {
    /// Listens on a socket at a path. A socket file that no program listens on is replaced.
    ///
    /// # Errors
    /// Returns [`SocketError`] if another program listens there, the file is not a socket, or the system refuses.
    pub fn listen(path: &Path, skin: &Skin) -> Result<Self, SocketError> {
        Ok(Self {
            socket: bind(path)?,
            file: file_identity(path),
            path: path.to_owned(),
            peer: None,
            exchange: DatagramExchange::new(skin.robot.joints.len()),
            pace: SpeedLimits::from_skin(skin),
            joints: u32::try_from(skin.robot.joints.len()).unwrap_or_default(),
        })
    }

    fn receive(&mut self) {
        // One byte more than the longest datagram, to detect longer ones.
        let mut bytes = [0; MAX_ANSWER_BYTES + 1];
        for _ in 0..MAX_DATAGRAMS_PER_TICK {
            let (length, from) = match self.socket.recv_from(&mut bytes) {
                Ok(received) => received,
                Err(error) if error.kind() == ErrorKind::WouldBlock => return,
                Err(_) => {
                    self.exchange.counts.failed += 1;
                    return;
                }
            };
            if from.is_unnamed() {
                self.exchange.counts.failed += 1;
                continue;
            }
            let known = self.peer.as_ref().is_some_and(|peer| is_same_address(peer, &from));
            let sender = if known { DatagramSender::Peer } else { DatagramSender::Other };
            if self.exchange.handle_datagram(bytes.get(..length).unwrap_or(&bytes), sender) {
                self.peer = Some(from);
            }
        }
    }

    fn send(&mut self, input: &ControllerInput) {
        let Some(peer) = &self.peer else { return };
        let state = StateDatagram { input: *input, joints: self.joints }.encode();
        let sent = match self.socket.send_to_addr(&state, peer) {
            Ok(_) => SendResult::Taken,
            // None of these errors means that the peer has gone.
            Err(error) if is_transient(&error) => SendResult::QueueFull,
            Err(_) => SendResult::PeerGone,
        };
        if sent == SendResult::PeerGone {
            self.peer = None;
        }
        self.exchange.record_send_result(input.tick, sent);
    }
}

impl Controller for ExternalController {
    fn step(&mut self, input: &ControllerInput) -> ControllerOutput {
        self.receive();
        let step = self.exchange.step(input, &self.pace);
        self.send(input);
        step
    }

    fn named_counters(&self) -> Vec<(String, u64)> {
        self.exchange.counts.named_counters().collect()
    }

    fn absence(&self, silent: Option<u32>) -> Option<ControllerAbsence> {
        self.exchange.counts.absence(self.path.clone(), silent)
    }
}

impl Drop for ExternalController {
    fn drop(&mut self) {
        if self.file.is_some() && file_identity(&self.path) == self.file {
            // Ignore the error: the next gateway replaces a dead socket.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

fn bind(path: &Path) -> Result<UnixDatagram, SocketError> {
    let system = |source| SocketError::System { path: path.to_owned(), source };
    let socket = match bind_private(path) {
        Err(error) if error.kind() == ErrorKind::AddrInUse => {
            if !std::fs::symlink_metadata(path).map_err(system)?.file_type().is_socket() {
                return Err(SocketError::NotASocket { path: path.to_owned() });
            }
            match UnixDatagram::unbound().and_then(|probe| probe.connect(path)) {
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => {
                    std::fs::remove_file(path).and_then(|()| bind_private(path))
                }
                Ok(()) | Err(_) => return Err(SocketError::Live { path: path.to_owned() }),
            }
        }
        bound => bound,
    };
    let socket = socket.map_err(system)?;
    socket.set_nonblocking(true).map_err(system)?;
    let mode = std::fs::symlink_metadata(path).map_err(system)?.mode() & 0o7777;
    if mode & 0o077 != 0 {
        // No datagram was received from it.
        let _ = std::fs::remove_file(path);
        return Err(SocketError::Mode { path: path.to_owned(), mode });
    }
    Ok(socket)
}

/// Binds a socket to which only its user may send, whatever the umask is. Linux gives the new file the mode of the
/// socket that is bound, so other users never have access.
fn bind_private(path: &Path) -> io::Result<UnixDatagram> {
    let socket = UnixDatagram::unbound()?;
    fchmod(&socket, Mode::RUSR | Mode::WUSR)?;
    rustix::net::bind(&socket, &SocketAddrUnix::new(path)?)?;
    Ok(socket)
}

/// Returns true if an error of the socket may have passed by the next tick, so that it is no reason to end.
fn is_transient(error: &io::Error) -> bool {
    let errno = Errno::from_io_error(error);
    matches!(errno, Some(Errno::AGAIN | Errno::INTR | Errno::NOMEM | Errno::NOBUFS))
}

/// Returns the device and inode of a file; `None` if there is no file.
fn file_identity(path: &Path) -> Option<(u64, u64)> {
    std::fs::symlink_metadata(path).ok().map(|file| (file.dev(), file.ino()))
}

/// Returns true if two sockets have the same address. Both must have one.
fn is_same_address(one: &SocketAddr, other: &SocketAddr) -> bool {
    one.as_pathname() == other.as_pathname() && one.as_abstract_name() == other.as_abstract_name()
}
