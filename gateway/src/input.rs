//! Inputs of commands, whose reading a signal can stop.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::Duration;

use bench::bus::follow::{FollowStep, Follower, NeverReopenedBus};
use bench::bus::listen;
use bench::signals::catch_signals;
use protocol::bus::{Bus, BusError, BusOptions, KindChoice, KindChoices, ReceivedFrame};
use protocol::can::{self, EXTENDED_MASK};
use protocol::input::{can_be_read_again, is_standard_input};
use protocol::skin::{Cell, Skin};
use protocol::stop;
use protocol::usage::Failure;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use signal_hook::consts::{SIGINT, SIGTERM};
use trace::capture::{
    CaptureError, CaptureFormat, CaptureNote, NoteKind, ORIGIN_METADATA, Reader, SKIN_OR_SCENARIO,
};

use super::output;
use super::print::{abbreviate_names, count_with_noun};

/// Interval between attempts to open an awaited bus.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// Maximum time until a signal takes effect while no frame arrives.
pub(crate) const POLL_TIMEOUT: Duration = Duration::from_millis(200);

/// Catches SIGINT and SIGTERM, and returns the flag that they set.
pub(crate) fn stop_flag() -> Result<Arc<AtomicBool>, Failure> {
    catch_signals(&[SIGINT, SIGTERM]).map_err(Failure::run_error)
}

/// Sets the stop flag when standard input ends.
pub(crate) fn stop_after_input() -> io::Result<()> {
    let wait = || {
        // An input that cannot be read has ended, too.
        let _ = io::copy(&mut io::stdin(), &mut io::sink());
        stop::stop_flag().store(true, Ordering::Relaxed);
    };
    thread::Builder::new().name("end of input".to_owned()).spawn(wait).map(drop)
}

/// Returns true for the name of a capture, false for that of a bus.
pub(crate) fn is_file(source: &Path) -> bool {
    is_standard_input(source) || source.exists()
}

/// Returns true if the name looks like a file's: it has a directory or an extension, which buses never have.
pub(crate) fn is_path(name: &Path) -> bool {
    name.components().count() > 1 || name.extension().is_some()
}

/// Returns the error for a source that is neither a file nor a bus that can be opened.
pub(crate) fn no_such_source_failure(name: &str, error: &BusError) -> Failure {
    let is_absent = matches!(
        error,
        BusError::Name(_)
            | BusError::NotServed { .. }
            | BusError::Absent { .. }
            | BusError::NoInterface(_)
            | BusError::NoSocketCan(_)
    );
    if is_path(Path::new(name)) && is_absent {
        return Failure::usage_error(format!("there is no file and no bus named {name}: correct the path"));
    }
    Failure::usage_error(format!("there is no file {name}, and opening it as a bus failed: {error}"))
}

/// Returns the named skin, or else that of a recording. Prints a note if the named skin differs from the recording's.
pub(crate) fn named_or_recorded_skin(files: &[PathBuf], named: Option<&Path>) -> Result<Skin, Failure> {
    let Some(path) = named else { return skin_of_recording(files) };
    let skin = Skin::read(path).map_err(Failure::usage_error)?;
    note_skin_difference(files, path, &skin);
    Ok(skin)
}

/// Prints a note if a skin differs from the one at the beginning of a recording.
pub(crate) fn note_skin_difference(files: &[PathBuf], path: &Path, skin: &Skin) {
    if !files.iter().all(|file| can_be_read_again(file)) {
        return;
    }
    let Ok(reader) = Reader::open_all(files) else { return };
    let Some(Ok(own)) = reader.extras().skin() else { return };
    if let Some((what, is, was)) = first_skin_difference(skin, &own) {
        let (path, name) = (path.display(), reader.name());
        output::print_note(format_args!(
            "--skin {path} differs from the skin recorded in {name} ({what}: {is}, recorded: {was})"
        ));
    }
}

/// Returns the first difference between two skins: its name, and the value in each skin.
pub(crate) fn first_skin_difference(one: &Skin, other: &Skin) -> Option<(String, String, String)> {
    let buses = |skin: &Skin| skin.buses.iter().map(|bus| bus.name.clone()).collect::<Vec<_>>().join(", ");
    let joints = |skin: &Skin| skin.robot.joints.len().to_string();
    let cells = |skin: &Skin| skin.cells.len().to_string();
    let all = [
        ("joints", joints(one), joints(other)),
        ("cells", cells(one), cells(other)),
        ("buses", buses(one), buses(other)),
    ];
    if let Some((what, is, was)) = all.into_iter().find(|(_, is, was)| is != was) {
        return Some((what.to_owned(), is, was));
    }
    let changed = one.cells.iter().find(|cell| {
        let same = |it: &&Cell| it.bus == cell.bus && it.node == cell.node;
        let before = other.cells.iter().find(same);
        before.is_none_or(|before| other.parameters(before) != one.parameters(cell))
    })?;
    let bus = one.buses.get(changed.bus).map_or("", |bus| &bus.name);
    Some((
        format!("parameters of cell {} on {bus}", changed.node),
        "as described".to_owned(),
        "different".to_owned(),
    ))
}

/// Reads the skin from a file, which is either a skin or a recording with a skin attached.
pub(crate) fn read_skin_or_recording(file: &Path) -> Result<Skin, Failure> {
    // If the file is neither, the error is that of reading it as a skin.
    let is_recording =
        can_be_read_again(file) && Reader::open(file).is_ok_and(|it| it.format() == CaptureFormat::Mcap);
    if !is_recording {
        return read_skin(file);
    }
    attached_skin(&[file.to_owned()], "name a skin file", || Ok(()))
}

/// Reads a skin file. If the file is a capture, the error says so, as far as that can be recognised.
pub(crate) fn read_skin(file: &Path) -> Result<Skin, Failure> {
    Skin::read(file).map_err(|error| capture_error(file).unwrap_or_else(|| Failure::usage_error(error)))
}

/// Returns the error for a file that is a capture or other text instead of a skin, by its name or content, or `None`
/// for a skin.
fn capture_error(file: &Path) -> Option<Failure> {
    if file.extension().is_some_and(|end| end == "toml") || !can_be_read_again(file) {
        return None;
    }
    let mut reader = match Reader::open(file) {
        Err(error @ CaptureError::OtherFormat { .. }) => return Some(Failure::usage_error(error)),
        opened => opened.ok()?,
    };
    let name = file.display();
    Some(match reader.has_frame().ok()? {
        true => Failure::usage_error(format!(
            "{name} is a capture ({}), but this command needs a skin: name a skin file",
            format_name(&reader)
        )),
        false if reader.text_kind().is_some_and(|(kind, _)| kind == SKIN_OR_SCENARIO) => return None,
        false => no_frame_failure(&reader),
    })
}

/// Returns the skin attached to a recording.
pub(crate) fn skin_of_recording(files: &[PathBuf]) -> Result<Skin, Failure> {
    if files.iter().any(|file| is_standard_input(file)) {
        return Err(Failure::usage_error("standard input can be read only once: name the skin with --skin"));
    }
    if let Some(pipe) =
        files.iter().find(|file| file.metadata().is_ok_and(|it| !it.is_file() && !it.is_dir()))
    {
        return Err(Failure::usage_error(format!(
            "{} is not a regular file and can be read only once: name the skin with --skin",
            pipe.display()
        )));
    }
    attached_skin(files, "name one with --skin", || require_frames(files))
}

/// Returns the skin attached to a recording. For a recording without one, `check` runs first and may return another
/// error; `hint` is part of the error.
fn attached_skin(
    files: &[PathBuf],
    hint: &str,
    check: impl Fn() -> Result<(), Failure>,
) -> Result<Skin, Failure> {
    let mut reader = Reader::open_all(files).map_err(Failure::usage_error)?;
    // The attached skin may come after the frames, so read until it is found.
    while reader.format() == CaptureFormat::Mcap
        && reader.extras().skin().is_none()
        && reader.next().map_err(Failure::run_error)?.is_some()
    {}
    let name = reader.name();
    match reader.extras().skin() {
        Some(skin) => skin.map_err(|error| Failure::usage_error(format!("{name}, {error}"))),
        None => {
            check()?;
            Err(match &reader.extras().unfinished {
                Some(why) => Failure::run_error(format!("{name} contains no skin, and {why}: {hint}")),
                None => Failure::usage_error(format!("{name} contains no skin: {hint}")),
            })
        }
    }
}

/// Returns an error for a capture without frames, because naming a skin would not help.
pub(crate) fn require_frames(files: &[PathBuf]) -> Result<(), Failure> {
    let mut reader = Reader::open_all(files).map_err(Failure::usage_error)?;
    if reader.has_frame().map_err(Failure::run_error)? { Ok(()) } else { Err(no_frame_failure(&reader)) }
}

/// Returns the skin that a reader has found so far. If the skin is unreadable, prints a note that says what is used
/// `instead`.
pub(crate) fn skin_found_so_far(reader: &Reader, instead: &str) -> Option<Skin> {
    let name = reader.name();
    let skin = reader.extras().skin()?;
    skin.inspect_err(|error| output::print_note(format_args!("{name}, {error}; {instead}"))).ok()
}

/// Returns the name of a capture's format.
pub(crate) fn format_name(reader: &Reader) -> &'static str {
    match reader.format() {
        CaptureFormat::Candump => "candump log",
        CaptureFormat::Mcap => "MCAP",
    }
}

/// Returns the location of an entry as text: the capture, and the line if the capture has lines.
pub(crate) fn location(name: &str, line: u64) -> String {
    if line > 0 { format!("{name}:{line}") } else { name.to_owned() }
}

/// Returns the error for a capture without frames.
pub(crate) fn no_frame_failure(reader: &Reader) -> Failure {
    let name = reader.name();
    if let Some((what, hint)) = reader.text_kind() {
        return Failure::usage_error(format!(
            "{name} is {what}, not a candump log or MCAP recording: {hint}"
        ));
    }
    let what = match (reader.format(), reader.line_count()) {
        (CaptureFormat::Candump, 0) => "the file is empty".to_owned(),
        (CaptureFormat::Candump, lines) => format!(
            "no frame in {}; expected the output of candump, with lines like `(1700000000.123456) vcan0 \
             123#00` or `vcan0  123   [1]  00`",
            count_with_noun(lines, "line")
        ),
        (CaptureFormat::Mcap, _) => match describe_other_contents(reader) {
            others if others.is_empty() => "it contains no CAN frames".to_owned(),
            others => format!("it contains no CAN frames, only {others}"),
        },
    };
    Failure::run_error(format!("{name}: {what}"))
}

/// Describes the contents of a recording other than frames and notes.
pub(crate) fn describe_other_contents(reader: &Reader) -> String {
    let extras = reader.extras();
    let topics = extras.topics.iter().filter(|topic| topic.messages > 0);
    let topics = topics.map(|topic| format!("{} ({} messages)", topic.name, topic.messages));
    let attached = extras.attachments.iter().map(|(name, _)| format!("attachment {name}"));
    let facts = extras.metadata.iter().filter(|(name, _)| name != ORIGIN_METADATA);
    let facts = facts.map(|(name, _)| format!("metadata {name}"));
    abbreviate_names(&topics.chain(attached).chain(facts).collect::<Vec<_>>())
}

/// Numbers of the items of a capture that were unreadable, lost or not supported.
#[derive(Debug, Default)]
pub(crate) struct LossCounts {
    /// Number of unreadable lines.
    pub(crate) lines: u64,
    /// Number of unreadable messages.
    pub(crate) messages: u64,
    /// Number of frames that the recorder lost.
    pub(crate) frames: u64,
    /// Number of CAN XL frames.
    pub(crate) can_xl: u64,
}

impl LossCounts {
    /// Counts an entry that is not a frame.
    pub(crate) fn count(&mut self, note: &CaptureNote<'_>) {
        match note.kind {
            NoteKind::Text => {}
            NoteKind::CanXl => self.can_xl += 1,
            NoteKind::Dropped(frames) => self.frames = self.frames.saturating_add(frames),
            NoteKind::Unreadable(_) if note.line == 0 => self.messages += 1,
            NoteKind::Unreadable(_) => self.lines += 1,
        }
    }

    /// Returns the number of unreadable lines and messages.
    pub(crate) const fn unreadable_count(&self) -> u64 {
        self.lines + self.messages
    }

    /// Prints the counts at the end of a capture. `can_xl` says how CAN XL frames were handled.
    pub(crate) fn print_counts(&self, reader: &Reader, can_xl: &str) {
        let name = reader.name();
        // In a recording, candump lines are notes.
        let unread = match reader.line_count() {
            0 => format!("{} of a log could not be read", count_with_noun(self.lines, "line")),
            lines => format!("{} of {lines} lines could not be read", self.lines),
        };
        let said = [
            (self.lines, unread),
            (self.messages, format!("{} could not be read", count_with_noun(self.messages, "message"))),
            (self.frames, format!("{} frames are missing, because the recorder lost them", self.frames)),
            (self.can_xl, format!("CAN XL frames are {can_xl}: {}", self.can_xl)),
        ];
        let said = said.iter().filter(|(count, _)| *count > 0).map(|(_, said)| said);
        for line in said.chain(&reader.extras().unfinished) {
            output::print_note(format_args!("{name}: {line}"));
        }
        for remark in reader.remarks() {
            output::print_note(format_args!("{name}: {remark}"));
        }
    }
}

/// A live bus from which a command receives. A loss of the bus is reported once, until the bus works again.
#[derive(Debug)]
pub(crate) struct BusReceiver {
    bus: Bus,
    follower: Follower,
}

/// Opens buses as [`ReceiveEnd::open`] does. If `until` is given, waits for buses that do not exist, until that flag is
/// set.
pub(crate) fn open_bus_receivers(
    sources: &[PathBuf],
    kinds: &KindChoices,
    format: Option<can::Format>,
    options: &BusOptions,
    until: Option<&AtomicBool>,
) -> Result<Vec<BusReceiver>, Failure> {
    let mut opened = Vec::new();
    for source in sources {
        let name = source.display().to_string();
        loop {
            match (BusReceiver::open(&name, kinds.kind_of(&name), format, options.clone()), until) {
                (Ok(receive_end), _) => break opened.push(receive_end),
                (Err(_), Some(stopped)) if stopped.load(Ordering::Relaxed) => return Ok(opened),
                (Err(error), Some(_)) if error.may_open_later() => thread::sleep(RETRY_INTERVAL),
                (Err(error), _) => return Err(no_such_source_failure(&name, &error)),
            }
        }
    }
    Ok(opened)
}

impl BusReceiver {
    /// Opens a bus to receive all its frames, and prints the kind of the bus. Without a format, also opens a classic
    /// interface.
    fn open(
        name: &str,
        kind: KindChoice,
        format: Option<can::Format>,
        options: BusOptions,
    ) -> Result<Self, BusError> {
        let bus = listen::open_bus(name, kind, format, BusOptions { error_mask: EXTENDED_MASK, ..options })?;
        output::print_note(format_args!("listening on {}, a bus of kind {}", bus.name(), bus.kind()));
        Ok(Self { bus, follower: Follower::default() })
    }

    /// Receives the frames that are waiting or arrive within `wait`. Returns true if there are any.
    ///
    /// # Errors
    /// Returns [`BusError`] if the bus is gone.
    pub(crate) fn receive(&mut self, wait: Duration) -> Result<bool, BusError> {
        match self.follower.step(&mut NeverReopenedBus(&self.bus), wait) {
            FollowStep::Frames(_) | FollowStep::Leftover(_) => Ok(true),
            FollowStep::Nothing | FollowStep::Drained | FollowStep::Refused(_) => Ok(false),
            FollowStep::Down(error) => {
                output::print_note(format_args!("skinbus: {error}; waiting for the bus to return"));
                Ok(false)
            }
            FollowStep::Gone(error) => Err(error),
        }
    }

    /// The frames received last.
    pub(crate) fn frames(&self) -> impl Iterator<Item = ReceivedFrame> + '_ {
        self.follower.frames()
    }

    pub(crate) const fn bus(&self) -> &Bus {
        &self.bus
    }

    /// Prints and returns the number of frames lost because they arrived faster than they were processed. `done` says
    /// in the note how they would have been processed.
    pub(crate) fn report_missing_frames(&self, done: &str) -> u64 {
        let (name, missing) = (self.bus().name(), self.follower.dropped_frames());
        if missing > 0 {
            output::print_note(format_args!(
                "{name}: {missing} frames are missing, because they arrived faster than they were {done}"
            ));
        }
        missing
    }
}

/// Waits until a frame arrives on one of these buses, at most for `timeout`.
pub(crate) fn wait(receive_ends: &[BusReceiver], timeout: Duration) -> Result<(), Failure> {
    let mut fds: Vec<_> =
        receive_ends.iter().map(|receive_end| PollFd::new(receive_end.bus(), PollFlags::IN)).collect();
    match poll(&mut fds, Timespec::try_from(timeout).ok().as_ref()) {
        Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
        Err(errno) => Err(Failure::run_error(io::Error::from(errno))),
    }
}

/// Opens a capture, standard input or the parts of a recording, so that a signal can stop its reader. Signals are
/// caught only once a file is open: a program that waits for the other end of a pipe has nothing to clean up.
pub(crate) fn open_capture(
    sources: &[PathBuf],
    through: impl Fn(InterruptibleFile) -> Box<dyn Read + Send> + Send + 'static,
) -> Result<Reader, Failure> {
    let flag = OnceLock::new();
    let interruptible = move |file| {
        // All parts share one flag. If signals cannot be caught, they end the program at once.
        let caught = || stop_flag().unwrap_or_else(|_| Arc::clone(stop::stop_flag()));
        through(InterruptibleFile { file, stopped: Arc::clone(flag.get_or_init(caught)) })
    };
    Reader::open_wrapped(sources, Box::new(interruptible)).map_err(Failure::usage_error)
}

/// A file whose reading can be stopped: it then reports the end of the file.
pub(crate) struct InterruptibleFile {
    pub(crate) file: File,
    pub(crate) stopped: Arc<AtomicBool>,
}

impl Read for InterruptibleFile {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let timeout = Timespec::try_from(POLL_TIMEOUT).ok();
        while !self.stopped.load(Ordering::Relaxed) {
            match poll(&mut [PollFd::new(&self.file, PollFlags::IN)], timeout.as_ref()) {
                Ok(0) | Err(rustix::io::Errno::INTR) => {}
                Ok(_) => return self.file.read(buffer),
                Err(errno) => return Err(errno.into()),
            }
        }
        Ok(0)
    }
}
