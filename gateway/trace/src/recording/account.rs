//! What a recording came to.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

/// One file of a recording.
#[derive(Clone, Debug, Serialize)]
pub struct Written {
    /// Its name.
    pub path: String,
    /// candump or mcap.
    pub format: &'static str,
    /// Frames in it.
    pub frames: u64,
    /// Messages in it, frames among them.
    pub messages: u64,
    /// Its size.
    pub bytes: u64,
}

/// How many.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Count {
    /// Frames.
    pub frames: u64,
    /// Other messages.
    pub others: u64,
}

impl Count {
    /// A frame of a bus.
    pub const FRAME: Self = Self { frames: 1, others: 0 };

    /// So many other messages.
    #[must_use]
    pub const fn others(others: u64) -> Self {
        Self { frames: 0, others }
    }

    pub(super) fn add(&mut self, other: Self) {
        self.frames += other.frames;
        self.others += other.others;
    }

    /// What a file came to in which it is.
    pub(super) fn in_file(self, path: &Path, bytes: u64) -> Written {
        let Self { frames, others } = self;
        Written { path: path.display().to_string(), format: "mcap", frames, messages: frames + others, bytes }
    }
}

/// What a run's recording came to.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Recording {
    /// Its files, in the order in which they were finished.
    pub files: Vec<Written>,
    /// Frames that are in every format that was asked for.
    pub frames: u64,
    /// Frames that are not: the sum of the two below.
    pub lost: u64,
    /// Frames that did not fit into the queue to the recorder.
    pub lost_queue: u64,
    /// Frames that could not be written.
    pub lost_write: u64,
    /// Other messages that are missing, by topic's kind: ticks and epochs, and those that could not be written.
    pub messages_lost: BTreeMap<&'static str, u64>,
    /// Messages that came too late for their place in the order of times, and stand behind it.
    pub messages_late: u64,
    /// Processor time of the recorder's thread, in s.
    pub processor_s: f64,
    /// What went wrong, in words, each once.
    pub errors: Vec<String>,
}
