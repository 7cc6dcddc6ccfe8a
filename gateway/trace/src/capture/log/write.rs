//! Captures as candump text: written.

use std::collections::HashMap;
use std::io::{self, Write};

use protocol::candump::{Direction, Record, Timestamp, write_record};

use crate::capture::{Entry, Note, NoteKind};

/// Bytes that are written together.
const PIECE: usize = 1 << 16;

/// How many digits of a second are written.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Digits {
    /// As many as the capture has.
    #[default]
    Own,
    /// 6, as candump does unless told otherwise.
    Six,
    /// 9, as `candump -N` does.
    Nine,
}

/// What a log is to look like.
#[derive(Clone, Copy, Debug, Default)]
pub struct Style {
    /// Digits of a second.
    pub digits: Digits,
    /// Only what every tool reads: frames, without raw DLC.
    pub plain: bool,
    /// `T` or `R` behind frames whose direction is known, as `candump -x` does. Wireshark does not read that.
    pub directions: bool,
}

/// What became of an entry.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Wrote {
    /// All of it is in the log.
    All,
    /// Its line is shorter than what is known: digits, direction or raw DLC are left out, as was asked for.
    Less,
    /// It is not in the log: a note that was not asked for, or that a log has no place for.
    Nothing,
}

/// Writes entries as lines.
#[derive(Debug)]
pub struct LogWriter<W> {
    out: W,
    style: Style,
    /// Lines that wait to be written.
    lines: String,
    /// Frames that were lost so far, by bus.
    lost: HashMap<String, u64>,
}

impl<W: Write> LogWriter<W> {
    /// Writes to `out`, many lines at once.
    pub fn new(out: W, style: Style) -> Self {
        Self { out, style, lines: String::with_capacity(2 * PIECE), lost: HashMap::new() }
    }

    /// Writes an entry.
    ///
    /// # Errors
    /// When `out` fails.
    pub fn write(&mut self, entry: &Entry<'_>) -> io::Result<Wrote> {
        match entry {
            Entry::Frame(record) => self.frame(record),
            Entry::Note(_) if self.style.plain => Ok(Wrote::Nothing),
            Entry::Note(note) => self.note(note),
        }
    }

    fn frame(&mut self, record: &Record<'_>) -> io::Result<Wrote> {
        let Record { time, interface, frame, direction } = *record;
        let Timestamp { nanos, nine_digits: own, .. } = time;
        let nine_digits = match self.style.digits {
            Digits::Own => own,
            Digits::Six => false,
            Digits::Nine => true,
        };
        let mut less = !nine_digits && nanos % 1_000 != 0;
        let mut written = Record { time: Timestamp { nine_digits, ..time }, interface, frame, direction };
        let mut way = match direction {
            None => "",
            Some(Direction::Sent) => " T",
            Some(Direction::Received) => " R",
        };
        if !self.style.directions {
            less |= !way.is_empty();
            way = "";
        }
        if self.style.plain {
            less |= frame.raw_dlc() != 0;
            written.frame = frame.with_raw_dlc(0);
        }
        let name;
        if interface.is_empty() || interface.contains(|byte: char| byte.is_whitespace()) {
            // No line can have it; what another recording calls a bus may be anything.
            name = format!("_{interface}").replace(char::is_whitespace, "_");
            written.interface = &name;
            less = true;
        }
        // A string takes everything.
        let _ = write_record(&mut self.lines, &written);
        self.lines.push_str(way);
        self.end_line()?;
        Ok(if less { Wrote::Less } else { Wrote::All })
    }

    /// A line of a log as it was; what a recording says itself in candump's words, or as a comment.
    fn note(&mut self, note: &Note<'_>) -> io::Result<Wrote> {
        let text = String::from_utf8_lossy(note.text);
        match note.kind {
            _ if note.line > 0 => {
                if let Ok(text) = str::from_utf8(note.text) {
                    self.lines.push_str(text);
                } else {
                    self.put()?;
                    self.out.write_all(note.text)?;
                }
            }
            NoteKind::Dropped(frames) => {
                let total = self.lost.entry(note.interface.to_owned()).or_default();
                *total = total.saturating_add(frames);
                let (bus, s) = (note.interface, if frames == 1 { "" } else { "s" });
                self.lines += &format!(
                    "DROPCOUNT: dropped {frames} CAN frame{s} on '{bus}' socket (total drops {total})"
                );
            }
            NoteKind::Text => {
                self.lines.push_str("# ");
                self.lines.push_str(&text.replace(['\n', '\r'], " "));
            }
            NoteKind::CanXl | NoteKind::Unreadable(_) => return Ok(Wrote::Nothing),
        }
        self.end_line()?;
        Ok(Wrote::All)
    }

    fn end_line(&mut self) -> io::Result<()> {
        self.lines.push('\n');
        if self.lines.len() < PIECE { Ok(()) } else { self.put() }
    }

    fn put(&mut self) -> io::Result<()> {
        self.out.write_all(self.lines.as_bytes())?;
        self.lines.clear();
        Ok(())
    }

    /// Hands on what waits.
    ///
    /// # Errors
    /// When `out` fails.
    pub fn flush(&mut self) -> io::Result<()> {
        self.put()?;
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::candump::{Line, parse};

    fn written(style: Style, entries: &[Entry<'_>]) -> (String, Vec<Wrote>) {
        let mut bytes = Vec::new();
        let mut log = LogWriter::new(&mut bytes, style);
        let wrote = entries.iter().map(|entry| log.write(entry).unwrap()).collect();
        log.flush().unwrap();
        (String::from_utf8_lossy(&bytes).into_owned(), wrote)
    }

    fn frame(line: &str) -> Entry<'_> {
        let Ok(Line::Frame(record)) = parse(line) else { panic!("{line}") };
        Entry::Frame(record)
    }

    fn note(kind: NoteKind, line: u64, text: &[u8]) -> Entry<'_> {
        Entry::Note(Note { kind, nanos: 0, interface: "vcan0", line, text })
    }

    #[test]
    fn a_frame_is_written_as_it_was_or_as_was_requested() {
        let line = "(1.000000007) can0 123#1122334455667788_A T";
        let style = |digits, plain| Style { digits, plain, directions: !plain };
        let as_is = |line: &str| (format!("{line}\n"), vec![Wrote::All]);
        assert_eq!(written(style(Digits::Own, false), &[frame(line)]), as_is(line));
        let bare = (line.replace(" T", "\n"), vec![Wrote::Less]);
        assert_eq!(written(Style::default(), &[frame(line)]), bare);
        let six = ("(1.000000) can0 123#1122334455667788_A T\n".to_owned(), vec![Wrote::Less]);
        assert_eq!(written(style(Digits::Six, false), &[frame(line)]), six);
        let plain = ("(1.000000007) can0 123#1122334455667788\n".to_owned(), vec![Wrote::Less]);
        assert_eq!(written(style(Digits::Own, true), &[frame(line)]), plain);
        let short = frame("(1.000001) can0 123#");
        assert_eq!(written(style(Digits::Nine, true), &[short]), as_is("(1.000001000) can0 123#"));
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
        let mut log = LogWriter::new(&mut bytes, Style::default());
        for entry in &entries {
            assert_eq!(log.write(entry).unwrap(), Wrote::All);
        }
        log.flush().unwrap();
        assert_eq!(bytes, b" # odd  \n(\xFF\nDROPCOUNT: dropped 3 of them\n(1.0) xl\n");
        let plain = Style { plain: true, ..Style::default() };
        assert_eq!(written(plain, &entries), (String::new(), vec![Wrote::Nothing; 4]));
    }

    #[test]
    fn a_recordings_own_notes_are_written_in_candumps_words() {
        let entries = [
            note(NoteKind::Dropped(3), 0, b"3 frames did not fit a queue"),
            note(NoteKind::Dropped(1), 0, b""),
            note(NoteKind::Text, 0, b"two\nlines"),
            note(NoteKind::Unreadable("a message is too short".to_owned()), 0, b"\0"),
        ];
        let (text, wrote) = written(Style::default(), &entries);
        let expected = "DROPCOUNT: dropped 3 CAN frames on 'vcan0' socket (total drops 3)\n\
                        DROPCOUNT: dropped 1 CAN frame on 'vcan0' socket (total drops 4)\n\
                        # two lines\n";
        assert_eq!(text, expected);
        assert_eq!(wrote, [Wrote::All, Wrote::All, Wrote::All, Wrote::Nothing]);
    }

    #[test]
    fn a_bus_whose_name_no_line_can_have_gets_another() {
        let Entry::Frame(record) = frame("(1.000000) can0 123#") else { panic!() };
        for (name, expected) in [("", "_"), ("my bus", "_my_bus")] {
            let (text, wrote) =
                written(Style::default(), &[Entry::Frame(Record { interface: name, ..record })]);
            assert_eq!((text, wrote), (format!("(1.000000) {expected} 123#\n"), vec![Wrote::Less]));
        }
    }
}
