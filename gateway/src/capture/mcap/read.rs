//! The entries of an MCAP recording, and what else it has.

use std::collections::HashMap;
use std::io::{self, Read};

use ::mcap::McapError;
use ::mcap::records::{Channel, Record as Raw, op};
use ::mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use protocol::candump::{Direction, Record, Timestamp};

use super::foreign::Foreign;
use crate::capture::log::read_some;
use crate::capture::{Entry, Extras, InForce, Item, Note, NoteKind, Other, Topic};
use crate::record::TOPIC_OF_STATE;
use crate::ros2::Message;
use crate::ros2::messages::{CanFrame, CaptureNote};

/// The greatest record or chunk that is taken into memory; ours have 256 KiB, and those of other writers a few MiB.
const LIMIT: usize = 128 << 20;
/// Bytes that are read at once.
const PIECE: usize = 1 << 18;
/// Bytes of attachments and metadata that are kept.
const KEPT: usize = 16 << 20;
/// Bytes of a message before its data: channel, sequence, two times.
const HEAD: usize = 22;

/// Why nothing more comes.
#[derive(Debug)]
pub(crate) enum Fault {
    Io(io::Error),
    Damaged(String),
}

/// Reads the entries of a recording.
pub(crate) struct McapReader {
    input: Box<dyn Read + Send>,
    linear: LinearReader,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Lane>,
    extras: Extras,
    /// Bytes of attachments and metadata so far.
    kept: usize,
    /// The message that was read last.
    message: Vec<u8>,
    /// Bytes that came in.
    bytes: u64,
    any_frame: bool,
    /// Whether messages that are only counted are wanted too.
    others: bool,
    /// Whether no other part of the recording came before.
    is_first: bool,
    /// What was read ahead: the channel and time of the next message, or why there is none.
    first: Option<Result<(u16, u64), Fault>>,
    over: bool,
}

/// A channel: its topic, and what is done with its messages.
struct Lane {
    topic: String,
    what: What,
}

#[derive(Clone, Copy)]
enum What {
    Frames {
        nine_digits: bool,
    },
    /// Frames of before, that are in force when the recording begins.
    InForce,
    Notes,
    Foreign(Foreign),
    /// They are counted, here in the list of topics.
    Counted(usize),
}

impl McapReader {
    /// Goes on behind `head`, which has been read already; `others` if messages of other topics are wanted too.
    pub(crate) fn new(head: &[u8], input: Box<dyn Read + Send>, others: bool) -> Self {
        // A chunk is checked before anything of it is believed.
        let options = LinearReaderOptions::default()
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_record_length_limit(LIMIT);
        let mut linear = LinearReader::new_with_options(options);
        for (to, from) in linear.insert(head.len()).iter_mut().zip(head) {
            *to = *from;
        }
        linear.notify_read(head.len());
        let mut reader = Self {
            input,
            linear,
            schemas: HashMap::new(),
            channels: HashMap::new(),
            extras: Extras::default(),
            kept: 0,
            message: Vec::new(),
            bytes: u64::try_from(head.len()).unwrap_or(0),
            any_frame: false,
            others,
            is_first: true,
            first: None,
            over: false,
        };
        // What stands before the first message is known from the beginning.
        reader.first = reader.advance().transpose();
        reader
    }

    pub(crate) const fn extras(&self) -> &Extras {
        &self.extras
    }

    /// It is a part that follows others, of which this is known: what was in force when it began is no news, and its
    /// topics are theirs.
    pub(crate) fn follows(&mut self, before: Extras) {
        let own = std::mem::replace(&mut self.extras, before);
        self.is_first = false;
        self.extras.unfinished = self.extras.unfinished.take().or(own.unfinished);
        let topics = &mut self.extras.topics;
        let places = own.topics.into_iter().map(|topic| {
            let known = topics.iter().position(|it| it.name == topic.name && it.schema == topic.schema);
            match known.and_then(|at| Some((at, topics.get_mut(at)?))) {
                Some((at, known)) => {
                    known.messages += topic.messages;
                    at
                }
                None => {
                    topics.push(topic);
                    topics.len() - 1
                }
            }
        });
        let places: Vec<_> = places.collect();
        for lane in self.channels.values_mut() {
            if let What::Counted(topic) = &mut lane.what {
                *topic = places.get(*topic).copied().unwrap_or_default();
            }
        }
    }

    /// Whether nothing more comes. Reads on up to the next message, which [`McapReader::next`] then gives out.
    pub(crate) fn is_at_its_end(&mut self) -> Result<bool, Fault> {
        if self.first.is_none() {
            self.first = self.advance()?.map(Ok);
        }
        Ok(self.first.is_none())
    }

    /// The next entry, or message of another topic where these are wanted. Never panics.
    pub(crate) fn next(&mut self) -> Result<Option<Item<'_>>, Fault> {
        let message = match self.first.take() {
            Some(first) => Some(first?),
            None => self.advance()?,
        };
        Ok(message.map(|(channel, log_time)| self.item(channel, log_time)))
    }

    fn item(&mut self, channel: u16, log_time: u64) -> Item<'_> {
        let topic = match self.channels.get(&channel) {
            Some(Lane { what: What::Counted(topic), .. }) => *topic,
            _ => return Item::Entry(self.entry(channel, log_time)),
        };
        let (topic, schema) = self
            .extras
            .topics
            .get(topic)
            .map_or(("", ""), |topic| (topic.name.as_str(), topic.schema.as_str()));
        Item::Other(Other { topic, schema, nanos: log_time, message: &self.message })
    }

    /// Reads up to the next message that is wanted; its channel and its time.
    fn advance(&mut self) -> Result<Option<(u16, u64)>, Fault> {
        while !self.over {
            match self.step() {
                Ok(None) => {}
                Ok(message) => return Ok(message),
                Err(fault) => {
                    self.over = true;
                    return Err(fault);
                }
            }
        }
        Ok(None)
    }

    /// Reads on; a message that is wanted is in `message` then: its channel and its time.
    fn step(&mut self) -> Result<Option<(u16, u64)>, Fault> {
        match self.linear.next_event() {
            None => self.over = true,
            Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                // A damaged length asks for anything: what is there comes piece by piece.
                let room = self.linear.insert(wanted.clamp(PIECE, 4 * PIECE));
                let got = read_some(&mut self.input, room).map_err(Fault::Io)?;
                self.linear.notify_read(got);
                self.bytes += u64::try_from(got).unwrap_or(0);
            }
            Some(Ok(LinearReadEvent::Record { opcode: op::MESSAGE, data })) => {
                let (head, data) =
                    data.split_at_checked(HEAD).ok_or_else(|| damaged("a message is too short"))?;
                let (channel, log_time) = match head {
                    &[a, b, _, _, _, _, c, d, e, f, g, h, i, j, ..] => {
                        (u16::from_le_bytes([a, b]), u64::from_le_bytes([c, d, e, f, g, h, i, j]))
                    }
                    _ => return Err(damaged("a message is too short")),
                };
                let lane = self.channels.get(&channel);
                let lane = lane.ok_or_else(|| {
                    damaged(format!("a message belongs to channel {channel}, which it has not"))
                })?;
                match lane.what {
                    What::Counted(topic) => {
                        if let Some(topic) = self.extras.topics.get_mut(topic) {
                            topic.messages += 1;
                        }
                        if !self.others {
                            return Ok(None);
                        }
                    }
                    What::InForce if !self.is_first => return Ok(None),
                    What::InForce => {
                        let frame = CanFrame::stamp(data)
                            .and_then(|nanos| CanFrame::decode(data, Timestamp { nanos, nine_digits: true }));
                        let CanFrame(Record { time, interface, frame, direction }) = frame
                            .map_err(|error| damaged(format!("a message of {}: {error}", lane.topic)))?;
                        let (bus, own) = (interface.to_owned(), direction == Some(Direction::Sent));
                        self.keep(size_of::<InForce>(), |extras| {
                            extras.in_force.push(InForce { bus, own, frame, nanos: time.nanos })
                        });
                        return Ok(None);
                    }
                    What::Frames { .. } | What::Notes | What::Foreign(_) => {}
                }
                self.message.clear();
                self.message.extend_from_slice(data);
                return Ok(Some((channel, log_time)));
            }
            Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                if matches!(opcode, op::SCHEMA | op::CHANNEL | op::ATTACHMENT | op::METADATA) {
                    match ::mcap::parse_record(opcode, data).map_err(|error| damaged(error.to_string()))? {
                        Raw::Schema { header, .. } => {
                            self.schemas.insert(header.id, header.name);
                        }
                        Raw::Channel(channel) => self.channel(channel),
                        Raw::Attachment { header, data, .. } => {
                            let name = header.name;
                            self.kept += name.len();
                            let bytes =
                                if self.kept + data.len() <= KEPT { data.into_owned() } else { Vec::new() };
                            self.keep(bytes.len(), |extras| extras.attachments.push((name, bytes)));
                        }
                        Raw::Metadata(metadata) => {
                            let facts: Vec<_> = metadata.metadata.into_iter().collect();
                            let size = facts.iter().map(|(key, value)| key.len() + value.len()).sum();
                            self.keep(size, |extras| extras.metadata.push((metadata.name, facts)));
                        }
                        Raw::Header(_)
                        | Raw::Footer(_)
                        | Raw::Message { .. }
                        | Raw::Chunk { .. }
                        | Raw::MessageIndex(_)
                        | Raw::ChunkIndex(_)
                        | Raw::AttachmentIndex(_)
                        | Raw::Statistics(_)
                        | Raw::MetadataIndex(_)
                        | Raw::SummaryOffset(_)
                        | Raw::DataEnd(_)
                        | Raw::Unknown { .. } => {}
                    }
                }
            }
            Some(Err(McapError::UnexpectedEof)) => {
                self.over = true;
                let bytes = self.bytes;
                self.extras.unfinished.get_or_insert_with(|| {
                    format!("it has no end: after {bytes} bytes it was cut off, or never finished")
                });
            }
            Some(Err(McapError::Io(error))) => {
                return Err(damaged(format!("a chunk cannot be unpacked: {error}")));
            }
            Some(Err(error)) => return Err(damaged(error.to_string())),
        }
        Ok(None)
    }

    /// Keeps something of so many bytes, while there is room.
    fn keep(&mut self, size: usize, keep: impl FnOnce(&mut Extras)) {
        self.kept += size;
        if self.kept <= KEPT {
            keep(&mut self.extras);
        }
    }

    fn channel(&mut self, channel: Channel) {
        if self.channels.contains_key(&channel.id) {
            // Said again in the summary.
            return;
        }
        let schema = self.schemas.get(&channel.schema_id).map_or("", String::as_str);
        let nine_digits = channel.metadata.get("time_digits").is_none_or(|digits| digits != "6");
        let what = if channel.message_encoding != "cdr" {
            None
        } else if schema == CanFrame::TYPE && channel.topic.starts_with(TOPIC_OF_STATE) {
            Some(What::InForce)
        } else if schema == CanFrame::TYPE {
            Some(What::Frames { nine_digits })
        } else if schema == CaptureNote::TYPE {
            Some(What::Notes)
        } else {
            Foreign::of(schema).map(What::Foreign)
        };
        let what = what.unwrap_or_else(|| {
            let topics = &mut self.extras.topics;
            let known = topics.iter().position(|topic| topic.name == channel.topic && topic.schema == schema);
            What::Counted(known.unwrap_or_else(|| {
                topics.push(Topic { name: channel.topic.clone(), schema: schema.to_owned(), messages: 0 });
                topics.len() - 1
            }))
        });
        self.channels.insert(channel.id, Lane { topic: channel.topic, what });
    }

    /// What the message says.
    fn entry(&mut self, channel: u16, log_time: u64) -> Entry<'_> {
        let message = &self.message;
        let Some(lane) = self.channels.get(&channel) else {
            return unreadable("", log_time, message, "no channel");
        };
        let decoded = match lane.what {
            What::Frames { nine_digits } => {
                let time = Timestamp { nanos: log_time, nine_digits };
                CanFrame::decode(message, time).map(|frame| Entry::Frame(frame.0))
            }
            What::Foreign(foreign) => foreign.decode(message, log_time, &lane.topic).map(Entry::Frame),
            What::Notes => CaptureNote::decode(message, log_time).map(|note| {
                let mut note = note.0.into_owned();
                if note.line > 0 && !self.any_frame {
                    note.nanos = 0;
                }
                Entry::Note(note)
            }),
            What::Counted(_) | What::InForce => {
                return unreadable("", log_time, message, "it is not looked at");
            }
        };
        match decoded {
            Ok(entry) => {
                self.any_frame |= matches!(entry, Entry::Frame(_));
                entry
            }
            Err(error) => unreadable(&lane.topic, log_time, message, &error.to_string()),
        }
    }
}

/// A message that is not what its channel says.
fn unreadable<'a>(topic: &str, nanos: u64, message: &'a [u8], why: &str) -> Entry<'a> {
    let kind = NoteKind::Unreadable(format!("a message of {topic}: {why}"));
    Entry::Note(Note { kind, nanos, interface: "", line: 0, text: message })
}

fn damaged(what: impl Into<String>) -> Fault {
    Fault::Damaged(what.into())
}
