//! What has to hold of the cells before a comparison with a recording means anything.

use std::collections::{BTreeMap, BTreeSet};

use protocol::id::CellId;
use protocol::message::State;

use super::Options;
use super::comparator::Comparator;
use super::error::Mismatch;
use super::start::Routes;
use super::survey::{Bus, Cell, Known, Survey};
use crate::setup::names;

/// What is replayed, and what has to hold of the cells.
#[derive(Debug)]
pub(super) struct Checks {
    pub(super) options: Options,
    pub(super) survey: Survey,
    pub(super) routes: Routes,
    /// What the capture is called.
    pub(super) name: String,
}

impl Checks {
    /// The present name of a bus.
    pub(super) fn bus_link(&self, bus_link: usize) -> &str {
        self.routes.names.get(bus_link).map_or("", |(_, name)| name)
    }

    /// The name of each bus, and the bus in the capture.
    pub(super) fn bus_links(&self) -> impl Iterator<Item = (&str, &Bus)> {
        let buses = &self.survey.buses;
        self.routes.names.iter().filter_map(|(bus, name)| Some((name.as_str(), buses.get(*bus)?)))
    }

    /// The cells that a bus of the recording has in the part that is replayed.
    fn cells<'a>(&self, bus: &'a Bus) -> impl Iterator<Item = (CellId, &'a Cell)> + use<'a> {
        bus.cells_in(self.survey.bounds())
    }

    /// The same, by bus.
    pub(super) fn recorded(&self) -> Vec<BTreeSet<CellId>> {
        self.bus_links().map(|(_, bus)| self.cells(bus).map(|(cell, _)| cell).collect()).collect()
    }

    /// Whether the state where the replay begins needs new parameters: then cells have their recorded configuration
    /// only after that state is restored.
    pub(super) fn configures(&self) -> bool {
        self.bus_links().any(|(_, bus)| bus.state.configures())
    }

    /// Whether cells that were just started are in the state in which the replay begins.
    pub(super) fn are_fresh(&self) -> bool {
        self.options.spawn.is_some() && self.bus_links().all(|(_, bus)| bus.state.is_fresh())
    }

    /// Cells whose configuration in the recording is not known.
    pub(super) fn unchecked(&self) -> u64 {
        let unknown = |bus| self.cells(bus).filter(|(_, cell)| hash(cell).is_none()).count() as u64;
        self.bus_links().map(|(_, bus)| unknown(bus)).sum()
    }

    /// The cells have to be there, with the configuration that they had.
    pub(super) fn hashes(&self, comparator: &Comparator) -> Result<(), Mismatch> {
        if self.options.expect.is_none() {
            return Ok(());
        }
        let (mut absent, mut other) = (Vec::new(), Vec::new());
        let (mut equal, mut others, mut count) = (0_usize, 0_usize, 0_usize);
        for (bus_link, (name, bus)) in self.bus_links().enumerate() {
            let there: BTreeMap<_, _> = comparator
                .settled(bus_link)
                .filter_map(|(cell, present)| Some((cell, present.claim.heartbeat()?.configuration)))
                .collect();
            let (mut missing, mut differing) = (Vec::new(), Vec::new());
            for (cell, recorded) in self.cells(bus) {
                count += 1;
                match (hash(recorded), there.get(&cell)) {
                    (_, None) => missing.push(cell),
                    (Some(then), Some(&now)) if then != now => {
                        differing.push(format!("{cell} (recorded {then:04X}, now {now:04X})"));
                    }
                    (then, Some(_)) => equal += usize::from(then.is_some()),
                }
            }
            if !missing.is_empty() {
                absent.push(format!("{} on {name}", names(&missing, "")));
            }
            if !differing.is_empty() {
                others += differing.len();
                let more = if differing.len() > 4 { ", ..." } else { "" };
                differing.truncate(4);
                other.push(format!("{}{more} on {name}", differing.join(", ")));
            }
        }
        let (cells, spawned) = (other.join("; "), self.options.spawn.is_some());
        if count > 0 && others == count {
            return Err(Mismatch::Skin { count, cells, spawned });
        }
        if others > 0 {
            return Err(Mismatch::Cells { cells, spawned });
        }
        if !absent.is_empty() {
            return Err(Mismatch::Absent(absent.join("; ")));
        }
        if equal == 0 { Err(Mismatch::Unknown) } else { Ok(()) }
    }

    /// The cells on each bus that measure, though in the recording they obeyed stimuli.
    pub(super) fn measuring(&self, comparator: &Comparator) -> Vec<Vec<CellId>> {
        let measures = |(bus_link, (_, bus)): (usize, (&str, &Bus))| {
            let obeyed = |cell: &CellId| bus.cells.get(cell).is_some_and(|cell| !cell.measured);
            let now =
                comparator.settled(bus_link).filter(|(_, present)| !present.claim.says(State::TEST_MODE));
            now.map(|(cell, _)| cell).filter(obeyed).collect()
        };
        self.bus_links().enumerate().map(measures).collect()
    }
}

/// The hash of a cell's configuration in the recording, if it is known.
const fn hash(cell: &Cell) -> Option<u16> {
    if let Known::Yes(hash) = cell.hash { Some(hash) } else { None }
}
