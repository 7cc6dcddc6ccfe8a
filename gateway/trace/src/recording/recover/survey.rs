//! Finds the intact records of a damaged file.
//!
//! ```text
//!   magic │ head │ chunk │ index │ ch#nk │ index │ chunk │ … │ summary │ footer
//!   ──────┴──────┴───────┴───────┼───────┼───────┴───────┴───┴─────────┴───────
//!              a piece           └ wrong ┘        a piece      found from its end
//! ```

use std::collections::VecDeque;
use std::io::{self, Read, Seek, SeekFrom};

use mcap::records::op;

use super::described::{DescriptionSet, DescriptionTrust};
use super::{MAX_ATTACHMENT_BYTES, RecoverError, RecoveryResult};
use crate::container::{
    Chunk, FormatError, FramedRecord, MAGIC, MAX_RECORD_BYTES, RECORD_HEADER_BYTES, Record, RecordReader,
    can_begin_record, first_record, parse,
};

/// The number of records before a wrong one that are examined again, because their lengths may have been wrong.
const MAX_UNSURE_RECORDS: usize = 4;

/// The length of a footer record in bytes.
const FOOTER_BYTES: usize = 29;

/// A part of the file that can be copied.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum IntactRange {
    /// All records from one offset to another.
    Records { from: u64, to: u64 },
    /// A record whose length field is wrong, with the length computed from its contents.
    Record { at: u64, code: u8, length: u64 },
}

/// The intact parts of a damaged file, and its schemas and channels.
#[derive(Debug, Default)]
pub(super) struct FileSurvey {
    pub(super) profile: String,
    pub(super) pieces: Vec<IntactRange>,
    pub(super) described: DescriptionSet,
    pub(super) recovered: RecoveryResult,
}

/// The summary section of a file, which is found from the end of the file.
struct SummarySection {
    /// The offset at which the data section ends.
    data_end: u64,
    /// The number of messages according to the statistics.
    stated: Option<u64>,
    /// False if the checksum of the summary is wrong.
    is_right: bool,
}

/// The result of examining a record.
enum ExaminedRecord {
    /// The record is intact.
    Intact,
    /// The record is intact except for its operation code or one of its lengths. The fields are the correct operation
    /// code, the length of the contents, and the offset of the record's end.
    WrongLength(u8, u64, u64),
    /// The data section or the file ends with this record.
    End,
    /// The record looks like the end of the data section, but other records follow it. The source is positioned at
    /// them.
    FalseEnd,
    /// The record is wrong. `end` is where it ends by its length field, if that may be correct. From `rows` on, several
    /// records in a row are accepted as intact; before it they may be inside of a damaged, uncompressed chunk.
    Damaged { end: Option<u64>, rows: u64 },
}

/// The state of a survey while the file is read.
struct Surveyor<R> {
    source: RecordReader<R>,
    size: u64,
    /// The latest offset at which the data section can end.
    limit: u64,
    /// True if the file ends with the magic bytes.
    has_magic: bool,
    chunk: Chunk,
    survey: FileSurvey,
    /// The last records whose lengths are not confirmed by a checksum. Each has its offset, and the offset from which
    /// several records in a row are accepted inside of it.
    unsure: VecDeque<(u64, u64)>,
}

impl FileSurvey {
    /// Surveys a file.
    pub(super) fn new(from: impl Read + Seek) -> Result<Self, RecoverError> {
        let mut source = RecordReader::new(from, MAX_ATTACHMENT_BYTES);
        let is_begun = source.read_magic().map_err(RecoverError::Read)?;
        let first = source.body().to_vec();
        let size = source.size().map_err(RecoverError::Read)?;
        if !is_begun && first.len() < MAGIC.len() && MAGIC.starts_with(&first) {
            return Err(RecoverError::Empty(size));
        }
        let (chunk, survey) = (Chunk::default(), Self::default());
        let mut surveyor =
            Surveyor { source, size, limit: size, has_magic: false, chunk, survey, unsure: VecDeque::new() };
        let done = surveyor.run(is_begun).map_err(RecoverError::Read)?;
        match done {
            false => Err(RecoverError::NoMcap { got: first }),
            true if surveyor.survey.pieces.is_empty() => Err(RecoverError::Empty(size)),
            true => Ok(surveyor.survey),
        }
    }
}

impl<R: Read + Seek> Surveyor<R> {
    /// Surveys the whole file. Returns true if the file is an MCAP recording.
    fn run(&mut self, is_begun: bool) -> io::Result<bool> {
        let summary = self.summary()?;
        let mut at = MAGIC.len() as u64;
        if !is_begun {
            let known = summary.is_some() || self.is_header(at)?;
            if !known {
                // A chunk proves that the file is a recording. Other records may stand before the chunk.
                let Some(certain) = self.find_first_record(0, self.size, false)? else { return Ok(false) };
                at = self.find_first_record(0, certain, true)?.unwrap_or(certain);
            }
            self.count_lost(at);
        }
        if let Some(summary) = &summary {
            (self.limit, self.survey.recovered.stated) = (summary.data_end, summary.stated);
            self.survey.recovered.is_checksum_wrong |= !summary.is_right;
        }
        self.source.seek(at)?;
        let mut is_ended = false;
        while self.source.bytes_read() < self.limit {
            let began = self.source.bytes_read();
            match self.examine()? {
                ExaminedRecord::Intact => self.add_intact(began),
                ExaminedRecord::WrongLength(code, length, end) => {
                    self.survey.pieces.push(IntactRange::Record { at: began, code, length });
                    self.count_lost(0);
                    self.unsure.clear();
                    self.source.seek(end)?;
                }
                ExaminedRecord::End => {
                    is_ended = true;
                    break;
                }
                ExaminedRecord::FalseEnd => {}
                ExaminedRecord::Damaged { end, rows } => {
                    if !self.resume_after_damage(began, end, rows)? {
                        break;
                    }
                }
            }
        }
        self.survey.recovered.has_end |= summary.is_some();
        // The checksum of the data section is missing with the record that should end the section.
        self.survey.recovered.is_checksum_wrong |= summary.is_some() && !is_ended;
        Ok(true)
    }

    /// Returns true if a header record begins at `at`.
    fn is_header(&mut self, at: u64) -> io::Result<bool> {
        self.source.seek(at)?;
        let framed = self.source.next()?;
        let is_header = framed == FramedRecord::Record(op::HEADER) && self.source.check(framed).is_ok();
        let end = self.source.bytes_read();
        Ok(is_header && can_begin_record(self.source.input(), end, self.size)?)
    }

    fn find_first_record(&mut self, from: u64, until: u64, any: bool) -> io::Result<Option<u64>> {
        first_record(self.source.input(), from, until, any)
    }

    /// Returns the offset of the first record: a chunk or attachment at or after `from`, or several records in a row at
    /// or after `rows`.
    fn find_record_or_row(&mut self, from: u64, rows: u64, until: u64) -> io::Result<Option<u64>> {
        match self.find_first_record(from, rows.min(until), false)? {
            None => self.find_first_record(rows, until, true),
            found => Ok(found),
        }
    }

    /// Counts a damaged place at which `bytes` bytes were lost.
    fn count_lost(&mut self, bytes: u64) {
        self.survey.recovered.damaged.0 += 1;
        self.survey.recovered.damaged.1 += bytes;
    }

    /// Adds a record that begins at `began` and ends at the source's position to the intact parts.
    fn add_intact(&mut self, began: u64) {
        let to = self.source.bytes_read();
        match self.survey.pieces.last_mut() {
            Some(IntactRange::Records { to: end, .. }) if *end == began => *end = to,
            _ => self.survey.pieces.push(IntactRange::Records { from: began, to }),
        }
    }

    /// Reads and examines the next record.
    fn examine(&mut self) -> io::Result<ExaminedRecord> {
        let framed = self.source.next()?;
        let (began, end) = (self.source.record_offset(), self.source.bytes_read());
        let checked = self.source.check(framed);
        let content = began + RECORD_HEADER_BYTES as u64;
        // Compressed data does not look like records. If bytes are missing in a chunk, the records after it have moved
        // forward into the range that the chunk's length spans.
        let own = self.source.uncompressed_chunk_length();
        let rows = own.map_or(0, |own| content.saturating_add(own));
        let wrong = ExaminedRecord::Damaged { end: Some(end), rows };
        let code = match framed {
            FramedRecord::End(_) => return Ok(ExaminedRecord::Damaged { end: None, rows: 0 }),
            FramedRecord::Unknown(_, length) => {
                let end = content.checked_add(length).filter(|by_length| *by_length == end);
                return Ok(ExaminedRecord::Damaged { end, rows: 0 });
            }
            FramedRecord::Truncated(code, _) => {
                let found = self.examine_by_content(code, &checked)?;
                return Ok(found.unwrap_or(ExaminedRecord::Damaged { end: None, rows }));
            }
            FramedRecord::Record(code)
            | FramedRecord::Skipped(code, _)
            | FramedRecord::Oversized(code, _) => code,
        };
        if let Err(FormatError::Swallowed(_)) = checked {
            return Ok(ExaminedRecord::Damaged { end: None, rows: 0 });
        }
        if checked.is_err() {
            return Ok(self.examine_by_content(code, &checked)?.unwrap_or(wrong));
        }
        match (framed, code) {
            (FramedRecord::Record(_), op::DATA_END) => return self.examine_data_end(began),
            (FramedRecord::Record(_), op::FOOTER) => {
                let ends = end + MAGIC.len() as u64 == self.size && self.source.read_magic()?;
                self.survey.recovered.has_end |= ends;
                return Ok(if ends { ExaminedRecord::End } else { wrong });
            }
            (FramedRecord::Record(_), _) if self.check_contents(code).is_err() => return Ok(wrong),
            (FramedRecord::Oversized(..), _) => return Ok(wrong),
            _ => {}
        }
        match code {
            op::CHUNK if self.chunk.has_checksum() => self.unsure.clear(),
            op::ATTACHMENT if !self.source.body().ends_with(&[0; 4]) => self.unsure.clear(),
            op::CHUNK | op::ATTACHMENT => self.queue_unsure_record(began, end),
            _ => self.queue_unsure_record(began, content),
        }
        Ok(ExaminedRecord::Intact)
    }

    /// Stores a record whose length is not confirmed by a checksum, to be examined again if the next record is wrong.
    fn queue_unsure_record(&mut self, began: u64, rows: u64) {
        if self.unsure.len() == MAX_UNSURE_RECORDS {
            self.unsure.pop_front();
        }
        self.unsure.push_back((began, rows));
    }

    /// Returns the last record with the length of its contents if only its length field is wrong.
    fn examine_by_content(
        &mut self,
        code: u8,
        checked: &Result<(), FormatError>,
    ) -> io::Result<Option<ExaminedRecord>> {
        let &Err(FormatError::Length { own, bytes, .. }) = checked else { return Ok(None) };
        let content = self.source.record_offset() + RECORD_HEADER_BYTES as u64;
        let limit = if code == op::ATTACHMENT { MAX_ATTACHMENT_BYTES } else { MAX_RECORD_BYTES };
        let end = content + own.min(limit + 1);
        if own > limit || end > self.limit || matches!(code, op::DATA_END | op::FOOTER) {
            return Ok(None);
        }
        // Either the length field or the lengths in the contents may be wrong. Other records follow after the correct
        // length, but not after the wrong one.
        let by_length = content.saturating_add(bytes);
        let is_shorter = by_length < end && can_begin_record(self.source.input(), by_length, self.limit)?;
        // Chunks and attachments have two lengths in their contents, which prove that they are complete.
        let is_sure = matches!(code, op::CHUNK | op::ATTACHMENT);
        if !is_sure && !can_begin_record(self.source.input(), end, self.limit)? {
            return Ok(None);
        }
        let is_right = self.source.read_with_length(content - RECORD_HEADER_BYTES as u64, own)?
            && self.check_contents(code).is_ok();
        let end = if is_shorter { by_length } else { end };
        Ok(is_right.then_some(ExaminedRecord::WrongLength(code, own, end)))
    }

    /// Checks the record that was read last. Collects the schemas and channels in it.
    fn check_contents(&mut self, code: u8) -> Result<(), FormatError> {
        let Self { source, chunk, survey, .. } = self;
        let FileSurvey { described, profile, .. } = survey;
        let body = source.body();
        if code != op::CHUNK {
            if let Record::Header { profile: of_file, .. } = parse(code, body)? {
                of_file.clone_into(profile);
            }
            return described.add(code, body, DescriptionTrust::Unchecked);
        }
        chunk.unpack(body, source.bytes_read())?;
        while let Some((code, body)) = chunk.next() {
            parse(code, body)?;
        }
        chunk.rewind();
        let trust =
            if chunk.has_checksum() { DescriptionTrust::Certain } else { DescriptionTrust::Unchecked };
        while let Some((code, body)) = chunk.next() {
            if matches!(code, op::SCHEMA | op::CHANNEL) {
                described.add(code, body, trust)?;
            }
        }
        Ok(())
    }

    /// Handles a record that ends the data section. If other records follow it, it is damage that looks like the end.
    fn examine_data_end(&mut self, began: u64) -> io::Result<ExaminedRecord> {
        let checked = self.source.check_section_checksum(op::DATA_END).is_ok();
        let end = self.source.bytes_read();
        if self.limit < self.size && end < self.limit {
            return Ok(ExaminedRecord::Damaged { end: Some(end), rows: 0 });
        }
        self.survey.recovered.is_checksum_wrong |= !checked;
        if self.limit < self.size {
            return Ok(ExaminedRecord::End);
        }
        self.source.begin_summary();
        let (mut all, mut of_all) = (Vec::new(), DescriptionTrust::Doubtful);
        loop {
            let framed = self.source.next()?;
            if self.source.check(framed).is_err() {
                break;
            }
            match framed {
                FramedRecord::Record(code @ (op::SCHEMA | op::CHANNEL)) => {
                    all.push((code, self.source.body().to_vec()));
                }
                FramedRecord::Record(op::FOOTER) => {
                    let has_none = self.source.body().ends_with(&[0; 4]);
                    let is_right = self.source.check_section_checksum(op::FOOTER).is_ok();
                    self.survey.recovered.is_checksum_wrong |= !is_right;
                    of_all = summary_trust(is_right, has_none);
                    self.survey.recovered.has_end = self.source.read_magic()?;
                    break;
                }
                FramedRecord::Skipped(..) => {}
                FramedRecord::Record(_)
                | FramedRecord::Oversized(..)
                | FramedRecord::Unknown(..)
                | FramedRecord::Truncated(..)
                | FramedRecord::End(_) => break,
            }
        }
        for (code, body) in all {
            // Descriptions that cannot be decoded are ignored.
            let _ = self.survey.described.add(code, &body, of_all);
        }
        self.source.end_summary();
        let Some(more) = self.find_first_record(began + 1, self.size, false)? else {
            return Ok(ExaminedRecord::End);
        };
        self.count_lost(more - began);
        self.source.seek(more)?;
        self.survey.recovered.has_end = false;
        Ok(ExaminedRecord::FalseEnd)
    }

    /// Continues at the next intact records after a wrong one. Returns false if there are no more.
    fn resume_after_damage(&mut self, began: u64, end: Option<u64>, rows: u64) -> io::Result<bool> {
        let end = match end.filter(|end| *end <= self.limit) {
            Some(end) => can_begin_record(self.source.input(), end, self.limit)?.then_some(end),
            None => None,
        };
        // An earlier record with a wrong length may have led into the middle of another one, to bytes that look like a
        // record.
        let mut until = began;
        while let Some((at, within)) = self.unsure.pop_back() {
            if let Some(found) = self.find_record_or_row(at + 1, within.max(at + 1), until)? {
                self.unsure.clear();
                self.truncate_intact(at);
                self.count_lost(found - at);
                self.source.seek(found)?;
                return Ok(true);
            }
            until = at;
        }
        let from = began + 1;
        let found = match end {
            Some(end) => self.find_first_record(from, end, false)?.or(Some(end)),
            None => self.find_record_or_row(from, rows.max(from), self.limit)?,
        };
        let Some(found) = found else {
            let rest = self.limit.saturating_sub(began);
            if self.has_magic {
                self.count_lost(rest);
            } else {
                self.survey.recovered.unfinished_bytes = rest;
            }
            return Ok(false);
        };
        self.count_lost(found.saturating_sub(began));
        self.source.seek(found)?;
        Ok(true)
    }

    /// Removes the last record from the intact parts, because its length was wrong and spans other records.
    fn truncate_intact(&mut self, at: u64) {
        if let Some(IntactRange::Records { from, to }) = self.survey.pieces.last_mut() {
            *to = at;
            if from == to {
                self.survey.pieces.pop();
            }
        }
    }

    /// Reads the summary, if the file ends with one, and collects the schemas and channels in it.
    fn summary(&mut self) -> io::Result<Option<SummarySection>> {
        let Some(footer) = self.size.checked_sub((FOOTER_BYTES + MAGIC.len()) as u64) else {
            return Ok(None);
        };
        let mut at_end = [0; FOOTER_BYTES + MAGIC.len()];
        let input = self.source.input();
        input.seek(SeekFrom::Start(footer))?;
        input.read_exact(&mut at_end)?;
        self.has_magic = at_end.ends_with(MAGIC);
        let Some((&head, rest)) = at_end.split_first_chunk::<RECORD_HEADER_BYTES>() else { return Ok(None) };
        let Some((&start, _)) = rest.split_first_chunk::<8>() else { return Ok(None) };
        let is_footer = head == [op::FOOTER, 20, 0, 0, 0, 0, 0, 0, 0] && rest.ends_with(MAGIC);
        let start = match u64::from_le_bytes(start) {
            0 => footer,
            start => start,
        };
        if !is_footer || start > footer || start < MAGIC.len() as u64 {
            return Ok(None);
        }
        input.seek(SeekFrom::Start(start))?;
        let mut of_summary = RecordReader::resume_at(start, input, 0);
        of_summary.begin_summary();
        let (mut stated, mut all) = (None, Vec::new());
        let checksum = loop {
            let framed = of_summary.next()?;
            if of_summary.check(framed).is_err() {
                return Ok(None);
            }
            match framed {
                FramedRecord::Record(op::FOOTER) => break of_summary.check_section_checksum(op::FOOTER),
                FramedRecord::Record(code @ (op::SCHEMA | op::CHANNEL)) => {
                    all.push((code, of_summary.body().to_vec()))
                }
                FramedRecord::Skipped(op::STATISTICS, _) => {
                    stated = of_summary.body().first_chunk().map(|count| u64::from_le_bytes(*count));
                }
                FramedRecord::Skipped(..) => {}
                FramedRecord::Record(_)
                | FramedRecord::Oversized(..)
                | FramedRecord::Unknown(..)
                | FramedRecord::Truncated(..)
                | FramedRecord::End(_) => {
                    return Ok(None);
                }
            }
        };
        if of_summary.bytes_read() != footer + FOOTER_BYTES as u64 {
            return Ok(None);
        }
        let is_right = checksum.is_ok();
        let trust = summary_trust(is_right, at_end.ends_with(&[&[0; 4][..], MAGIC].concat()));
        for (code, body) in all {
            // Descriptions that cannot be decoded are ignored.
            let _ = self.survey.described.add(code, &body, trust);
        }
        Ok(Some(SummarySection { data_end: start, stated: stated.filter(|_| is_right), is_right }))
    }
}

/// Returns how reliable the descriptions in a summary are, by its checksum.
const fn summary_trust(is_right: bool, has_none: bool) -> DescriptionTrust {
    match (is_right, has_none) {
        (false, _) => DescriptionTrust::Doubtful,
        (true, true) => DescriptionTrust::Unchecked,
        (true, false) => DescriptionTrust::Certain,
    }
}
