//! The main thread while the loop runs. It sends stimuli ahead of their epochs, injects faults at their times, carries
//! out remote commands, and shows events and progress.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use protocol::bus::BusKind;
use protocol::can::Frame;
use protocol::id::{CellId, Node};
use protocol::message::{Message, SensorPage, StimulusStart};
use protocol::skin::Cell;
use protocol::time::Span;

use super::accelerations::{Accelerations, TickMotion};
use super::begin::{SWITCH_RETRY_INTERVAL, SentSwitchRequests};
use super::bench::Bench;
use super::commanded::start_bus_server;
use super::commander::RemoteControl;
use super::measured::LoopTotals;
use super::receiver::BusEvent;
use super::usage::{ProcessorTimes, private_memory_kib};
use crate::bus::link::BusSlot;
use crate::bus::realtime::{self, GrantedPrivileges};
use crate::error::RunError;
use crate::progress::Progress;
use crate::record::Recorder;
use crate::summary::{PrivateMemory, Summary};
use crate::threads::{ThreadError, spawn};
use control::cycle::turn::{TickDriver, TimedRecord};
use control::external::ControllerAbsence;
use model::scenario::{FaultKind, Touches};
use model::table::Notice;

/// Number of epochs by which stimuli are sent ahead of the epoch that latches them; a cell queues at most 8.
const STIMULUS_LEAD_EPOCHS: u64 = 5;
/// Interval between two rounds of the main thread.
pub(super) const MAIN_THREAD_INTERVAL: Duration = Duration::from_millis(10);
/// Queue length for the loop's records: more than a second of ticks.
const TICK_RECORD_QUEUE_LENGTH: usize = 1_024;

/// Result of the thread that runs the control loop.
struct LoopResult {
    /// Privileges that the machine granted to the thread.
    granted: GrantedPrivileges,
    /// Counts of the controller by name.
    counts: BTreeMap<String, u64>,
    /// Reason why the controller counts as absent, if it does.
    absence: Option<ControllerAbsence>,
}

/// Progress of the main thread through the faults and touches of the scenario.
pub(super) struct ScenarioProgress {
    pub(super) touches: Touches,
    accelerations: Option<Accelerations>,
    /// Next epoch whose stimuli are to be sent.
    epoch: u64,
    /// Index of the scenario's next fault.
    fault: usize,
    /// Cells to which switches were sent again, with the times.
    announced: SentSwitchRequests,
    /// Cells whose contact state was cleared, with the times.
    pub(super) cleared: SentSwitchRequests,
    /// Time at which the loop started.
    started: Instant,
}

impl ScenarioProgress {
    pub(super) const fn has_sent_no_stimulus(&self) -> bool {
        self.epoch == 0
    }
}

impl Bench<'_> {
    /// Runs the control loop to its end or to its failure, and fills in the summary.
    pub(super) fn control_loop(
        &mut self,
        summary: &mut Summary,
        measured: &mut LoopTotals,
    ) -> Result<(), RunError> {
        let options = self.options;
        let (records, mut inlet) = rtrb::RingBuffer::new(TICK_RECORD_QUEUE_LENGTH);
        let cycle = self.cycle.take().expect("the loop begins once");
        let (lines, slots) = self.bus_links.iter_mut().filter_map(|bus_link| bus_link.port.take()).unzip();
        let scenario = Arc::new(options.scenario.clone());
        let turn = TickDriver::new(cycle, lines, scenario, Arc::clone(&self.shared), records);
        let turn = turn.with_recorder(self.recorded.take());
        let touches = Touches::new(&options.scenario, &options.skin);
        let (announced, started) = (SentSwitchRequests::new(SWITCH_RETRY_INTERVAL), Instant::now());
        let accelerations = Accelerations::new(options);
        let cleared = SentSwitchRequests::new(SWITCH_RETRY_INTERVAL);
        let mut script =
            ScenarioProgress { touches, accelerations, epoch: 0, fault: 0, announced, cleared, started };
        self.settle_contact_states(&mut script)?;
        self.send_stimuli(&mut script, None)?;

        let before = ProcessorTimes::measure(&self.processes, &self.served);
        script.started = Instant::now();
        let control = self.start_loop(turn, slots)?;
        let mut progress = Progress::new(options.quiet);
        let mut failure = None;
        while !control.is_finished() {
            thread::sleep(MAIN_THREAD_INTERVAL);
            summary.interrupted = self.signalled.load(Ordering::Relaxed);
            failure = self.run_round(&mut script, &mut progress, measured, &mut inlet).err();
            if failure.is_some() || summary.interrupted || self.is_end_requested {
                self.shared.stop_loop.store(true, Ordering::Relaxed);
            }
            if failure.is_some() {
                break;
            }
        }
        let ended = control.join();
        summary.duration_s = script.started.elapsed().as_secs_f64();
        progress.clear_line();
        measured.add_records(&mut inlet, self.began);
        summary.processor =
            ProcessorTimes::measure(&self.processes, &self.served).cores_since(&before, summary.duration_s);
        let of_buses = self.served.iter().filter_map(|bus| private_memory_kib(bus.pid()));
        summary.memory = PrivateMemory {
            cell_private_kib: self.processes.pids().filter_map(private_memory_kib).max(),
            gateway_private_kib: private_memory_kib(std::process::id()),
            buses_private_kib: of_buses.reduce(|all, one| all + one),
        };
        if failure.is_some() || ended.is_err() {
            // The halt is the last command that the cells get.
            let _ = self.send_to_all(&Message::Halt);
        }
        let LoopResult { granted, counts, absence } =
            ended.map_err(|_| RunError::Panicked("control loop"))?;
        let control = &mut summary.control;
        (control.fifo, control.memory_locked, control.controller) = (granted.fifo, granted.locked, counts);
        let ended = match failure {
            Some(failure) => Err(failure),
            None => {
                summary.no_controller = absence.map(|absence| absence.to_string());
                self.request_final_reports(summary.interrupted)
            }
        };
        self.note_ended_processes(&progress, true);
        ended
    }

    /// Starts the loop's thread.
    fn start_loop(
        &self,
        mut turn: TickDriver,
        mut slots: Vec<BusSlot>,
    ) -> Result<JoinHandle<LoopResult>, ThreadError> {
        let period_ns = self.options.skin.timing.tick_nanos();
        let ticks = self.options.scenario.duration.0 * 1_000 / period_ns;
        let shared = Arc::clone(&self.shared);
        spawn("control", move || {
            let granted = realtime::request_realtime();
            let send = |bus: usize, frames: &[Frame]| {
                slots.get_mut(bus).is_some_and(|slot| slot.read().try_send_all(frames))
            };
            realtime::run_ticks(&mut turn, &shared, period_ns, ticks, send);
            let counts = turn.named_counters().into_iter().filter(|(_, count)| *count > 0).collect();
            LoopResult { granted, counts, absence: turn.absence() }
        })
    }

    /// Runs all checks of the main thread once.
    fn run_round(
        &mut self,
        script: &mut ScenarioProgress,
        progress: &mut Progress,
        measured: &mut LoopTotals,
        records: &mut rtrb::Consumer<TimedRecord>,
    ) -> Result<(), RunError> {
        self.send_stimuli(script, measured.last_motion())?;
        if self
            .bus_links
            .iter()
            .any(|bus_link| bus_link.receiver.as_ref().is_some_and(JoinHandle::is_finished))
        {
            // A receiver that loses its bus keeps running. A receiver that has ended without a message would otherwise
            // go unnoticed.
            return Err(RunError::ReceiverEnded);
        }
        self.inject_faults(script, progress)?;
        self.handle_remote_commands(measured, progress);
        self.handle_events(script, progress)?;
        self.note_ended_processes(progress, false);
        self.restart_bus_servers(progress);
        self.handle_host_reports(script, progress)?;
        for note in self.watch_networks()? {
            progress.print_note(&note);
        }
        self.resend_cell_switches(&mut script.announced)?;
        self.clear_contacts(script)?;
        let was_halted = measured.halts.present_halt_reason().is_some();
        measured.add_records(records, self.began);
        match (was_halted, measured.halts.present_halt_reason()) {
            (false, Some(why)) => {
                // One bus is enough, because the loop repeats on the other buses what is received on it.
                let bus_link = self
                    .bus_links
                    .iter()
                    .find(|bus_link| bus_link.link.state.is_working())
                    .or_else(|| self.bus_links.first());
                let (bus, kind) = bus_link.map_or(("BUS", BusKind::SocketCan), |bus_link| {
                    (bus_link.link.name.as_str(), bus_link.link.kind)
                });
                let hint = format!("`skinbus frame resume --bus {bus} --bus-kind {kind}` resumes it");
                progress.print_note(&format!("the robot is halted: {why}; {hint}"));
                self.remotes.iter_mut().for_each(RemoteControl::send_state_soon);
            }
            (true, None) => {
                progress.print_note("the robot continues");
                self.remotes.iter_mut().for_each(RemoteControl::send_state_soon);
            }
            (true, Some(_)) | (false, None) => {}
        }
        for line in self.recorder.iter().flat_map(Recorder::messages) {
            progress.print_note(&line);
        }
        let lost = self.bus_links.iter().filter(|bus_link| !bus_link.link.state.is_working());
        progress.show_line(|width| {
            let lost: Vec<_> = lost.map(|bus_link| bus_link.link.name.as_str()).collect();
            let comparing = self.shared.comparing.load(Ordering::Relaxed);
            let of = (self.options.scenario.duration, &self.options.skin);
            measured.progress_text(script.started.elapsed(), of, comparing, &lost, width)
        });
        Ok(())
    }

    /// Sends the stimuli of all epochs up to [`STIMULUS_LEAD_EPOCHS`] ahead.
    fn send_stimuli(&self, script: &mut ScenarioProgress, moved: Option<TickMotion>) -> Result<(), RunError> {
        let broadcasts = self.shared.broadcasts.load(Ordering::Acquire);
        // Skipped broadcasts have no epoch, but the scenario's time continues.
        let skipped = self.shared.broadcasts_skipped.load(Ordering::Relaxed);
        let seconds = |touches: &Touches, epoch: u64| Span(touches.time_of(epoch + skipped).0).seconds();
        while script.epoch < broadcasts + STIMULUS_LEAD_EPOCHS {
            // If this thread was delayed, skip the epochs that have passed.
            let epoch = script.epoch.max(broadcasts);
            let numbered = self.first_epoch.advanced_by(epoch.to_le_bytes()[0]);
            for stimulus in script.touches.stimuli_between(script.epoch.checked_sub(1), epoch) {
                self.send_cell_stimuli(
                    (stimulus.bus, stimulus.node),
                    stimulus.pages(),
                    StimulusStart::Epoch(numbered),
                )?;
            }
            if let Some(accelerations) = &script.accelerations {
                let now = seconds(&script.touches, epoch);
                self.send_all(&accelerations.stimuli_for_future_epoch(self.options, moved, (numbered, now)))?;
            }
            script.epoch = epoch + 1;
        }
        if let Some(accelerations) = &mut script.accelerations {
            let now = seconds(&script.touches, broadcasts);
            self.send_all(&accelerations.latest_stimuli(self.options, moved, (broadcasts, now)))?;
        }
        Ok(())
    }

    /// Sends messages, each on its bus.
    fn send_all(&self, messages: &[(usize, Message)]) -> Result<(), RunError> {
        for (bus, message) in messages {
            self.bus_links.get(*bus).map_or(Ok(true), |bus_link| bus_link.send(message))?;
        }
        Ok(())
    }

    /// Resends the scenario's stimuli to the selected cells. Does not change stimuli from other senders.
    pub(super) fn resend_stimuli(
        &self,
        script: &ScenarioProgress,
        selects: impl Fn(&Cell) -> bool,
    ) -> Result<(), RunError> {
        let touched = script
            .touches
            .touched_cells()
            .filter_map(|place| Some((place, self.options.skin.cells.get(place)?)));
        for (cell, &Cell { bus, node, .. }) in touched.filter(|(_, cell)| selects(cell)) {
            let pages = script.touches.pages(cell, script.epoch.saturating_sub(1));
            self.send_cell_stimuli((bus, node), pages, StimulusStart::Next)?;
        }
        Ok(())
    }

    fn send_cell_stimuli(
        &self,
        (bus, node): (usize, CellId),
        pages: impl Iterator<Item = SensorPage>,
        from: StimulusStart,
    ) -> Result<(), RunError> {
        let to = Node::Cell(node);
        let messages: Vec<_> = pages.map(|page| (bus, Message::Stimulus { to, from, page })).collect();
        // The cells' contact state follows the frames that the bus carried.
        self.send_all(&messages)
    }

    /// Injects the scenario's process faults at their times.
    fn inject_faults(&mut self, script: &mut ScenarioProgress, progress: &Progress) -> Result<(), RunError> {
        let options = self.options;
        while let Some(fault) = options.scenario.faults.get(script.fault) {
            if u128::from(fault.at.0) > script.started.elapsed().as_micros() {
                break;
            }
            script.fault += 1;
            if let FaultKind::Wire { link_down, from, to, both_ways } = fault.kind {
                self.switch_cell_links(link_down, (from, to), both_ways, progress);
            }
            let FaultKind::Process { action, cells } = &fault.kind else { continue };
            for cell in cells.iter().filter_map(|&cell| options.skin.cells.get(cell)) {
                let done = self.processes.apply_action(cell.bus, cell.node.get(), *action)?;
                let bus = self.bus_name(cell.bus);
                let failed = if done { "" } else { ", ignored because this run did not start its process" };
                progress.print_note(&format!("scenario: {action:?} cell {} on {bus}{failed}", cell.node));
            }
        }
        Ok(())
    }

    /// Takes the links between two cells down, or brings them up again. The next check of the cells' network sends the
    /// change to the cells.
    fn switch_cell_links(
        &mut self,
        link_down: bool,
        (from, to): (usize, usize),
        both_ways: bool,
        progress: &Progress,
    ) {
        let cells = &self.options.skin.cells;
        let (Some(from), Some(to)) = (cells.get(from), cells.get(to)) else { return };
        let network = self.bus_links.get_mut(from.bus).and_then(|bus_link| bus_link.network.as_mut());
        let Some(network) = network else { return };
        network.set_link_down(link_down, from.node, to.node);
        if both_ways {
            network.set_link_down(link_down, to.node, from.node);
        }
        let what = if link_down { "link down" } else { "link up" };
        let (begin, end) = if both_ways { ("between", "and") } else { ("from", "to") };
        let (from, to, bus) = (from.node, to.node, network.name());
        progress.print_note(&format!("scenario: {what} {begin} cell {from} {end} cell {to} on {bus}"));
    }

    /// Returns true if all buses are gone, and no command has taken one down or is bringing one up.
    fn has_lost_all_buses(&self) -> bool {
        let mut buses = self.bus_links.iter().enumerate();
        buses.all(|(bus, bus_link)| bus_link.link.is_gone() && !self.commanded.is_loss_expected(bus))
    }

    /// Handles the events of the receivers.
    fn handle_events(&self, script: &ScenarioProgress, progress: &Progress) -> Result<(), RunError> {
        let events: Vec<_> = self.events.try_iter().collect();
        let mut returned = BTreeSet::new();
        let mut changed = BTreeMap::<(usize, &str), Vec<CellId>>::new();
        for (bus, bus_event) in events {
            match bus_event {
                BusEvent::Notice(Notice::OtherGateway) => return Err(self.other_gateway_error(bus)),
                BusEvent::Notice(Notice::Dead(cell)) => {
                    changed.entry((bus, "fallen silent")).or_default().push(cell)
                }
                BusEvent::Notice(Notice::Revived(cell)) => {
                    changed.entry((bus, "come back")).or_default().push(cell)
                }
                BusEvent::Notice(Notice::Restarted(cell)) => {
                    progress.print_note(&format!("cell {cell} on {} restarted", self.bus_name(bus)));
                    // The restarted cell has lost its contact state.
                    self.resend_stimuli(script, |it| it.bus == bus && it.node == cell)?;
                }
                BusEvent::Notice(Notice::Returned(cell)) => {
                    // A heartbeat that was under way when its host was lost does not mean that the cell is back: it
                    // gets no messages until the host is reachable.
                    let is_away =
                        self.bus_links.get(bus).is_some_and(|it| it.hosts.is_host_unreachable(cell));
                    if !is_away {
                        returned.insert((bus, cell));
                    }
                }
                BusEvent::Notice(Notice::Duplicate(cell)) => {
                    progress.print_note(&format!(
                        "cell {cell} on {} shares its node id with another cell: stop one of the two",
                        self.bus_name(bus)
                    ));
                }
                BusEvent::Down(why) => progress.print_note(&why.to_string()),
                BusEvent::Up => progress.print_note(&format!("{} works again", self.bus_name(bus))),
                // Without any bus there is no torque, so the run ends, unless a bus is to come back.
                BusEvent::Lost(why) if self.has_lost_all_buses() => return Err(RunError::Lost(why)),
                BusEvent::Lost(why) => {
                    progress.print_note(&format!(
                        "{why}; the other buses continue, and this bus is reopened when it works again"
                    ));
                }
                BusEvent::Refused(why) => {
                    progress.print_note(&format!("{} cannot be reopened yet: {why}", self.bus_name(bus)))
                }
            }
        }
        if !returned.is_empty() {
            self.resend_to_returned(script, &returned)?;
        }
        for ((bus, how), cells) in changed {
            let first: Vec<_> = cells.iter().take(6).map(ToString::to_string).collect();
            let (first, bus) = (first.join(", "), self.bus_name(bus));
            progress.print_note(&match cells.len() {
                1 => format!("cell {first} on {bus} has {how}"),
                2..=6 => format!("cells {first} on {bus} have {how}"),
                count => format!("{count} cells on {bus} have {how} ({first} ...)"),
            });
        }
        Ok(())
    }

    /// Shows notes about cell processes that have ended; with `last`, all pending notes.
    fn note_ended_processes(&mut self, progress: &Progress, last: bool) {
        let ended = self.processes.take_ended();
        for note in self.ended.add_ended(ended, last) {
            progress.print_note(&note);
        }
    }

    /// Handles the reports of links to other hosts.
    fn handle_host_reports(
        &mut self,
        script: &ScenarioProgress,
        progress: &Progress,
    ) -> Result<(), RunError> {
        let mut reached = BTreeSet::new();
        for (bus, bus_link) in self.bus_links.iter_mut().enumerate() {
            let changes = bus_link.hosts.read_reports(&bus_link.link);
            changes.notes.iter().for_each(|note| progress.print_note(note));
            reached.extend(changes.reached.into_iter().map(|cell| (bus, cell)));
            if !changes.possibly_missed.is_empty() {
                // The receiver must know these cells before any further messages are sent to them.
                let _ = bus_link.possibly_missed.send(changes.possibly_missed);
            }
        }
        if reached.is_empty() {
            return Ok(());
        }
        self.resend_to_returned(script, &reached)
    }

    /// Resends stimuli and commands to cells that may have missed changes while they were absent.
    fn resend_to_returned(
        &self,
        script: &ScenarioProgress,
        cells: &BTreeSet<(usize, CellId)>,
    ) -> Result<(), RunError> {
        self.resend_stimuli(script, |it| cells.contains(&(it.bus, it.node)))?;
        for bus_link in cells.iter().filter_map(|&(bus, _)| self.bus_links.get(bus)) {
            bus_link.link.state.returned.store(true, Ordering::Relaxed);
        }
        Ok(())
    }

    /// Starts new servers for this run's embedded buses whose servers have ended, unless a command has taken the bus
    /// down.
    fn restart_bus_servers(&mut self, progress: &Progress) {
        let gone = self.bus_links.iter().enumerate();
        let gone = gone.filter(|&(bus, bus_link)| bus_link.link.is_gone() && !self.commanded.is_down(bus));
        let gone: Vec<_> = gone.map(|(_, bus_link)| bus_link.link.name.clone()).collect();
        for served in
            self.served.iter_mut().filter(|served| gone.iter().any(|name| name == served.bus_name()))
        {
            let Some(status) = served.exit_status() else { continue };
            let name = served.bus_name().to_owned();
            progress.print_note(&match start_bus_server(self.options, &name) {
                Ok(again) => {
                    *served = again;
                    format!("the process that served {name} ended ({status}); a new process serves it")
                }
                Err(error) => format!(
                    "the process that served {name} ended ({status}) and could not be restarted: {error}"
                ),
            });
        }
    }
}
