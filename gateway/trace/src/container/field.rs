//! What a record says.

use std::collections::BTreeMap;

use mcap::records::op;

use super::{Damage, LONGEST_DESCRIPTION};

/// A record, as far as readers of recordings want to know it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Record<'a> {
    /// How a file begins.
    Header {
        /// What conventions it follows.
        profile: &'a str,
        /// Who wrote it.
        library: &'a str,
    },
    /// A type of messages.
    Schema {
        /// Its number.
        id: u16,
        /// Its name.
        name: &'a str,
        /// The language of its definition.
        encoding: &'a str,
        /// Its definition.
        data: &'a [u8],
    },
    /// A topic.
    Channel {
        /// Its number.
        id: u16,
        /// The number of its messages' type; 0 when they have none.
        schema: u16,
        /// Its name.
        topic: &'a str,
        /// How its messages are encoded.
        encoding: &'a str,
        /// What else is said of it.
        facts: Facts<'a>,
    },
    /// A message.
    Message {
        /// The number of its channel.
        channel: u16,
        /// Its number there.
        sequence: u32,
        /// When it was recorded, in ns.
        log_time: u64,
        /// When it was sent, in ns.
        publish_time: u64,
        /// What it says.
        data: &'a [u8],
    },
    /// A file in the file.
    Attachment {
        /// When it was recorded, in ns.
        log_time: u64,
        /// When it was made, in ns.
        create_time: u64,
        /// Its name.
        name: &'a str,
        /// Its media type.
        media_type: &'a str,
        /// Its bytes.
        data: &'a [u8],
    },
    /// Facts under a name.
    Metadata {
        /// The name.
        name: &'a str,
        /// The facts.
        facts: Facts<'a>,
    },
    /// The end of the file.
    Footer {
        /// The checksum of the summary and of what is before this; 0 when there is none.
        crc: u32,
    },
    /// The end of what was recorded.
    DataEnd {
        /// The checksum of everything before it; 0 when there is none.
        crc: u32,
    },
    /// Anything else: indexes, statistics, chunks, what is not known.
    Other,
}

/// Keys and values, as they stand in the file: whole, and UTF-8.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Facts<'a>(&'a [u8]);

impl<'a> Facts<'a> {
    /// One after the other.
    pub fn iter(&self) -> impl Iterator<Item = (&'a str, &'a str)> + use<'a> {
        let mut rest = Fields { record: "", bytes: 0, rest: self.0 };
        std::iter::from_fn(move || Some((rest.text("").ok()?, rest.text("").ok()?)))
    }

    /// The value of a key.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&'a str> {
        self.iter().find(|(name, _)| *name == key).map(|(_, value)| value)
    }
}

impl From<Facts<'_>> for BTreeMap<String, String> {
    fn from(facts: Facts<'_>) -> Self {
        facts.iter().map(|(key, value)| (key.to_owned(), value.to_owned())).collect()
    }
}

/// What is kept of the names in a file, which whoever wrote it may have made as long and as many as they liked.
#[derive(Clone, Copy, Debug, Default)]
pub struct Names(usize);

impl Names {
    /// What keeping a name costs beside its bytes.
    pub const ENTRY: usize = 128;
    /// All of them together.
    const LIMIT: usize = 32 << 20;

    /// Makes sure that there is room for another one, of so many bytes.
    ///
    /// # Errors
    /// When there is not.
    pub fn add(&mut self, bytes: usize) -> Result<(), Damage> {
        self.0 = self.0.saturating_add(bytes).saturating_add(Self::ENTRY);
        if self.0 > Self::LIMIT { Err(Damage::Names { limit: Self::LIMIT }) } else { Ok(()) }
    }
}

/// A record's fields, one after the other.
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

    fn short(&self, field: &'static str) -> Damage {
        Damage::Short { record: self.record, bytes: self.bytes, field }
    }

    fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N], Damage> {
        let (head, rest) = self.rest.split_first_chunk().ok_or_else(|| self.short(field))?;
        self.rest = rest;
        Ok(*head)
    }

    fn u16(&mut self, field: &'static str) -> Result<u16, Damage> {
        self.array(field).map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self, field: &'static str) -> Result<u32, Damage> {
        self.array(field).map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self, field: &'static str) -> Result<u64, Damage> {
        self.array(field).map(u64::from_le_bytes)
    }

    /// So many bytes, which it must have.
    pub(super) fn bytes(&mut self, count: u64, field: &'static str) -> Result<&'a [u8], Damage> {
        let split = usize::try_from(count).ok().and_then(|count| self.rest.split_at_checked(count));
        let (bytes, rest) = split.ok_or_else(|| self.short(field))?;
        self.rest = rest;
        Ok(bytes)
    }

    pub(super) fn text(&mut self, field: &'static str) -> Result<&'a str, Damage> {
        let bytes = self.u32(field)?;
        let bytes = self.bytes(bytes.into(), field)?;
        std::str::from_utf8(bytes).map_err(|_| Damage::Text { record: self.record, field })
    }

    fn facts(&mut self, field: &'static str) -> Result<Facts<'a>, Damage> {
        let bytes = self.u32(field)?;
        let facts = self.bytes(bytes.into(), field)?;
        let mut all = Self { rest: facts, ..*self };
        while !all.rest.is_empty() {
            all.text(field)?;
            all.text(field)?;
        }
        Ok(Facts(facts))
    }
}

/// What a record says. Of a chunk, an index and the like nothing: [`Record::Other`].
///
/// # Errors
/// When it is shorter than it says, longer than a description may be, or a name in it is not UTF-8.
pub fn parse(opcode: u8, body: &[u8]) -> Result<Record<'_>, Damage> {
    let description = |record| match body.len() as u64 {
        bytes if body.len() > LONGEST_DESCRIPTION => {
            Err(Damage::Long { what: record, bytes, limit: LONGEST_DESCRIPTION as u64 })
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
            Record::Channel { id, schema, topic, encoding, facts: from.facts("metadata")? }
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
            Record::Metadata { name: from.text("name")?, facts: from.facts("facts")? }
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

fn attachment(body: &[u8]) -> Result<Record<'_>, Damage> {
    let mut from = Fields::new("attachment", body);
    let (log_time, create_time) = (from.u64("log time")?, from.u64("create time")?);
    let (name, media_type) = (from.text("name")?, from.text("media type")?);
    let bytes = from.u64("data")?;
    let data = from.bytes(bytes, "data")?;
    let checked = body.get(..body.len() - from.rest.len()).unwrap_or_default();
    let saved = from.u32("checksum")?;
    let found = if saved == 0 { 0 } else { crc32fast::hash(checked) };
    if saved != found {
        return Err(Damage::Checksum { what: "an attachment", saved, found });
    }
    Ok(Record::Attachment { log_time, create_time, name, media_type, data })
}

/// The name of an attachment of which only the beginning is there; empty when not even that is.
#[must_use]
pub(super) fn attachment_name(beginning: &[u8]) -> &str {
    let mut from = Fields::new("attachment", beginning);
    from.u64("").and_then(|_| from.u64("")).and_then(|_| from.text("")).unwrap_or_default()
}
