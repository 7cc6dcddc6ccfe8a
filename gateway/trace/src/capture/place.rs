//! Positions in a capture at which a reader can continue.

use std::path::{Path, PathBuf};

use super::log::Clock;
use super::mcap::{ReadFault, McapState};

/// The position of an entry in a capture.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct SeekPoint {
    /// The index of the part.
    pub(super) part: usize,
    /// The byte offset of the record or line in its part.
    pub(super) offset: u64,
    /// The number of lines before it, if they were counted.
    pub(super) line: u64,
    /// The number of entries before it in the same record.
    pub(super) skip: u32,
    /// The clock of a log at this position.
    pub(super) clock: Clock,
}

/// An index of positions in a capture, by time.
#[derive(Debug)]
pub struct SeekIndex {
    pub(super) parts: Vec<IndexedFile>,
    /// The positions in their order, each with the latest time of all entries before the next position, in ns since
    /// 1970.
    pub(super) marks: Vec<(u64, SeekPoint)>,
    /// The minimum distance between two positions of a file, in bytes.
    pub(super) piece: u64,
}

#[derive(Debug)]
pub(super) struct IndexedFile {
    pub(super) path: PathBuf,
    /// Records of the summary that describe the messages: operation codes and contents.
    pub(super) descriptions: Vec<(u8, Vec<u8>)>,
}

impl SeekIndex {
    /// Returns the latest time in the capture, in ns since 1970, as far as the index knows; 0 for an empty capture.
    #[must_use]
    pub fn latest(&self) -> u64 {
        self.marks.last().map_or(0, |(latest, _)| *latest)
    }

    /// Returns the last position that has only entries earlier than `nanos` before it.
    #[must_use]
    pub fn before(&self, nanos: u64) -> SeekPoint {
        let at = self.marks.partition_point(|(latest, _)| *latest < nanos);
        self.marks.get(at).or_else(|| self.marks.last()).map(|(_, place)| *place).unwrap_or_default()
    }

    pub(super) fn path(&self, part: usize) -> Option<&Path> {
        self.parts.get(part).map(|part| part.path.as_path())
    }

    /// Returns the files of the parts after `part`.
    pub(super) fn behind(&self, part: usize) -> impl Iterator<Item = &PathBuf> {
        self.parts.iter().skip(part + 1).map(|part| &part.path)
    }

    /// Passes the message descriptions of a part to the state of a reader.
    pub(super) fn describe(&self, part: usize, state: &mut McapState) -> Result<(), ReadFault> {
        for (opcode, body) in self.parts.get(part).into_iter().flat_map(|part| &part.descriptions) {
            state.process(*opcode, body, false)?;
        }
        Ok(())
    }
}
