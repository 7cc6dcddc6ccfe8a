//! A replay from its cells' first word to its summary.

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
use super::checks::Checks;
use super::hall::Hall;
use super::live::Live;
use super::player::{LaneTally, Played, Player};
use super::reel::Cut;
use super::report::{BusSummary, Expect, Lockstep, Summary};
use super::source::{self, AHEAD};
use super::start::{Buses, Wearing};
use super::survey::Bus;
use crate::run::RunError;
use crate::run::progress::Progress;
use crate::run::realtime::{self, Granted};
use crate::setup::spawn;
use model::quantiles::Quantiles;

/// The main thread's rhythm.
const LOOK: Duration = Duration::from_millis(20);

/// A replay that is ready.
pub(super) struct Session {
    pub(super) hall: Arc<Hall>,
    pub(super) buses: Buses,
    pub(super) signalled: Arc<AtomicBool>,
    pub(super) progress: Progress,
    /// Cells that were put into test mode, by lane.
    pub(super) measuring: Vec<Vec<CellId>>,
}

impl Session {
    /// `idle` is how late the idle machine wakes a thread, `wearing` the skin of the cells that were started.
    pub(super) fn run(
        mut self,
        idle: Option<&Histogram<u64>>,
        wearing: Option<&Wearing>,
    ) -> Result<Summary, ReplayError> {
        let mut receivers = Vec::new();
        if self.hall.checks.options.hears() {
            let roots = std::mem::take(&mut self.buses.roots);
            for ((index, lane), roots) in self.buses.lanes.iter().enumerate().zip(roots) {
                let (lanes, hall) = (Arc::clone(&self.buses.lanes), Arc::clone(&self.hall));
                let hear = move || lanes.get(index).map_or(0, |lane| hall.hear(index, lane, roots));
                receivers.push(spawn(&format!("rx {}", lane.bus.name()), hear)?);
            }
        }
        let mut outcome = self.meet(wearing).and_then(|()| self.play(idle));
        if let Err(error) = self.leave() {
            self.progress.note(&error.to_string());
        }
        self.hall.deaf.store(true, Ordering::Relaxed);
        for (lane, receiver) in receivers.into_iter().enumerate() {
            let unheard = receiver.join().unwrap_or(0);
            if let Some(bus) = outcome.as_mut().ok().and_then(|summary| summary.buses.get_mut(lane)) {
                bus.unheard = unheard;
            }
        }
        self.progress.clear();
        outcome
    }

    /// Sends everything; the summary is yet without what the receivers have not heard.
    fn play(&mut self, idle: Option<&Histogram<u64>>) -> Result<Summary, ReplayError> {
        let (queue, mut steps) = rtrb::RingBuffer::new(AHEAD);
        let hall = Arc::clone(&self.hall);
        let reader = spawn("reader", move || source::read(&hall, queue))?;
        while !self.hall.ready.load(Ordering::Relaxed) && !reader.is_finished() {
            thread::sleep(Duration::from_millis(1));
        }

        let options = &self.hall.checks.options;
        let hears = options.hears();
        let (voice, said) = mpsc::channel();
        let lanes = Arc::clone(&self.buses.lanes);
        let sync = || lanes.iter().map(|lane| lane.frames(&Message::Sync).collect()).collect();
        let player = Player::new(lanes.len(), options.pace, options.lockstep.then(sync));
        let mut live = Live {
            hall: Arc::clone(&self.hall),
            voice,
            lockstep: Lockstep::default(),
            in_vain: BTreeSet::new(),
            down: BTreeSet::new(),
            lanes,
        };
        let began = Instant::now();
        let player = spawn("player", move || {
            let granted = realtime::prepare();
            if hears {
                for lane in 0..live.lanes.len() {
                    // Where the counters begin; a bus that is down says so at the first frame.
                    let _ = live.report(lane);
                }
                live.hall.judge().mute(false);
            }
            let played = player.play(&mut steps, &mut live);
            (played, live, granted)
        })?;
        let rival = self.watch(&said, || player.is_finished());
        let (mut played, mut live, granted) = player.join().map_err(|_| RunError::Panicked("player"))?;
        let duration_s = began.elapsed().as_secs_f64();
        let cut = reader.join().map_err(|_| RunError::Panicked("reader"))?;
        played.failure = rival.or(played.failure);
        // What a signal has ended is judged as far as it went.
        self.hall.over.store(false, Ordering::Relaxed);
        let lanes = self.hall.checks.lanes().enumerate();
        for (lane, (name, _)) in lanes.filter(|_| hears && played.failure.is_none()) {
            if let Err(why) = live.report(lane) {
                self.progress.note(&format!("{name}: no last words of its cells: {why}"));
            }
        }
        self.hall.judge().finish(!played.was_stopped && played.failure.is_none());
        for line in said.try_iter() {
            self.progress.note(&line);
        }
        let cut = cut.unwrap_or_else(|error| {
            played.failure.get_or_insert(ReplayError::Read(error));
            Cut::default()
        });
        Ok(self.summary(played, cut, live, duration_s, granted, idle))
    }

    /// Shows how it goes, until it is over; whether there is another gateway.
    fn watch(&mut self, said: &mpsc::Receiver<String>, is_over: impl Fn() -> bool) -> Option<ReplayError> {
        let bar = self.progress.bar(self.length());
        let mut rival = None;
        while !is_over() {
            thread::sleep(LOOK);
            bar.set_position(self.hall.at.load(Ordering::Relaxed) / 1_000_000);
            bar.set_message(self.hall.sent.load(Ordering::Relaxed).to_string());
            for line in said.try_iter() {
                self.progress.note(&line);
            }
            for ended in self.buses.processes.ended() {
                self.progress.note(&format!("the process of {ended} ended ({})", ended.status));
            }
            if self.hall.checks.options.hears() && rival.is_none() {
                let lane = self.hall.judge().rival();
                rival = lane.map(|lane| ReplayError::Rival(self.hall.checks.lane(lane).to_owned()));
            }
            if rival.is_some() || self.signalled.load(Ordering::Relaxed) {
                self.hall.over.store(true, Ordering::Relaxed);
                self.hall.has_heard();
            }
        }
        bar.finish_and_clear();
        rival
    }

    /// How long it is, in ms of the capture; none when it has no end.
    fn length(&self) -> Option<u64> {
        let Checks { survey, options, .. } = &self.hall.checks;
        let (from, to) = survey.bounds();
        let from = from.max(survey.first.unwrap_or(0));
        let one = to.min(survey.last).saturating_sub(from) / 1_000_000;
        options.passes.map(|passes| one * u64::from(passes))
    }

    fn summary(
        &self,
        played: Played,
        cut: Cut,
        live: Live,
        duration_s: f64,
        granted: Granted,
        idle: Option<&Histogram<u64>>,
    ) -> Summary {
        let checks = &self.hall.checks;
        let options = &checks.options;
        let total = |of: fn(&LaneTally) -> u64| played.lanes.iter().map(of).sum();
        let bus = |(index, (name, bus)): (usize, (&str, &Bus))| {
            Some(BusSummary {
                capture: bus.name.clone(),
                name: name.to_owned(),
                kind: self.buses.lanes.get(index)?.bus.kind().to_string(),
                frames: *played.lanes.get(index)?,
                unheard: 0,
            })
        };
        let mut lockstep = live.lockstep;
        lockstep.silent_cells.dedup();
        Summary {
            file: checks.name.clone(),
            duration_s,
            interrupted: played.was_stopped && self.signalled.load(Ordering::Relaxed),
            sent: total(|lane| lane.sent),
            refused: total(|lane| lane.refused),
            lost: total(|lane| lane.lost),
            skipped: cut.skipped,
            sent_at_once: cut.late,
            buses: checks.lanes().enumerate().filter_map(bus).collect(),
            late_us: idle.map(|_| Quantiles::of(&played.late, 1e-3)),
            idle_late_us: idle.map(|idle| Quantiles::of(idle, 1e-3)),
            spin_us: options.spin.as_secs_f64() * 1e6,
            fifo: granted.fifo,
            memory_locked: granted.locked,
            lockstep: options.lockstep.then_some(lockstep),
            expect: options.expect.then(|| self.expectation()),
            failure: played.failure.map(|failure| failure.to_string()),
        }
    }

    fn expectation(&self) -> Expect {
        let (judge, checks) = (self.hall.judge(), &self.hall.checks);
        let present = (0..self.buses.lanes.len()).flat_map(|lane| judge.present(lane));
        let late = present.filter_map(|(_, cell)| {
            let (first, last) = cell.heard?;
            Some(u64::from(last.joints_late.wrapping_sub(first.joints_late)))
        });
        Expect {
            tally: *judge.tally(),
            joints_skipped: late.sum(),
            recording_dropped: checks.survey.dropped,
            unchecked_cells: checks.unchecked(),
            first: judge.first().cloned(),
        }
    }
}
