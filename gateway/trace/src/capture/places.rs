//! Builds an index of positions in a capture. With it a reader can go to a time without reading everything before it.
//!
//! ```text
//! MCAP:  heads of chunks ─────────────────┐
//!                                         ├──> Places ── before(time) ──> Place ──> Reader::go_to
//! log:   a line of each piece of the file ┘
//! ```

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use ::mcap::records::op;
use protocol::input;

use super::log::{LogReader, MAX_LINE_BYTES as LONGEST_LINE, frame_time_in_line};
use super::magic::is_mcap;
use super::place::{IndexedFile, SeekIndex, SeekPoint};
use super::{CaptureEntry, CaptureError, Reader};
use crate::container::{MAGIC, MAX_DESCRIPTION_BYTES, seek_record};
use crate::order::REORDER_WINDOW_NS;

/// The minimum distance between two indexed positions of a file, in bytes.
const MIN_DISTANCE_BYTES: u64 = 64 << 10;
/// The maximum size of the schema and channel records that are stored for a part, in bytes.
const MAX_PART_DESCRIPTIONS_BYTES: usize = 16 << 20;
/// The number of bytes at the end of a log that are searched for its last frame.
const LAST_FRAME_SEARCH_BYTES: u64 = 4 * LONGEST_LINE as u64;

impl SeekIndex {
    /// Indexes one file, or the parts of one recording given in any order. Reads only the times of the entries.
    /// # Errors
    /// Returns [`CaptureError`] if a file cannot be read or is not seekable, or if the files are not parts of one
    /// recording.
    pub fn open(paths: &[PathBuf]) -> Result<Self, CaptureError> {
        Self::open_with_min_distance(paths, MIN_DISTANCE_BYTES)
    }

    /// Indexes the files with one position at least every `piece` bytes.
    fn open_with_min_distance(paths: &[PathBuf], piece: u64) -> Result<Self, CaptureError> {
        let mut places = Self { parts: Vec::new(), marks: Vec::new(), min_distance: piece };
        for path in Reader::order_paths(paths)? {
            let name = path.display().to_string();
            places.index_file(&path).map_err(|source| CaptureError::Io { name, source })?;
        }
        Ok(places)
    }

    fn index_file(&mut self, path: &Path) -> io::Result<()> {
        let mut file = input::open(path)?;
        if !file.metadata()?.is_file() {
            let why = "it is a stream in which this command cannot jump back: save it to a file first";
            return Err(io::Error::new(io::ErrorKind::NotSeekable, why));
        }
        self.parts.push(IndexedFile { path: path.to_owned(), descriptions: Vec::new() });
        if is_mcap(&mut file)? { self.add_mcap(file) } else { self.add_log(file) }
    }

    /// Adds a position in the last part, unless it is too close to the one before. `latest` is the latest time of all
    /// entries before the next position.
    fn add_point(&mut self, place: SeekPoint, latest: u64) {
        let place = SeekPoint { part: self.parts.len() - 1, ..place };
        let latest = latest.max(self.latest_ns());
        match self.marks.last_mut() {
            Some((of, last)) if last.part == place.part && place.offset - last.offset < self.min_distance => {
                *of = latest
            }
            _ => self.marks.push((latest, place)),
        }
    }

    fn add_mcap(&mut self, file: File) -> io::Result<()> {
        const INDEXED_RECORDS: &[u8] = &[op::CHUNK, op::MESSAGE, op::SCHEMA, op::CHANNEL, op::FOOTER];
        // A small buffer suffices, because most of the skipped records are longer than it.
        let mut from = BufReader::with_capacity(4 << 10, file);
        from.seek(SeekFrom::Start(MAGIC.len() as u64))?;
        let mut described = 0;
        while let Some((opcode, length)) = seek_record(&mut from, INDEXED_RECORDS)? {
            let at = from.stream_position()? - 9;
            let mut head = Vec::new();
            let kept = match opcode {
                op::FOOTER => break,
                op::CHUNK => 16,
                op::MESSAGE => 14,
                _ => length.min(MAX_DESCRIPTION_BYTES as u64),
            };
            (&mut from).take(kept.min(length)).read_to_end(&mut head)?;
            let rest = i64::try_from(length.saturating_sub(kept));
            if head.len() as u64 != kept || !rest.is_ok_and(|rest| from.seek_relative(rest).is_ok()) {
                break;
            }
            let time = |at: usize| {
                let bytes = head.get(at..at + 8).and_then(|bytes| bytes.try_into().ok());
                bytes.map_or(0, u64::from_le_bytes)
            };
            match opcode {
                op::CHUNK => self.add_point(SeekPoint { offset: at, ..SeekPoint::default() }, time(8)),
                op::MESSAGE => self.add_point(SeekPoint { offset: at, ..SeekPoint::default() }, time(6)),
                _ => {
                    described += head.len();
                    if let Some(part) =
                        self.parts.last_mut().filter(|_| described <= MAX_PART_DESCRIPTIONS_BYTES)
                    {
                        part.descriptions.push((opcode, head));
                    }
                }
            }
        }
        Ok(())
    }

    /// Indexes a log by one line in every piece of it. Lines of different buses may be out of order by at most the
    /// merge window, which is added to each time.
    fn add_log(&mut self, mut file: File) -> io::Result<()> {
        let length = file.metadata()?.len();
        let mut last = SeekPoint::default();
        let mut at = 0;
        while at < length {
            match find_frame_line(&mut file, at)? {
                Some((_, None)) => return self.index_by_reading(file),
                Some((offset, Some(nanos))) if at > 0 => {
                    self.add_point(last, nanos.saturating_add(REORDER_WINDOW_NS));
                    last = SeekPoint { offset, ..SeekPoint::default() };
                }
                Some(_) | None => {}
            }
            at += self.min_distance;
        }
        let mut end = Vec::new();
        file.seek(SeekFrom::Start(length.saturating_sub(LAST_FRAME_SEARCH_BYTES)))?;
        (&mut file).take(LAST_FRAME_SEARCH_BYTES).read_to_end(&mut end)?;
        let latest = end.split(|&byte| is_line_end(byte)).filter_map(|line| frame_time_in_line(line)?).max();
        self.add_point(last, latest.unwrap_or(0));
        Ok(())
    }

    /// Indexes a log by reading all of it, because its times depend on all lines before them.
    fn index_by_reading(&mut self, mut file: File) -> io::Result<()> {
        file.rewind()?;
        let part = self.parts.len() - 1;
        self.marks.retain(|(_, place)| place.part != part);
        let mut log = LogReader::new(&[], Box::new(file));
        loop {
            let (offset, line, clock) = (log.offset(), log.lines(), log.clock());
            match log.next()? {
                Some(CaptureEntry::Frame(record)) => {
                    let place = SeekPoint { offset, line, clock, ..SeekPoint::default() };
                    self.add_point(place, record.time.nanos);
                }
                Some(CaptureEntry::Note(_)) => {}
                None => return Ok(()),
            }
        }
    }
}

const fn is_line_end(byte: u8) -> bool {
    matches!(byte, b'\n' | b'\r')
}

/// Finds the first frame of a log at or after the offset `at`. Returns the offset of the line, and the time if the line
/// holds an absolute one.
fn find_frame_line(file: &mut File, at: u64) -> io::Result<Option<(u64, Option<u64>)>> {
    file.seek(SeekFrom::Start(at))?;
    let mut piece = Vec::new();
    file.take(2 * LONGEST_LINE as u64).read_to_end(&mut piece)?;
    let mut from = at;
    // The first line of a piece is incomplete, unless the piece begins the file.
    for (number, line) in piece.split_inclusive(|&byte| is_line_end(byte)).enumerate() {
        let text = line.trim_ascii_end();
        if let Some(nanos) = frame_time_in_line(text).filter(|_| number > 0 || at == 0) {
            return Ok(Some((from, nanos)));
        }
        from += line.len() as u64;
    }
    Ok(None)
}

#[cfg(test)]
mod tests;
