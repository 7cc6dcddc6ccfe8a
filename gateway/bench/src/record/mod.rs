//! Recording of a run, and the thread that writes it.
//!
//! ```text
//!   receiver, one a bus ─ frames, drops, contact states ───┐
//!   control loop ─────── ticks ────────────────────────────┼─> queues ─> recorder ─┬─> run.mcap, run-1.mcap, ...
//!   kernel ───────────── drops of its backlog ─────────────┘   (bounded)            └─> candump log
//! ```
//!
//! No thread waits for the recorder: queues count items that do not fit, and the recording notes where they are
//! missing. File errors do not end the run. `docs/reference/recording.md` describes the topics.

pub(crate) mod backlog;
pub mod facts;
pub mod feed;
pub mod text;
mod thread;
pub mod topics;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;

use feed::{RecorderFeed, UnrecordedCounts};
use text::CandumpWriter;
use thiserror::Error;
use topics::Topics;
use trace::recording::account::RecordingAccount;
use trace::recording::layout::Layout;
use trace::recording::repair;
use trace::recording::robot::RecordedRobot;
use trace::recording::series::{AttachedFile, FileHead, SplitLimits, SplitRecording};

use crate::bus::realtime::wall_clock_ns;
use crate::threads::{ThreadError, spawn};
use trace::files::check_writable_regular_file;

/// Outputs of a recording.
#[derive(Clone, Debug, Default)]
pub struct RecordOptions {
    /// Output of frames as candump text.
    pub candump: Option<CandumpOutput>,
    /// Output of all data as MCAP.
    pub mcap: Option<McapOutput>,
    /// True if existing files are overwritten.
    pub force: bool,
}

/// An output of frames as candump text.
#[derive(Clone, Debug)]
pub struct CandumpOutput {
    /// Path of the log.
    pub path: PathBuf,
    /// True if a number is added to the file's name when the file exists.
    pub numbered: bool,
}

/// An output of all data as MCAP.
#[derive(Clone, Debug)]
pub struct McapOutput {
    /// Path of the first file.
    pub path: PathBuf,
    /// Limits at which a new file is started.
    pub split: SplitLimits,
    /// Files attached to each file of the recording.
    pub attachments: Vec<AttachedFile>,
    /// Geometry of the robot's links, if known.
    pub robot: Option<RecordedRobot>,
    /// Command line of the program.
    pub command_line: Vec<String>,
}

/// An error of an output.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum OutputError {
    /// The log cannot be written.
    #[error("--candump {}: {source}", .path.display())]
    Candump {
        /// Path of the log.
        path: PathBuf,
        /// Cause.
        source: io::Error,
    },
    /// The recording cannot be written.
    #[error("--record {}: {source}", .path.display())]
    Mcap {
        /// Path of the first file.
        path: PathBuf,
        /// Cause.
        source: io::Error,
    },
    /// The name of the recording does not end in `.mcap`.
    #[error("--record {}: the name of a recording must end in .mcap", .0.display())]
    Name(PathBuf),
}

/// Output files that are open but contain no data yet.
#[derive(Debug)]
pub struct RecordingOutputs {
    text: Option<CandumpWriter>,
    series: Option<SplitRecording<Topics>>,
}

impl RecordingOutputs {
    /// Opens the outputs, so that errors show up before the run starts. Repairs unfinished files of killed runs beside
    /// them and reports each repair. Waits for a FIFO's reader, or until `stopped`.
    ///
    /// # Errors
    /// Returns [`OutputError`] with the file that cannot be written.
    pub fn open_outputs(
        options: &RecordOptions,
        stopped: &AtomicBool,
        say: impl FnMut(&str),
    ) -> Result<Self, OutputError> {
        let text = options.candump.as_ref().map(|candump| {
            let failed = |source| OutputError::Candump { path: candump.path.clone(), source };
            CandumpWriter::create(candump, options.force, stopped).map_err(failed)
        });
        let text = text.transpose()?;
        let series = options.mcap.as_ref().map(|McapOutput { path, split, .. }| {
            let failed = |source| OutputError::Mcap { path: path.clone(), source };
            if path.extension().is_none_or(|extension| extension != "mcap") {
                return Err(OutputError::Name(path.clone()));
            }
            check_writable_regular_file(path, options.force).map_err(failed)?;
            repair::repair_orphans(path, say);
            SplitRecording::claim(path, options.force, *split).map_err(failed)
        });
        Ok(Self { text, series: series.transpose()? })
    }

    /// Returns true if no output is requested.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.text.is_none() && self.series.is_none()
    }

    /// Path of the candump log, if any.
    #[must_use]
    pub fn candump_path(&self) -> Option<&Path> {
        self.text.as_ref().map(CandumpWriter::path)
    }

    /// Returns true if more than frames is recorded.
    #[must_use]
    pub const fn records_all(&self) -> bool {
        self.series.is_some()
    }

    /// Starts the recorder; each file begins with `head`.
    ///
    /// # Errors
    /// Returns [`ThreadError`] if the system grants no thread.
    pub fn start(self, feed: RecorderFeed, layout: Layout, head: FileHead) -> Result<Recorder, ThreadError> {
        let stop = Arc::new(StopRequest::default());
        let (tell, said) = mpsc::channel();
        let (notes, noted) = mpsc::channel();
        let work = thread::RecorderThread::new(self, feed, layout, (noted, tell));
        let ended = Arc::clone(&stop);
        let thread = spawn("recorder", move || work.run(head, &ended))?;
        Ok(Recorder { thread, stop, notes, messages: said })
    }
}

/// Requests to end a recording.
#[derive(Debug, Default)]
struct StopRequest {
    /// Ends the recording.
    now: AtomicBool,
    /// Removes the recording, as if the run had not happened.
    discard: AtomicBool,
}

/// Handle of the recorder's thread.
#[derive(Debug)]
pub struct Recorder {
    thread: std::thread::JoinHandle<RecordingAccount>,
    stop: Arc<StopRequest>,
    notes: mpsc::Sender<(u64, String)>,
    messages: mpsc::Receiver<String>,
}

impl Recorder {
    /// Returns the messages for the user that have arrived since the last call.
    pub fn messages(&self) -> impl Iterator<Item = String> + '_ {
        self.messages.try_iter()
    }

    /// Adds a note about an intervention to the recording; a candump log holds frames only.
    pub fn add_note(&self, text: &str) {
        // After the thread has ended, notes are lost.
        let _ = self.notes.send((wall_clock_ns(), text.to_owned()));
    }

    /// Ends the recording of a run that never began. Removes all outputs except a candump log that contains frames.
    #[must_use]
    pub fn discard(self) -> RecordingAccount {
        self.stop.discard.store(true, Ordering::Relaxed);
        self.stop.now.store(true, Ordering::Release);
        // If the thread panicked, it leaves a file that the next run removes.
        self.thread.join().unwrap_or_default()
    }

    /// Records all queued items and ends the files. Call it after all threads have stopped queuing. `unrecorded` counts
    /// items that did not fit into the receivers' queues; `ticks` counts ticks that did not fit into theirs.
    #[must_use]
    pub fn finish(self, unrecorded: UnrecordedCounts, ticks: u64) -> RecordingAccount {
        self.stop.now.store(true, Ordering::Release);
        let mut recording = self.thread.join().unwrap_or_else(|_| {
            let errors =
                vec!["the recorder crashed: the next run recovers the part that was written".to_owned()];
            RecordingAccount { errors, ..RecordingAccount::default() }
        });
        recording.lost_queue = unrecorded.frames;
        recording.lost += unrecorded.frames;
        for (name, lost) in [("ticks", ticks), ("epochs", unrecorded.epochs)] {
            if lost > 0 {
                recording.messages_lost.insert(name, lost);
            }
        }
        recording
    }
}
