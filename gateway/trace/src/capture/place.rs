//! Positions in a capture from which a reader can continue.

use std::path::{Path, PathBuf};

use super::log::Clock;
use super::mcap::{McapState, ReadFault};

/// A position in a capture, directly before an entry.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct SeekPoint {
    /// The index of the file among the parts of the capture.
    pub(super) part: usize,
    /// The byte offset of the record or line in its part.
    pub(super) offset: u64,
    /// The number of lines before this position in a log; 0 if they were not counted.
    pub(super) line: u64,
    /// The number of frames and notes of the record at `offset` that come before this position.
    pub(super) skip: u32,
    /// The state of the log's clock at this position.
    pub(super) clock: Clock,
}

/// An index of positions in a capture, by time.
#[derive(Debug)]
pub struct SeekIndex {
    pub(super) parts: Vec<IndexedFile>,
    /// The positions in ascending order. The time with each is the latest one of all entries before the next position,
    /// in ns since 1970.
    pub(super) marks: Vec<(u64, SeekPoint)>,
    /// The minimum distance between two positions of a file, in bytes.
    pub(super) min_distance: u64,
}

#[derive(Debug)]
pub(super) struct IndexedFile {
    pub(super) path: PathBuf,
    /// Schema and channel records of the summary: operation code and contents of each.
    pub(super) descriptions: Vec<(u8, Vec<u8>)>,
}

impl SeekIndex {
    /// Returns the latest time in the capture, in ns since 1970, as far as the index knows; 0 for an empty capture.
    #[must_use]
    pub fn latest_ns(&self) -> u64 {
        self.marks.last().map_or(0, |(latest, _)| *latest)
    }

    /// Returns the last indexed position before which all entries are earlier than `nanos`, in ns since 1970.
    #[must_use]
    pub fn point_before(&self, nanos: u64) -> SeekPoint {
        let at = self.marks.partition_point(|(latest, _)| *latest < nanos);
        self.marks.get(at).or_else(|| self.marks.last()).map(|(_, place)| *place).unwrap_or_default()
    }

    pub(super) fn path(&self, part: usize) -> Option<&Path> {
        self.parts.get(part).map(|part| part.path.as_path())
    }

    /// Returns the files after the one with the index `part`.
    pub(super) fn paths_after(&self, part: usize) -> impl Iterator<Item = &PathBuf> {
        self.parts.iter().skip(part + 1).map(|part| &part.path)
    }

    /// Passes the schemas and channels of a part to the state of a reader.
    pub(super) fn apply_descriptions(&self, part: usize, state: &mut McapState) -> Result<(), ReadFault> {
        for (opcode, body) in self.parts.get(part).into_iter().flat_map(|part| &part.descriptions) {
            state.process_record(*opcode, body, false)?;
        }
        Ok(())
    }
}
