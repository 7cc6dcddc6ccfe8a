//! A capture of one format into the other, entry by entry.

use std::io::{self, Write};

use super::log::{Less, LogWriter, Style, Wrote};
use super::mcap::McapWriter;
pub use super::mcap::Origin;
use super::{CaptureError, Entry, Format, Note, NoteKind, Reader};
use thiserror::Error;

/// Where entries go.
#[derive(Debug)]
pub struct Output<W: Write>(Form<W>);

#[derive(Debug)]
enum Form<W: Write> {
    Log(Box<LogWriter<W>>),
    Mcap(Box<McapWriter<W>>),
}

impl<W: Write> Output<W> {
    /// A capture of a format, made of a log; `style` is for a log.
    ///
    /// # Errors
    /// When its beginning cannot be written.
    pub fn new(out: W, format: Format, style: Style) -> io::Result<Self> {
        Ok(match format {
            Format::Candump => Self(Form::Log(Box::new(LogWriter::new(out, style)))),
            Format::Mcap => Self::recording(out, Origin { of_log: true, file: None })?,
        })
    }

    /// A recording.
    ///
    /// # Errors
    /// When its beginning cannot be written.
    pub fn recording(out: W, origin: Origin<'_>) -> io::Result<Self> {
        Ok(Self(Form::Mcap(Box::new(McapWriter::new(out, origin)?))))
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
            Form::Log(log) => log.pass_on(),
            Form::Mcap(_) => Ok(()),
        }
    }

    /// Hands everything on: what was written can be read from the output, whatever happens afterwards.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn keep(&mut self) -> io::Result<()> {
        match &mut self.0 {
            Form::Log(log) => log.pass_on(),
            Form::Mcap(mcap) => mcap.flush(),
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

/// Where [`convert`] writes.
pub trait Target {
    /// Writes an entry.
    ///
    /// # Errors
    /// When it cannot be written.
    fn write(&mut self, entry: &Entry<'_>) -> io::Result<Wrote>;

    /// Hands lines on that wait for more.
    ///
    /// # Errors
    /// When they cannot be written.
    fn pass_on(&mut self) -> io::Result<()>;
}

impl<W: Write> Target for Output<W> {
    fn write(&mut self, entry: &Entry<'_>) -> io::Result<Wrote> {
        Self::write(self, entry)
    }

    fn pass_on(&mut self) -> io::Result<()> {
        Self::pass_on(self)
    }
}

/// Frames whose line says less than the capture, by what it does not say.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Shortened {
    /// Digits of their times.
    pub digits: u64,
    /// Their direction.
    pub direction: u64,
    /// Their raw DLC.
    pub raw_dlc: u64,
    /// The name of their bus.
    pub name: u64,
}

/// What a conversion came to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Converted {
    /// Frames that were written.
    pub frames: u64,
    /// Other lines and words that were written.
    pub notes: u64,
    /// Lines that begin like a frame and are none.
    pub unreadable: u64,
    /// Messages that are none of their type.
    pub unreadable_messages: u64,
    /// CAN XL frames, kept as text.
    pub can_xl: u64,
    /// Frames that whoever took the capture lost.
    pub dropped: u64,
    /// Frames whose line says less than the capture.
    pub shortened: Shortened,
    /// Notes that are not in the output.
    pub omitted: u64,
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
pub fn convert(
    from: &mut Reader,
    to: &mut impl Target,
    mut unreadable: impl FnMut(&Note<'_>, &str) -> Result<(), String>,
) -> Result<Converted, ConvertError> {
    let mut done = Converted::default();
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
            Entry::Frame(_) => done.frames += 1,
            Entry::Note(note) => {
                done.note(note);
                if let NoteKind::Unreadable(why) = &note.kind {
                    unreadable(note, why).map_err(ConvertError::Strict)?;
                }
            }
        }
        match to.write(&entry).map_err(ConvertError::Write)? {
            Wrote::All => {}
            Wrote::Less(less) => done.shortened.count(less),
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

impl Shortened {
    fn count(&mut self, less: Less) {
        let Less { digits, direction, raw_dlc, name } = less;
        self.digits += u64::from(digits);
        self.direction += u64::from(direction);
        self.raw_dlc += u64::from(raw_dlc);
        self.name += u64::from(name);
    }
}

impl Converted {
    fn note(&mut self, note: &Note<'_>) {
        self.notes += 1;
        match &note.kind {
            NoteKind::Text => {}
            NoteKind::Dropped(frames) => self.dropped = self.dropped.saturating_add(*frames),
            NoteKind::CanXl => self.can_xl += 1,
            NoteKind::Unreadable(_) if note.line == 0 => self.unreadable_messages += 1,
            NoteKind::Unreadable(_) => self.unreadable += 1,
        }
    }
}
