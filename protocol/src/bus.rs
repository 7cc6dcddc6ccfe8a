//! Opening a bus: SocketCAN or the embedded bus, behind one type.
//!
//! ```no_run
//! use protocol::bus::{Bus, Choice, Filter, Inbox, Options};
//! use protocol::can::Frame;
//! use protocol::id::{Command, Id};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let options = Options { filters: vec![Filter::exact(Id::command(Command::Joints))], ..Options::default() };
//! let bus = Bus::open("vcan0", Choice::Auto, &options)?;
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
//! All of it works on `&Bus`, so one thread may receive while others send.

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
use batch::{BATCH, Batch, SMALL};
use carrier::Carrier;

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
pub use inbox::{Inbox, Received};
pub use kernel::{GATEWAY_RECEIVE_BUFFER, has_socketcan, set_receive_buffer};
pub use kinds::{BusKind, Choice, Kinds, KindsError, OneKind, UnknownKind};

/// How a bus is opened.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Options {
    /// What to receive; nothing at all when empty, as a sender wants it. At most [`Filter::MAX`].
    pub filters: Vec<Filter>,
    /// Whether to receive, marked as own, what this socket itself sends.
    pub own_frames: bool,
    /// Whether CAN FD frames are sent and received; an interface must then have MTU 72.
    pub fd: bool,
    /// Which error frames to receive, as the bits of `linux/can/error.h`.
    pub error_mask: u32,
    /// Bytes that may wait unread, as the kernel counts them: about 1 KiB a frame.
    pub receive_buffer: usize,
    /// How long [`Bus::send`] waits for room before it gives up.
    pub send_timeout: Duration,
    /// Where embedded buses live; `None` is [`embedded::usual_directory`].
    pub directory: Option<PathBuf>,
}

impl Default for Options {
    /// Every data frame, classic and FD, no own ones, room for four answers of each of 254 cells.
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

/// From now on this thread, and what it starts, takes no processor from another that is at work when it is woken
/// (`SCHED_BATCH`); whether the system granted it.
///
/// For those of a bench that wake each other by hundreds: cells, and who serves their bus. A bus that is interrupted by
/// each cell that it hands a frame to switches between processes once for every frame.
pub fn never_interrupt() -> bool {
    calls::set_batch()
}

/// An open bus.
#[derive(Debug)]
pub struct Bus {
    name: String,
    kind: BusKind,
    socket: CanFdSocket,
    receive_buffer: usize,
    fd: bool,
    send_timeout: Duration,
    /// Where an embedded bus lives, as in [`Options`].
    directory: Option<PathBuf>,
    /// A send failed because the interface is down, and the next receive will report it: the kernel reports to a
    /// socket once.
    down: AtomicBool,
    /// The next receive returns an error that came behind the frames of the last one.
    failed: AtomicBool,
    /// The socket's `SO_RCVTIMEO`, in ms; 0 before it is set.
    receive_timeout: AtomicU32,
    /// The last wait that used it ended without a frame.
    expired: AtomicBool,
}

impl Bus {
    /// How long [`Bus::wait_and_receive`] waits with the socket's own timeout.
    const WAITS: [Duration; 2] = [Duration::from_millis(25), Duration::from_millis(100)];

    /// Opens a bus. When this returns, the filters are set.
    ///
    /// # Errors
    /// When the bus cannot be used as requested; the error has a hint.
    pub fn open(name: &str, choice: Choice, options: &Options) -> Result<Self, BusError> {
        check_name(name)?;
        check_count(name, &options.filters)?;
        let kind = choice.resolve(name);
        let (socket, receive_buffer) = match (kind.carrier().open(name, options), choice) {
            (Err(BusError::NotServed { name, directory }), Choice::Auto) => {
                return Err(BusError::Absent { name, directory });
            }
            (opened, _) => opened?,
        };
        let Options { fd, send_timeout, .. } = *options;
        Ok(Self {
            name: name.to_owned(),
            kind,
            socket,
            receive_buffer,
            fd,
            send_timeout,
            directory: options.directory.clone(),
            down: AtomicBool::new(false),
            failed: AtomicBool::new(false),
            receive_timeout: AtomicU32::new(0),
            expired: AtomicBool::new(false),
        })
    }

    /// The name under which it was opened.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What carries the frames.
    #[must_use]
    pub const fn kind(&self) -> BusKind {
        self.kind
    }

    /// Whether it was opened for CAN FD frames.
    #[must_use]
    pub const fn carries_fd(&self) -> bool {
        self.fd
    }

    /// Whether nothing real hangs on this bus: the embedded one, a vcan or a vxcan.
    ///
    /// # Errors
    /// When the kernel does not report it.
    pub fn is_virtual(&self) -> Result<bool, BusError> {
        self.carrier().is_virtual(&self.name).map_err(|error| self.io_error("look at", error))
    }

    const fn carrier(&self) -> &'static dyn Carrier {
        self.kind.carrier()
    }

    /// How many bytes may wait unread, as the kernel granted and counts them (twice what was requested when
    /// all was granted).
    #[must_use]
    pub const fn receive_buffer(&self) -> usize {
        self.receive_buffer
    }

    /// Waits until there is something to receive; `None` waits without end. `false` when the time is over
    /// or a signal came.
    ///
    /// # Errors
    /// When the system cannot wait.
    pub fn wait(&self, timeout: Option<Duration>) -> Result<bool, BusError> {
        if self.has_error() {
            return Ok(true);
        }
        self.poll(PollFlags::IN, timeout).map_err(|errno| self.error("wait for", errno))
    }

    /// Waits until there is something to receive here or on another bus. `false` when the time is over or a signal came.
    ///
    /// # Errors
    /// When the system cannot wait.
    pub fn wait_with(&self, other: &Self, timeout: Duration) -> Result<bool, BusError> {
        if self.has_error() || other.has_error() {
            return Ok(true);
        }
        let mut both = [self, other].map(|bus| PollFd::new(&bus.socket, PollFlags::IN));
        wait_on(&mut both, Some(timeout)).map_err(|errno| self.error("wait for", errno))
    }

    /// Returns whether the next receive reports an error that the kernel does not report again.
    fn has_error(&self) -> bool {
        self.down.load(Ordering::Relaxed) || self.failed.load(Ordering::Relaxed)
    }

    /// Receives what has come, at most 64 frames, and forgets what was in `inbox`; how many frames there
    /// are now. Never waits and never allocates, unless the system lacks memory for so long as 0.1 s. 0 when nothing
    /// has come.
    ///
    /// # Errors
    /// [`BusError::Down`] and [`BusError::Gone`] for an interface, [`BusError::Closed`] or [`BusError::HungUp`] for an
    /// embedded bus; frames that came before are received first.
    pub fn receive(&self, inbox: &mut Inbox) -> Result<usize, BusError> {
        self.take(inbox, |batch, socket| batch.receive(socket))
    }

    /// The same, but waits up to `timeout` for the first frame; it may return earlier without any. One system call
    /// instead of two, which then takes one frame, when the time is 25 ms or more: for a receiver that has nothing else
    /// to do and is woken for each frame.
    ///
    /// # Errors
    /// As [`Bus::wait`] and [`Bus::receive`].
    pub fn wait_and_receive(&self, inbox: &mut Inbox, timeout: Duration) -> Result<usize, BusError> {
        let Some(wait) = Self::WAITS.into_iter().rfind(|&wait| wait <= timeout) else {
            inbox.clear();
            let comes = timeout.is_zero() || self.wait(Some(timeout))?;
            return if comes { self.receive(inbox) } else { Ok(0) };
        };
        let millis = u32::try_from(wait.as_millis()).unwrap_or(u32::MAX);
        // Setting it is a system call. Most waits end with a frame before, so a shorter one is kept until it ran out.
        let set = self.receive_timeout.load(Ordering::Relaxed);
        let is_kept = set == millis || (0 < set && set < millis && !self.expired.load(Ordering::Relaxed));
        if !is_kept {
            sockopt::set_socket_timeout(&self.socket, Timeout::Recv, Some(wait))
                .map_err(|errno| self.error("set the timeout of", errno))?;
            self.receive_timeout.store(millis, Ordering::Relaxed);
        }
        let count = self.take(inbox, |batch, socket| batch.receive_one_patiently(socket))?;
        self.expired.store(count == 0, Ordering::Relaxed);
        Ok(count)
    }

    fn take(
        &self,
        inbox: &mut Inbox,
        receive: impl Fn(&mut Batch, &CanFdSocket) -> io::Result<usize>,
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
                // The server ended with frames of ours unread: what it had sent can still be read.
                Err(error) if is(&error, Errno::CONNRESET) => {}
                Err(error) if is(&error, Errno::AGAIN) || is(&error, Errno::INTR) => return Ok(0),
                Err(error) if batch::is_shortage(&error) && is_before(&mut give_up, SHORTAGE) => {
                    std::thread::sleep(RECHECK);
                }
                Err(error) => return Err(self.io_error("receive from", error)),
            }
        }
        inbox.failure = inbox.batch.take_failure();
        self.failed.store(inbox.failure.is_some(), Ordering::Relaxed);
        let over = inbox.take(self.carrier());
        match inbox.frames().len() {
            0 if over => Err(self.closed()),
            count => Ok(count),
        }
    }

    /// Sends frames, in order. When the bus takes no more, waits for room, as long as
    /// [`Options::send_timeout`] says since the last frame was taken. Never allocates unless it fails.
    ///
    /// # Errors
    /// The reason, and how many were sent before it.
    pub fn send(&self, frames: &[Frame]) -> Result<(), SendError> {
        if !self.carries(frames) {
            let cause = BusError::FdFrame(self.name.clone());
            return Err(SendError { sent: 0, target: frames.len(), cause });
        }
        self.patiently(frames.len(), |sent| self.send_some(frames.get(sent..).unwrap_or_default()))
    }

    /// Whether it was opened for frames like these.
    fn carries(&self, frames: &[Frame]) -> bool {
        self.fd || frames.iter().all(|frame| frame.format() == Format::Classic)
    }

    /// Has everything sent, waiting for room in between; `some` sends from so many on, and returns how many.
    fn patiently(&self, target: usize, some: impl Fn(usize) -> io::Result<usize>) -> Result<(), SendError> {
        let (mut sent, mut give_up) = (0, None);
        while sent < target {
            let waited = match some(sent) {
                Ok(count) => {
                    sent += count;
                    give_up = None;
                    continue;
                }
                Err(error) if is(&error, Errno::INTR) => continue,
                Err(error) => self.wait_for_room(error, &mut give_up),
            };
            waited.map_err(|cause| SendError { sent, target, cause })?;
        }
        Ok(())
    }

    /// Waits for room, if that is what was missing, until it is time to give up.
    fn wait_for_room(&self, error: io::Error, give_up: &mut Option<Instant>) -> Result<(), BusError> {
        // A full queue of an interface, or no memory for the frame.
        let interface = batch::is_shortage(&error);
        if !interface && !is(&error, Errno::AGAIN) {
            return Err(self.io_error("send to", error));
        }
        let now = Instant::now();
        let left = give_up.get_or_insert(now + self.send_timeout).saturating_duration_since(now);
        if left.is_zero() {
            return Err(BusError::Full { name: self.name.clone(), waited: self.send_timeout });
        }
        let waited = if interface {
            // Its queue is shared and nothing signals when it has room, so look again soon.
            wait_on(&mut [], Some(left.min(RECHECK)))
        } else {
            self.poll(PollFlags::OUT, Some(left))
        };
        waited.map(|_| ()).map_err(|errno| self.error("wait for", errno))
    }

    /// Sends frames, at most 64, if the bus takes them all at once, and returns whether it did. Never waits,
    /// never allocates, and returns no reason: for a loop that has its own deadline. That the interface is
    /// down is reported by the next [`Bus::receive`].
    #[must_use]
    pub fn offer(&self, frames: &[Frame]) -> bool {
        if !self.carries(frames) {
            return false;
        }
        let sent = self.send_some(frames);
        if sent.as_ref().is_err_and(|error| is(error, Errno::NETDOWN)) {
            self.down.store(true, Ordering::Relaxed);
        }
        sent.is_ok_and(|sent| sent == frames.len())
    }

    /// Receives what passes these filters from now on, at most [`Filter::MAX`], in place of what was requested
    /// before. What was sent on the bus before by this socket, or has come to it already, is not touched. For one
    /// thread at a time.
    ///
    /// # Errors
    /// When there are too many, or the bus does not take them.
    pub fn set_filters(&self, filters: &[Filter]) -> Result<(), BusError> {
        check_count(&self.name, filters)?;
        self.carrier().set_filters(self, filters)
    }

    fn send_some(&self, frames: &[Frame]) -> io::Result<usize> {
        match frames {
            [frame] => {
                let (bytes, len) = (frame.to_bytes(), frame.byte_len());
                batch::send_one(&self.socket, bytes.get(..len).unwrap_or(&bytes))
            }
            few if few.len() <= SMALL => self.send_up_to::<SMALL>(few),
            many => self.send_up_to::<BATCH>(many),
        }
    }

    // Not inlined: its stack depends on N.
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
        wait_on(&mut [PollFd::new(&self.socket, what)], timeout)
    }

    /// The error for the end of the connection to an embedded bus.
    fn closed(&self) -> BusError {
        embedded::closed(&self.name, self.directory.as_deref())
    }

    fn error(&self, doing: &'static str, errno: Errno) -> BusError {
        self.io_error(doing, errno.into())
    }

    fn io_error(&self, doing: &'static str, source: io::Error) -> BusError {
        let name = self.name.clone();
        let cause = Errno::from_io_error(&source).and_then(|errno| self.carrier().cause(errno));
        let Some(cause) = cause else { return BusError::Io { name, doing, source } };
        let error = cause(name);
        if matches!(error, BusError::Closed(_)) { self.closed() } else { error }
    }
}

impl AsFd for Bus {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// How long a full transmit queue is left alone: a few frames at 1 Mbit/s.
const RECHECK: Duration = Duration::from_micros(500);
/// Time for which the system may lack the memory to receive before that is an error.
const SHORTAGE: Duration = Duration::from_millis(100);

fn wait_on(what: &mut [PollFd<'_>], timeout: Option<Duration>) -> Result<bool, Errno> {
    let timeout = timeout.and_then(|timeout| Timespec::try_from(timeout).ok());
    match poll(what, timeout.as_ref()) {
        Ok(ready) => Ok(ready > 0),
        Err(Errno::INTR) => Ok(false),
        Err(Errno::NOMEM | Errno::AGAIN) => {
            std::thread::sleep(RECHECK);
            Ok(false)
        }
        Err(errno) => Err(errno),
    }
}

/// Returns whether it is before the time to give up, which the first call sets.
fn is_before(give_up: &mut Option<Instant>, after: Duration) -> bool {
    let now = Instant::now();
    now < *give_up.get_or_insert(now + after)
}

fn is(error: &io::Error, errno: Errno) -> bool {
    error.raw_os_error() == Some(errno.raw_os_error())
}

fn check_count(name: &str, filters: &[Filter]) -> Result<(), BusError> {
    let got = filters.len();
    if got <= Filter::MAX { Ok(()) } else { Err(BusError::Filters { name: name.to_owned(), got }) }
}

/// Sees that a bus can have this name: the rule of interfaces, so that a bench runs on either kind.
///
/// # Errors
/// When it cannot.
pub fn check_name(name: &str) -> Result<(), BusError> {
    let fits = (1..=15).contains(&name.len()) && name != "." && name != "..";
    let bad = |c: char| c == '/' || c == ':' || c.is_whitespace() || c.is_control();
    if fits && !name.contains(bad) { Ok(()) } else { Err(BusError::Name(name.to_owned())) }
}

/// Whether a name has 1 to 15 characters that the kernel takes in every interface's name, and a shell as they are:
/// ASCII letters and digits, `-`, `_` and `.`.
#[must_use]
pub fn is_plain(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    (1..=15).contains(&name.len()) && name.chars().all(plain)
}

#[cfg(test)]
mod tests;
