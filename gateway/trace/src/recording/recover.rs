//! Makes a whole file of one whose writer ended in the middle.
//!
//! ```text
//!   magic │ head │ chunk │ index │ chunk │ index │ chu        a file whose writer was killed
//!   ──────┴──────┴───────┴───────┴───────┴───────┼────
//!            kept, message by message            └ reported: bytes of an incomplete record
//! ```
//!
//! A chunk is kept when it is whole and its checksum is right. One that is damaged is left out and reported, and so are
//! bytes that are no record; what follows is kept, and looked for where a length leads nowhere.

mod described;
mod survey;

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, Read, Seek, Write};

use mcap::records::op;
use thiserror::Error;

use self::survey::{Piece, Survey};
use super::file::FileWriter;
use crate::container::{Chunk, Damage, Framed, Record, Source, parse};

/// The longest attachment that is copied.
const LONGEST_ATTACHMENT: u64 = 1 << 30;

/// What a recovery came to.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Recovered {
    /// Messages that were kept.
    pub messages: u64,
    /// Of these, frames of buses.
    pub frames: u64,
    /// The latest time of a message, in ns since 1970; 0 of none.
    pub last_nanos: u64,
    /// Bytes at the end that are no whole record.
    pub unfinished: u64,
    /// Damaged places, and their bytes.
    pub damaged: (u64, u64),
    /// Messages whose topic was described only in something that is lost.
    pub homeless: u64,
    /// Messages that there were, if the file says how many.
    pub stated: Option<u64>,
    /// Whether the file had its end.
    pub whole: bool,
    /// Whether a checksum of all its data, or of its summary, is wrong.
    pub checksum: bool,
}

impl Recovered {
    /// Whether nothing is lost but what a killed writer had not finished.
    #[must_use]
    pub const fn is_undamaged(&self) -> bool {
        self.damaged.0 == 0 && self.homeless == 0
    }

    /// Whether nothing was wrong with the file.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        let is_all = self.stated.is_none_or(|stated| stated == self.messages);
        self.whole && self.unfinished == 0 && self.is_undamaged() && !self.checksum && is_all
    }

    /// Whether more messages were lost than kept, as far as it is known how many there were.
    #[must_use]
    pub fn is_little(&self) -> bool {
        let missing = self.stated.map_or(0, |stated| stated.saturating_sub(self.messages));
        missing.max(self.homeless) > self.messages
    }
}

impl fmt::Display for Recovered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = (self.last_nanos / 1_000_000_000, self.last_nanos % 1_000_000_000 / 1_000);
        let of = self.stated.filter(|stated| *stated != self.messages);
        let of = of.map_or_else(String::new, |stated| format!(" of {stated}"));
        write!(f, "{}{of} messages, {} of them frames", self.messages, self.frames)?;
        if self.messages > 0 {
            write!(f, ", the last at {}.{:06}", seconds.0, seconds.1)?;
        }
        match self.unfinished {
            0 => write!(f, "; nothing unfinished at the end")?,
            bytes => write!(f, "; {bytes} bytes of an unfinished record are lost")?,
        }
        match self.damaged {
            (0, _) => {}
            (_, 0) => write!(f, "; a length in it was wrong, and nothing is lost for that")?,
            (1, bytes) => write!(f, "; {bytes} damaged bytes are lost")?,
            (places, bytes) => write!(f, "; {bytes} damaged bytes in {places} places are lost")?,
        }
        if self.homeless > 0 {
            write!(f, "; {} messages of topics that are described nowhere else are lost", self.homeless)?;
        }
        if self.checksum && self.is_undamaged() {
            write!(f, "; a checksum of the whole was wrong, and none of a part")?;
        }
        Ok(())
    }
}

/// Why nothing can be recovered.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecoverError {
    /// Something else.
    #[error(
        "it is no MCAP file: it begins with {}, an MCAP file with 89 4d 43 41 50: name a recording",
        hex(got)
    )]
    NoMcap {
        /// Its first bytes.
        got: Vec<u8>,
    },
    /// An MCAP file that breaks off before its first message could be.
    #[error("it ends within its first {0} bytes: there is nothing in it")]
    Empty(u64),
    /// It cannot be read.
    #[error("reading: {0}")]
    Read(io::Error),
    /// The new one cannot be written.
    #[error("writing: {0}")]
    Write(io::Error),
}

fn hex(bytes: &[u8]) -> String {
    let digits: Vec<_> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    if digits.is_empty() { "nothing".to_owned() } else { digits.join(" ") }
}

/// Copies everything whole into a new file, and ends it. Behind damage it goes on with the next record that is certain.
/// What types and topics are is known from wherever the file says it.
///
/// # Errors
/// When there is nothing to keep, a file fails, or the input cannot be gone back in.
pub fn recover(mut from: impl Read + Seek, out: impl Write) -> Result<Recovered, RecoverError> {
    let Survey { profile, pieces, described, recovered } = Survey::of(&mut from)?;
    let begin = || -> io::Result<_> {
        let mut writer = FileWriter::with_profile(out, &profile)?;
        let topics = described.write(&mut writer)?;
        writer.flush()?;
        Ok((writer, topics))
    };
    let (writer, topics) = begin().map_err(RecoverError::Write)?;
    drop(described);
    let mut copy = Copy { writer, topics, recovered };
    let mut source = Source::new(from, LONGEST_ATTACHMENT);
    let mut chunk = Chunk::default();
    for piece in pieces {
        match piece {
            Piece::Records { from, to } => {
                source.move_to(from).map_err(RecoverError::Read)?;
                while source.read() < to {
                    let framed = source.next().map_err(RecoverError::Read)?;
                    if let Framed::Record(code) = framed {
                        copy.take(&mut chunk, code, source.body(), source.read())?;
                    }
                }
            }
            Piece::Record { at, code, length } => {
                source.read_as(at, length).map_err(RecoverError::Read)?;
                copy.take(&mut chunk, code, source.body(), source.read())?;
            }
        }
    }
    copy.writer.finish().map_err(RecoverError::Write)?;
    Ok(copy.recovered)
}

struct Copy<W: Write> {
    writer: FileWriter<W>,
    /// Topics, and whether their messages are frames.
    topics: BTreeMap<u16, bool>,
    recovered: Recovered,
}

impl<W: Write> Copy<W> {
    /// Copies a record, which was right when the file was gone through; `read` is how many bytes of the file were read
    /// so far.
    fn take(&mut self, chunk: &mut Chunk, code: u8, body: &[u8], read: u64) -> Result<(), RecoverError> {
        if code != op::CHUNK {
            return self.record(code, body).map_err(RecoverError::Write);
        }
        chunk.unpack(body, read).map_err(changed)?;
        while let Some((code, body)) = chunk.next() {
            // Types and topics are written, and nothing else belongs into a chunk.
            if code == op::MESSAGE {
                self.record(code, body).map_err(RecoverError::Write)?;
            }
        }
        Ok(())
    }

    fn record(&mut self, code: u8, body: &[u8]) -> io::Result<()> {
        match parse(code, body).map_err(io::Error::other)? {
            Record::Message { channel, sequence, log_time, publish_time, data } => {
                let Some(is_frame) = self.topics.get(&channel) else {
                    self.recovered.homeless += 1;
                    return Ok(());
                };
                self.writer.put((channel, sequence), (log_time, publish_time), data)?;
                let Recovered { messages, frames, last_nanos, .. } = &mut self.recovered;
                *messages += 1;
                *frames += u64::from(*is_frame);
                *last_nanos = log_time.max(*last_nanos);
                Ok(())
            }
            Record::Attachment { log_time, create_time, name, media_type, data } => {
                self.writer.attach_at(name, media_type, (log_time, create_time), data)
            }
            Record::Metadata { name, facts } => self.writer.metadata(name, &facts.into()),
            // Written before, generated again, or of no file of ours.
            Record::Schema { .. }
            | Record::Channel { .. }
            | Record::Header { .. }
            | Record::DataEnd { .. }
            | Record::Footer { .. }
            | Record::Other => Ok(()),
        }
    }
}

/// The file is another one than a moment ago.
fn changed(damage: Damage) -> RecoverError {
    RecoverError::Read(io::Error::other(format!("it was changed meanwhile: {damage}")))
}
