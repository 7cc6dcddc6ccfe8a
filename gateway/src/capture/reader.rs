//! Reading a capture of either format.

use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use protocol::can::Frame;
use thiserror::Error;

use super::log::LogReader;
use super::magic::{self, Kind};
use super::mcap::{Fault, McapReader, ORIGIN, SOURCE};
use super::{Entry, Item};

/// What a capture is written in.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Format {
    /// Text of `candump -L`.
    Candump,
    /// An MCAP recording.
    Mcap,
}

/// Why a capture cannot be read, or not further.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// It cannot be opened or read.
    #[error("{name}: {source}")]
    Io {
        /// Its name.
        name: String,
        /// Why.
        source: io::Error,
    },
    /// Its first bytes say that it is something else.
    #[error("{name} is {what}, and no candump log or MCAP recording: {remedy}")]
    Other {
        /// Its name.
        name: String,
        /// What it is.
        what: &'static str,
        /// What to do.
        remedy: &'static str,
    },
    /// From here on it is not what it was.
    #[error("{name} is damaged: {what}; {entries} frames and notes before that were read")]
    Damaged {
        /// Its name.
        name: String,
        /// What is wrong.
        what: String,
        /// How many entries came before.
        entries: u64,
    },
}

/// What an MCAP recording has beside frames and notes, as far as it has been read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Extras {
    /// Topics that are no frames and no notes, in the order in which they came.
    pub topics: Vec<Topic>,
    /// Frames of before, that are in force when the recording begins.
    pub in_force: Vec<InForce>,
    /// Attachments by name; the largest without their bytes.
    pub attachments: Vec<(String, Vec<u8>)>,
    /// Metadata by name.
    pub metadata: Vec<(String, Vec<(String, String)>)>,
    /// What is missing at its end, when it was never finished.
    pub unfinished: Option<String>,
}

/// A frame that was on a bus before a recording began, and still says what holds.
#[derive(Clone, Debug, PartialEq)]
pub struct InForce {
    /// Its bus.
    pub bus: String,
    /// Whether whoever recorded it had sent it.
    pub own: bool,
    /// What it is.
    pub frame: Frame,
    /// When it was on the bus, in ns since 1970.
    pub nanos: u64,
}

/// A topic that is neither frames nor notes.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Topic {
    /// Its name.
    pub name: String,
    /// The type of its messages.
    pub schema: String,
    /// How many.
    pub messages: u64,
}

/// Reads a capture from its beginning to its end, in bounded memory.
pub struct Reader {
    name: String,
    source: Source,
    entries: u64,
}

enum Source {
    Log(LogReader),
    Mcap(Box<McapReader>),
}

impl fmt::Debug for Reader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Reader")
            .field("name", &self.name)
            .field("format", &self.format())
            .finish_non_exhaustive()
    }
}

impl Reader {
    /// Opens a file, or standard input by the name `-`.
    ///
    /// # Errors
    /// When it cannot be opened or is no capture.
    pub fn open(path: &Path) -> Result<Self, CaptureError> {
        if path.as_os_str() == "-" {
            return Self::from_read("standard input", io::stdin());
        }
        let (name, file) = file(path)?;
        Self::from_read(name, file)
    }

    /// Reads from anything; the name is for errors. What it is, is told by its first bytes, which are waited
    /// for here.
    ///
    /// # Errors
    /// When it cannot be read or is no capture.
    pub fn from_read(
        name: impl Into<String>,
        input: impl Read + Send + 'static,
    ) -> Result<Self, CaptureError> {
        Self::begin(name.into(), input, false)
    }

    fn begin(name: String, input: impl Read + Send + 'static, others: bool) -> Result<Self, CaptureError> {
        let mut input = Box::new(input);
        let source = match magic::look(&mut input) {
            Ok((Kind::Text, head)) => Source::Log(LogReader::new(&head, input)),
            Ok((Kind::Mcap, head)) => Source::Mcap(Box::new(McapReader::new(&head, input, others))),
            Ok((Kind::Other(what, remedy), _)) => return Err(CaptureError::Other { name, what, remedy }),
            Err(source) => return Err(CaptureError::Io { name, source }),
        };
        Ok(Self { name, source, entries: 0 })
    }

    /// Its name, as errors have it.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What it is written in.
    #[must_use]
    pub const fn format(&self) -> Format {
        match self.source {
            Source::Log(_) => Format::Candump,
            Source::Mcap(_) => Format::Mcap,
        }
    }

    /// The next entry, in the order of the file; `None` after the last one. Never panics.
    ///
    /// # Errors
    /// When it cannot be read, or is damaged: then nothing more comes.
    #[expect(
        clippy::should_implement_trait,
        reason = "an entry borrows from the reader; an iterator's cannot"
    )]
    pub fn next(&mut self) -> Result<Option<Entry<'_>>, CaptureError> {
        // Only what was opened as `Items` has others.
        Ok(match self.next_item()? {
            Some(Item::Entry(entry)) => Some(entry),
            Some(Item::Other(_)) | None => None,
        })
    }

    fn next_item(&mut self) -> Result<Option<Item<'_>>, CaptureError> {
        let Self { name, source, entries } = self;
        let next = match source {
            Source::Log(log) => match log.next() {
                Ok(next) => next.map(Item::Entry),
                Err(source) => return Err(CaptureError::Io { name: name.clone(), source }),
            },
            Source::Mcap(mcap) => match mcap.next() {
                Ok(next) => next,
                Err(Fault::Io(source)) => return Err(CaptureError::Io { name: name.clone(), source }),
                Err(Fault::Damaged(what)) => {
                    return Err(CaptureError::Damaged { name: name.clone(), what, entries: *entries });
                }
            },
        };
        *entries += u64::from(matches!(next, Some(Item::Entry(_))));
        Ok(next)
    }

    /// Whether its entries are lines of a log, now or before it was converted. Else what was left to whoever
    /// took the capture is in it too, as each frame's direction.
    #[must_use]
    pub fn is_of_a_log(&self) -> bool {
        let origin = |facts: &[(String, String)]| {
            facts.iter().any(|(key, value)| (key.as_str(), value.as_str()) == SOURCE)
        };
        self.format() == Format::Candump
            || self.extras().metadata.iter().any(|(name, facts)| name == ORIGIN && origin(facts))
    }

    /// Lines of a log so far: the number of the last entry's; 0 in an MCAP recording.
    #[must_use]
    pub const fn lines(&self) -> u64 {
        match &self.source {
            Source::Log(log) => log.lines(),
            Source::Mcap(_) => 0,
        }
    }

    /// Whether all that has been taken from the input is used up, so that the next entry may take a while: the
    /// time to flush what is shown of a live pipe.
    #[must_use]
    pub const fn is_drained(&self) -> bool {
        match &self.source {
            Source::Log(log) => log.is_drained(),
            Source::Mcap(_) => false,
        }
    }

    /// What it has beside frames and notes, as far as it has been read; what stands before the first of them, from
    /// the beginning. A log has nothing.
    #[must_use]
    pub fn extras(&self) -> &Extras {
        static NONE: Extras = Extras {
            topics: Vec::new(),
            in_force: Vec::new(),
            attachments: Vec::new(),
            metadata: Vec::new(),
            unfinished: None,
        };
        match &self.source {
            Source::Log(_) => &NONE,
            Source::Mcap(mcap) => mcap.extras(),
        }
    }
}

/// Reads a recording with the messages of all its topics, in bounded memory.
#[derive(Debug)]
pub struct Items(Reader);

impl Items {
    /// Opens a file.
    ///
    /// # Errors
    /// When it cannot be opened or is no capture.
    pub fn open(path: &Path) -> Result<Self, CaptureError> {
        let (name, file) = file(path)?;
        Reader::begin(name, file, true).map(Self)
    }

    /// What it is written in.
    #[must_use]
    pub const fn format(&self) -> Format {
        self.0.format()
    }

    /// The next entry, or message of another topic, in the order of the file; `None` after the last one. Never panics.
    ///
    /// # Errors
    /// When it cannot be read, or is damaged: then nothing more comes.
    #[expect(
        clippy::should_implement_trait,
        reason = "an item borrows from the reader; an iterator's cannot"
    )]
    pub fn next(&mut self) -> Result<Option<Item<'_>>, CaptureError> {
        self.0.next_item()
    }

    /// What it has beside messages, as [`Reader::extras`].
    #[must_use]
    pub fn extras(&self) -> &Extras {
        self.0.extras()
    }
}

/// A file and its name for errors.
fn file(path: &Path) -> Result<(String, File), CaptureError> {
    let name = path.display().to_string();
    let failed = |source| CaptureError::Io { name: name.clone(), source };
    let file = File::open(path).map_err(failed)?;
    if file.metadata().map_err(failed)?.is_dir() {
        return Err(failed(io::ErrorKind::IsADirectory.into()));
    }
    Ok((name, file))
}
