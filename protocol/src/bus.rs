//! A CAN bus: SocketCAN or the embedded bus, behind one type.
//!
//! ```no_run
//! use protocol::bus::{Bus, BusOptions, Filter, Inbox, KindChoice};
//! use protocol::can::Frame;
//! use protocol::id::{Command, Id};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let options = BusOptions { filters: vec![Filter::exact(Id::command(Command::Joints))], ..BusOptions::default() };
//! let bus = Bus::open("vcan0", KindChoice::Auto, &options)?;
//! let mut inbox = Inbox::new();
//! while bus.wait(None)? {
//!     bus.receive(&mut inbox)?;
//!     for received in inbox.frames() {
//!         bus.send(&[Frame::classic(0x201, received.frame.data())?])?;
//!     }
//! }
//! # Ok(())
//! # }
//! ```
//!
//! All methods take `&Bus`, so one thread can receive while others send.

use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::sockopt::{self, Timeout};
use socketcan::CanFdSocket;

use crate::can::{Format, Frame};
use batch::{MAX_BATCH_DATAGRAMS, ReceiveBatch, SMALL_BATCH_SIZE};
use carrier::{BusBackend, OpenedSocket};

pub mod batch;
#[expect(unsafe_code, reason = "recvmmsg and sendmmsg have no safe wrapper")]
mod calls;
mod carrier;
pub mod embedded;
mod error;
mod filter;
mod inbox;
mod kernel;
mod kinds;
mod link;
pub mod netlink;
mod slot;

pub use error::{BusError, SendError};
pub use filter::Filter;
pub use inbox::{Inbox, ReceivedFrame};
pub use kernel::{GATEWAY_RECEIVE_BUFFER_BYTES, has_socketcan, set_batch_scheduling, set_receive_buffer};
pub use kinds::{BusKind, KindChoice, KindChoices, KindOption, KindsError, UnknownKind};

/// Options for opening a bus.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct BusOptions {
    /// Filters for received frames, at most [`Filter::MAX_COUNT`]. Without filters the socket receives nothing, which
    /// suits a program that only sends.
    pub filters: Vec<Filter>,
    /// True to receive the frames that this socket sends, marked as own.
    pub own_frames: bool,
    /// True to send and receive CAN FD frames; a kernel interface must then have an MTU of 72.
    pub fd: bool,
    /// Error frames to receive, as a mask of the bits in `linux/can/error.h`.
    pub error_mask: u32,
    /// Size of the receive buffer in bytes as the kernel counts it: about 1 KiB per frame.
    pub receive_buffer: usize,
    /// Maximum time that [`Bus::send`] waits for room in the transmit queue.
    pub send_timeout: Duration,
    /// The directory of embedded buses; `None` for [`embedded::default_directory`].
    pub directory: Option<PathBuf>,
}

impl Default for BusOptions {
    /// Returns options to receive all data frames, classic and FD, except those that this socket sends. The receive
    /// buffer holds four answers from each of 254 cells.
    fn default() -> Self {
        Self {
            filters: vec![Filter::ALL],
            own_frames: false,
            fd: true,
            error_mask: 0,
            receive_buffer: 4 * 254 * 1024,
            send_timeout: Duration::from_millis(100),
            directory: None,
        }
    }
}

/// An open bus.
#[derive(Debug)]
pub struct Bus {
    name: String,
    kind: BusKind,
    socket: CanFdSocket,
    receive_buffer: usize,
    is_timed: bool,
    fd: bool,
    send_timeout: Duration,
    /// The directory of embedded buses, as in [`BusOptions`].
    directory: Option<PathBuf>,
    /// Set when a send fails because the interface is down. The next receive reports it, because the kernel
    /// reports it to a socket only once.
    down: AtomicBool,
    /// Set when an error followed the frames of the last receive. The next receive returns it.
    failed: AtomicBool,
    /// The socket's `SO_RCVTIMEO` in ms; 0 before it is set.
    receive_timeout: AtomicU32,
    /// Set when the last wait with `SO_RCVTIMEO` ended without a frame.
    expired: AtomicBool,
}

impl Bus {
    /// The timeouts that [`Bus::wait_and_receive`] sets as `SO_RCVTIMEO`.
    const SOCKET_TIMEOUTS: [Duration; 2] = [Duration::from_millis(25), Duration::from_millis(100)];

    /// Opens a bus. The filters are active when this function returns.
    ///
    /// # Errors
    /// Returns an error, with a hint for the user, if the bus does not exist, is not accessible, or does not support
    /// the options.
    pub fn open(name: &str, choice: KindChoice, options: &BusOptions) -> Result<Self, BusError> {
        check_name(name)?;
        check_filter_count(name, &options.filters)?;
        let kind = choice.resolve(name);
        let OpenedSocket { socket, receive_buffer, is_timed } =
            match (kind.backend().open(name, options), choice) {
                (Err(BusError::NotServed { name, directory }), KindChoice::Auto) => {
                    return Err(BusError::Absent { name, directory });
                }
                (opened, _) => opened?,
            };
        let BusOptions { fd, send_timeout, .. } = *options;
        Ok(Self {
            name: name.to_owned(),
            kind,
            socket,
            receive_buffer,
            is_timed,
            fd,
            send_timeout,
            directory: options.directory.clone(),
            down: AtomicBool::new(false),
            failed: AtomicBool::new(false),
            receive_timeout: AtomicU32::new(0),
            expired: AtomicBool::new(false),
        })
    }

    /// Returns the name that the bus was opened with.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the kind of the bus.
    #[must_use]
    pub const fn kind(&self) -> BusKind {
        self.kind
    }

    /// Returns true if the bus was opened for CAN FD frames.
    #[must_use]
    pub const fn carries_fd(&self) -> bool {
        self.fd
    }

    /// Returns true if frames take time on the bus as on a real one, so that their time stamps are their ends.
    #[must_use]
    pub const fn is_timed(&self) -> bool {
        self.is_timed
    }

    /// Returns the bus, unless frames take time on it.
    ///
    /// # Errors
    /// Returns [`BusError::TakesTime`] if they do.
    pub fn without_time(self) -> Result<Self, BusError> {
        if self.is_timed { Err(BusError::TakesTime(self.name)) } else { Ok(self) }
    }

    /// Returns true if the bus has no hardware: an embedded bus, a vcan or a vxcan.
    ///
    /// # Errors
    /// Returns an error if the kernel does not report the type of the interface.
    pub fn is_virtual(&self) -> Result<bool, BusError> {
        self.backend().is_virtual(&self.name).map_err(|error| self.io_error("query", error))
    }

    const fn backend(&self) -> &'static dyn BusBackend {
        self.kind.backend()
    }

    /// Returns the size of the receive buffer in bytes, as granted and counted by the kernel: twice the
    /// requested size if it was granted in full.
    #[must_use]
    pub const fn receive_buffer_bytes(&self) -> usize {
        self.receive_buffer
    }

    /// Waits until [`Bus::receive`] has a frame or an error to return; `None` waits without limit. Returns false after
    /// the timeout or a signal.
    ///
    /// # Errors
    /// Returns an error if the system call fails.
    pub fn wait(&self, timeout: Option<Duration>) -> Result<bool, BusError> {
        if self.has_error() {
            return Ok(true);
        }
        self.poll(PollFlags::IN, timeout).map_err(|errno| self.bus_error("wait for", errno))
    }

    /// Waits until [`Bus::receive`] has a frame or an error to return, on this bus or on `other`. Returns false after
    /// the timeout or a signal.
    ///
    /// # Errors
    /// Returns an error if the system call fails.
    pub fn wait_for_either(&self, other: &Self, timeout: Duration) -> Result<bool, BusError> {
        if self.has_error() || other.has_error() {
            return Ok(true);
        }
        let mut both = [self, other].map(|bus| PollFd::new(&bus.socket, PollFlags::IN));
        poll_descriptors(&mut both, Some(timeout)).map_err(|errno| self.bus_error("wait for", errno))
    }

    /// Returns true if the next receive will report a stored error.
    fn has_error(&self) -> bool {
        self.down.load(Ordering::Relaxed) || self.failed.load(Ordering::Relaxed)
    }

    /// Receives up to 64 frames into `inbox`, replacing its contents. Returns the number of frames: 0 if nothing has
    /// arrived. Never allocates, and does not wait for frames. If the system lacks memory, retries for up to 0.1 s.
    ///
    /// # Errors
    /// Returns [`BusError::Down`] or [`BusError::Gone`] for a kernel interface, [`BusError::Closed`] or
    /// [`BusError::HungUp`] for an embedded bus. Frames that arrived before the error are returned first; the error
    /// follows with the next call.
    pub fn receive(&self, inbox: &mut Inbox) -> Result<usize, BusError> {
        self.receive_with(inbox, |batch, socket| batch.receive(socket))
    }

    /// Like [`Bus::receive`], but waits up to `timeout` for the first frame; may return early without one. With a
    /// timeout of 25 ms or more, this takes one system call instead of two, and returns at most one frame. It suits a
    /// receiver that wakes up for each frame.
    ///
    /// # Errors
    /// Returns the errors of [`Bus::wait`] and [`Bus::receive`].
    pub fn wait_and_receive(&self, inbox: &mut Inbox, timeout: Duration) -> Result<usize, BusError> {
        let Some(wait) = Self::SOCKET_TIMEOUTS.into_iter().rfind(|&wait| wait <= timeout) else {
            inbox.clear();
            let comes = timeout.is_zero() || self.wait(Some(timeout))?;
            return if comes { self.receive(inbox) } else { Ok(0) };
        };
        let millis = u32::try_from(wait.as_millis()).unwrap_or(u32::MAX);
        // Setting the timeout is a system call. Most waits end with a frame, so a shorter timeout is kept
        // until it expires.
        let set = self.receive_timeout.load(Ordering::Relaxed);
        let is_kept = set == millis || (0 < set && set < millis && !self.expired.load(Ordering::Relaxed));
        if !is_kept {
            sockopt::set_socket_timeout(&self.socket, Timeout::Recv, Some(wait))
                .map_err(|errno| self.bus_error("set the timeout of", errno))?;
            self.receive_timeout.store(millis, Ordering::Relaxed);
        }
        let count = self.receive_with(inbox, |batch, socket| batch.receive_one(socket))?;
        self.expired.store(count == 0, Ordering::Relaxed);
        Ok(count)
    }

    fn receive_with(
        &self,
        inbox: &mut Inbox,
        receive: impl Fn(&mut ReceiveBatch, &CanFdSocket) -> io::Result<usize>,
    ) -> Result<usize, BusError> {
        inbox.clear();
        if self.down.swap(false, Ordering::Relaxed) {
            return Err(BusError::Down(self.name.clone()));
        }
        self.failed.store(false, Ordering::Relaxed);
        let mut give_up = None;
        loop {
            let received = inbox.failure.take().map_or_else(|| receive(&mut inbox.batch, &self.socket), Err);
            match received {
                Ok(_) => break,
                // The server ended with unread frames of ours. Its own frames can still be received.
                Err(error) if is_errno(&error, Errno::CONNRESET) => {}
                Err(error) if is_errno(&error, Errno::AGAIN) || is_errno(&error, Errno::INTR) => {
                    return Ok(0);
                }
                Err(error)
                    if batch::is_memory_shortage(&error)
                        && is_before_deadline(&mut give_up, OUT_OF_MEMORY_TIMEOUT) =>
                {
                    std::thread::sleep(RETRY_INTERVAL);
                }
                Err(error) => return Err(self.io_error("receive from", error)),
            }
        }
        inbox.failure = inbox.batch.take_failure();
        self.failed.store(inbox.failure.is_some(), Ordering::Relaxed);
        let over = inbox.decode(self.backend());
        match inbox.frames().len() {
            0 if over => Err(self.closed_error()),
            count => Ok(count),
        }
    }

    /// Sends frames in order. If the transmit queue is full, waits for room, at most [`BusOptions::send_timeout`] after
    /// the last accepted frame. Never allocates except on failure.
    ///
    /// # Errors
    /// Returns the cause and the number of frames that were sent before the failure.
    pub fn send(&self, frames: &[Frame]) -> Result<(), SendError> {
        if !self.accepts_formats(frames) {
            let cause = BusError::FdFrame(self.name.clone());
            return Err(SendError { sent: 0, total: frames.len(), cause });
        }
        self.send_items(frames.len(), |sent| self.send_batch(frames.get(sent..).unwrap_or_default()))
    }

    /// Returns true if the bus was opened for the formats of all these frames: FD frames need [`BusOptions::fd`].
    fn accepts_formats(&self, frames: &[Frame]) -> bool {
        self.fd || frames.iter().all(|frame| frame.format() == Format::Classic)
    }

    /// Sends `target` items, and waits for room whenever the socket accepts no more. `some` sends the items from the
    /// given index on and returns the number that the socket accepted.
    fn send_items(&self, target: usize, some: impl Fn(usize) -> io::Result<usize>) -> Result<(), SendError> {
        let (mut sent, mut give_up) = (0, None);
        while sent < target {
            let waited = match some(sent) {
                Ok(count) => {
                    sent += count;
                    give_up = None;
                    continue;
                }
                Err(error) if is_errno(&error, Errno::INTR) => continue,
                Err(error) => self.wait_for_room(error, &mut give_up),
            };
            waited.map_err(|cause| SendError { sent, total: target, cause })?;
        }
        Ok(())
    }

    /// Waits for room if `error` means that the transmit queue is full. Returns an error after the send timeout, or for
    /// any other `error`.
    fn wait_for_room(&self, error: io::Error, give_up: &mut Option<Instant>) -> Result<(), BusError> {
        // The transmit queue of the interface is full, or there is no memory for the frame.
        let interface = batch::is_memory_shortage(&error);
        if !interface && !is_errno(&error, Errno::AGAIN) {
            return Err(self.io_error("send to", error));
        }
        let now = Instant::now();
        let left = give_up.get_or_insert(now + self.send_timeout).saturating_duration_since(now);
        if left.is_zero() {
            return Err(BusError::Full { name: self.name.clone(), waited: self.send_timeout });
        }
        let waited = if interface {
            // The queue is shared and nothing signals room in it, so retry soon.
            poll_descriptors(&mut [], Some(left.min(RETRY_INTERVAL)))
        } else {
            self.poll(PollFlags::OUT, Some(left))
        };
        waited.map(|_| ()).map_err(|errno| self.bus_error("wait for", errno))
    }

    /// Sends at most 64 frames if the bus accepts all of them at once, and returns true if it did. Never waits or
    /// allocates, and does not report the cause of a failure: for a loop with its own deadline. If the interface is
    /// down, the next [`Bus::receive`] returns the error.
    #[must_use]
    pub fn try_send_all(&self, frames: &[Frame]) -> bool {
        if !self.accepts_formats(frames) {
            return false;
        }
        let sent = self.send_batch(frames);
        if sent.as_ref().is_err_and(|error| is_errno(error, Errno::NETDOWN)) {
            self.down.store(true, Ordering::Relaxed);
        }
        sent.is_ok_and(|sent| sent == frames.len())
    }

    /// Replaces the receive filters, at most [`Filter::MAX_COUNT`]. Frames that already wait in the receive buffer stay
    /// there. Only one thread may call this at a time.
    ///
    /// # Errors
    /// Returns an error if there are too many filters, or the bus does not accept them.
    pub fn set_filters(&self, filters: &[Filter]) -> Result<(), BusError> {
        check_filter_count(&self.name, filters)?;
        self.backend().set_filters(self, filters)
    }

    fn send_batch(&self, frames: &[Frame]) -> io::Result<usize> {
        match frames {
            [frame] => {
                let (bytes, len) = (frame.to_bytes(), frame.byte_len());
                batch::send_one(&self.socket, bytes.get(..len).unwrap_or(&bytes))
            }
            few if few.len() <= SMALL_BATCH_SIZE => self.send_up_to::<SMALL_BATCH_SIZE>(few),
            many => self.send_up_to::<MAX_BATCH_DATAGRAMS>(many),
        }
    }

    // Not inlined, because its stack frame depends on N.
    #[inline(never)]
    fn send_up_to<const N: usize>(&self, frames: &[Frame]) -> io::Result<usize> {
        let mut outgoing = batch::Outgoing::<N>::new();
        for frame in frames {
            if !outgoing.push(&frame.to_bytes(), frame.byte_len()) {
                break;
            }
        }
        outgoing.send(&self.socket)
    }

    fn poll(&self, what: PollFlags, timeout: Option<Duration>) -> Result<bool, Errno> {
        poll_descriptors(&mut [PollFd::new(&self.socket, what)], timeout)
    }

    /// Returns the error for a connection to an embedded bus that has ended.
    fn closed_error(&self) -> BusError {
        embedded::closed_error(&self.name, self.directory.as_deref())
    }

    fn bus_error(&self, doing: &'static str, errno: Errno) -> BusError {
        self.io_error(doing, errno.into())
    }

    fn io_error(&self, doing: &'static str, source: io::Error) -> BusError {
        let name = self.name.clone();
        let cause = Errno::from_io_error(&source).and_then(|errno| self.backend().bus_error(errno));
        let Some(cause) = cause else { return BusError::Io { name, doing, source } };
        let error = cause(name);
        if matches!(error, BusError::Closed(_)) { self.closed_error() } else { error }
    }
}

impl AsFd for Bus {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// Retry interval while a transmit queue is full: the duration of a few frames at 1 Mbit/s.
const RETRY_INTERVAL: Duration = Duration::from_micros(500);
/// Maximum time for which a call is retried when the system lacks memory.
const OUT_OF_MEMORY_TIMEOUT: Duration = Duration::from_millis(100);

fn poll_descriptors(what: &mut [PollFd<'_>], timeout: Option<Duration>) -> Result<bool, Errno> {
    let timeout = timeout.and_then(|timeout| Timespec::try_from(timeout).ok());
    match poll(what, timeout.as_ref()) {
        Ok(ready) => Ok(ready > 0),
        Err(Errno::INTR) => Ok(false),
        Err(Errno::NOMEM | Errno::AGAIN) => {
            std::thread::sleep(RETRY_INTERVAL);
            Ok(false)
        }
        Err(errno) => Err(errno),
    }
}

/// Returns true before a deadline. The first call sets the deadline to `after` from now.
fn is_before_deadline(give_up: &mut Option<Instant>, after: Duration) -> bool {
    let now = Instant::now();
    now < *give_up.get_or_insert(now + after)
}

fn is_errno(error: &io::Error, errno: Errno) -> bool {
    error.raw_os_error() == Some(errno.raw_os_error())
}

fn check_filter_count(name: &str, filters: &[Filter]) -> Result<(), BusError> {
    let got = filters.len();
    if got <= Filter::MAX_COUNT { Ok(()) } else { Err(BusError::Filters { name: name.to_owned(), got }) }
}

/// Checks that a name is valid for a bus. The rule is that of network interfaces, so that the same bench runs on either
/// kind of bus.
///
/// # Errors
/// Returns an error if the name is invalid.
pub fn check_name(name: &str) -> Result<(), BusError> {
    let fits = (1..=15).contains(&name.len()) && name != "." && name != "..";
    let bad = |c: char| c == '/' || c == ':' || c.is_whitespace() || c.is_control();
    if fits && !name.contains(bad) { Ok(()) } else { Err(BusError::Name(name.to_owned())) }
}

/// Returns true if a name is valid for every kernel interface and needs no quotes in a shell: 1 to 15 ASCII
/// letters, digits, `-`, `_` and `.`.
#[must_use]
pub fn is_plain_name(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    (1..=15).contains(&name.len()) && name.chars().all(plain)
}

#[cfg(test)]
mod tests;
