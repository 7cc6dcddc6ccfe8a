//! Opens lines without blocking: terminals in raw mode, Unix sockets and TCP sockets.

use std::io;
use std::net::{SocketAddr, ToSocketAddrs};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FileType, FlockOperation, Mode, OFlags, flock};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, sockopt};
use rustix::termios::{self, ControlModes, InputModes, OptionalActions, QueueSelector, SpecialCodeIndex};

use super::options::{LineAddress, LineOptions};

/// The time within which a TCP connection must be established.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// The send buffer of a socket in bytes. A larger buffer would delay frames and hide that the other side is too slow.
const SEND_BUFFER_BYTES: usize = 16 << 10;
/// The time without data after which a TCP connection is probed, with three probes a second apart.
const KEEPALIVE_IDLE: Duration = Duration::from_secs(5);

/// A line that is open or is being opened.
#[derive(Debug)]
pub(super) struct LinePort {
    fd: OwnedFd,
    is_tty: bool,
    /// The time at which an attempt to connect is given up; `None` if the line is open.
    connecting: Option<Instant>,
}

impl AsFd for LinePort {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

/// Opens a line, and opens it again whenever it was lost.
#[derive(Debug)]
pub(super) struct PortOpener {
    options: LineOptions,
    /// The addresses of the host of a TCP line. They are resolved once, because that may take long.
    hosts: Vec<SocketAddr>,
    next: usize,
}

impl PortOpener {
    pub(super) fn new(options: LineOptions) -> io::Result<Self> {
        let hosts = match &options.address {
            LineAddress::Tcp { host, port } => (host.as_str(), *port).to_socket_addrs()?.collect(),
            LineAddress::Tty(_) | LineAddress::Unix(_) => Vec::new(),
        };
        Ok(Self { options, hosts, next: 0 })
    }

    pub(super) const fn options(&self) -> &LineOptions {
        &self.options
    }

    pub(super) fn open(&mut self) -> io::Result<LinePort> {
        match &self.options.address {
            LineAddress::Tty(path) => {
                let fd = open_tty(path, self.options.baud)?;
                Ok(LinePort { fd, is_tty: true, connecting: None })
            }
            LineAddress::Unix(path) => {
                let address = SocketAddrUnix::new(path)?;
                connect(AddressFamily::UNIX, |fd| rustix::net::connect(fd, &address))
            }
            LineAddress::Tcp { .. } => {
                let host = self.hosts.get(self.next % self.hosts.len().max(1));
                let host = *host.ok_or_else(|| io::Error::other("the host name has no address"))?;
                self.next += 1;
                let family = if host.is_ipv4() { AddressFamily::INET } else { AddressFamily::INET6 };
                let port = connect(family, |fd| rustix::net::connect(fd, &host))?;
                sockopt::set_tcp_nodelay(&port, true)?;
                sockopt::set_socket_keepalive(&port, true)?;
                sockopt::set_tcp_keepidle(&port, KEEPALIVE_IDLE)?;
                sockopt::set_tcp_keepintvl(&port, Duration::from_secs(1))?;
                sockopt::set_tcp_keepcnt(&port, 3)?;
                Ok(port)
            }
        }
    }
}

impl LinePort {
    /// Returns true if the connection is not established yet.
    pub(super) const fn is_connecting(&self) -> bool {
        self.connecting.is_some()
    }

    /// Checks a connection that was being established. Returns true once it is.
    pub(super) fn check_connected(&mut self) -> io::Result<bool> {
        let Some(until) = self.connecting else { return Ok(true) };
        let mut polled = [PollFd::new(&self.fd, PollFlags::OUT)];
        if poll(&mut polled, Some(&Timespec::default()))? == 0 {
            return if Instant::now() < until { Ok(false) } else { Err(Errno::TIMEDOUT.into()) };
        }
        sockopt::socket_error(&self.fd)??;
        // If no program listens on a port of the ephemeral range, repeated attempts sooner or later connect the socket
        // to itself, and every frame would come back.
        if Some(rustix::net::getsockname(&self.fd)?) == rustix::net::getpeername(&self.fd)? {
            return Err(Errno::CONNREFUSED.into());
        }
        self.connecting = None;
        Ok(true)
    }

    /// Reads available bytes. Returns their number, which is 0 if none are available yet.
    pub(super) fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        match rustix::io::read(&self.fd, buffer) {
            Ok(0) => Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the other end closed it")),
            Ok(count) => Ok(count),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(errno) => Err(errno.into()),
        }
    }

    /// Writes as many bytes as the line accepts at once. Returns their number.
    pub(super) fn write(&self, bytes: &[u8]) -> io::Result<usize> {
        let done = if self.is_tty {
            rustix::io::write(&self.fd, bytes)
        } else {
            rustix::net::send(&self.fd, bytes, rustix::net::SendFlags::NOSIGNAL)
        };
        match done {
            Ok(count) => Ok(count),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(errno) => Err(errno.into()),
        }
    }

    /// Discards the output of a terminal that is not sent yet. Otherwise closing it would wait for an adapter that
    /// accepts nothing.
    pub(super) fn discard_output(&self) {
        if self.is_tty {
            let _ = termios::tcflush(&self.fd, QueueSelector::OFlush);
        }
    }
}

fn connect(
    family: AddressFamily,
    connect: impl FnOnce(&OwnedFd) -> rustix::io::Result<()>,
) -> io::Result<LinePort> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let fd = rustix::net::socket_with(family, SocketType::STREAM, flags, None)?;
    sockopt::set_socket_send_buffer_size(&fd, SEND_BUFFER_BYTES)?;
    let connecting = match connect(&fd) {
        Ok(()) if family == AddressFamily::UNIX => None,
        Ok(()) | Err(Errno::INPROGRESS) => Some(Instant::now() + CONNECT_TIMEOUT),
        Err(errno) => return Err(errno.into()),
    };
    Ok(LinePort { fd, is_tty: false, connecting })
}

/// Opens a terminal in raw mode for reading and writing, and locks it against other programs that use such locks.
fn open_tty(path: &Path, baud: Option<u32>) -> io::Result<OwnedFd> {
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let other = |hint: String| Err(io::Error::new(io::ErrorKind::InvalidInput, hint));
    let fd = match rustix::fs::open(path, flags, Mode::empty()) {
        Ok(fd) => fd,
        Err(Errno::NXIO) if is_socket(path) => {
            return other(format!("it is a socket: write unix:{}", path.display()));
        }
        Err(errno) => return Err(errno.into()),
    };
    // TIOCEXCL is not used, because it does not keep root out and stays set if the program is killed.
    match flock(&fd, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => {}
        Err(Errno::WOULDBLOCK) => {
            let used = "another program uses it; stop that program first";
            return Err(io::Error::new(io::ErrorKind::ResourceBusy, used));
        }
        Err(errno) => return Err(errno.into()),
    }
    let mut settings = match termios::tcgetattr(&fd) {
        Ok(settings) => settings,
        Err(Errno::NOTTY) => return other("it is not a terminal".to_owned()),
        Err(errno) => return Err(errno.into()),
    };
    settings.make_raw();
    settings.input_modes.remove(InputModes::IXOFF | InputModes::IXANY);
    settings.control_modes.remove(ControlModes::CRTSCTS | ControlModes::CSTOPB);
    settings.control_modes.insert(ControlModes::CLOCAL | ControlModes::CREAD);
    settings.special_codes[SpecialCodeIndex::VMIN] = 1;
    settings.special_codes[SpecialCodeIndex::VTIME] = 0;
    if let Some(baud) = baud {
        settings.set_speed(baud)?;
    }
    termios::tcsetattr(&fd, OptionalActions::Now, &settings)?;
    Ok(fd)
}

fn is_socket(path: &Path) -> bool {
    let about = rustix::fs::stat(path);
    about.is_ok_and(|about| FileType::from_raw_mode(about.st_mode) == FileType::Socket)
}
