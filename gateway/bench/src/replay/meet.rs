//! Checks before the start: the cells are present, their tree is complete, and their state fits the recording.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use protocol::id::CellId;
use protocol::message::{Message, State};

use super::ReplayError;
use super::comparator::Comparator;
use super::session::ReplaySession;
use super::start::{SpawnSkin, mode_message};
use crate::error::RunError;
use crate::processes::START_TIMEOUT;
use crate::setup::{Timeout, format_cells};

/// Time within which each running cell sends at least one heartbeat.
const DISCOVERY_TIMEOUT: Duration = Duration::from_secs(1);
/// Time after which the remaining cells count as unreachable if no other cell has become reachable: two hellos and a
/// search.
const ROUTE_TIMEOUT: Duration = Duration::from_secs(2);
/// Interval between polls.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

impl ReplaySession {
    /// Queries the cells and checks that they fit the recording.
    pub(super) fn check_cells(&mut self, skin_override: Option<&SpawnSkin>) -> Result<(), ReplayError> {
        let shared_state = Arc::clone(&self.shared_state);
        let (checks, options) = (&shared_state.checks, &shared_state.checks.options);
        if !options.receives_cell_messages() {
            return Ok(());
        }
        let cells_of_bus = |skin: &protocol::skin::Skin, name: &str| -> BTreeSet<CellId> {
            let bus = skin.bus_index(name);
            bus.into_iter().flat_map(|bus| skin.cells_on_bus(bus)).map(|cell| cell.node).collect()
        };
        let required = match skin_override {
            None => checks.recorded_cells(),
            Some(skin_override) => {
                shared_state.comparator().set_units(&skin_override.skin);
                checks.named_buses().map(|(name, _)| cells_of_bus(&skin_override.skin, name)).collect()
            }
        };
        self.wait_for_cells(&required)?;
        self.wait_for_tree()?;
        let comparator = shared_state.comparator();
        let has_no_cells = (0..self.buses.bus_links.len())
            .all(|bus_link| comparator.settled_cells(bus_link).next().is_none());
        if has_no_cells && (options.expect.is_some() || options.lockstep || skin_override.is_some()) {
            let names: Vec<_> = checks.named_buses().map(|(name, _)| name).collect();
            return Err(ReplayError::NoCell(names.join(", ")));
        }
        if !checks.needs_parameters() {
            checks.check_hashes(&comparator)?;
        }
        let measuring = checks.measuring_cells(&comparator);
        drop(comparator);
        let all = measuring.concat();
        if all.is_empty() {
            return Ok(());
        }
        if options.test_mode {
            self.set_test_mode(&measuring)?;
            self.measuring = measuring;
            return Ok(());
        }
        let error = ReplayError::Measuring(format_cells(&all, ""));
        if options.expect.is_some() {
            return Err(error);
        }
        self.progress.print_note(&error.to_string());
        Ok(())
    }

    /// Polls until the check returns true.
    fn poll_until(
        &mut self,
        mut is_last: impl FnMut(&mut Self, &Comparator) -> Result<bool, ReplayError>,
    ) -> Result<(), ReplayError> {
        let shared_state = Arc::clone(&self.shared_state);
        while !is_last(self, &shared_state.comparator())? {
            thread::sleep(POLL_INTERVAL);
        }
        Ok(())
    }

    fn is_interrupted(&self) -> bool {
        self.signalled.load(Ordering::Relaxed)
    }

    /// Waits until the required cells have answered, or until no further cell answers.
    fn wait_for_cells(&mut self, required: &[BTreeSet<CellId>]) -> Result<(), ReplayError> {
        let spawned = self.buses.processes.pids().next().is_some();
        for bus_link in self.buses.bus_links.iter() {
            bus_link.send(&[Message::Sync])?;
        }
        // Cells answer at once, so that after the first pause they are known even if none is required.
        thread::sleep(POLL_INTERVAL);
        let all = required.iter().map(BTreeSet::len).sum::<usize>();
        let mut timeout = Timeout::new(if spawned { START_TIMEOUT } else { DISCOVERY_TIMEOUT });
        self.poll_until(|session, comparator| {
            if session.is_interrupted() {
                return Err(RunError::Interrupted.into());
            }
            if let Some(ended) = session.buses.processes.take_ended().into_iter().next() {
                let cells = ended.to_string();
                return Err(ReplayError::Ended { cells, status: ended.status, said: ended.reason });
            }
            if let Some(bus_link) = comparator.other_gateway_bus() {
                return Err(ReplayError::OtherGateway(
                    session.shared_state.checks.bus_name(bus_link).to_owned(),
                ));
            }
            let there = |(bus_link, cells): (usize, &BTreeSet<CellId>)| {
                comparator.settled_cells(bus_link).filter(|(cell, _)| cells.contains(cell)).count()
            };
            let there = required.iter().enumerate().map(there).sum();
            Ok(there == all || timeout.has_stalled(there))
        })
    }

    /// Waits until all cells that reply with sums have a route to the gateway, or until no further cell finds one.
    fn wait_for_tree(&mut self) -> Result<(), ReplayError> {
        for bus_link in self.buses.bus_links.iter().filter(|bus_link| bus_link.wired) {
            bus_link.send(&[Message::Report])?;
        }
        let mut timeout = Timeout::new(ROUTE_TIMEOUT);
        self.poll_until(|session, comparator| {
            let wired = session.buses.bus_links.iter().enumerate().filter(|(_, bus_link)| bus_link.wired);
            let without: Vec<_> =
                wired.map(|(index, bus_link)| (bus_link, comparator.unreachable_cells(index))).collect();
            let count: usize = without.iter().map(|(_, cells)| cells.len()).sum();
            if count == 0 || session.is_interrupted() {
                return Ok(true);
            }
            let is_over = timeout.has_stalled(usize::MAX - count);
            for (bus_link, cells) in without.iter().filter(|(_, cells)| is_over && !cells.is_empty()) {
                let (name, cells) = (bus_link.bus.name(), format_cells(cells, ""));
                session
                    .progress
                    .print_note(&format!("these cells on {name} have no route to the gateway: {cells}"));
            }
            Ok(is_over)
        })
    }

    /// Puts measuring cells into test mode.
    fn set_test_mode(&mut self, measuring: &[Vec<CellId>]) -> Result<(), ReplayError> {
        self.send_mode(measuring, true)?;
        let give_up = Instant::now() + DISCOVERY_TIMEOUT;
        self.poll_until(|_, comparator| {
            let obeys = |(bus_link, cells): (usize, &Vec<CellId>)| {
                let obeying =
                    comparator.present_cells(bus_link).filter(|(_, it)| it.claim.has_state(State::TEST_MODE));
                obeying.filter(|(cell, _)| cells.contains(cell)).count() == cells.len()
            };
            let all_obey = measuring.iter().enumerate().all(obeys);
            if !all_obey && Instant::now() > give_up {
                return Err(ReplayError::NoTestMode(format_cells(&measuring.concat(), "")));
            }
            Ok(all_obey)
        })
    }

    /// Restores the former mode of the cells.
    pub(super) fn restore_mode(&self) -> Result<(), ReplayError> {
        self.send_mode(&self.measuring, false)
    }

    /// Switches cells to test mode and reports it at once, or switches them to measuring.
    fn send_mode(&self, cells: &[Vec<CellId>], obey: bool) -> Result<(), ReplayError> {
        for (bus_link, cells) in self.buses.bus_links.iter().zip(cells).filter(|(_, cells)| !cells.is_empty())
        {
            let modes = cells.iter().map(|cell| mode_message(*cell, obey));
            bus_link.send(&modes.chain(obey.then_some(Message::Sync)).collect::<Vec<_>>())?;
        }
        Ok(())
    }
}
