//! Checks that the cells on the buses match a recording before their replies are compared with it.

use std::collections::{BTreeMap, BTreeSet};

use protocol::id::CellId;
use protocol::message::State;

use super::ReplayOptions;
use super::comparator::Comparator;
use super::error::CellMismatch;
use super::start::BusRoutes;
use super::survey::{InitialValue, Survey, SurveyedBus, SurveyedCell};
use crate::setup::format_cells;

/// Checks of the cells before a replay: the options, the survey of the capture and the routes of its buses.
#[derive(Debug)]
pub(super) struct CellChecks {
    pub(super) options: ReplayOptions,
    pub(super) survey: Survey,
    pub(super) routes: BusRoutes,
    /// Display name of the capture.
    pub(super) name: String,
}

impl CellChecks {
    /// Returns the name that a bus has in this replay.
    pub(super) fn bus_name(&self, bus_link: usize) -> &str {
        self.routes.names.get(bus_link).map_or("", |(_, name)| name)
    }

    /// Returns the name that each bus has in this replay, and the survey of the recorded bus.
    pub(super) fn named_buses(&self) -> impl Iterator<Item = (&str, &SurveyedBus)> {
        let buses = &self.survey.buses;
        self.routes.names.iter().filter_map(|(bus, name)| Some((name.as_str(), buses.get(*bus)?)))
    }

    /// Returns the cells that sent on a bus in the replayed part of the recording.
    fn cells<'a>(&self, bus: &'a SurveyedBus) -> impl Iterator<Item = (CellId, &'a SurveyedCell)> + use<'a> {
        bus.cells_active_in(self.survey.part_bounds_ns())
    }

    /// Returns the cells that sent on each bus in the replayed part of the recording.
    pub(super) fn recorded_cells(&self) -> Vec<BTreeSet<CellId>> {
        self.named_buses().map(|(_, bus)| self.cells(bus).map(|(cell, _)| cell).collect()).collect()
    }

    /// Returns true if the replay begins with a state that includes parameters. The cells then have their recorded
    /// configuration only after that state is restored.
    pub(super) fn needs_parameters(&self) -> bool {
        self.named_buses().any(|(_, bus)| bus.state.has_commit())
    }

    /// Returns true if newly started cells are already in the state in which the replay begins.
    pub(super) fn are_cells_fresh(&self) -> bool {
        self.options.spawn.is_some() && self.named_buses().all(|(_, bus)| bus.state.is_start_state())
    }

    /// Returns the number of cells whose recorded configuration is unknown.
    pub(super) fn unknown_hash_count(&self) -> u64 {
        let unknown = |bus| self.cells(bus).filter(|(_, cell)| recorded_hash(cell).is_none()).count() as u64;
        self.named_buses().map(|(_, bus)| unknown(bus)).sum()
    }

    /// Checks that the cells are present with their recorded configuration.
    pub(super) fn check_hashes(&self, comparator: &Comparator) -> Result<(), CellMismatch> {
        if self.options.expect.is_none() {
            return Ok(());
        }
        let (mut absent, mut other) = (Vec::new(), Vec::new());
        let (mut equal, mut others, mut count) = (0_usize, 0_usize, 0_usize);
        for (bus_link, (name, bus)) in self.named_buses().enumerate() {
            let there: BTreeMap<_, _> = comparator
                .settled_cells(bus_link)
                .filter_map(|(cell, present)| Some((cell, present.claim.heartbeat()?.configuration)))
                .collect();
            let (mut missing, mut differing) = (Vec::new(), Vec::new());
            for (cell, recorded) in self.cells(bus) {
                count += 1;
                match (recorded_hash(recorded), there.get(&cell)) {
                    (_, None) => missing.push(cell),
                    (Some(then), Some(&now)) if then != now => {
                        differing.push(format!("{cell} (recorded {then:04X}, now {now:04X})"));
                    }
                    (then, Some(_)) => equal += usize::from(then.is_some()),
                }
            }
            if !missing.is_empty() {
                absent.push(format!("{} on {name}", format_cells(&missing, "")));
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
            return Err(CellMismatch::Skin { count, cells, spawned });
        }
        if others > 0 {
            return Err(CellMismatch::Cells { cells, spawned });
        }
        if !absent.is_empty() {
            return Err(CellMismatch::Absent(absent.join("; ")));
        }
        if equal == 0 { Err(CellMismatch::Unknown) } else { Ok(()) }
    }

    /// Returns the cells of each bus that measure now, although they obeyed stimuli in the recording.
    pub(super) fn measuring_cells(&self, comparator: &Comparator) -> Vec<Vec<CellId>> {
        let measures = |(bus_link, (_, bus)): (usize, (&str, &SurveyedBus))| {
            let obeyed = |cell: &CellId| bus.cells.get(cell).is_some_and(|cell| !cell.measured);
            let now = comparator
                .settled_cells(bus_link)
                .filter(|(_, present)| !present.claim.has_state(State::TEST_MODE));
            now.map(|(cell, _)| cell).filter(obeyed).collect()
        };
        self.named_buses().enumerate().map(measures).collect()
    }
}

/// Returns the hash of a cell's recorded configuration, if known.
const fn recorded_hash(cell: &SurveyedCell) -> Option<u16> {
    if let InitialValue::Value(hash) = cell.hash { Some(hash) } else { None }
}
