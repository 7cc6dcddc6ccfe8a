//! Reads the messages of a recording as they are in the file, of all topics, from any time on.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Seek, SeekFrom};
use std::path::PathBuf;

use ::mcap::records::op;

use super::CaptureError;
use super::magic::is_mcap;
use super::mcap::ReadFault;
use super::place::{SeekIndex, SeekPoint};
use crate::container::{
    Chunk, FormatError, FramedRecord, MAX_RECORD_BYTES, NameBudget, Record, RecordReader, parse,
};
use crate::ros2::topic::{QOS_KEY, is_latched};

/// The number of bytes that are read at once.
const READ_BYTES: usize = 1 << 18;

/// A topic as a recording describes it.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct ChannelDescription {
    /// The name of the topic.
    pub topic: String,
    /// The encoding of the messages, such as `cdr`.
    pub encoding: String,
    /// The name of the message type.
    pub schema_name: String,
    /// The language of the definition, such as `ros2msg`.
    pub schema_encoding: String,
    /// The definition of the message type.
    pub schema: Vec<u8>,
    /// True if readers that join later need the last message.
    pub is_latched: bool,
}

/// A message as it is in the file.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct RecordedMessage<'a> {
    /// The index of the channel in [`MessageReader::channels`].
    pub channel: usize,
    /// The time by which the file is sorted, in ns since 1970.
    pub log_nanos: u64,
    /// The encoded message.
    pub message: &'a [u8],
}

/// A schema: name, encoding and definition.
type Schema = (String, String, Vec<u8>);

/// The numbers of the schemas and channels in one file.
#[derive(Debug, Default)]
struct FileNumbers {
    schemas: BTreeMap<u16, Schema>,
    channels: BTreeMap<u16, usize>,
}

/// A message that was found but not returned yet. Its bytes are in the chunk or in the source.
#[derive(Clone, Copy, Debug)]
struct FoundMessage {
    channel: usize,
    log_nanos: u64,
    in_chunk: bool,
}

/// Reads the messages of a recording in the order of its files. All files must be MCAP files.
#[derive(Debug)]
pub struct MessageReader {
    places: SeekIndex,
    channels: Vec<ChannelDescription>,
    names: NameBudget,
    numbers: FileNumbers,
    part: usize,
    source: Option<RecordReader<BufReader<File>>>,
    chunk: Chunk,
    in_chunk: bool,
    found: Option<FoundMessage>,
    messages: u64,
}

impl MessageReader {
    /// Opens the parts of a recording, given in any order, at its beginning.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if a file cannot be read or is not seekable, or if the files are not parts of one
    /// recording.
    pub fn open(paths: &[PathBuf]) -> Result<Self, CaptureError> {
        let mut reader = Self {
            places: SeekIndex::open(paths)?,
            channels: Vec::new(),
            names: NameBudget::default(),
            numbers: FileNumbers::default(),
            part: 0,
            source: None,
            chunk: Chunk::default(),
            in_chunk: false,
            found: None,
            messages: 0,
        };
        for part in (0..reader.places.parts.len()).rev() {
            reader.part = part;
            reader.learn_channels_of_part().map_err(|fault| reader.capture_error(fault))?;
        }
        reader.go_to(SeekPoint::default())?;
        Ok(reader)
    }

    /// Returns the channels that are known so far: those that a file describes outside of its chunks, and those that
    /// were read.
    #[must_use]
    pub fn channels(&self) -> &[ChannelDescription] {
        &self.channels
    }

    /// Goes to the first message at or after a time, in ns since 1970.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if a file cannot be read or is damaged.
    pub fn seek(&mut self, nanos: u64) -> Result<(), CaptureError> {
        self.go_to(self.places.point_before(nanos))?;
        while self.find()?.is_some_and(|found| found.log_nanos < nanos) {
            self.found = None;
        }
        Ok(())
    }

    /// Returns the next message, unless it is later than `until`, in ns since 1970. Returns `None` after the last
    /// message, too.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if a file cannot be read or is damaged; reading ends then.
    pub fn next_until(&mut self, until: u64) -> Result<Option<RecordedMessage<'_>>, CaptureError> {
        let Some(found) = self.find()?.filter(|found| found.log_nanos <= until) else { return Ok(None) };
        self.found = None;
        let source = self.source.as_ref().map_or(&[][..], RecordReader::body);
        let body = if found.in_chunk { self.chunk.body() } else { source };
        let Ok(Record::Message { data, .. }) = parse(op::MESSAGE, body) else { return Ok(None) };
        Ok(Some(RecordedMessage { channel: found.channel, log_nanos: found.log_nanos, message: data }))
    }

    fn go_to(&mut self, place: SeekPoint) -> Result<(), CaptureError> {
        self.part = place.part;
        (self.in_chunk, self.found, self.source) = (false, None, None);
        let opened = self.learn_channels_of_part().and_then(|()| self.open_part(place.offset));
        opened.map_err(|fault| self.capture_error(fault))
    }

    /// Opens the present part at the offset of a record; 0 stands for the first record.
    fn open_part(&mut self, offset: u64) -> Result<(), ReadFault> {
        let Some(path) = self.places.path(self.part) else { return Ok(()) };
        let mut file = File::open(path)?;
        if !is_mcap(&mut file)? {
            return Err(FormatError::Magic.into());
        }
        file.seek(SeekFrom::Start(offset))?;
        let input = BufReader::with_capacity(READ_BYTES, file);
        let mut source = RecordReader::resume_at(offset, input, 0);
        if offset == 0 {
            source.read_magic()?;
        }
        (self.source, self.chunk) = (Some(source), Chunk::default());
        Ok(())
    }

    /// Reads up to the next message, which stays found until it is returned.
    fn find(&mut self) -> Result<Option<FoundMessage>, CaptureError> {
        while self.found.is_none() {
            if self.source.is_none() {
                if self.part + 1 >= self.places.parts.len() {
                    return Ok(None);
                }
                self.go_to(SeekPoint { part: self.part + 1, ..SeekPoint::default() })?;
            }
            if let Err(fault) = self.read_record() {
                let error = self.capture_error(fault);
                // Nothing is read after damage.
                (self.source, self.part) = (None, self.places.parts.len());
                return Err(error);
            }
        }
        Ok(self.found)
    }

    fn read_record(&mut self) -> Result<(), ReadFault> {
        let Some(mut source) = self.source.take() else { return Ok(()) };
        if self.in_chunk {
            let mut chunk = std::mem::take(&mut self.chunk);
            match chunk.next() {
                Some((opcode, body)) => self.process_record(opcode, body, true)?,
                None => self.in_chunk = false,
            }
            (self.chunk, self.source) = (chunk, Some(source));
            return Ok(());
        }
        let framed = source.next()?;
        source.check(framed)?;
        match framed {
            FramedRecord::Record(op::CHUNK) => {
                self.chunk.unpack(source.body(), source.bytes_read())?;
                self.in_chunk = true;
            }
            // The messages of the part end here. What is missing in an unfinished one is told by the capture's reader.
            FramedRecord::Record(op::DATA_END | op::FOOTER)
            | FramedRecord::Truncated(..)
            | FramedRecord::End(_) => return Ok(()),
            FramedRecord::Record(opcode) => self.process_record(opcode, source.body(), false)?,
            FramedRecord::Oversized(op::ATTACHMENT, _)
            | FramedRecord::Skipped(..)
            | FramedRecord::Unknown(..) => {}
            FramedRecord::Oversized(_, bytes) => {
                return Err(FormatError::TooLong { what: "record", bytes, limit: MAX_RECORD_BYTES }.into());
            }
        }
        self.source = Some(source);
        Ok(())
    }

    fn process_record(&mut self, opcode: u8, body: &[u8], in_chunk: bool) -> Result<(), ReadFault> {
        match opcode {
            op::SCHEMA | op::CHANNEL => self.describe(opcode, body),
            op::MESSAGE => {
                let Record::Message { channel, log_time, .. } = parse(opcode, body)? else { return Ok(()) };
                let known = self.numbers.channels.get(&channel).copied();
                let channel = known.ok_or(FormatError::Channel(channel))?;
                self.messages += 1;
                self.found = Some(FoundMessage { channel, log_nanos: log_time, in_chunk });
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Learns the schemas and channels that the present part describes outside of its chunks.
    fn learn_channels_of_part(&mut self) -> Result<(), ReadFault> {
        self.numbers = FileNumbers::default();
        let Some(part) = self.places.parts.get(self.part) else { return Ok(()) };
        let descriptions = part.descriptions.clone();
        descriptions.iter().try_for_each(|(opcode, body)| self.describe(*opcode, body))
    }

    fn describe(&mut self, opcode: u8, body: &[u8]) -> Result<(), ReadFault> {
        match parse(opcode, body)? {
            Record::Schema { id, name, encoding, data } if !self.numbers.schemas.contains_key(&id) => {
                self.names.add(name.len() + encoding.len() + data.len())?;
                let schema = (name.to_owned(), encoding.to_owned(), data.to_vec());
                self.numbers.schemas.insert(id, schema);
            }
            Record::Channel { id, schema, topic, encoding, facts }
                if !self.numbers.channels.contains_key(&id) =>
            {
                self.names.add(topic.len() + encoding.len())?;
                let schema = self.numbers.schemas.get(&schema).cloned();
                let (schema_name, schema_encoding, schema) = schema.unwrap_or_default();
                let described = ChannelDescription {
                    topic: topic.to_owned(),
                    encoding: encoding.to_owned(),
                    schema_name,
                    schema_encoding,
                    schema,
                    is_latched: facts.get(QOS_KEY).is_some_and(is_latched),
                };
                let index = self.channels.iter().position(|known| *known == described);
                let index = index.unwrap_or_else(|| {
                    self.channels.push(described);
                    self.channels.len() - 1
                });
                self.numbers.channels.insert(id, index);
            }
            Record::Schema { .. }
            | Record::Channel { .. }
            | Record::Header { .. }
            | Record::Message { .. }
            | Record::Attachment { .. }
            | Record::Metadata { .. }
            | Record::Footer { .. }
            | Record::DataEnd { .. }
            | Record::Other => {}
        }
        Ok(())
    }

    fn capture_error(&self, fault: ReadFault) -> CaptureError {
        let path = self.places.path(self.part).or_else(|| self.places.path(0));
        let name = path.map(|path| path.display().to_string()).unwrap_or_default();
        fault.into_capture_error(&name, self.messages)
    }
}

#[cfg(test)]
#[path = "messages/tests.rs"]
mod tests;
