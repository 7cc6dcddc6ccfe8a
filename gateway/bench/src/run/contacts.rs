//! Contact state of cells that were running before this run. They may hold stimuli that were sent before this run
//! received on their bus.

use std::time::Duration;

use protocol::id::{CellId, Node};
use protocol::parameters::Parameter;
use protocol::usage::eprint_line;

use super::begin::DISCOVERY_TIMEOUT;
use super::bench::Bench;
use super::watch::ScenarioProgress;
use crate::error::RunError;
use crate::view::CellView;

/// Time that cells have to report their counters and to clear their contact state; they need some milliseconds.
const REPORT_TIMEOUT: Duration = Duration::from_millis(500);
/// Value of the mode in which cells obey stimuli.
const TEST_MODE_WORD: i16 = 1;

impl Bench<'_> {
    /// Waits briefly until the contact state of all cells in test mode is known; their counters show whether they have
    /// received stimuli before. If the scenario touches the skin, clears the contact state of the cells.
    pub(super) fn settle_contact_states(&mut self, script: &mut ScenarioProgress) -> Result<(), RunError> {
        let unreported = |cell: &CellView| cell.unclear && !cell.responded.counters;
        self.poll_until(REPORT_TIMEOUT, |bench, timeout| {
            Ok(bench.count_cells(unreported) == 0 || timeout.has_stalled(0))
        })?;
        if script.touches.touched_cells().next().is_some() {
            self.poll_until(DISCOVERY_TIMEOUT, |bench, timeout| {
                bench.clear_contacts(script)?;
                Ok(bench.count_cells(|cell| cell.unclear) == 0 || timeout.has_stalled(0))
            })?;
        }
        let unclear = self.selected_cell_names(|cell| cell.unclear);
        if !unclear.is_empty() && !self.options.quiet {
            eprint_line(&format!(
                "it is unknown whether these cells are in contact, so their torques are not compared: {unclear}; they \
                 received stimuli before this run (`skinbus frame configure --cell N --write mode 1` resets a cell)"
            ));
        }
        Ok(())
    }

    /// Clears the contact state of cells in test mode that may have received stimuli from others, or may have missed
    /// some of this run, and sends them the scenario's stimuli. Does nothing if the scenario does not touch the skin.
    pub(super) fn clear_contacts(&self, script: &mut ScenarioProgress) -> Result<(), RunError> {
        if script.touches.touched_cells().next().is_none() {
            return Ok(());
        }
        let unclear = self.cells_with_unknown_contact();
        let due = script.cleared.due_requests(self.now(), unclear);
        for &(bus, cell) in &due {
            let Some(bus_link) = self.bus_links.get(bus) else { continue };
            let mode = core::array::from_fn(|place| if place == 0 { TEST_MODE_WORD } else { 0 });
            bus_link.send_switch(Node::Cell(cell), (Parameter::Mode.number(), mode))?;
        }
        if due.is_empty() || script.has_sent_no_stimulus() {
            return Ok(());
        }
        self.resend_stimuli(script, |it| due.contains(&(it.bus, it.node)))
    }

    /// Returns the cells on working buses that may hold stimuli which this run has not received.
    fn cells_with_unknown_contact(&self) -> Vec<(usize, CellId)> {
        let mut unclear = Vec::new();
        for (bus, bus_link) in
            self.bus_links.iter().enumerate().filter(|(_, bus_link)| bus_link.link.state.is_working())
        {
            let Ok(view) = bus_link.view.lock() else { continue };
            // Check the flag first: cells are rarely unclear, and this would visit thousands of cells a hundred times a
            // second.
            let cells = view.cells.iter().filter(|cell| view.unclear && cell.unclear);
            unclear.extend(cells.map(|cell| (bus, cell.node)));
        }
        unclear
    }
}
