//! Counts the messages that a recording has written and lost.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

/// A finished file of a recording, with its size and message counts.
#[derive(Clone, Debug, Serialize)]
pub struct WrittenFile {
    /// The name of the file.
    pub path: String,
    /// The format: `candump` or `mcap`.
    pub format: &'static str,
    /// The number of frames in the file.
    pub frames: u64,
    /// The number of messages in the file, including frames.
    pub messages: u64,
    /// The size of the file in bytes.
    pub bytes: u64,
}

/// A number of frames and a number of other messages.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct MessageCount {
    /// Frames.
    pub frames: u64,
    /// Other messages.
    pub others: u64,
}

impl MessageCount {
    /// The count of a single frame.
    pub const ONE_FRAME: Self = Self { frames: 1, others: 0 };

    /// Returns the count of `others` messages that are not frames.
    #[must_use]
    pub const fn other_messages(others: u64) -> Self {
        Self { frames: 0, others }
    }

    pub(super) fn add(&mut self, other: Self) {
        self.frames += other.frames;
        self.others += other.others;
    }

    /// Returns the entry for a file of `bytes` bytes that holds these messages.
    pub(super) fn into_written_file(self, path: &Path, bytes: u64) -> WrittenFile {
        let Self { frames, others } = self;
        WrittenFile {
            path: path.display().to_string(),
            format: "mcap",
            frames,
            messages: frames + others,
            bytes,
        }
    }
}

/// A summary of a run's recording: its files, and the messages that were written and lost.
#[derive(Clone, Debug, Default, Serialize)]
pub struct RecordingAccount {
    /// The files, in the order in which they were finished.
    pub files: Vec<WrittenFile>,
    /// Frames that are in every requested format.
    pub frames: u64,
    /// Frames that were lost: the sum of `lost_queue` and `lost_write`.
    pub lost: u64,
    /// Frames lost because the recorder's queue was full.
    pub lost_queue: u64,
    /// Frames lost because the file could not be written.
    pub lost_write: u64,
    /// Lost messages other than frames, by kind: ticks, epochs, and messages that could not be written.
    pub messages_lost: BTreeMap<&'static str, u64>,
    /// Messages that reached the recorder after messages of later times had been written. The file holds them out of
    /// order.
    pub messages_late: u64,
    /// The processor time used by the recorder's thread, in s.
    pub processor_s: f64,
    /// Error messages of the recorder, without repetitions.
    pub errors: Vec<String>,
}
