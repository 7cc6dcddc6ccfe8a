//! Writes one MCAP file of a recording: its header, channels and messages.
//!
//! This is the only module that uses the writer of the crate `mcap`.
//! The crate writes the schema and the channel of a message into the chunk of the first message, and again into the
//! summary. This module repeats all schemas and channels outside of chunks, after that chunk and then every
//! [`CHUNKS_PER_DESCRIPTION`] chunks. No single damaged place can therefore make all messages unreadable.

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
use crate::container::{FramedRecord, Record, RecordReader, parse};
use crate::ros2::Message;
use crate::ros2::topic::{MESSAGE_ENCODING, QOS_KEY, SCHEMA_ENCODING};

/// The size of a chunk in bytes before compression. Compressing a larger chunk would block the writer for so long that
/// its queues fill up.
pub const CHUNK_BYTES: u64 = 256 << 10;

/// The number of chunks after which all schemas and channels are written again.
pub const CHUNKS_PER_DESCRIPTION: u32 = 64;

/// The length in bytes of a message record without the message itself.
const MESSAGE_OVERHEAD: u64 = 31;

/// Returns the options for the writer of the crate `mcap`. Seeking is off, so that flushed data stays readable even if
/// the program is killed. Threads are off, because they cost more than they save. Chunk ends and the checksum of the
/// data section are left to [`FileWriter`] and [`SharedOutput`](super::output).
fn mcap_write_options() -> WriteOptions {
    WriteOptions::new()
        .profile(MCAP_PROFILE)
        .library(format!("{PROGRAM_PREFIX}{}", env!("CARGO_PKG_VERSION")))
        .compression(Some(mcap::Compression::Zstd))
        .compression_threads(0)
        .chunk_size(Some(2 * CHUNK_BYTES))
        .calculate_data_section_crc(false)
        .disable_seeking(true)
}

/// The name of the metadata record that stores the identity of the file. A copy of a recording has another identity
/// than it stores.
const IDENTITY_METADATA: &str = "recorder";
/// The key of the file's inode in [`IDENTITY_METADATA`].
const INODE_KEY: &str = "inode";
const BIRTH_TIME_KEY: &str = "born_ns";
/// The MCAP profile of a recording: the conventions that it follows.
const MCAP_PROFILE: &str = "ros2";
/// The beginning of the name of the writing program; the version follows.
const PROGRAM_PREFIX: &str = "skinbus ";

/// Returns the values that distinguish a file from its copies: the inode, and the creation time if the file system
/// stores it, because an inode can be reused.
fn identity(about: &fs::Metadata) -> BTreeMap<String, String> {
    let born = about.created().ok().and_then(|at| at.duration_since(UNIX_EPOCH).ok());
    let born = born.map(|born| (BIRTH_TIME_KEY.to_owned(), born.as_nanos().to_string()));
    [(INODE_KEY.to_owned(), about.ino().to_string())].into_iter().chain(born).collect()
}

/// Returns the first bytes of a recording: magic bytes, header, and a metadata record with the identity of the file
/// whose metadata are `about`.
///
/// # Errors
/// Returns no error in practice, because it writes to memory.
pub fn file_prefix(about: &fs::Metadata) -> io::Result<Vec<u8>> {
    let mut writer = FileWriter::with_file_identity(Vec::new(), about)?;
    writer.flush()?;
    Ok(writer.into_inner())
}

/// Returns true if a file begins with its own identity, in the form of any version of this program. Changes the
/// position in the file.
///
/// # Errors
/// Returns an error if the file cannot be read.
pub fn has_own_identity(file: &mut File) -> io::Result<bool> {
    let target = identity(&file.metadata()?);
    file.rewind()?;
    let mut from = RecordReader::new(file, 0);
    if !from.read_magic()? || from.next()? != FramedRecord::Record(op::HEADER) {
        return Ok(false);
    }
    let header = parse(op::HEADER, from.body());
    let is_ours = matches!(header, Ok(Record::Header { library, .. }) if library.starts_with(PROGRAM_PREFIX));
    if !is_ours || from.next()? != FramedRecord::Record(op::METADATA) {
        return Ok(false);
    }
    let Ok(Record::Metadata { name, facts }) = parse(op::METADATA, from.body()) else { return Ok(false) };
    Ok(name == IDENTITY_METADATA && target.iter().all(|(key, value)| facts.get(key) == Some(value)))
}

/// Converts an error of the crate `mcap` into an I/O error.
#[must_use]
pub fn io_error(error: McapError) -> io::Error {
    if let McapError::Io(error) = error { error } else { io::Error::other(error.to_string()) }
}

/// A channel of a file, with the sequence number of its next message.
#[derive(Clone, Copy, Debug)]
pub struct Channel {
    id: u16,
    sequence: u32,
    is_frames: bool,
}

impl Channel {
    /// Creates a channel with a given number, for a destination that is not a file.
    #[must_use]
    pub const fn with_id(id: u16) -> Self {
        Self { id, sequence: 0, is_frames: false }
    }

    /// Returns the number of the channel.
    #[must_use]
    pub const fn id(&self) -> u16 {
        self.id
    }

    /// Counts a message of the channel. Returns the number of the channel, the sequence number of the message, and true
    /// if the channel holds frames.
    pub(super) const fn next_message(&mut self) -> (u16, u32, bool) {
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        (self.id, sequence, self.is_frames)
    }
}

/// Returns true if a channel with this topic and type holds frames of a bus.
#[must_use]
pub(super) fn is_frame_channel(topic: &str, schema: &str) -> bool {
    schema == Frame::TYPE && topic.starts_with(BUS_TOPIC_PREFIX)
}

/// An MCAP file that is being written. After an error it must not be used any more.
pub struct FileWriter<W: Write> {
    writer: Writer<SharedOutput<W>>,
    output: SharedOutput<W>,
    buffer: Vec<u8>,
    /// The number of complete chunks.
    chunks: u64,
    /// The number of uncompressed bytes in the open chunk.
    open_bytes: u64,
    /// The records of all schemas and channels so far, as they are repeated in the file.
    descriptions: Vec<u8>,
    /// The numbers of the schemas and of the channels in `descriptions`.
    described: (BTreeSet<u16>, BTreeSet<u16>),
    /// The number of chunks since all schemas and channels were last written; `None` if a new one has not been written
    /// yet.
    chunks_since_description: Option<u32>,
}

impl<W: Write> core::fmt::Debug for FileWriter<W> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("FileWriter").field("chunks", &self.chunks).finish_non_exhaustive()
    }
}

impl<W: Write> FileWriter<W> {
    /// Begins a file with the profile of a recording.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written, as all methods below do.
    pub fn new(out: W) -> io::Result<Self> {
        Self::with_profile(out, MCAP_PROFILE)
    }

    /// Begins a file with another profile than that of a recording.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub(super) fn with_profile(out: W, profile: &str) -> io::Result<Self> {
        let output = SharedOutput::new(out);
        let writer = mcap_write_options().profile(profile).create(output.clone()).map_err(io_error)?;
        Ok(Self {
            writer,
            output,
            buffer: Vec::new(),
            chunks: 0,
            open_bytes: 0,
            descriptions: Vec::new(),
            described: (BTreeSet::new(), BTreeSet::new()),
            chunks_since_description: Some(0),
        })
    }

    /// Begins the file of a run's recording. The identity of the file is written after the header.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn with_file_identity(out: W, about: &fs::Metadata) -> io::Result<Self> {
        let mut writer = Self::new(out)?;
        writer.write_metadata(IDENTITY_METADATA, &identity(about))?;
        Ok(writer)
    }

    /// Writes a metadata record.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn write_metadata(&mut self, name: &str, facts: &BTreeMap<String, String>) -> io::Result<()> {
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

    /// Attaches a file whose recording time and creation time differ.
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
        let qos = (QOS_KEY, "");
        let facts = [&qos].into_iter().chain(facts).map(|&(key, value)| (key.to_owned(), value.to_owned()));
        let (facts, definition) = (facts.collect(), M::DEFINITION.as_bytes());
        let schema = self.writer.add_schema(M::TYPE, SCHEMA_ENCODING, definition).map_err(io_error)?;
        self.describe_schema(schema, (M::TYPE, SCHEMA_ENCODING), definition);
        let id = self.writer.add_channel(schema, topic, MESSAGE_ENCODING, &facts).map_err(io_error)?;
        self.describe_channel((id, schema), (topic, MESSAGE_ENCODING), &facts);
        Ok(Channel { id, sequence: 0, is_frames: is_frame_channel(topic, M::TYPE) })
    }

    /// Adds a schema under a given number, as in a file that is copied.
    pub(super) fn add_schema_with_id(
        &mut self,
        id: u16,
        (name, encoding): (&str, &str),
        data: &[u8],
    ) -> io::Result<()> {
        self.writer.add_schema_with_id(id, name, encoding, data).map_err(io_error)?;
        self.describe_schema(id, (name, encoding), data);
        Ok(())
    }

    /// Adds a channel under a given number, for the schema with a given number.
    pub(super) fn add_channel_with_id(
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
        let body = [
            &id.to_le_bytes()[..],
            &length_prefixed(name.as_bytes()),
            &length_prefixed(encoding.as_bytes()),
            &length_prefixed(data),
        ];
        self.add_description(op::SCHEMA, &body.concat());
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
        let facts = facts
            .iter()
            .flat_map(|(key, value)| [length_prefixed(key.as_bytes()), length_prefixed(value.as_bytes())]);
        let facts = length_prefixed(&facts.collect::<Vec<_>>().concat());
        let (topic, encoding) = (length_prefixed(topic.as_bytes()), length_prefixed(encoding.as_bytes()));
        let body = [&id.to_le_bytes()[..], &schema.to_le_bytes(), &topic, &encoding, &facts];
        self.add_description(op::CHANNEL, &body.concat());
    }

    fn add_description(&mut self, opcode: u8, body: &[u8]) {
        // The crate writes the schema and the channel into the chunk too, so the chunk grows by them.
        self.open_bytes += (RECORD_HEADER_BYTES + body.len()) as u64;
        self.descriptions.push(opcode);
        self.descriptions.extend((body.len() as u64).to_le_bytes());
        self.descriptions.extend(body);
        self.chunks_since_description = None;
    }

    /// Writes a message. Memory is allocated only if the chunk is larger than all before it.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn write<M: Message>(&mut self, channel: &mut Channel, nanos: u64, message: &M) -> io::Result<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        message.encode_into(&mut buffer);
        let (id, sequence, _) = channel.next_message();
        let put = self.write_encoded((id, sequence), (nanos, nanos), &buffer);
        self.buffer = buffer;
        put
    }

    /// Writes a message that is already encoded, with its channel number, sequence number, log time and publish time.
    pub(super) fn write_encoded(
        &mut self,
        (channel_id, sequence): (u16, u32),
        (log_time, publish_time): (u64, u64),
        data: &[u8],
    ) -> io::Result<()> {
        if self.open_bytes > CHUNK_BYTES {
            self.end_chunk()?;
        }
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        self.writer.write_to_known_channel(&header, data).map_err(io_error)?;
        self.open_bytes += MESSAGE_OVERHEAD + data.len() as u64;
        Ok(())
    }

    /// Ends the chunk. Writes all schemas and channels after it if one is new or [`CHUNKS_PER_DESCRIPTION`] chunks have
    /// passed.
    fn end_chunk(&mut self) -> io::Result<()> {
        if self.open_bytes == 0 {
            return Ok(());
        }
        self.writer.flush().map_err(io_error)?;
        self.open_bytes = 0;
        self.chunks += 1;
        self.chunks_since_description = match self.chunks_since_description {
            Some(since) if since + 1 < CHUNKS_PER_DESCRIPTION => Some(since + 1),
            Some(_) | None => {
                self.output.insert_records(&self.descriptions)?;
                Some(0)
            }
        };
        Ok(())
    }

    /// Returns the number of chunks so far, including the open one.
    #[must_use]
    pub const fn chunks(&self) -> u64 {
        self.chunks + 1
    }

    /// Ends the chunk and flushes the output. Everything up to here can then be read even if the program is killed.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.output.flush_output()
    }

    /// Ends the file with indexes and statistics, which readers need for seeking.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn finish(&mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.output.expect_data_end();
        self.writer.finish().map_err(io_error)?;
        self.output.flush_output()
    }

    /// Returns the output. The file has no end unless [`FileWriter::finish`] wrote it.
    ///
    /// # Panics
    /// Never in practice: this method drops the only other handle of the output.
    #[must_use]
    pub fn into_inner(self) -> W {
        drop(self.writer.into_inner());
        self.output.into_inner().expect("the writer was the other handle")
    }
}

/// The length of a record's header in bytes: operation code and length.
const RECORD_HEADER_BYTES: usize = 9;

/// Encodes a string as MCAP does: its length in 32 bits, then its bytes.
fn length_prefixed(bytes: &[u8]) -> Vec<u8> {
    [&u32::try_from(bytes.len()).unwrap_or(u32::MAX).to_le_bytes()[..], bytes].concat()
}
