//! Writes the entries of a capture as an MCAP recording.

use std::collections::HashMap;
use std::fs::Metadata;
use std::io::{self, Write};

use protocol::candump::{Record, Timestamp};
use robots::UniqueNames;

use crate::capture::{CaptureEntry, CaptureNote, NoteKind};
use crate::recording::file::{Channel, FileWriter};
use crate::recording::{BUS_TOPIC_PREFIX, NOTES_TOPIC};

/// The maximum number of channels for frames. Each channel costs a reader memory, and a log may contain any number of
/// buses.
const MAX_CHANNELS: usize = 64;
/// The topic for frames of all buses beyond [`MAX_CHANNELS`]. Each message holds the name of its bus.
const FURTHER_BUSES_TOPIC: &str = "/further";
/// The name of the metadata record that states what a recording was converted from.
pub const ORIGIN_METADATA: &str = "capture";
/// The entry of [`ORIGIN_METADATA`] in a recording that was converted from a log.
pub(crate) const LOG_ORIGIN: (&str, &str) = ("from", "candump log");
/// The entry of [`ORIGIN_METADATA`] in a recording that was converted from another recording.
const RECORDING_ORIGIN: (&str, &str) = ("from", "MCAP recording");
/// The metadata key of a channel for the number of decimals of its times: 6 or 9.
pub(super) const TIME_DIGITS_KEY: &str = "time_digits";
/// The metadata key of a channel for the number of digits to which seconds are padded. It is missing if they are not
/// padded.
pub(super) const SECONDS_DIGITS_KEY: &str = "seconds_digits";
/// The maximum size of notes that wait for the first frame, in bytes.
const MAX_WAITING_BYTES: usize = 1 << 20;

/// Writes the entries of a capture as messages. Notes before the first frame are held back, because they get its time.
#[derive(Debug)]
pub(crate) struct McapWriter<W: Write> {
    file: FileWriter<W>,
    channels: Vec<BusChannel>,
    /// The topic of each bus, for at most [`MAX_CHANNELS`] buses.
    topics: HashMap<String, String>,
    taken: UniqueNames,
    /// The index of the channel that the last frame was written to.
    last: usize,
    notes: Option<Channel>,
    /// Notes before the first frame; `None` after it.
    waiting: Option<Vec<WaitingNote>>,
    /// The size of the waiting notes, in bytes.
    bytes: usize,
}

/// The channel for the frames of one bus whose times have one form.
#[derive(Debug)]
struct BusChannel {
    interface: String,
    form: Timestamp,
    channel: Channel,
}

/// A note that waits for the first frame.
#[derive(Debug)]
struct WaitingNote {
    kind: NoteKind,
    interface: String,
    line: u64,
    text: Vec<u8>,
}

/// The source that a recording is converted from, and the file that it is written to.
#[derive(Clone, Copy, Debug)]
pub struct RecordingOrigin<'a> {
    /// True if the source is a log, false if it is a recording.
    pub of_log: bool,
    /// The metadata of the file that is written. Its inode is stored in the recording, so that an unfinished file can
    /// be recognised.
    pub file: Option<&'a Metadata>,
}

impl<W: Write> McapWriter<W> {
    /// Begins a recording.
    pub(crate) fn new(out: W, origin: RecordingOrigin<'_>) -> io::Result<Self> {
        let mut file = match origin.file {
            Some(about) => FileWriter::with_file_identity(out, about)?,
            None => FileWriter::new(out)?,
        };
        let (key, value) = if origin.of_log { LOG_ORIGIN } else { RECORDING_ORIGIN };
        file.write_metadata(ORIGIN_METADATA, &[(key.to_owned(), value.to_owned())].into())?;
        let mut taken = UniqueNames::default();
        taken.assign(NOTES_TOPIC.to_owned());
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
    pub(crate) fn write(&mut self, entry: &CaptureEntry<'_>) -> io::Result<()> {
        match entry {
            CaptureEntry::Frame(record) => {
                if self.waiting.is_some() {
                    self.write_waiting(record.time.nanos)?;
                }
                let place = self.channel_index(record)?;
                let Some(bus) = self.channels.get_mut(place) else { return Ok(()) };
                self.file.write(&mut bus.channel, record.time.nanos, record)
            }
            CaptureEntry::Note(note) => match &mut self.waiting {
                Some(waiting) if note.line > 0 && self.bytes < MAX_WAITING_BYTES => {
                    self.bytes += note.text.len() + size_of::<WaitingNote>();
                    let (kind, interface) = (note.kind.clone(), note.interface.to_owned());
                    waiting.push(WaitingNote { kind, interface, line: note.line, text: note.text.to_vec() });
                    Ok(())
                }
                _ => {
                    self.write_waiting(note.nanos)?;
                    self.write_note(note)
                }
            },
        }
    }

    /// Writes the waiting notes with the time of the first frame. With their own time, 0, the time line of a viewer
    /// would begin in 1970.
    fn write_waiting(&mut self, nanos: u64) -> io::Result<()> {
        for WaitingNote { kind, interface, line, text } in self.waiting.take().unwrap_or_default() {
            self.write_note(&CaptureNote { kind, nanos, interface: &interface, line, text: &text })?;
        }
        Ok(())
    }

    fn write_note(&mut self, note: &CaptureNote<'_>) -> io::Result<()> {
        let channel = match &mut self.notes {
            Some(channel) => channel,
            none => none.insert(self.file.channel::<CaptureNote<'_>>(NOTES_TOPIC, &[])?),
        };
        self.file.write(channel, note.nanos, note)
    }

    /// Returns the index of the channel for a frame. Creates the channel at its first frame.
    fn channel_index(&mut self, record: &Record<'_>) -> io::Result<usize> {
        let form = Timestamp { nanos: 0, ..record.time };
        let is = |name: &str, bus: &BusChannel| bus.form == form && bus.interface == name;
        if self.channels.get(self.last).is_some_and(|bus| is(record.interface, bus)) {
            return Ok(self.last);
        }
        let find = |channels: &[BusChannel], name: &str| channels.iter().position(|bus| is(name, bus));
        let mut found = find(&self.channels, record.interface);
        let mut name = record.interface;
        if found.is_none() && self.channels.len() >= MAX_CHANNELS {
            name = FURTHER_BUSES_TOPIC;
            found = find(&self.channels, name);
        }
        self.last = if let Some(place) = found {
            place
        } else {
            let proposed = || format!("{BUS_TOPIC_PREFIX}{}", name.trim_start_matches('/'));
            let topic = self.topics.entry(name.to_owned()).or_insert_with(|| self.taken.assign(proposed()));
            let padded = form.min_digits.to_string();
            let facts = [
                (TIME_DIGITS_KEY, if form.nine_digits { "9" } else { "6" }),
                (SECONDS_DIGITS_KEY, padded.as_str()),
            ];
            let facts = facts.get(..if form.min_digits > 1 { 2 } else { 1 }).unwrap_or_default();
            let channel = self.file.channel::<Record<'_>>(topic, facts)?;
            self.channels.push(BusChannel { interface: name.to_owned(), form, channel });
            self.channels.len() - 1
        };
        Ok(self.last)
    }

    /// Ends the chunk and flushes it. Notes that wait for the first frame are kept.
    pub(crate) fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }

    /// Writes the end of the file.
    pub(crate) fn finish(&mut self) -> io::Result<()> {
        self.write_waiting(0)?;
        self.file.finish()
    }
}
