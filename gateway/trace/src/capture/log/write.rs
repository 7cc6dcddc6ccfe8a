//! Writes the entries of a capture as a candump log.

use std::collections::{HashMap, HashSet};
use std::fmt;
use std::io::{self, Write};

use protocol::candump::{Direction, Record, Timestamp, write_record};
use protocol::usage::is_unprintable;

use crate::capture::{CaptureEntry, CaptureNote, NoteKind};

/// The size in bytes at which buffered lines are written.
const WRITE_BYTES: usize = 1 << 16;
/// The maximum size in bytes of lines that wait for the first frame. Nothing is written before the first frame, because
/// a text without frames is not a log.
const MAX_WAITING_BYTES: usize = 1 << 20;

/// The number of decimals of a time in seconds.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum TimeDigits {
    /// As many decimals as in the capture.
    #[default]
    Own,
    /// 6 decimals, candump's default.
    Six,
    /// 9 decimals, as with `candump -N`.
    Nine,
}

/// The form of the lines of a log: the decimals of times, the directions of frames, and what is left out.
#[derive(Clone, Copy, Debug, Default)]
pub struct LogStyle {
    /// The number of decimals of the times.
    pub digits: TimeDigits,
    /// True to write only frames, and no raw DLC, so that every tool can read the log.
    pub plain: bool,
    /// True to write `T` or `R` after frames whose direction is known, as `candump -x` does. Wireshark does not read
    /// such lines.
    pub directions: bool,
}

/// The result of writing an entry.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum WriteOutcome {
    /// The log holds the whole entry.
    All,
    /// The log holds the entry without some of its information.
    Less(OmittedProperties),
    /// The log omits the entry, because it is a note that was not requested or that a log cannot hold.
    Nothing,
}

/// The properties of a frame that a line of a log cannot show.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct OmittedProperties {
    /// True if digits of the time are omitted.
    pub digits: bool,
    /// True if the direction is omitted.
    pub direction: bool,
    /// True if the raw DLC is omitted.
    pub raw_dlc: bool,
    /// True if the bus has another name in the log, because a line cannot hold its own.
    pub name: bool,
}

/// Writes the entries of a capture as lines of a log.
#[derive(Debug)]
pub struct LogWriter<W> {
    out: W,
    style: LogStyle,
    /// Lines that wait to be written.
    lines: Lines,
    any_frame: bool,
    /// The number of frames that the recorder lost so far, by bus.
    lost: HashMap<String, u64>,
    names: BusNames,
}

/// A text buffer that can hold any bytes, not only UTF-8.
#[derive(Debug, Default)]
struct Lines(Vec<u8>);

impl fmt::Write for Lines {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.extend_from_slice(text.as_bytes());
        Ok(())
    }
}

/// The names that the buses have in the log.
#[derive(Debug, Default)]
struct BusNames {
    /// The bus of the last frame, and its name in the log if that differs.
    last: (String, Option<String>),
    /// Names in the log, by bus.
    written: HashMap<String, String>,
    taken: HashSet<String>,
}

impl BusNames {
    /// The maximum number of buses whose names are stored.
    const MAX_NAMES: usize = 4_096;

    /// Returns the name of `bus` in the log if it differs from its own name. Stores `bus` as the last one.
    #[inline]
    fn replacement_name(&mut self, bus: &str) -> Option<&str> {
        if self.last.0 != bus || self.taken.is_empty() {
            let written = self.assign(bus);
            self.last = (bus.to_owned(), Some(written).filter(|name| name != bus));
        }
        self.last.1.as_deref()
    }

    /// Returns a name for the bus that a line can hold and that no other bus of the log has. Blanks and control
    /// characters are replaced.
    fn assign(&mut self, bus: &str) -> String {
        if let Some(name) = self.written.get(bus) {
            return name.clone();
        }
        let is_odd = |letter: char| letter.is_whitespace() || is_unprintable(letter);
        let plain = if bus.is_empty() || bus.contains(is_odd) {
            format!("_{}", bus.replace(is_odd, "_"))
        } else {
            bus.to_owned()
        };
        let further = (2..).map(|number| format!("{plain}_{number}"));
        let mut candidates = [plain.clone()].into_iter().chain(further);
        let name = candidates.find(|name| !self.taken.contains(name)).unwrap_or_default();
        if self.taken.len() < Self::MAX_NAMES {
            self.taken.insert(name.clone());
            self.written.insert(bus.to_owned(), name.clone());
        }
        name
    }
}

impl<W: Write> LogWriter<W> {
    /// Creates a writer that buffers lines.
    pub fn new(out: W, style: LogStyle) -> Self {
        let lines = Lines(Vec::with_capacity(2 * WRITE_BYTES));
        Self { out, style, lines, any_frame: false, lost: HashMap::new(), names: BusNames::default() }
    }

    /// Writes an entry.
    ///
    /// # Errors
    /// Returns an error if `out` fails.
    pub fn write(&mut self, entry: &CaptureEntry<'_>) -> io::Result<WriteOutcome> {
        match entry {
            CaptureEntry::Frame(record) => self.write_frame(record),
            CaptureEntry::Note(_) if self.style.plain => Ok(WriteOutcome::Nothing),
            CaptureEntry::Note(note) => self.write_note(note),
        }
    }

    fn write_frame(&mut self, record: &Record<'_>) -> io::Result<WriteOutcome> {
        let Record { time, interface, frame, direction } = *record;
        let Timestamp { nanos, nine_digits: own, .. } = time;
        let nine_digits = match self.style.digits {
            TimeDigits::Own => own,
            TimeDigits::Six => false,
            TimeDigits::Nine => true,
        };
        let mut less =
            OmittedProperties { digits: !nine_digits && nanos % 1_000 != 0, ..OmittedProperties::default() };
        let mut written = Record { time: Timestamp { nine_digits, ..time }, interface, frame, direction };
        let mut way = match direction {
            None => "",
            Some(Direction::Sent) => " T",
            Some(Direction::Received) => " R",
        };
        if !self.style.directions {
            less.direction = !way.is_empty();
            way = "";
        }
        if self.style.plain {
            less.raw_dlc = frame.raw_dlc() != 0;
            written.frame = frame.with_raw_dlc(0);
        }
        if let Some(name) = self.names.replacement_name(interface) {
            written.interface = name;
            less.name = true;
        }
        self.any_frame = true;
        // Writing to memory cannot fail.
        let _ = write_record(&mut self.lines, &written);
        self.lines.0.extend_from_slice(way.as_bytes());
        self.end_line()?;
        Ok(if less == OmittedProperties::default() { WriteOutcome::All } else { WriteOutcome::Less(less) })
    }

    /// Writes a note: a line of a log unchanged, and a note of a recording as candump's message on lost frames or as a
    /// comment.
    fn write_note(&mut self, note: &CaptureNote<'_>) -> io::Result<WriteOutcome> {
        let lines = &mut self.lines.0;
        match note.kind {
            // A line feed within the text would begin a further line, which the source does not have.
            _ if note.line > 0 => {
                let ends = |byte: &u8| if matches!(byte, b'\n' | b'\r') { b' ' } else { *byte };
                lines.extend(note.text.iter().map(ends));
            }
            NoteKind::Dropped(frames) => {
                let total = self.lost.entry(note.interface.to_owned()).or_default();
                *total = total.saturating_add(frames);
                let (bus, s) =
                    (self.names.replacement_name(note.interface), if frames == 1 { "" } else { "s" });
                let bus = bus.filter(|_| !note.interface.is_empty()).unwrap_or(note.interface);
                let text = format!(
                    "DROPCOUNT: dropped {frames} CAN frame{s} on '{bus}' socket (total drops {total})"
                );
                lines.extend_from_slice(text.as_bytes());
            }
            NoteKind::Text => {
                let text = String::from_utf8_lossy(note.text).replace(is_unprintable, " ");
                lines.extend_from_slice(b"# ");
                lines.extend_from_slice(text.as_bytes());
            }
            NoteKind::CanXl | NoteKind::Unreadable(_) => return Ok(WriteOutcome::Nothing),
        }
        self.end_line()?;
        Ok(WriteOutcome::All)
    }

    fn end_line(&mut self) -> io::Result<()> {
        self.lines.0.push(b'\n');
        let most = if self.any_frame { WRITE_BYTES } else { MAX_WAITING_BYTES };
        if self.lines.0.len() < most { Ok(()) } else { self.write_buffer() }
    }

    fn write_buffer(&mut self) -> io::Result<()> {
        self.out.write_all(&self.lines.0)?;
        self.lines.0.clear();
        Ok(())
    }

    /// Writes the buffered lines to the output if there was a frame before.
    ///
    /// # Errors
    /// Returns an error if `out` fails.
    pub fn flush_lines(&mut self) -> io::Result<()> {
        if self.any_frame { self.flush() } else { Ok(()) }
    }

    /// Flushes the buffer.
    ///
    /// # Errors
    /// Returns an error if `out` fails.
    pub fn flush(&mut self) -> io::Result<()> {
        self.write_buffer()?;
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::candump::{CandumpLine, parse};

    fn written(style: LogStyle, entries: &[CaptureEntry<'_>]) -> (String, Vec<WriteOutcome>) {
        let mut bytes = Vec::new();
        let mut log = LogWriter::new(&mut bytes, style);
        let wrote = entries.iter().map(|entry| log.write(entry).unwrap()).collect();
        log.flush().unwrap();
        (String::from_utf8_lossy(&bytes).into_owned(), wrote)
    }

    fn frame(line: &str) -> CaptureEntry<'_> {
        let Ok(CandumpLine::Frame(record)) = parse(line) else { panic!("{line}") };
        CaptureEntry::Frame(record)
    }

    fn note(kind: NoteKind, line: u64, text: &[u8]) -> CaptureEntry<'_> {
        CaptureEntry::Note(CaptureNote { kind, nanos: 0, interface: "vcan0", line, text })
    }

    #[test]
    fn a_frame_is_written_as_it_was_or_as_was_requested() {
        let line = "(1.000000007) can0 123#1122334455667788_A T";
        let style = |digits, plain| LogStyle { digits, plain, directions: !plain };
        let as_is = |line: &str| (format!("{line}\n"), vec![WriteOutcome::All]);
        assert_eq!(written(style(TimeDigits::Own, false), &[frame(line)]), as_is(line));
        let less = OmittedProperties::default();
        let bare = (
            line.replace(" T", "\n"),
            vec![WriteOutcome::Less(OmittedProperties { direction: true, ..less })],
        );
        assert_eq!(written(LogStyle::default(), &[frame(line)]), bare);
        let six = (
            "(1.000000) can0 123#1122334455667788_A T\n".to_owned(),
            vec![WriteOutcome::Less(OmittedProperties { digits: true, ..less })],
        );
        assert_eq!(written(style(TimeDigits::Six, false), &[frame(line)]), six);
        let less = OmittedProperties { direction: true, raw_dlc: true, ..less };
        let plain = ("(1.000000007) can0 123#1122334455667788\n".to_owned(), vec![WriteOutcome::Less(less)]);
        assert_eq!(written(style(TimeDigits::Own, true), &[frame(line)]), plain);
        let short = frame("(1.000001) can0 123#");
        assert_eq!(written(style(TimeDigits::Nine, true), &[short]), as_is("(1.000001000) can0 123#"));
    }

    #[test]
    fn lines_of_a_log_are_written_as_they_were() {
        let entries = [
            note(NoteKind::Text, 1, b" # odd  "),
            note(NoteKind::Unreadable("column 2".to_owned()), 2, b"(\xFF"),
            note(NoteKind::Dropped(3), 3, b"DROPCOUNT: dropped 3 of them"),
            note(NoteKind::CanXl, 4, b"(1.0) xl"),
        ];
        let mut bytes = Vec::new();
        let mut log = LogWriter::new(&mut bytes, LogStyle::default());
        for entry in &entries {
            assert_eq!(log.write(entry).unwrap(), WriteOutcome::All);
        }
        log.flush().unwrap();
        assert_eq!(bytes, b" # odd  \n(\xFF\nDROPCOUNT: dropped 3 of them\n(1.0) xl\n");
        let plain = LogStyle { plain: true, ..LogStyle::default() };
        assert_eq!(written(plain, &entries), (String::new(), vec![WriteOutcome::Nothing; 4]));
    }

    #[test]
    fn a_recordings_own_notes_are_written_in_candumps_words() {
        let entries = [
            note(NoteKind::Dropped(3), 0, b"3 frames did not fit a queue"),
            note(NoteKind::Dropped(1), 0, b""),
            note(NoteKind::Text, 0, b"two\n\x1blines"),
            note(NoteKind::Unreadable("a message is too short".to_owned()), 0, b"\0"),
        ];
        let (text, wrote) = written(LogStyle::default(), &entries);
        let expected = "DROPCOUNT: dropped 3 CAN frames on 'vcan0' socket (total drops 3)\n\
                        DROPCOUNT: dropped 1 CAN frame on 'vcan0' socket (total drops 4)\n\
                        # two  lines\n";
        assert_eq!(text, expected);
        assert_eq!(wrote, [WriteOutcome::All, WriteOutcome::All, WriteOutcome::All, WriteOutcome::Nothing]);
    }

    #[test]
    fn a_bus_whose_name_no_line_can_have_gets_another_that_is_its_own() {
        let CaptureEntry::Frame(record) = frame("(1.000000) can0 123#") else { panic!() };
        let names = [
            "",
            "my bus",
            "my\tbus",
            "_my_bus",
            "\u{1b}[31mred",
            "c\r@n",
            "a\0b",
            "a\u{202e}b",
            "can0",
            "my bus",
        ];
        let expected = [
            "_",
            "_my_bus",
            "_my_bus_2",
            "_my_bus_3",
            "__[31mred",
            "_c_@n",
            "_a_b",
            "_a_b_2",
            "can0",
            "_my_bus",
        ];
        let entries = names.map(|interface| CaptureEntry::Frame(Record { interface, ..record }));
        let (text, wrote) = written(LogStyle::default(), &entries);
        let lines = expected.map(|name| format!("(1.000000) {name} 123#"));
        assert_eq!(text.lines().collect::<Vec<_>>(), lines);
        let other = WriteOutcome::Less(OmittedProperties { name: true, ..OmittedProperties::default() });
        let is_other = names
            .iter()
            .zip(expected)
            .map(|(bus, name)| if *bus == name { WriteOutcome::All } else { other });
        assert_eq!(wrote, is_other.collect::<Vec<_>>());
    }

    #[test]
    fn nothing_is_written_before_the_first_frame() {
        let mut bytes = Vec::new();
        let mut log = LogWriter::new(&mut bytes, LogStyle::default());
        log.write(&note(NoteKind::Text, 1, b"words")).unwrap();
        log.flush_lines().unwrap();
        assert!(log.out.is_empty());
        log.write(&frame("(1.000000) can0 123#")).unwrap();
        log.flush_lines().unwrap();
        assert_eq!(log.out, b"words\n(1.000000) can0 123#\n");
    }
}
