//! What has to hold of the cells before a comparison with a recording means anything.

use std::collections::{BTreeMap, BTreeSet};

use protocol::id::CellId;
use protocol::message::State;
use thiserror::Error;

use super::judge::Judge;
use super::start::Routes;
use super::survey::{Bus, Known, Survey};
use crate::setup::names;

/// Cells that are not as they were in the recording.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
pub enum Mismatch {
    /// All of them.
    #[error(
        "the recording is of another skin: all {count} cells have another configuration than then, {cells}; {}",
        remedy(*.spawned)
    )]
    Skin {
        /// How many there are.
        count: usize,
        /// Which, with their configurations.
        cells: String,
        /// Whether they were started here.
        spawned: bool,
    },
    /// Some.
    #[error("cells have another configuration than in the recording: {cells}; {}", remedy(*.spawned))]
    Cells {
        /// Which, with their configurations.
        cells: String,
        /// Whether they were started here.
        spawned: bool,
    },
    /// Some are not there.
    #[error("cells of the recording are absent: {0}; start them with cell-node, or all with --spawn")]
    Absent(String),
    /// Nobody knows.
    #[error(
        "nothing can be compared: the recording has no heartbeat of a cell, so nothing says of which skin it is; record \
         for half a second at least"
    )]
    Unknown,
}

fn remedy(spawned: bool) -> &'static str {
    if spawned {
        "name the recording's skin with --skin"
    } else {
        "configure them for the recording's skin, or start them from it with --spawn"
    }
}

/// What has to hold of the cells.
#[derive(Debug)]
pub(super) struct Checks {
    pub(super) survey: Survey,
    pub(super) routes: Routes,
    /// Whether replies are compared.
    pub(super) expects: bool,
    /// Whether cells were started here.
    pub(super) spawned: bool,
    /// What the capture is called.
    pub(super) name: String,
}

impl Checks {
    /// What a lane is called now.
    pub(super) fn lane(&self, lane: usize) -> &str {
        self.routes.names.get(lane).map_or("", |(_, name)| name)
    }

    /// Each lane's name and its bus in the capture.
    pub(super) fn lanes(&self) -> impl Iterator<Item = (&str, Option<&Bus>)> {
        self.routes.names.iter().map(|(bus, name)| (name.as_str(), self.survey.buses.get(*bus)))
    }

    /// The cells that the recording has in the part that is replayed, by lane.
    pub(super) fn recorded(&self) -> Vec<BTreeSet<CellId>> {
        let bounds = self.survey.bounds();
        let cells = |bus: &Bus| bus.cells_in(bounds).map(|(cell, _)| cell).collect();
        self.lanes().map(|(_, bus)| bus.map(cells).unwrap_or_default()).collect()
    }

    /// Whether the state in force where the replay begins has to be brought about with new parameters: then cells
    /// have them only after that.
    pub(super) fn configures(&self) -> bool {
        self.lanes().any(|(_, bus)| bus.is_some_and(|bus| bus.state.configures()))
    }

    /// Whether cells that were just started are in the state in which the replay begins.
    pub(super) fn are_fresh(&self) -> bool {
        self.spawned && self.lanes().all(|(_, bus)| bus.is_none_or(|bus| bus.state.is_fresh()))
    }

    /// Cells whose configuration in the recording is not known.
    pub(super) fn unchecked(&self) -> u64 {
        let recorded = self.recorded();
        let unknown = |(bus, cells): (Option<&Bus>, &BTreeSet<CellId>)| {
            cells.iter().filter(|cell| hash(bus, cell).is_none()).count() as u64
        };
        self.lanes().map(|(_, bus)| bus).zip(&recorded).map(unknown).sum()
    }

    /// The cells have to be there, with the configuration that they had.
    pub(super) fn hashes(&self, judge: &Judge) -> Result<(), Mismatch> {
        if !self.expects {
            return Ok(());
        }
        let (mut absent, mut other) = (Vec::new(), Vec::new());
        let (mut checked, mut others, mut count) = (0_usize, 0_usize, 0_usize);
        for (lane, ((name, bus), cells)) in self.lanes().zip(self.recorded()).enumerate() {
            let there = judge.present(lane).filter(|(_, present)| present.claim.is_settled());
            let there: BTreeMap<_, _> = there
                .filter_map(|(cell, present)| Some((cell, present.claim.heartbeat()?.configuration)))
                .collect();
            let missing: Vec<_> = cells.iter().copied().filter(|cell| !there.contains_key(cell)).collect();
            if !missing.is_empty() {
                absent.push(format!("{} on {name}", names(&missing, "")));
            }
            count += cells.len();
            let known = cells.iter().filter_map(|cell| Some((cell, hash(bus, cell)?, *there.get(cell)?)));
            let (same, differing): (Vec<_>, Vec<_>) = known.partition(|(_, then, now)| then == now);
            checked += same.len() + differing.len();
            others += differing.len();
            let told = differing
                .iter()
                .take(4)
                .map(|(cell, then, now)| format!("{cell} (recorded {then:04X}, now {now:04X})"));
            let more = if differing.len() > 4 { ", ..." } else { "" };
            if !differing.is_empty() {
                other.push(format!("{}{more} on {name}", told.collect::<Vec<_>>().join(", ")));
            }
        }
        let (cells, spawned) = (other.join("; "), self.spawned);
        if count > 0 && others == count {
            return Err(Mismatch::Skin { count, cells, spawned });
        }
        if others > 0 {
            return Err(Mismatch::Cells { cells, spawned });
        }
        if !absent.is_empty() {
            return Err(Mismatch::Absent(absent.join("; ")));
        }
        if checked == 0 { Err(Mismatch::Unknown) } else { Ok(()) }
    }

    /// The cells on each lane that measure, though in the recording they obeyed stimuli.
    pub(super) fn measuring(&self, judge: &Judge) -> Vec<Vec<CellId>> {
        let measures = |(lane, (_, bus)): (usize, (&str, Option<&Bus>))| {
            let obeyed =
                |cell: &CellId| bus.and_then(|bus| bus.cells.get(cell)).is_some_and(|cell| !cell.measured);
            let now = judge
                .present(lane)
                .filter(|(_, present)| present.claim.is_settled() && !present.claim.says(State::TEST_MODE));
            now.map(|(cell, _)| cell).filter(obeyed).collect()
        };
        self.lanes().enumerate().map(measures).collect()
    }
}

/// The hash of a cell's configuration in the recording, if it is known.
fn hash(bus: Option<&Bus>, cell: &CellId) -> Option<u16> {
    match bus?.cells.get(cell)?.hash {
        Known::Yes(hash) => Some(hash),
        Known::No | Known::TooLate => None,
    }
}
