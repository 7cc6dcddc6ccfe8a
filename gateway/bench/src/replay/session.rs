//! A replay from its cells' first word to its summary.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use protocol::can::Frame;
use protocol::id::{CellId, Node};
use protocol::message::Message;

use super::feed::{AHEAD, Queue, Source};
use super::hall::{Hall, Voice};
use super::judge::Judge;
use super::live::{Live, mode};
use super::player::{LaneTally, Pace, Played, Player};
use super::reel::{Cut, Selection};
use super::report::{BusSummary, Expect, First, Lockstep, Summary};
use super::start::{self, Buses, Checks, Routes, rival};
use super::survey::{Known, Survey};
use super::teller::Teller;
use super::{Options, ear};
use crate::run::RunError;
use crate::run::realtime::{self, Granted};
use model::quantiles::Quantiles;

/// The main thread's rhythm.
const LOOK: Duration = Duration::from_millis(20);

/// A replay that is ready.
pub(super) struct Session<'a> {
    options: &'a Options,
    survey: Arc<Survey>,
    routes: Routes,
    checks: Checks,
    hall: Arc<Hall>,
    buses: Buses,
    signalled: Arc<AtomicBool>,
    teller: Teller,
    /// Cells that were put into test mode, by lane.
    measuring: Vec<Vec<CellId>>,
}

impl<'a> Session<'a> {
    pub(super) fn new(
        options: &'a Options,
        checks: Checks,
        judge: Judge,
        buses: Buses,
        signalled: Arc<AtomicBool>,
        teller: Teller,
    ) -> Self {
        let (survey, routes) = (Arc::clone(&checks.survey), checks.routes.clone());
        let hall = Arc::new(Hall::new(judge));
        let measuring = Vec::new();
        Self { options, survey, routes, checks, hall, buses, signalled, teller, measuring }
    }

    pub(super) fn run(
        mut self,
        idle: Option<&Histogram<u64>>,
        wearing: Option<&start::Wearing>,
    ) -> Result<Summary, RunError> {
        let mut ears = Vec::new();
        if self.options.hears() {
            let roots = std::mem::take(&mut self.buses.roots);
            for ((index, lane), roots) in self.buses.lanes.iter().enumerate().zip(roots) {
                let (bus, format, hall) = (Arc::clone(&lane.bus), lane.format, Arc::clone(&self.hall));
                let name = format!("rx {}", bus.name());
                let hear = move || ear::hear(index, &bus, format, roots, &hall);
                ears.push(thread::Builder::new().name(name).spawn(hear).map_err(no_thread)?);
            }
        }
        let outcome = self.meet(wearing).and_then(|()| self.play());
        if let Err(error) = self.leave() {
            self.teller.say(&error.to_string());
        }
        self.hall.deaf.store(true, Ordering::Relaxed);
        let unheard: Vec<_> = ears.into_iter().map(|ear| ear.join().unwrap_or(0)).collect();
        self.teller.clear();
        let (played, cut, seconds, live) = outcome?;
        Ok(self.summary(played, cut, seconds, &live, &unheard, idle))
    }

    /// Calls the cells, and sees that they are as they have to be.
    fn meet(&mut self, wearing: Option<&start::Wearing>) -> Result<(), RunError> {
        if !self.options.hears() {
            return Ok(());
        }
        let wanted = match wearing {
            None => self.checks.recorded(),
            Some(wearing) => {
                let of = |(_, name): &(usize, String)| {
                    let bus = wearing.skin.bus_named(name)?;
                    Some(wearing.skin.cells_of(bus).map(|cell| cell.node).collect())
                };
                self.routes.names.iter().map(|name| of(name).unwrap_or_default()).collect()
            }
        };
        let signalled = Arc::clone(&self.signalled);
        self.buses.call_the_roll(&self.hall, &wanted, || signalled.load(Ordering::Relaxed))?;
        self.buses.let_them_organise(&self.hall, &self.teller, || signalled.load(Ordering::Relaxed))?;
        let judge = self.hall.judge();
        let lanes = 0..self.routes.names.len();
        let there: usize =
            lanes.map(|lane| judge.present(lane).filter(|(_, cell)| cell.claim.is_settled()).count()).sum();
        if there == 0 && (self.options.expect || self.options.lockstep || wearing.is_some()) {
            let names: Vec<_> = self.routes.names.iter().map(|(_, name)| name.as_str()).collect();
            return Err(RunError::Failed(format!(
                "no cell answers on {}: start them with cell-node, or with --spawn",
                names.join(", ")
            )));
        }
        if !self.checks.configures() {
            self.checks.hashes(&judge).map_err(RunError::Failed)?;
        }
        let measuring = self.checks.measuring(&judge);
        drop(judge);
        if measuring.iter().all(Vec::is_empty) {
            return Ok(());
        }
        start::into_test_mode(self.options, &self.buses.lanes, &measuring, &self.hall)?;
        if self.options.test_mode {
            self.measuring = measuring;
            return Ok(());
        }
        let all: Vec<_> = measuring.iter().flatten().copied().collect();
        let said = format!(
            "cells measure and do not obey stimuli, as they did in the recording: {}; --test-mode lets them obey while \
             the replay lasts",
            start::names(&all)
        );
        if self.options.expect {
            return Err(RunError::Failed(said));
        }
        self.teller.say(&said);
        Ok(())
    }

    /// Sends everything; how long that took, in s.
    fn play(&mut self) -> Result<(Played, Cut, f64, (Live, Granted)), RunError> {
        let (queue, steps) = rtrb::RingBuffer::new(AHEAD);
        let ready = Arc::new(AtomicBool::new(false));
        let hears = self.options.hears();
        let is_fresh = self.options.spawn.is_some() && self.is_fresh();
        let source = Source {
            survey: Arc::clone(&self.survey),
            selection: Selection {
                only: self.options.only,
                pick: self.options.pick.clone(),
                lanes: self.routes.lanes.clone(),
                reads: hears,
            },
            passes: self.options.passes,
            restores: (hears && !is_fresh, hears),
            hall: Arc::clone(&self.hall),
            ready: Arc::clone(&ready),
        };
        let files = self.options.files.clone();
        let reader =
            thread::Builder::new().name("reader".to_owned()).spawn(move || source.run(&files, queue));
        let reader = reader.map_err(no_thread)?;
        while !ready.load(Ordering::Relaxed) && !reader.is_finished() {
            thread::sleep(Duration::from_millis(1));
        }

        let (voice, said) = mpsc::channel();
        let lanes = Arc::clone(&self.buses.lanes);
        let syncs = self
            .options
            .lockstep
            .then(|| lanes.iter().map(|lane| lane.frames(&Message::Sync).collect::<Vec<Frame>>()).collect());
        let live = Live {
            hall: Arc::clone(&self.hall),
            voice: Voice(voice),
            spin_ns: u64::try_from(self.options.spin.as_nanos()).unwrap_or(u64::MAX),
            may_wait: self.options.pace == Pace::Max || self.options.lockstep,
            expects: self.options.expect,
            checks: self.checks.clone(),
            silent: Vec::new(),
            asked_again: 0,
            in_vain: BTreeSet::new(),
            down: vec![false; lanes.len()],
            lanes,
        };
        let player = Player::new(self.routes.names.len(), self.options.pace, syncs);
        let began = Instant::now();
        let perform = move |mut live: Live| {
            let granted = realtime::prepare();
            if hears {
                for lane in 0..live.lanes.len() {
                    // Where the counters begin; a bus that is down says so at the first frame.
                    let _ = live.report(lane);
                }
                live.hall.judge().mute(false);
            }
            let played = player.play(&mut Queue(steps), &mut live);
            (played, live, granted)
        };
        let player = thread::Builder::new().name("player".to_owned()).spawn(move || perform(live));
        let player = player.map_err(no_thread)?;
        let rivalry = self.watch(&said, || player.is_finished());
        let panicked = |_| RunError::Failed("the player panicked".to_owned());
        let (mut played, mut live, granted) = player.join().map_err(panicked)?;
        let seconds = began.elapsed().as_secs_f64();
        let cut = reader.join().map_err(|_| RunError::Failed("the reader panicked".to_owned()))?;
        if let Some(name) = rivalry {
            played.failure = Some(rival(&name).to_string());
        }
        // What a signal has ended is judged as far as it went.
        self.hall.over.store(false, Ordering::Relaxed);
        if hears {
            let names: Vec<_> = self.routes.names.clone();
            for (lane, (_, name)) in names.iter().enumerate() {
                if played.failure.is_none()
                    && let Err(why) = live.report(lane)
                {
                    self.teller.say(&format!("{name}: no last words of its cells: {why}"));
                }
            }
        }
        self.hall.judge().finish(!played.was_stopped && played.failure.is_none());
        for line in said.try_iter() {
            self.teller.say(&line);
        }
        let cut = match cut {
            Ok(cut) => cut,
            Err(error) => {
                played.failure.get_or_insert_with(|| error.to_string());
                Cut::default()
            }
        };
        Ok((played, cut, seconds, (live, granted)))
    }

    /// Whether cells that were just started are in the state in which the replay begins.
    fn is_fresh(&self) -> bool {
        self.routes
            .names
            .iter()
            .all(|(bus, _)| self.survey.buses.get(*bus).is_none_or(|bus| bus.state.is_fresh()))
    }

    /// Shows how it goes, until it is over; returns the bus on which there is another gateway.
    fn watch(&mut self, said: &mpsc::Receiver<String>, is_over: impl Fn() -> bool) -> Option<String> {
        let bar = self.teller.bar(self.length());
        let mut rivalry = None;
        while !is_over() {
            thread::sleep(LOOK);
            bar.set_position(self.hall.at.load(Ordering::Relaxed) / 1_000_000);
            bar.set_message(self.hall.sent.load(Ordering::Relaxed).to_string());
            for line in said.try_iter() {
                self.teller.say(&line);
            }
            for ended in self.buses.processes.ended() {
                let ((first, last), status) = (ended.nodes, ended.status);
                let cells =
                    if first == last { format!("cell {first}") } else { format!("cells {first} to {last}") };
                self.teller.say(&format!("the process of {cells} ended ({status})"));
            }
            if self.options.hears() && rivalry.is_none() {
                let lane = self.hall.judge().rival();
                rivalry = lane.and_then(|lane| Some(self.routes.names.get(lane)?.1.clone()));
            }
            if rivalry.is_some() || self.signalled.load(Ordering::Relaxed) {
                self.hall.over.store(true, Ordering::Relaxed);
                self.hall.has_heard();
            }
        }
        bar.finish_and_clear();
        rivalry
    }

    /// How long it is, in ms of the capture; none when it has no end.
    fn length(&self) -> Option<u64> {
        let (from, to) = self.survey.bounds();
        let from = from.max(self.survey.first.unwrap_or(0));
        let one = to.min(self.survey.last).saturating_sub(from) / 1_000_000;
        self.options.passes.map(|passes| one * u64::from(passes))
    }

    /// Leaves cells as they were met.
    fn leave(&self) -> Result<(), RunError> {
        for (lane, cells) in self.buses.lanes.iter().zip(&self.measuring) {
            for cell in cells {
                start::send(lane, &mode(Node::Cell(*cell), false))?;
            }
        }
        Ok(())
    }

    fn summary(
        &self,
        played: Played,
        cut: Cut,
        duration_s: f64,
        (live, granted): &(Live, Granted),
        unheard: &[u64],
        idle: Option<&Histogram<u64>>,
    ) -> Summary {
        let judge = self.hall.judge();
        let total = |of: fn(&LaneTally) -> u64| played.lanes.iter().map(of).sum();
        let bus = |(index, (bus, name)): (usize, &(usize, String))| {
            let lane = self.buses.lanes.get(index)?;
            Some(BusSummary {
                capture: self.survey.buses.get(*bus)?.name.clone(),
                name: name.clone(),
                kind: lane.bus.kind().to_string(),
                frames: *played.lanes.get(index)?,
                unheard: unheard.get(index).copied().unwrap_or(0),
            })
        };
        let silent = |(lane, cell): &(usize, CellId)| {
            format!("{cell} on {}", self.routes.names.get(*lane).map_or("", |(_, name)| name))
        };
        let mut silent_cells: Vec<_> = live.silent.iter().map(silent).collect();
        silent_cells.dedup();
        Summary {
            file: self.checks.name.clone(),
            duration_s,
            interrupted: played.was_stopped && self.signalled.load(Ordering::Relaxed),
            sent: total(|lane| lane.sent),
            refused: total(|lane| lane.refused),
            lost: total(|lane| lane.lost),
            skipped: cut.skipped,
            sent_at_once: cut.late,
            buses: self.routes.names.iter().enumerate().filter_map(bus).collect(),
            late_us: idle.map(|_| Quantiles::of(&played.late, 1e-3)),
            idle_late_us: idle.map(|idle| Quantiles::of(idle, 1e-3)),
            spin_us: self.options.spin.as_secs_f64() * 1e6,
            fifo: granted.fifo,
            memory_locked: granted.locked,
            lockstep: self
                .options
                .lockstep
                .then_some(Lockstep { silent_cells, asked_again: live.asked_again }),
            expect: self.options.expect.then(|| self.expectation(&judge)),
            failure: played.failure,
        }
    }

    fn expectation(&self, judge: &Judge) -> Expect {
        let recorded = self.checks.recorded();
        let unchecked = self.routes.names.iter().zip(&recorded).map(|((bus, _), cells)| {
            let bus = self.survey.buses.get(*bus);
            let unknown = |cell: &&CellId| {
                let known = bus.and_then(|bus| bus.cells.get(cell)).map(|cell| cell.hash);
                !matches!(known, Some(Known::Yes(_)))
            };
            cells.iter().filter(unknown).count() as u64
        });
        let late =
            (0..self.routes.names.len()).flat_map(|lane| judge.present(lane)).filter_map(|(_, cell)| {
                let (first, last) = cell.heard?;
                Some(u64::from(last.joints_late.wrapping_sub(first.joints_late)))
            });
        Expect {
            tally: *judge.tally(),
            joints_skipped: late.sum(),
            recording_dropped: self.survey.dropped,
            unchecked_cells: unchecked.sum(),
            first: judge.first().map(First::from),
        }
    }
}

fn no_thread(error: std::io::Error) -> RunError {
    RunError::Failed(format!("cannot start a thread: {error}"))
}
