//! Recovers a complete file from one whose writer was killed.
//!
//! ```text
//!   magic │ head │ chunk │ index │ chunk │ index │ chu        a file whose writer was killed
//!   ──────┴──────┴───────┴───────┴───────┴───────┼────
//!            kept, message by message            └ reported: bytes of an incomplete record
//! ```
//!
//! A chunk is kept if it is complete and its checksum is correct. Damaged chunks, and bytes that are not a record, are
//! left out and reported. Intact records after them are kept; if a length is wrong, the next records are searched for.

mod described;
mod survey;

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, Read, Seek, Write};

use mcap::records::op;
use thiserror::Error;

use self::survey::{FileSurvey, IntactRange};
use super::file::FileWriter;
use crate::container::{Chunk, FormatError, FramedRecord, Record, RecordReader, parse};

/// The longest attachment that is copied, in bytes.
const MAX_ATTACHMENT_BYTES: u64 = 1 << 30;

/// The result of a recovery: what was kept and what was lost.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct RecoveryResult {
    /// Messages kept.
    pub messages: u64,
    /// Frames among the kept messages.
    pub frames: u64,
    /// The latest time of a message, in ns since 1970; 0 without messages.
    pub last_nanos: u64,
    /// Bytes at the end of the file that are not a complete record.
    pub unfinished_bytes: u64,
    /// The number of damaged places, and the bytes lost there.
    pub damaged: (u64, u64),
    /// Messages that were lost because their channel was described only in a damaged part of the file.
    pub orphaned_messages: u64,
    /// The number of messages according to the statistics of the file, if it has any.
    pub stated: Option<u64>,
    /// True if the file had a complete summary and footer.
    pub has_end: bool,
    /// True if the checksum of all data or of the summary is wrong.
    pub is_checksum_wrong: bool,
}

impl RecoveryResult {
    /// Returns true if only the end is missing that a killed writer had not written yet.
    #[must_use]
    pub const fn is_undamaged(&self) -> bool {
        self.damaged.0 == 0 && self.orphaned_messages == 0
    }

    /// Returns true if the file was complete and correct.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        let is_all = self.stated.is_none_or(|stated| stated == self.messages);
        self.has_end && self.unfinished_bytes == 0 && self.is_undamaged() && !self.is_checksum_wrong && is_all
    }

    /// Returns true if more messages were lost than kept. This can be determined only if the file states their number.
    #[must_use]
    pub fn lost_more_than_kept(&self) -> bool {
        let missing = self.stated.map_or(0, |stated| stated.saturating_sub(self.messages));
        missing.max(self.orphaned_messages) > self.messages
    }
}

impl fmt::Display for RecoveryResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = (self.last_nanos / 1_000_000_000, self.last_nanos % 1_000_000_000 / 1_000);
        let of = self.stated.filter(|stated| *stated != self.messages);
        let of = of.map_or_else(String::new, |stated| format!(" of {stated}"));
        write!(f, "{}{of} messages recovered, {} of which are CAN frames", self.messages, self.frames)?;
        if self.messages > 0 {
            write!(f, ", the last at {}.{:06}", seconds.0, seconds.1)?;
        }
        match self.unfinished_bytes {
            0 => write!(f, "; the last record is complete")?,
            bytes => write!(f, "; {bytes} bytes of an unfinished record are lost")?,
        }
        match self.damaged {
            (0, _) => {}
            (_, 0) => write!(f, "; a wrong length field caused no loss")?,
            (1, bytes) => write!(f, "; {bytes} damaged bytes are lost")?,
            (places, bytes) => write!(f, "; {bytes} damaged bytes in {places} places are lost")?,
        }
        if self.orphaned_messages > 0 {
            write!(
                f,
                "; {} messages are lost with the descriptions of their topics",
                self.orphaned_messages
            )?;
        }
        if self.is_checksum_wrong && self.is_undamaged() {
            write!(f, "; the checksum of the whole file was wrong, but those of its chunks were right")?;
        }
        Ok(())
    }
}

/// An error that ends a recovery without a new file.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecoverError {
    /// The input does not begin like an MCAP file.
    #[error(
        "it is not an MCAP file: it begins with {}, but MCAP begins with 89 4d 43 41 50; name a recording",
        hex(got)
    )]
    NoMcap {
        /// The first bytes of the input.
        got: Vec<u8>,
    },
    /// The MCAP file ends before its first message.
    #[error("it ends after {0} bytes, before its first message, so nothing can be recovered")]
    Empty(u64),
    /// The input cannot be read.
    #[error("reading failed: {0}")]
    Read(io::Error),
    /// The new file cannot be written.
    #[error("writing failed: {0}")]
    Write(io::Error),
}

fn hex(bytes: &[u8]) -> String {
    let digits: Vec<_> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    if digits.is_empty() { "nothing".to_owned() } else { digits.join(" ") }
}

/// Copies all intact records into a new file and writes its end. After damage, copying continues at the next record
/// that is certainly one. Schemas and channels are collected from the whole file first.
///
/// # Errors
/// Returns [`RecoverError`] if no message can be recovered, if reading or writing fails, or if the input is not
/// seekable.
pub fn recover(mut from: impl Read + Seek, out: impl Write) -> Result<RecoveryResult, RecoverError> {
    let FileSurvey { profile, pieces, described, recovered } = FileSurvey::new(&mut from)?;
    let begin = || -> io::Result<_> {
        let mut writer = FileWriter::with_profile(out, &profile)?;
        let topics = described.write(&mut writer)?;
        writer.flush()?;
        Ok((writer, topics))
    };
    let (writer, topics) = begin().map_err(RecoverError::Write)?;
    drop(described);
    let mut copy = RecordCopier { writer, topics, recovered };
    let mut source = RecordReader::new(from, MAX_ATTACHMENT_BYTES);
    let mut chunk = Chunk::default();
    for piece in pieces {
        match piece {
            IntactRange::Records { from, to } => {
                source.seek(from).map_err(RecoverError::Read)?;
                while source.bytes_read() < to {
                    let framed = source.next().map_err(RecoverError::Read)?;
                    if let FramedRecord::Record(code) = framed {
                        copy.copy_record(&mut chunk, code, source.body(), source.bytes_read())?;
                    }
                }
            }
            IntactRange::Record { at, code, length } => {
                source.read_with_length(at, length).map_err(RecoverError::Read)?;
                copy.copy_record(&mut chunk, code, source.body(), source.bytes_read())?;
            }
        }
    }
    copy.writer.finish().map_err(RecoverError::Write)?;
    Ok(copy.recovered)
}

struct RecordCopier<W: Write> {
    writer: FileWriter<W>,
    /// The channel numbers of the new file, each with true if its messages are frames.
    topics: BTreeMap<u16, bool>,
    recovered: RecoveryResult,
}

impl<W: Write> RecordCopier<W> {
    /// Copies a record that the survey found intact. `read` is the number of bytes of the input read so far.
    fn copy_record(
        &mut self,
        chunk: &mut Chunk,
        code: u8,
        body: &[u8],
        read: u64,
    ) -> Result<(), RecoverError> {
        if code != op::CHUNK {
            return self.write_record(code, body).map_err(RecoverError::Write);
        }
        chunk.unpack(body, read).map_err(changed_input_error)?;
        while let Some((code, body)) = chunk.next() {
            // Schemas and channels are already written, and chunks hold no other records.
            if code == op::MESSAGE {
                self.write_record(code, body).map_err(RecoverError::Write)?;
            }
        }
        Ok(())
    }

    fn write_record(&mut self, code: u8, body: &[u8]) -> io::Result<()> {
        match parse(code, body).map_err(io::Error::other)? {
            Record::Message { channel, sequence, log_time, publish_time, data } => {
                let Some(is_frame) = self.topics.get(&channel) else {
                    self.recovered.orphaned_messages += 1;
                    return Ok(());
                };
                self.writer.write_encoded((channel, sequence), (log_time, publish_time), data)?;
                let RecoveryResult { messages, frames, last_nanos, .. } = &mut self.recovered;
                *messages += 1;
                *frames += u64::from(*is_frame);
                *last_nanos = log_time.max(*last_nanos);
                Ok(())
            }
            Record::Attachment { log_time, create_time, name, media_type, data } => {
                self.writer.attach_at(name, media_type, (log_time, create_time), data)
            }
            Record::Metadata { name, facts } => self.writer.write_metadata(name, &facts.into()),
            // These records are already written, are generated for the new file, or do not occur in a recording of
            // skinbus.
            Record::Schema { .. }
            | Record::Channel { .. }
            | Record::Header { .. }
            | Record::DataEnd { .. }
            | Record::Footer { .. }
            | Record::Other => Ok(()),
        }
    }
}

/// Returns the error for an input that was changed between the survey and the copy.
fn changed_input_error(damage: FormatError) -> RecoverError {
    RecoverError::Read(io::Error::other(format!("it was changed during the recovery: {damage}")))
}
