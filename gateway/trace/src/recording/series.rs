//! Writes a recording as a series of MCAP files. Each file can be read without the others. It is flushed regularly,
//! ends when it is large or old enough, and gets its final name when it is complete.
//!
//! After an error the file is closed, and it is repaired at the end of the recording. Another file is begun at once; if
//! that fails, it is tried again every few seconds. Messages that arrive meanwhile are counted as lost.

mod event;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::fs::statvfs;

use super::account::{MessageCount, WrittenFile};
use super::file::FileWriter;
use super::names::{self, PartFile};
use super::publish::{CompleteFile, PublishedFile, Publisher};
use super::recover::RecoverError;
use super::repair::{self, RepairResult};
use super::sink::{FileGauge, ReservedFile};
use super::window::ReorderWindow;
use crate::files::parent_folder;

pub use event::RecordingEvent;

/// The size of the write buffer in bytes. Chunks are larger and are written without it.
const WRITE_BUFFER_BYTES: usize = 64 << 10;
/// The interval between two attempts to begin a file after an error.
const RETRY_INTERVAL: Duration = Duration::from_secs(5);
/// The maximum time for which an incomplete packet delays the end of a file. The time is limited because any traffic
/// may look like a segment.
const MAX_PACKET_HOLD: Duration = Duration::from_millis(500);
/// The interval between two checks that a file still has its name.
const NAME_CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// The free space in bytes that a disk must have before recording continues after the disk was full.
const MIN_FREE_BYTES: u64 = 64 << 20;

/// The writer of one file of a recording.
pub type Writer = FileWriter<BufWriter<ReservedFile>>;

/// The limits of a file. When one is reached, the next file is begun.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct SplitLimits {
    /// The size of a file in bytes, without the attachments and metadata at its beginning.
    pub bytes: u64,
    /// The age of a file.
    pub age: Duration,
}

impl Default for SplitLimits {
    /// Returns 1 GiB and 10 minutes.
    fn default() -> Self {
        Self { bytes: 1 << 30, age: Duration::from_secs(600) }
    }
}

/// A file that is attached to the recording.
#[derive(Clone, Debug)]
pub struct AttachedFile {
    /// The name of the attachment.
    pub name: String,
    /// Its media type.
    pub media_type: &'static str,
    /// Its contents.
    pub bytes: Vec<u8>,
}

/// The metadata and attachments that each file of the recording begins with.
#[derive(Clone, Debug, Default)]
pub struct FileHead {
    /// The start of the recording, in ns since 1970.
    pub nanos: u64,
    /// Metadata records by name.
    pub metadata: Vec<(&'static str, BTreeMap<String, String>)>,
    /// Attachments.
    pub attachments: Vec<AttachedFile>,
}

impl FileHead {
    fn write(&self, writer: &mut Writer, number: u32) -> io::Result<()> {
        for (name, facts) in &self.metadata {
            writer.write_metadata(name, facts)?;
        }
        let place = [("number".to_owned(), number.to_string())];
        writer.write_metadata("part", &BTreeMap::from(place))?;
        for AttachedFile { name, media_type, bytes } in &self.attachments {
            writer.attach(name, media_type, self.nanos, bytes)?;
        }
        Ok(())
    }
}

/// The file that is being written.
#[derive(Debug)]
struct OpenFile<T> {
    writer: Writer,
    topics: T,
    part: PartFile,
    gauge: Arc<FileGauge>,
    /// The number of bytes in the file before its first message.
    head: u64,
    began: Instant,
    /// The time at which the name of the file was last checked.
    name_checked: Instant,
    /// The time at which the file became large or old enough to end; `None` before.
    due_since: Option<Instant>,
    /// The number of messages that were flushed to the file.
    kept: MessageCount,
    /// The number of messages written since the last flush.
    written: MessageCount,
}

impl<T> OpenFile<T> {
    /// Writes the waiting messages that have waited long enough, or all of them if `all` is true.
    fn write_waiting_to_file(&mut self, window: &mut ReorderWindow, all: bool) -> io::Result<()> {
        let Self { writer, written, .. } = self;
        written.add(if all { window.write_all(writer) } else { window.write_due(writer) }?);
        Ok(())
    }
}

/// A file that could not be written further. It stays locked until it is repaired.
#[derive(Debug)]
struct BrokenFile {
    part: PartFile,
    file: File,
    kept: MessageCount,
}

/// The files of a recording. `T` holds the channels of a file.
#[derive(Debug)]
pub struct SplitRecording<T> {
    path: PathBuf,
    force: bool,
    split: SplitLimits,
    head: FileHead,
    /// The time of the recorder, in ns since 1970.
    now: u64,
    /// The number of the open file, or of the last one if none is open.
    number: u32,
    /// The first file, which is created and locked but has no contents yet.
    claimed: Option<(PartFile, File)>,
    /// Files of an earlier recording of the same name, which are removed at the end.
    stale: Vec<PathBuf>,
    open: Option<OpenFile<T>>,
    /// Messages that wait for the open file. All files share the window, so that its buffers stay allocated.
    window: ReorderWindow,
    /// The time of the last error.
    failed: Option<Instant>,
    /// The time at which a file was last begun directly after an error, and true if another file is to be begun now.
    immediate_retry: (Option<Instant>, bool),
    broken: Vec<BrokenFile>,
    /// Renames complete files. Each has its message counts and its length in bytes.
    publisher: Publisher<(MessageCount, u64)>,
    written: Vec<WrittenFile>,
    lost: MessageCount,
    /// Events that have not been reported yet.
    said: Vec<RecordingEvent>,
}

impl<T> SplitRecording<T> {
    /// Creates and locks the first file, so that errors are reported before the recording begins.
    ///
    /// # Errors
    /// Returns an error if another program writes the file, or if it cannot be written.
    pub fn claim(path: &Path, force: bool, split: SplitLimits) -> io::Result<Self> {
        let stale = names::existing_files(path);
        if let Some(there) = stale.first().filter(|_| !force) {
            let why = format!("the file {} exists: name another file, or add --overwrite", there.display());
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, why));
        }
        Ok(Self {
            claimed: Some(PartFile::create(path.to_owned())?),
            stale,
            path: path.to_owned(),
            force,
            split,
            head: FileHead::default(),
            now: 0,
            number: 0,
            open: None,
            window: ReorderWindow::default(),
            failed: None,
            immediate_retry: (None, false),
            broken: Vec::new(),
            publisher: Publisher::new(force),
            written: Vec::new(),
            lost: MessageCount::default(),
            said: Vec::new(),
        })
    }

    /// Begins the first file with `head`. `topics` creates the channels of a file.
    pub fn begin_first_file(&mut self, head: FileHead, topics: impl FnOnce(&mut Writer) -> io::Result<T>) {
        (self.now, self.head) = (head.nanos, head);
        let Some((part, file)) = self.claimed.take() else { return };
        match self.start_file(part, file, topics) {
            Ok(open) => self.open = Some(open),
            Err(error) => self.handle_error(&error),
        }
    }

    /// Adds a metadata record to the open file and to all later ones.
    pub fn add_metadata(&mut self, name: &'static str, facts: BTreeMap<String, String>) {
        let written = self.open.as_mut().map_or(Ok(()), |open| open.writer.write_metadata(name, &facts));
        self.head.metadata.push((name, facts));
        if let Err(error) = written {
            self.close_broken_file(&error);
        }
    }

    fn start_file(
        &mut self,
        part: PartFile,
        file: File,
        topics: impl FnOnce(&mut Writer) -> io::Result<T>,
    ) -> io::Result<OpenFile<T>> {
        let begin = || {
            let about = file.metadata()?;
            let (sink, gauge) = ReservedFile::new(file, parent_folder(&part.path))?;
            let mut writer =
                Writer::with_file_identity(BufWriter::with_capacity(WRITE_BUFFER_BYTES, sink), &about)?;
            self.head.write(&mut writer, self.number)?;
            let topics = topics(&mut writer)?;
            writer.flush()?;
            if gauge.is_full() {
                return Err(rustix::io::Errno::NOSPC.into());
            }
            Ok((writer, topics, gauge))
        };
        // The file is still empty.
        let (writer, topics, gauge) = begin().inspect_err(|_: &io::Error| part.remove())?;
        self.window.begin(self.now);
        let (head, began) = (gauge.bytes(), Instant::now());
        let (kept, written) = (MessageCount::default(), MessageCount::default());
        Ok(OpenFile {
            writer,
            topics,
            part,
            gauge,
            head,
            began,
            name_checked: began,
            due_since: None,
            kept,
            written,
        })
    }

    /// Sets the time of the recorder, in ns since 1970.
    pub fn set_time(&mut self, now: u64) {
        self.now = now;
        let Some(OpenFile { writer, written, .. }) = &mut self.open else { return };
        match self.window.set_time(now, writer) {
            Ok(count) => written.add(count),
            Err(error) => self.close_broken_file(&error),
        }
    }

    /// Adds `count` messages to the open file by calling `write`. If no file is open, they are counted as lost.
    pub fn add_messages(&mut self, count: MessageCount, write: impl FnOnce(&mut ReorderWindow, &mut T)) {
        let Some(open) = &mut self.open else { return self.lost.add(count) };
        write(&mut self.window, &mut open.topics);
        if self.window.is_full() {
            self.write_waiting_messages(false);
        }
    }

    /// Writes all waiting messages to the open file. Messages that are added later stand after them.
    pub fn write_waiting(&mut self) {
        self.write_waiting_messages(true);
    }

    fn write_waiting_messages(&mut self, all: bool) {
        if let Some(Err(error)) =
            self.open.as_mut().map(|open| open.write_waiting_to_file(&mut self.window, all))
        {
            self.close_broken_file(&error);
        }
    }

    /// Writes the messages that have waited long enough. Ends a file whose disk is full, or one that is large or old
    /// enough, the latter only if `holds` is false. Returns true if the caller should begin another file with
    /// [`SplitRecording::begin_next`].
    pub fn flush_due_messages(&mut self, holds: bool) -> bool {
        self.collect_published();
        let Some(open) = &mut self.open else {
            let due = self.failed.is_some_and(|at| at.elapsed() >= RETRY_INTERVAL);
            let prompt = std::mem::replace(&mut self.immediate_retry.1, false);
            return (due || prompt) && has_room(&self.path);
        };
        if let Err(error) =
            open.write_waiting_to_file(&mut self.window, false).and_then(|()| open.writer.flush())
        {
            self.close_broken_file(&error);
            return false;
        }
        open.kept.add(std::mem::take(&mut open.written));
        if open.name_checked.elapsed() >= NAME_CHECK_INTERVAL {
            open.name_checked = Instant::now();
            if !open.part.has_temporary_name() {
                self.end_file();
                return true;
            }
        }
        open.gauge.extend_reserve(open.writer.chunks());
        if open.gauge.is_full() {
            self.end_file();
            self.handle_error(&rustix::io::Errno::NOSPC.into());
            return false;
        }
        let enough =
            open.gauge.bytes() >= self.split.bytes + open.head || open.began.elapsed() >= self.split.age;
        let since = enough.then(|| *open.due_since.get_or_insert_with(Instant::now));
        let enough = since.is_some_and(|since| !holds || since.elapsed() >= MAX_PACKET_HOLD);
        if enough {
            self.end_file();
        }
        enough
    }

    /// Begins another file. `topics` creates its channels. Returns true on success.
    pub fn begin_next(&mut self, topics: impl FnOnce(&mut Writer) -> io::Result<T>) -> bool {
        let number = self.number + 1;
        let goal = names::numbered_path(&self.path, number);
        let failed_before = self.failed;
        let before = std::mem::replace(&mut self.number, number);
        match PartFile::create(goal).and_then(|(part, file)| self.start_file(part, file, topics)) {
            Ok(open) => {
                if failed_before.is_some() {
                    let goal = open.part.goal.display();
                    self.said.push(RecordingEvent::Other(format!("recording continues in {goal}")));
                }
                (self.failed, self.open) = (None, Some(open));
                true
            }
            Err(error) => {
                self.handle_error(&error);
                self.number = before;
                false
            }
        }
    }

    /// Returns true if a file is open.
    #[must_use]
    pub const fn is_open(&self) -> bool {
        self.open.is_some()
    }

    /// Returns the number of messages that could not be written.
    #[must_use]
    pub const fn lost_messages(&self) -> MessageCount {
        self.lost
    }

    /// Returns the number of messages that arrived after messages of later times had been written.
    #[must_use]
    pub const fn late_messages(&self) -> u64 {
        self.window.late_messages()
    }

    /// Returns the size of the open file in bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.open.as_ref().map_or(0, |open| open.gauge.bytes())
    }

    /// Returns the events since the last call, and removes them.
    pub fn drain_events(&mut self) -> std::vec::Drain<'_, RecordingEvent> {
        self.said.drain(..)
    }

    /// Ends the open file, and passes it on to be renamed.
    fn end_file(&mut self) {
        let Some(mut open) = self.open.take() else { return };
        if let Err(error) =
            open.write_waiting_to_file(&mut self.window, true).and_then(|()| open.writer.finish())
        {
            self.open = Some(open);
            return self.close_broken_file(&error);
        }
        open.kept.add(open.written);
        let (sink, _) = open.writer.into_inner().into_parts();
        let about = (open.kept, open.gauge.bytes());
        self.publisher.publish(CompleteFile { file: sink.into_file(), part: open.part, about });
    }

    /// Adds the files that were renamed since the last call to those of the recording.
    fn collect_published(&mut self) {
        for PublishedFile { path, about: (kept, bytes), error } in self.publisher.drain_published() {
            self.said.extend(error.map(RecordingEvent::Other));
            match path {
                Some(path) => self.written.push(kept.into_written_file(&path, bytes)),
                // The file is complete, but its name is unknown.
                None => self.lost.add(kept),
            }
        }
    }

    /// Closes the open file after an error.
    fn close_broken_file(&mut self, error: &io::Error) {
        let Some(open) = self.open.take() else { return };
        self.lost.add(open.written);
        self.lost.add(self.window.waiting_count());
        // The buffer holds an incomplete record, which is dropped. The file stays locked until it is repaired.
        let (sink, _) = open.writer.into_inner().into_parts();
        self.broken.push(BrokenFile { part: open.part, file: sink.into_file(), kept: open.kept });
        self.handle_error(error);
    }

    /// Handles an error. Requests another file at once, unless that was done a moment ago: the error then persists.
    fn handle_error(&mut self, error: &io::Error) {
        let (last, prompt) = &mut self.immediate_retry;
        if last.is_none_or(|at| at.elapsed() >= RETRY_INTERVAL) {
            (*last, *prompt) = (Some(Instant::now()), true);
        }
        if self.failed.replace(Instant::now()).is_none() {
            let path = names::numbered_path(&self.path, self.number);
            self.said.push(RecordingEvent::BrokeOff(format!("{}: {error}", path.display())));
        }
    }

    /// Removes the open file, which is not wanted.
    pub fn discard(&mut self) {
        if let Some(open) = self.open.take() {
            // If this fails, the next run repairs the file.
            open.part.remove();
        }
    }

    /// Ends the recording. Returns its files, and the number of lost messages.
    pub fn finish(&mut self) -> (Vec<WrittenFile>, MessageCount) {
        self.end_file();
        self.publisher.finish();
        self.collect_published();
        for BrokenFile { part, file, kept } in std::mem::take(&mut self.broken) {
            let from = part.open().map_err(RecoverError::Read);
            let goal = || part.goal.clone();
            match from.and_then(|from| repair::repair(&part.path, &from, goal, self.force)) {
                Ok(RepairResult { recovered, new: Some((goal, bytes)), .. }) => {
                    // The number of messages on the disk may differ from the counted one, so the recovered ones decide.
                    self.lost.frames = (self.lost.frames + kept.frames).saturating_sub(recovered.frames);
                    let others = recovered.messages - recovered.frames;
                    self.lost.others = (self.lost.others + kept.others).saturating_sub(others);
                    self.written.push(
                        MessageCount { frames: recovered.frames, others }.into_written_file(&goal, bytes),
                    );
                }
                Ok(RepairResult { new: None, .. }) => self.lost.add(kept),
                Err(error) => {
                    self.said.push(RecordingEvent::Other(repair::unrepaired_message(&part, &error)));
                    let bytes = file.metadata().map_or(0, |about| about.len());
                    self.written.push(kept.into_written_file(&part.path, bytes));
                }
            }
        }
        // An earlier recording with more files would seem to continue this one.
        for stale in std::mem::take(&mut self.stale) {
            if !self.written.iter().any(|written| Path::new(&written.path) == stale) {
                // The file was to be overwritten. An error of removing it does no harm.
                let _ = std::fs::remove_file(stale);
            }
        }
        (std::mem::take(&mut self.written), self.lost)
    }
}

impl<T> Drop for SplitRecording<T> {
    fn drop(&mut self) {
        if let Some((part, _)) = &self.claimed {
            // The file is still empty.
            part.remove();
        }
    }
}

fn has_room(path: &Path) -> bool {
    statvfs(parent_folder(path))
        .is_ok_and(|about| about.f_bavail.saturating_mul(about.f_frsize) >= MIN_FREE_BYTES)
}
