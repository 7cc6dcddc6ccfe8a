//! Reads the records of a file in order, without decoding them.

use std::io::{self, BufReader, Read, Seek, SeekFrom};

use mcap::records::op;

use super::field::{Record, attachment_name, parse};
use super::search::{
    RECORD_HEADER_BYTES, ends_with_records, has_wrong_opcode, is_known_opcode, is_uncompressed,
    length_by_fields,
};
use super::{FormatError, MAGIC, MAX_RECORD_BYTES, read_uninterrupted};

/// The maximum number of bytes stored of a record that is too long for memory or that no reader needs.
const KEPT_PREFIX_BYTES: u64 = 64 << 10;
/// The maximum number of bytes stored of a message index record, which no reader needs.
const KEPT_INDEX_BYTES: u64 = 64;

/// The number of bytes at the beginning of a footer that its checksum covers.
const FOOTER_CHECKED_BYTES: usize = 16;

/// A record of the file, or the reason why there is no further record.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum FramedRecord {
    /// A record with this operation code, whose contents are in [`RecordReader::body`].
    Record(u8),
    /// A skipped record with this operation code and length: an index, statistics, or a record of an application. Its
    /// beginning is in [`RecordReader::body`].
    Skipped(u8, u64),
    /// A record with this operation code and length that is too long for memory. Its beginning is in
    /// [`RecordReader::body`].
    Oversized(u8, u64),
    /// A record with an operation code that the format does not define, and its length.
    Unknown(u8, u64),
    /// A record with this operation code and length that the input does not hold completely. The available beginning,
    /// up to a limit, is in [`RecordReader::body`].
    Truncated(u8, u64),
    /// The end of the input. The number counts the remaining bytes, which are too few for a record header; it is 0 if
    /// the file ends between two records.
    End(u64),
}

/// Splits an input into records. Of indexes, statistics and unknown records, which no reader needs, only the beginning
/// is stored.
#[derive(Debug)]
pub struct RecordReader<R> {
    input: R,
    body: Vec<u8>,
    /// The number of bytes read.
    read: u64,
    /// The offset and the operation code of the record that was read last.
    began: u64,
    code: u8,
    /// The offset of the record before the last one if that record is a message, whose length is not confirmed by a
    /// checksum.
    message_before: Option<u64>,
    /// The longest attachment that is read into memory, in bytes.
    attachments: u64,
    /// The checksum of all bytes in the data section so far; `None` once it cannot be computed.
    checksum: Option<crc32fast::Hasher>,
    /// True once a chunk was read.
    has_chunks: bool,
    /// True in the summary section, which follows the data section.
    in_summary: bool,
    /// The last bytes read.
    last: [u8; MAGIC.len()],
}

impl<R: Read> RecordReader<R> {
    /// Creates a reader that keeps attachments of at most `attachments` bytes.
    pub fn new(input: R, attachments: u64) -> Self {
        let checksum = Some(crc32fast::Hasher::new());
        let (body, last) = (Vec::new(), [0; MAGIC.len()]);
        Self {
            input,
            body,
            read: 0,
            began: 0,
            code: 0,
            message_before: None,
            attachments,
            checksum,
            has_chunks: false,
            in_summary: false,
            last,
        }
    }

    /// Creates a reader that continues at the offset `read` of a file.
    pub fn resume_at(read: u64, input: R, attachments: u64) -> Self {
        Self { read, checksum: None, ..Self::new(input, attachments) }
    }

    /// Reads the magic bytes at the beginning or end of a file into [`RecordReader::body`]. Returns true if they are
    /// correct.
    ///
    /// # Errors
    /// Returns an error if the input fails.
    pub fn read_magic(&mut self) -> io::Result<bool> {
        self.body.clear();
        self.read_into_body(MAGIC.len() as u64)?;
        self.update_checksum();
        Ok(self.body == MAGIC)
    }

    /// Returns the contents of the last record, without its operation code and length.
    #[must_use]
    pub fn body(&self) -> &[u8] {
        &self.body
    }

    /// Returns the number of bytes read so far.
    #[must_use]
    pub const fn bytes_read(&self) -> u64 {
        self.read
    }

    /// Returns the offset of the last record.
    #[must_use]
    pub const fn record_offset(&self) -> u64 {
        self.began
    }

    /// Returns the offset of the record before the last one, if that is a message.
    #[must_use]
    pub const fn offset_of_message_before(&self) -> Option<u64> {
        self.message_before
    }

    /// Returns true if the last bytes read are the magic bytes.
    #[must_use]
    pub fn ends_with_magic(&self) -> bool {
        self.last == *MAGIC
    }

    /// Returns the length of the last record, computed from its fields, if it is an uncompressed chunk. Anything in
    /// that range that looks like a record belongs to the chunk.
    #[must_use]
    pub fn uncompressed_chunk_length(&self) -> Option<u64> {
        length_by_fields(op::CHUNK, &self.body)
            .filter(|_| self.code == op::CHUNK && is_uncompressed(&self.body))
    }

    /// Checks the record that was read last: its length against its own fields, and its operation code against its
    /// position in the file.
    ///
    /// # Errors
    /// Returns [`FormatError`] if the operation code or the length is wrong.
    pub fn check(&self, framed: FramedRecord) -> Result<(), FormatError> {
        let (code, bytes) = match framed {
            FramedRecord::Unknown(code, _) => return Err(FormatError::Unknown(code)),
            FramedRecord::End(_) => return Ok(()),
            FramedRecord::Record(code) => (code, self.body.len() as u64),
            FramedRecord::Skipped(code, bytes)
            | FramedRecord::Oversized(code, bytes)
            | FramedRecord::Truncated(code, bytes) => (code, bytes),
        };
        let is_index = matches!(
            code,
            op::CHUNK_INDEX | op::ATTACHMENT_INDEX | op::STATISTICS | op::METADATA_INDEX | op::SUMMARY_OFFSET
        );
        let is_elsewhere =
            (is_index && !self.in_summary) || (code == op::HEADER && self.began > MAGIC.len() as u64);
        // Messages stand in chunks or between schemas and channels. Message indexes follow chunks.
        let is_of = |kind| length_by_fields(kind, &self.body) == Some(bytes);
        let is_other = code == op::MESSAGE
            && (is_of(op::SCHEMA) || is_of(op::CHANNEL) || (self.has_chunks && is_of(op::MESSAGE_INDEX)));
        if is_elsewhere || is_other || (code >= 0x80 && has_wrong_opcode(&self.body, bytes)) {
            return Err(FormatError::Code(code));
        }
        match length_by_fields(code, &self.body) {
            Some(own) if own != bytes => Err(FormatError::Length { code, bytes, own }),
            _ if code == op::MESSAGE && ends_with_records(&self.body) => Err(FormatError::Swallowed(bytes)),
            _ => Ok(()),
        }
    }

    /// Returns the name of the attachment that was read last, if the attachment is too long for memory.
    #[must_use]
    pub fn attachment_name(&self) -> &str {
        attachment_name(&self.body)
    }

    /// Compares the checksum in the last record with the bytes that were read: those of the data section at its end, or
    /// those of the summary at the footer. Accepts a file without checksums, and one of which a part was skipped.
    ///
    /// # Errors
    /// Returns [`FormatError`] if the record or the checksum is wrong.
    pub fn check_section_checksum(&mut self, code: u8) -> Result<(), FormatError> {
        let found = self.checksum.take().map(crc32fast::Hasher::finalize);
        let (Record::DataEnd { crc: saved } | Record::Footer { crc: saved }) = parse(code, &self.body)?
        else {
            return Ok(());
        };
        let what = if code == op::FOOTER { "the summary" } else { "the data section" };
        match found {
            Some(found) if saved != 0 && saved != found => Err(FormatError::Checksum { what, saved, found }),
            _ => Ok(()),
        }
    }

    /// Begins the summary section. The checksum in the footer covers it from here on.
    pub fn begin_summary(&mut self) {
        self.checksum = Some(crc32fast::Hasher::new());
        self.in_summary = true;
    }

    /// Continues the data section, because what looked like a summary was not one.
    pub const fn end_summary(&mut self) {
        self.in_summary = false;
    }

    /// Returns the next item.
    ///
    /// # Errors
    /// Returns an error if the input fails.
    #[expect(
        clippy::should_implement_trait,
        reason = "a record borrows from the source; an iterator's cannot"
    )]
    pub fn next(&mut self) -> io::Result<FramedRecord> {
        self.message_before = (self.code == op::MESSAGE).then_some(self.began);
        (self.began, self.code) = (self.read, 0);
        self.body.clear();
        self.read_into_body(9)?;
        let Some(&[opcode, ref length @ ..]) = self.body.first_chunk::<9>() else {
            return Ok(FramedRecord::End(self.read - self.began));
        };
        self.code = opcode;
        self.has_chunks |= opcode == op::CHUNK;
        let length = u64::from_le_bytes(*length);
        if opcode != op::DATA_END {
            self.update_checksum();
        }
        self.body.clear();
        let (limit, beginning) = match opcode {
            op::ATTACHMENT => (self.attachments, KEPT_PREFIX_BYTES),
            op::HEADER
            | op::FOOTER
            | op::SCHEMA
            | op::CHANNEL
            | op::MESSAGE
            | op::CHUNK
            | op::METADATA
            | op::DATA_END => (MAX_RECORD_BYTES, KEPT_PREFIX_BYTES),
            op::MESSAGE_INDEX => (0, KEPT_INDEX_BYTES),
            _ => (0, KEPT_PREFIX_BYTES),
        };
        let is_long = length > limit;
        let kept = if is_long { length.min(beginning) } else { length };
        let mut there = self.read_into_body(kept)? == kept;
        match opcode {
            op::DATA_END => {}
            op::FOOTER => self.update_checksum_to(FOOTER_CHECKED_BYTES),
            _ => self.update_checksum(),
        }
        if is_long && there {
            there = self.skip(length - kept)?;
        }
        Ok(match limit {
            _ if !is_known_opcode(opcode) => FramedRecord::Unknown(opcode, length),
            _ if !there => FramedRecord::Truncated(opcode, length),
            0 if opcode != op::ATTACHMENT => FramedRecord::Skipped(opcode, length),
            _ if is_long => FramedRecord::Oversized(opcode, length),
            _ => FramedRecord::Record(opcode),
        })
    }

    /// Appends up to `bytes` bytes of the input to the body. Memory is allocated only for bytes that were read,
    /// whatever number is requested.
    fn read_into_body(&mut self, bytes: u64) -> io::Result<u64> {
        let came = (&mut self.input).take(bytes).read_to_end(&mut self.body)?;
        self.read += came as u64;
        let from = self.body.len().saturating_sub(came.min(MAGIC.len()));
        keep_last_bytes(&mut self.last, self.body.get(from..).unwrap_or_default());
        Ok(came as u64)
    }

    fn update_checksum(&mut self) {
        self.update_checksum_to(usize::MAX);
    }

    fn update_checksum_to(&mut self, bytes: usize) {
        if let Some(checksum) = &mut self.checksum {
            checksum.update(self.body.get(..bytes).unwrap_or(&self.body));
        }
    }

    /// Skips `bytes` bytes. Returns false if the input ended before.
    fn skip(&mut self, bytes: u64) -> io::Result<bool> {
        let mut leftover = bytes;
        let mut piece = [0; 8 << 10];
        while leftover > 0 {
            let most = usize::try_from(leftover).map_or(piece.len(), |leftover| leftover.min(piece.len()));
            let room = piece.get_mut(..most).unwrap_or_default();
            let came = read_uninterrupted(&mut self.input, room)?;
            let Some(came @ [_, ..]) = room.get(..came) else { return Ok(false) };
            if let Some(checksum) = &mut self.checksum {
                checksum.update(came);
            }
            keep_last_bytes(&mut self.last, came);
            self.read += came.len() as u64;
            leftover -= came.len() as u64;
        }
        Ok(true)
    }
}

impl<R: Read + Seek> RecordReader<R> {
    /// Returns the input.
    pub const fn input(&mut self) -> &mut R {
        &mut self.input
    }

    /// Returns the length of the input, in bytes.
    ///
    /// # Errors
    /// Returns an error if the input fails or is not seekable.
    pub fn size(&mut self) -> io::Result<u64> {
        let size = self.input.seek(SeekFrom::End(0))?;
        self.input.seek(SeekFrom::Start(self.read))?;
        Ok(size)
    }

    /// Continues reading at the offset `place`. The checksum of the section can then no longer be computed, unless
    /// `place` is the present offset.
    ///
    /// # Errors
    /// Returns an error if the input fails.
    pub fn seek(&mut self, place: u64) -> io::Result<()> {
        self.input.seek(SeekFrom::Start(place))?;
        if place != self.read {
            (self.read, self.began, self.checksum) = (place, place, None);
        }
        Ok(())
    }

    /// Reads the contents of the record at offset `began` into [`RecordReader::body`]. Uses `length` instead of the
    /// record's own length field, which is wrong. Returns true if the input has all these bytes.
    ///
    /// # Errors
    /// Returns an error if the input fails.
    pub fn read_with_length(&mut self, began: u64, length: u64) -> io::Result<bool> {
        self.seek(began + RECORD_HEADER_BYTES as u64)?;
        self.began = began;
        self.body.clear();
        Ok(self.read_into_body(length)? == length)
    }
}

/// Stores the last bytes of the input for the check that it ends with the magic.
fn keep_last_bytes(last: &mut [u8; MAGIC.len()], came: &[u8]) {
    let came = came.get(came.len().saturating_sub(last.len())..).unwrap_or_default();
    last.rotate_left(came.len());
    let from = last.len() - came.len();
    if let Some(place) = last.get_mut(from..) {
        place.copy_from_slice(came);
    }
}

/// Finds the next record with one of the operation codes in `target`; other records are skipped unread. Returns the
/// operation code and the length of the record.
///
/// # Errors
/// Returns an error if the input fails.
pub fn seek_record<R: Read + Seek>(input: &mut BufReader<R>, target: &[u8]) -> io::Result<Option<(u8, u64)>> {
    loop {
        let mut head = [0; 9];
        match input.read_exact(&mut head) {
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(None),
            done => done?,
        }
        let [opcode, length @ ..] = head;
        let length = u64::from_le_bytes(length);
        if target.contains(&opcode) {
            return Ok(Some((opcode, length)));
        }
        // The length exceeds that of any file.
        let Ok(length) = i64::try_from(length) else { return Ok(None) };
        if input.seek_relative(length).is_err() {
            return Ok(None);
        }
    }
}
