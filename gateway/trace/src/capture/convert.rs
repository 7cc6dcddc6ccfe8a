//! Converts a capture from a log into a recording or back, entry by entry.

use std::io::{self, Write};

use super::log::{LogStyle, LogWriter, OmittedProperties, WriteOutcome};
use super::mcap::McapWriter;
pub use super::mcap::RecordingOrigin;
use super::{CaptureEntry, CaptureError, CaptureFormat, CaptureNote, NoteKind, Reader};
use thiserror::Error;

/// The file that [`convert`] writes: a candump log or an MCAP recording.
#[derive(Debug)]
pub struct CaptureWriter<W: Write>(FormatWriter<W>);

#[derive(Debug)]
enum FormatWriter<W: Write> {
    Log(Box<LogWriter<W>>),
    Mcap(Box<McapWriter<W>>),
}

impl<W: Write> CaptureWriter<W> {
    /// Begins a file of the given format. `style` applies to a candump log only.
    ///
    /// # Errors
    /// Returns an error if the head of the file cannot be written.
    pub fn new(out: W, format: CaptureFormat, style: LogStyle) -> io::Result<Self> {
        Ok(match format {
            CaptureFormat::Candump => Self(FormatWriter::Log(Box::new(LogWriter::new(out, style)))),
            CaptureFormat::Mcap => Self::new_mcap(out, RecordingOrigin { of_log: true, file: None })?,
        })
    }

    /// Begins an MCAP recording that notes `origin`, the source that it is converted from.
    ///
    /// # Errors
    /// Returns an error if the head of the file cannot be written.
    pub fn new_mcap(out: W, origin: RecordingOrigin<'_>) -> io::Result<Self> {
        Ok(Self(FormatWriter::Mcap(Box::new(McapWriter::new(out, origin)?))))
    }

    /// Writes an entry. Returns which of the entry's information the format could not hold.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    pub fn write(&mut self, entry: &CaptureEntry<'_>) -> io::Result<WriteOutcome> {
        match &mut self.0 {
            FormatWriter::Log(log) => log.write(entry),
            FormatWriter::Mcap(mcap) => mcap.write(entry).map(|()| WriteOutcome::All),
        }
    }

    /// Flushes the lines that a log has buffered. Does nothing for a recording, which is written in chunks.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    pub fn flush_lines(&mut self) -> io::Result<()> {
        match &mut self.0 {
            FormatWriter::Log(log) => log.flush_lines(),
            FormatWriter::Mcap(_) => Ok(()),
        }
    }

    /// Flushes everything written so far. It can then be read even if the program is killed.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    pub fn flush_all(&mut self) -> io::Result<()> {
        match &mut self.0 {
            FormatWriter::Log(log) => log.flush_lines(),
            FormatWriter::Mcap(mcap) => mcap.flush(),
        }
    }

    /// Writes the buffered entries and the end of the file.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    pub fn finish(&mut self) -> io::Result<()> {
        match &mut self.0 {
            FormatWriter::Log(log) => log.flush(),
            FormatWriter::Mcap(mcap) => mcap.finish(),
        }
    }
}

/// The side of [`convert`] that entries are written to.
pub trait EntrySink {
    /// Writes an entry. Returns which of the entry's information the output could not hold.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    fn write(&mut self, entry: &CaptureEntry<'_>) -> io::Result<WriteOutcome>;

    /// Flushes the buffered lines.
    ///
    /// # Errors
    /// Returns an error if the output cannot be written.
    fn flush_lines(&mut self) -> io::Result<()>;
}

impl<W: Write> EntrySink for CaptureWriter<W> {
    fn write(&mut self, entry: &CaptureEntry<'_>) -> io::Result<WriteOutcome> {
        Self::write(self, entry)
    }

    fn flush_lines(&mut self) -> io::Result<()> {
        Self::flush_lines(self)
    }
}

/// Counts of frames that lost information when they were written as candump text. A frame that lost two kinds of
/// information counts twice.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct LossCounts {
    /// Frames whose time has fewer digits in the log.
    pub digits: u64,
    /// Frames that lost their direction.
    pub direction: u64,
    /// Frames that lost their raw DLC.
    pub raw_dlc: u64,
    /// Frames that lost the name of their bus.
    pub name: u64,
}

/// Counts of the entries that a conversion read and wrote.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ConversionCounts {
    /// Frames written.
    pub frames: u64,
    /// Notes written: comments and other lines between frames.
    pub notes: u64,
    /// Lines that begin like a frame but cannot be parsed.
    pub unreadable: u64,
    /// Messages of a recording whose bytes do not match their message type.
    pub unreadable_messages: u64,
    /// CAN XL frames, which are copied as text and not decoded.
    pub can_xl: u64,
    /// Frames that were lost when the capture was recorded, by its own notes.
    pub dropped: u64,
    /// Frames that lost information because a line of candump text cannot hold it.
    pub shortened: LossCounts,
    /// Notes left out because the output format cannot hold them.
    pub omitted: u64,
}

/// An error that ends a conversion early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConvertError {
    /// The capture cannot be read further.
    #[error(transparent)]
    Read(#[from] CaptureError),
    /// The output cannot be written.
    #[error(transparent)]
    Write(io::Error),
    /// An entry is unreadable, and the caller's `unreadable` refused to skip it.
    #[error("{0}")]
    Strict(String),
}

/// Copies all entries from a reader to a target, in their order. Calls `unreadable` for each line or message that
/// should be a frame but cannot be parsed; an error returned by `unreadable` stops the conversion.
///
/// # Errors
/// Returns [`ConvertError`] if either side fails, or if `unreadable` returns an error.
pub fn convert(
    from: &mut Reader,
    to: &mut impl EntrySink,
    mut unreadable: impl FnMut(&CaptureNote<'_>, &str) -> Result<(), String>,
) -> Result<ConversionCounts, ConvertError> {
    let mut done = ConversionCounts::default();
    loop {
        let entry = match from.next() {
            Ok(Some(entry)) => entry,
            Ok(None) => return Ok(done),
            Err(error) => {
                // A reader that follows the output gets everything before the error.
                to.flush_lines().map_err(ConvertError::Write)?;
                return Err(error.into());
            }
        };
        match &entry {
            CaptureEntry::Frame(_) => done.frames += 1,
            CaptureEntry::Note(note) => {
                done.count_note(note);
                if let NoteKind::Unreadable(why) = &note.kind {
                    unreadable(note, why).map_err(ConvertError::Strict)?;
                }
            }
        }
        match to.write(&entry).map_err(ConvertError::Write)? {
            WriteOutcome::All => {}
            WriteOutcome::Less(less) => done.shortened.count_omitted(less),
            WriteOutcome::Nothing => {
                done.notes -= 1;
                done.omitted += 1;
            }
        }
        if from.is_drained() {
            // A reader may be following the output.
            to.flush_lines().map_err(ConvertError::Write)?;
        }
    }
}

impl LossCounts {
    fn count_omitted(&mut self, less: OmittedProperties) {
        let OmittedProperties { digits, direction, raw_dlc, name } = less;
        self.digits += u64::from(digits);
        self.direction += u64::from(direction);
        self.raw_dlc += u64::from(raw_dlc);
        self.name += u64::from(name);
    }
}

impl ConversionCounts {
    fn count_note(&mut self, note: &CaptureNote<'_>) {
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
