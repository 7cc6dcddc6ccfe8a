//! Reading a capture of either format.

use std::collections::VecDeque;
use std::fmt;
use std::fs::File;
use std::io::{self, Read, Seek};
use std::path::{Path, PathBuf};

use protocol::can::Frame;
use protocol::document::DocumentError;
use protocol::skin::Skin;
use serde::Serialize;
use thiserror::Error;

use super::log::LogReader;
use super::magic::{self, Kind};
use super::mcap::{Fault, McapReader, ORIGIN, SOURCE};
use super::{Entry, Item, parts};

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
    /// Several files are not the parts of one recording.
    #[error("{0}")]
    Parts(String),
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

/// What the skin in a recording of a run is called.
pub const SKIN: &str = "skin.toml";

impl Extras {
    /// The skin that is attached; `None` when none is.
    ///
    /// # Errors
    /// Of the skin, when it is none that this version knows.
    #[must_use]
    pub fn skin(&self) -> Option<Result<Skin, DocumentError>> {
        let (_, text) = self.attachments.iter().find(|(name, _)| name == SKIN)?;
        Some(Skin::parse(SKIN, &String::from_utf8_lossy(text)))
    }
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
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Topic {
    /// Its name.
    #[serde(rename = "topic")]
    pub name: String,
    /// The type of its messages.
    pub schema: String,
    /// How many.
    pub messages: u64,
}

/// What a file is read through.
pub type Through = Box<dyn Fn(File) -> Box<dyn Read + Send> + Send>;

/// Reads a capture from its beginning to its end, in bounded memory. The parts of a split recording are one capture.
pub struct Reader {
    /// What all of it is called.
    name: String,
    /// The file that is being read.
    file: String,
    source: Source,
    /// Whether messages of all topics are wanted.
    others: bool,
    entries: u64,
    /// Parts that follow.
    rest: VecDeque<PathBuf>,
    through: Through,
    /// Whether a part before this one has no end.
    is_unfinished: bool,
}

enum Source {
    Log(LogReader),
    Mcap(Box<McapReader>),
}

impl Source {
    /// Of a recording that is a regular file, attachments and metadata are known from the beginning.
    fn open(path: &Path, through: &Through, others: bool) -> Result<(String, Self), CaptureError> {
        let name = path.display().to_string();
        let failed = |source| CaptureError::Io { name: name.clone(), source };
        let mut file = File::open(path).map_err(failed)?;
        let about = file.metadata().map_err(failed)?;
        if about.is_dir() {
            return Err(failed(io::ErrorKind::IsADirectory.into()));
        }
        if about.is_file() {
            let looked = magic::look(&mut file).and_then(|looked| file.rewind().map(|()| looked));
            if let (Kind::Mcap, _) = looked.map_err(failed)? {
                let mcap = McapReader::with_files(file, through, others).map_err(failed)?;
                return Ok((name, Self::Mcap(Box::new(mcap))));
            }
        }
        let source = Self::begin(&name, through(file), others)?;
        Ok((name, source))
    }

    fn begin(name: &str, input: impl Read + Send + 'static, others: bool) -> Result<Self, CaptureError> {
        let (name, mut input) = (name.to_owned(), Box::new(input));
        match magic::look(&mut input) {
            Ok((Kind::Text, head)) => Ok(Self::Log(LogReader::new(&head, input))),
            Ok((Kind::Mcap, head)) => Ok(Self::Mcap(Box::new(McapReader::new(&head, input, others)))),
            Ok((Kind::Other(what, remedy), _)) => Err(CaptureError::Other { name, what, remedy }),
            Err(source) => Err(CaptureError::Io { name, source }),
        }
    }

    /// Whether nothing more comes of it, when it is a recording.
    fn is_at_its_end(&mut self, name: &str, entries: u64) -> Result<bool, CaptureError> {
        let Self::Mcap(mcap) = self else { return Ok(false) };
        mcap.is_at_its_end().map_err(|fault| fault.of(name, entries))
    }
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
        Self::begin_parts(&[path.to_owned()], plain(), false)
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

    /// Opens one file, or the parts of one recording in any order.
    ///
    /// # Errors
    /// As [`Reader::open`]; when several files are not parts of one recording that follow each other.
    pub fn open_all(paths: &[PathBuf]) -> Result<Self, CaptureError> {
        Self::open_through(paths, plain())
    }

    /// The same, read through something.
    ///
    /// # Errors
    /// As [`Reader::open_all`].
    pub fn open_through(paths: &[PathBuf], through: Through) -> Result<Self, CaptureError> {
        Self::begin_parts(paths, through, false)
    }

    fn begin_parts(paths: &[PathBuf], through: Through, others: bool) -> Result<Self, CaptureError> {
        if let [one] = paths
            && one.as_os_str() == "-"
        {
            return Self::begin("standard input".to_owned(), io::stdin(), others);
        }
        let paths = parts::ordered(paths)?;
        let name = parts::title(&paths);
        let mut rest = VecDeque::from(paths);
        let Some(first) = rest.pop_front() else {
            return Err(CaptureError::Parts("no file is named: name a capture".to_owned()));
        };
        let (file, source) = Source::open(&first, &through, others)?;
        Ok(Self { name, file, source, others, entries: 0, rest, through, is_unfinished: false })
    }

    fn begin(name: String, input: impl Read + Send + 'static, others: bool) -> Result<Self, CaptureError> {
        let source = Source::begin(&name, input, others)?;
        let (file, rest) = (name.clone(), VecDeque::new());
        Ok(Self { name, file, source, others, entries: 0, rest, through: plain(), is_unfinished: false })
    }

    /// What it is called: its name, or those of its first and last part.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Goes on with the part that follows; whether there is one.
    fn go_on(&mut self) -> Result<bool, CaptureError> {
        let Some(path) = self.rest.pop_front() else { return Ok(false) };
        let (name, mut next) = Source::open(&path, &self.through, self.others)?;
        if let (Source::Mcap(before), Source::Mcap(next)) = (&self.source, &mut next) {
            let mut extras = before.extras().clone();
            if let Some(what) = extras.unfinished.as_mut().filter(|_| !self.is_unfinished) {
                *what = format!("{}: {what}", self.file);
                self.is_unfinished = true;
            }
            next.follows(extras);
        }
        (self.file, self.source) = (name, next);
        Ok(true)
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
        while !self.rest.is_empty() && self.source.is_at_its_end(&self.file, self.entries)? {
            self.go_on()?;
        }
        let Self { file: name, source, entries, .. } = self;
        let next = match source {
            Source::Log(log) => match log.next() {
                Ok(next) => next.map(Item::Entry),
                Err(source) => return Err(CaptureError::Io { name: name.clone(), source }),
            },
            Source::Mcap(mcap) => match mcap.next() {
                Ok(next) => next,
                Err(fault) => return Err(fault.of(name, *entries)),
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
    /// Opens one file, or the parts of one recording in any order.
    ///
    /// # Errors
    /// As [`Reader::open_all`].
    pub fn open_all(paths: &[PathBuf]) -> Result<Self, CaptureError> {
        Reader::begin_parts(paths, plain(), true).map(Self)
    }

    /// What it is called, as [`Reader::name`].
    #[must_use]
    pub fn name(&self) -> &str {
        self.0.name()
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

impl Fault {
    /// As an error of a file of which so many entries have been read.
    fn of(self, name: &str, entries: u64) -> CaptureError {
        let name = name.to_owned();
        match self {
            Self::Io(source) => CaptureError::Io { name, source },
            Self::Damaged(what) => CaptureError::Damaged { name, what, entries },
        }
    }
}

/// Files as they are.
fn plain() -> Through {
    Box::new(|file| Box::new(file))
}
