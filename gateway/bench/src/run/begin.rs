//! Start of a run up to the first tick: starts the cells, checks that no other gateway is on their buses, and waits
//! until all cells are ready, switched and in a tree.

use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::KindChoices;
use protocol::id::{CellId, Node};
use protocol::message::Message;
use protocol::packet::Epoch;
use protocol::parameters::{Parameter, Sensing};
use protocol::sine::SineMethod;
use protocol::time::Span;
use protocol::usage::eprint_line;

use super::bench::{Bench, POLL_INTERVAL};
use super::receiver::BusEvent;
use crate::error::RunError;
use crate::processes::{CellLaunch, GATEWAY_DETECTION_TIME, START_TIMEOUT, program_path};
use crate::setup::{Timeout, format_cells};
use crate::view::BusView;
use model::repeat::RepeatedRequests;
use model::table::{Notice, SwitchTarget};

/// Time within which running cells must send a heartbeat, and all cells must confirm their switches.
pub(super) const DISCOVERY_TIMEOUT: Duration = Duration::from_secs(2);
/// Interval after which switches are sent again to a cell that does not confirm them.
pub(super) const SWITCH_RETRY_INTERVAL: Span = Span::from_millis(250);

/// Cells, by bus and node id, to which switches were sent, with the times.
pub(super) type SentSwitchRequests = RepeatedRequests<(usize, CellId)>;

impl Bench<'_> {
    /// Starts the cells, listens for another gateway, and waits until all cells are ready.
    pub(super) fn bring_up_cells(&mut self) -> Result<(), RunError> {
        let options = self.options;
        let listened = Instant::now() + GATEWAY_DETECTION_TIME;
        if options.spawn {
            if self.served.len() < self.bus_links.len() {
                self.check_for_other_senders(listened)?;
            }
            let program = program_path("cell-node")?;
            self.processes.start(&CellLaunch {
                program: &program,
                skin_file: &options.skin_file,
                skin: &options.skin,
                kinds: &KindChoices::from_kinds(
                    self.bus_links.iter().map(|bus_link| (bus_link.link.name.as_str(), bus_link.link.kind)),
                ),
                directory: options.directory.as_deref(),
                per_process: options.cells_per_process,
                flash: options.flash.as_deref(),
                sine: SineMethod::default(),
            })?;
        }
        let cells = options.skin.cells.len();
        self.poll_until(self.progress_timeout(), |bench, timeout| {
            // Cells without parameters will not become ready.
            let ready = bench.count_cells(|cell| cell.ready || cell.unconfigured);
            let is_over = timeout.has_stalled(ready);
            // After a moment without processor time, ready cells may count as dead until they send again.
            Ok(Instant::now() >= listened && (ready == cells || is_over))
        })?;
        self.check_cells()?;
        self.resume_halted_cells()?;
        self.continue_former_epochs();
        self.send_cell_switches()?;
        // Requests the counters, contact states and network positions of the cells.
        self.send_to_all(&Message::Report)?;
        if self.bus_links.iter().any(|bus_link| bus_link.network.is_some()) {
            self.organise_trees()
        } else {
            Ok(())
        }
    }

    /// Prints the lines that the options give for the start of the loop.
    pub(super) fn print_announcements(&self) {
        if self.options.quiet {
            return;
        }
        self.options.announced.iter().for_each(|line| eprint_line(line));
        if let Some(log) = &self.log {
            eprint_line(&format!("frames are recorded in {}", log.display()));
        }
    }

    /// Returns the maximum time without progress of the cells.
    pub(super) const fn progress_timeout(&self) -> Duration {
        if self.options.spawn { START_TIMEOUT } else { DISCOVERY_TIMEOUT }
    }

    /// Polls until the check returns true.
    pub(super) fn poll_until(
        &mut self,
        timeout: Duration,
        mut is_last: impl FnMut(&mut Self, &mut Timeout) -> Result<bool, RunError>,
    ) -> Result<(), RunError> {
        let mut timeout = Timeout::new(timeout);
        while !is_last(self, &mut timeout)? {
            thread::sleep(POLL_INTERVAL);
            self.check_for_failures()?;
        }
        Ok(())
    }

    /// Resumes cells that an earlier gateway has halted.
    fn resume_halted_cells(&mut self) -> Result<(), RunError> {
        self.send_to_all(&Message::Resume)?;
        let halted = |bench: &Self| bench.count_cells(|cell| cell.halted);
        if halted(self) == 0 {
            return Ok(());
        }
        // The next heartbeats show the state of the cells.
        self.send_to_all(&Message::Sync)?;
        self.poll_until(DISCOVERY_TIMEOUT, |bench, timeout| Ok(halted(bench) == 0 || timeout.has_stalled(0)))
    }

    /// Checks that a bus that existed before has neither a gateway nor cells with the same node ids. Listening disturbs
    /// neither of them.
    fn check_for_other_senders(&mut self, until: Instant) -> Result<(), RunError> {
        self.poll_until(GATEWAY_DETECTION_TIME, |_, _| Ok(Instant::now() >= until))?;
        // Emulated cells are present already, and belong to this run.
        let others = self.bus_links.iter().enumerate().filter_map(|(bus, bus_link)| {
            let view = bus_link.view.lock().ok()?;
            let heard = view.cells.iter().filter(|cell| cell.seen).map(|cell| cell.node);
            let others: Vec<_> = heard.filter(|node| !self.processes.has_process(bus, node.get())).collect();
            (!others.is_empty()).then(|| format_cells(&others, &format!(" on {}", bus_link.link.name)))
        });
        let cells = others.collect::<Vec<_>>().join("; ");
        if cells.is_empty() {
            return Ok(());
        }
        let embedded = self.bus_links.iter().any(|bus_link| !bus_link.link.kind.is_interface());
        Err(RunError::CellsPresent { cells, embedded })
    }

    /// Sets the first epoch to follow those of a former gateway, because cells that were running before have received
    /// its joints.
    fn continue_former_epochs(&mut self) {
        if self.options.spawn {
            return;
        }
        let heard = |view: &BusView| -> Vec<_> {
            view.cells.iter().filter(|cell| cell.ready).map(|cell| cell.last_joints).collect()
        };
        let last =
            epoch_before_start(&self.bus_views().flat_map(|(_, view)| heard(&view)).collect::<Vec<_>>());
        self.first_epoch = last.next();
        if let Some(cycle) = &mut self.cycle {
            cycle.start_after_epoch(last);
        }
    }

    fn check_cells(&self) -> Result<(), RunError> {
        let spawned = self.options.spawn;
        let silent = self.selected_cell_names(|cell| !cell.ready && !cell.unconfigured);
        let unconfigured = self.selected_cell_names(|cell| cell.unconfigured);
        let none = self.count_cells(|cell| cell.ready) == 0;
        if !unconfigured.is_empty() && (none || spawned) {
            return Err(RunError::Unconfigured(unconfigured));
        }
        if none || (spawned && !silent.is_empty()) {
            return Err(RunError::NotReady { cells: silent, spawned });
        }
        let cells = self.selected_cell_names(|cell| cell.ready && cell.other_configuration);
        if !cells.is_empty() {
            return Err(RunError::OtherSkin { skin: self.options.skin_file.clone(), cells });
        }
        let measuring = self.selected_cell_names(|cell| cell.measures);
        for (what, who) in [
            ("do not answer, so the run continues without them", silent),
            ("have no parameters, so the run continues without them", unconfigured),
            (
                "use their own sensors, so the scenario does not press them (`skinbus frame configure --cell N --write \
                 mode 1` puts one into test mode)",
                measuring,
            ),
        ] {
            if !who.is_empty() && !self.options.quiet {
                eprint_line(&format!("these cells {what}: {who}"));
            }
        }
        Ok(())
    }

    /// Handles events while the bench starts. Returns an error if another gateway is found, a process ended, or a bus
    /// was lost.
    fn check_for_failures(&mut self) -> Result<(), RunError> {
        if self.signalled.load(Ordering::Relaxed) {
            return Err(RunError::Interrupted);
        }
        for (bus, bus_event) in self.events.try_iter() {
            match bus_event {
                BusEvent::Notice(Notice::OtherGateway) => return Err(self.other_gateway_error(bus)),
                BusEvent::Down(why) | BusEvent::Lost(why) | BusEvent::Refused(why) => {
                    return Err(RunError::Lost(why));
                }
                BusEvent::Notice(_) | BusEvent::Up => {}
            }
        }
        match self.processes.take_ended().into_iter().next() {
            None => Ok(()),
            Some(ended) => {
                Err(RunError::Ended { cells: ended.to_string(), status: ended.status, said: ended.reason })
            }
        }
    }

    /// Returns the error of another gateway on a bus.
    pub(super) fn other_gateway_error(&self, bus: usize) -> RunError {
        let link = self.bus_links.get(bus).map(|bus_link| &bus_link.link);
        RunError::OtherGateway(link.map(|link| (link.name.clone(), link.kind)))
    }

    /// Sends a command on all buses.
    pub(super) fn send_to_all(&self, message: &Message) -> Result<(), RunError> {
        for bus_link in &self.bus_links {
            if bus_link.send(message)? {
                bus_link.link.state.commands.fetch_add(1, Ordering::Relaxed);
            }
        }
        Ok(())
    }

    /// Sends all cells, before the first joints, the switches that a cell loses when it restarts.
    fn send_cell_switches(&mut self) -> Result<(), RunError> {
        let mut announced = SentSwitchRequests::new(SWITCH_RETRY_INTERVAL);
        let lacking = self.unconfirmed_switches();
        for (bus, (bus_link, described)) in self.bus_links.iter().zip(&self.options.skin.buses).enumerate() {
            // Cells that ran before may be in any mode; newly started cells are in the default mode.
            let off = (!self.options.spawn && described.sensing == Sensing::Off)
                .then(|| (Parameter::Sensing.number(), Sensing::Off.words()));
            let first = lacking.iter().find(|((of, _), _)| *of == bus).map(|(_, switches)| switches.clone());
            for switch in off.into_iter().chain(first.unwrap_or_default()) {
                bus_link.send_switch(Node::Everyone, switch)?;
            }
        }
        announced.mark_all_sent(self.now());
        self.poll_until(DISCOVERY_TIMEOUT, |bench, timeout| {
            bench.resend_cell_switches(&mut announced)?;
            // Cells that have not confirmed by then get their switches again while the loop runs.
            Ok(bench.unconfirmed_switches().is_empty() || timeout.has_stalled(0))
        })
    }

    /// Sends switches again to cells that have not confirmed them in time, because the cell restarted or a message was
    /// lost.
    pub(super) fn resend_cell_switches(&self, announced: &mut SentSwitchRequests) -> Result<(), RunError> {
        let lacking = self.unconfirmed_switches();
        let due = announced.due_requests(self.now(), lacking.iter().map(|(cell, _)| *cell));
        for ((bus, cell), switches) in lacking.into_iter().filter(|(cell, _)| due.contains(cell)) {
            let Some(bus_link) = self.bus_links.get(bus) else { continue };
            for switch in switches {
                bus_link.send_switch(Node::Cell(cell), switch)?;
            }
        }
        Ok(())
    }

    /// Returns the reachable cells with unconfirmed switches, and those switches.
    fn unconfirmed_switches(&self) -> Vec<((usize, CellId), Vec<SwitchTarget>)> {
        let mut lacking = Vec::new();
        for (bus, bus_link) in
            self.bus_links.iter().enumerate().filter(|(_, bus_link)| bus_link.link.state.is_working())
        {
            let Ok(view) = bus_link.view.lock() else { continue };
            // Check the flag first: cells rarely lack a switch, and this would visit thousands of cells a hundred times
            // a second.
            for cell in view.cells.iter().filter(|cell| view.has_unconfirmed && cell.has_unconfirmed_switch())
            {
                lacking.push(((bus, cell.node), cell.unconfirmed_switches.into_iter().flatten().collect()));
            }
        }
        lacking
    }
}

/// Returns the epoch after which this run starts its own, such that no cell takes the first joints as repeated: the
/// next epoch must not be one of `taken`, the last epochs that the cells received. The search starts at the first
/// cell's epoch, because buses may have had different ones.
fn epoch_before_start(taken: &[Epoch]) -> Epoch {
    let mut last = taken.first().copied().unwrap_or_default();
    for _ in 0..u8::MAX {
        if !taken.contains(&last.next()) {
            break;
        }
        last = last.next();
    }
    last
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_epoch_is_new_to_the_cells_of_all_buses() {
        let first =
            |taken: &[u8]| epoch_before_start(&taken.iter().map(|&epoch| Epoch(epoch)).collect::<Vec<_>>()).0;
        assert_eq!(first(&[]), 0);
        assert_eq!(first(&[7, 7, 7]), 7);
        assert_eq!(first(&[7, 7, 200, 200]), 7);
        assert_eq!(first(&[255, 255, 0, 0, 1]), 1, "0 would be repeated on one bus, and 1 on another");
    }
}
