//! Writes one MCAP file: its settings, channels and messages.
//!
//! This is the only module that uses the writer of the crate `mcap`.
//!
//! Schemas and channels are written by the crate in the chunk of their first message. This module repeats them outside
//! of chunks, after that chunk and then every [`DESCRIBED_EVERY`] chunks; the crate also writes them in the summary. No
//! single damaged place in a file therefore destroys what all messages need.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{self, Seek, Write};
use std::os::unix::fs::MetadataExt;
use std::time::UNIX_EPOCH;

use mcap::records::{MessageHeader, op};
use mcap::write::Metadata;
use mcap::{Attachment, McapError, WriteOptions, Writer};
use protocol::candump::Record as Frame;

use super::BUS_TOPIC_PREFIX;
use super::output::SharedOutput;
use crate::container::{Framed, Record, RecordReader, parse};
use crate::ros2::Message;

/// The number of bytes that are compressed together. Larger chunks block the writer for so long that its queues fill
/// up.
pub const CHUNK_BYTES: u64 = 256 << 10;

/// The number of chunks between two descriptions of all schemas and channels.
pub const CHUNKS_PER_DESCRIPTION: u32 = 64;

/// The overhead of a message record in bytes.
const MESSAGE_OVERHEAD: u64 = 31;

/// Returns the settings of every written file. The crate does not seek, so that flushed data stays readable whatever
/// happens afterwards, and uses no threads, which cost more than they save. The [`FileWriter`] ends chunks, and the
/// [`Output`] computes the checksum of the data section.
fn options() -> WriteOptions {
    WriteOptions::new()
        .profile(PROFILE)
        .library(format!("{PROGRAM}{}", env!("CARGO_PKG_VERSION")))
        .compression(Some(mcap::Compression::Zstd))
        .compression_threads(0)
        .chunk_size(Some(2 * CHUNK_BYTES))
        .calculate_data_section_crc(false)
        .disable_seeking(true)
}

/// The name of the metadata record that identifies the file in which a recording was begun.
const MARK: &str = "recorder";
/// The key of the inode in [`MARK`].
const INODE: &str = "inode";
const BORN: &str = "born_ns";
/// The conventions that a recording follows.
const PROFILE: &str = "ros2";
/// The name of the writing program.
const PROGRAM: &str = "skinbus ";

/// Returns the identity that distinguishes a file from a copy: its inode, and its creation time if the file system
/// stores it, because inodes are reused.
fn identity(about: &fs::Metadata) -> BTreeMap<String, String> {
    let born = about.created().ok().and_then(|at| at.duration_since(UNIX_EPOCH).ok());
    let born = born.map(|born| (BORN.to_owned(), born.as_nanos().to_string()));
    [(INODE.to_owned(), about.ino().to_string())].into_iter().chain(born).collect()
}

/// Returns the beginning of a recording: magic bytes, header, and the identity of the file `about`.
///
/// # Errors
/// Never returns one, because it writes to memory.
pub fn mark(about: &fs::Metadata) -> io::Result<Vec<u8>> {
    let mut writer = FileWriter::in_file(Vec::new(), about)?;
    writer.flush()?;
    Ok(writer.into_inner())
}

/// Returns true if a file begins with its own identity, written by any version of this program. Moves the position in
/// the file.
///
/// # Errors
/// Returns an error if the file cannot be read.
pub fn is_marked(file: &mut File) -> io::Result<bool> {
    let target = identity(&file.metadata()?);
    file.rewind()?;
    let mut from = RecordReader::new(file, 0);
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

/// Converts an error of the crate `mcap` into an I/O error.
#[must_use]
pub fn io_error(error: McapError) -> io::Error {
    if let McapError::Io(error) = error { error } else { io::Error::other(error.to_string()) }
}

/// A channel of a file.
#[derive(Clone, Copy, Debug)]
pub struct Channel {
    id: u16,
    sequence: u32,
    is_frames: bool,
}

impl Channel {
    /// Returns the number of the channel.
    pub(super) const fn id(&self) -> u16 {
        self.id
    }

    /// Returns the number of the channel, the sequence number of its next message, and true if it holds frames of a
    /// bus.
    pub(super) const fn next(&mut self) -> (u16, u32, bool) {
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        (self.id, sequence, self.is_frames)
    }
}

/// Returns true if a channel holds frames of a bus.
#[must_use]
pub(super) fn is_frames(topic: &str, schema: &str) -> bool {
    schema == Frame::TYPE && topic.starts_with(BUS_TOPIC_PREFIX)
}

/// A file that is being written. It is unusable after an error.
pub struct FileWriter<W: Write> {
    writer: Writer<SharedOutput<W>>,
    output: SharedOutput<W>,
    buffer: Vec<u8>,
    /// The number of complete chunks.
    chunks: u64,
    /// The number of uncompressed bytes in the open chunk.
    open: u64,
    /// The records of all schemas and channels.
    descriptions: Vec<u8>,
    /// The numbers of the schemas and channels in `descriptions`.
    described: (BTreeSet<u16>, BTreeSet<u16>),
    /// The number of chunks since the descriptions were written; `None` if some have not been written yet.
    chunks_since_description: Option<u32>,
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
    /// Returns an error if the file cannot be written, as all methods below do.
    pub fn new(out: W) -> io::Result<Self> {
        Self::with_profile(out, PROFILE)
    }

    /// Begins a file that follows other conventions.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub(super) fn with_profile(out: W, profile: &str) -> io::Result<Self> {
        let output = SharedOutput::new(out);
        let writer = options().profile(profile).create(output.clone()).map_err(io_error)?;
        Ok(Self {
            writer,
            output,
            buffer: Vec::new(),
            chunks: 0,
            open: 0,
            descriptions: Vec::new(),
            described: (BTreeSet::new(), BTreeSet::new()),
            chunks_since_description: Some(0),
        })
    }

    /// Begins the file of a run's recording, with its identity.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn in_file(out: W, about: &fs::Metadata) -> io::Result<Self> {
        let mut writer = Self::new(out)?;
        writer.metadata(MARK, &identity(about))?;
        Ok(writer)
    }

    /// Writes a metadata record.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn metadata(&mut self, name: &str, facts: &BTreeMap<String, String>) -> io::Result<()> {
        self.end_chunk()?;
        let record = Metadata { name: name.to_owned(), metadata: facts.clone() };
        self.writer.write_metadata(&record).map_err(io_error)
    }

    /// Attaches a file.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn attach(&mut self, name: &str, media_type: &str, nanos: u64, bytes: &[u8]) -> io::Result<()> {
        self.attach_at(name, media_type, (nanos, nanos), bytes)
    }

    /// Attaches a file with separate times of recording and creation.
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

    /// Adds a channel for messages of a type, with metadata.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn channel<M: Message>(&mut self, topic: &str, facts: &[(&str, &str)]) -> io::Result<Channel> {
        // Bag tools require the key, and accept an empty value.
        let qos = ("offered_qos_profiles", "");
        let facts = [&qos].into_iter().chain(facts).map(|&(key, value)| (key.to_owned(), value.to_owned()));
        let (facts, definition) = (facts.collect(), M::DEFINITION.as_bytes());
        let schema = self.writer.add_schema(M::TYPE, "ros2msg", definition).map_err(io_error)?;
        self.describe_schema(schema, (M::TYPE, "ros2msg"), definition);
        let id = self.writer.add_channel(schema, topic, "cdr", &facts).map_err(io_error)?;
        self.describe_channel((id, schema), (topic, "cdr"), &facts);
        Ok(Channel { id, sequence: 0, is_frames: is_frames(topic, M::TYPE) })
    }

    /// Adds a schema with a given number.
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

    /// Adds a channel with given numbers of its own and of its schema.
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
        // The crate also writes the description into the chunk.
        self.open += (HEAD_OF_RECORD + body.len()) as u64;
        self.descriptions.push(opcode);
        self.descriptions.extend((body.len() as u64).to_le_bytes());
        self.descriptions.extend(body);
        self.chunks_since_description = None;
    }

    /// Writes a message. Allocates only when the chunk grows.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn write<M: Message>(&mut self, channel: &mut Channel, nanos: u64, message: &M) -> io::Result<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        message.encode_into(&mut buffer);
        let (id, sequence, _) = channel.next();
        let put = self.put((id, sequence), (nanos, nanos), &buffer);
        self.buffer = buffer;
        put
    }

    /// Writes an encoded message with its channel and sequence numbers, and its times of logging and publishing.
    pub(super) fn put(
        &mut self,
        (channel_id, sequence): (u16, u32),
        (log_time, publish_time): (u64, u64),
        data: &[u8],
    ) -> io::Result<()> {
        if self.open > CHUNK_BYTES {
            self.end_chunk()?;
        }
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        self.writer.write_to_known_channel(&header, data).map_err(io_error)?;
        self.open += MESSAGE_OVERHEAD + data.len() as u64;
        Ok(())
    }

    /// Ends the chunk, and writes the descriptions after it if they are due.
    fn end_chunk(&mut self) -> io::Result<()> {
        if self.open == 0 {
            return Ok(());
        }
        self.writer.flush().map_err(io_error)?;
        self.open = 0;
        self.chunks += 1;
        self.chunks_since_description = match self.chunks_since_description {
            Some(since) if since + 1 < CHUNKS_PER_DESCRIPTION => Some(since + 1),
            Some(_) | None => {
                self.output.records(&self.descriptions)?;
                Some(0)
            }
        };
        Ok(())
    }

    /// Returns an upper bound of the number of chunks so far.
    #[must_use]
    pub const fn chunks(&self) -> u64 {
        self.chunks + 1
    }

    /// Ends the chunk and flushes the output: the file can be read up to here from now on.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.output.hand_on()
    }

    /// Writes the end of the file: indexes and statistics for seeking.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn finish(&mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.output.begin_end();
        self.writer.finish().map_err(io_error)?;
        self.output.hand_on()
    }

    /// Returns the output. The file has no end unless [`FileWriter::finish`] wrote it.
    ///
    /// # Panics
    /// Never: the other handle of the output is dropped here.
    #[must_use]
    pub fn into_inner(self) -> W {
        drop(self.writer.into_inner());
        self.output.into_inner().expect("the writer was the other handle")
    }
}

/// The length of a record's header in bytes: operation code and length.
const HEAD_OF_RECORD: usize = 9;

/// Encodes bytes after their length, as the format stores strings.
fn text(bytes: &[u8]) -> Vec<u8> {
    [&u32::try_from(bytes.len()).unwrap_or(u32::MAX).to_le_bytes()[..], bytes].concat()
}
