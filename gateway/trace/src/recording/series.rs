//! A recording's MCAP files, one after the other: each is begun with what makes it readable by itself, flushed,
//! ended when it is large or old enough, and given its name when it is whole.
//!
//! After an error the file takes nothing more. It is kept, repaired at the end, and another one is tried at once, then every
//! few seconds; what comes meanwhile is counted.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::fs::statvfs;

use super::account::{Count, Written};
use super::file::FileWriter;
use super::names::{self, Part};
use super::publish::{Ended, Published, Publisher};
use super::recover::RecoverError;
use super::repair::{self, Repaired};
use super::sink::{Gauge, Sink};
use super::window::Window;
use crate::files::folder_of;

/// Bytes that go to the file together; a chunk is larger and goes by itself.
const BUFFER: usize = 64 << 10;
/// Between two attempts behind an error.
const RETRY: Duration = Duration::from_secs(5);
/// A file that is to end waits so long at most for what holds it: any traffic may look like a segment.
const HOLD: Duration = Duration::from_millis(500);
/// Between two looks whether a file still has its name.
const LOOK: Duration = Duration::from_secs(1);
/// Room on a disk that was full before it is tried again.
const ROOM: u64 = 64 << 20;

/// The writer of a file.
pub type Writer = FileWriter<BufWriter<Sink>>;

/// When another file is begun.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Split {
    /// When this one has so many bytes beside what each file begins with.
    pub bytes: u64,
    /// When it is so old.
    pub age: Duration,
}

impl Default for Split {
    /// 1 GiB, or 10 minutes.
    fn default() -> Self {
        Self { bytes: 1 << 30, age: Duration::from_secs(600) }
    }
}

/// A file in the file.
#[derive(Clone, Debug)]
pub struct Attached {
    /// Its name there.
    pub name: String,
    /// What it is.
    pub media_type: &'static str,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

/// What each file begins with.
#[derive(Clone, Debug, Default)]
pub struct Head {
    /// When the recording began, in ns since 1970.
    pub nanos: u64,
    /// Facts by name.
    pub metadata: Vec<(&'static str, BTreeMap<String, String>)>,
    /// Files.
    pub attachments: Vec<Attached>,
}

impl Head {
    fn write(&self, writer: &mut Writer, number: u32) -> io::Result<()> {
        for (name, facts) in &self.metadata {
            writer.metadata(name, facts)?;
        }
        let place = [("number".to_owned(), number.to_string())];
        writer.metadata("part", &BTreeMap::from(place))?;
        for Attached { name, media_type, bytes } in &self.attachments {
            writer.attach(name, media_type, self.nanos, bytes)?;
        }
        Ok(())
    }
}

/// An event to be reported.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum Said {
    /// A file takes nothing more; the run goes on.
    BrokeOff(String),
    /// Anything else.
    Else(String),
}

impl Said {
    /// What happened, for the end of the run.
    #[must_use]
    pub fn what(&self) -> &str {
        match self {
            Self::BrokeOff(what) | Self::Else(what) => what,
        }
    }
}

impl core::fmt::Display for Said {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let more = match self {
            Self::BrokeOff(_) => {
                ": the run goes on without it; what was recorded so far stays readable, what comes now is counted"
            }
            Self::Else(_) => "",
        };
        write!(f, "{}{more}", self.what())
    }
}

/// A file that is being written.
#[derive(Debug)]
struct Open<T> {
    writer: Writer,
    topics: T,
    part: Part,
    gauge: Arc<Gauge>,
    /// Bytes before the first message.
    head: u64,
    began: Instant,
    /// When it was looked at whether it still has its name.
    looked: Instant,
    /// Since when it is large or old enough.
    enough: Option<Instant>,
    /// In the file, flushed.
    kept: Count,
    /// Written since.
    written: Count,
}

impl<T> Open<T> {
    /// Writes what has waited long enough, or all that waits.
    fn release(&mut self, window: &mut Window, all: bool) -> io::Result<()> {
        let Self { writer, written, .. } = self;
        written.add(if all { window.release_all(writer) } else { window.release(writer) }?);
        Ok(())
    }
}

/// A file that broke off, held until it is repaired.
#[derive(Debug)]
struct Broken {
    part: Part,
    file: File,
    kept: Count,
}

/// The files of a recording; `T` is what a file's channels are kept in.
#[derive(Debug)]
pub struct Series<T> {
    path: PathBuf,
    force: bool,
    split: Split,
    head: Head,
    /// The recorder's time.
    now: u64,
    /// The number of the file that is open, or was last.
    number: u32,
    /// Claimed, and not begun.
    claimed: Option<(Part, File)>,
    /// Files of an earlier recording whose places this one takes.
    stale: Vec<PathBuf>,
    open: Option<Open<T>>,
    /// What waits for the file that is open: one for all of them, whose buffers stay.
    window: Window,
    /// When the last error was.
    failed: Option<Instant>,
    /// When a file was begun at once behind an error, which is to be done next.
    prompt: (Option<Instant>, bool),
    broken: Vec<Broken>,
    /// Ends files that are whole, each with what is in it and its bytes.
    publisher: Publisher<(Count, u64)>,
    written: Vec<Written>,
    lost: Count,
    /// What people should know.
    said: Vec<Said>,
}

impl<T> Series<T> {
    /// Claims the first file, so that what makes that impossible is known before there is anything to write.
    ///
    /// # Errors
    /// When somebody else has it, or it cannot be written.
    pub fn claim(path: &Path, force: bool, split: Split) -> io::Result<Self> {
        let stale = names::series(path);
        if let Some(there) = stale.first().filter(|_| !force) {
            let why =
                format!("{} exists: name another file, or overwrite it with --overwrite", there.display());
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, why));
        }
        Ok(Self {
            claimed: Some(Part::create(path.to_owned())?),
            stale,
            path: path.to_owned(),
            force,
            split,
            head: Head::default(),
            now: 0,
            number: 0,
            open: None,
            window: Window::default(),
            failed: None,
            prompt: (None, false),
            broken: Vec::new(),
            publisher: Publisher::new(force),
            written: Vec::new(),
            lost: Count::default(),
            said: Vec::new(),
        })
    }

    /// Begins the first file.
    pub fn begin(&mut self, head: Head, topics: impl FnOnce(&mut Writer) -> io::Result<T>) {
        (self.now, self.head) = (head.nanos, head);
        let Some((part, file)) = self.claimed.take() else { return };
        match self.start(part, file, topics) {
            Ok(open) => self.open = Some(open),
            Err(error) => self.fail(&error),
        }
    }

    /// Adds facts that are known only now, to the file that is open and to each that follows.
    pub fn add(&mut self, name: &'static str, facts: BTreeMap<String, String>) {
        let written = self.open.as_mut().map_or(Ok(()), |open| open.writer.metadata(name, &facts));
        self.head.metadata.push((name, facts));
        if let Err(error) = written {
            self.break_off(&error);
        }
    }

    fn start(
        &mut self,
        part: Part,
        file: File,
        topics: impl FnOnce(&mut Writer) -> io::Result<T>,
    ) -> io::Result<Open<T>> {
        let begin = || {
            let about = file.metadata()?;
            let (sink, gauge) = Sink::new(file, folder_of(&part.path))?;
            let mut writer = Writer::in_file(BufWriter::with_capacity(BUFFER, sink), &about)?;
            self.head.write(&mut writer, self.number)?;
            let topics = topics(&mut writer)?;
            writer.flush()?;
            if gauge.is_full() {
                return Err(rustix::io::Errno::NOSPC.into());
            }
            Ok((writer, topics, gauge))
        };
        // There is nothing in it.
        let (writer, topics, gauge) = begin().inspect_err(|_: &io::Error| part.remove())?;
        self.window.begin(self.now);
        let (head, began) = (gauge.bytes(), Instant::now());
        let (kept, written) = (Count::default(), Count::default());
        Ok(Open { writer, topics, part, gauge, head, began, looked: began, enough: None, kept, written })
    }

    /// Tells the recorder's time, in ns since 1970, by which messages are put in order.
    pub fn look(&mut self, now: u64) {
        self.now = now;
        let Some(Open { writer, written, .. }) = &mut self.open else { return };
        match self.window.look(now, writer) {
            Ok(count) => written.add(count),
            Err(error) => self.break_off(&error),
        }
    }

    /// Takes messages for the file that is open; without one they are counted.
    pub fn put(&mut self, count: Count, write: impl FnOnce(&mut Window, &mut T)) {
        let Some(open) = &mut self.open else { return self.lost.add(count) };
        write(&mut self.window, &mut open.topics);
        if self.window.is_full() {
            self.release(false);
        }
    }

    /// Writes what waits in the file that is open: what comes then stands behind it.
    pub fn settle(&mut self) {
        self.release(true);
    }

    fn release(&mut self, all: bool) {
        if let Some(Err(error)) = self.open.as_mut().map(|open| open.release(&mut self.window, all)) {
            self.break_off(&error);
        }
    }

    /// Hands on what has waited long enough; ends a file that is large or old enough, as soon as nothing `holds` it, or
    /// whose disk is full. Whether another file should be begun with [`Series::next`].
    pub fn flush(&mut self, holds: bool) -> bool {
        self.take_published();
        let Some(open) = &mut self.open else {
            let due = self.failed.is_some_and(|at| at.elapsed() >= RETRY);
            let prompt = std::mem::replace(&mut self.prompt.1, false);
            return (due || prompt) && has_room(&self.path);
        };
        if let Err(error) = open.release(&mut self.window, false).and_then(|()| open.writer.flush()) {
            self.break_off(&error);
            return false;
        }
        open.kept.add(std::mem::take(&mut open.written));
        if open.looked.elapsed() >= LOOK {
            open.looked = Instant::now();
            if !open.part.is_there() {
                self.end();
                return true;
            }
        }
        open.gauge.reserve_for(open.writer.chunks());
        if open.gauge.is_full() {
            self.end();
            self.fail(&rustix::io::Errno::NOSPC.into());
            return false;
        }
        let enough =
            open.gauge.bytes() >= self.split.bytes + open.head || open.began.elapsed() >= self.split.age;
        let since = enough.then(|| *open.enough.get_or_insert_with(Instant::now));
        let enough = since.is_some_and(|since| !holds || since.elapsed() >= HOLD);
        if enough {
            self.end();
        }
        enough
    }

    /// Begins another file; whether that was possible.
    pub fn next(&mut self, topics: impl FnOnce(&mut Writer) -> io::Result<T>) -> bool {
        let number = self.number + 1;
        let goal = names::numbered(&self.path, number);
        let failed_before = self.failed;
        let before = std::mem::replace(&mut self.number, number);
        match Part::create(goal).and_then(|(part, file)| self.start(part, file, topics)) {
            Ok(open) => {
                if failed_before.is_some() {
                    let goal = open.part.goal.display();
                    self.said.push(Said::Else(format!("recording goes on in {goal}")));
                }
                (self.failed, self.open) = (None, Some(open));
                true
            }
            Err(error) => {
                self.fail(&error);
                self.number = before;
                false
            }
        }
    }

    /// Whether something is being written.
    #[must_use]
    pub const fn is_open(&self) -> bool {
        self.open.is_some()
    }

    /// Frames and others that were not written.
    #[must_use]
    pub const fn lost(&self) -> Count {
        self.lost
    }

    /// Messages that came when their file was past their time.
    #[must_use]
    pub const fn late(&self) -> u64 {
        self.window.late()
    }

    /// Bytes of the file that is open.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.open.as_ref().map_or(0, |open| open.gauge.bytes())
    }

    /// What people should know since they were told last.
    pub fn said(&mut self) -> std::vec::Drain<'_, Said> {
        self.said.drain(..)
    }

    /// Ends the file and gives it its name.
    fn end(&mut self) {
        let Some(mut open) = self.open.take() else { return };
        if let Err(error) = open.release(&mut self.window, true).and_then(|()| open.writer.finish()) {
            self.open = Some(open);
            return self.break_off(&error);
        }
        open.kept.add(open.written);
        let (sink, _) = open.writer.into_inner().into_parts();
        let about = (open.kept, open.gauge.bytes());
        self.publisher.publish(Ended { file: sink.into_file(), part: open.part, about });
    }

    /// Notes the files that have their names by now.
    fn take_published(&mut self) {
        for Published { path, about: (kept, bytes), error } in self.publisher.done() {
            self.said.extend(error.map(Said::Else));
            match path {
                Some(path) => self.written.push(kept.in_file(&path, bytes)),
                // Wherever it is, it is whole; but nobody is told where.
                None => self.lost.add(kept),
            }
        }
    }

    /// The file takes nothing more.
    fn break_off(&mut self, error: &io::Error) {
        let Some(open) = self.open.take() else { return };
        self.lost.add(open.written);
        self.lost.add(self.window.count());
        // What is buffered is a part of something; the file stays held until it is repaired.
        let (sink, _) = open.writer.into_inner().into_parts();
        self.broken.push(Broken { part: open.part, file: sink.into_file(), kept: open.kept });
        self.fail(error);
    }

    /// Another file is begun at once, unless that was done just now: then it is not a single error.
    fn fail(&mut self, error: &io::Error) {
        let (last, prompt) = &mut self.prompt;
        if last.is_none_or(|at| at.elapsed() >= RETRY) {
            (*last, *prompt) = (Some(Instant::now()), true);
        }
        if self.failed.replace(Instant::now()).is_none() {
            let path = names::numbered(&self.path, self.number);
            self.said.push(Said::BrokeOff(format!("{}: {error}", path.display())));
        }
    }

    /// Takes the file that is open away.
    pub fn discard(&mut self) {
        if let Some(open) = self.open.take() {
            // What remains is an orphan, which the next run repairs.
            open.part.remove();
        }
    }

    /// Ends the recording: its files, and what was lost.
    pub fn finish(&mut self) -> (Vec<Written>, Count) {
        self.end();
        self.publisher.finish();
        self.take_published();
        for Broken { part, file, kept } in std::mem::take(&mut self.broken) {
            let from = part.open().map_err(RecoverError::Read);
            let goal = || part.goal.clone();
            match from.and_then(|from| repair::repair(&part.path, &from, goal, self.force)) {
                Ok(Repaired { recovered, new: Some((goal, bytes)), .. }) => {
                    // More may have come to the disk than is known of, or less.
                    self.lost.frames = (self.lost.frames + kept.frames).saturating_sub(recovered.frames);
                    let others = recovered.messages - recovered.frames;
                    self.lost.others = (self.lost.others + kept.others).saturating_sub(others);
                    self.written.push(Count { frames: recovered.frames, others }.in_file(&goal, bytes));
                }
                Ok(Repaired { new: None, .. }) => self.lost.add(kept),
                Err(error) => {
                    self.said.push(Said::Else(repair::unrepaired(&part, &error)));
                    let bytes = file.metadata().map_or(0, |about| about.len());
                    self.written.push(kept.in_file(&part.path, bytes));
                }
            }
        }
        // One that is longer than this one would seem to go on with the other's files.
        for stale in std::mem::take(&mut self.stale) {
            if !self.written.iter().any(|written| Path::new(&written.path) == stale) {
                // It was to be overwritten; that it is still there harms nobody.
                let _ = std::fs::remove_file(stale);
            }
        }
        (std::mem::take(&mut self.written), self.lost)
    }
}

impl<T> Drop for Series<T> {
    fn drop(&mut self) {
        if let Some((part, _)) = &self.claimed {
            // There is nothing in it.
            part.remove();
        }
    }
}

fn has_room(path: &Path) -> bool {
    statvfs(folder_of(path)).is_ok_and(|about| about.f_bavail.saturating_mul(about.f_frsize) >= ROOM)
}
