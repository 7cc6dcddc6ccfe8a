//! Our own types: a CAN frame, and what stands between frames.
//!
//! There is no convention for CAN in recordings that would bring a candump line back as it was: `can_msgs/Frame`
//! holds 8 bytes, `ros2_socketcan_msgs/FdFrame` has no flags. These do, and any viewer reads them.

use std::borrow::Cow;

use protocol::can::{ERROR, EXTENDED, EXTENDED_MASK, Format, Frame, REMOTE};
use protocol::candump::{Direction, Record, Timestamp};

use super::Message;
use super::cdr::{CdrError, Reader, Writer};
use crate::capture::{Note, NoteKind};

/// The definitions of a header, to stand behind a message that has one.
macro_rules! header {
    () => {
        "\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id

================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"
    };
}
pub(super) use header;

const NANOS: u64 = 1_000_000_000;

/// Writes a header. Its seconds end in 2038; the recording's own times do not.
pub(super) fn write_header(out: &mut Writer<'_>, nanos: u64, frame_id: &str) {
    write_time(out, nanos);
    out.str(frame_id);
}

/// Writes a time.
pub(super) fn write_time(out: &mut Writer<'_>, nanos: u64) {
    out.i32(i32::try_from(nanos / NANOS).unwrap_or(i32::MAX));
    out.u32(u32::try_from(nanos % NANOS).unwrap_or(0));
}

/// Reads a header's name; its time is said better by the recording itself.
fn frame_id<'a>(from: &mut Reader<'a>) -> Result<&'a str, CdrError> {
    from.i32()?;
    from.u32()?;
    from.str()
}

/// A frame of a bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CanFrame<'a>(pub Record<'a>);

impl Message for CanFrame<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/CanFrame";
    const DEFINITION: &'static str = concat!(
        "\
std_msgs/Header header      # when it was on the bus, by the kernel; frame_id is the bus
uint32 id                   # 11 or 29 bits, without flags
bool is_extended            # 29 bits
bool is_rtr                 # remote frame
bool is_error               # error frame: a message of the driver
bool is_fd
uint8 flags                 # of an FD frame: 1 BRS, 2 ESI, 4 FDF
uint8 length                # bytes of data, or those that a remote frame asks for
uint8 raw_dlc               # DLC 9..15 of a classic frame of 8 bytes, else 0
uint8 direction             # 0 unknown, 1 received, 2 sent by whoever took the capture
uint8[] data

",
        header!()
    );

    fn write(&self, out: &mut Writer<'_>) {
        let Record { time, interface, frame, direction } = &self.0;
        write_header(out, time.nanos, interface);
        out.u32(frame.raw_id() & EXTENDED_MASK);
        out.bool(frame.is_extended());
        out.bool(frame.is_remote());
        out.bool(frame.is_error());
        out.bool(frame.format() == Format::Fd);
        out.u8(frame.flags());
        out.u8(frame.len());
        out.u8(frame.raw_dlc());
        out.u8(match direction {
            None => 0,
            Some(Direction::Received) => 1,
            Some(Direction::Sent) => 2,
        });
        out.bytes(frame.data());
    }
}

impl<'a> CanFrame<'a> {
    /// When the frame was on its bus, by its header, in ns since 1970: of a frame of before, that is long before the
    /// recording has it.
    ///
    /// # Errors
    /// When it is no such message.
    pub fn stamp(message: &[u8]) -> Result<u64, CdrError> {
        let mut from = Reader::new(message)?;
        let (sec, nanosec) = (from.i32()?, from.u32()?);
        Ok(u64::try_from(sec).unwrap_or(0) * NANOS + u64::from(nanosec))
    }

    /// Reads a message that the recording holds at a time. Never panics.
    ///
    /// # Errors
    /// When it is no such message.
    pub fn decode(message: &'a [u8], time: Timestamp) -> Result<Self, CdrError> {
        let mut from = Reader::new(message)?;
        let interface = frame_id(&mut from)?;
        let mut id = from.u32()?;
        if id > EXTENDED_MASK {
            return Err(CdrError::Value { what: "id", got: id.into(), allowed: "29 bits" });
        }
        for flag in [EXTENDED, REMOTE, ERROR] {
            id |= if from.bool()? { flag } else { 0 };
        }
        let format = if from.bool()? { Format::Fd } else { Format::Classic };
        let [flags, length, raw_dlc, direction] = [from.u8()?, from.u8()?, from.u8()?, from.u8()?];
        let direction = match direction {
            0 => None,
            1 => Some(Direction::Received),
            2 => Some(Direction::Sent),
            got => {
                return Err(CdrError::Value { what: "direction", got: got.into(), allowed: "0, 1 or 2" });
            }
        };
        let data = from.bytes()?;
        let wrong = CdrError::Value {
            what: "length",
            got: length.into(),
            allowed: "that of the data; 8 in a classic frame, 64 in an FD one",
        };
        let asked = [0; 64];
        let data = match id & REMOTE {
            0 if data.len() == usize::from(length) => data,
            0 => return Err(wrong),
            _ => asked.get(..usize::from(length)).ok_or(wrong)?,
        };
        let frame = Frame::with_data(id, format, flags, data).map_err(|_| wrong)?.with_raw_dlc(raw_dlc);
        Ok(Self(Record { time, interface, frame, direction }))
    }
}

/// Something between frames: a comment, frames that were lost, a line that is no frame.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureNote<'a>(pub Cow<'a, Note<'a>>);

impl Message for CaptureNote<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/CaptureNote";
    const DEFINITION: &'static str = concat!(
        "\
std_msgs/Header header      # frame_id is the bus, or empty
uint8 TEXT=0                # a comment, an empty line
uint8 DROPPED=1             # frames are missing here
uint8 CAN_XL=2              # a CAN XL frame, which is not read
uint8 UNREADABLE=3          # a line that begins like a frame and is none
uint8 kind
uint64 frames               # how many were dropped
uint64 line                 # in the log it comes from, from 1, else 0
string text                 # the line or, of an unreadable one, what is wrong with it
uint8[] bytes               # the line, when text is not the same

",
        header!()
    );

    fn write(&self, out: &mut Writer<'_>) {
        let note = self.0.as_ref();
        let (kind, frames) = match note.kind {
            NoteKind::Text => (0, 0),
            NoteKind::Dropped(frames) => (1, frames),
            NoteKind::CanXl => (2, 0),
            NoteKind::Unreadable(_) => (3, 0),
        };
        write_header(out, note.nanos, note.interface);
        out.u8(kind);
        out.u64(frames);
        out.u64(note.line);
        // A text of CDR ends at its NUL for some readers.
        let text = str::from_utf8(note.text).ok().filter(|text| !text.contains('\0'));
        match (&note.kind, text) {
            (NoteKind::Unreadable(why), _) => {
                out.str(&why.replace('\0', "?"));
                out.bytes(note.text);
            }
            (NoteKind::Text | NoteKind::Dropped(_) | NoteKind::CanXl, Some(text)) => {
                out.str(text);
                out.bytes(&[]);
            }
            (NoteKind::Text | NoteKind::Dropped(_) | NoteKind::CanXl, None) => {
                out.str(&String::from_utf8_lossy(note.text).replace('\0', "?"));
                out.bytes(note.text);
            }
        }
    }
}

impl<'a> CaptureNote<'a> {
    /// Reads a message that the recording holds at a time. Never panics.
    ///
    /// # Errors
    /// When it is no such message.
    pub fn decode(message: &'a [u8], nanos: u64) -> Result<Self, CdrError> {
        let mut from = Reader::new(message)?;
        let interface = frame_id(&mut from)?;
        let (kind, frames, line) = (from.u8()?, from.u64()?, from.u64()?);
        let (text, bytes) = (from.str()?, from.bytes()?);
        let (kind, text) = match kind {
            3 => (NoteKind::Unreadable(text.to_owned()), bytes),
            0 => (NoteKind::Text, if bytes.is_empty() { text.as_bytes() } else { bytes }),
            1 => (NoteKind::Dropped(frames), if bytes.is_empty() { text.as_bytes() } else { bytes }),
            2 => (NoteKind::CanXl, if bytes.is_empty() { text.as_bytes() } else { bytes }),
            got => return Err(CdrError::Value { what: "kind", got: got.into(), allowed: "0 to 3" }),
        };
        Ok(Self(Cow::Owned(Note { kind, nanos, interface, line, text })))
    }
}

/// The time of a message, with as many digits as its channel says.
#[must_use]
pub const fn timestamp(log_time: u64, nine_digits: bool) -> Timestamp {
    Timestamp { nanos: log_time, nine_digits }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use protocol::can::STANDARD_MASK;

    fn back_and_forth(record: Record<'_>) -> Result<Record<'_>, CdrError> {
        let mut buffer = Vec::new();
        CanFrame(record).encode_into(&mut buffer);
        let back = CanFrame::decode(&buffer, record.time)?;
        assert_eq!(back.0.interface, record.interface);
        Ok(Record { interface: record.interface, ..back.0 })
    }

    #[test]
    fn a_frame_stands_byte_for_byte_where_the_definition_says() {
        let frame = Frame::fd(0x22C, 1, &[0xAA, 0xBB]).unwrap();
        let time = Timestamp { nanos: 5 * NANOS + 7, nine_digits: true };
        let record = Record { time, interface: "vcan0", frame, direction: Some(Direction::Sent) };
        let mut buffer = Vec::new();
        CanFrame(record).encode_into(&mut buffer);
        let expected = [
            &[0, 1, 0, 0][..],
            &[5, 0, 0, 0, 7, 0, 0, 0],
            &[6, 0, 0, 0, b'v', b'c', b'a', b'n', b'0', 0, 0, 0],
            &[0x2C, 2, 0, 0],
            &[0, 0, 0, 1],
            &[5, 2, 0, 2],
            &[2, 0, 0, 0, 0xAA, 0xBB],
        ];
        assert_eq!(buffer, expected.concat());
    }

    #[test]
    fn a_message_that_is_no_frame_is_refused() {
        let time = Timestamp { nanos: 0, nine_digits: true };
        let record = Record { time, interface: "", frame: Frame::EMPTY, direction: None };
        let mut buffer = Vec::new();
        CanFrame(record).encode_into(&mut buffer);
        let with = |at: usize, value: u8| {
            let mut bytes = buffer.clone();
            bytes[at] = value;
            CanFrame::decode(&bytes, time).map(|_| ()).unwrap_err().to_string()
        };
        // The empty name takes 5 bytes, and 3 fill.
        assert!(with(23, 0xFF).starts_with("id of a message is 4278190080: allowed is 29 bits"));
        assert!(with(29, 1).starts_with("length of a message is 1: allowed is that of the data"));
        assert!(with(31, 3).starts_with("direction of a message is 3: allowed is 0, 1 or 2"));
    }

    fn note(kind: NoteKind, text: &[u8]) -> Note<'_> {
        Note { kind, nanos: 42, interface: "can0", line: 7, text }
    }

    #[test]
    fn notes_come_back_with_every_byte() {
        let kinds = [
            NoteKind::Text,
            NoteKind::Dropped(3),
            NoteKind::CanXl,
            NoteKind::Unreadable("column 5: 6 or 9 digits of a second".to_owned()),
        ];
        for kind in kinds {
            for text in [&b""[..], b"# a comment", b"\xFF\0broken", b"a\0b", "µ".as_bytes()] {
                let note = note(kind.clone(), text);
                let mut buffer = Vec::new();
                CaptureNote(Cow::Borrowed(&note)).encode_into(&mut buffer);
                assert_eq!(CaptureNote::decode(&buffer, 42).unwrap().0.as_ref(), &note);
            }
        }
    }

    proptest! {
        #[test]
        fn every_frame_comes_back(
            nanos: u64, nine_digits: bool, kind in 0..5, id: u32, flags in 0_u8..16, way in 0_usize..3, dlc in 9_u8..16,
            interface in "[a-z0-9]{1,15}", data in proptest::collection::vec(any::<u8>(), 0..=64),
        ) {
            let short = &data[..data.len().min(8)];
            let frame = match kind {
                0 => Frame::classic(id & STANDARD_MASK, short),
                1 => Frame::classic(id & EXTENDED_MASK | EXTENDED, short),
                2 => Frame::remote(id & STANDARD_MASK, flags.min(8)),
                3 => Frame::classic(id & EXTENDED_MASK | ERROR, short),
                _ => Frame::with_data(id & STANDARD_MASK, Format::Fd, flags, &data),
            }.unwrap();
            let frame = if kind < 4 && frame.len() == 8 { frame.with_raw_dlc(dlc) } else { frame };
            let direction = [None, Some(Direction::Sent), Some(Direction::Received)][way];
            let time = Timestamp { nanos, nine_digits };
            let record = Record { time, interface: &interface, frame, direction };
            prop_assert_eq!(back_and_forth(record), Ok(record));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(0_u8..4, 0..80)) {
            let _ = CanFrame::decode(&bytes, timestamp(0, true));
            let _ = CaptureNote::decode(&bytes, 0);
        }
    }
}
