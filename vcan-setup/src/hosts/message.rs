//! The format of the messages between hosts.
//!
//! Numbers are little-endian. A message is one batch of frames of one source:
//!
//! | bytes | what |
//! |---|---|
//! | 0 | version, 1 |
//! | 1 to 7 | 0 |
//! | 8 to 15 | life: a random number of this start of the source |
//! | 16 to 23 | number of the first frame; the next ones follow without a gap |
//! | 24 to 31 | frames that the source received from its bus and dropped before that, since it started; they have numbers too |
//! | 32 to 39 | frames that the source's bus dropped before the source received them; they have no numbers |
//! | 40 to 41 | frames in this message |
//! | then each | time in ns since 1970 by the source's clock (8), identifier and flags as in the kernel's struct (4), 1 for FD (1), FD flags (1), DLC of 9 to 15 of a classic frame, else 0 (1), length (1), data |

use protocol::can::{Format, Frame, FrameError};
use thiserror::Error;

/// The version of the message format.
pub const VERSION: u8 = 1;
/// The maximum number of frames in a message.
pub const MAX_FRAMES: usize = 256;
/// The length of the header in bytes.
const HEADER_BYTES: usize = 42;
/// The length of a frame before its data, in bytes.
const FRAME_HEADER_BYTES: usize = 16;

/// A frame with the time at which it was on the bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct StampedFrame {
    /// The time in ns since 1970, by the clock of the host whose bus it is.
    pub at_nanos: u64,
    /// The frame.
    pub frame: Frame,
}

/// The header of a message of one source.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct MessageHeader {
    /// A random number that identifies this start of the source.
    pub life: u64,
    /// The number of the first frame in the message.
    pub first: u64,
    /// The number of frames before `first` that the source dropped since its start.
    pub dropped: u64,
    /// The number of frames that the source's bus dropped before the source received them. They have no numbers.
    pub missed: u64,
}

/// The reason why a message is invalid.
#[derive(Clone, Copy, Debug, Error, Eq, PartialEq)]
#[non_exhaustive]
pub enum MessageError {
    /// The message has another version of the format.
    #[error(
        "a message has version {0}, but only version {VERSION} is supported: use the same release of skinbus on all hosts"
    )]
    Version(u8),
    /// The message is shorter or longer than its frames require. The field is its length in bytes.
    #[error("a message of {0} bytes has the wrong length for its frames")]
    Length(usize),
    /// A frame is invalid.
    #[error("frame {index} of a message is invalid: {error}")]
    Frame {
        /// The index of the frame in the message.
        index: usize,
        /// The error of the frame.
        error: FrameError,
    },
    /// The numbers in the header are impossible: a frame number would exceed 2^64, or more frames were dropped than
    /// numbered.
    #[error(
        "a message has inconsistent counts: its first frame has number {first}, but {dropped} frames were \
         dropped before it"
    )]
    Numbers {
        /// The number of the first frame.
        first: u64,
        /// The number of dropped frames.
        dropped: u64,
    },
}

/// Encodes a message with at most [`MAX_FRAMES`] of the given frames.
pub fn encode<'a>(
    head: &MessageHeader,
    frames: impl IntoIterator<Item = &'a StampedFrame>,
    bytes: &mut Vec<u8>,
) {
    bytes.clear();
    bytes.extend([VERSION, 0, 0, 0, 0, 0, 0, 0]);
    for word in [head.life, head.first, head.dropped, head.missed] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend([0, 0]);
    let mut count = 0_u16;
    for StampedFrame { at_nanos, frame } in frames.into_iter().take(MAX_FRAMES) {
        let is_fd = frame.format() == Format::Fd;
        bytes.extend(at_nanos.to_le_bytes());
        bytes.extend(frame.raw_id().to_le_bytes());
        let (flags, dlc) = if is_fd { (frame.flags(), 0) } else { (0, frame.raw_dlc()) };
        bytes.extend([u8::from(is_fd), flags, dlc, frame.len()]);
        bytes.extend(frame.data());
        count += 1;
    }
    if let Some(place) = bytes.get_mut(HEADER_BYTES - 2..HEADER_BYTES) {
        place.copy_from_slice(&count.to_le_bytes());
    }
}

/// Decodes a message and appends its frames to `frames`. Appends none if the message is invalid. Never panics.
///
/// # Errors
/// Returns [`MessageError`] if the message has another version, is incomplete, or contains an invalid frame.
pub fn decode(bytes: &[u8], frames: &mut Vec<StampedFrame>) -> Result<MessageHeader, MessageError> {
    let before = frames.len();
    let read = decode_message(bytes, frames);
    if read.is_err() {
        frames.truncate(before);
    }
    read
}

fn decode_message(bytes: &[u8], frames: &mut Vec<StampedFrame>) -> Result<MessageHeader, MessageError> {
    let wrong = MessageError::Length(bytes.len());
    let &version = bytes.first().ok_or(wrong)?;
    if version != VERSION {
        return Err(MessageError::Version(version));
    }
    let (head, mut rest) = bytes.split_first_chunk::<HEADER_BYTES>().ok_or(wrong)?;
    let word = |at: usize| head.get(at..at + 8).and_then(|word| word.try_into().ok()).map(u64::from_le_bytes);
    let (Some(life), Some(first), Some(dropped), Some(missed)) = (word(8), word(16), word(24), word(32))
    else {
        return Err(wrong);
    };
    let [.., low, high] = *head;
    let count = usize::from(u16::from_le_bytes([low, high]));
    if count > MAX_FRAMES {
        return Err(wrong);
    }
    if dropped > first || first.checked_add(MAX_FRAMES as u64).is_none() {
        return Err(MessageError::Numbers { first, dropped });
    }
    for index in 0..count {
        let (fixed, tail) = rest.split_first_chunk::<FRAME_HEADER_BYTES>().ok_or(wrong)?;
        let &[a, b, c, d, e, f, g, h, i, j, k, l, is_fd, flags, dlc, len] = fixed;
        let at_nanos = u64::from_le_bytes([a, b, c, d, e, f, g, h]);
        let id = u32::from_le_bytes([i, j, k, l]);
        let is_remote = is_fd == 0 && id & protocol::can::REMOTE != 0;
        let (data, tail) = tail.split_at_checked(if is_remote { 0 } else { len.into() }).ok_or(wrong)?;
        let frame = match (is_fd, is_remote) {
            (0, true) => Frame::remote(id, len),
            (0, false) => Frame::classic(id, data),
            _ => Frame::with_data(id, Format::Fd, flags, data),
        };
        let mut frame = frame.map_err(|error| MessageError::Frame { index, error })?;
        if is_fd == 0 {
            frame = frame.with_raw_dlc(dlc);
        }
        frames.push(StampedFrame { at_nanos, frame });
        rest = tail;
    }
    if rest.is_empty() { Ok(MessageHeader { life, first, dropped, missed }) } else { Err(wrong) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const HEAD_OF: MessageHeader =
        MessageHeader { life: 0x0102_0304_0506_0708, first: 9, dropped: 2, missed: 1 };

    fn stamped(at_nanos: u64, frame: Frame) -> StampedFrame {
        StampedFrame { at_nanos, frame }
    }

    #[test]
    fn a_message_is_these_bytes() {
        let frames = [
            stamped(1, Frame::classic(0x123, &[0xAB]).unwrap()),
            stamped(2, Frame::fd(0x8000_0456, 1, &[1, 2]).unwrap()),
            stamped(3, Frame::remote(0x7FF, 4).unwrap()),
        ];
        let mut bytes = Vec::new();
        encode(&HEAD_OF, &frames, &mut bytes);
        #[rustfmt::skip]
        let expected = [
            1, 0, 0, 0, 0, 0, 0, 0,
            8, 7, 6, 5, 4, 3, 2, 1,
            9, 0, 0, 0, 0, 0, 0, 0,
            2, 0, 0, 0, 0, 0, 0, 0,
            1, 0, 0, 0, 0, 0, 0, 0,
            3, 0,
            1, 0, 0, 0, 0, 0, 0, 0, 0x23, 1, 0, 0, 0, 0, 0, 1, 0xAB,
            2, 0, 0, 0, 0, 0, 0, 0, 0x56, 4, 0, 0x80, 1, 5, 0, 2, 1, 2,
            3, 0, 0, 0, 0, 0, 0, 0, 0xFF, 7, 0, 0x40, 0, 0, 0, 4,
        ];
        assert_eq!(bytes, expected);
        let mut read = Vec::new();
        assert_eq!(decode(&bytes, &mut read), Ok(HEAD_OF));
        assert_eq!(read, frames);
    }

    #[test]
    fn what_is_no_message_is_refused_as_a_whole() {
        let frame = stamped(1, Frame::classic(0x123, &[1, 2, 3]).unwrap());
        let mut bytes = Vec::new();
        encode(&HEAD_OF, &[frame, frame], &mut bytes);
        let mut read = vec![frame];
        for cut in 0..bytes.len() {
            assert_eq!(decode(&bytes[..cut], &mut read), Err(MessageError::Length(cut)), "{cut}");
        }
        let with = |at: usize, byte: u8| {
            let mut bytes = bytes.clone();
            bytes[at] = byte;
            bytes
        };
        assert_eq!(decode(&with(0, 2), &mut read), Err(MessageError::Version(2)));
        assert_eq!(decode(&with(40, 3), &mut read), Err(MessageError::Length(bytes.len())));
        assert_eq!(decode(&with(41, 1), &mut read), Err(MessageError::Length(bytes.len())), "258 frames");
        assert!(matches!(
            decode(&with(57, 9), &mut read),
            Err(MessageError::Length(_) | MessageError::Frame { .. })
        ));
        assert!(matches!(
            decode(&with(24, 10), &mut read),
            Err(MessageError::Numbers { first: 9, dropped: 10 })
        ));
        let mut last = with(16, 255);
        last[17..24].fill(255);
        assert!(matches!(decode(&last, &mut read), Err(MessageError::Numbers { .. })));
        assert_eq!(read, [frame], "nothing of them was taken");
    }

    proptest! {
        #[test]
        fn whatever_comes_is_a_message_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..200), head: bool) {
            let mut bytes = bytes;
            if head && bytes.len() > 42 { bytes[0] = VERSION; bytes[16..32].fill(0); bytes[41] = 0; }
            let mut frames = Vec::new();
            if let Ok(head) = decode(&bytes, &mut frames) {
                let mut again = Vec::new();
                encode(&head, &frames, &mut again);
                let mut read = Vec::new();
                prop_assert_eq!(decode(&again, &mut read), Ok(head));
                prop_assert_eq!(read, frames);
            } else {
                prop_assert!(frames.is_empty());
            }
        }
    }
}
