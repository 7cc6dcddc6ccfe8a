//! The buffer of one datagram, and the kernel's control messages about it.

use crate::can::FD_BYTES;

/// Length in bytes of the time stamp that follows a frame on a timed bus.
pub const STAMP_BYTES: usize = 8;
/// Maximum length of a datagram with a frame in bytes.
pub const MAX_FRAME_DATAGRAM_BYTES: usize = FD_BYTES + STAMP_BYTES;

/// The buffer of one datagram and its control messages.
pub(super) struct DatagramBuffer {
    pub(super) bytes: [u8; MAX_FRAME_DATAGRAM_BYTES],
    /// Control messages: a time stamp (32 bytes) and a drop count (24 bytes).
    pub(super) control: [u64; 8],
    pub(super) len: usize,
    pub(super) control_len: usize,
    pub(super) flags: i32,
}

/// The kernel's control messages about a datagram, decoded.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct DatagramInfo {
    /// Time of arrival in nanoseconds of the wall clock (`SO_TIMESTAMPNS`).
    pub at_nanos: Option<u64>,
    /// Number of datagrams that the socket has dropped so far (`SO_RXQ_OVFL`).
    pub dropped: Option<u32>,
}

impl DatagramInfo {
    /// Decodes control messages.
    pub(super) fn decode(control: &[u8]) -> Self {
        let mut notes = Self::default();
        for ControlMessage { kind, data } in ControlMessages(control) {
            if kind == libc::SCM_TIMESTAMPNS {
                notes.at_nanos = parse_timespec_nanos(data);
            } else if kind == libc::SO_RXQ_OVFL {
                notes.dropped = data.first_chunk().map(|&bytes| u32::from_ne_bytes(bytes));
            }
        }
        notes
    }
}

/// A control message of the level `SOL_SOCKET`.
struct ControlMessage<'a> {
    kind: i32,
    data: &'a [u8],
}

/// An iterator over control messages. Each consists of length, level, type and data, padded to a 64-bit word.
struct ControlMessages<'a>(&'a [u8]);

impl<'a> Iterator for ControlMessages<'a> {
    type Item = ControlMessage<'a>;

    fn next(&mut self) -> Option<ControlMessage<'a>> {
        const USIZE_BYTES: usize = size_of::<usize>();
        const CMSG_HEADER_BYTES: usize = size_of::<libc::cmsghdr>();
        loop {
            let (head, _) = self.0.split_first_chunk::<CMSG_HEADER_BYTES>()?;
            let (len, rest) = head.split_at(USIZE_BYTES);
            let len = len.try_into().map_or(0, usize::from_ne_bytes);
            let number = |at| {
                rest.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |&bytes| i32::from_ne_bytes(bytes))
            };
            let data = self.0.get(CMSG_HEADER_BYTES..len)?;
            self.0 = self.0.get(len.next_multiple_of(USIZE_BYTES)..).unwrap_or_default();
            if number(0) == libc::SOL_SOCKET {
                return Some(ControlMessage { kind: number(4), data });
            }
        }
    }
}

/// Calls `take` with each file descriptor that came with a datagram (`SCM_RIGHTS`).
pub(super) fn for_each_descriptor(slot: &DatagramBuffer, mut take: impl FnMut(i32)) {
    let words = slot.control.map(u64::to_ne_bytes);
    let messages = ControlMessages(words.as_flattened().get(..slot.control_len).unwrap_or_default());
    for message in messages.filter(|message| message.kind == libc::SCM_RIGHTS) {
        let (descriptors, _) = message.data.as_chunks();
        descriptors.iter().for_each(|&bytes| take(i32::from_ne_bytes(bytes)));
    }
}

/// Converts a `struct timespec` of two 64-bit words to nanoseconds.
fn parse_timespec_nanos(timespec: &[u8]) -> Option<u64> {
    let (seconds, rest) = timespec.split_first_chunk()?;
    let nanos = rest.first_chunk()?;
    let seconds = u64::try_from(i64::from_ne_bytes(*seconds)).ok()?;
    let nanos = u64::try_from(i64::from_ne_bytes(*nanos)).ok()?;
    seconds.checked_mul(1_000_000_000)?.checked_add(nanos)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn no_control_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            let _ = DatagramInfo::decode(&bytes);
        }
    }
}
