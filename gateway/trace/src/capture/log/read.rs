//! Reads the entries of a candump log line by line. Memory is bounded whatever the file contains.

use std::io::{self, Read};
use std::ops::Range;

use protocol::candump::{self, CandumpLine, Record};

use super::clock::{Clock, LogRemark, TimeEvidence};
use super::console::{self, ConsoleFrame, ConsoleLine, LineTime};
use crate::capture::{CaptureEntry, CaptureNote, NoteKind};
use crate::container::read_uninterrupted;

/// The maximum length of a line in bytes, with its line end: twice the longest CAN XL frame. Longer lines are cut.
pub const MAX_LINE_BYTES: usize = 8_192;
/// The number of bytes requested from the input at once. It must be a multiple of [`MAX_LINE_BYTES`].
const READ_BYTES: usize = 1 << 18;
/// The maximum size in bytes of the sample of lines before the first frame. The kind of a text without frames is
/// recognised from this sample.
const MAX_SAMPLE_BYTES: usize = 4_096;
/// The UTF-8 byte order mark, which some editors write at the beginning of a file.
const BYTE_ORDER_MARK: &[u8] = b"\xEF\xBB\xBF";

/// Reads the entries of a log.
pub(crate) struct LogReader {
    input: Box<dyn Read + Send>,
    buffer: Vec<u8>,
    /// The range of the buffer that has been read and not yet parsed.
    rest: Range<usize>,
    at_end: bool,
    /// The offset in the file of the next byte to be read into the buffer.
    taken: u64,
    /// The number of lines read so far.
    lines: u64,
    clock: Clock,
    /// The remarks on the log, each listed once.
    remarks: Vec<LogRemark>,
    /// The sample of lines before the first frame. It does not grow afterwards.
    sample: Vec<u8>,
    any_frame: bool,
}

impl LogReader {
    /// Creates a reader for an input whose first bytes, `head`, have already been read.
    pub(crate) fn new(head: &[u8], input: Box<dyn Read + Send>) -> Self {
        let mut buffer = vec![0; READ_BYTES];
        let taken = head.len() as u64;
        let head = head.strip_prefix(BYTE_ORDER_MARK).unwrap_or(head);
        for (to, from) in buffer.iter_mut().zip(head) {
            *to = *from;
        }
        let (clock, remarks, sample) = (Clock::default(), Vec::new(), Vec::new());
        let (rest, any_frame) = (0..head.len(), false);
        Self { input, buffer, rest, at_end: false, taken, lines: 0, clock, remarks, sample, any_frame }
    }

    /// Continues the line numbers of earlier logs that have `lines` lines in total.
    pub(crate) fn with_line_count(self, lines: u64) -> Self {
        Self { lines, ..self }
    }

    /// Creates a reader for an input of which bytes and lines were skipped, with the clock at that position.
    pub(crate) fn resume((bytes, lines, clock): (u64, u64, Clock), input: Box<dyn Read + Send>) -> Self {
        Self { taken: bytes, lines, clock, ..Self::new(&[], input) }
    }

    /// Returns the offset in the file of the next line.
    pub(crate) const fn offset(&self) -> u64 {
        self.taken - (self.rest.end - self.rest.start) as u64
    }

    pub(crate) const fn lines(&self) -> u64 {
        self.lines
    }

    pub(crate) const fn clock(&self) -> Clock {
        self.clock
    }

    /// Returns the remarks on the frames so far.
    pub(crate) fn remarks(&self) -> &[LogRemark] {
        &self.remarks
    }

    /// Returns the sample of the lines before the first frame.
    pub(crate) fn first_lines_sample(&self) -> &[u8] {
        &self.sample
    }

    /// Returns true if the buffer has no complete line, so that the next entry requires a read from the input.
    pub(crate) fn is_drained(&self) -> bool {
        self.buffer.get(self.rest.clone()).is_none_or(|rest| line_end(rest).is_none())
    }

    /// Returns true after the last line. May read from the input.
    pub(crate) fn is_at_its_end(&mut self) -> io::Result<bool> {
        while self.rest.is_empty() && !self.at_end {
            self.fill()?;
        }
        Ok(self.rest.is_empty())
    }

    /// Returns the next entry; each line is one entry. Never panics.
    #[inline]
    pub(crate) fn next(&mut self) -> io::Result<Option<CaptureEntry<'_>>> {
        let Some((line, long)) = self.next_line()? else { return Ok(None) };
        if self.clock.is_undecided()
            && parse_relative_time(self.buffer.get(line.clone()).unwrap_or_default()).is_some()
        {
            self.rest.start = line.start;
            self.detect_time_reference()?;
            return self.next();
        }
        self.lines += 1;
        let text = self.buffer.get(line).unwrap_or_default();
        if long {
            return Ok(Some(CaptureEntry::Note(line_note(text, long, self.clock.last_ns(), self.lines))));
        }
        if let Ok(CandumpLine::Frame(record)) = candump::parse_bytes(text) {
            self.clock.set(record.time.nanos);
            self.any_frame = true;
            return Ok(Some(CaptureEntry::Frame(record)));
        }
        let mut note = line_note(text, long, self.clock.last_ns(), self.lines);
        match console::parse(text) {
            None => {}
            Some(Ok(ConsoleLine::CanXl)) => note.kind = NoteKind::CanXl,
            Some(Ok(ConsoleLine::Frame(ConsoleFrame { stamp, interface, frame, direction, has_flags }))) => {
                let (time, remark) = self.clock.next_frame_time(stamp);
                let no_flags = (!has_flags).then_some(LogRemark::NoFlags);
                for remark in remark.into_iter().chain(no_flags) {
                    if !self.remarks.contains(&remark) {
                        self.remarks.push(remark);
                    }
                }
                self.any_frame = true;
                return Ok(Some(CaptureEntry::Frame(Record { time, interface, frame, direction })));
            }
            Some(Err(error)) => note.kind = NoteKind::Unreadable(error.to_string()),
        }
        if !self.any_frame && self.sample.len() < MAX_SAMPLE_BYTES {
            self.sample.extend_from_slice(text.get(..MAX_SAMPLE_BYTES).unwrap_or(text));
            self.sample.push(b'\n');
        }
        Ok(Some(CaptureEntry::Note(note)))
    }

    /// Determines what relative times count from, by the lines that follow in the buffer. Reads as many lines as are
    /// needed and fit.
    #[cold]
    fn detect_time_reference(&mut self) -> io::Result<()> {
        let mut evidence = TimeEvidence::default();
        let mut seen = 0;
        while !evidence.is_enough() {
            let fresh = self.buffer.get(self.rest.start + seen..self.rest.end).unwrap_or_default();
            let end = line_end(fresh);
            let line = fresh.get(..end.unwrap_or(fresh.len())).unwrap_or_default();
            if end.is_some() || self.at_end {
                if let Some((interface, nanos)) = parse_relative_time(line) {
                    evidence.add_time(interface, nanos);
                }
                seen += line.len() + 1;
            }
            if end.is_none() && (self.at_end || self.rest.len() == self.buffer.len()) {
                break;
            }
            if end.is_none() {
                self.fill()?;
            }
        }
        self.clock.set_reference(evidence.likely_reference());
        Ok(())
    }

    /// Returns the range of the next line in the buffer, without its line end, and true if the line was cut because it
    /// is too long. A line ends with a line feed, a carriage return, or both.
    #[inline]
    fn next_line(&mut self) -> io::Result<Option<(Range<usize>, bool)>> {
        let Range { start, end } = self.rest;
        let fresh = self.buffer.get(start..end).unwrap_or_default();
        match line_end(fresh) {
            Some(at) if at < MAX_LINE_BYTES => match fresh.get(at..) {
                Some([b'\r']) => self.next_unbuffered_line(),
                Some([b'\r', b'\n', ..]) => Ok(Some((self.end_line(start + at, 2), false))),
                _ => Ok(Some((self.end_line(start + at, 1), false))),
            },
            _ => self.next_unbuffered_line(),
        }
    }

    /// Consumes the next line and its line end. Returns the range of the line.
    #[inline]
    const fn end_line(&mut self, end: usize, length: usize) -> Range<usize> {
        let start = self.rest.start;
        self.rest.start = end + length;
        start..end
    }

    /// Returns the next line if the buffer does not hold all of it, or if it is too long.
    fn next_unbuffered_line(&mut self) -> io::Result<Option<(Range<usize>, bool)>> {
        let mut seen = 0;
        loop {
            let Range { start, end } = self.rest;
            let fresh = self.buffer.get(start + seen..end).unwrap_or_default();
            // The search for a line end stops at the maximum length of a line.
            let within = fresh.get(..MAX_LINE_BYTES - seen).unwrap_or(fresh);
            match line_end(within).map(|at| (at, fresh.get(at..).unwrap_or_default())) {
                // The buffer ends with the carriage return; a line feed that belongs to it may follow.
                Some((at, [b'\r'])) if !self.at_end => {
                    seen += at;
                    self.fill()?;
                    continue;
                }
                Some((at, rest)) => {
                    let length = if rest.starts_with(b"\r\n") { 2 } else { 1 };
                    return Ok(Some((self.end_line(start + seen + at, length), false)));
                }
                None => {}
            }
            seen += within.len();
            if seen == MAX_LINE_BYTES {
                let line = self.skip_line(start..start + seen)?;
                return Ok(Some((line, true)));
            }
            if self.at_end || self.fill()? == 0 {
                let Range { start, end } = self.rest;
                return Ok((start < end).then(|| (self.end_line(end, 0), false)));
            }
        }
    }

    /// Skips the rest of a line that is too long; its beginning, `line`, is kept. Returns the range of the kept bytes
    /// in the buffer.
    fn skip_line(&mut self, line: Range<usize>) -> io::Result<Range<usize>> {
        self.buffer.copy_within(line.clone(), 0);
        let kept = line.len();
        let mut rest = line.end..self.rest.end;
        loop {
            if let Some(at) = self.buffer.get(rest.clone()).and_then(line_end) {
                self.rest = rest.start + at + 1..rest.end;
                return Ok(0..kept);
            }
            let room = self.buffer.get_mut(kept..).unwrap_or_default();
            let got = read_uninterrupted(&mut self.input, room)?;
            rest = kept..kept + got;
            self.taken += got as u64;
            if got == 0 {
                self.at_end = true;
                self.rest = rest;
                return Ok(0..kept);
            }
        }
    }

    /// Reads more bytes into the buffer. Returns 0 at the end of the input.
    fn fill(&mut self) -> io::Result<usize> {
        if self.rest.start > 0 {
            self.buffer.copy_within(self.rest.clone(), 0);
            self.rest = 0..self.rest.len();
        }
        let room = self.buffer.get_mut(self.rest.end..).unwrap_or_default();
        let got = read_uninterrupted(&mut self.input, room)?;
        self.rest.end += got;
        self.taken += got as u64;
        self.at_end = got == 0;
        Ok(got)
    }
}

/// Returns the offset of the first line end in a text.
#[inline]
fn line_end(text: &[u8]) -> Option<usize> {
    memchr::memchr2(b'\n', b'\r', text)
}

/// Returns the bus and the time of the frame in a line if the time is relative; `None` for other lines.
#[inline]
fn parse_relative_time(line: &[u8]) -> Option<(&str, u64)> {
    // Lines of a log have ten digits before the point.
    if line.first() == Some(&b'(') && line.get(11) == Some(&b'.') {
        return None;
    }
    match console::parse(line) {
        Some(Ok(ConsoleLine::Frame(ConsoleFrame { stamp: LineTime::Relative(time), interface, .. }))) => {
            Some((interface, time.nanos))
        }
        _ => None,
    }
}

/// Returns the time of the frame in a line, in ns since 1970. Returns `None` if the line holds no frame, and
/// `Some(None)` if the time depends on the lines before it.
pub(crate) fn frame_time_in_line(line: &[u8]) -> Option<Option<u64>> {
    let line = line.trim_ascii_end();
    if let Ok(CandumpLine::Frame(record)) = candump::parse_bytes(line) {
        return Some(Some(record.time.nanos));
    }
    match console::parse(line)?.ok()? {
        ConsoleLine::Frame(ConsoleFrame {
            stamp: LineTime::Absolute(time) | LineTime::Local(time), ..
        }) => Some(Some(time.nanos)),
        ConsoleLine::Frame(_) => Some(None),
        ConsoleLine::CanXl => None,
    }
}

/// Makes a note of a line that is not a frame. Only a line that begins with a parenthesis, as lines with frames do,
/// counts as unreadable; others are text.
#[cold]
fn line_note(text: &[u8], long: bool, nanos: u64, line: u64) -> CaptureNote<'_> {
    let why = format!("the line is longer than {MAX_LINE_BYTES} bytes; its rest was skipped");
    let kind = match candump::parse_bytes(text) {
        _ if long => NoteKind::Unreadable(why),
        Ok(CandumpLine::Frame(_) | CandumpLine::Other) => NoteKind::Text,
        Ok(CandumpLine::Dropped { frames }) => NoteKind::Dropped(frames),
        Ok(CandumpLine::CanXl) => NoteKind::CanXl,
        Err(error) => NoteKind::Unreadable(error.to_string()),
    };
    let interface = if matches!(kind, NoteKind::Dropped(_)) { quoted_bus_name(text) } else { "" };
    CaptureNote { kind, nanos, interface, line, text }
}

/// Returns the bus of candump's message on lost frames: `... frames on 'vcan0' socket ...`.
fn quoted_bus_name(text: &[u8]) -> &str {
    text.split(|&byte| byte == b'\'').nth(1).and_then(|name| core::str::from_utf8(name).ok()).unwrap_or("")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A reader that returns a fixed number of bytes at a time, as pipes do.
    struct Pieces(Vec<u8>, usize);

    impl Read for Pieces {
        fn read(&mut self, room: &mut [u8]) -> io::Result<usize> {
            let len = self.1.min(self.0.len()).min(room.len());
            for (to, from) in room.iter_mut().zip(self.0.drain(..len)) {
                *to = from;
            }
            Ok(len)
        }
    }

    /// Returns the line number, the text and the kind of each note.
    fn all(bytes: &[u8], piece: usize) -> Vec<(u64, Vec<u8>, NoteKind)> {
        let mut log = LogReader::new(&[], Box::new(Pieces(bytes.to_vec(), piece)));
        let mut all = Vec::new();
        loop {
            match log.next().unwrap() {
                Some(CaptureEntry::Note(note)) => all.push((note.line, note.text.to_vec(), note.kind)),
                Some(CaptureEntry::Frame(_)) => {}
                None => return all,
            }
        }
    }

    fn text(line: u64, text: &[u8]) -> (u64, Vec<u8>, NoteKind) {
        (line, text.to_vec(), NoteKind::Text)
    }

    #[test]
    fn lines_are_counted_and_the_last_one_needs_no_end() {
        for piece in [1, 2, 5, 1000] {
            let found = all(b"one\n\r\n(1.000000) can0 123#\n\xFF\nfive", piece);
            assert_eq!(found, [text(1, b"one"), text(2, b""), text(4, b"\xFF"), text(5, b"five")]);
            let found = all(b"one\r(1.000000) can0 123#\r\rfour\r\nfive\r", piece);
            assert_eq!(found, [text(1, b"one"), text(3, b""), text(4, b"four"), text(5, b"five")]);
            assert_eq!(all(b"", piece), []);
            assert_eq!(all(b"\n", piece), [text(1, b"")]);
        }
    }

    #[test]
    fn of_a_line_without_end_the_beginning_is_kept_and_the_next_one_is_read() {
        let long =
            || Err::<(), _>(format!("the line is longer than {MAX_LINE_BYTES} bytes; its rest was skipped"));
        for piece in [4097, READ_BYTES] {
            let mut bytes = vec![b'('; 3 * READ_BYTES];
            bytes.extend_from_slice(b"\nnext\n");
            bytes.extend_from_slice(&vec![b'x'; READ_BYTES]);
            let found = all(&bytes, piece);
            let unreadable = NoteKind::Unreadable(long().unwrap_err());
            assert_eq!(found[0], (1, vec![b'('; MAX_LINE_BYTES], unreadable.clone()));
            assert_eq!(found[1], text(2, b"next"));
            assert_eq!(found[2], (3, vec![b'x'; MAX_LINE_BYTES], unreadable));
            assert_eq!(found.len(), 3);
        }
    }

    #[test]
    fn a_line_may_be_as_long_as_the_limit_and_not_longer() {
        let line = |len: usize| [b"#".repeat(len - 1).as_slice(), b"\nnext\n"].concat();
        for piece in [1023, READ_BYTES] {
            let longest = all(&line(MAX_LINE_BYTES), piece);
            assert_eq!(longest, [text(1, &b"#".repeat(MAX_LINE_BYTES - 1)), text(2, b"next")]);
            let longer = all(&line(MAX_LINE_BYTES + 1), piece);
            assert!(matches!(longer[0].2, NoteKind::Unreadable(_)), "{:?}", longer[0].2);
            assert_eq!(longer[1..], [text(2, b"next")]);
        }
    }

    #[test]
    fn bytes_that_are_no_text_are_a_fault_only_in_a_frame() {
        let fault = NoteKind::Unreadable("column 2: expected seconds since 1970".to_owned());
        assert_eq!(all(b"(\xff\n\xff\n", 100), [(1, b"(\xff".to_vec(), fault), text(2, b"\xFF")]);
    }

    #[test]
    fn a_note_has_the_time_of_the_frame_before_it_and_a_loss_its_bus() {
        let bytes =
            b"# a\n(2.000001) can0 123#\nDROPCOUNT: dropped 3 CAN frames on 'can7' socket (total drops 9)\n";
        let mut log = LogReader::new(&[], Box::new(&bytes[..]));
        let mut notes = Vec::new();
        while let Some(entry) = log.next().unwrap() {
            if let CaptureEntry::Note(note) = entry {
                notes.push((note.line, note.nanos, note.interface.to_owned(), note.kind));
            }
        }
        let lost = (3, 2_000_001_000, "can7".to_owned(), NoteKind::Dropped(3));
        assert_eq!(notes, [(1, 0, String::new(), NoteKind::Text), lost]);
    }
}
