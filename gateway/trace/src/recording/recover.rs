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

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, Read, Seek, Write};

use mcap::records::{MessageHeader, op};
use mcap::write::{Metadata, NoSeek};
use mcap::{Attachment, McapError, Writer};
use protocol::candump::Record as Frame;
use thiserror::Error;

use super::TOPIC_OF_BUS;
use super::file::{io_error, options};
use crate::container::{
    Chunk, Damage, Framed, HEAD, LONGEST, MAGIC, Names, Record, Source, first_record, is_record, own_length,
    parse,
};
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
    /// Damaged places, and their bytes.
    pub damaged: (u64, u64),
    /// Messages whose topic was described in something that is lost.
    pub homeless: u64,
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
    pub const fn is_sound(&self) -> bool {
        self.whole && self.unfinished == 0 && self.is_undamaged() && !self.checksum
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
            bytes => write!(f, "; {bytes} bytes of an unfinished record are lost")?,
        }
        match self.damaged {
            (0, _) => {}
            (_, 0) => write!(f, "; a length in it was wrong, and nothing is lost for that")?,
            (1, bytes) => write!(f, "; {bytes} damaged bytes are lost")?,
            (places, bytes) => write!(f, "; {bytes} damaged bytes in {places} places are lost")?,
        }
        if self.homeless > 0 {
            write!(f, "; {} messages of topics that were described there are lost", self.homeless)?;
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

/// Copies everything whole into a new file, and ends it. Behind damage it goes on with the next record that is certain;
/// of an input that cannot be gone back in only where the damaged record ends by its length.
///
/// # Errors
/// When there is nothing to keep, or a file fails.
pub fn recover(from: impl Read + Seek, out: impl Write) -> Result<Recovered, RecoverError> {
    let mut source = Source::new(from, LONGEST_ATTACHMENT);
    if !source.magic().map_err(RecoverError::Read)? && !MAGIC.starts_with(source.body()) {
        return Err(RecoverError::NoMcap { got: source.body().to_vec() });
    }
    let first = source.next().map_err(RecoverError::Read)?;
    let is_header = first == Framed::Record(op::HEADER);
    if !is_header {
        let [began, _] = source.began();
        if resume(&mut source, (began, began, None), true).map_err(RecoverError::Read)?.is_none() {
            return Err(RecoverError::Empty(source.read()));
        }
    }
    let mut copy =
        Copy::new(if is_header { source.body() } else { &[] }, out).map_err(RecoverError::Write)?;
    if !is_header {
        copy.lost(MAGIC.len() as u64, source.read());
    }
    let mut chunk = Chunk::default();
    // Up to here all is right.
    let mut right = source.read();
    loop {
        let framed = source.next().map_err(RecoverError::Read)?;
        let [began, _] = source.began();
        let kept = match framed {
            Framed::End(0) => break,
            Framed::Record(op::DATA_END) => {
                let checksums = source.check_section(op::DATA_END).is_ok();
                // What follows is generated again.
                let end = ends_well(&mut source).map_err(RecoverError::Read)?;
                // Its operation code and length are five bytes: damage may look like it.
                let goes_on = !end.whole
                    && resume(&mut source, (right, began, None), false)
                        .map_err(RecoverError::Read)?
                        .is_some();
                if !goes_on {
                    copy.recovered.whole = end.whole;
                    copy.recovered.checksum = !(checksums && end.checksum);
                    break;
                }
                copy.lost(began, source.read());
                continue;
            }
            Framed::Record(code) => {
                let (body, read) = (source.body(), source.read());
                if code == op::CHUNK { copy.chunk(&mut chunk, body, read) } else { copy.record(code, body) }
            }
            Framed::Long(_, bytes) => Err(Damage::Long { what: "record", bytes, limit: LONGEST }.into()),
            Framed::Unknown(code, _) => Err(Damage::Unknown(code).into()),
            Framed::End(bytes) => Err(Damage::Cut(bytes).into()),
        };
        match kept {
            Ok(()) => {
                let code = if let Framed::Record(code) = framed { code } else { 0 };
                right = source.read();
                // Its content is right, and says where it ends.
                let own = own_length(code, source.body()).map(|own| began + HEAD as u64 + own);
                if let Some(own) = own.filter(|own| *own < right)
                    && source.move_to(own).is_ok()
                {
                    right = own;
                    copy.lost(began, began);
                }
            }
            Err(Failed::Write(error)) => return Err(RecoverError::Write(io_error(error))),
            Err(Failed::Damage(_)) => {
                let end = (!matches!(framed, Framed::End(_))).then_some(source.read());
                match resume(&mut source, (right, began, end), true).map_err(RecoverError::Read)? {
                    Some(at) => copy.lost(began, at),
                    None => {
                        copy.recovered.unfinished =
                            source.size().unwrap_or_else(|_| source.read()).saturating_sub(began);
                        break;
                    }
                }
            }
        }
    }
    copy.writer.finish().map_err(|error| RecoverError::Write(io_error(error)))?;
    Ok(copy.recovered)
}

/// Goes to where records go on behind a damaged one, which began and, by its length, ends there; before it all is right up
/// to a place. Where that is; none when nothing follows. Only chunks and attachments are looked for, unless `any`.
fn resume(
    source: &mut Source<impl Read + Seek>,
    (right, began, end): (u64, u64, Option<u64>),
    any: bool,
) -> io::Result<Option<u64>> {
    let [_, before] = source.began();
    let Ok(size) = source.size() else { return Ok(end) };
    let input = source.input();
    // The length of the record before it may have led over others.
    let mut found = first_record(input, right.max(before + 1), began, false)?;
    if found.is_none() {
        let end = match end {
            Some(end) if is_record(input, end, size)? => Some(end),
            _ => None,
        };
        found = first_record(input, began + 1, end.unwrap_or(size), any && end.is_none())?.or(end);
    }
    if let Some(at) = found {
        source.move_to(at)?;
    }
    Ok(found)
}

/// How a file ends behind its data section.
struct End {
    /// With a footer and the magic bytes.
    whole: bool,
    /// Its summary is as its checksum says.
    checksum: bool,
}

/// Whether summary, footer and magic follow. An index that breaks off is no loss: the new file has its own.
fn ends_well(source: &mut Source<impl Read>) -> io::Result<End> {
    source.begin_summary();
    loop {
        match source.next()? {
            Framed::Record(op::FOOTER) => {
                let checksum = source.check_section(op::FOOTER).is_ok();
                return Ok(End { whole: source.magic()?, checksum });
            }
            Framed::End(_) => return Ok(End { whole: false, checksum: true }),
            Framed::Record(_) | Framed::Long(..) | Framed::Unknown(..) => {}
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

    /// What stood between two places is lost, as far as the first is before the second.
    fn lost(&mut self, began: u64, goes_on: u64) {
        self.recovered.damaged.0 += 1;
        self.recovered.damaged.1 += goes_on.saturating_sub(began);
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
            Record::Header { .. } | Record::DataEnd { .. } | Record::Footer { .. } | Record::Other => {}
        }
        Ok(())
    }
}
