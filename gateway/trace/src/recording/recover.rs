//! Makes a whole file of one whose writer ended in the middle.
//!
//! ```text
//!   magic │ head │ chunk │ index │ chunk │ index │ chu        a file whose writer was killed
//!   ──────┴──────┴───────┴───────┴───────┴───────┼────
//!            kept, message by message            └ reported: bytes of an incomplete record
//! ```
//!
//! A chunk is kept when it is whole and its checksum is right. One that is damaged is left out and reported;
//! what follows it is kept.

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, Read, Write};

use mcap::records::{MessageHeader, op};
use mcap::write::{Metadata, NoSeek};
use mcap::{Attachment, McapError, Writer};
use protocol::candump::Record as Frame;
use thiserror::Error;

use super::TOPIC_OF_BUS;
use super::file::{io_error, options};
use crate::container::{Chunk, Damage, Framed, LONGEST, MAGIC, Names, Record, Source, parse};
use crate::ros2::Message;

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
    /// Whole chunks whose content is damaged, and their bytes.
    pub damaged: (u64, u64),
    /// Messages whose topic was described in something that is lost.
    pub homeless: u64,
    /// Whether the file had its end.
    pub whole: bool,
}

impl Recovered {
    /// Whether nothing was wrong with the file.
    #[must_use]
    pub const fn is_sound(&self) -> bool {
        self.whole && self.unfinished == 0 && self.damaged.0 == 0 && self.homeless == 0
    }
}

impl fmt::Display for Recovered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = (self.last_nanos / 1_000_000_000, self.last_nanos % 1_000_000_000 / 1_000);
        write!(f, "{} messages, {} of them frames", self.messages, self.frames)?;
        if self.messages > 0 {
            write!(f, ", the last at {}.{:06}", seconds.0, seconds.1)?;
        }
        match self.unfinished {
            0 => write!(f, "; nothing unfinished at the end")?,
            bytes => write!(f, "; {bytes} bytes of an unfinished chunk are lost")?,
        }
        if let (chunks @ 1.., bytes) = self.damaged {
            write!(f, "; {chunks} damaged chunks of {bytes} bytes are lost")?;
        }
        if self.homeless > 0 {
            write!(f, "; {} messages of topics that were described there are lost", self.homeless)?;
        }
        Ok(())
    }
}

/// Why nothing can be recovered.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecoverError {
    /// Something else.
    #[error("it is no MCAP file: it begins with {}, an MCAP file with 89 4d 43 41 50", hex(got))]
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

/// Copies everything whole into a new file, and ends it.
///
/// # Errors
/// When there is nothing to keep, or a file fails.
pub fn recover(from: impl Read, out: impl Write) -> Result<Recovered, RecoverError> {
    let mut source = Source::new(from, LONGEST_ATTACHMENT);
    if !source.magic().map_err(RecoverError::Read)? && !MAGIC.starts_with(source.body()) {
        return Err(RecoverError::NoMcap { got: source.body().to_vec() });
    }
    loop {
        match source.next().map_err(RecoverError::Read)? {
            Framed::Record(op::HEADER) => break,
            Framed::End(_) => return Err(RecoverError::Empty(source.read())),
            Framed::Record(_) | Framed::Long(..) => {}
        }
    }
    let mut copy = Copy::new(source.body(), out).map_err(RecoverError::Write)?;
    let mut chunk = Chunk::default();
    loop {
        let framed = source.next().map_err(RecoverError::Read)?;
        let (kept, bytes) = match framed {
            Framed::End(bytes) => {
                copy.recovered.unfinished = bytes;
                break;
            }
            Framed::Record(op::DATA_END) => {
                // What follows is generated again.
                copy.recovered.whole = ends_well(&mut source).map_err(RecoverError::Read)?;
                break;
            }
            Framed::Record(code) => {
                let (body, read) = (source.body(), source.read());
                let kept = if code == op::CHUNK {
                    copy.chunk(&mut chunk, body, read)
                } else {
                    copy.record(code, body)
                };
                (kept, body.len() as u64)
            }
            Framed::Long(_, bytes) => {
                (Err(Damage::Long { what: "record", bytes, limit: LONGEST }.into()), bytes)
            }
        };
        match kept {
            Ok(()) => {}
            Err(Failed::Write(error)) => return Err(RecoverError::Write(io_error(error))),
            Err(Failed::Damage(_)) => {
                copy.recovered.damaged.0 += 1;
                copy.recovered.damaged.1 += bytes;
            }
        }
    }
    copy.writer.finish().map_err(|error| RecoverError::Write(io_error(error)))?;
    Ok(copy.recovered)
}

/// Whether summary, footer and magic follow. An index that breaks off is no loss: the new file has its own.
fn ends_well(source: &mut Source<impl Read>) -> io::Result<bool> {
    loop {
        match source.next()? {
            Framed::Record(op::FOOTER) => return source.magic(),
            Framed::End(_) => return Ok(false),
            Framed::Record(_) | Framed::Long(..) => {}
        }
    }
}

/// Why a record or a chunk is not in the new file.
#[derive(Debug, Error)]
enum Failed {
    #[error(transparent)]
    Damage(#[from] Damage),
    #[error(transparent)]
    Write(#[from] McapError),
}

struct Copy<W: Write> {
    writer: Writer<NoSeek<W>>,
    /// Schemas, and which of them are those of frames.
    schemas: BTreeMap<u16, bool>,
    /// Channels, and whether their messages are frames.
    channels: BTreeMap<u16, bool>,
    names: Names,
    recovered: Recovered,
}

impl<W: Write> Copy<W> {
    fn new(header: &[u8], out: W) -> io::Result<Self> {
        let profile = match parse(op::HEADER, header) {
            Ok(Record::Header { profile, .. }) => profile,
            _ => "",
        };
        let writer = options().profile(profile).create(NoSeek::new(out)).map_err(io_error)?;
        let (schemas, channels, names) = (BTreeMap::new(), BTreeMap::new(), Names::default());
        Ok(Self { writer, schemas, channels, names, recovered: Recovered::default() })
    }

    /// A chunk's records, if all of them are right; `read` is how many bytes of the file were read so far.
    fn chunk(&mut self, chunk: &mut Chunk, packed: &[u8], read: u64) -> Result<(), Failed> {
        chunk.unpack(packed, read)?;
        while let Some((code, body)) = chunk.next() {
            parse(code, body)?;
        }
        chunk.rewind();
        while let Some((code, body)) = chunk.next() {
            // Nothing else belongs into a chunk.
            if matches!(code, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
                self.record(code, body)?;
            }
        }
        Ok(())
    }

    fn record(&mut self, code: u8, body: &[u8]) -> Result<(), Failed> {
        match self.keep(&parse(code, body)?) {
            Err(Failed::Write(error)) if !matches!(error, McapError::Io(_)) => {
                // Its channel or its schema stood in what is lost.
                self.recovered.homeless += 1;
                Ok(())
            }
            kept => kept,
        }
    }

    fn keep(&mut self, record: &Record<'_>) -> Result<(), Failed> {
        let writer = &mut self.writer;
        match *record {
            Record::Schema { id, name, encoding, data } => {
                if !self.schemas.contains_key(&id) {
                    self.names.add(name.len() + encoding.len() + data.len())?;
                    self.schemas.insert(id, name == Frame::TYPE);
                }
                writer.add_schema_with_id(id, name, encoding, data)?;
            }
            Record::Channel { id, schema, topic, encoding, facts } => {
                if !self.channels.contains_key(&id) {
                    self.names.add(topic.len() + encoding.len())?;
                    facts.iter().try_for_each(|(key, value)| self.names.add(key.len() + value.len()))?;
                    let frames = self.schemas.get(&schema).is_some_and(|frames| *frames);
                    self.channels.insert(id, frames && topic.starts_with(TOPIC_OF_BUS));
                }
                writer.add_channel_with_id(id, schema, topic, encoding, &facts.into())?;
            }
            Record::Message { channel, sequence, log_time, publish_time, data } => {
                let header = MessageHeader { channel_id: channel, sequence, log_time, publish_time };
                writer.write_to_known_channel(&header, data)?;
                let Recovered { messages, frames, last_nanos, .. } = &mut self.recovered;
                *messages += 1;
                *frames += u64::from(self.channels.get(&channel).is_some_and(|frames| *frames));
                *last_nanos = log_time.max(*last_nanos);
            }
            Record::Attachment { log_time, create_time, name, media_type, data } => {
                let (name, media_type) = (name.to_owned(), media_type.to_owned());
                writer.attach(&Attachment { log_time, create_time, name, media_type, data: data.into() })?;
            }
            Record::Metadata { name, facts } => {
                writer.write_metadata(&Metadata { name: name.to_owned(), metadata: facts.into() })?;
            }
            // Generated again, or of no file of ours.
            Record::Header { .. } | Record::DataEnd { .. } | Record::Other => {}
        }
        Ok(())
    }
}
