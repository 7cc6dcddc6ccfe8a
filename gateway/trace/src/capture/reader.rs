//! Reads captures, which may be candump logs or MCAP recordings.

mod source;

use std::collections::VecDeque;
use std::fmt;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use protocol::input;

use super::log::{Clock, LogReader, LogRemark};
use super::magic::is_mcap;
use super::mcap::{
    ForeignBusNames, LOG_ORIGIN, McapReader, McapState, ORIGIN_METADATA, ReadFault, TopicSurvey,
};
use super::parts::{self, CaptureFile, PartsError};
use super::place::{SeekIndex, SeekPoint};
use super::text_kinds::detect_text_kind;
use super::times::TimeChecks;
use super::{CaptureEntry, CaptureError, CaptureFormat, FileWrapper, RecordingExtras, RecordingItem};
use source::CaptureSource;

/// Reads a capture from its beginning to its end in bounded memory. The parts of a split recording are one capture.
pub struct Reader {
    /// The name of the capture; for several files, the names of the first and the last.
    name: String,
    /// The name of the file that is being read.
    file: String,
    source: CaptureSource,
    /// True if messages of other topics are returned too, not only frames and notes.
    all_topics: bool,
    entries: u64,
    /// The index of the file that is being read.
    part: usize,
    /// The files that follow.
    remaining: VecDeque<PathBuf>,
    through: FileWrapper,
    /// True if an earlier file has no end, because it was never finished.
    is_unfinished: bool,
    /// The bus names for frames of other programs, if they were found before reading.
    buses: ForeignBusNames,
    times: TimeChecks,
    /// The name of the preceding file. `None` once the first frame of the current file has been read.
    before: Option<String>,
    /// Remarks on the logs that were read before the current file.
    remarks: Vec<LogRemark>,
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
    /// Opens a file as a capture. The name `-` means standard input.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the file cannot be opened or is not a capture.
    pub fn open(path: &Path) -> Result<Self, CaptureError> {
        Self::open_all(&[path.to_owned()])
    }

    /// Reads a capture from any input. `name` is used in errors. Blocks until the first bytes show the format.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the input cannot be read or is not a capture.
    pub fn from_read(
        name: impl Into<String>,
        input: impl Read + Send + 'static,
    ) -> Result<Self, CaptureError> {
        let name = name.into();
        let source = CaptureSource::detect_source(&name, input, McapState::new(false, None), None)?;
        Ok(Self::from_first_source(name.clone(), (name, source), VecDeque::new(), identity_wrapper(), false))
    }

    /// Opens one or more files as one capture. The parts of a recording may be given in any order; other files are read
    /// in the order of their first frames.
    ///
    /// # Errors
    /// Returns [`CaptureError`] as [`Reader::open`] does, and if several files are not one capture.
    pub fn open_all(paths: &[PathBuf]) -> Result<Self, CaptureError> {
        Self::open_parts(paths, identity_wrapper(), false)
    }

    /// Opens a capture like [`Reader::open_all`], with each file wrapped by `through`.
    ///
    /// # Errors
    /// Returns [`CaptureError`] as [`Reader::open_all`] does.
    pub fn open_wrapped(paths: &[PathBuf], through: FileWrapper) -> Result<Self, CaptureError> {
        Self::open_parts(paths, through, false)
    }

    /// Opens a capture of which messages of all topics are read. [`Reader::next_item`] returns them.
    ///
    /// # Errors
    /// Returns [`CaptureError`] as [`Reader::open_all`] does.
    pub fn open_with_all_topics(paths: &[PathBuf]) -> Result<Self, CaptureError> {
        Self::open_parts(paths, identity_wrapper(), true)
    }

    fn open_parts(paths: &[PathBuf], through: FileWrapper, others: bool) -> Result<Self, CaptureError> {
        if let [one] = paths
            && input::is_standard_input(one)
        {
            let name = "standard input".to_owned();
            let file = input::open(one).map_err(|source| CaptureError::Io { name: name.clone(), source })?;
            let source =
                CaptureSource::detect_source(&name, through(file), McapState::new(others, None), None)?;
            return Ok(Self::from_first_source(
                name.clone(),
                (name, source),
                VecDeque::new(),
                through,
                others,
            ));
        }
        let ordered = Self::order_paths(paths)?;
        let name = parts::title(&ordered);
        let mut rest = VecDeque::from(ordered);
        let first = rest.pop_front().ok_or(PartsError::None)?;
        let buses = Self::survey_bus_names([&first].into_iter().chain(&rest));
        let opened =
            CaptureSource::open(&first, &through, McapState::new(others, None).with_buses(buses.clone()))?;
        Ok(Self { buses, ..Self::from_first_source(name, opened, rest, through, others) })
    }

    /// Finds the bus names for frames of other programs in all files. They are empty if the names do not depend on
    /// later frames. Files that cannot be read are skipped, because they are reported when they are read.
    fn survey_bus_names<'a>(paths: impl Iterator<Item = &'a PathBuf> + Clone) -> ForeignBusNames {
        let recording = |path: &&PathBuf| {
            let mut file = input::can_be_read_again(path).then(|| File::open(path).ok()).flatten()?;
            is_mcap(&mut file).is_ok_and(|is| is).then_some(file)
        };
        let mut survey = TopicSurvey::default();
        for mut file in paths.clone().filter_map(|path| recording(&path)) {
            let _ = survey.add_file(&mut file);
        }
        if !survey.must_read_messages() {
            return ForeignBusNames::default();
        }
        let files = paths.filter_map(|path| recording(&path));
        files
            .fold(ForeignBusNames::default(), |known, file| survey.bus_names_of(Box::new(file), known))
            .renamed_with_all_pairs()
    }

    /// Returns the files of one capture in the order in which they are read.
    pub(super) fn order_paths(paths: &[PathBuf]) -> Result<Vec<PathBuf>, CaptureError> {
        if let [] | [_] = paths {
            return Ok(paths.to_vec());
        }
        let named = |path: &PathBuf| match input::is_standard_input(path) {
            true => Err(CaptureError::from(PartsError::StandardInput)),
            false => {
                let mut reader = Self::open(path)?;
                // The part number is stored before the first frame, so it is known after this call.
                let first = reader.first_time();
                Ok(CaptureFile::new(path, reader.extras(), reader.format(), first, reader.line_count()))
            }
        };
        Ok(parts::in_reading_order(paths.iter().map(named).collect::<Result<_, CaptureError>>()?)?)
    }

    /// Reads up to the first frame and returns its time, in ns since 1970. Returns `None` if the capture has no
    /// readable frame.
    fn first_time(&mut self) -> Option<u64> {
        loop {
            match self.next() {
                Ok(Some(CaptureEntry::Frame(record))) => return Some(record.time.nanos),
                Ok(Some(CaptureEntry::Note(_))) => {}
                Ok(None) | Err(_) => return None,
            }
        }
    }

    /// Reads up to the first frame. Returns true if the capture has one.
    ///
    /// # Errors
    /// Returns [`CaptureError`] as [`Reader::next`] does.
    pub fn has_frame(&mut self) -> Result<bool, CaptureError> {
        loop {
            match self.next()? {
                Some(CaptureEntry::Frame(_)) => return Ok(true),
                Some(CaptureEntry::Note(_)) => {}
                None => return Ok(false),
            }
        }
    }

    fn from_first_source(
        name: String,
        (file, source): (String, CaptureSource),
        rest: VecDeque<PathBuf>,
        through: FileWrapper,
        others: bool,
    ) -> Self {
        Self {
            name,
            file,
            source,
            all_topics: others,
            entries: 0,
            part: 0,
            remaining: rest,
            through,
            is_unfinished: false,
            buses: ForeignBusNames::default(),
            times: TimeChecks::default(),
            before: None,
            remarks: Vec::new(),
        }
    }

    /// Returns the name of the capture: that of its file, or those of its first and last file.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Opens the next file of the capture. Returns false after the last one.
    fn open_next_part(&mut self) -> Result<bool, CaptureError> {
        let Some(path) = self.remaining.pop_front() else { return Ok(false) };
        self.part += 1;
        self.before = Some(self.file.clone());
        self.remarks = self.log_remarks();
        let lines = self.line_count();
        let mut before = self.extras().clone();
        if let Some(what) = before.unfinished.as_mut().filter(|_| !self.is_unfinished) {
            *what = format!("{}: {what}", self.file);
            self.is_unfinished = true;
        }
        let state = McapState::new(self.all_topics, Some(before)).with_buses(self.buses.clone());
        let source;
        (self.file, source) = CaptureSource::open(&path, &self.through, state)?;
        self.source = match source {
            CaptureSource::Log(log) => CaptureSource::Log(log.with_line_count(lines)),
            mcap @ CaptureSource::Mcap(_) => mcap,
        };
        Ok(true)
    }

    /// Returns the position of the next entry. A reader can go back to it only if the input is seekable.
    #[must_use]
    pub const fn seek_point(&self) -> SeekPoint {
        let (offset, skip) = match &self.source {
            CaptureSource::Log(log) => {
                let (offset, line, clock) = (log.offset(), log.lines(), log.clock());
                return SeekPoint { part: self.part, offset, line, skip: 0, clock };
            }
            CaptureSource::Mcap(mcap) => mcap.resume_point(),
        };
        SeekPoint { part: self.part, offset, line: 0, skip, clock: Clock::NEW }
    }

    /// Continues at a position of the same capture. The entry at that position is read next.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the capture cannot be read or is damaged; reading ends then.
    pub fn seek(&mut self, places: &SeekIndex, place: SeekPoint) -> Result<(), CaptureError> {
        let Some(path) = places.path(place.part) else { return Ok(()) };
        if self.part != place.part || place.offset == 0 {
            let before = (place.part > 0).then(|| self.extras().clone());
            let state = McapState::new(self.all_topics, before).with_buses(self.buses.clone());
            (self.file, self.source) = CaptureSource::open(path, &self.through, state)?;
            self.part = place.part;
            self.remaining = places.paths_after(place.part).cloned().collect();
        }
        self.times = TimeChecks::default();
        let name = self.file.clone();
        let failed = |source| CaptureError::Io { name: name.clone(), source };
        if place.offset > 0 {
            let mut file = input::open(path).map_err(failed)?;
            let regular = file.try_clone().map_err(failed)?;
            file.seek(SeekFrom::Start(place.offset)).map_err(failed)?;
            let input = (self.through)(file);
            let empty = CaptureSource::Log(LogReader::new(&[], Box::new(io::empty())));
            self.source = match std::mem::replace(&mut self.source, empty) {
                CaptureSource::Log(_) => {
                    CaptureSource::Log(LogReader::resume((place.offset, place.line, place.clock), input))
                }
                CaptureSource::Mcap(mcap) => {
                    let mut state = mcap.into_state();
                    places
                        .apply_descriptions(place.part, &mut state)
                        .map_err(|fault| fault.into_capture_error(&name, self.entries))?;
                    CaptureSource::Mcap(Box::new(McapReader::resume(
                        place.offset,
                        input,
                        state,
                        Some(regular),
                    )))
                }
            };
        }
        let mut skip = place.skip;
        while skip > 0 {
            match self.next_item()? {
                Some(RecordingItem::Entry(_)) => skip -= 1,
                Some(RecordingItem::Other(_)) => {}
                None => break,
            }
        }
        Ok(())
    }

    /// Returns the format of the file that is being read.
    #[must_use]
    pub const fn format(&self) -> CaptureFormat {
        match self.source {
            CaptureSource::Log(_) => CaptureFormat::Candump,
            CaptureSource::Mcap(_) => CaptureFormat::Mcap,
        }
    }

    /// Returns the next entry in the order of the file, or `None` after the last entry. Never panics.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the capture cannot be read or is damaged; reading ends then.
    #[expect(
        clippy::should_implement_trait,
        reason = "an entry borrows from the reader; an iterator's cannot"
    )]
    pub fn next(&mut self) -> Result<Option<CaptureEntry<'_>>, CaptureError> {
        // Only a reader that was opened with all topics returns other messages.
        Ok(match self.next_item()? {
            Some(RecordingItem::Entry(entry)) => Some(entry),
            Some(RecordingItem::Other(_)) | None => None,
        })
    }

    /// Returns the next entry, in the order of the file, or `None` after the last one. Also returns messages of other
    /// topics if the reader was opened by [`Reader::open_with_all_topics`]. Never panics.
    ///
    /// # Errors
    /// Returns [`CaptureError`] if the capture cannot be read or is damaged; reading ends then.
    pub fn next_item(&mut self) -> Result<Option<RecordingItem<'_>>, CaptureError> {
        while !self.remaining.is_empty() && self.source.is_at_its_end(&self.file, self.entries)? {
            self.open_next_part()?;
        }
        let Self { file: name, source, entries, times, before, .. } = self;
        let next = match source {
            CaptureSource::Log(log) => {
                log.next().map(|next| next.map(RecordingItem::Entry)).map_err(ReadFault::from)
            }
            CaptureSource::Mcap(mcap) => mcap.next(),
        };
        let next = next.map_err(|fault| fault.into_capture_error(name, *entries))?;
        *entries += u64::from(matches!(next, Some(RecordingItem::Entry(_))));
        if let Some(RecordingItem::Entry(CaptureEntry::Frame(record))) = &next {
            if let Some(before) = before.take().filter(|_| record.time.nanos < times.latest_ns()) {
                times.record_overlap(name, &before);
            }
            times.check_frame_time(record.interface, record.time.nanos);
        }
        Ok(next)
    }

    /// Returns true if the capture is a log, or a recording that was converted from one. Other recordings hold more,
    /// such as the direction of each frame.
    #[must_use]
    pub fn is_from_log(&self) -> bool {
        let (key, value) = LOG_ORIGIN;
        self.format() == CaptureFormat::Candump
            || self.extras().metadata_value(ORIGIN_METADATA, key) == Some(value)
    }

    /// Returns the number of lines read so far from a log, which is the line number of the last entry. Returns 0 for an
    /// MCAP recording.
    #[must_use]
    pub const fn line_count(&self) -> u64 {
        match &self.source {
            CaptureSource::Log(log) => log.lines(),
            CaptureSource::Mcap(_) => 0,
        }
    }

    /// Returns remarks on the times, flags and buses of the frames read so far, one line each.
    #[must_use]
    pub fn remarks(&self) -> Vec<String> {
        self.times.backwards_remark().into_iter().chain(self.remarks_except_order()).collect()
    }

    /// Returns the remarks except the one on times that run backwards.
    #[must_use]
    pub fn remarks_except_order(&self) -> Vec<String> {
        let shared = match &self.source {
            CaptureSource::Mcap(mcap) => mcap.buses().is_frame_id_shared(),
            CaptureSource::Log(_) => false,
        };
        let shared = shared.then(|| {
            "several topics use the same frame_id: each topic is read as a bus of its own, named after the topic"
                .to_owned()
        });
        let of_log = self.log_remarks().into_iter().map(|remark| remark.to_string());
        of_log.chain(self.times.remarks()).chain(shared).collect()
    }

    fn log_remarks(&self) -> Vec<LogRemark> {
        let mut remarks = self.remarks.clone();
        if let CaptureSource::Log(log) = &self.source {
            remarks.extend(log.remarks().iter().filter(|remark| !self.remarks.contains(remark)));
        }
        remarks
    }

    /// Returns false if any line so far had no time.
    #[must_use]
    pub fn has_times(&self) -> bool {
        !self.log_remarks().contains(&LogRemark::NoTimes)
    }

    /// Returns the kind of a text that has no frames, judged by its first lines, and advice to the user.
    #[must_use]
    pub fn text_kind(&self) -> Option<(&'static str, &'static str)> {
        match &self.source {
            CaptureSource::Log(log) => detect_text_kind(log.first_lines_sample()),
            CaptureSource::Mcap(_) => None,
        }
    }

    /// Returns true if any channel so far holds frames of another program.
    #[must_use]
    pub fn has_foreign_frames(&self) -> bool {
        match &self.source {
            CaptureSource::Mcap(mcap) => mcap.has_foreign(),
            CaptureSource::Log(_) => false,
        }
    }

    /// Returns true if the next entry requires a read from the input, which may block. The caller flushes its output
    /// then, so that a live pipe is followed without delay.
    #[must_use]
    pub fn is_drained(&self) -> bool {
        match &self.source {
            CaptureSource::Log(log) => log.is_drained(),
            CaptureSource::Mcap(_) => false,
        }
    }

    /// Returns the attachments, metadata and other topics read so far. Those before the first frame are available from
    /// the beginning. A log has none.
    #[must_use]
    pub fn extras(&self) -> &RecordingExtras {
        match &self.source {
            CaptureSource::Log(_) => RecordingExtras::NONE,
            CaptureSource::Mcap(mcap) => mcap.extras(),
        }
    }
}

/// Returns a wrapper that leaves files as they are.
fn identity_wrapper() -> FileWrapper {
    Box::new(|file| Box::new(file))
}
