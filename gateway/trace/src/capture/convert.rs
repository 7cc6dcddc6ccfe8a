//! A capture of one format into the other, entry by entry.

use std::io::{self, Write};

use super::last_times::LastTimes;
use super::log::{LogWriter, Style, Wrote};
use super::mcap::McapWriter;
use super::{CaptureError, Entry, Format, Note, NoteKind, Reader};
use protocol::candump::Record;
use thiserror::Error;

/// Buses whose times are compared.
const BUSES: usize = 64;

/// Where entries go.
#[derive(Debug)]
pub struct Output<W: Write>(Form<W>);

#[derive(Debug)]
enum Form<W: Write> {
    Log(LogWriter<W>),
    Mcap(Box<McapWriter<W>>),
}

impl<W: Write> Output<W> {
    /// A capture of a format; `style` is for a log.
    ///
    /// # Errors
    /// When its beginning cannot be written.
    pub fn new(out: W, format: Format, style: Style) -> io::Result<Self> {
        Ok(Self(match format {
            Format::Candump => Form::Log(LogWriter::new(out, style)),
            Format::Mcap => Form::Mcap(Box::new(McapWriter::new(out)?)),
        }))
    }

    /// Writes an entry.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&mut self, entry: &Entry<'_>) -> io::Result<Wrote> {
        match &mut self.0 {
            Form::Log(log) => log.write(entry),
            Form::Mcap(mcap) => mcap.write(entry).map(|()| Wrote::All),
        }
    }

    /// Hands lines on that wait for more; a recording is written in its own pieces.
    ///
    /// # Errors
    /// When they cannot be written.
    pub fn pass_on(&mut self) -> io::Result<()> {
        match &mut self.0 {
            Form::Log(log) => log.flush(),
            Form::Mcap(_) => Ok(()),
        }
    }

    /// Writes what is left, and the end.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn finish(&mut self) -> io::Result<()> {
        match &mut self.0 {
            Form::Log(log) => log.flush(),
            Form::Mcap(mcap) => mcap.finish(),
        }
    }
}

/// What a conversion came to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Converted {
    /// Frames that were written.
    pub frames: u64,
    /// Other lines and words that were written.
    pub notes: u64,
    /// Lines or messages that begin like a frame and are none.
    pub unreadable: u64,
    /// CAN XL frames, kept as text.
    pub can_xl: u64,
    /// Frames that whoever took the capture lost.
    pub dropped: u64,
    /// Frames whose line says less than the capture.
    pub shortened: u64,
    /// Notes that are not in the output.
    pub omitted: u64,
    /// How often a frame is older than the one before it on its bus, and the first of them, counted from 1.
    pub backwards: Option<(u64, u64)>,
}

/// Why a conversion ended before its time.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConvertError {
    /// The capture cannot be read further.
    #[error(transparent)]
    Read(#[from] CaptureError),
    /// The output cannot be written.
    #[error(transparent)]
    Write(io::Error),
    /// Something is unreadable, and nothing of that kind is let through.
    #[error("{0}")]
    Strict(String),
}

/// Copies all entries in their order. `unreadable` is told of each line that is no frame; what it returns
/// says whether to go on.
///
/// # Errors
/// When one side fails, or `unreadable` says so.
pub fn convert<W: Write>(
    from: &mut Reader,
    to: &mut Output<W>,
    mut unreadable: impl FnMut(&Note<'_>, &str) -> Result<(), String>,
) -> Result<Converted, ConvertError> {
    let mut done = Converted::default();
    let mut last_times = LastTimes::default();
    loop {
        let entry = match from.next() {
            Ok(Some(entry)) => entry,
            Ok(None) => return Ok(done),
            Err(error) => {
                // Who reads along has what came before.
                to.pass_on().map_err(ConvertError::Write)?;
                return Err(error.into());
            }
        };
        match &entry {
            Entry::Frame(record) => done.frame(record, &mut last_times),
            Entry::Note(note) => {
                done.note(&note.kind);
                if let NoteKind::Unreadable(why) = &note.kind {
                    unreadable(note, why).map_err(ConvertError::Strict)?;
                }
            }
        }
        match to.write(&entry).map_err(ConvertError::Write)? {
            Wrote::All => {}
            Wrote::Less => done.shortened += 1,
            Wrote::Nothing => {
                done.notes -= 1;
                done.omitted += 1;
            }
        }
        if from.is_drained() {
            // Somebody may be reading along.
            to.pass_on().map_err(ConvertError::Write)?;
        }
    }
}

impl Converted {
    fn frame(&mut self, record: &Record<'_>, last_times: &mut LastTimes<BUSES>) {
        self.frames += 1;
        let nanos = record.time.nanos;
        if last_times.replace(record.interface, nanos).is_some_and(|last| nanos < last) {
            self.backwards.get_or_insert((0, self.frames)).0 += 1;
        }
    }

    fn note(&mut self, kind: &NoteKind) {
        self.notes += 1;
        match kind {
            NoteKind::Text => {}
            NoteKind::Dropped(frames) => self.dropped = self.dropped.saturating_add(*frames),
            NoteKind::CanXl => self.can_xl += 1,
            NoteKind::Unreadable(_) => self.unreadable += 1,
        }
    }
}
