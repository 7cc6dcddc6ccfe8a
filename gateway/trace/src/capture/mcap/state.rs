//! Schemas, channels and extras of an MCAP recording, and the decoding of its messages.

use std::collections::HashMap;
use std::fmt::Display;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use ::mcap::records::op;
use protocol::candump::{Direction, Record, Timestamp};

use super::ReadFault;
use super::buses::{ForeignBuses, beginning};
use super::foreign::ForeignType;
use super::write::{SECONDS_DIGITS, TIME_DIGITS};
use crate::capture::log::MAX_LINE_BYTES as LONGEST_LINE;
use crate::capture::{Entry, RecordingExtras, Item, LatchedFrame, Note, NoteKind, OtherMessage, Topic};
use crate::container::{FormatError, MetadataMap, MAGIC, NameBudget, Record as Raw, find, parse};
use crate::recording::STATE_TOPIC_PREFIX;
use crate::ros2::cdr::CdrError;
use crate::ros2::{Message, MessageError, messages};

/// The maximum size of the attachments, metadata and latched frames that are kept, in bytes.
pub(super) const MAX_KEPT_BYTES: usize = 16 << 20;
/// The memory overhead of an attachment, a metadata value or a frame, in bytes.
const ENTRY: usize = NameBudget::ENTRY_OVERHEAD;
/// The longest message that is decoded as a frame, in bytes.
const LONGEST_FRAME: usize = 4 << 10;
/// The longest message that is decoded as a note, in bytes: a line and its position.
const LONGEST_NOTE: usize = LONGEST_LINE + (1 << 10);

/// The state of reading a recording.
pub(crate) struct McapState {
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Channel>,
    /// The indices of topics that are only counted, by name and type.
    counted: HashMap<(String, String), usize>,
    names: NameBudget,
    extras: RecordingExtras,
    /// The size of the attachments and metadata so far, in bytes.
    kept: usize,
    /// True if attachments and metadata are already known.
    knows_files: bool,
    any_frame: bool,
    /// The buses of other programs' frames.
    buses: ForeignBuses,
    /// True if messages that are only counted are requested too.
    others: bool,
    /// True if no other part of the recording came before.
    is_first: bool,
}

/// A requested message. Its contents are in the record that was read last.
#[derive(Clone, Copy)]
pub(crate) struct RequestedMessage {
    pub(super) channel: u16,
    pub(super) times: MessageTimes,
    pub(super) in_chunk: bool,
}

/// The times of a message, in ns since 1970.
#[derive(Clone, Copy)]
pub(crate) struct MessageTimes {
    /// The time that orders the file.
    pub(super) logged: u64,
    /// The time at which the message was published.
    pub(super) published: u64,
}

/// A channel: its topic and its use.
struct Channel {
    topic: String,
    what: ChannelUsage,
}

#[derive(Clone, Copy)]
enum ChannelUsage {
    /// Frames, whose times are written in this form.
    Frames(Timestamp),
    /// Earlier frames that are latched when the recording begins.
    Latched,
    Notes,
    Foreign(ForeignType),
    /// Messages that are counted, under this index in the list of topics.
    Counted(usize),
}

impl McapState {
    /// Creates an empty state, or one that continues the extras of the parts `before` this one. In the latter case
    /// latched frames at the beginning of this part are already known, and its topics are those of the earlier parts.
    /// `others` requests the messages that are otherwise only counted.
    pub(crate) fn new(others: bool, before: Option<RecordingExtras>) -> Self {
        let is_first = before.is_none();
        let extras = before.unwrap_or_default();
        let topics = extras.topics.iter().enumerate();
        Self {
            schemas: HashMap::new(),
            channels: HashMap::new(),
            counted: topics.map(|(at, it)| ((it.name.clone(), it.schema.clone()), at)).collect(),
            names: NameBudget::default(),
            extras,
            kept: 0,
            knows_files: !is_first,
            any_frame: false,
            buses: ForeignBuses::default(),
            others,
            is_first,
        }
    }

    /// Uses buses that are already known.
    pub(crate) fn with_buses(self, buses: ForeignBuses) -> Self {
        Self { buses, ..self }
    }

    pub(super) const fn buses(&self) -> &ForeignBuses {
        &self.buses
    }

    pub(super) fn into_buses(self) -> ForeignBuses {
        self.buses
    }

    /// Returns true if a channel so far has frames of another program's type.
    pub(super) fn has_foreign(&self) -> bool {
        self.channels.values().any(|channel| matches!(channel.what, ChannelUsage::Foreign(_)))
    }

    pub(super) const fn extras(&self) -> &RecordingExtras {
        &self.extras
    }

    /// Records that the file ends after `read` bytes without a footer.
    pub(super) fn truncated(&mut self, read: u64) {
        let why = || format!("it has no end: after {read} bytes it was cut off, or never finished");
        self.extras.unfinished.get_or_insert_with(why);
    }

    /// Reads the attachments and metadata of a seekable file in advance without reading all of it, and detects a
    /// missing end.
    pub(crate) fn find_files(&mut self, file: &mut (impl Read + Seek)) -> io::Result<()> {
        let size = file.seek(SeekFrom::End(0))?;
        file.seek(SeekFrom::Start(size.saturating_sub(MAGIC.len() as u64)))?;
        let mut end = Vec::new();
        file.take(MAGIC.len() as u64).read_to_end(&mut end)?;
        file.rewind()?;
        let has_end = end == MAGIC && size > MAGIC.len() as u64;
        if !has_end {
            self.truncated(size);
        }
        if self.knows_files {
            return Ok(());
        }
        // Most of the skipped data is longer than this.
        let mut from = BufReader::with_capacity(4 << 10, file);
        if from.read_exact(&mut [0; MAGIC.len()]).is_err() {
            return Ok(());
        }
        let mut body = Vec::new();
        let mut footer = None;
        while let Some((opcode, length)) = find(&mut from, &[op::ATTACHMENT, op::METADATA, op::FOOTER])? {
            if opcode == op::FOOTER {
                footer = from.stream_position()?.checked_add(length);
                break;
            }
            body.clear();
            let came = (&mut from).take(length.min(MAX_KEPT_BYTES as u64)).read_to_end(&mut body)? as u64;
            if came < length {
                let rest = i64::try_from(length - came);
                if rest.is_err() || rest.is_ok_and(|rest| from.seek_relative(rest).is_err()) {
                    break;
                }
            }
            match parse(opcode, &body) {
                Ok(Raw::Attachment { name, data, .. }) => self.attachment(name, data),
                Ok(Raw::Metadata { name, facts }) => self.metadata(name, &facts),
                // Errors are reported when the record is read.
                _ => {}
            }
        }
        // A wrong length may have skipped some attachments. They are then added when their records are read.
        self.knows_files = !has_end || footer.is_some_and(|end| end + MAGIC.len() as u64 == size);
        if !self.knows_files {
            self.extras.attachments.clear();
            self.extras.metadata.clear();
            self.kept = 0;
        }
        Ok(())
    }

    /// Processes a record. Returns the message if it is requested.
    pub(crate) fn process(&mut self, opcode: u8, body: &[u8], in_chunk: bool) -> Result<Option<RequestedMessage>, ReadFault> {
        match parse(opcode, body)? {
            Raw::Schema { id, name, .. } => {
                if self.schemas.get(&id).is_none_or(|known| known != name) {
                    self.names.add(name.len())?;
                    self.schemas.insert(id, name.to_owned());
                }
            }
            // A channel is repeated in the summary, or in every chunk.
            Raw::Channel { id, .. } if self.channels.contains_key(&id) => {}
            Raw::Channel { id, schema, topic, encoding, facts } => {
                self.channel(id, schema, topic, encoding, &facts)?;
            }
            Raw::Message { channel, log_time, publish_time, data, .. } => {
                let target = self.is_requested(channel, data)?;
                let times = MessageTimes { logged: log_time, published: publish_time };
                return Ok(target.then_some(RequestedMessage { channel, times, in_chunk }));
            }
            Raw::Attachment { name, data, .. } if !self.knows_files => self.attachment(name, data),
            Raw::Metadata { name, facts } if !self.knows_files => self.metadata(name, &facts),
            Raw::Header { .. }
            | Raw::Attachment { .. }
            | Raw::Metadata { .. }
            | Raw::DataEnd { .. }
            | Raw::Footer { .. }
            | Raw::Other => {}
        }
        Ok(None)
    }

    /// Counts or keeps a message. Returns true if it is requested.
    fn is_requested(&mut self, channel: u16, data: &[u8]) -> Result<bool, ReadFault> {
        let Channel { topic, what } = self.channels.get(&channel).ok_or(FormatError::Channel(channel))?;
        match *what {
            ChannelUsage::Counted(topic) => {
                if let Some(topic) = self.extras.topics.get_mut(topic) {
                    topic.messages += 1;
                }
                Ok(self.others)
            }
            ChannelUsage::Latched if !self.is_first => Ok(false),
            ChannelUsage::Latched => {
                let record =
                    latched(data).map_err(|source| FormatError::Message { topic: topic.clone(), source })?;
                let (bus, own) = (record.interface, record.direction == Some(Direction::Sent));
                let (frame, nanos) = (record.frame, record.time.nanos);
                self.keep(bus.len() + ENTRY, |extras| {
                    extras.latched.push(LatchedFrame { bus: bus.to_owned(), own, frame, nanos });
                });
                Ok(false)
            }
            ChannelUsage::Frames(_) | ChannelUsage::Notes | ChannelUsage::Foreign(_) => Ok(true),
        }
    }

    /// Keeps something of `size` bytes while there is room.
    fn keep(&mut self, size: usize, keep: impl FnOnce(&mut RecordingExtras)) {
        self.kept = self.kept.saturating_add(size);
        if self.is_first && self.kept <= MAX_KEPT_BYTES {
            keep(&mut self.extras);
        }
    }

    pub(super) fn attachment(&mut self, name: &str, data: &[u8]) {
        let fits = self.kept.saturating_add(name.len() + ENTRY + data.len()) <= MAX_KEPT_BYTES;
        let data = if fits { data } else { &[] };
        self.keep(name.len() + ENTRY + data.len(), |extras| {
            extras.attachments.push((name.to_owned(), data.to_vec()));
        });
    }

    fn metadata(&mut self, name: &str, facts: &MetadataMap<'_>) {
        let size = facts.iter().map(|(key, value)| key.len() + value.len() + ENTRY).sum::<usize>();
        self.keep(name.len() + ENTRY + size, |extras| {
            let facts = facts.iter().map(|(key, value)| (key.to_owned(), value.to_owned()));
            extras.metadata.push((name.to_owned(), facts.collect()));
        });
    }

    fn channel(
        &mut self,
        id: u16,
        schema: u16,
        topic: &str,
        encoding: &str,
        facts: &MetadataMap<'_>,
    ) -> Result<(), ReadFault> {
        let schema = self.schemas.get(&schema).cloned().unwrap_or_default();
        // Topic and schema may be stored twice each.
        self.names.add(2 * (topic.len() + schema.len()))?;
        let what = if let Some(foreign) = ForeignType::from_schema(encoding, &schema) {
            Some(ChannelUsage::Foreign(foreign))
        } else if encoding != "cdr" {
            None
        } else if schema == Record::TYPE && topic.starts_with(STATE_TOPIC_PREFIX) {
            Some(ChannelUsage::Latched)
        } else if schema == Record::TYPE {
            Some(ChannelUsage::Frames(form(facts)))
        } else if schema == Note::TYPE {
            Some(ChannelUsage::Notes)
        } else {
            None
        };
        let what = what.unwrap_or_else(|| {
            let topics = &mut self.extras.topics;
            let place =
                self.counted.entry((topic.to_owned(), schema)).or_insert_with_key(|(name, schema)| {
                    topics.push(Topic { name: name.clone(), schema: schema.clone(), messages: 0 });
                    topics.len() - 1
                });
            ChannelUsage::Counted(*place)
        });
        self.channels.insert(id, Channel { topic: topic.to_owned(), what });
        Ok(())
    }

    pub(super) fn item<'a>(&'a mut self, channel: u16, times: MessageTimes, message: &'a [u8]) -> Item<'a> {
        // Other programs may have published their messages by another clock.
        let MessageTimes { logged: log_time, published } = times;
        let Some(Channel { topic, what }) = self.channels.get(&channel) else {
            return Item::Entry(unreadable("", log_time, message, &"no channel"));
        };
        let decoded = match *what {
            ChannelUsage::Counted(place) => {
                let topic = self.extras.topics.get(place);
                let (topic, schema) = topic.map_or(("", ""), |topic| (&topic.name, &topic.schema));
                return Item::Other(OtherMessage { topic, schema, nanos: published, message });
            }
            // Latched frames are never requested.
            ChannelUsage::Latched => latched(message).map(Entry::Frame),
            ChannelUsage::Frames(form) => {
                let time = Timestamp { nanos: published, ..form };
                decode(message, LONGEST_FRAME, |message| messages::frame(message, time)).map(Entry::Frame)
            }
            ChannelUsage::Foreign(foreign) => {
                let record = decode(message, LONGEST_FRAME, |message| foreign.decode(message, log_time));
                let buses = &mut self.buses;
                record.map(|record| {
                    Entry::Frame(Record { interface: buses.name(topic, record.interface), ..record })
                })
            }
            ChannelUsage::Notes => {
                let note = decode(message, LONGEST_NOTE, |message| messages::note(message, published));
                note.map(|mut note| {
                    if note.line > 0 && !self.any_frame {
                        note.nanos = 0;
                    }
                    Entry::Note(note)
                })
            }
        };
        let entry = decoded.unwrap_or_else(|why| unreadable(topic, log_time, message, &why));
        self.any_frame |= matches!(entry, Entry::Frame(_));
        Item::Entry(entry)
    }
}

/// Returns the form of times that the metadata of a channel specify.
fn form(facts: &MetadataMap<'_>) -> Timestamp {
    let nine_digits = facts.get(TIME_DIGITS).is_none_or(|digits| digits != "6");
    let min_digits = facts.get(SECONDS_DIGITS).and_then(|digits| digits.parse().ok()).unwrap_or(1);
    Timestamp { nanos: 0, nine_digits, min_digits }
}

/// Decodes a message, unless it is too long.
fn decode<'a, T>(
    message: &'a [u8],
    limit: usize,
    decode: impl FnOnce(&'a [u8]) -> Result<T, CdrError>,
) -> Result<T, MessageError> {
    let bytes = message.len();
    if bytes > limit { Err(MessageError::Long { bytes, limit }) } else { Ok(decode(message)?) }
}

/// Decodes a latched frame, with its own time.
fn latched(message: &[u8]) -> Result<Record<'_>, MessageError> {
    decode(message, LONGEST_FRAME, |message| {
        messages::frame(message, Timestamp::nine_digits(messages::stamp(message)?))
    })
}

/// Makes the note of a message that does not match the type of its channel.
fn unreadable<'a>(topic: &str, nanos: u64, message: &'a [u8], why: &dyn Display) -> Entry<'a> {
    let topic = beginning(topic);
    let kind = NoteKind::Unreadable(format!("a message of {topic}: {why}"));
    let message = message.get(..LONGEST_LINE).unwrap_or(message);
    Entry::Note(Note { kind, nanos, interface: "", line: 0, text: message })
}
