//! The client side of the embedded bus: its directory, and the control datagrams that client and server exchange
//! besides frames.
//!
//! docs/reference/embedded-bus.md describes each byte. A frame is a datagram of 16 or 72 bytes, identical to the
//! kernel's struct; no control datagram has either length.

use std::os::fd::AsFd;

use super::{Filter, calls};

pub use client::seqpacket_socket;
pub(super) use client::{EmbeddedBackend, closed_error};
pub use directory::{
    DirectoryError, MARKER_FILE, default_directory, make_directory, open_directory, remove_directory,
    socket_address, socket_name, write_marker,
};

mod client;
mod directory;

/// The version of the protocol between client and server, which every hello contains.
pub const HELLO_VERSION: u8 = 2;
/// Index of the byte in a frame that is 1 if the receiving client sent the frame itself.
pub const OWN_FRAME_BYTE_INDEX: usize = 6;
/// Maximum length of a client's hello in bytes.
pub const MAX_HELLO_BYTES: usize = HELLO_HEADER_BYTES + 8 * Filter::MAX_COUNT;

const HELLO_MAGIC: &[u8; 7] = b"skinbus";
const HELLO_HEADER_BYTES: usize = 23;
const HELLO_REPLY_BYTES: usize = 17;

/// Returns the id of the process that connected a socket; `None` if the process is in another pid namespace.
#[must_use]
pub fn peer_process(socket: impl AsFd) -> Option<u32> {
    calls::peer_process(socket.as_fd())
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
}

impl ClientHello {
    /// Encodes the hello as a datagram.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HELLO_HEADER_BYTES + 8 * self.filters.len());
        bytes.extend_from_slice(HELLO_MAGIC);
        bytes.extend_from_slice(&[HELLO_VERSION, self.own_frames.into(), self.fd.into()]);
        bytes.extend_from_slice(&self.error_mask.to_le_bytes());
        bytes.extend_from_slice(&self.buffer.to_le_bytes());
        bytes.push(0);
        encode_filters(&self.filters, &mut bytes);
        bytes
    }

    /// Decodes a datagram. Returns `None` if it is not a hello of this version. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (head, filters) = bytes.split_first_chunk::<HELLO_HEADER_BYTES>()?;
        let rest = head.strip_prefix(HELLO_MAGIC)?;
        let &[HELLO_VERSION, own @ 0..=1, fd @ 0..=1, m0, m1, m2, m3, ref rest @ ..] = rest else {
            return None;
        };
        let (buffer, [0]) = rest.split_first_chunk()? else { return None };
        Some(Self {
            filters: decode_filters(filters).filter(|filters| filters.len() <= Filter::MAX_COUNT)?,
            own_frames: own == 1,
            fd: fd == 1,
            error_mask: u32::from_le_bytes([m0, m1, m2, m3]),
            buffer: u64::from_le_bytes(*buffer),
        })
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
    pub fn encode(self) -> [u8; HELLO_REPLY_BYTES] {
        let (code, version, granted) = match self {
            Self::Welcome { granted } => (0, HELLO_VERSION, granted),
            Self::Refused { version } => (1, version, 0),
        };
        let mut bytes = [0; HELLO_REPLY_BYTES];
        let (magic, rest) = bytes.split_at_mut(HELLO_MAGIC.len());
        let (head, value) = rest.split_at_mut(2);
        magic.copy_from_slice(HELLO_MAGIC);
        head.copy_from_slice(&[version, code]);
        value.copy_from_slice(&granted.to_le_bytes());
        bytes
    }

    /// Decodes a datagram. Returns `None` if it is not an answer. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let &[version, code, ref value @ ..] = bytes.strip_prefix(HELLO_MAGIC)? else { return None };
        let granted = u64::from_le_bytes(value.try_into().ok()?);
        match (version, code) {
            (HELLO_VERSION, 0) => Some(Self::Welcome { granted }),
            (version, 1) => Some(Self::Refused { version }),
            _ => None,
        }
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
    use crate::can::{CLASSIC_BYTES, FD_BYTES};
    use proptest::prelude::*;

    fn any_hello() -> impl Strategy<Value = ClientHello> {
        let filters = proptest::collection::vec(any::<(u32, u32)>(), 0..20);
        (filters, any::<(bool, bool, u32, u64)>()).prop_map(
            |(filters, (own_frames, fd, error_mask, buffer))| {
                let filters = filters.into_iter().map(|(id, mask)| Filter { id, mask }).collect();
                ClientHello { filters, own_frames, fd, error_mask, buffer }
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
        };
        let expected = b"skinbus\x02\x01\x01\xff\x01\0\0\0\0\x10\0\0\0\0\0\0\x01\0\0\0\xff\x07\0\xc0";
        assert_eq!(hello.encode(), expected);
    }

    #[test]
    fn no_control_datagram_is_as_long_as_a_frame() {
        let lens = (0..=Filter::MAX_COUNT)
            .map(|count| HELLO_HEADER_BYTES + 8 * count)
            .chain((0..=Filter::MAX_COUNT).flat_map(|count| {
                let filters = vec![Filter::ALL; count];
                FilterPart::split_filters(&filters).map(|part| part.encode().len()).collect::<Vec<_>>()
            }))
            .chain([HelloReply::Refused { version: 1 }.encode().len(), encode_drop_notice(0).len()]);
        assert!(lens.into_iter().all(|len| len != CLASSIC_BYTES && len != FD_BYTES && len != 0));
    }

    #[test]
    fn a_hello_of_another_version_is_none() {
        let mut bytes =
            ClientHello { filters: vec![], own_frames: false, fd: true, error_mask: 0, buffer: 0 }.encode();
        bytes[7] = HELLO_VERSION + 1;
        assert_eq!(ClientHello::decode(&bytes), None);
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
        fn every_answer_comes_back(granted: u64, version: u8, total: u32) {
            for answer in [HelloReply::Welcome { granted }, HelloReply::Refused { version }] {
                prop_assert_eq!(HelloReply::decode(&answer.encode()), Some(answer));
            }
            prop_assert_eq!(decode_drop_notice(&encode_drop_notice(total)), Some(total));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            let _ = (ClientHello::decode(&bytes), FilterPart::decode(&bytes));
            let _ = (HelloReply::decode(&bytes), decode_drop_notice(&bytes));
        }
    }
}
