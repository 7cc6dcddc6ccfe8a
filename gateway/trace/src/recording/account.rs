//! Counts of what a recording wrote and lost.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

/// One file of a recording.
#[derive(Clone, Debug, Serialize)]
pub struct WrittenFile {
    /// The name of the file.
    pub path: String,
    /// The format: `candump` or `mcap`.
    pub format: &'static str,
    /// The number of frames in it.
    pub frames: u64,
    /// The number of messages in it, including frames.
    pub messages: u64,
    /// Its size in bytes.
    pub bytes: u64,
}

/// Counts of messages.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct MessageCount {
    /// Frames.
    pub frames: u64,
    /// Other messages.
    pub others: u64,
}

impl MessageCount {
    /// One frame of a bus.
    pub const FRAME: Self = Self { frames: 1, others: 0 };

    /// Counts `others` other messages.
    #[must_use]
    pub const fn others(others: u64) -> Self {
        Self { frames: 0, others }
    }

    pub(super) fn add(&mut self, other: Self) {
        self.frames += other.frames;
        self.others += other.others;
    }

    /// Returns the account of a file that holds these messages.
    pub(super) fn in_file(self, path: &Path, bytes: u64) -> WrittenFile {
        let Self { frames, others } = self;
        WrittenFile { path: path.display().to_string(), format: "mcap", frames, messages: frames + others, bytes }
    }
}

/// The account of a run's recording.
#[derive(Clone, Debug, Default, Serialize)]
pub struct RecordingAccount {
    /// The files, in the order in which they were finished.
    pub files: Vec<WrittenFile>,
    /// Frames that are in every requested format.
    pub frames: u64,
    /// Lost frames: the sum of the two below.
    pub lost: u64,
    /// Frames that did not fit into the recorder's queue.
    pub lost_queue: u64,
    /// Frames that could not be written.
    pub lost_write: u64,
    /// Other messages that are missing, by kind of topic: ticks and epochs, and those that could not be written.
    pub messages_lost: BTreeMap<&'static str, u64>,
    /// Messages that arrived too late for their position in the order of times, and stand after it.
    pub messages_late: u64,
    /// The processor time of the recorder's thread, in s.
    pub processor_s: f64,
    /// Error messages, each once.
    pub errors: Vec<String>,
}
