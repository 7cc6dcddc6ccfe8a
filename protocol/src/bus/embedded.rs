//! The client side of the embedded bus: its directory, and the control datagrams that client and server exchange
//! besides frames.
//!
//! docs/reference/embedded-bus.md describes each byte. A frame is a datagram of 16 or 72 bytes, identical to the
//! kernel's struct; no control datagram has either length.

use std::io;
use std::os::fd::{AsFd, OwnedFd};

use socketcan::{CanFdSocket, SocketOptions};

use super::{Filter, calls};
use crate::can::CLASSIC_BYTES;

pub use super::slot::{MAX_FRAME_DATAGRAM_BYTES, STAMP_BYTES};
pub use client::seqpacket_socket;
pub(super) use client::{EmbeddedBackend, closed_error};
pub use directory::{
    DirectoryError, MARKER_FILE, default_directory, make_directory, open_directory, remove_directory,
    socket_address, socket_name, write_marker,
};
pub use figures::{FIGURES_REQUEST, FiguresRequest, MAX_FIGURES_BYTES};

mod client;
mod directory;
mod figures;

/// The newest version of the protocol between client and server, which every hello contains.
pub const HELLO_VERSION: u8 = 3;
/// The oldest version that a server understands. It has no time stamps of the bus.
pub const OLDEST_HELLO_VERSION: u8 = 2;
/// Index of the byte in a frame that is 1 if the receiving client sent the frame itself.
pub const OWN_FRAME_BYTE_INDEX: usize = 6;
/// Maximum length of a client's hello in bytes.
pub const MAX_HELLO_BYTES: usize = HELLO_HEADER_BYTES + 8 * Filter::MAX_COUNT;

const HELLO_MAGIC: &[u8; 7] = b"skinbus";
const HELLO_HEADER_BYTES: usize = 23;
/// Length of an answer of version 2 in bytes.
const HELLO_REPLY_BYTES: usize = 17;

/// Returns the id of the process that connected a socket; `None` if the process is in another pid namespace.
#[must_use]
pub fn peer_process(socket: impl AsFd) -> Option<u32> {
    calls::peer_process(socket.as_fd())
}

/// Enables the kernel's time stamps (`SO_TIMESTAMPNS`) of the datagrams that a socket receives from now on.
///
/// # Errors
/// Returns the error of `setsockopt`.
pub fn enable_time_stamps(socket: &OwnedFd) -> io::Result<()> {
    CanFdSocket::from(socket.try_clone()?).set_recv_timestamp(true)
}

/// The first datagram of a client: its filters and options.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct ClientHello {
    /// Filters for received frames.
    pub filters: Vec<Filter>,
    /// True to receive the frames that the client itself sends.
    pub own_frames: bool,
    /// True to receive CAN FD frames.
    pub fd: bool,
    /// Mask of error frames to receive.
    pub error_mask: u32,
    /// Requested size of the receive buffer in bytes.
    pub buffer: u64,
    /// Version of the protocol: [`OLDEST_HELLO_VERSION`] to [`HELLO_VERSION`].
    pub version: u8,
    /// True to receive the time stamps of a timed bus. Version 2 has none.
    pub stamps: bool,
}

impl Default for ClientHello {
    /// Returns a hello of the newest version for CAN FD frames, without filters, own frames and stamps.
    fn default() -> Self {
        Self {
            filters: Vec::new(),
            own_frames: false,
            fd: true,
            error_mask: 0,
            buffer: 0,
            version: HELLO_VERSION,
            stamps: false,
        }
    }
}

impl ClientHello {
    /// Encodes the hello as a datagram.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HELLO_HEADER_BYTES + 8 * self.filters.len());
        bytes.extend_from_slice(HELLO_MAGIC);
        bytes.extend_from_slice(&[self.version, self.own_frames.into(), self.fd.into()]);
        bytes.extend_from_slice(&self.error_mask.to_le_bytes());
        bytes.extend_from_slice(&self.buffer.to_le_bytes());
        bytes.push(self.stamps.into());
        encode_filters(&self.filters, &mut bytes);
        bytes
    }

    /// Decodes a datagram. Returns `None` if it is not a hello of a known version. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (head, filters) = bytes.split_first_chunk::<HELLO_HEADER_BYTES>()?;
        let rest = head.strip_prefix(HELLO_MAGIC)?;
        let &[
            version @ OLDEST_HELLO_VERSION..=HELLO_VERSION,
            own @ 0..=1,
            fd @ 0..=1,
            m0,
            m1,
            m2,
            m3,
            ref rest @ ..,
        ] = rest
        else {
            return None;
        };
        let (buffer, &[stamps]) = rest.split_first_chunk()? else { return None };
        if stamps > u8::from(version > OLDEST_HELLO_VERSION) {
            return None;
        }
        Some(Self {
            filters: decode_filters(filters).filter(|filters| filters.len() <= Filter::MAX_COUNT)?,
            own_frames: own == 1,
            fd: fd == 1,
            error_mask: u32::from_le_bytes([m0, m1, m2, m3]),
            buffer: u64::from_le_bytes(*buffer),
            version,
            stamps: stamps == 1,
        })
    }

    /// Returns the version to name in a refusal of a datagram: its own version if a server understands that.
    #[must_use]
    pub fn refused_version(bytes: &[u8]) -> u8 {
        match bytes.strip_prefix(HELLO_MAGIC) {
            Some(&[version @ OLDEST_HELLO_VERSION..=HELLO_VERSION, ..]) => version,
            _ => HELLO_VERSION,
        }
    }
}

/// A piece of a list of filters. The complete list replaces the present filters of a client.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct FilterPart {
    /// True for the first piece of a list. It discards a list that is not complete yet.
    pub first: bool,
    /// True for the last piece of a list. It activates the list.
    pub last: bool,
    /// The filters of this piece.
    pub filters: Vec<Filter>,
}

impl FilterPart {
    const FILTER_TAG: u8 = b'F';
    const FIRST_PART_FLAG: u8 = 1;
    const LAST_PART_FLAG: u8 = 2;
    /// Maximum number of filters in a piece. The datagram must not be longer than an FD frame, because a server reads
    /// no longer ones.
    const MAX_FILTERS_PER_PART: usize = 8;

    /// Splits a list of filters into pieces for one datagram each.
    pub fn split_filters(filters: &[Filter]) -> impl Iterator<Item = Self> + use<'_> {
        let parts = filters.len().div_ceil(Self::MAX_FILTERS_PER_PART).max(1);
        (0..parts).map(move |part| Self {
            first: part == 0,
            last: part == parts - 1,
            filters: filters
                .iter()
                .skip(part * Self::MAX_FILTERS_PER_PART)
                .take(Self::MAX_FILTERS_PER_PART)
                .copied()
                .collect(),
        })
    }

    /// Encodes the piece as a datagram.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let flag = |set, flag| if set { flag } else { 0 };
        let mut bytes = vec![
            Self::FILTER_TAG,
            flag(self.first, Self::FIRST_PART_FLAG) | flag(self.last, Self::LAST_PART_FLAG),
        ];
        encode_filters(&self.filters, &mut bytes);
        bytes
    }

    /// Decodes a datagram. Returns `None` if it is not a piece of a list of filters. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[Self::FILTER_TAG, flags @ 0..=3, ref rest @ ..] = bytes else { return None };
        let filters = decode_filters(rest).filter(|filters| filters.len() <= Self::MAX_FILTERS_PER_PART)?;
        Some(Self {
            first: flags & Self::FIRST_PART_FLAG != 0,
            last: flags & Self::LAST_PART_FLAG != 0,
            filters,
        })
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

/// The server's answer to a client's hello.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum HelloReply {
    /// The client is connected and its filters are set.
    Welcome {
        /// Size of the client's receive buffer in bytes, as the kernel counts it.
        granted: u64,
        /// The version of the client's hello.
        version: u8,
        /// True if frames come with time stamps of a timed bus. Version 2 cannot say so.
        stamps: bool,
    },
    /// The server did not understand the hello.
    Refused {
        /// The version that the server uses.
        version: u8,
    },
}

impl HelloReply {
    /// Encodes the answer as a datagram.
    #[must_use]
    pub fn encode(self) -> Vec<u8> {
        let (code, version, granted, stamps) = match self {
            Self::Welcome { granted, version, stamps } => (0, version, granted, stamps),
            Self::Refused { version } => (1, version, 0, false),
        };
        let mut bytes = Vec::with_capacity(HELLO_REPLY_BYTES + 1);
        bytes.extend_from_slice(HELLO_MAGIC);
        bytes.extend_from_slice(&[version, code]);
        bytes.extend_from_slice(&granted.to_le_bytes());
        if version > OLDEST_HELLO_VERSION {
            bytes.push(stamps.into());
        }
        bytes
    }

    /// Decodes a datagram. Returns `None` if it is not an answer. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[version, code, ref value @ ..] = bytes.strip_prefix(HELLO_MAGIC)? else { return None };
        let (granted, rest) = value.split_first_chunk()?;
        let granted = u64::from_le_bytes(*granted);
        match (version, code, rest) {
            (OLDEST_HELLO_VERSION, 0, []) => Some(Self::Welcome { granted, version, stamps: false }),
            (HELLO_VERSION, 0, &[stamps @ 0..=1]) => {
                Some(Self::Welcome { granted, version, stamps: stamps == 1 })
            }
            // A server of any other version may refuse, too.
            (version, 1, _) => Some(Self::Refused { version }),
            _ => None,
        }
    }
}

/// Splits a datagram into the bytes of a frame and its time stamp on a timed bus, in ns since 1970.
#[must_use]
pub fn split_stamp(bytes: &[u8]) -> (&[u8], Option<u64>) {
    const STAMPED_CLASSIC_BYTES: usize = CLASSIC_BYTES + STAMP_BYTES;
    match bytes.len() {
        STAMPED_CLASSIC_BYTES | MAX_FRAME_DATAGRAM_BYTES => match bytes.split_last_chunk() {
            Some((frame, stamp)) => (frame, Some(u64::from_le_bytes(*stamp))),
            None => (bytes, None),
        },
        _ => (bytes, None),
    }
}

/// Encodes a refusal notice: the total number of frames of a client that its transmit queue on a timed bus refused, and
/// the identifier of the last one, with its flags.
#[must_use]
pub fn encode_refusal_notice(total: u32, id: u32) -> [u8; 9] {
    let mut bytes = [b'R'; 9];
    let (_, rest) = bytes.split_at_mut(1);
    let words = total.to_le_bytes().into_iter().chain(id.to_le_bytes());
    rest.iter_mut().zip(words).for_each(|(to, from)| *to = from);
    bytes
}

/// Decodes a refusal notice. Returns the total number of refused frames and the identifier of the last one; `None` for
/// any other datagram.
#[must_use]
pub const fn decode_refusal_notice(bytes: &[u8]) -> Option<(u32, u32)> {
    match *bytes {
        [b'R', a, b, c, d, e, f, g, h] => {
            Some((u32::from_le_bytes([a, b, c, d]), u32::from_le_bytes([e, f, g, h])))
        }
        _ => None,
    }
}

/// Encodes a drop notice: the total number of frames dropped for a client.
#[must_use]
pub const fn encode_drop_notice(total: u32) -> [u8; 5] {
    let [a, b, c, d] = total.to_le_bytes();
    [b'D', a, b, c, d]
}

/// Decodes a drop notice. Returns the total number of dropped frames; `None` for any other datagram.
#[must_use]
pub const fn decode_drop_notice(bytes: &[u8]) -> Option<u32> {
    match *bytes {
        [b'D', a, b, c, d] => Some(u32::from_le_bytes([a, b, c, d])),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::FD_BYTES;
    use proptest::prelude::*;

    fn any_hello() -> impl Strategy<Value = ClientHello> {
        let filters = proptest::collection::vec(any::<(u32, u32)>(), 0..20);
        (filters, any::<(bool, bool, u32, u64)>(), (2..=3_u8, any::<bool>())).prop_map(
            |(filters, (own_frames, fd, error_mask, buffer), (version, stamps))| {
                let filters = filters.into_iter().map(|(id, mask)| Filter { id, mask }).collect();
                let stamps = stamps && version == 3;
                ClientHello { filters, own_frames, fd, error_mask, buffer, version, stamps }
            },
        )
    }

    #[test]
    fn the_bytes_of_a_hello() {
        let filter = Filter { id: 0x001, mask: 0xC000_07FF };
        let hello = ClientHello {
            filters: vec![filter],
            own_frames: true,
            fd: true,
            error_mask: 0x1FF,
            buffer: 0x10_0000,
            version: 2,
            stamps: false,
        };
        let expected = b"skinbus\x02\x01\x01\xff\x01\0\0\0\0\x10\0\0\0\0\0\0\x01\0\0\0\xff\x07\0\xc0";
        assert_eq!(hello.encode(), expected);
        let newer = ClientHello { version: 3, stamps: true, ..hello }.encode();
        assert_eq!(newer[..7], expected[..7]);
        assert_eq!((newer[7], newer[22]), (3, 1));
        assert_eq!((&newer[8..22], &newer[23..]), (&expected[8..22], &expected[23..]));
    }

    #[test]
    fn no_control_datagram_is_as_long_as_a_frame() {
        let lens = (0..=Filter::MAX_COUNT)
            .map(|count| HELLO_HEADER_BYTES + 8 * count)
            .chain((0..=Filter::MAX_COUNT).flat_map(|count| {
                let filters = vec![Filter::ALL; count];
                FilterPart::split_filters(&filters).map(|part| part.encode().len()).collect::<Vec<_>>()
            }))
            .chain((1..=3).map(|version| HelloReply::Refused { version }.encode().len()))
            .chain([encode_drop_notice(0).len(), encode_refusal_notice(0, 0).len()]);
        let frames = [CLASSIC_BYTES, FD_BYTES].map(|len| [len, len + STAMP_BYTES]);
        assert!(lens.into_iter().all(|len| !frames.as_flattened().contains(&len) && len != 0));
    }

    #[test]
    fn a_hello_of_another_version_is_none() {
        let hello = ClientHello { stamps: true, ..ClientHello::default() };
        for (version, stamps, refused) in [(4, 1, 3), (1, 0, 3), (2, 1, 2), (3, 2, 3)] {
            let mut bytes = hello.encode();
            (bytes[7], bytes[22]) = (version, stamps);
            assert_eq!(ClientHello::decode(&bytes), None, "version {version}, stamps {stamps}");
            assert_eq!(ClientHello::refused_version(&bytes), refused);
        }
        assert_eq!(ClientHello::refused_version(b"skinbu"), 3);
    }

    #[test]
    fn a_stamp_follows_the_frame() {
        for len in [CLASSIC_BYTES, FD_BYTES] {
            let frame: Vec<_> = (0..len).map(|at| u8::try_from(at).unwrap()).collect();
            assert_eq!(split_stamp(&frame), (frame.as_slice(), None));
            let stamped = [&frame[..], &0x0102_0304_0506_0708_u64.to_le_bytes()].concat();
            assert_eq!(split_stamp(&stamped), (frame.as_slice(), Some(0x0102_0304_0506_0708)));
        }
        assert_eq!(split_stamp(&[0; 25]), (&[0; 25][..], None));
    }

    proptest! {
        #[test]
        fn every_hello_comes_back(hello in any_hello()) {
            prop_assert_eq!(ClientHello::decode(&hello.encode()), Some(hello));
        }

        #[test]
        fn every_change_of_filters_comes_back_in_parts_that_a_bus_can_read(words in proptest::collection::vec(any::<(u32, u32)>(), 0..40)) {
            let filters: Vec<_> = words.into_iter().map(|(id, mask)| Filter { id, mask }).collect();
            let parts: Vec<_> = FilterPart::split_filters(&filters).collect();
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
        fn every_answer_comes_back(granted: u64, version: u8, total: u32, id: u32, stamps: bool) {
            let newer = HelloReply::Welcome { granted, version: 3, stamps };
            let older = HelloReply::Welcome { granted, version: 2, stamps: false };
            for answer in [newer, older, HelloReply::Refused { version }] {
                prop_assert_eq!(HelloReply::decode(&answer.encode()), Some(answer));
            }
            prop_assert_eq!(decode_drop_notice(&encode_drop_notice(total)), Some(total));
            prop_assert_eq!(decode_refusal_notice(&encode_refusal_notice(total, id)), Some((total, id)));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            let _ = (ClientHello::decode(&bytes), FilterPart::decode(&bytes));
            let _ = (HelloReply::decode(&bytes), decode_drop_notice(&bytes));
        }
    }
}
