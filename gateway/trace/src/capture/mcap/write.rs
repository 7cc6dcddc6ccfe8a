//! The entries of a capture as an MCAP recording.

use std::collections::HashMap;
use std::fs::Metadata;
use std::io::{self, Write};

use protocol::candump::{Record, Timestamp};
use robots::Taken;

use crate::capture::{Entry, Note, NoteKind};
use crate::recording::file::{Channel, FileWriter};
use crate::recording::{NOTES, TOPIC_OF_BUS};

/// Channels of frames at most: each costs a reader memory, and a log may name any number of buses.
const CHANNELS: usize = 64;
/// The topic of the frames of further buses; each has its bus' name.
const FURTHER: &str = "/further";
/// The metadata with the source of a recording that was made from a capture.
pub const ORIGIN: &str = "capture";
/// Its content.
pub(crate) const SOURCE: (&str, &str) = ("from", "candump log");
/// Its content in a recording that was made of another one.
const OTHER_SOURCE: (&str, &str) = ("from", "MCAP recording");
/// The metadata of a channel: digits of a second, 6 or 9.
pub(super) const TIME_DIGITS: &str = "time_digits";
/// The same: digits that seconds are padded to; missing where they are not.
pub(super) const SECONDS_DIGITS: &str = "seconds_digits";
/// Bytes of notes that wait for the first frame.
const WAITING: usize = 1 << 20;

/// Writes entries as messages. Until a first frame tells the time, notes wait for it.
#[derive(Debug)]
pub(crate) struct McapWriter<W: Write> {
    file: FileWriter<W>,
    channels: Vec<BusChannel>,
    /// By bus, its topic: of [`CHANNELS`] buses at most.
    topics: HashMap<String, String>,
    taken: Taken,
    /// The channel of the last frame.
    last: usize,
    notes: Option<Channel>,
    /// Notes before the first frame.
    waiting: Option<Vec<Waiting>>,
    /// Their bytes.
    bytes: usize,
}

/// The channel of a bus' frames with times in one form.
#[derive(Debug)]
struct BusChannel {
    interface: String,
    form: Timestamp,
    channel: Channel,
}

/// A note that waits.
#[derive(Debug)]
struct Waiting {
    kind: NoteKind,
    interface: String,
    line: u64,
    text: Vec<u8>,
}

/// Source and file of a recording.
#[derive(Clone, Copy, Debug)]
pub struct Origin<'a> {
    /// Set if the source is a log, and not a recording.
    pub of_log: bool,
    /// The file that it is written to while it grows, whose mark it gets.
    pub file: Option<&'a Metadata>,
}

impl<W: Write> McapWriter<W> {
    /// Begins a recording.
    pub(crate) fn new(out: W, origin: Origin<'_>) -> io::Result<Self> {
        let mut file = match origin.file {
            Some(about) => FileWriter::in_file(out, about)?,
            None => FileWriter::new(out)?,
        };
        let (key, value) = if origin.of_log { SOURCE } else { OTHER_SOURCE };
        file.metadata(ORIGIN, &[(key.to_owned(), value.to_owned())].into())?;
        let mut taken = Taken::default();
        taken.give_one(NOTES.to_owned());
        Ok(Self {
            file,
            channels: Vec::new(),
            topics: HashMap::new(),
            taken,
            last: 0,
            notes: None,
            waiting: Some(Vec::new()),
            bytes: 0,
        })
    }

    /// Writes an entry.
    pub(crate) fn write(&mut self, entry: &Entry<'_>) -> io::Result<()> {
        match entry {
            Entry::Frame(record) => {
                if self.waiting.is_some() {
                    self.write_waiting(record.time.nanos)?;
                }
                let place = self.channel(record)?;
                let Some(bus) = self.channels.get_mut(place) else { return Ok(()) };
                self.file.write(&mut bus.channel, record.time.nanos, record)
            }
            Entry::Note(note) => match &mut self.waiting {
                Some(waiting) if note.line > 0 && self.bytes < WAITING => {
                    self.bytes += note.text.len() + size_of::<Waiting>();
                    let (kind, interface) = (note.kind.clone(), note.interface.to_owned());
                    waiting.push(Waiting { kind, interface, line: note.line, text: note.text.to_vec() });
                    Ok(())
                }
                _ => {
                    self.write_waiting(note.nanos)?;
                    self.note(note)
                }
            },
        }
    }

    /// Notes before the first frame get its time, so that a viewer's time line does not begin in 1970.
    fn write_waiting(&mut self, nanos: u64) -> io::Result<()> {
        for Waiting { kind, interface, line, text } in self.waiting.take().unwrap_or_default() {
            self.note(&Note { kind, nanos, interface: &interface, line, text: &text })?;
        }
        Ok(())
    }

    fn note(&mut self, note: &Note<'_>) -> io::Result<()> {
        let channel = match &mut self.notes {
            Some(channel) => channel,
            none => none.insert(self.file.channel::<Note<'_>>(NOTES, &[])?),
        };
        self.file.write(channel, note.nanos, note)
    }

    /// The place of a frame's channel, which is created for its first frame.
    fn channel(&mut self, record: &Record<'_>) -> io::Result<usize> {
        let form = Timestamp { nanos: 0, ..record.time };
        let is = |name: &str, bus: &BusChannel| bus.form == form && bus.interface == name;
        if self.channels.get(self.last).is_some_and(|bus| is(record.interface, bus)) {
            return Ok(self.last);
        }
        let find = |channels: &[BusChannel], name: &str| channels.iter().position(|bus| is(name, bus));
        let mut found = find(&self.channels, record.interface);
        let mut name = record.interface;
        if found.is_none() && self.channels.len() >= CHANNELS {
            name = FURTHER;
            found = find(&self.channels, name);
        }
        self.last = if let Some(place) = found {
            place
        } else {
            let proposed = || format!("{TOPIC_OF_BUS}{}", name.trim_start_matches('/'));
            let topic = self.topics.entry(name.to_owned()).or_insert_with(|| self.taken.give_one(proposed()));
            let padded = form.min_digits.to_string();
            let facts =
                [(TIME_DIGITS, if form.nine_digits { "9" } else { "6" }), (SECONDS_DIGITS, padded.as_str())];
            let facts = facts.get(..if form.min_digits > 1 { 2 } else { 1 }).unwrap_or_default();
            let channel = self.file.channel::<Record<'_>>(topic, facts)?;
            self.channels.push(BusChannel { interface: name.to_owned(), form, channel });
            self.channels.len() - 1
        };
        Ok(self.last)
    }

    /// Ends the chunk, and hands everything on but notes that wait for the first frame.
    pub(crate) fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }

    /// Writes the end.
    pub(crate) fn finish(&mut self) -> io::Result<()> {
        self.write_waiting(0)?;
        self.file.finish()
    }
}
