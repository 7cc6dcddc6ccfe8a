//! One MCAP file as it is written: what it is made of, its channels, its messages.
//!
//! The only place that knows the crate `mcap` and the settings that a recording needs.
//!
//! Types and topics are described where the crate does it, in the chunk of their first message; outside of chunks, behind
//! that chunk and again every [`DESCRIBED_EVERY`] chunks; and in the summary. So no damaged place of a file takes what all
//! others need.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{self, Seek, Write};
use std::os::unix::fs::MetadataExt;
use std::time::UNIX_EPOCH;

use mcap::records::{MessageHeader, op};
use mcap::write::Metadata;
use mcap::{Attachment, McapError, WriteOptions, Writer};
use protocol::candump::Record as Frame;

use super::TOPIC_OF_BUS;
use super::output::Output;
use crate::container::{Framed, Record, Source, parse};
use crate::ros2::Message;

/// Bytes that are compressed together; larger ones take a writer's time in pieces that queues feel.
pub const CHUNK: u64 = 256 << 10;

/// Chunks between two descriptions of all types and topics.
pub const DESCRIBED_EVERY: u32 = 64;

/// Bytes of a message's record beside its own.
const HEAD: u64 = 31;

/// The settings of every file that is written: no seeking, so that what has been flushed stays readable
/// whatever happens afterwards; no threads, which cost more than they save. Chunks are ended by the [`FileWriter`], and the
/// checksum of the data section is that of the [`Output`].
fn options() -> WriteOptions {
    WriteOptions::new()
        .profile(PROFILE)
        .library(format!("{PROGRAM}{}", env!("CARGO_PKG_VERSION")))
        .compression(Some(mcap::Compression::Zstd))
        .compression_threads(0)
        .chunk_size(Some(2 * CHUNK))
        .calculate_data_section_crc(false)
        .disable_seeking(true)
}

/// The metadata that says which file a recording was begun in.
const MARK: &str = "recorder";
/// The fact that says it.
const INODE: &str = "inode";
const BORN: &str = "born_ns";
/// The conventions that a recording follows.
const PROFILE: &str = "ros2";
/// Who writes.
const PROGRAM: &str = "skinbus ";

/// What tells a file from a copy of it: its inode, and since inodes are used again, when it was made, where the file
/// system knows that.
fn identity(about: &fs::Metadata) -> BTreeMap<String, String> {
    let born = about.created().ok().and_then(|at| at.duration_since(UNIX_EPOCH).ok());
    let born = born.map(|born| (BORN.to_owned(), born.as_nanos().to_string()));
    [(INODE.to_owned(), about.ino().to_string())].into_iter().chain(born).collect()
}

/// What a recording's file begins with: that it is ours, and not a copy of ours.
///
/// # Errors
/// Never, into memory.
pub fn mark(about: &fs::Metadata) -> io::Result<Vec<u8>> {
    let mut writer = FileWriter::in_file(Vec::new(), about)?;
    writer.flush()?;
    Ok(writer.into_inner())
}

/// Whether a file begins with its mark, of whatever version; its place is moved.
///
/// # Errors
/// When it cannot be read.
pub fn is_marked(file: &mut File) -> io::Result<bool> {
    let target = identity(&file.metadata()?);
    file.rewind()?;
    let mut from = Source::new(file, 0);
    if !from.magic()? || from.next()? != Framed::Record(op::HEADER) {
        return Ok(false);
    }
    let header = parse(op::HEADER, from.body());
    let is_ours = matches!(header, Ok(Record::Header { library, .. }) if library.starts_with(PROGRAM));
    if !is_ours || from.next()? != Framed::Record(op::METADATA) {
        return Ok(false);
    }
    let Ok(Record::Metadata { name, facts }) = parse(op::METADATA, from.body()) else { return Ok(false) };
    Ok(name == MARK && target.iter().all(|(key, value)| facts.get(key) == Some(value)))
}

/// What was written cannot go on.
#[must_use]
pub fn io_error(error: McapError) -> io::Error {
    if let McapError::Io(error) = error { error } else { io::Error::other(error.to_string()) }
}

/// A topic of a file.
#[derive(Clone, Copy, Debug)]
pub struct Channel {
    id: u16,
    sequence: u32,
    is_frames: bool,
}

impl Channel {
    /// Its number in the file.
    pub(super) const fn id(&self) -> u16 {
        self.id
    }

    /// Its number, that of its next message, and whether that is a frame of a bus.
    pub(super) const fn next(&mut self) -> (u16, u32, bool) {
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        (self.id, sequence, self.is_frames)
    }
}

/// Whether a topic of messages of a type is frames of a bus.
#[must_use]
pub(super) fn is_frames(topic: &str, schema: &str) -> bool {
    schema == Frame::TYPE && topic.starts_with(TOPIC_OF_BUS)
}

/// A file that is being written. After an error it takes nothing more.
pub struct FileWriter<W: Write> {
    writer: Writer<Output<W>>,
    output: Output<W>,
    buffer: Vec<u8>,
    /// Chunks that were ended.
    chunks: u64,
    /// Uncompressed bytes in the chunk that is open.
    open: u64,
    /// The records of all types and topics.
    descriptions: Vec<u8>,
    /// Which of them are in it.
    described: (BTreeSet<u16>, BTreeSet<u16>),
    /// Chunks since they were written; `None` when some were never.
    since: Option<u32>,
}

impl<W: Write> core::fmt::Debug for FileWriter<W> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("FileWriter").field("chunks", &self.chunks).finish_non_exhaustive()
    }
}

impl<W: Write> FileWriter<W> {
    /// Begins a file.
    ///
    /// # Errors
    /// When it cannot be written, as of everything below.
    pub fn new(out: W) -> io::Result<Self> {
        Self::with_profile(out, PROFILE)
    }

    /// Begins a file that follows other conventions.
    ///
    /// # Errors
    /// See above.
    pub(super) fn with_profile(out: W, profile: &str) -> io::Result<Self> {
        let output = Output::new(out);
        let writer = options().profile(profile).create(output.clone()).map_err(io_error)?;
        Ok(Self {
            writer,
            output,
            buffer: Vec::new(),
            chunks: 0,
            open: 0,
            descriptions: Vec::new(),
            described: (BTreeSet::new(), BTreeSet::new()),
            since: Some(0),
        })
    }

    /// Begins the file of a run's recording, with its mark.
    ///
    /// # Errors
    /// See above.
    pub fn in_file(out: W, about: &fs::Metadata) -> io::Result<Self> {
        let mut writer = Self::new(out)?;
        writer.metadata(MARK, &identity(about))?;
        Ok(writer)
    }

    /// Facts by name.
    ///
    /// # Errors
    /// See above.
    pub fn metadata(&mut self, name: &str, facts: &BTreeMap<String, String>) -> io::Result<()> {
        self.end_chunk()?;
        let record = Metadata { name: name.to_owned(), metadata: facts.clone() };
        self.writer.write_metadata(&record).map_err(io_error)
    }

    /// A file in the file, as it is.
    ///
    /// # Errors
    /// See above.
    pub fn attach(&mut self, name: &str, media_type: &str, nanos: u64, bytes: &[u8]) -> io::Result<()> {
        self.attach_at(name, media_type, (nanos, nanos), bytes)
    }

    /// The same with both of its times: when it was recorded, and when it was made.
    pub(super) fn attach_at(
        &mut self,
        name: &str,
        media_type: &str,
        (log_time, create_time): (u64, u64),
        bytes: &[u8],
    ) -> io::Result<()> {
        self.end_chunk()?;
        let (name, media_type) = (name.to_owned(), media_type.to_owned());
        let attachment = Attachment { log_time, create_time, name, media_type, data: bytes.into() };
        self.writer.attach(&attachment).map_err(io_error)
    }

    /// A topic for messages of a type; `facts` is what else the file says of it.
    ///
    /// # Errors
    /// See above.
    pub fn channel<M: Message>(&mut self, topic: &str, facts: &[(&str, &str)]) -> io::Result<Channel> {
        // Bag tools want to find it, and take it empty.
        let qos = ("offered_qos_profiles", "");
        let facts = [&qos].into_iter().chain(facts).map(|&(key, value)| (key.to_owned(), value.to_owned()));
        let (facts, definition) = (facts.collect(), M::DEFINITION.as_bytes());
        let schema = self.writer.add_schema(M::TYPE, "ros2msg", definition).map_err(io_error)?;
        self.describe_schema(schema, (M::TYPE, "ros2msg"), definition);
        let id = self.writer.add_channel(schema, topic, "cdr", &facts).map_err(io_error)?;
        self.describe_channel((id, schema), (topic, "cdr"), &facts);
        Ok(Channel { id, sequence: 0, is_frames: is_frames(topic, M::TYPE) })
    }

    /// A type with a number of its own.
    pub(super) fn schema_as(
        &mut self,
        id: u16,
        (name, encoding): (&str, &str),
        data: &[u8],
    ) -> io::Result<()> {
        self.writer.add_schema_with_id(id, name, encoding, data).map_err(io_error)?;
        self.describe_schema(id, (name, encoding), data);
        Ok(())
    }

    /// A topic with a number of its own, and that of its messages' type.
    pub(super) fn channel_as(
        &mut self,
        (id, schema): (u16, u16),
        (topic, encoding): (&str, &str),
        facts: &BTreeMap<String, String>,
    ) -> io::Result<()> {
        self.writer.add_channel_with_id(id, schema, topic, encoding, facts).map_err(io_error)?;
        self.describe_channel((id, schema), (topic, encoding), facts);
        Ok(())
    }

    fn describe_schema(&mut self, id: u16, (name, encoding): (&str, &str), data: &[u8]) {
        if !self.described.0.insert(id) {
            return;
        }
        let body = [&id.to_le_bytes()[..], &text(name.as_bytes()), &text(encoding.as_bytes()), &text(data)];
        self.describe(op::SCHEMA, &body.concat());
    }

    fn describe_channel(
        &mut self,
        (id, schema): (u16, u16),
        (topic, encoding): (&str, &str),
        facts: &BTreeMap<String, String>,
    ) {
        if !self.described.1.insert(id) {
            return;
        }
        let facts = facts.iter().flat_map(|(key, value)| [text(key.as_bytes()), text(value.as_bytes())]);
        let facts = text(&facts.collect::<Vec<_>>().concat());
        let (topic, encoding) = (text(topic.as_bytes()), text(encoding.as_bytes()));
        let body = [&id.to_le_bytes()[..], &schema.to_le_bytes(), &topic, &encoding, &facts];
        self.describe(op::CHANNEL, &body.concat());
    }

    fn describe(&mut self, opcode: u8, body: &[u8]) {
        // The crate puts it into the chunk too.
        self.open += (HEAD_OF_RECORD + body.len()) as u64;
        self.descriptions.push(opcode);
        self.descriptions.extend((body.len() as u64).to_le_bytes());
        self.descriptions.extend(body);
        self.since = None;
    }

    /// A message. Nothing is allocated for it but the chunk's growth.
    ///
    /// # Errors
    /// See above.
    pub fn write<M: Message>(&mut self, channel: &mut Channel, nanos: u64, message: &M) -> io::Result<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        message.encode_into(&mut buffer);
        let (id, sequence, _) = channel.next();
        let put = self.put((id, sequence), (nanos, nanos), &buffer);
        self.buffer = buffer;
        put
    }

    /// The bytes of a channel's message: its numbers, when it is logged and when it was published.
    pub(super) fn put(
        &mut self,
        (channel_id, sequence): (u16, u32),
        (log_time, publish_time): (u64, u64),
        data: &[u8],
    ) -> io::Result<()> {
        if self.open > CHUNK {
            self.end_chunk()?;
        }
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        self.writer.write_to_known_channel(&header, data).map_err(io_error)?;
        self.open += HEAD + data.len() as u64;
        Ok(())
    }

    /// Ends the chunk, and describes types and topics behind it when it is time.
    fn end_chunk(&mut self) -> io::Result<()> {
        if self.open == 0 {
            return Ok(());
        }
        self.writer.flush().map_err(io_error)?;
        self.open = 0;
        self.chunks += 1;
        self.since = match self.since {
            Some(since) if since + 1 < DESCRIBED_EVERY => Some(since + 1),
            Some(_) | None => {
                self.output.records(&self.descriptions)?;
                Some(0)
            }
        };
        Ok(())
    }

    /// At least as many chunks as there are so far.
    #[must_use]
    pub const fn chunks(&self) -> u64 {
        self.chunks + 1
    }

    /// Ends the chunk and hands everything on: what is in the file from here on can be read.
    ///
    /// # Errors
    /// See above.
    pub fn flush(&mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.output.hand_on()
    }

    /// Writes the end: indexes and figures, by which readers find their way.
    ///
    /// # Errors
    /// See above.
    pub fn finish(&mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.output.begin_end();
        self.writer.finish().map_err(io_error)?;
        self.output.hand_on()
    }

    /// The output, without an end if none was written.
    ///
    /// # Panics
    /// Never: nobody else has the output.
    #[must_use]
    pub fn into_inner(self) -> W {
        drop(self.writer.into_inner());
        self.output.into_inner().expect("the writer was the other handle")
    }
}

/// Bytes of an operation code and a length.
const HEAD_OF_RECORD: usize = 9;

/// Bytes behind their length, as the format has strings.
fn text(bytes: &[u8]) -> Vec<u8> {
    [&u32::try_from(bytes.len()).unwrap_or(u32::MAX).to_le_bytes()[..], bytes].concat()
}
