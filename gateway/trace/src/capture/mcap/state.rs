//! Holds the schemas, channels and extras of an MCAP recording while it is read, and decodes its messages.

use std::collections::HashMap;
use std::fmt::Display;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use ::mcap::records::op;
use protocol::candump::{Direction, Record, Timestamp};

use super::ReadFault;
use super::buses::{ForeignBusNames, truncate_topic};
use super::foreign::ForeignMessageType;
use super::write::{SECONDS_DIGITS_KEY, TIME_DIGITS_KEY};
use crate::capture::log::MAX_LINE_BYTES as LONGEST_LINE;
use crate::capture::{
    CaptureEntry, CaptureNote, LatchedFrame, NoteKind, OtherMessage, RecordingExtras, RecordingItem, Topic,
};
use crate::container::{FormatError, MAGIC, MetadataMap, NameBudget, Record as Raw, parse, seek_record};
use crate::recording::STATE_TOPIC_PREFIX;
use crate::ros2::cdr::CdrError;
use crate::ros2::{Message, MessageError, messages};

/// The maximum size of the attachments, metadata and latched frames that are kept, in bytes.
pub(super) const MAX_KEPT_BYTES: usize = 16 << 20;
/// The memory overhead of an attachment, a metadata value or a frame, in bytes.
const ENTRY_OVERHEAD: usize = NameBudget::ENTRY_OVERHEAD;
/// The longest message that is decoded as a frame, in bytes.
const MAX_FRAME_MESSAGE: usize = 4 << 10;
/// The longest message that is decoded as a note, in bytes: a line and its position.
const MAX_NOTE_MESSAGE: usize = LONGEST_LINE + (1 << 10);

/// The part of a recording's contents that is needed to decode its messages: schemas, channels and bus names.
pub(crate) struct McapState {
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Channel>,
    /// The index in the list of topics, by the name and type of the topic. Messages of these topics are only counted.
    counted: HashMap<(String, String), usize>,
    names: NameBudget,
    extras: RecordingExtras,
    /// The size of the attachments and metadata kept so far, in bytes.
    kept: usize,
    /// True if attachments and metadata were read in advance.
    knows_files: bool,
    any_frame: bool,
    /// The bus names for frames of other programs.
    buses: ForeignBusNames,
    /// True if the caller requests messages of other topics too, which are otherwise only counted.
    others: bool,
    /// True in the first part of a recording.
    is_first: bool,
}

/// A message to be decoded. Its contents are in the record that was read last.
#[derive(Clone, Copy)]
pub(crate) struct RequestedMessage {
    pub(super) channel: u16,
    pub(super) times: MessageTimes,
    pub(super) in_chunk: bool,
}

/// The times of a message, in ns since 1970.
#[derive(Clone, Copy)]
pub(crate) struct MessageTimes {
    /// The time by which the messages of the file are ordered (`log_time`).
    pub(super) logged: u64,
    /// The time at which the message was published (`publish_time`).
    pub(super) published: u64,
}

/// A channel: its topic and how its messages are used.
struct Channel {
    topic: String,
    what: ChannelUsage,
}

#[derive(Clone, Copy)]
enum ChannelUsage {
    /// Frames. The channel's metadata state the form of their times.
    Frames(Timestamp),
    /// Frames that were sent before the recording began and were still latched then.
    Latched,
    Notes,
    Foreign(ForeignMessageType),
    /// Messages that are only counted, with the index of the topic.
    Counted(usize),
}

impl McapState {
    /// Creates an empty state, or one that continues the extras of the parts `before` this one. In that case latched
    /// frames at the beginning of this part are ignored, because they are already known. With `others`, messages of
    /// other topics are requested and not only counted.
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
            buses: ForeignBusNames::default(),
            others,
            is_first,
        }
    }

    /// Uses bus names that were found in advance.
    pub(crate) fn with_buses(self, buses: ForeignBusNames) -> Self {
        Self { buses, ..self }
    }

    pub(super) const fn buses(&self) -> &ForeignBusNames {
        &self.buses
    }

    pub(super) fn into_buses(self) -> ForeignBusNames {
        self.buses
    }

    /// Returns true if any channel so far holds frames of another program.
    pub(super) fn has_foreign(&self) -> bool {
        self.channels.values().any(|channel| matches!(channel.what, ChannelUsage::Foreign(_)))
    }

    pub(super) const fn extras(&self) -> &RecordingExtras {
        &self.extras
    }

    /// Records that the file ends without a footer, after `read` bytes.
    pub(super) fn record_truncation(&mut self, read: u64) {
        let why = || format!("its end is missing: it was cut off after {read} bytes, or never finished");
        self.extras.unfinished.get_or_insert_with(why);
    }

    /// Reads the attachments and metadata of a seekable file in advance; other records are skipped. Also detects that
    /// the end of the file is missing.
    pub(crate) fn read_extras_ahead(&mut self, file: &mut (impl Read + Seek)) -> io::Result<()> {
        let size = file.seek(SeekFrom::End(0))?;
        file.seek(SeekFrom::Start(size.saturating_sub(MAGIC.len() as u64)))?;
        let mut end = Vec::new();
        file.take(MAGIC.len() as u64).read_to_end(&mut end)?;
        file.rewind()?;
        let has_end = end == MAGIC && size > MAGIC.len() as u64;
        if !has_end {
            self.record_truncation(size);
        }
        if self.knows_files {
            return Ok(());
        }
        // A small buffer suffices, because most of the skipped records are longer than it.
        let mut from = BufReader::with_capacity(4 << 10, file);
        if from.read_exact(&mut [0; MAGIC.len()]).is_err() {
            return Ok(());
        }
        let mut body = Vec::new();
        let mut footer = None;
        while let Some((opcode, length)) =
            seek_record(&mut from, &[op::ATTACHMENT, op::METADATA, op::FOOTER])?
        {
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
                Ok(Raw::Attachment { name, data, .. }) => self.add_attachment(name, data),
                Ok(Raw::Metadata { name, facts }) => self.add_metadata(name, &facts),
                // Errors are reported when this record is read again in its place.
                _ => {}
            }
        }
        // A wrong length may have skipped attachments. Such attachments are added when their records are read.
        self.knows_files = !has_end || footer.is_some_and(|end| end + MAGIC.len() as u64 == size);
        if !self.knows_files {
            self.extras.attachments.clear();
            self.extras.metadata.clear();
            self.kept = 0;
        }
        Ok(())
    }

    /// Processes a record. Returns the message if it is requested.
    pub(crate) fn process_record(
        &mut self,
        opcode: u8,
        body: &[u8],
        in_chunk: bool,
    ) -> Result<Option<RequestedMessage>, ReadFault> {
        match parse(opcode, body)? {
            Raw::Schema { id, name, .. } => {
                if self.schemas.get(&id).is_none_or(|known| known != name) {
                    self.names.add(name.len())?;
                    self.schemas.insert(id, name.to_owned());
                }
            }
            // A channel may be repeated in the summary or in every chunk.
            Raw::Channel { id, .. } if self.channels.contains_key(&id) => {}
            Raw::Channel { id, schema, topic, encoding, facts } => {
                self.add_channel(id, schema, topic, encoding, &facts)?;
            }
            Raw::Message { channel, log_time, publish_time, data, .. } => {
                let target = self.is_requested(channel, data)?;
                let times = MessageTimes { logged: log_time, published: publish_time };
                return Ok(target.then_some(RequestedMessage { channel, times, in_chunk }));
            }
            Raw::Attachment { name, data, .. } if !self.knows_files => self.add_attachment(name, data),
            Raw::Metadata { name, facts } if !self.knows_files => self.add_metadata(name, &facts),
            Raw::Header { .. }
            | Raw::Attachment { .. }
            | Raw::Metadata { .. }
            | Raw::DataEnd { .. }
            | Raw::Footer { .. }
            | Raw::Other => {}
        }
        Ok(None)
    }

    /// Returns true if the message is to be decoded and returned. Otherwise counts it, or keeps it if it is a latched
    /// frame.
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
                let record = decode_latched_frame(data)
                    .map_err(|source| FormatError::Message { topic: topic.clone(), source })?;
                let (bus, own) = (record.interface, record.direction == Some(Direction::Sent));
                let (frame, nanos) = (record.frame, record.time.nanos);
                self.keep_if_it_fits(bus.len() + ENTRY_OVERHEAD, |extras| {
                    extras.latched.push(LatchedFrame { bus: bus.to_owned(), own, frame, nanos });
                });
                Ok(false)
            }
            ChannelUsage::Frames(_) | ChannelUsage::Notes | ChannelUsage::Foreign(_) => Ok(true),
        }
    }

    /// Calls `keep` if `size` more bytes fit into the limit [`MAX_KEPT_BYTES`].
    fn keep_if_it_fits(&mut self, size: usize, keep: impl FnOnce(&mut RecordingExtras)) {
        self.kept = self.kept.saturating_add(size);
        if self.is_first && self.kept <= MAX_KEPT_BYTES {
            keep(&mut self.extras);
        }
    }

    pub(super) fn add_attachment(&mut self, name: &str, data: &[u8]) {
        let fits = self.kept.saturating_add(name.len() + ENTRY_OVERHEAD + data.len()) <= MAX_KEPT_BYTES;
        let data = if fits { data } else { &[] };
        self.keep_if_it_fits(name.len() + ENTRY_OVERHEAD + data.len(), |extras| {
            extras.attachments.push((name.to_owned(), data.to_vec()));
        });
    }

    fn add_metadata(&mut self, name: &str, facts: &MetadataMap<'_>) {
        let size = facts.iter().map(|(key, value)| key.len() + value.len() + ENTRY_OVERHEAD).sum::<usize>();
        self.keep_if_it_fits(name.len() + ENTRY_OVERHEAD + size, |extras| {
            let facts = facts.iter().map(|(key, value)| (key.to_owned(), value.to_owned()));
            extras.metadata.push((name.to_owned(), facts.collect()));
        });
    }

    fn add_channel(
        &mut self,
        id: u16,
        schema: u16,
        topic: &str,
        encoding: &str,
        facts: &MetadataMap<'_>,
    ) -> Result<(), ReadFault> {
        let schema = self.schemas.get(&schema).cloned().unwrap_or_default();
        // The topic and the type of a message may be stored twice each.
        self.names.add(2 * (topic.len() + schema.len()))?;
        let what = if let Some(foreign) = ForeignMessageType::from_schema(encoding, &schema) {
            Some(ChannelUsage::Foreign(foreign))
        } else if encoding != "cdr" {
            None
        } else if schema == Record::TYPE && topic.starts_with(STATE_TOPIC_PREFIX) {
            Some(ChannelUsage::Latched)
        } else if schema == Record::TYPE {
            Some(ChannelUsage::Frames(timestamp_format(facts)))
        } else if schema == CaptureNote::TYPE {
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

    pub(super) fn decode_item<'a>(
        &'a mut self,
        channel: u16,
        times: MessageTimes,
        message: &'a [u8],
    ) -> RecordingItem<'a> {
        // Programs may publish messages by another clock than that of the recorder.
        let MessageTimes { logged: log_time, published } = times;
        let Some(Channel { topic, what }) = self.channels.get(&channel) else {
            return RecordingItem::Entry(unreadable_note("", log_time, message, &"no channel"));
        };
        let decoded = match *what {
            ChannelUsage::Counted(place) => {
                let topic = self.extras.topics.get(place);
                let (topic, schema) = topic.map_or(("", ""), |topic| (&topic.name, &topic.schema));
                return RecordingItem::Other(OtherMessage { topic, schema, nanos: published, message });
            }
            // Latched frames are never requested.
            ChannelUsage::Latched => decode_latched_frame(message).map(CaptureEntry::Frame),
            ChannelUsage::Frames(form) => {
                let time = Timestamp { nanos: published, ..form };
                decode_limited(message, MAX_FRAME_MESSAGE, |message| messages::decode_frame(message, time))
                    .map(CaptureEntry::Frame)
            }
            ChannelUsage::Foreign(foreign) => {
                let record =
                    decode_limited(message, MAX_FRAME_MESSAGE, |message| foreign.decode(message, log_time));
                let buses = &mut self.buses;
                record.map(|record| {
                    CaptureEntry::Frame(Record { interface: buses.name(topic, record.interface), ..record })
                })
            }
            ChannelUsage::Notes => {
                let note = decode_limited(message, MAX_NOTE_MESSAGE, |message| {
                    messages::decode_note(message, published)
                });
                note.map(|mut note| {
                    if note.line > 0 && !self.any_frame {
                        note.nanos = 0;
                    }
                    CaptureEntry::Note(note)
                })
            }
        };
        let entry = decoded.unwrap_or_else(|why| unreadable_note(topic, log_time, message, &why));
        self.any_frame |= matches!(entry, CaptureEntry::Frame(_));
        RecordingItem::Entry(entry)
    }
}

/// Returns the form of times that is stated in the metadata of a channel.
fn timestamp_format(facts: &MetadataMap<'_>) -> Timestamp {
    let nine_digits = facts.get(TIME_DIGITS_KEY).is_none_or(|digits| digits != "6");
    let min_digits = facts.get(SECONDS_DIGITS_KEY).and_then(|digits| digits.parse().ok()).unwrap_or(1);
    Timestamp { nanos: 0, nine_digits, min_digits }
}

/// Decodes a message, unless it is too long.
fn decode_limited<'a, T>(
    message: &'a [u8],
    limit: usize,
    decode: impl FnOnce(&'a [u8]) -> Result<T, CdrError>,
) -> Result<T, MessageError> {
    let bytes = message.len();
    if bytes > limit { Err(MessageError::Long { bytes, limit }) } else { Ok(decode(message)?) }
}

/// Decodes a latched frame with the time at which it was on the bus.
fn decode_latched_frame(message: &[u8]) -> Result<Record<'_>, MessageError> {
    decode_limited(message, MAX_FRAME_MESSAGE, |message| {
        messages::decode_frame(message, Timestamp::with_nine_digits(messages::decode_stamp_nanos(message)?))
    })
}

/// Makes the note for a message that cannot be decoded by the type of its channel.
fn unreadable_note<'a>(topic: &str, nanos: u64, message: &'a [u8], why: &dyn Display) -> CaptureEntry<'a> {
    let topic = truncate_topic(topic);
    let kind = NoteKind::Unreadable(format!("a message of {topic}: {why}"));
    let message = message.get(..LONGEST_LINE).unwrap_or(message);
    CaptureEntry::Note(CaptureNote { kind, nanos, interface: "", line: 0, text: message })
}
