//! Replay: a capture is sent onto buses again, and the cells' replies are compared with the recorded ones.
//!
//! ```text
//!   capture ─ survey: buses, cells, hashes, the state where it begins
//!      │
//!      └─ reader thread ── order, pick, number ── steps ──> player (SCHED_FIFO) ──> buses ──> cells
//!                               │                                │                    │
//!                               └─ replies ─> comparator <───────┴─ announced joints  │
//!                                                  ▲                                  │
//!                                                  └─ receiver (one a bus) <──────────┘
//! ```
//!
//! The logic is pure: [`survey`], [`model::latched::state`], [`trace::order`], [`replay_plan`], [`player`] (its clock
//! and buses are a [`player::PlayerBackend`]), [`comparator`] and [`difference`]. The other modules hold threads,
//! sockets and the clock.

mod checks;
pub mod comparator;
pub mod difference;
mod error;
mod live;
mod meet;
pub mod player;
pub mod replay_plan;
pub mod report;
mod session;
mod shared_state;
mod sine;
mod source;
mod start;
pub mod survey;

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use protocol::bus::KindChoices;
use protocol::id::CellId;
use protocol::input::is_standard_input;
use protocol::sine::SineMethod;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use self::checks::CellChecks;
pub use self::error::CellMismatch;
pub use self::error::ReplayError;
use self::player::ReplaySpeed;
use self::replay_plan::SenderFilter;
use self::report::Summary;
use self::session::ReplaySession;
use self::shared_state::SharedState;
use self::sine::RecordedSine;
use self::start::BusRoutes;
use self::survey::{Survey, TimeRange};
use crate::bus::realtime::idle_lateness;
use crate::bus::time::BusTimeChoice;
use crate::processes::ended::EndedProcesses;
use crate::progress::Progress;
use crate::setup::format_cells;
use crate::signals::catch_signals;
use model::decode::MAX_BUSES;
use trace::capture::{CaptureEntry, CaptureError, NoteKind, Reader, RecordingExtras, seconds_since};

/// Period in ns of the wake-ups whose lateness is measured.
const WAKEUP_PERIOD_NS: u64 = 2_000_000;
/// Maximum number of unreadable lines that are named.
const MAX_LISTED_UNREADABLE_LINES: u64 = 5;

/// Cells to start for a replay.
#[derive(Clone, Debug)]
pub struct SpawnOptions {
    /// Path of the skin file for the cells; `None` for the skin attached to the recording.
    pub skin: Option<PathBuf>,
    /// Maximum number of cells per process.
    pub cells_per_process: usize,
}

/// Options of a replay.
#[derive(Clone, Debug)]
pub struct ReplayOptions {
    /// The capture: a file, or the parts of a recording.
    pub files: Vec<PathBuf>,
    /// Kind of each bus.
    pub kinds: KindChoices,
    /// Time that frames take on the embedded buses that the replay serves for its cells.
    pub bus_time: BusTimeChoice,
    /// Selection of the frames by their sender.
    pub only: SenderFilter,
    /// Buses of the capture whose frames are sent; empty for all.
    pub buses: Vec<String>,
    /// Pairs of a bus of the capture and the bus that receives its frames.
    pub map: Vec<(String, String)>,
    /// Part of the capture that is replayed.
    pub part: TimeRange,
    /// Number of passes over the capture, or `None` to repeat without end.
    pub passes: Option<u32>,
    /// Speed of the replay.
    pub pace: ReplaySpeed,
    /// Time before a frame is due during which the thread polls the clock instead of sleeping.
    pub spin: Duration,
    /// True if joints are sent only after all cells have answered the joints before.
    pub lockstep: bool,
    /// Tolerance in steps of torques for the comparison with recorded replies, or `None` to compare nothing.
    pub expect: Option<u16>,
    /// Cells to start, if any.
    pub spawn: Option<SpawnOptions>,
    /// True if measuring cells are put into test mode.
    pub test_mode: bool,
    /// Time to wait for room on a full bus.
    pub timeout: Duration,
    /// Size of a socket's receive buffer in bytes, as the kernel counts them.
    pub receive_buffer: usize,
    /// True if progress is hidden.
    pub quiet: bool,
}

/// Replays a capture to its end, or until SIGINT or SIGTERM.
///
/// # Errors
/// Returns [`ReplayError`] if the replay cannot start or the capture cannot be read to its end. Problems on the buses
/// and in the comparison are in the summary.
pub fn replay(options: &ReplayOptions) -> Result<Summary, ReplayError> {
    let (first, sine) = replay_with_sine(options, None)?;
    let Some(RecordedSine::Assumed(assumed)) = sine.filter(|_| first.has_other_torque_words()) else {
        return Ok(first);
    };
    let other = assumed.other();
    let progress = Progress::notes_only(options.quiet);
    progress.print_note(&format!(
        "{} does not say which sine function its cells used, and {assumed} gives other torques: the replay \
         is repeated with {other}",
        first.file
    ));
    let (second, _) = replay_with_sine(options, Some(other))?;
    Ok(if second.differs_less_than(&first) { second } else { first })
}

/// Replays a capture once. The cells that it starts compute with `sine`; with `None`, with that of the recorded cells.
/// Also returns the sine of these cells.
fn replay_with_sine(
    options: &ReplayOptions,
    sine: Option<SineMethod>,
) -> Result<(Summary, Option<RecordedSine>), ReplayError> {
    let progress = Progress::notes_only(options.quiet);
    let (survey, extras, name) = survey_capture(options, &progress)?;
    let routes = BusRoutes::new(options, &survey, &name)?;
    let skin_override = options.spawn.as_ref().map(|spawn| start::spawn_skin(spawn, &routes, &extras, &name));
    let skin_override = skin_override.transpose()?;
    // Until here, a signal may end the program, because there is nothing to clean up.
    let signalled = catch_signals(&[SIGHUP, SIGINT, SIGTERM])?;
    // In lockstep, frames are sent when cells have answered, not at a time.
    let timed = options.is_timed();
    let idle = timed.then(|| idle_lateness(WAKEUP_PERIOD_NS));
    let recorded = start::recorded_skin(&extras);
    let mut buses = start::open_buses(options, &survey, &routes, skin_override.as_ref(), recorded.as_ref())?;
    for bus_link in buses.bus_links.iter() {
        progress.print_note(&format!("{} is {}", bus_link.bus.name(), bus_link.bus.kind()));
    }
    let sends_joints = options.only != SenderFilter::Replies && survey.buses.iter().any(|bus| bus.joints > 0);
    let present = if sends_joints { buses.find_cells()? } else { Vec::new() };
    let checks = CellChecks { options: options.clone(), survey, routes, name };
    let mut started_sine = None;
    if let (Some(spawn), Some(skin_override)) = (&options.spawn, &skin_override) {
        let sine = match sine {
            Some(sine) => RecordedSine::Known(sine),
            None => sine::recorded_sine(options, &extras, &skin_override.skin)?,
        };
        buses.start_cells(spawn, skin_override, &present, sine.method())?;
        started_sine = Some(sine);
    } else if options.only == SenderFilter::All {
        warn_of_duplicates(&checks, &present, &progress);
    }
    let shared_state = Arc::new(SharedState::new(checks));
    let (measuring, ended) = (Vec::new(), EndedProcesses::default());
    let session = ReplaySession { shared_state, buses, signalled, progress, measuring, ended };
    Ok((session.run(idle.as_ref(), skin_override.as_ref())?, started_sine))
}

/// Reads the whole capture once. Returns its survey, its contents other than frames, and its display name.
fn survey_capture(
    options: &ReplayOptions,
    progress: &Progress,
) -> Result<(Survey, RecordingExtras, String), ReplayError> {
    if options.files.iter().any(|file| is_standard_input(file)) {
        return Err(ReplayError::StandardInput);
    }
    let is_pipe = |file: &&PathBuf| file.metadata().is_ok_and(|it| !it.is_file() && !it.is_dir());
    if let Some(pipe) = options.files.iter().find(is_pipe) {
        return Err(ReplayError::Pipe(pipe.clone()));
    }
    let mut reader = Reader::open_all(&options.files).map_err(ReplayError::Open)?;
    let name = reader.name().to_owned();
    let mut survey = Survey::new(options.part);
    let check_bus_count =
        |buses| if buses > MAX_BUSES { Err(ReplayError::Buses(name.clone())) } else { Ok(()) };
    let note = |text: String| progress.print_note(&format!("{name}: {text}"));
    // Latched frames are stored before the first frame, and are known once the capture is open.
    let latched = &reader.extras().latched;
    let buses: BTreeSet<_> = latched.iter().map(|frame| frame.bus.as_str()).collect();
    check_bus_count(buses.len())?;
    survey.add_latched_frames(latched);
    survey.run_began = reader.extras().run_began();
    let (mut unreadable, mut backwards) = (0_u64, None);
    while let Some(entry) = reader.next().map_err(ReplayError::Read)? {
        match entry {
            CaptureEntry::Frame(record) => {
                if record.time.nanos < survey.last && backwards.is_none() {
                    backwards = Some((survey.frames + 1, survey.last - record.time.nanos));
                }
                survey.add_frame(&record);
                check_bus_count(survey.buses.len())?;
            }
            CaptureEntry::Note(note) => match note.kind {
                NoteKind::Dropped(frames) => survey.dropped = survey.dropped.saturating_add(frames),
                NoteKind::Unreadable(why) => {
                    let line = format!("{name}:{}: {why}", note.line);
                    unreadable += 1;
                    if unreadable <= MAX_LISTED_UNREADABLE_LINES {
                        progress.print_note(&line);
                    }
                }
                NoteKind::Text => survey.add_note(&note),
                NoteKind::CanXl => {}
            },
        }
    }
    survey.finish();
    if unreadable > 0 {
        note(format!("lines skipped because they could not be read: {unreadable}"));
    }
    if survey.dropped > 0 {
        note(format!("{} frames are missing: they were lost during recording", survey.dropped));
    }
    if let Some(what) = &reader.extras().unfinished {
        note(what.to_string());
    }
    for remark in reader.remarks_except_order() {
        note(remark);
    }
    if let Some((frame, nanos)) = backwards.filter(|(_, nanos)| *nanos > trace::order::REORDER_WINDOW_NS) {
        let back = Duration::from_nanos(nanos).as_secs_f64();
        note(format!(
            "time stamps go backwards (first at frame {frame}, by {back:.3} s): a frame that is out of order \
             is sent immediately"
        ));
    }
    if survey.frames == 0 {
        return Err(match reader.text_kind() {
            Some((what, hint)) => ReplayError::Open(CaptureError::OtherFormat { name, what, hint }),
            None => ReplayError::Empty(name),
        });
    }
    let (from, to) = survey.part_bounds_ns();
    if from > survey.last || from >= to {
        let ends_s = seconds_since(survey.time_origin_ns(), survey.last);
        return Err(ReplayError::NothingLeft { name, ends_s });
    }
    Ok((survey, reader.extras().clone(), name))
}

/// Warns that cells which are already on the bus will receive copies of the messages that they sent in the recording.
fn warn_of_duplicates(checks: &CellChecks, heard: &[BTreeSet<CellId>], progress: &Progress) {
    for ((name, bus), heard) in checks.named_buses().zip(heard) {
        let both: Vec<_> = heard.iter().copied().filter(|cell| bus.cells.contains_key(cell)).collect();
        if !both.is_empty() {
            progress.print_note(&format!(
                "the replay also sends recorded frames of these cells on {name}, although the cells are on \
                 the bus: {}; add --only inputs to leave such frames out",
                format_cells(&both, "")
            ));
        }
    }
}
