//! Places in a capture at which a reader can go on.

use std::path::{Path, PathBuf};

use super::log::Clock;
use super::mcap::{Fault, State};

/// Where in a capture an entry is.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Place {
    /// Which part, from 0.
    pub(super) part: usize,
    /// Bytes of the part before the record or the line.
    pub(super) offset: u64,
    /// Lines before it, where they were counted.
    pub(super) line: u64,
    /// Entries of the record before it.
    pub(super) skip: u32,
    /// The times of a log up to there.
    pub(super) clock: Clock,
}

/// Some places of a capture, by time.
#[derive(Debug)]
pub struct Places {
    pub(super) parts: Vec<Part>,
    /// In their order, each with the latest time of all that stands before the next one, in ns since 1970.
    pub(super) marks: Vec<(u64, Place)>,
    /// Bytes of a file from one place to the next.
    pub(super) piece: u64,
}

#[derive(Debug)]
pub(super) struct Part {
    pub(super) path: PathBuf,
    /// Records of the summary that say what the messages are: operation codes and contents.
    pub(super) descriptions: Vec<(u8, Vec<u8>)>,
}

impl Places {
    /// The latest time in the capture, in ns since 1970, as its places say; 0 of an empty one.
    #[must_use]
    pub fn latest(&self) -> u64 {
        self.marks.last().map_or(0, |(latest, _)| *latest)
    }

    /// The last place that has nothing of this time or later before it.
    #[must_use]
    pub fn before(&self, nanos: u64) -> Place {
        let at = self.marks.partition_point(|(latest, _)| *latest < nanos);
        self.marks.get(at).or_else(|| self.marks.last()).map(|(_, place)| *place).unwrap_or_default()
    }

    pub(super) fn path(&self, part: usize) -> Option<&Path> {
        self.parts.get(part).map(|part| part.path.as_path())
    }

    /// The parts behind one.
    pub(super) fn behind(&self, part: usize) -> impl Iterator<Item = &PathBuf> {
        self.parts.iter().skip(part + 1).map(|part| &part.path)
    }

    /// Says to the state of a reader what the messages of a part are.
    pub(super) fn describe(&self, part: usize, state: &mut State) -> Result<(), Fault> {
        for (opcode, body) in self.parts.get(part).into_iter().flat_map(|part| &part.descriptions) {
            state.take(*opcode, body, false)?;
        }
        Ok(())
    }
}
