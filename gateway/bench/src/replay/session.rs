//! A replay, from the first message to the cells to the summary.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use protocol::id::CellId;
use protocol::message::Message;

use super::ReplayError;
use super::checks::CellChecks;
use super::live::LiveBackend;
use super::player::{BusTally, Player, PlayerResult};
use super::replay_plan::PlanSummary;
use super::report::{BusSummary, LockstepResult, ReplyComparison, Summary};
use super::shared_state::SharedState;
use super::source::{self, STEP_QUEUE_LENGTH};
use super::start::{Buses, SpawnSkin};
use super::survey::SurveyedBus;
use crate::bus::realtime::{self, GrantedPrivileges};
use crate::error::RunError;
use crate::processes::ended::EndedProcesses;
use crate::progress::Progress;
use crate::threads::spawn;
use protocol::quantiles::Quantiles;

/// Interval between two checks of the main thread.
const CHECK_INTERVAL: Duration = Duration::from_millis(20);

/// A replay that is ready to start.
pub(super) struct ReplaySession {
    pub(super) shared_state: Arc<SharedState>,
    pub(super) buses: Buses,
    pub(super) signalled: Arc<AtomicBool>,
    pub(super) progress: Progress,
    /// Cells that were put into test mode, by bus. They measure again after the replay.
    pub(super) measuring: Vec<Vec<CellId>>,
    /// Processes of cells that have ended.
    pub(super) ended: EndedProcesses,
}

impl ReplaySession {
    /// Runs the replay. `idle` is the wake-up lateness of the idle machine; `skin_override` is the skin of the started
    /// cells.
    pub(super) fn run(
        mut self,
        idle: Option<&Histogram<u64>>,
        skin_override: Option<&SpawnSkin>,
    ) -> Result<Summary, ReplayError> {
        let mut receivers = Vec::new();
        if self.shared_state.checks.options.receives_cell_messages() {
            let roots = std::mem::take(&mut self.buses.roots);
            for ((index, bus_link), roots) in self.buses.bus_links.iter().enumerate().zip(roots) {
                let (bus_links, shared_state) =
                    (Arc::clone(&self.buses.bus_links), Arc::clone(&self.shared_state));
                let receive = move || {
                    bus_links
                        .get(index)
                        .map_or(0, |bus_link| shared_state.receive_until_end(index, bus_link, roots))
                };
                receivers.push(spawn(&format!("rx {}", bus_link.bus.name()), receive)?);
            }
        }
        let mut outcome = self.check_cells(skin_override).and_then(|()| self.send_all_steps(idle));
        if let Err(error) = self.restore_mode() {
            self.progress.print_note(&error.to_string());
        }
        self.shared_state.stop_receiving.store(true, Ordering::Relaxed);
        for (bus_link, receiver) in receivers.into_iter().enumerate() {
            let unheard = receiver.join().unwrap_or(0);
            if let Some(bus) = outcome.as_mut().ok().and_then(|summary| summary.buses.get_mut(bus_link)) {
                bus.unheard = unheard;
            }
        }
        self.progress.clear_line();
        outcome
    }

    /// Sends all steps. The returned summary lacks the number of unread frames, which the receivers report later.
    fn send_all_steps(&mut self, idle: Option<&Histogram<u64>>) -> Result<Summary, ReplayError> {
        let (queue, mut steps) = rtrb::RingBuffer::new(STEP_QUEUE_LENGTH);
        let shared_state = Arc::clone(&self.shared_state);
        let reader = spawn("reader", move || source::read_capture(&shared_state, queue))?;
        while !self.shared_state.ready.load(Ordering::Relaxed) && !reader.is_finished() {
            thread::sleep(Duration::from_millis(1));
        }

        let options = &self.shared_state.checks.options;
        let hears = options.receives_cell_messages();
        let (log_sender, said) = mpsc::channel();
        let bus_links = Arc::clone(&self.buses.bus_links);
        let sync =
            || bus_links.iter().map(|bus_link| bus_link.encode_frames(&Message::Sync).collect()).collect();
        let player = Player::new(bus_links.len(), options.pace, options.lockstep.then(sync));
        let mut live = LiveBackend {
            shared_state: Arc::clone(&self.shared_state),
            log_sender,
            lockstep: LockstepResult::default(),
            resend_failed: BTreeSet::new(),
            down: BTreeSet::new(),
            bus_links,
        };
        let is_timed = options.is_timed();
        let began = Instant::now();
        let player = spawn("player", move || {
            // Without a schedule the thread never sleeps, and would keep all others from the processor.
            let granted = if is_timed { realtime::request_realtime() } else { GrantedPrivileges::default() };
            if hears {
                for bus_link in 0..live.bus_links.len() {
                    // Request the initial values of the counters. If the bus is down, the first frame reports it.
                    let _ = live.request_counters(bus_link);
                }
                live.shared_state.comparator().set_muted(false);
            }
            let played = player.play(&mut steps, &mut live);
            (played, live, granted)
        })?;
        let other_gateway = self.show_progress(&said, || player.is_finished());
        let (mut played, mut live, granted) = player.join().map_err(|_| RunError::Panicked("player"))?;
        let duration_s = began.elapsed().as_secs_f64();
        let plan_summary = reader.join().map_err(|_| RunError::Panicked("reader"))?;
        played.failure = other_gateway.or(played.failure);
        // A replay ended by a signal is compared up to that point.
        self.shared_state.stop_sending.store(false, Ordering::Relaxed);
        let bus_links = self.shared_state.checks.named_buses().enumerate();
        for (bus_link, (name, _)) in bus_links.filter(|_| hears && played.failure.is_none()) {
            if let Err(why) = live.request_counters(bus_link) {
                self.progress
                    .print_note(&format!("{name}: cannot request a final report from the cells: {why}"));
            }
        }
        self.shared_state.comparator().finish(!played.was_stopped && played.failure.is_none());
        for line in said.try_iter() {
            self.progress.print_note(&line);
        }
        self.note_ended_processes(true);
        let plan_summary = plan_summary.unwrap_or_else(|error| {
            played.failure.get_or_insert(ReplayError::Read(error));
            PlanSummary::default()
        });
        Ok(self.summary(played, plan_summary, live, duration_s, granted, idle))
    }

    /// Shows notes about processes that have ended; with `last`, all pending notes.
    fn note_ended_processes(&mut self, last: bool) {
        let ended = self.buses.processes.take_ended();
        for note in self.ended.add_ended(ended, last) {
            self.progress.print_note(&note);
        }
    }

    /// Shows the progress until the replay is over. Returns an error if another gateway appears.
    fn show_progress(
        &mut self,
        said: &mpsc::Receiver<String>,
        is_over: impl Fn() -> bool,
    ) -> Option<ReplayError> {
        let bar = self.progress.start_bar(self.capture_length_ms());
        let mut other_gateway = None;
        while !is_over() {
            thread::sleep(CHECK_INTERVAL);
            bar.set_position(self.shared_state.at.load(Ordering::Relaxed) / 1_000_000);
            bar.set_message(self.shared_state.sent.load(Ordering::Relaxed).to_string());
            for line in said.try_iter() {
                self.progress.print_note(&line);
            }
            self.note_ended_processes(false);
            if self.shared_state.checks.options.receives_cell_messages() && other_gateway.is_none() {
                let bus_link = self.shared_state.comparator().other_gateway_bus();
                other_gateway = bus_link.map(|bus_link| {
                    ReplayError::OtherGateway(self.shared_state.checks.bus_name(bus_link).to_owned())
                });
            }
            if other_gateway.is_some() || self.signalled.load(Ordering::Relaxed) {
                self.shared_state.stop_sending.store(true, Ordering::Relaxed);
                self.shared_state.notify_waiting();
            }
        }
        bar.finish_and_clear();
        other_gateway
    }

    /// Returns the length of the capture in ms, or `None` if the replay has no end.
    fn capture_length_ms(&self) -> Option<u64> {
        let CellChecks { survey, options, .. } = &self.shared_state.checks;
        let (from, to) = survey.part_bounds_ns();
        let from = from.max(survey.first.unwrap_or(0));
        let one = to.min(survey.last).saturating_sub(from) / 1_000_000;
        options.passes.map(|passes| one * u64::from(passes))
    }

    fn summary(
        &self,
        played: PlayerResult,
        plan_summary: PlanSummary,
        live: LiveBackend,
        duration_s: f64,
        granted: GrantedPrivileges,
        idle: Option<&Histogram<u64>>,
    ) -> Summary {
        let checks = &self.shared_state.checks;
        let options = &checks.options;
        let total = |of: fn(&BusTally) -> u64| played.bus_links.iter().map(of).sum();
        let bus = |(index, (name, bus)): (usize, (&str, &SurveyedBus))| {
            Some(BusSummary {
                capture: bus.name.clone(),
                name: name.to_owned(),
                kind: self.buses.bus_links.get(index)?.bus.kind().to_string(),
                frames: *played.bus_links.get(index)?,
                unheard: 0,
            })
        };
        let mut lockstep = live.lockstep;
        lockstep.silent_cells.dedup();
        Summary {
            file: checks.name.clone(),
            duration_s,
            interrupted: played.was_stopped && self.signalled.load(Ordering::Relaxed),
            sent: total(|bus_link| bus_link.sent),
            refused: total(|bus_link| bus_link.refused),
            lost: total(|bus_link| bus_link.lost),
            skipped: plan_summary.skipped,
            sent_at_once: plan_summary.late,
            buses: checks.named_buses().enumerate().filter_map(bus).collect(),
            late_us: idle.map(|_| Quantiles::from_histogram(&played.late, 1e-3)),
            idle_late_us: idle.map(|idle| Quantiles::from_histogram(idle, 1e-3)),
            spin_us: options.spin.as_secs_f64() * 1e6,
            fifo: granted.fifo,
            memory_locked: granted.locked,
            lockstep: options.lockstep.then_some(lockstep),
            expect: options.expect.map(|tolerance| self.comparison_result(tolerance)),
            cell_errors: self.ended.errors(),
            failure: played.failure.map(|failure| failure.to_string()),
        }
    }

    fn comparison_result(&self, tolerance: u16) -> ReplyComparison {
        let (comparator, checks) = (self.shared_state.comparator(), &self.shared_state.checks);
        let present = (0..self.buses.bus_links.len()).flat_map(|bus_link| comparator.present_cells(bus_link));
        let late = present.filter_map(|(_, cell)| {
            let (first, last) = cell.counters?;
            Some(u64::from(last.joints_late.wrapping_sub(first.joints_late)))
        });
        ReplyComparison {
            tolerance,
            tally: *comparator.tally(),
            joints_skipped: late.sum(),
            recording_dropped: checks.survey.dropped,
            unchecked_cells: checks.unknown_hash_count(),
            first: comparator.first_difference().cloned(),
        }
    }
}
