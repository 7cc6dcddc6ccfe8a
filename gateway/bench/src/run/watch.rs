//! The main thread while the loop runs: stimuli ahead of their epochs, faults at their times, news and
//! progress for people, frames into the log, and at the end the summary.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use protocol::bus::BusKind;
use protocol::can::Frame;
use protocol::id::{CellId, Node};
use protocol::message::{From, Message, SensorPage};
use protocol::skin::Cell;
use protocol::time::Micros;

use super::launch::{ServedBus, program};
use super::link::{Slot, may_return};
use super::measured::Measured;
use super::organise::lines;
use super::progress::{Progress, say};
use super::realtime::{self, Granted};
use super::receiver::{Left, News, View};
use super::start::{Bench, Lane};
use super::switching::Told;
use super::{RunError, usage};
use crate::record::Recorder;
use crate::record::backlog;
use crate::summary::{
    AccuracySummary, BusSummary, Loop, NetworkSummary, OutagesSummary, Outcome, Processor, Summary,
};
use control::cycle::turn::{Timed, Turn};
use model::quantiles::Quantiles;
use model::scenario::{FaultKind, Stimulus, Touches};
use model::table::{Accuracy, Notice, Said};
use trace::recording::account::Recording;

/// What a controller counted, by name.
type Counts = BTreeMap<String, u64>;

/// Stimuli are sent so many epochs before the one from which they hold; cells let 8 wait.
const LEAD: u64 = 5;
/// The main thread's rhythm.
const LOOK: Duration = Duration::from_millis(10);
/// How long the cells may take to say their last words; a machine that is overloaded needs it.
const LAST_WORDS: Duration = Duration::from_secs(3);

/// Faults and touches that are still to come.
struct Script {
    touches: Touches,
    /// The next epoch whose stimuli are to be sent.
    epoch: u64,
    /// The next fault.
    fault: usize,
    /// Cells that were switched again.
    told: Told,
}

/// What a loop came to.
struct Driven {
    measured: Measured,
    seconds: f64,
    interrupted: bool,
    granted: Granted,
    controller: Counts,
    processor: Processor,
    cell_private_kib: Option<u64>,
}

impl Driven {
    fn new() -> Self {
        Self {
            measured: Measured::new(),
            seconds: 0.0,
            interrupted: false,
            granted: Granted::default(),
            controller: Counts::new(),
            processor: Processor::default(),
            cell_private_kib: None,
        }
    }
}

impl Bench<'_> {
    /// Runs the loop to its end, or as far as it comes.
    pub(super) fn watch(mut self) -> Summary {
        let mut driven = Driven::new();
        let failure = self.drive(&mut driven).err().map(|error| error.to_string());
        let received = self.stop_receivers();
        let recording = self.finish_recording(&received);
        if failure.is_some() {
            self.say_what_is_kept(recording.as_ref());
        }
        self.summary(driven, &received, recording).judged(failure)
    }

    /// Ends a bench whose loop never began.
    pub(super) fn give_up(mut self, error: RunError) -> Result<Summary, RunError> {
        let received = self.stop_receivers();
        let recording = self.recorder.take().map(Recorder::discard);
        self.say_what_is_kept(recording.as_ref());
        if error.exit_code() != 1 {
            return Err(error);
        }
        Ok(self.summary(Driven::new(), &received, recording).judged(Some(error.to_string())))
    }

    /// Where the frames are that were heard before a failure.
    fn say_what_is_kept(&self, recording: Option<&Recording>) {
        if self.options.quiet {
            return;
        }
        for file in recording.into_iter().flat_map(|recording| &recording.files) {
            say(&format!("{} frames until then are in {}", file.frames, file.path));
        }
    }

    fn drive(&mut self, driven: &mut Driven) -> Result<(), RunError> {
        let options = self.options;
        let (records, mut inlet) = Self::records();
        let turn = Turn::new(
            self.cycle.take().expect("the loop begins once"),
            std::mem::take(&mut self.lines),
            Arc::new(options.scenario.clone()),
            Arc::clone(&self.shared),
            records,
        )
        .recorded(self.recorded.take());
        let touches = Touches::new(&options.scenario, &options.skin);
        let mut script = Script { touches, epoch: 0, fault: 0, told: Told::new() };
        self.press(&mut script)?;

        let before = self.spent();
        let started = Instant::now();
        let control = self.start_loop(turn)?;
        let mut progress = Progress::new(options.quiet);
        let mut failure = None;
        while !control.is_finished() {
            thread::sleep(LOOK);
            driven.interrupted = self.signalled.load(Ordering::Relaxed);
            let step = self.step(&mut script, &mut progress, &mut driven.measured, &mut inlet, started);
            failure = step.err();
            if failure.is_some() || driven.interrupted {
                self.shared.stop_loop.store(true, Ordering::Relaxed);
            }
            if failure.is_some() {
                break;
            }
        }
        let ended = control.join();
        driven.seconds = started.elapsed().as_secs_f64();
        progress.clear();
        driven.measured.take(&mut inlet, self.began);
        driven.processor = self.spent().since(&before, driven.seconds);
        driven.cell_private_kib = self.processes.pids().filter_map(usage::private_kib).max();
        if failure.is_some() || ended.is_err() {
            // Nobody commands the cells any more.
            let _ = self.say(&Message::Halt);
        }
        let panicked = |_| RunError::Failed("the control loop panicked".to_owned());
        (driven.granted, driven.controller) = ended.map_err(panicked)?;
        match failure {
            Some(failure) => Err(failure),
            None => self.last_words(driven.interrupted),
        }
    }

    fn summary(&self, driven: Driven, received: &[Option<Left>], recording: Option<Recording>) -> Summary {
        let Driven { measured, controller, granted, .. } = driven;
        let backlog_dropped =
            backlog::dropped().zip(self.backlog_dropped).map(|(now, before)| now.saturating_sub(before));
        Summary {
            skin: self.options.skin.name.clone(),
            cells: self.options.skin.cells.len(),
            outcome: Outcome::Done,
            failure: None,
            duration_s: driven.seconds,
            interrupted: driven.interrupted,
            halted: measured.halts.why().map(str::to_owned),
            halts: measured.halts.all(),
            further_halts: measured.halts.further,
            before_halt: measured.halts.history(&self.options.skin),
            first_broadcast_s: measured.first_broadcast_s.unwrap_or(f64::NAN),
            control: self.loop_summary(&measured, granted, controller),
            accuracy: accuracy(received),
            backlog_dropped,
            buses: self.bus_summaries(received, backlog_dropped, &measured),
            processor: driven.processor,
            cell_private_kib: driven.cell_private_kib,
            recording,
        }
    }

    /// The loop's thread, which leaves what the machine granted and what the controller counted.
    fn start_loop(&mut self, mut turn: Turn) -> Result<thread::JoinHandle<(Granted, Counts)>, RunError> {
        let period_ns = self.options.skin.timing.tick_nanos();
        let ticks = self.options.scenario.duration.0 * 1_000 / period_ns;
        let shared = Arc::clone(&self.shared);
        let mut slots: Vec<Slot> = self.lanes.iter_mut().filter_map(|lane| lane.slot.take()).collect();
        let control = move || {
            let granted = realtime::prepare();
            let send = |bus: usize, frames: &[Frame]| {
                slots.get_mut(bus).is_some_and(|slot| slot.read().offer(frames))
            };
            realtime::run(&mut turn, &shared, period_ns, ticks, send);
            (granted, turn.counts().into_iter().filter(|(_, count)| *count > 0).collect())
        };
        let thread = thread::Builder::new().name("control".to_owned()).spawn(control);
        thread.map_err(|error| RunError::Failed(format!("cannot start the control loop: {error}")))
    }

    /// One look around.
    fn step(
        &mut self,
        script: &mut Script,
        progress: &mut Progress,
        measured: &mut Measured,
        records: &mut rtrb::Consumer<Timed>,
        started: Instant,
    ) -> Result<(), RunError> {
        self.press(script)?;
        if self.lanes.iter().any(|lane| lane.receiver.as_ref().is_some_and(thread::JoinHandle::is_finished)) {
            // One that loses its bus stays; one that has gone without a word must not be missed.
            return Err(RunError::Failed("a receiver ended while the loop ran".to_owned()));
        }
        self.break_things(script, progress, started)?;
        self.hear(script, progress)?;
        self.serve_again(progress);
        for note in self.watch_networks()? {
            progress.note(&note);
        }
        self.switch_again(&mut script.told)?;
        let was_halted = measured.halts.why().is_some();
        measured.take(records, self.began);
        match (was_halted, measured.halts.why()) {
            (false, Some(why)) => {
                // One bus is enough: what is heard on it is said on the others.
                let lane = self.lanes.iter().find(|lane| lane.link.is_there()).or_else(|| self.lanes.first());
                let lane = lane.map(|lane| (lane.link.name(), lane.link.kind()));
                let (bus, kind) = lane.unwrap_or(("BUS", BusKind::SocketCan));
                let remedy = format!("`gateway ack {bus} --bus-kind {kind}` lets it go on");
                progress.note(&format!("the robot is halted: {why}; {remedy}"));
            }
            (true, None) => progress.note("the robot goes on"),
            (true, Some(_)) | (false, None) => {}
        }
        for line in self.recorder.iter().flat_map(Recorder::said) {
            progress.note(&line);
        }
        let shared = Arc::clone(&self.shared);
        let lost = self.lanes.iter().filter(|lane| !lane.link.is_there());
        progress.show(|| {
            let cells = self.options.skin.cells.len();
            measured.line(
                started,
                self.options.scenario.duration.0,
                cells,
                shared.comparing.load(Ordering::Relaxed),
                &lost.map(|lane| lane.link.name()).collect::<Vec<_>>(),
            )
        });
        Ok(())
    }

    /// Sends the stimuli of all epochs up to [`LEAD`] ahead.
    fn press(&self, script: &mut Script) -> Result<(), RunError> {
        let broadcasts = self.shared.broadcasts.load(Ordering::Acquire);
        while script.epoch < broadcasts + LEAD {
            // Epochs that have passed while this thread was away cannot be made good one by one.
            let epoch = script.epoch.max(broadcasts);
            let from = From::Epoch(self.first_epoch.plus(epoch.to_le_bytes()[0]));
            for stimulus in script.touches.changes(script.epoch.checked_sub(1), epoch) {
                self.stimulate(&stimulus, from)?;
            }
            script.epoch = epoch + 1;
        }
        Ok(())
    }

    /// Tells some cells again what the scenario makes them feel; what others feel is not its business.
    fn remind(&self, script: &Script, wanted: impl Fn(&Cell) -> bool) -> Result<(), RunError> {
        let touched =
            script.touches.cells().filter_map(|place| Some((place, self.options.skin.cells.get(place)?)));
        for (cell, &Cell { bus, node, .. }) in touched.filter(|(_, cell)| wanted(cell)) {
            let sensors = script.touches.sensors(cell, script.epoch.saturating_sub(1));
            self.stimulate(&Stimulus { cell, bus, node, sensors }, From::Next)?;
        }
        Ok(())
    }

    fn stimulate(&self, stimulus: &Stimulus, from: From) -> Result<(), RunError> {
        let Some((lane, described)) = self.lanes.iter().zip(&self.options.skin.buses).nth(stimulus.bus)
        else {
            return Ok(());
        };
        let message = Message::Stimulus {
            to: Node::Cell(stimulus.node),
            from,
            page: SensorPage::Skin(stimulus.sensors),
        };
        let frames: Vec<Frame> = message.encode().frames(described.format).collect();
        match lane.link.send(&frames) {
            // Counted; what the cells then feel is what the bus carried.
            Err(error) if may_return(&error.cause) => {
                self.shared.unsent.fetch_add(frames.len() as u64, Ordering::Relaxed);
                Ok(())
            }
            sent => Ok(sent.map_err(protocol::bus::BusError::from)?),
        }
    }

    /// Does to processes what the scenario says, when it is time.
    fn break_things(
        &mut self,
        script: &mut Script,
        progress: &mut Progress,
        started: Instant,
    ) -> Result<(), RunError> {
        let options = self.options;
        while let Some(fault) = options.scenario.faults.get(script.fault) {
            if u128::from(fault.at.0) > started.elapsed().as_micros() {
                break;
            }
            script.fault += 1;
            if let FaultKind::Wire { cut, from, to, both_ways } = fault.kind {
                self.break_wire(cut, (from, to), both_ways, progress);
            }
            let FaultKind::Process { action, cells } = &fault.kind else { continue };
            for cell in cells.iter().filter_map(|&cell| options.skin.cells.get(cell)) {
                let done = self.processes.act(cell.bus, cell.node.get(), *action)?;
                let bus = options.skin.buses.get(cell.bus).map_or("", |bus| bus.name.as_str());
                let failed = if done { "" } else { " (no process of ours)" };
                progress.note(&format!("scenario: {action:?} cell {} on {bus}{failed}", cell.node));
            }
        }
        Ok(())
    }

    /// Cuts the wires between two cells, or mends them; the next look at their network tells them.
    fn break_wire(
        &mut self,
        cut: bool,
        (from, to): (usize, usize),
        both_ways: bool,
        progress: &mut Progress,
    ) {
        let cells = &self.options.skin.cells;
        let (Some(from), Some(to)) = (cells.get(from), cells.get(to)) else { return };
        let Some(Some(network)) = self.networks.get_mut(from.bus) else { return };
        network.set_cut(cut, from.node, to.node);
        if both_ways {
            network.set_cut(cut, to.node, from.node);
        }
        let what = if cut { "Cut" } else { "Mend" };
        let way = if both_ways { "between" } else { "one way, from" };
        let (from, to, bus) = (from.node, to.node, network.name());
        progress.note(&format!("scenario: {what} the wires {way} cell {from} and cell {to} on {bus}"));
    }

    /// What the receivers and the processes have to say.
    fn hear(&mut self, script: &Script, progress: &mut Progress) -> Result<(), RunError> {
        let options = self.options;
        let name = |bus: usize| options.skin.buses.get(bus).map_or("", |bus| bus.name.as_str());
        let news: Vec<_> = self.news.try_iter().collect();
        let mut returned = BTreeSet::new();
        let mut changed = BTreeMap::<(usize, &str), Vec<CellId>>::new();
        for (bus, news) in news {
            match news {
                News::Notice(Notice::Rival) => return Err(self.rival(bus)),
                News::Notice(Notice::Dead(cell)) => {
                    changed.entry((bus, "fallen silent")).or_default().push(cell)
                }
                News::Notice(Notice::Back(cell)) => {
                    changed.entry((bus, "spoken again")).or_default().push(cell)
                }
                News::Notice(Notice::Restarted(cell)) => {
                    progress.note(&format!("cell {cell} on {} started anew", name(bus)));
                    // It has forgotten what it felt.
                    self.remind(script, |it| it.bus == bus && it.node == cell)?;
                }
                News::Notice(Notice::Returned(cell)) => {
                    returned.insert((bus, cell));
                }
                News::Notice(Notice::Duplicate(cell)) => {
                    progress.note(&format!(
                        "cell {cell} on {} hears another cell under its number: stop one of the two",
                        name(bus)
                    ));
                }
                News::Down(why) => progress.note(&why),
                News::Up => {
                    progress.note(&format!("{} works again", name(bus)));
                }
                // Who has no bus left feels nothing.
                News::Lost(why) if self.lanes.iter().all(|lane| lane.link.is_gone()) => {
                    return Err(RunError::Failed(why));
                }
                News::Lost(why) => {
                    progress
                        .note(&format!("{why}; the others go on, and it is opened again when it is back"));
                }
                News::Refused(why) => {
                    progress.note(&format!("{} cannot be opened again yet: {why}", name(bus)))
                }
            }
        }
        if !returned.is_empty() {
            // What was to change while they were away did not come to them.
            self.remind(script, |it| returned.contains(&(it.bus, it.node)))?;
            for lane in returned.iter().filter_map(|&(bus, _)| self.lanes.get(bus)) {
                lane.link.returned().store(true, Ordering::Relaxed);
            }
        }
        for ((bus, how), cells) in changed {
            let first: Vec<_> = cells.iter().take(6).map(ToString::to_string).collect();
            let (first, bus) = (first.join(", "), name(bus));
            progress.note(&match cells.len() {
                1 => format!("cell {first} on {bus} has {how}"),
                2..=6 => format!("cells {first} on {bus} have {how}"),
                count => format!("{count} cells on {bus} have {how} ({first} ...)"),
            });
        }
        for ended in self.processes.ended() {
            progress.note(&format!("the process of {} ended ({})", self.cells_of(&ended), ended.status));
        }
        Ok(())
    }

    /// Lets late replies come in, and asks all cells for their counters and a last heartbeat.
    fn last_words(&self, interrupted: bool) -> Result<(), RunError> {
        thread::sleep(Duration::from_secs_f64(2.0 / self.options.skin.timing.broadcast_hz()));
        self.wait_until(|bench| bench.has_caught_up())?;
        self.say(&Message::Report)?;
        self.wait_until(|bench| bench.has_caught_up() && bench.all_have(|said| said.counters))?;
        if interrupted {
            self.say(&Message::Halt)?;
        }
        // Last of all, so that each cell's own count covers everything else that it has sent.
        self.say(&Message::Sync)?;
        self.wait_until(|bench| bench.has_caught_up() && bench.all_have(|said| said.heartbeat))
    }

    /// Whether the receivers have read everything that was sent; what came before it they have read too. Of a bus
    /// that is lost nothing is waited for.
    fn has_caught_up(&self) -> bool {
        self.lanes.iter().all(|lane| {
            let read = lane.view.lock().map_or(u64::MAX, |view| view.commands);
            !lane.link.is_there() || read >= lane.link.commands().load(Ordering::Relaxed)
        })
    }

    /// Whether all cells have said it that can be expected to, on buses that work.
    fn all_have(&self, said: impl Fn(&Said) -> bool) -> bool {
        self.lanes.iter().filter(|lane| lane.link.is_there()).all(|lane| {
            let all = |view: &View| view.cells.iter().all(|cell| !cell.ready || said(&cell.said));
            lane.view.lock().map_or(true, |view| all(&view))
        })
    }

    /// Serves embedded buses again that were ours and whose processes have ended.
    fn serve_again(&mut self, progress: &mut Progress) {
        let gone: Vec<_> = self.lanes.iter().filter(|lane| lane.link.is_gone()).collect();
        for served in &mut self.served {
            let name = served.bus().to_owned();
            if !gone.iter().any(|lane| lane.link.name() == name) {
                continue;
            }
            let Some(status) = served.ended() else { continue };
            let again = program("vcan-setup", self.options.vcan_setup.as_deref())
                .and_then(|program| ServedBus::start(&program, &name, self.options.directory.as_deref()));
            progress.note(&match again {
                Ok(again) => {
                    *served = again;
                    format!("the process that served {name} ended ({status}); it is served again")
                }
                Err(error) => format!("the process that served {name} ended ({status}), and {error}"),
            });
        }
    }

    /// Waits for something, but not for ever; what is missing then shows in the accounts.
    fn wait_until(&self, done: impl Fn(&Self) -> bool) -> Result<(), RunError> {
        let give_up = Instant::now() + LAST_WORDS;
        while !done(self) && Instant::now() < give_up {
            thread::sleep(LOOK);
        }
        Ok(())
    }

    fn spent(&self) -> Spent {
        Spent {
            gateway: usage::own_seconds(),
            cells: self.processes.pids().map(|pid| (pid, usage::processor_seconds(pid))).collect(),
            buses: self.served.iter().map(|it| (it.pid(), usage::processor_seconds(it.pid()))).collect(),
        }
    }

    fn loop_summary(&self, measured: &Measured, granted: Granted, controller: Counts) -> Loop {
        let count = |counter: &std::sync::atomic::AtomicU64| counter.load(Ordering::Relaxed);
        Loop {
            ticks: measured.ticks,
            ticks_skipped: measured.skipped,
            broadcasts: count(&self.shared.broadcasts),
            broadcasts_skipped: count(&self.shared.broadcasts_skipped),
            bad_cycles: measured.bad.clone(),
            controller,
            late_us: Quantiles::of(&measured.late, 1e-3),
            idle_late_us: Quantiles::of(&self.idle, 1e-3),
            took_us: Quantiles::of(&measured.took, 1e-3),
            central_us: Quantiles::of(&measured.central, 1e-3),
            took_distributed_us: Quantiles::of(&measured.took_distributed, 1e-3),
            fifo: granted.fifo,
            memory_locked: granted.locked,
            records_lost: count(&self.shared.records_lost),
            unsent: count(&self.shared.unsent),
        }
    }

    fn bus_summaries(
        &self,
        received: &[Option<Left>],
        backlog_dropped: Option<u64>,
        measured: &Measured,
    ) -> Vec<BusSummary> {
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let now = Micros(u64::try_from(wall.as_micros()).unwrap_or(u64::MAX));
        let pairs = self.lanes.iter().zip(received).enumerate();
        let summary = |(index, (lane, received)): (usize, (&Lane, &Option<Left>))| {
            let received = received.as_ref()?;
            let (bus, kind) = (&lane.link, lane.link.kind().to_string());
            let mut summary = BusSummary::new(
                bus.name(),
                &kind,
                bus.receive_buffer(),
                &received.table,
                received.dropped,
                now,
            );
            let Left { outages, .. } = received;
            summary.outages = OutagesSummary {
                times: outages.times,
                lost_s: outages.lost(Instant::now()).as_secs_f64(),
                at_end: outages.lasts(),
                ticks: measured.missing.get(index.min(31)).copied().unwrap_or(0),
            };
            summary.network =
                self.networks.get(index).and_then(Option::as_ref).map(|network| NetworkSummary {
                    organised_s: network.organised.map(|organised| organised.as_secs_f64()),
                    deepest: network.deepest(),
                    differences: lines(&network.differences),
                    without_way: network.without_way().collect(),
                    longest_without_way_s: network.longest.as_secs_f64(),
                    parent_changes: received.table.parent_changes(),
                });
            Some(summary)
        };
        let mut summaries: Vec<_> = pairs.filter_map(summary).collect();
        // Nobody knows of which bus they were, but of the kernel's own.
        let mut backlog = backlog_dropped.unwrap_or(0);
        for summary in summaries.iter_mut().filter(|summary| summary.kind == BusKind::SocketCan.name()) {
            backlog -= summary.uplink.explain_by_backlog(backlog);
        }
        summaries
    }
}

fn accuracy(received: &[Option<Left>]) -> AccuracySummary {
    let all = received.iter().flatten().map(|received| received.table.accuracy());
    all.fold(Accuracy::default(), Accuracy::with).into()
}

/// Processor time so far, in s.
struct Spent {
    gateway: f64,
    /// Of each cell's process.
    cells: HashMap<u32, f64>,
    /// Of each process that serves a bus.
    buses: HashMap<u32, f64>,
}

impl Spent {
    /// What was spent since, in cores; of processes that are still there.
    fn since(&self, before: &Self, seconds: f64) -> Processor {
        let since = |now: &HashMap<u32, f64>, before: &HashMap<u32, f64>| {
            let one = |(pid, spent): (&u32, &f64)| spent - before.get(pid).copied().unwrap_or(0.0);
            // Not sum(), which is -0.0 of no processes.
            now.iter().map(one).fold(0.0, |all, one| all + one) / seconds
        };
        Processor {
            gateway: (self.gateway - before.gateway) / seconds,
            cells: since(&self.cells, &before.cells),
            buses: since(&self.buses, &before.buses),
        }
    }
}
