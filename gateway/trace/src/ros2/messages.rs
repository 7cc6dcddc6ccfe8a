//! Message types of skinbus: CAN frames, and notes between frames.
//!
//! No existing message type for CAN holds all information of a candump line: `can_msgs/Frame` has 8 bytes of data, and
//! `ros2_socketcan_msgs/FdFrame` has no flags. These types do, and any viewer can read them.

use protocol::can::{ERROR, EXTENDED, Format, Frame, REMOTE, check_identifier};
use protocol::candump::{Direction, Record, Timestamp};

use super::cdr::{CdrError, CdrReader, CdrWriter, Encode};
use super::{Header, Message, definition};
use crate::note::{CaptureNote, NoteKind};

/// Encodes a frame of a bus as a message.
impl Message for Record<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/CanFrame";
    const DEFINITION: &'static str =
        definition!("skinbus_msgs/CanFrame", "std_msgs/Header", "builtin_interfaces/Time");
}

impl Encode for Record<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        let Self { time, interface, frame, direction } = self;
        out.put(Header { nanos: time.nanos, frame_id: interface });
        out.put(frame.id());
        for flag in [frame.is_extended(), frame.is_remote(), frame.is_error(), frame.format() == Format::Fd] {
            out.put(flag);
        }
        let direction = match direction {
            None => 0,
            Some(Direction::Received) => 1,
            Some(Direction::Sent) => 2,
        };
        for number in [frame.flags(), frame.len(), frame.raw_dlc(), direction] {
            out.put(number);
        }
        out.put_bytes(frame.data());
    }
}

/// Returns the time of a frame on its bus according to its header, in ns since 1970. For a frame that was latched
/// before the recording, this is earlier than the time of the record.
///
/// # Errors
/// Returns [`CdrError`] if the bytes are not a message of this type.
pub fn decode_stamp_nanos(message: &[u8]) -> Result<u64, CdrError> {
    Ok(CdrReader::new(message)?.get::<Header<'_>>()?.nanos)
}

/// Decodes a frame. Its time is `time`, that of the MCAP record.
///
/// # Errors
/// Returns [`CdrError`] if the bytes are not a message of this type.
pub fn decode_frame(message: &[u8], time: Timestamp) -> Result<Record<'_>, CdrError> {
    let mut from = CdrReader::new(message)?;
    let (Header { frame_id: interface, .. }, number) = (from.get()?, from.get::<u32>()?);
    let mut kind = 0;
    for flag in [EXTENDED, REMOTE, ERROR] {
        kind |= if from.get()? { flag } else { 0 };
    }
    let id = check_identifier(number, kind)?;
    let format = if from.get()? { Format::Fd } else { Format::Classic };
    let [flags, length, raw_dlc, direction]: [u8; 4] = from.get()?;
    let direction = match direction {
        0 => None,
        1 => Some(Direction::Received),
        2 => Some(Direction::Sent),
        got => return Err(value_error("direction", got, "0, 1 or 2")),
    };
    let is_remote = id & REMOTE != 0;
    if is_remote && format == Format::Fd {
        return Err(value_error("is_rtr", 1, "0 in an FD frame"));
    }
    let most_flags = if format == Format::Fd { 15 } else { 0 };
    if flags > most_flags {
        return Err(value_error("flags", flags, "0 to 15 in an FD frame, 0 in a classic one"));
    }
    let is_raw = format == Format::Classic && length == 8;
    if !(raw_dlc == 0 || is_raw && matches!(raw_dlc, 9..=15)) {
        return Err(value_error("raw_dlc", raw_dlc, "0; 9 to 15 in a classic frame of 8 bytes"));
    }
    let data = from.get_bytes()?;
    let wrong = value_error(
        "length",
        length,
        "the length of the data, at most 8 in a classic frame or 64 in an FD frame; a remote frame has no data",
    );
    let frame = match is_remote {
        false if data.len() == usize::from(length) => Frame::with_data(id, format, flags, data),
        true if data.is_empty() => Frame::remote(id, length),
        true | false => return Err(wrong),
    };
    let frame = frame.map_err(|_| wrong)?.with_raw_dlc(raw_dlc);
    Ok(Record { time, interface, frame, direction })
}

fn value_error(what: &'static str, got: u8, allowed: &'static str) -> CdrError {
    CdrError::Value { what, got: got.into(), allowed }
}

/// Encodes a note (a comment, lost frames, or a line that is not a frame) as a message.
impl Message for CaptureNote<'_> {
    const TYPE: &'static str = "skinbus_msgs/msg/CaptureNote";
    const DEFINITION: &'static str =
        definition!("skinbus_msgs/CaptureNote", "std_msgs/Header", "builtin_interfaces/Time");
}

impl Encode for CaptureNote<'_> {
    fn encode(&self, out: &mut CdrWriter<'_>) {
        // Some readers end a CDR text at its first NUL, so a text with a NUL is stored as bytes.
        let same = || str::from_utf8(self.text).ok().filter(|text| !text.contains('\0'));
        let (kind, frames, same) = match self.kind {
            NoteKind::Text => (0_u8, 0, same()),
            NoteKind::Dropped(frames) => (1, frames, same()),
            NoteKind::CanXl => (2, 0, same()),
            NoteKind::Unreadable(_) => (3, 0, None),
        };
        out.put(Header { nanos: self.nanos, frame_id: self.interface });
        out.put(kind);
        out.put((frames, self.line));
        match (&self.kind, same) {
            (_, Some(text)) => out.put(text),
            (NoteKind::Unreadable(why), None) => out.put(why.replace('\0', "?").as_str()),
            (_, None) => out.put(String::from_utf8_lossy(self.text).replace('\0', "?").as_str()),
        }
        out.put_bytes(if same.is_some() { &[] } else { self.text });
    }
}

/// Decodes a note. Its time is `nanos`, that of the MCAP record. Never panics.
///
/// # Errors
/// Returns [`CdrError`] if the bytes are not a message of this type.
pub fn decode_note(message: &[u8], nanos: u64) -> Result<CaptureNote<'_>, CdrError> {
    let mut from = CdrReader::new(message)?;
    let (Header { frame_id: interface, .. }, kind) = (from.get()?, from.get::<u8>()?);
    let [frames, line]: [u64; 2] = from.get()?;
    let (words, bytes) = (from.get::<&str>()?, from.get_bytes()?);
    let text = if bytes.is_empty() { words.as_bytes() } else { bytes };
    let (kind, text) = match kind {
        0 => (NoteKind::Text, text),
        1 => (NoteKind::Dropped(frames), text),
        2 => (NoteKind::CanXl, text),
        3 => (NoteKind::Unreadable(words.to_owned()), bytes),
        got => return Err(CdrError::Value { what: "kind", got: got.into(), allowed: "0 to 3" }),
    };
    Ok(CaptureNote { kind, nanos, interface, line, text })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::NANOS_PER_SECOND;
    use proptest::prelude::*;
    use protocol::can::{EXTENDED_MASK, STANDARD_MASK};

    fn back_and_forth(record: Record<'_>) -> Result<Record<'_>, CdrError> {
        let mut buffer = Vec::new();
        record.encode_into(&mut buffer);
        let back = decode_frame(&buffer, record.time)?;
        assert_eq!(back.interface, record.interface);
        Ok(Record { interface: record.interface, ..back })
    }

    #[test]
    fn a_frame_stands_byte_for_byte_where_the_definition_says() {
        let frame = Frame::fd(0x22C, 1, &[0xAA, 0xBB]).unwrap();
        let time = Timestamp::with_nine_digits(5 * NANOS_PER_SECOND + 7);
        let record = Record { time, interface: "vcan0", frame, direction: Some(Direction::Sent) };
        let mut buffer = Vec::new();
        record.encode_into(&mut buffer);
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
        let time = Timestamp::with_nine_digits(0);
        let record = Record { time, interface: "", frame: Frame::EMPTY, direction: None };
        let mut buffer = Vec::new();
        record.encode_into(&mut buffer);
        let with = |at: usize, value: u8| {
            let mut bytes = buffer.clone();
            bytes[at] = value;
            decode_frame(&bytes, time).map(|_| ()).unwrap_err().to_string()
        };
        // An empty name takes 5 bytes, and 3 bytes of padding follow it.
        let id = "id of a message: FF000000 does not fit an identifier of 11 bits: at most 7FF";
        assert_eq!(with(23, 0xFF), id);
        assert!(with(21, 8).ends_with("800 does not fit an identifier of 11 bits: at most 7FF"));
        assert!(with(28, 1).starts_with("flags of a message is 1; allowed: 0 to 15 in an FD frame"));
        assert!(with(30, 14).starts_with("raw_dlc of a message is 14; allowed: 0; 9 to 15"));
        let time = "the time of a message is -1 s and 0 ns: seconds must not be negative, and nanoseconds must be \
                    from 0 to 999999999";
        assert_eq!(back_from_1969(&buffer), time);
        assert!(with(29, 1).starts_with("length of a message is 1; allowed: the length of the data"));
        assert!(with(31, 3).starts_with("direction of a message is 3; allowed: 0, 1 or 2"));
    }

    fn back_from_1969(message: &[u8]) -> String {
        let mut bytes = message.to_vec();
        bytes[4..8].copy_from_slice(&(-1_i32).to_le_bytes());
        decode_frame(&bytes, Timestamp::with_nine_digits(0)).map(|_| ()).unwrap_err().to_string()
    }

    fn note(kind: NoteKind, text: &[u8]) -> CaptureNote<'_> {
        CaptureNote { kind, nanos: 42, interface: "can0", line: 7, text }
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
                note.encode_into(&mut buffer);
                assert_eq!(decode_note(&buffer, 42).unwrap(), note);
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
            let time = Timestamp { nine_digits, ..Timestamp::with_six_digits(nanos) };
            let record = Record { time, interface: &interface, frame, direction };
            prop_assert_eq!(back_and_forth(record), Ok(record));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(0_u8..4, 0..80)) {
            let _ = decode_frame(&bytes, Timestamp::with_nine_digits(0));
            let _ = decode_note(&bytes, 0);
        }
    }
}
