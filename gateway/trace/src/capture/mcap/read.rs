//! The entries of an MCAP recording, and what else it has.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufReader, Chain, Cursor, Read, Seek};

use ::mcap::records::op;
use protocol::candump::{Direction, Timestamp};

use super::foreign::Foreign;
use crate::capture::log::LONGEST as LONGEST_LINE;
use crate::capture::{Entry, Extras, InForce, Item, Note, NoteKind, Other, Through, Topic};
use crate::container::{Chunk, Damage, Facts, Framed, MAGIC, Names, Record as Raw, Source, find, parse};
use crate::recording::TOPIC_OF_STATE;
use crate::ros2::Message;
use crate::ros2::messages::{CanFrame, CaptureNote};

/// Bytes that are read at once.
const PIECE: usize = 1 << 18;
/// Bytes of attachments, metadata and frames in force that are kept.
const KEPT: usize = 16 << 20;
/// Bytes that a file, a fact or a frame costs beside its own.
const ENTRY: usize = Names::ENTRY;
/// The longest message that is a frame.
const LONGEST_FRAME: usize = 4 << 10;
/// The longest message that is a note: a line and its place.
const LONGEST_NOTE: usize = LONGEST_LINE + (1 << 10);
/// Letters of a topic's name that stand for a bus without a name.
const LONGEST_BUS: usize = 255;

/// Why nothing more comes.
#[derive(Debug)]
pub(crate) enum Fault {
    Io(io::Error),
    Damaged(String),
}

impl From<io::Error> for Fault {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<Damage> for Fault {
    fn from(damage: Damage) -> Self {
        Self::Damaged(damage.to_string())
    }
}

type Input = BufReader<Chain<Cursor<Vec<u8>>, Box<dyn Read + Send>>>;

/// Reads the entries of a recording.
pub(crate) struct McapReader {
    source: Source<Input>,
    chunk: Chunk,
    state: State,
    /// What was read when it was opened: the first message that is wanted, or why there is none.
    first: Option<Result<Wanted, Fault>>,
}

/// Where a reader is in its file.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Place {
    Magic,
    Records,
    InChunk,
    Over,
}

/// What is known of a recording.
struct State {
    place: Place,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Lane>,
    /// The places of topics that are only counted, by name and type.
    counted: HashMap<(String, String), usize>,
    names: Names,
    extras: Extras,
    /// Bytes of attachments and metadata so far.
    kept: usize,
    /// Whether attachments and metadata are known already.
    knows_files: bool,
    any_frame: bool,
    /// Whether messages that are only counted are wanted too.
    others: bool,
    /// Whether no other part of the recording came before.
    is_first: bool,
}

/// A message that is wanted. What it says is the record that was read last.
#[derive(Clone, Copy)]
struct Wanted {
    channel: u16,
    log_time: u64,
    in_chunk: bool,
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
        Self::begin(head, input, State::new(others))
    }

    /// Reads a file from its beginning. Its attachments and metadata are known from then on, wherever they stand.
    pub(crate) fn with_files(mut file: File, through: &Through, others: bool) -> io::Result<Self> {
        let mut state = State::new(others);
        state.find_files(&mut file)?;
        file.rewind()?;
        Ok(Self::begin(&[], through(file), state))
    }

    fn begin(head: &[u8], input: Box<dyn Read + Send>, state: State) -> Self {
        let input = BufReader::with_capacity(PIECE, Cursor::new(head.to_vec()).chain(input));
        let source = Source::new(input, KEPT as u64);
        let mut reader = Self { source, chunk: Chunk::new(), state, first: None };
        // What stands before the first message is known from the beginning.
        reader.first = reader.advance().transpose();
        reader
    }

    pub(crate) const fn extras(&self) -> &Extras {
        &self.state.extras
    }

    /// It is a part that follows others, of which this is known: what was in force when it began is no news, and its
    /// topics are theirs.
    pub(crate) fn follows(&mut self, before: Extras) {
        let state = &mut self.state;
        let own = std::mem::replace(&mut state.extras, before);
        state.is_first = false;
        state.extras.unfinished = state.extras.unfinished.take().or(own.unfinished);
        let topics = &mut state.extras.topics;
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
        let channels = state.channels.values_mut().filter_map(|lane| match &mut lane.what {
            What::Counted(topic) => Some(topic),
            What::Frames { .. } | What::InForce | What::Notes | What::Foreign(_) => None,
        });
        for topic in channels.chain(state.counted.values_mut()) {
            *topic = places.get(*topic).copied().unwrap_or_default();
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
        let wanted = match self.first.take() {
            Some(first) => Some(first?),
            None => self.advance()?,
        };
        let Some(Wanted { channel, log_time, in_chunk }) = wanted else { return Ok(None) };
        let body = if in_chunk { self.chunk.body() } else { self.source.body() };
        let Ok(Raw::Message { data, .. }) = parse(op::MESSAGE, body) else { return Ok(None) };
        Ok(Some(self.state.item(channel, log_time, data)))
    }

    /// Reads up to the next message that is wanted.
    fn advance(&mut self) -> Result<Option<Wanted>, Fault> {
        while self.state.place != Place::Over {
            match self.step() {
                Ok(None) => {}
                Ok(wanted) => return Ok(wanted),
                Err(fault) => {
                    self.state.place = Place::Over;
                    return Err(fault);
                }
            }
        }
        Ok(None)
    }

    /// Reads on by a record.
    fn step(&mut self) -> Result<Option<Wanted>, Fault> {
        let Self { source, chunk, state, .. } = self;
        match state.place {
            Place::Over => {}
            Place::Magic => {
                let there = source.magic()?;
                state.place = Place::Records;
                if !there {
                    state.no_magic(source.body(), source.read())?;
                }
            }
            Place::InChunk => match chunk.next() {
                Some((opcode @ (op::SCHEMA | op::CHANNEL | op::MESSAGE), body)) => {
                    return state.take(opcode, body, true);
                }
                Some(_) => {}
                None => state.place = Place::Records,
            },
            Place::Records => match source.next()? {
                Framed::Record(op::CHUNK) => {
                    chunk.unpack(source.body(), source.read())?;
                    state.place = Place::InChunk;
                }
                Framed::Record(op::DATA_END) => {
                    let found = source.data_checksum();
                    if let (Raw::DataEnd { crc: saved @ 1.. }, Some(found)) =
                        (parse(op::DATA_END, source.body())?, found)
                        && saved != found
                    {
                        return Err(Damage::Checksum { what: "the data section", saved, found }.into());
                    }
                }
                Framed::Record(op::FOOTER) => {
                    let there = source.magic()?;
                    state.place = Place::Over;
                    if !there {
                        state.no_magic(source.body(), source.read())?;
                    }
                }
                Framed::Record(opcode) => return state.take(opcode, source.body(), false),
                Framed::Long(op::ATTACHMENT, _) => state.attachment(source.attachment_name(), &[]),
                Framed::Long(_, bytes) => {
                    let limit = crate::container::LONGEST;
                    return Err(Damage::Long { what: "record", bytes, limit }.into());
                }
                Framed::End(_) => state.cut_off(source.read()),
            },
        }
        Ok(None)
    }
}

impl State {
    fn new(others: bool) -> Self {
        Self {
            place: Place::Magic,
            schemas: HashMap::new(),
            channels: HashMap::new(),
            counted: HashMap::new(),
            names: Names::default(),
            extras: Extras::default(),
            kept: 0,
            knows_files: false,
            any_frame: false,
            others,
            is_first: true,
        }
    }

    /// There are no magic bytes where they have to be.
    fn no_magic(&mut self, found: &[u8], read: u64) -> Result<(), Fault> {
        if !MAGIC.starts_with(found) {
            return Err(damaged("it does not begin and end with the magic bytes of an MCAP file"));
        }
        self.cut_off(read);
        Ok(())
    }

    fn cut_off(&mut self, read: u64) {
        self.place = Place::Over;
        let why = || format!("it has no end: after {read} bytes it was cut off, or never finished");
        self.extras.unfinished.get_or_insert_with(why);
    }

    /// Takes the attachments and metadata of a file that can be gone through without reading all of it.
    fn find_files(&mut self, file: &mut (impl Read + Seek)) -> io::Result<()> {
        // Most of what is passed over is longer than this.
        let mut from = BufReader::with_capacity(4 << 10, file);
        if from.read_exact(&mut [0; MAGIC.len()]).is_err() {
            return Ok(());
        }
        let mut body = Vec::new();
        while let Some((opcode, length)) = find(&mut from, &[op::ATTACHMENT, op::METADATA, op::FOOTER])? {
            if opcode == op::FOOTER {
                break;
            }
            body.clear();
            let came = (&mut from).take(length.min(KEPT as u64)).read_to_end(&mut body)? as u64;
            if came < length {
                let rest = i64::try_from(length - came);
                if rest.is_err() || rest.is_ok_and(|rest| from.seek_relative(rest).is_err()) {
                    break;
                }
            }
            match parse(opcode, &body) {
                Ok(Raw::Attachment { name, data, .. }) => self.attachment(name, data),
                Ok(Raw::Metadata { name, facts }) => self.metadata(name, &facts),
                // What is wrong with it is said when it is come to.
                _ => {}
            }
        }
        self.knows_files = true;
        Ok(())
    }

    /// Takes a record.
    fn take(&mut self, opcode: u8, body: &[u8], in_chunk: bool) -> Result<Option<Wanted>, Fault> {
        match parse(opcode, body)? {
            Raw::Schema { id, name, .. } => {
                if self.schemas.get(&id).is_none_or(|known| known != name) {
                    self.names.add(name.len())?;
                    self.schemas.insert(id, name.to_owned());
                }
            }
            // Said again in the summary, or in every chunk.
            Raw::Channel { id, .. } if self.channels.contains_key(&id) => {}
            Raw::Channel { id, schema, topic, encoding, facts } => {
                self.channel(id, schema, topic, encoding, &facts)?;
            }
            Raw::Message { channel, log_time, data, .. } => {
                let wanted = self.is_wanted(channel, data)?;
                return Ok(wanted.then_some(Wanted { channel, log_time, in_chunk }));
            }
            Raw::Attachment { name, data, .. } => {
                if !self.knows_files {
                    self.attachment(name, data);
                }
            }
            Raw::Metadata { name, facts } => {
                if !self.knows_files {
                    self.metadata(name, &facts);
                }
            }
            Raw::Header { .. } | Raw::DataEnd { .. } | Raw::Other => {}
        }
        Ok(None)
    }

    /// Takes a message, if nobody else wants it.
    fn is_wanted(&mut self, channel: u16, data: &[u8]) -> Result<bool, Fault> {
        let lane = self.channels.get(&channel);
        let lane =
            lane.ok_or_else(|| damaged(format!("a message belongs to channel {channel}, which it has not")))?;
        match lane.what {
            What::Counted(topic) => {
                if let Some(topic) = self.extras.topics.get_mut(topic) {
                    topic.messages += 1;
                }
                Ok(self.others)
            }
            What::InForce if !self.is_first => Ok(false),
            What::InForce => {
                let frame = |data| {
                    let time = Timestamp { nanos: CanFrame::stamp(data)?, nine_digits: true };
                    CanFrame::decode(data, time)
                };
                let CanFrame(record) = within(data, LONGEST_FRAME)
                    .and_then(|data| frame(data).map_err(|error| error.to_string()))
                    .map_err(|why| damaged(format!("a message of {}: {why}", lane.topic)))?;
                let (bus, own) = (record.interface, record.direction == Some(Direction::Sent));
                let (frame, nanos) = (record.frame, record.time.nanos);
                self.keep(bus.len() + ENTRY, |extras| {
                    extras.in_force.push(InForce { bus: bus.to_owned(), own, frame, nanos });
                });
                Ok(false)
            }
            What::Frames { .. } | What::Notes | What::Foreign(_) => Ok(true),
        }
    }

    /// Keeps something of so many bytes, while there is room.
    fn keep(&mut self, size: usize, keep: impl FnOnce(&mut Extras)) {
        self.kept = self.kept.saturating_add(size);
        if self.kept <= KEPT {
            keep(&mut self.extras);
        }
    }

    fn attachment(&mut self, name: &str, data: &[u8]) {
        let fits = self.kept.saturating_add(name.len() + ENTRY + data.len()) <= KEPT;
        let data = if fits { data } else { &[] };
        self.keep(name.len() + ENTRY + data.len(), |extras| {
            extras.attachments.push((name.to_owned(), data.to_vec()));
        });
    }

    fn metadata(&mut self, name: &str, facts: &Facts<'_>) {
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
        facts: &Facts<'_>,
    ) -> Result<(), Fault> {
        let schema = self.schemas.get(&schema).cloned().unwrap_or_default();
        // Each of them may be kept twice.
        self.names.add(2 * (topic.len() + schema.len()))?;
        let nine_digits = facts.get("time_digits").is_none_or(|digits| digits != "6");
        let what = if encoding != "cdr" {
            None
        } else if schema == CanFrame::TYPE && topic.starts_with(TOPIC_OF_STATE) {
            Some(What::InForce)
        } else if schema == CanFrame::TYPE {
            Some(What::Frames { nine_digits })
        } else if schema == CaptureNote::TYPE {
            Some(What::Notes)
        } else {
            Foreign::of(&schema).map(What::Foreign)
        };
        let what = what.unwrap_or_else(|| {
            let topics = &mut self.extras.topics;
            let place =
                self.counted.entry((topic.to_owned(), schema)).or_insert_with_key(|(name, schema)| {
                    topics.push(Topic { name: name.clone(), schema: schema.clone(), messages: 0 });
                    topics.len() - 1
                });
            What::Counted(*place)
        });
        self.channels.insert(id, Lane { topic: topic.to_owned(), what });
        Ok(())
    }

    fn item<'a>(&'a mut self, channel: u16, log_time: u64, message: &'a [u8]) -> Item<'a> {
        let Some(Lane { topic, what }) = self.channels.get(&channel) else {
            return Item::Entry(unreadable("", log_time, message, "no channel"));
        };
        let unreadable = |why: &str| unreadable(topic, log_time, message, why);
        let decoded = match *what {
            What::Counted(place) => {
                let topic = self.extras.topics.get(place);
                let (topic, schema) = topic.map_or(("", ""), |topic| (&topic.name, &topic.schema));
                return Item::Other(Other { topic, schema, nanos: log_time, message });
            }
            What::InForce => Err("it is not looked at".to_owned()),
            What::Frames { nine_digits } => within(message, LONGEST_FRAME).and_then(|message| {
                let time = Timestamp { nanos: log_time, nine_digits };
                let frame = CanFrame::decode(message, time);
                frame.map(|frame| Entry::Frame(frame.0)).map_err(|error| error.to_string())
            }),
            What::Foreign(foreign) => within(message, LONGEST_FRAME).and_then(|message| {
                let bus = beginning(topic);
                let frame = foreign.decode(message, log_time, bus);
                frame.map(Entry::Frame).map_err(|error| error.to_string())
            }),
            What::Notes => within(message, LONGEST_NOTE).and_then(|message| {
                let note = CaptureNote::decode(message, log_time).map_err(|error| error.to_string())?;
                let mut note = note.0.into_owned();
                if note.line > 0 && !self.any_frame {
                    note.nanos = 0;
                }
                Ok(Entry::Note(note))
            }),
        };
        let entry = decoded.unwrap_or_else(|why| unreadable(&why));
        self.any_frame |= matches!(entry, Entry::Frame(_));
        Item::Entry(entry)
    }
}

/// A message, unless it is too long for what it is to be.
fn within(message: &[u8], longest: usize) -> Result<&[u8], String> {
    if message.len() > longest {
        return Err(format!("it has {} bytes, and may have {longest}", message.len()));
    }
    Ok(message)
}

/// The beginning of a topic's name, which may be as long as anything.
fn beginning(topic: &str) -> &str {
    let ends = (0..=LONGEST_BUS.min(topic.len())).rev();
    ends.filter_map(|end| topic.get(..end)).next().unwrap_or_default()
}

/// A message that is not what its channel says.
fn unreadable<'a>(topic: &str, nanos: u64, message: &'a [u8], why: &str) -> Entry<'a> {
    let topic = beginning(topic);
    let kind = NoteKind::Unreadable(format!("a message of {topic}: {why}"));
    let message = message.get(..LONGEST_LINE).unwrap_or(message);
    Entry::Note(Note { kind, nanos, interface: "", line: 0, text: message })
}

fn damaged(what: impl Into<String>) -> Fault {
    Fault::Damaged(what.into())
}
