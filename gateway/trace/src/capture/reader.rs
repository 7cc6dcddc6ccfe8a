//! Reading a capture of either format.

use std::collections::VecDeque;
use std::fmt;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use protocol::input;
use thiserror::Error;

use super::log::{Clock, LogReader, Remark};
use super::magic::{self, Kind};
use super::mcap::{Fault, McapReader, ORIGIN, SOURCE, State};
use super::parts::{self, Part, PartsError};
use super::places::{Place, Places};
use super::{Entry, Extras, Item, Through};
use crate::container::Damage;

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
    #[error(transparent)]
    Parts(#[from] PartsError),
    /// Its first bytes say that it is something else.
    #[error("{name} is {what}, and no candump log or MCAP recording: {hint}")]
    Other {
        /// Its name.
        name: String,
        /// What it is.
        what: &'static str,
        /// What to do.
        hint: &'static str,
    },
    /// From here on it is not what it was.
    #[error("{name} is damaged: {what}; {entries} frames and notes before that were read")]
    Damaged {
        /// Its name.
        name: String,
        /// What is wrong.
        what: Damage,
        /// How many entries came before.
        entries: u64,
    },
}

/// Reads a capture from its beginning to its end, in bounded memory. The parts of a split recording are one capture.
pub struct Reader {
    /// What all of it is called.
    name: String,
    /// The file that is being read.
    file: String,
    source: Source,
    /// Whether messages of all topics are requested.
    others: bool,
    entries: u64,
    /// Which of the parts it is, from 0.
    part: usize,
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
    fn open(path: &Path, through: &Through, mut state: State) -> Result<(String, Self), CaptureError> {
        let name = path.display().to_string();
        let failed = |source| CaptureError::Io { name: name.clone(), source };
        let mut file = input::open(path).map_err(failed)?;
        let about = file.metadata().map_err(failed)?;
        if about.is_file() && is_mcap(&mut file).map_err(failed)? {
            state.find_files(&mut file).and_then(|()| file.rewind()).map_err(failed)?;
        }
        let source = Self::begin(&name, through(file), state)?;
        Ok((name, source))
    }

    fn begin(name: &str, input: impl Read + Send + 'static, state: State) -> Result<Self, CaptureError> {
        let (name, mut input) = (name.to_owned(), Box::new(input));
        match magic::look(&mut input) {
            Ok((Kind::Text, head)) => Ok(Self::Log(LogReader::new(&head, input))),
            Ok((Kind::Mcap, head)) => Ok(Self::Mcap(Box::new(McapReader::new(&head, input, state)))),
            Ok((Kind::Other(what, hint), _)) => Err(CaptureError::Other { name, what, hint }),
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
        Self::open_all(&[path.to_owned()])
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
        let name = name.into();
        let source = Source::begin(&name, input, State::new(false, None))?;
        Ok(Self::begin(name.clone(), (name, source), VecDeque::new(), plain(), false))
    }

    /// Opens one file, or the parts of one recording in any order.
    ///
    /// # Errors
    /// As [`Reader::open`]; when several files are not parts of one recording that follow each other.
    pub fn open_all(paths: &[PathBuf]) -> Result<Self, CaptureError> {
        Self::open_parts(paths, plain(), false)
    }

    /// The same, read through something.
    ///
    /// # Errors
    /// As [`Reader::open_all`].
    pub fn open_through(paths: &[PathBuf], through: Through) -> Result<Self, CaptureError> {
        Self::open_parts(paths, through, false)
    }

    /// The same, with the messages of all topics, which [`Reader::next_item`] gives out.
    ///
    /// # Errors
    /// As [`Reader::open_all`].
    pub fn open_with_others(paths: &[PathBuf]) -> Result<Self, CaptureError> {
        Self::open_parts(paths, plain(), true)
    }

    fn open_parts(paths: &[PathBuf], through: Through, others: bool) -> Result<Self, CaptureError> {
        if let [one] = paths
            && is_input(one)
        {
            let name = "standard input".to_owned();
            let source = Source::begin(&name, io::stdin(), State::new(others, None))?;
            return Ok(Self::begin(name.clone(), (name, source), VecDeque::new(), through, others));
        }
        let ordered = Self::ordered(paths)?;
        let name = parts::title(&ordered);
        let mut rest = VecDeque::from(ordered);
        let first = rest.pop_front().ok_or(PartsError::None)?;
        let opened = Source::open(&first, &through, State::new(others, None))?;
        Ok(Self::begin(name, opened, rest, through, others))
    }

    /// The parts of a recording in their order.
    pub(super) fn ordered(paths: &[PathBuf]) -> Result<Vec<PathBuf>, CaptureError> {
        if let [] | [_] = paths {
            return Ok(paths.to_vec());
        }
        let part = |path: &PathBuf| match is_input(path) {
            true => Err(PartsError::StandardInput.into()),
            false => Ok(Part::of(path, Self::open(path)?.extras())?),
        };
        Ok(parts::ordered(paths.iter().map(part).collect::<Result<_, CaptureError>>()?)?)
    }

    fn begin(
        name: String,
        (file, source): (String, Source),
        rest: VecDeque<PathBuf>,
        through: Through,
        others: bool,
    ) -> Self {
        Self { name, file, source, others, entries: 0, part: 0, rest, through, is_unfinished: false }
    }

    /// What it is called: its name, or those of its first and last part.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Goes on with the part that follows; whether there is one.
    fn go_on(&mut self) -> Result<bool, CaptureError> {
        let Some(path) = self.rest.pop_front() else { return Ok(false) };
        self.part += 1;
        let mut before = self.extras().clone();
        if let Some(what) = before.unfinished.as_mut().filter(|_| !self.is_unfinished) {
            *what = format!("{}: {what}", self.file);
            self.is_unfinished = true;
        }
        let state = State::new(self.others, Some(before));
        (self.file, self.source) = Source::open(&path, &self.through, state)?;
        Ok(true)
    }

    /// Where its next entry is. Of an input that cannot be gone back in it is of no use.
    #[must_use]
    pub const fn place(&self) -> Place {
        let (offset, skip) = match &self.source {
            Source::Log(log) => {
                let (offset, line, clock) = (log.offset(), log.lines(), log.clock());
                return Place { part: self.part, offset, line, skip: 0, clock };
            }
            Source::Mcap(mcap) => mcap.anchor(),
        };
        Place { part: self.part, offset, line: 0, skip, clock: Clock::NEW }
    }

    /// Goes to a place of the same capture; what comes next is the entry there.
    ///
    /// # Errors
    /// When it cannot be read, or is damaged: then nothing more comes.
    pub fn go_to(&mut self, places: &Places, place: Place) -> Result<(), CaptureError> {
        let Some(path) = places.path(place.part) else { return Ok(()) };
        if self.part != place.part || place.offset == 0 {
            let before = (place.part > 0).then(|| self.extras().clone());
            (self.file, self.source) = Source::open(path, &self.through, State::new(self.others, before))?;
            self.part = place.part;
            self.rest = places.behind(place.part).cloned().collect();
        }
        let name = self.file.clone();
        let failed = |source| CaptureError::Io { name: name.clone(), source };
        if place.offset > 0 {
            let mut file = input::open(path).map_err(failed)?;
            file.seek(SeekFrom::Start(place.offset)).map_err(failed)?;
            let input = (self.through)(file);
            let empty = Source::Log(LogReader::new(&[], Box::new(io::empty())));
            self.source = match std::mem::replace(&mut self.source, empty) {
                Source::Log(_) => Source::Log(LogReader::at((place.offset, place.line, place.clock), input)),
                Source::Mcap(mcap) => {
                    let mut state = mcap.into_state();
                    places.describe(place.part, &mut state).map_err(|fault| fault.of(&name, self.entries))?;
                    Source::Mcap(Box::new(McapReader::at(place.offset, input, state)))
                }
            };
        }
        for _ in 0..place.skip {
            self.next_item()?;
        }
        Ok(())
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
        // Only what was opened with others has them.
        Ok(match self.next_item()? {
            Some(Item::Entry(entry)) => Some(entry),
            Some(Item::Other(_)) | None => None,
        })
    }

    /// The next entry, or message of another topic where these are requested, in the order of the file; `None` after the
    /// last one. Never panics.
    ///
    /// # Errors
    /// When it cannot be read, or is damaged: then nothing more comes.
    pub fn next_item(&mut self) -> Result<Option<Item<'_>>, CaptureError> {
        while !self.rest.is_empty() && self.source.is_at_its_end(&self.file, self.entries)? {
            self.go_on()?;
        }
        let Self { file: name, source, entries, .. } = self;
        let next = match source {
            Source::Log(log) => log.next().map(|next| next.map(Item::Entry)).map_err(Fault::from),
            Source::Mcap(mcap) => mcap.next(),
        };
        let next = next.map_err(|fault| fault.of(name, *entries))?;
        *entries += u64::from(matches!(next, Some(Item::Entry(_))));
        Ok(next)
    }

    /// Whether its entries are lines of a log, now or before it was converted. Else what was left to whoever
    /// took the capture is in it too, as each frame's direction.
    #[must_use]
    pub fn is_of_a_log(&self) -> bool {
        let (key, value) = SOURCE;
        self.format() == Format::Candump || self.extras().fact(ORIGIN, key) == Some(value)
    }

    /// Lines of a log so far: the number of the last entry's; 0 in an MCAP recording.
    #[must_use]
    pub const fn lines(&self) -> u64 {
        match &self.source {
            Source::Log(log) => log.lines(),
            Source::Mcap(_) => 0,
        }
    }

    /// What is to be known of the times and flags of the frames so far.
    #[must_use]
    pub fn remarks(&self) -> &[Remark] {
        match &self.source {
            Source::Log(log) => log.remarks(),
            Source::Mcap(_) => &[],
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
        match &self.source {
            Source::Log(_) => Extras::NONE,
            Source::Mcap(mcap) => mcap.extras(),
        }
    }
}

impl Fault {
    /// As an error of a file of which so many entries have been read.
    pub(super) fn of(self, name: &str, entries: u64) -> CaptureError {
        let name = name.to_owned();
        match self {
            Self::Io(source) => CaptureError::Io { name, source },
            Self::Damaged(what) => CaptureError::Damaged { name, what, entries },
        }
    }
}

/// Whether a file is an MCAP recording; its place is its beginning.
pub(super) fn is_mcap(file: &mut File) -> io::Result<bool> {
    let (kind, _) = magic::look(file)?;
    file.rewind()?;
    Ok(kind == Kind::Mcap)
}

fn is_input(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Files as they are.
fn plain() -> Through {
    Box::new(|file| Box::new(file))
}
