//! The embedded bus as a client sees it: where it lives, and what is said beside frames.
//!
//! A frame is a datagram of 16 or 72 bytes, exactly the kernel's struct; anything else is control, and no
//! control datagram has either length. Numbers are little endian.
//!
//! ```text
//!   hello    client -> bus, first     "skinbus", version, own 0/1, fd 0/1, error mask u32, buffer u64,
//!                                     reserved u8, then id u32 and mask u32 per filter: 23 + 8n bytes
//!   answer   bus -> client, first     "skinbus", version, 0 welcome / 1 refused, granted buffer u64: 17 bytes
//!   filters  client -> bus, later     "F", 1 first part + 2 last part, then id u32 and mask u32 per filter, at most
//!                                     8: 2 + 8n bytes
//!   dropped  bus -> client, later     "D", frames dropped so far u32: 5 bytes
//! ```
//!
//! After a welcome the filters are in force. A client changes them by *filters*, in one part or several; with the last
//! part they are in force for what the bus takes from then on, frames of this client and of others. In a frame that is given back to its sender, the reserved
//! byte 6 is 1; the bus clears that byte in every other frame.

use std::fs::DirBuilder;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::net::{AddressFamily, RecvFlags, SendFlags, SocketAddrUnix, SocketFlags, SocketType, sockopt};
use socketcan::{CanFdSocket, SocketOptions};
use thiserror::Error;

use super::batch::{self, Datagram};
use super::kinds::Carrier;
use super::{Bus, BusError, Filter, Options};

/// The version of what is said beside frames.
pub const VERSION: u8 = 2;
/// Which byte of a frame marks it as the receiver's own.
pub const OWN_BYTE: usize = 6;
/// The longest hello in bytes.
pub const HELLO_MAX: usize = HELLO_HEAD + 8 * Filter::MAX;

const MAGIC: &[u8; 7] = b"skinbus";
const HELLO_HEAD: usize = 23;
const ANSWER_LEN: usize = 17;
/// How long a client waits for a server: it answers at once unless it is stopped.
const PATIENCE: Duration = Duration::from_secs(2);

/// What a client asks for when it connects.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Hello {
    /// What it wants to receive.
    pub filters: Vec<Filter>,
    /// Whether it wants its own frames back.
    pub own_frames: bool,
    /// Whether it wants CAN FD frames.
    pub fd: bool,
    /// Which error frames it wants.
    pub error_mask: u32,
    /// How many bytes may wait for it.
    pub buffer: u64,
}

impl Hello {
    /// The datagram.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HELLO_HEAD + 8 * self.filters.len());
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&[VERSION, self.own_frames.into(), self.fd.into()]);
        bytes.extend_from_slice(&self.error_mask.to_le_bytes());
        bytes.extend_from_slice(&self.buffer.to_le_bytes());
        bytes.push(0);
        encode_filters(&self.filters, &mut bytes);
        bytes
    }

    /// Reads the datagram; `None` when it is no hello of this version. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (head, filters) = bytes.split_first_chunk::<HELLO_HEAD>()?;
        let rest = head.strip_prefix(MAGIC)?;
        let &[VERSION, own @ 0..=1, fd @ 0..=1, m0, m1, m2, m3, ref rest @ ..] = rest else { return None };
        let (buffer, [0]) = rest.split_first_chunk()? else { return None };
        Some(Self {
            filters: decode_filters(filters).filter(|filters| filters.len() <= Filter::MAX)?,
            own_frames: own == 1,
            fd: fd == 1,
            error_mask: u32::from_le_bytes([m0, m1, m2, m3]),
            buffer: u64::from_le_bytes(*buffer),
        })
    }
}

/// Filters that take the place of those in force: all of them when it is the first and the last part.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct FilterPart {
    /// What came of an unfinished change before is forgotten.
    pub first: bool,
    /// All filters are known.
    pub last: bool,
    /// Some of them.
    pub filters: Vec<Filter>,
}

impl FilterPart {
    const HEAD: u8 = b'F';
    const FIRST: u8 = 1;
    const LAST: u8 = 2;
    /// So many fit into a datagram that is no longer than an FD frame's, which is what a bus reads.
    const FILTERS: usize = 8;

    /// These filters in as many parts as they need.
    pub fn split(filters: &[Filter]) -> impl Iterator<Item = Self> + use<'_> {
        let parts = filters.len().div_ceil(Self::FILTERS).max(1);
        (0..parts).map(move |part| Self {
            first: part == 0,
            last: part == parts - 1,
            filters: filters.iter().skip(part * Self::FILTERS).take(Self::FILTERS).copied().collect(),
        })
    }

    /// The datagram.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let flag = |set, flag| if set { flag } else { 0 };
        let mut bytes = vec![Self::HEAD, flag(self.first, Self::FIRST) | flag(self.last, Self::LAST)];
        encode_filters(&self.filters, &mut bytes);
        bytes
    }

    /// Reads the datagram; `None` when it is none. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[Self::HEAD, flags @ 0..=3, ref rest @ ..] = bytes else { return None };
        let filters = decode_filters(rest).filter(|filters| filters.len() <= Self::FILTERS)?;
        Some(Self { first: flags & Self::FIRST != 0, last: flags & Self::LAST != 0, filters })
    }
}

fn encode_filters(filters: &[Filter], bytes: &mut Vec<u8>) {
    for filter in filters {
        bytes.extend_from_slice(&filter.id.to_le_bytes());
        bytes.extend_from_slice(&filter.mask.to_le_bytes());
    }
}

fn decode_filters(bytes: &[u8]) -> Option<Vec<Filter>> {
    let (filters, []) = bytes.as_chunks::<8>() else { return None };
    let filter = |&[a, b, c, d, e, f, g, h]: &[u8; 8]| Filter {
        id: u32::from_le_bytes([a, b, c, d]),
        mask: u32::from_le_bytes([e, f, g, h]),
    };
    Some(filters.iter().map(filter).collect())
}

/// What the bus says to a hello.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Answer {
    /// The filters are in force.
    Welcome {
        /// How many bytes may wait for this client, as the kernel counts them.
        granted: u64,
    },
    /// The hello was not understood.
    Refused {
        /// The version that the bus speaks.
        version: u8,
    },
}

impl Answer {
    /// The datagram.
    #[must_use]
    pub fn encode(self) -> [u8; ANSWER_LEN] {
        let (code, version, granted) = match self {
            Self::Welcome { granted } => (0, VERSION, granted),
            Self::Refused { version } => (1, version, 0),
        };
        let mut bytes = [0; ANSWER_LEN];
        let (magic, rest) = bytes.split_at_mut(MAGIC.len());
        let (head, value) = rest.split_at_mut(2);
        magic.copy_from_slice(MAGIC);
        head.copy_from_slice(&[version, code]);
        value.copy_from_slice(&granted.to_le_bytes());
        bytes
    }

    /// Reads the datagram; `None` when it is no answer. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[version, code, ref value @ ..] = bytes.strip_prefix(MAGIC)? else { return None };
        let granted = u64::from_le_bytes(value.try_into().ok()?);
        match (version, code) {
            (VERSION, 0) => Some(Self::Welcome { granted }),
            (version, 1) => Some(Self::Refused { version }),
            _ => None,
        }
    }
}

/// The notice of how many frames were dropped so far.
#[must_use]
pub const fn encode_dropped(total: u32) -> [u8; 5] {
    let [a, b, c, d] = total.to_le_bytes();
    [b'D', a, b, c, d]
}

/// Reads that notice.
#[must_use]
pub const fn decode_dropped(bytes: &[u8]) -> Option<u32> {
    match *bytes {
        [b'D', a, b, c, d] => Some(u32::from_le_bytes([a, b, c, d])),
        _ => None,
    }
}

/// Where embedded buses live unless told otherwise: `$SKINBUS_DIR`, else `$XDG_RUNTIME_DIR/skinbus`, else
/// `/tmp/skinbus-<user>`.
#[must_use]
pub fn usual_directory() -> PathBuf {
    let set = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    set("SKINBUS_DIR")
        .or_else(|| set("XDG_RUNTIME_DIR").map(|path| path.join("skinbus")))
        .unwrap_or_else(|| PathBuf::from(format!("/tmp/skinbus-{}", rustix::process::geteuid().as_raw())))
}

/// The file name of a bus's socket within its directory.
#[must_use]
pub fn socket_name(bus: &str) -> String {
    format!("{bus}.bus")
}

/// The socket's address.
///
/// # Errors
/// When the path is longer than a socket's can be.
pub fn address(directory: &Path, bus: &str) -> Result<SocketAddrUnix, DirectoryError> {
    let path = directory.join(socket_name(bus));
    SocketAddrUnix::new(&path).map_err(|_| DirectoryError::TooLong(path))
}

/// Why a directory is not used for embedded buses.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DirectoryError {
    /// Somebody else's.
    #[error("{} belongs to user {owner}, and this is user {us}: set SKINBUS_DIR to a directory of your own", path.display())]
    Owner {
        /// The directory.
        path: PathBuf,
        /// Whose it is.
        owner: u32,
        /// Who asks.
        us: u32,
    },
    /// Open to others.
    #[error("{} has mode {mode:04o}, and the bus is private: `chmod 700` it, or set SKINBUS_DIR to another directory", path.display())]
    Mode {
        /// The directory.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// No socket can have this path.
    #[error("{} is too long for a socket, whose path has at most 107 bytes: set SKINBUS_DIR to a shorter one", .0.display())]
    TooLong(PathBuf),
    /// It cannot be opened or made; a link is not followed.
    #[error("cannot use {} as the directory of embedded buses: {source}", path.display())]
    Io {
        /// The directory.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

impl DirectoryError {
    /// Whether it is not there at all.
    #[must_use]
    pub fn is_absent(&self) -> bool {
        matches!(self, Self::Io { source, .. } if source.kind() == io::ErrorKind::NotFound)
    }
}

/// Opens the directory and sees that it is ours alone.
///
/// # Errors
/// When it is not there, not a directory (a link is none), somebody else's, or open to others.
pub fn open_directory(path: &Path) -> Result<OwnedFd, DirectoryError> {
    let io = |errno: Errno| DirectoryError::Io { path: path.to_owned(), source: errno.into() };
    let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC | OFlags::RDONLY;
    let directory = rustix::fs::open(path, flags, Mode::empty()).map_err(io)?;
    let stat = rustix::fs::fstat(&directory).map_err(io)?;
    let us = rustix::process::geteuid().as_raw();
    if stat.st_uid != us {
        return Err(DirectoryError::Owner { path: path.to_owned(), owner: stat.st_uid, us });
    }
    let mode = stat.st_mode & 0o7777;
    if mode & 0o077 != 0 {
        return Err(DirectoryError::Mode { path: path.to_owned(), mode });
    }
    Ok(directory)
}

/// Makes the directory (mode 0700) unless it is there, then opens it.
///
/// # Errors
/// As [`open_directory`], or when it cannot be made.
pub fn make_directory(path: &Path) -> Result<OwnedFd, DirectoryError> {
    match DirBuilder::new().mode(0o700).create(path) {
        Ok(()) => open_directory(path),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => open_directory(path),
        Err(source) => Err(DirectoryError::Io { path: path.to_owned(), source }),
    }
}

/// Buses that a process of this user serves.
pub(super) struct Embedded;

impl Carrier for Embedded {
    fn open(&self, name: &str, options: &Options) -> Result<(CanFdSocket, usize), BusError> {
        let failed = |errno: Errno| BusError::refused(name, "connect to", errno);
        let gone = |errno| match errno {
            Errno::PIPE | Errno::CONNRESET => BusError::Closed(name.to_owned()),
            errno => failed(errno),
        };
        let no_answer = || BusError::NoAnswer { name: name.to_owned(), waited: PATIENCE };
        let socket = CanFdSocket::from(connect(name, options)?);
        socket.set_recv_timestamp(true).map_err(|source| BusError::refused(name, "set up", source))?;
        let hello = Hello {
            filters: options.filters.clone(),
            own_frames: options.own_frames,
            fd: options.fd,
            error_mask: options.error_mask,
            buffer: options.receive_buffer as u64,
        };
        rustix::net::send(&socket, &hello.encode(), SendFlags::NOSIGNAL).map_err(gone)?;
        let wait = Timespec::try_from(PATIENCE).unwrap_or_default();
        let mut polled = [PollFd::new(&socket, PollFlags::IN)];
        if rustix::io::retry_on_intr(|| poll(&mut polled, Some(&wait))).map_err(failed)? == 0 {
            return Err(no_answer());
        }
        let mut bytes = [0; 64];
        let (len, _) = rustix::net::recv(&socket, &mut bytes, RecvFlags::DONTWAIT).map_err(gone)?;
        sockopt::set_socket_timeout(&socket, sockopt::Timeout::Send, None).map_err(failed)?;
        match Answer::decode(bytes.get(..len).unwrap_or_default()) {
            Some(Answer::Welcome { granted }) => Ok((socket, usize::try_from(granted).unwrap_or(usize::MAX))),
            Some(Answer::Refused { version }) => {
                Err(BusError::Refused { name: name.to_owned(), ours: VERSION, theirs: version })
            }
            None => Err(BusError::Closed(name.to_owned())),
        }
    }

    fn set_filters(&self, bus: &Bus, filters: &[Filter]) -> Result<(), BusError> {
        let parts: Vec<_> = FilterPart::split(filters).map(|part| part.encode()).collect();
        let send = |sent| parts.get::<usize>(sent).map_or(Ok(0), |part| batch::send_one(&bus.socket, part));
        Ok(bus.patiently(parts.len(), send)?)
    }

    fn is_virtual(&self, _name: &str) -> io::Result<bool> {
        Ok(true)
    }

    fn is_own(&self, frame: Datagram<'_>) -> bool {
        frame.bytes().and_then(|bytes| bytes.get(OWN_BYTE)) == Some(&1)
    }

    fn dropped(&self, notice: &[u8]) -> Option<u32> {
        decode_dropped(notice)
    }

    fn cause(&self, errno: Errno) -> Option<fn(String) -> BusError> {
        matches!(errno, Errno::PIPE | Errno::CONNRESET | Errno::NOTCONN).then_some(BusError::Closed)
    }
}

/// A socket that a server has taken, or that waits among those that it will take; it gives up sending in time.
fn connect(name: &str, options: &Options) -> Result<OwnedFd, BusError> {
    let directory = options.directory.clone().unwrap_or_else(usual_directory);
    let failed = |errno: Errno| BusError::refused(name, "connect to", errno);
    let not_served = || BusError::NotServed { name: name.to_owned(), directory: directory.clone() };
    open_directory(&directory)
        .map_err(|error| if error.is_absent() { not_served() } else { error.into() })?;
    let address = address(&directory, name)?;
    let socket = seqpacket(SocketFlags::empty()).map_err(failed)?;
    // A connection waits while the server's list of new clients is full; the timeout bounds that.
    sockopt::set_socket_timeout(&socket, sockopt::Timeout::Send, Some(PATIENCE)).map_err(failed)?;
    sockopt::set_socket_send_buffer_size(&socket, SEND_BUFFER).map_err(failed)?;
    match rustix::net::connect(&socket, &address) {
        Ok(()) => Ok(socket),
        Err(Errno::NOENT | Errno::CONNREFUSED) => Err(not_served()),
        Err(Errno::AGAIN) => Err(BusError::NoAnswer { name: name.to_owned(), waited: PATIENCE }),
        Err(errno) => Err(failed(errno)),
    }
}

/// A socket as both ends of an embedded bus have it.
///
/// # Errors
/// When the system gives none.
pub fn seqpacket(flags: SocketFlags) -> rustix::io::Result<OwnedFd> {
    rustix::net::socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, flags | SocketFlags::CLOEXEC, None)
}

/// Room for what the server has not read yet: some 700 FD frames, a whole skin's answers in one go.
const SEND_BUFFER: usize = 1 << 18;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::{CLASSIC_BYTES, FD_BYTES};
    use proptest::prelude::*;

    fn any_hello() -> impl Strategy<Value = Hello> {
        let filters = proptest::collection::vec(any::<(u32, u32)>(), 0..20);
        (filters, any::<(bool, bool, u32, u64)>()).prop_map(
            |(filters, (own_frames, fd, error_mask, buffer))| {
                let filters = filters.into_iter().map(|(id, mask)| Filter { id, mask }).collect();
                Hello { filters, own_frames, fd, error_mask, buffer }
            },
        )
    }

    #[test]
    fn the_bytes_of_a_hello() {
        let filter = Filter { id: 0x001, mask: 0xC000_07FF };
        let hello =
            Hello { filters: vec![filter], own_frames: true, fd: true, error_mask: 0x1FF, buffer: 0x10_0000 };
        let expected = b"skinbus\x02\x01\x01\xff\x01\0\0\0\0\x10\0\0\0\0\0\0\x01\0\0\0\xff\x07\0\xc0";
        assert_eq!(hello.encode(), expected);
    }

    #[test]
    fn no_control_datagram_is_as_long_as_a_frame() {
        let lens = (0..=Filter::MAX)
            .map(|count| HELLO_HEAD + 8 * count)
            .chain((0..=Filter::MAX).flat_map(|count| {
                let filters = vec![Filter::ALL; count];
                FilterPart::split(&filters).map(|part| part.encode().len()).collect::<Vec<_>>()
            }))
            .chain([Answer::Refused { version: 1 }.encode().len(), encode_dropped(0).len()]);
        assert!(lens.into_iter().all(|len| len != CLASSIC_BYTES && len != FD_BYTES && len != 0));
    }

    #[test]
    fn a_hello_of_another_version_is_none() {
        let mut bytes =
            Hello { filters: vec![], own_frames: false, fd: true, error_mask: 0, buffer: 0 }.encode();
        bytes[7] = VERSION + 1;
        assert_eq!(Hello::decode(&bytes), None);
    }

    proptest! {
        #[test]
        fn every_hello_comes_back(hello in any_hello()) {
            prop_assert_eq!(Hello::decode(&hello.encode()), Some(hello));
        }

        #[test]
        fn every_change_of_filters_comes_back_in_parts_that_a_bus_can_read(words in proptest::collection::vec(any::<(u32, u32)>(), 0..40)) {
            let filters: Vec<_> = words.into_iter().map(|(id, mask)| Filter { id, mask }).collect();
            let parts: Vec<_> = FilterPart::split(&filters).collect();
            for part in &parts {
                let bytes = part.encode();
                prop_assert!(bytes.len() <= FD_BYTES);
                prop_assert_eq!(FilterPart::decode(&bytes), Some(part.clone()));
            }
            prop_assert!(parts.first().is_some_and(|part| part.first) && parts.last().is_some_and(|part| part.last));
            prop_assert_eq!(parts.iter().filter(|part| part.first || part.last).count(), parts.len().min(2));
            prop_assert_eq!(parts.into_iter().flat_map(|part| part.filters).collect::<Vec<_>>(), filters);
        }

        #[test]
        fn every_answer_comes_back(granted: u64, version: u8, total: u32) {
            for answer in [Answer::Welcome { granted }, Answer::Refused { version }] {
                prop_assert_eq!(Answer::decode(&answer.encode()), Some(answer));
            }
            prop_assert_eq!(decode_dropped(&encode_dropped(total)), Some(total));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            let _ = (Hello::decode(&bytes), FilterPart::decode(&bytes));
            let _ = (Answer::decode(&bytes), decode_dropped(&bytes));
        }
    }
}
