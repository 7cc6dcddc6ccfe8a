//! Makes a whole file of one whose writer ended in the middle.
//!
//! ```text
//!   magic │ head │ chunk │ index │ chunk │ index │ chu        a file whose writer was killed
//!   ──────┴──────┴───────┴───────┴───────┴───────┼────
//!            kept, message by message            └ said: so many bytes of something unfinished
//! ```
//!
//! A chunk is kept when it is whole and its checksum is right. One that is damaged is left out and said; what
//! follows it is kept.

use std::collections::BTreeSet;
use std::fmt;
use std::io::{self, Read, Write};

use mcap::records::{AttachmentHeader, Channel, Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::write::NoSeek;
use mcap::{Attachment, MAGIC, McapError, Writer, parse_record};
use thiserror::Error;

use super::TOPIC_OF_BUS;
use super::file::{io_error, options};
use crate::ros2::Message;
use crate::ros2::messages::CanFrame;

/// No record is longer: it would be a length that is no length.
const LONGEST: u64 = 1 << 30;

/// What a recovery came to.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct Recovered {
    /// Messages that were kept.
    pub messages: u64,
    /// Of these, frames of buses.
    pub frames: u64,
    /// The greatest time of a message, in ns since 1970; 0 of none.
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
            0 => write!(f, "; nothing unfinished at the end"),
            bytes => write!(f, "; {bytes} bytes of an unfinished chunk are lost"),
        }?;
        match self.damaged {
            (0, _) => Ok(()),
            (chunks, bytes) => write!(f, "; {chunks} damaged chunks of {bytes} bytes are lost"),
        }?;
        match self.homeless {
            0 => Ok(()),
            messages => write!(f, "; {messages} messages of topics that were described there are lost"),
        }
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

/// A file's records, one after the other, with what is left of it when they end.
struct Records<R> {
    from: R,
    body: Vec<u8>,
    unfinished: u64,
}

impl<R: Read> Records<R> {
    /// The next whole record, into `body`; its operation code.
    fn next(&mut self) -> io::Result<Option<u8>> {
        let mut head = [0; 9];
        let came = read_up_to(&mut self.from, &mut head)?;
        let ([code, len @ ..], true) = (head, came == head.len()) else {
            self.unfinished = came as u64;
            return Ok(None);
        };
        let len = u64::from_le_bytes(len);
        self.body.clear();
        // Grows with what is there, not with what a damaged length says.
        let came = (&mut self.from).take(len.min(LONGEST)).read_to_end(&mut self.body)? as u64;
        if came < len {
            self.unfinished = head.len() as u64 + came + io::copy(&mut self.from, &mut io::sink())?;
            return Ok(None);
        }
        Ok(Some(code))
    }
}

fn read_up_to(from: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    let mut count = 0;
    while let Some(rest) = buffer.get_mut(count..).filter(|rest| !rest.is_empty()) {
        match from.read(rest) {
            Ok(0) => break,
            Ok(read) => count += read,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(count)
}

/// Copies everything whole into a new file, and ends it.
///
/// # Errors
/// When there is nothing to keep, or a file fails.
pub fn recover(from: impl Read, out: impl Write) -> Result<Recovered, RecoverError> {
    let mut records = Records { from, body: Vec::new(), unfinished: 0 };
    let mut magic = [0; MAGIC.len()];
    let came = read_up_to(&mut records.from, &mut magic).map_err(RecoverError::Read)?;
    let began = magic.get(..came).unwrap_or_default();
    if !MAGIC.starts_with(began) {
        return Err(RecoverError::NoMcap { got: began.to_vec() });
    }
    let mut copy = None;
    let mut out = Some(out);
    let mut recovered = Recovered::default();
    while let Some(code) = records.next().map_err(RecoverError::Read)? {
        if code == op::HEADER
            && let Some(out) = out.take()
        {
            copy = Some(Copy::new(&records.body, out).map_err(RecoverError::Write)?);
        }
        let Some(copy) = &mut copy else { continue };
        match code {
            op::CHUNK => match copy.chunk(&records.body) {
                Ok(()) => {}
                Err(Failed::Damaged) => {
                    recovered.damaged.0 += 1;
                    recovered.damaged.1 += records.body.len() as u64;
                }
                Err(Failed::Write(error)) => return Err(RecoverError::Write(error)),
            },
            op::DATA_END => {
                // What follows is made anew.
                recovered.whole = ends_well(&mut records).map_err(RecoverError::Read)?;
                break;
            }
            _ => copy.record(code, &records.body).map_err(RecoverError::Write)?,
        }
    }
    let Some(mut copy) = copy else { return Err(RecoverError::Empty(came as u64 + records.unfinished)) };
    copy.writer.finish().map_err(|error| RecoverError::Write(io_error(error)))?;
    recovered.unfinished = records.unfinished;
    recovered.homeless = copy.homeless;
    recovered.messages = copy.messages;
    recovered.frames = copy.frames;
    recovered.last_nanos = copy.last_nanos;
    Ok(recovered)
}

/// Whether summary, footer and magic follow.
fn ends_well(records: &mut Records<impl Read>) -> io::Result<bool> {
    while let Some(code) = records.next()? {
        if code == op::FOOTER {
            let mut magic = [0; MAGIC.len()];
            return Ok(read_up_to(&mut records.from, &mut magic)? == magic.len() && magic == MAGIC);
        }
    }
    // The index that breaks off is no loss: the new file has its own.
    records.unfinished = 0;
    Ok(false)
}

/// Why a chunk is not in the new file.
enum Failed {
    Damaged,
    Write(io::Error),
}

struct Copy<W: Write> {
    writer: Writer<NoSeek<W>>,
    /// Schemas of frames.
    frame_schemas: BTreeSet<u16>,
    /// Channels whose messages are frames.
    can: BTreeSet<u16>,
    homeless: u64,
    /// A chunk's records, held until all of them are known to be right.
    held: Vec<Record<'static>>,
    messages: u64,
    frames: u64,
    last_nanos: u64,
}

impl<W: Write> Copy<W> {
    fn new(header: &[u8], out: W) -> io::Result<Self> {
        let profile = match parse_record(op::HEADER, header) {
            Ok(Record::Header(header)) => header.profile,
            _ => String::new(),
        };
        let writer = options().profile(profile).create(NoSeek::new(out)).map_err(io_error)?;
        let (frame_schemas, can, held) = (BTreeSet::new(), BTreeSet::new(), Vec::new());
        Ok(Self { writer, frame_schemas, can, homeless: 0, held, messages: 0, frames: 0, last_nanos: 0 })
    }

    /// A chunk's records, if all of them are right.
    fn chunk(&mut self, body: &[u8]) -> Result<(), Failed> {
        self.held.clear();
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true);
        let mut reader = LinearReader::new_with_options(options);
        let head = [&[op::CHUNK][..], &(body.len() as u64).to_le_bytes()].concat();
        let mut rest = head.chain(body);
        while let Some(event) = reader.next_event() {
            match event.map_err(|_| Failed::Damaged)? {
                LinearReadEvent::ReadRequest(need) => {
                    let came = rest.read(reader.insert(need)).map_err(|_| Failed::Damaged)?;
                    reader.notify_read(came);
                    if came == 0 {
                        break;
                    }
                }
                LinearReadEvent::Record { data, opcode } => {
                    let record = parse_record(opcode, data).map_err(|_| Failed::Damaged)?;
                    self.held.push(record.into_owned());
                }
            }
        }
        for record in std::mem::take(&mut self.held) {
            self.keep(record).map_err(Failed::Write)?;
        }
        Ok(())
    }

    /// A record outside of chunks.
    fn record(&mut self, code: u8, body: &[u8]) -> io::Result<()> {
        match parse_record(code, body) {
            Ok(record) => self.keep(record.into_owned()),
            // Nothing that a reader could use; what follows it may be.
            Err(_) => Ok(()),
        }
    }

    fn keep(&mut self, record: Record<'_>) -> io::Result<()> {
        let writer = &mut self.writer;
        let kept = match record {
            Record::Schema { header, data } => {
                if header.name == CanFrame::TYPE {
                    self.frame_schemas.insert(header.id);
                }
                writer.add_schema_with_id(header.id, &header.name, &header.encoding, &data).map(|_| ())
            }
            Record::Channel(channel) => {
                if self.frame_schemas.contains(&channel.schema_id) && channel.topic.starts_with(TOPIC_OF_BUS)
                {
                    self.can.insert(channel.id);
                }
                let Channel { id, schema_id, topic, message_encoding, metadata } = channel;
                writer.add_channel_with_id(id, schema_id, &topic, &message_encoding, &metadata).map(|_| ())
            }
            Record::Message { header, data } => {
                let written = writer.write_to_known_channel(&header, &data);
                if written.is_ok() {
                    self.messages += 1;
                    self.frames += u64::from(self.can.contains(&header.channel_id));
                    self.last_nanos = self.last_nanos.max(header.log_time);
                }
                written
            }
            Record::Attachment {
                header: AttachmentHeader { log_time, create_time, name, media_type },
                data,
                ..
            } => writer.attach(&Attachment { log_time, create_time, name, media_type, data }),
            Record::Metadata(metadata) => writer.write_metadata(&metadata),
            // Made anew, or of no file of ours.
            Record::Header(_)
            | Record::Footer(_)
            | Record::Chunk { .. }
            | Record::MessageIndex(_)
            | Record::ChunkIndex(_)
            | Record::AttachmentIndex(_)
            | Record::Statistics(_)
            | Record::MetadataIndex(_)
            | Record::SummaryOffset(_)
            | Record::DataEnd(_)
            | Record::Unknown { .. } => Ok(()),
        };
        match kept {
            Err(McapError::Io(error)) => Err(error),
            // Its channel or its schema stood in what is lost.
            Err(_) => {
                self.homeless += 1;
                Ok(())
            }
            Ok(()) => Ok(()),
        }
    }
}
