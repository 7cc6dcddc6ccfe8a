//! What a run records, and the thread that writes it.
//!
//! ```text
//!   receiver, one a bus ─ frames, drops, contact states ───┐
//!   control loop ─────── ticks ────────────────────────────┼─> queues ─> recorder ─┬─> run.mcap, run-1.mcap, ...
//!   kernel ───────────── drops of its backlog ─────────────┘   (bounded)            └─> candump log
//! ```
//!
//! No thread waits for the recorder: what does not fit into a queue is counted, and the recording notes where it is
//! missing. No error of a file ends the run. `docs/reference/recording.md` has the topics.

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

use feed::{Feed, Unrecorded};
use text::Text;
use thiserror::Error;
use topics::Topics;
use trace::recording::account::Recording;
use trace::recording::layout::Layout;
use trace::recording::repair;
use trace::recording::robot::Robot;
use trace::recording::series::{Attached, Head, Series, Split};

use crate::bus::realtime::wall;
use crate::threads::{ThreadError, spawn};
use trace::files::check_regular;

/// What is to be recorded where.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Frames as candump text.
    pub candump: Option<Candump>,
    /// Everything as MCAP.
    pub mcap: Option<Mcap>,
    /// Whether a file that exists is overwritten.
    pub force: bool,
}

/// Frames as candump text.
#[derive(Clone, Debug)]
pub struct Candump {
    /// The file.
    pub path: PathBuf,
    /// Whether it gets a number when one of its name exists.
    pub numbered: bool,
}

/// Everything as MCAP.
#[derive(Clone, Debug)]
pub struct Mcap {
    /// The first file.
    pub path: PathBuf,
    /// When another file is begun.
    pub split: Split,
    /// Files in each file.
    pub attachments: Vec<Attached>,
    /// What is known of the robot's links.
    pub robot: Option<Robot>,
    /// How the program was called.
    pub command_line: Vec<String>,
}

/// Why nothing can be recorded there.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum OutputError {
    /// A log cannot be written.
    #[error("--candump {}: {source}", .path.display())]
    Candump {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A recording cannot be written.
    #[error("--record {}: {source}", .path.display())]
    Mcap {
        /// The first file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A recording has another name.
    #[error("--record {}: a recording's name ends in .mcap", .0.display())]
    Name(PathBuf),
}

/// Files that are reserved, and not begun.
#[derive(Debug)]
pub struct Outputs {
    text: Option<Text>,
    series: Option<Series<Topics>>,
}

impl Outputs {
    /// Opens what will be written, so that what makes that impossible is known before there is anything to write.
    /// Repairs the unfinished files of killed runs beside it, and reports each. A FIFO is waited for until it has a
    /// reader, or until `stopped`.
    ///
    /// # Errors
    /// What cannot be written, and what to do.
    pub fn claim(
        options: &Options,
        stopped: &AtomicBool,
        say: impl FnMut(&str),
    ) -> Result<Self, OutputError> {
        let text = options.candump.as_ref().map(|candump| {
            let failed = |source| OutputError::Candump { path: candump.path.clone(), source };
            Text::create(candump, options.force, stopped).map_err(failed)
        });
        let text = text.transpose()?;
        let series = options.mcap.as_ref().map(|Mcap { path, split, .. }| {
            let failed = |source| OutputError::Mcap { path: path.clone(), source };
            if path.extension().is_none_or(|extension| extension != "mcap") {
                return Err(OutputError::Name(path.clone()));
            }
            check_regular(path, options.force).map_err(failed)?;
            repair::orphans(path, say);
            Series::claim(path, options.force, *split).map_err(failed)
        });
        Ok(Self { text, series: series.transpose()? })
    }

    /// Whether nothing is to be recorded.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.text.is_none() && self.series.is_none()
    }

    /// The candump log, if there is one.
    #[must_use]
    pub fn log(&self) -> Option<&Path> {
        self.text.as_ref().map(Text::path)
    }

    /// Whether more than frames is recorded.
    #[must_use]
    pub const fn wants_all(&self) -> bool {
        self.series.is_some()
    }

    /// Begins to record what comes; each file begins with `head`.
    ///
    /// # Errors
    /// When there is no thread for it.
    pub fn start(self, feed: Feed, layout: Layout, head: Head) -> Result<Recorder, ThreadError> {
        let stop = Arc::new(Stop::default());
        let (tell, said) = mpsc::channel();
        let (notes, noted) = mpsc::channel();
        let work = thread::Work::new(self, feed, layout, (noted, tell));
        let ended = Arc::clone(&stop);
        let thread = spawn("recorder", move || work.run(head, &ended))?;
        Ok(Recorder { thread, stop, notes, said })
    }
}

/// How a recording is ended.
#[derive(Debug, Default)]
struct Stop {
    /// Now.
    now: AtomicBool,
    /// As if there had been no run.
    discard: AtomicBool,
}

/// The thread that records.
#[derive(Debug)]
pub struct Recorder {
    thread: std::thread::JoinHandle<Recording>,
    stop: Arc<Stop>,
    notes: mpsc::Sender<(u64, String)>,
    said: mpsc::Receiver<String>,
}

impl Recorder {
    /// Messages for the user since the last call.
    pub fn said(&self) -> impl Iterator<Item = String> + '_ {
        self.said.try_iter()
    }

    /// Notes in a recording what is done to the bench now; a log has frames only.
    pub fn note(&self, text: &str) {
        // Without its thread nothing is recorded any more.
        let _ = self.notes.send((wall(), text.to_owned()));
    }

    /// Ends the recording of a run that never began, and leaves only a log of received frames.
    #[must_use]
    pub fn discard(self) -> Recording {
        self.stop.discard.store(true, Ordering::Relaxed);
        self.stop.now.store(true, Ordering::Release);
        // At most it leaves a file that the next run removes.
        self.thread.join().unwrap_or_default()
    }

    /// Records what has been handed over once no thread hands over more, and ends the files. `unrecorded` is what
    /// did not fit into receivers' queues, `ticks` what did not into the loop's.
    #[must_use]
    pub fn finish(self, unrecorded: Unrecorded, ticks: u64) -> Recording {
        self.stop.now.store(true, Ordering::Release);
        let mut recording = self.thread.join().unwrap_or_else(|_| {
            let errors =
                vec!["the recorder panicked: what it had written is recovered by the next run".to_owned()];
            Recording { errors, ..Recording::default() }
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
