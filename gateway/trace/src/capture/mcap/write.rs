//! The entries of a capture as an MCAP recording.

use std::io::{self, Write};

use protocol::candump::Record;

use crate::capture::{Entry, Note, NoteKind};
use crate::recording::file::{Channel, FileWriter};
use crate::recording::{NOTES, TOPIC_OF_BUS};

/// Channels of frames: each costs a reader memory, and what a log calls its buses may be anything.
const CHANNEL_STATES: usize = 64;
/// Where the frames of further buses stand; each bears its bus' name.
const FURTHER: &str = "/further";
/// The metadata that says what a recording was made from, when that was a capture.
pub const ORIGIN: &str = "capture";
/// What it says.
pub(crate) const SOURCE: (&str, &str) = ("from", "candump log");
/// Bytes of notes that wait for the first frame.
const WAITING: usize = 1 << 20;

/// Writes entries as messages. Until a first frame tells the time, notes wait for it.
#[derive(Debug)]
pub(crate) struct McapWriter<W: Write> {
    file: FileWriter<W>,
    channel_states: Vec<LinkId>,
    /// The lane of the last frame.
    last: usize,
    notes: Option<Channel>,
    /// Notes before the first frame.
    waiting: Option<Vec<Waiting>>,
    /// Their bytes.
    bytes: usize,
}

/// The channel of a bus' frames with times of so many digits.
#[derive(Debug)]
struct LinkId {
    interface: String,
    nine_digits: bool,
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

impl<W: Write> McapWriter<W> {
    /// Begins a recording.
    pub(crate) fn new(out: W) -> io::Result<Self> {
        let mut file = FileWriter::new(out)?;
        let (key, value) = SOURCE;
        file.metadata(ORIGIN, &[(key.to_owned(), value.to_owned())].into())?;
        Ok(Self {
            file,
            channel_states: Vec::new(),
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
                let channel_state = self.channel_state(record)?;
                let Some(channel_state) = self.channel_states.get_mut(channel_state) else { return Ok(()) };
                self.file.write(&mut channel_state.channel, record.time.nanos, record)
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

    /// The place of a frame's lane, which is made when it is the first one there.
    fn channel_state(&mut self, record: &Record<'_>) -> io::Result<usize> {
        let nine_digits = record.time.nine_digits;
        let is = |name: &str, channel_state: &LinkId| {
            channel_state.nine_digits == nine_digits && channel_state.interface == name
        };
        if self.channel_states.get(self.last).is_some_and(|channel_state| is(record.interface, channel_state))
        {
            return Ok(self.last);
        }
        let find = |channel_states: &[LinkId], name: &str| {
            channel_states.iter().position(|channel_state| is(name, channel_state))
        };
        let mut found = find(&self.channel_states, record.interface);
        let mut name = record.interface;
        if found.is_none() && self.channel_states.len() >= CHANNEL_STATES {
            name = FURTHER;
            found = find(&self.channel_states, name);
        }
        self.last = if let Some(place) = found {
            place
        } else {
            let topic = format!("{TOPIC_OF_BUS}{}", name.trim_start_matches('/'));
            let digits = if nine_digits { "9" } else { "6" };
            let channel = self.file.channel::<Record<'_>>(&topic, &[("time_digits", digits)])?;
            self.channel_states.push(LinkId { interface: name.to_owned(), nine_digits, channel });
            self.channel_states.len() - 1
        };
        Ok(self.last)
    }

    /// Writes the end.
    pub(crate) fn finish(&mut self) -> io::Result<()> {
        self.write_waiting(0)?;
        self.file.finish()
    }
}
