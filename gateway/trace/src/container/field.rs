//! Decodes the fields of MCAP records.

use std::collections::BTreeMap;

use mcap::records::op;

use super::{FormatError, MAX_DESCRIPTION_BYTES};

/// A decoded record. It has only the fields that are needed to read a recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Record<'a> {
    /// The beginning of a file.
    Header {
        /// The profile: the conventions that the file follows, such as `ros2`.
        profile: &'a str,
        /// The name of the program that wrote the file.
        library: &'a str,
    },
    /// The definition of a message type.
    Schema {
        /// The number of the schema.
        id: u16,
        /// The name of the type.
        name: &'a str,
        /// The language of the definition, such as `ros2msg`.
        encoding: &'a str,
        /// The definition of the type.
        data: &'a [u8],
    },
    /// A channel: a topic with a type of messages.
    Channel {
        /// The number of the channel.
        id: u16,
        /// The number of the channel's schema; 0 if the channel has none.
        schema: u16,
        /// The name of the topic.
        topic: &'a str,
        /// The encoding of its messages.
        encoding: &'a str,
        /// The metadata of the channel.
        facts: MetadataMap<'a>,
    },
    /// A message.
    Message {
        /// The number of the message's channel.
        channel: u16,
        /// The sequence number of the message within its channel.
        sequence: u32,
        /// The time at which it was recorded, in ns.
        log_time: u64,
        /// The time at which it was sent, in ns.
        publish_time: u64,
        /// The encoded contents of the message.
        data: &'a [u8],
    },
    /// An attached file.
    Attachment {
        /// The time at which it was recorded, in ns.
        log_time: u64,
        /// The time at which it was created, in ns.
        create_time: u64,
        /// The name of the attachment.
        name: &'a str,
        /// The media type of the attachment.
        media_type: &'a str,
        /// The contents of the attachment.
        data: &'a [u8],
    },
    /// A metadata record: a name with keys and values.
    Metadata {
        /// The name.
        name: &'a str,
        /// The keys and values.
        facts: MetadataMap<'a>,
    },
    /// The end of the file.
    Footer {
        /// The checksum of the summary and of the footer before this field; 0 if there is none.
        crc: u32,
    },
    /// The end of the section that holds the messages.
    DataEnd {
        /// The checksum of all bytes before this record; 0 if there is none.
        crc: u32,
    },
    /// Any other record: an index, statistics, a chunk, or an unknown one.
    Other,
}

/// A map of keys to values, undecoded. It was checked to be complete and valid UTF-8.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MetadataMap<'a>(&'a [u8]);

impl<'a> MetadataMap<'a> {
    /// Iterates over the pairs of key and value.
    pub fn iter(&self) -> impl Iterator<Item = (&'a str, &'a str)> + use<'a> {
        let mut rest = Fields { record: "", bytes: 0, rest: self.0 };
        std::iter::from_fn(move || Some((rest.text("").ok()?, rest.text("").ok()?)))
    }

    /// Returns the value of a key.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&'a str> {
        self.iter().find(|(name, _)| *name == key).map(|(_, value)| value)
    }
}

impl From<MetadataMap<'_>> for BTreeMap<String, String> {
    fn from(facts: MetadataMap<'_>) -> Self {
        facts.iter().map(|(key, value)| (key.to_owned(), value.to_owned())).collect()
    }
}

/// The number of bytes still available for names. The limit is needed because an untrusted file may have any number of
/// names of any length.
#[derive(Clone, Copy, Debug, Default)]
pub struct NameBudget(usize);

impl NameBudget {
    /// The memory that a name takes in addition to its text, in bytes.
    pub const ENTRY_OVERHEAD: usize = 128;
    /// The maximum size of all names together, in bytes.
    const LIMIT_BYTES: usize = 32 << 20;

    /// Counts a name of `bytes` bytes towards the limit.
    ///
    /// # Errors
    /// Returns [`FormatError::Names`] if the limit is exceeded.
    pub fn add(&mut self, bytes: usize) -> Result<(), FormatError> {
        self.0 = self.0.saturating_add(bytes).saturating_add(Self::ENTRY_OVERHEAD);
        if self.0 > Self::LIMIT_BYTES { Err(FormatError::Names { limit: Self::LIMIT_BYTES }) } else { Ok(()) }
    }
}

/// A cursor over a record's fields.
#[derive(Clone, Copy)]
pub(super) struct Fields<'a> {
    record: &'static str,
    bytes: usize,
    pub(super) rest: &'a [u8],
}

impl<'a> Fields<'a> {
    pub(super) const fn new(record: &'static str, body: &'a [u8]) -> Self {
        Self { record, bytes: body.len(), rest: body }
    }

    fn too_short_error(&self, field: &'static str) -> FormatError {
        FormatError::Short { record: self.record, bytes: self.bytes, field }
    }

    fn read_array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N], FormatError> {
        let (head, rest) = self.rest.split_first_chunk().ok_or_else(|| self.too_short_error(field))?;
        self.rest = rest;
        Ok(*head)
    }

    fn u16(&mut self, field: &'static str) -> Result<u16, FormatError> {
        self.read_array(field).map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self, field: &'static str) -> Result<u32, FormatError> {
        self.read_array(field).map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self, field: &'static str) -> Result<u64, FormatError> {
        self.read_array(field).map(u64::from_le_bytes)
    }

    /// Returns the next `count` bytes.
    ///
    /// # Errors
    /// Returns [`FormatError::Short`] if the record has fewer.
    pub(super) fn bytes(&mut self, count: u64, field: &'static str) -> Result<&'a [u8], FormatError> {
        let split = usize::try_from(count).ok().and_then(|count| self.rest.split_at_checked(count));
        let (bytes, rest) = split.ok_or_else(|| self.too_short_error(field))?;
        self.rest = rest;
        Ok(bytes)
    }

    pub(super) fn text(&mut self, field: &'static str) -> Result<&'a str, FormatError> {
        let bytes = self.u32(field)?;
        let bytes = self.bytes(bytes.into(), field)?;
        std::str::from_utf8(bytes).map_err(|_| FormatError::Text { record: self.record, field })
    }

    fn read_metadata_map(&mut self, field: &'static str) -> Result<MetadataMap<'a>, FormatError> {
        let bytes = self.u32(field)?;
        let facts = self.bytes(bytes.into(), field)?;
        let mut all = Self { rest: facts, ..*self };
        while !all.rest.is_empty() {
            all.text(field)?;
            all.text(field)?;
        }
        Ok(MetadataMap(facts))
    }
}

/// Decodes a record. Chunks, indexes and statistics are returned as [`Record::Other`].
///
/// # Errors
/// Returns [`FormatError`] if the record is shorter than its fields, if a schema or another description is too long, if
/// a name is not UTF-8, or if an attachment's checksum is wrong.
pub fn parse(opcode: u8, body: &[u8]) -> Result<Record<'_>, FormatError> {
    let description = |record| match body.len() as u64 {
        bytes if body.len() > MAX_DESCRIPTION_BYTES => {
            Err(FormatError::TooLong { what: record, bytes, limit: MAX_DESCRIPTION_BYTES as u64 })
        }
        _ => Ok(Fields::new(record, body)),
    };
    Ok(match opcode {
        op::HEADER => {
            let mut from = description("header")?;
            Record::Header { profile: from.text("profile")?, library: from.text("library")? }
        }
        op::SCHEMA => {
            let mut from = description("schema")?;
            let (id, name, encoding) = (from.u16("id")?, from.text("name")?, from.text("encoding")?);
            let bytes = from.u32("definition")?;
            Record::Schema { id, name, encoding, data: from.bytes(bytes.into(), "definition")? }
        }
        op::CHANNEL => {
            let mut from = description("channel")?;
            let (id, schema) = (from.u16("id")?, from.u16("schema id")?);
            let (topic, encoding) = (from.text("topic")?, from.text("message encoding")?);
            Record::Channel { id, schema, topic, encoding, facts: from.read_metadata_map("metadata")? }
        }
        op::MESSAGE => {
            let mut from = Fields::new("message", body);
            let (channel, sequence) = (from.u16("channel id")?, from.u32("sequence")?);
            let (log_time, publish_time) = (from.u64("log time")?, from.u64("publish time")?);
            Record::Message { channel, sequence, log_time, publish_time, data: from.rest }
        }
        op::ATTACHMENT => attachment(body)?,
        op::METADATA => {
            let mut from = description("metadata")?;
            Record::Metadata { name: from.text("name")?, facts: from.read_metadata_map("facts")? }
        }
        op::FOOTER => {
            let mut from = Fields::new("footer", body);
            from.u64("summary start")?;
            from.u64("summary offset start")?;
            Record::Footer { crc: from.u32("checksum")? }
        }
        op::DATA_END => Record::DataEnd { crc: Fields::new("data end", body).u32("checksum")? },
        _ => Record::Other,
    })
}

fn attachment(body: &[u8]) -> Result<Record<'_>, FormatError> {
    let mut from = Fields::new("attachment", body);
    let (log_time, create_time) = (from.u64("log time")?, from.u64("create time")?);
    let (name, media_type) = (from.text("name")?, from.text("media type")?);
    let bytes = from.u64("data")?;
    let data = from.bytes(bytes, "data")?;
    let checked = body.get(..body.len() - from.rest.len()).unwrap_or_default();
    let saved = from.u32("checksum")?;
    let found = if saved == 0 { 0 } else { crc32fast::hash(checked) };
    if saved != found {
        return Err(FormatError::Checksum { what: "an attachment", saved, found });
    }
    Ok(Record::Attachment { log_time, create_time, name, media_type, data })
}

/// Returns the name of an attachment of which only the beginning is available; empty if not even the name is complete.
#[must_use]
pub(super) fn attachment_name(beginning: &[u8]) -> &str {
    let mut from = Fields::new("attachment", beginning);
    from.u64("").and_then(|_| from.u64("")).and_then(|_| from.text("")).unwrap_or_default()
}
