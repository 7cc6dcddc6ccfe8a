//! From a description to a bench whose cells are ready.

use std::error::Error;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver as Inlet};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use hdrhistogram::Histogram;
use protocol::bus::{BusError, BusKind, Filter, Kinds, Options as BusOptions};
use protocol::can::{Format, Frame};
use protocol::message::Message;
use protocol::packet::{Epoch, WORDS};
use protocol::skin::Reply;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGXFSZ};

use super::launch::{Ended, LISTEN, Plan, Processes, STARTING, ServedBus, open_or_serve, program};
use super::link::{Ear, Link, Slot, may_return};
use super::network::Network;
use super::progress::say;
use super::receiver::{CellView, Left, News, Receiver, View};
use super::roots::{Ears, Roots};
use super::{Options, RunError, realtime};
use crate::record::backlog;
use crate::record::feed::{self, Feed, Unrecorded};
use crate::record::{Mcap, Outputs, Recorder, facts};
use crate::signals::caught;
use control::cycle::Cycle;
use control::cycle::turn::{Line, Shared, Timed};
use control::motion::controller_of;
use control::robot::SimulatedArm;
use model::quantiles::{Quantiles, histogram};
use model::scenario::FaultKind;
use model::table::{Notice, Table};
use trace::recording::account::Recording;
use trace::recording::layout::Layout;
use trace::recording::series::Head;

/// How long stimuli and commands may wait for a full bus; the loop's own frames never wait.
const SEND_PATIENCE: Duration = Duration::from_millis(10);
/// Frames gather for a tick, and no longer than this.
const GATHER: Duration = Duration::from_millis(10);
/// Said when a receive buffer is smaller than it should be.
const LIMITED: &str = ", all that net.core.rmem_max allows: a burst of frames may be lost (and is counted)";
/// Cells that were there before are given so long to show up.
pub(super) const SHOWING: Duration = Duration::from_secs(2);
/// How benches on embedded buses keep out of each other's way.
const ELSEWHERE: &str = "set SKINBUS_DIR to another directory for this run";
/// Wake-ups of the idle machine that are measured, at the loop's period.
const IDLE_WAKEUPS: u32 = 100;
/// Records that wait for the main thread: more than a second of ticks.
const RECORDS: usize = 1_024;

/// One bus of a bench.
#[derive(Debug)]
pub(super) struct Lane {
    pub(super) link: Arc<Link>,
    /// Where the loop finds the bus, until it begins.
    pub(super) slot: Option<Slot>,
    pub(super) view: Arc<Mutex<View>>,
    pub(super) receiver: Option<JoinHandle<Left>>,
}

/// A bench whose cells are ready and whose loop has not begun.
#[derive(Debug)]
pub(super) struct Bench<'a> {
    pub(super) options: &'a Options,
    pub(super) began: Instant,
    pub(super) idle: Histogram<u64>,
    /// What the kernel's backlog had dropped before the first bus was opened.
    pub(super) backlog_dropped: Option<u64>,
    pub(super) shared: Arc<Shared>,
    pub(super) lanes: Vec<Lane>,
    pub(super) lines: Vec<Line>,
    pub(super) news: Inlet<(usize, News)>,
    pub(super) signalled: Arc<AtomicBool>,
    pub(super) cycle: Option<Cycle>,
    /// Each bus' network, where cells answer with sums.
    pub(super) networks: Vec<Option<Network>>,
    /// The epoch of the first broadcast.
    pub(super) first_epoch: Epoch,
    pub(super) recorder: Option<Recorder>,
    /// Where the loop's records go that are to be recorded.
    pub(super) recorded: Option<rtrb::Producer<Timed>>,
    // In this order they end: the cells before their buses.
    pub(super) processes: Processes,
    pub(super) served: Vec<ServedBus>,
}

/// Claims files and opens buses; [`Bench::begin`] starts the cells.
pub(super) fn start(options: &Options) -> Result<Bench<'_>, RunError> {
    let began = Instant::now();
    refuse(options)?;
    let signalled = caught(&[SIGHUP, SIGINT, SIGTERM]).map_err(RunError::Failed)?;
    // A file that may have no more bytes is an error like others, and no end.
    signal_hook::flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false)))
        .map_err(|error| RunError::Failed(format!("cannot catch signal {SIGXFSZ}: {error}")))?;
    let outputs = Outputs::claim(&options.record, &signalled, say).map_err(|refused| {
        if signalled.load(Ordering::Relaxed) { interrupted() } else { RunError::Usage(refused) }
    })?;
    let numbered = options.record.candump.as_ref().is_some_and(|candump| candump.numbered);
    if let Some(log) = outputs.log().filter(|_| numbered && !options.quiet) {
        say(&format!("frames are recorded in {}", log.display()));
    }
    // An external controller can find its socket from now on, so that it is there when the loop begins.
    let cycle = Some(cycle(options)?);
    let idle = idle_lateness(options.skin.timing.tick_nanos());
    let backlog_dropped = backlog::dropped();
    let mut served = Vec::new();
    let mut buses = Vec::new();
    for (index, described) in options.skin.buses.iter().enumerate() {
        let ears = Ears::of(&options.skin, index, !outputs.is_empty());
        let (link, ear, slot) = open(options, &described.name, ears.filters, &mut served)?;
        if !options.quiet {
            let kib = link.receive_buffer() / 1_024;
            let (name, kind) = (link.name(), link.kind());
            let less = if link.receive_buffer() < options.receive_buffer { LIMITED } else { "" };
            say(&format!("{name} is {kind}, with a receive buffer of {kib} KiB{less}"));
        }
        buses.push((link, ear, slot));
    }
    let shared = Arc::new(Shared::default());
    let (tell, news) = mpsc::channel();
    let (mut lanes, mut lines) = (Vec::new(), Vec::new());
    let mut feeds = Vec::new();
    for (index, (link, ear, slot)) in buses.into_iter().enumerate() {
        let view = Arc::new(Mutex::new(View::default()));
        let recorded = |()| feed::lane(outputs.wants_all(), Arc::clone(&view), Arc::clone(link.works()));
        let (outlet, feed) = (!outputs.is_empty()).then_some(()).map(recorded).unzip();
        let seat = Seat { index, ear, slot, view, outlet };
        let (lane, line) = listen(options, seat, &shared, tell.clone())?;
        lanes.push(lane);
        lines.push(line);
        feeds.extend(feed);
    }
    let (recorder, recorded) = record(options, outputs, feeds, &lanes, &idle)?;
    let processes = Processes::default();
    let first_epoch = Epoch(0);
    Ok(Bench {
        options,
        began,
        idle,
        backlog_dropped,
        shared,
        lanes,
        lines,
        news,
        signalled,
        cycle,
        networks: (0..options.skin.buses.len()).map(|bus| Network::of(&options.skin, bus)).collect(),
        first_epoch,
        recorder,
        recorded,
        processes,
        served,
    })
}

/// The loop's state, by the scenario's motion.
fn cycle(options: &Options) -> Result<Cycle, RunError> {
    let (skin, motion) = (&options.skin, options.scenario.motion);
    let controller = controller_of(skin, &motion).map_err(|error| {
        // Its cause says why the system refuses.
        let cause = error.source().map(|cause| format!(": {cause}")).unwrap_or_default();
        RunError::Usage(format!("{error}{cause}"))
    })?;
    Ok(Cycle::new(skin, controller, Box::new(SimulatedArm::new(skin, motion.start_rad))))
}

/// What a description may say and this program cannot do, and what it needs and is not there.
fn refuse(options: &Options) -> Result<(), RunError> {
    if options.spawn {
        program("cell-node", options.cell_node.as_deref())?;
    }
    if let Some(flash) = options.flash.as_deref().filter(|flash| !flash.is_dir()) {
        let flash = flash.display();
        return Err(RunError::Usage(format!("--flash {flash}: there is no such directory; make it first")));
    }
    if options.scenario.faults.iter().any(|fault| matches!(fault.kind, FaultKind::Bus { .. })) {
        return Err(RunError::Usage(
            "the scenario has a fault of a bus, which a run with processes cannot make; kill, stop, continue, \
             restart, cut, mend, stuck and drift it can"
                .to_owned(),
        ));
    }
    Ok(())
}

/// Measured in a thread as punctual as the loop's.
fn idle_lateness(period_ns: u64) -> Histogram<u64> {
    let measure = move || {
        realtime::prepare();
        realtime::idle_lateness(period_ns, IDLE_WAKEUPS)
    };
    thread::spawn(measure).join().unwrap_or_else(|_| histogram())
}

/// Opens a bus; an embedded one that nobody serves is served.
fn open(
    options: &Options,
    name: &str,
    filters: Vec<Filter>,
    served: &mut Vec<ServedBus>,
) -> Result<(Arc<Link>, Ear, Slot), RunError> {
    let wanted = BusOptions {
        fd: options.skin.buses.iter().any(|bus| bus.name == name && bus.format == Format::Fd),
        filters,
        own_frames: true,
        error_mask: u32::MAX,
        receive_buffer: options.receive_buffer,
        send_patience: SEND_PATIENCE,
        directory: options.directory.clone(),
    };
    let (bus, own) = open_or_serve(name, options.kinds.of(name), &wanted, options.vcan_setup.as_deref())?;
    served.extend(own);
    let sums = options.skin.buses.iter().any(|bus| bus.name == name && bus.reply != Reply::Torque);
    if sums && bus.kind() == BusKind::SocketCan && !bus.is_virtual()? {
        return Err(RunError::Usage(format!(
            "{name} is real hardware, and the wires between cells that answer with sums are simulated by frames that may \
             not go there: use a vcan or the embedded bus, or reply = \"torque\""
        )));
    }
    Ok(Link::new(bus, wanted))
}

/// Starts the thread that records, if anything is to be recorded; where the loop's records go to it.
fn record(
    options: &Options,
    outputs: Outputs,
    feeds: Vec<feed::Lane>,
    lanes: &[Lane],
    idle: &Histogram<u64>,
) -> Result<(Option<Recorder>, Option<rtrb::Producer<Timed>>), RunError> {
    if outputs.is_empty() {
        return Ok((None, None));
    }
    let (recorded, ticks) = outputs.wants_all().then(|| rtrb::RingBuffer::new(feed::TICKS)).unzip();
    let head =
        options.record.mcap.as_ref().map_or_else(Head::default, |mcap| head(options, mcap, lanes, idle));
    let feed = Feed { lanes: feeds, ticks };
    let recorder = outputs.start(feed, Layout::new(&options.skin), head);
    let recorder = recorder.map_err(|error| RunError::Failed(format!("cannot start a thread: {error}")))?;
    Ok((Some(recorder), recorded))
}

/// What each file of a recording begins with.
fn head(options: &Options, mcap: &Mcap, lanes: &[Lane], idle: &Histogram<u64>) -> Head {
    let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let nanos = u64::try_from(wall.as_nanos()).unwrap_or(u64::MAX);
    let mut run = vec![
        (
            "duration_s".to_owned(),
            (Duration::from_micros(options.scenario.duration.0)).as_secs_f64().to_string(),
        ),
        ("spawn".to_owned(), options.spawn.to_string()),
        ("cells_per_process".to_owned(), options.cells_per_process.to_string()),
    ];
    for (lane, described) in lanes.iter().zip(&options.skin.buses) {
        let (kind, bytes) = (lane.link.kind(), lane.link.receive_buffer());
        let format = match described.format {
            Format::Fd => "fd",
            Format::Classic => "classic",
        };
        run.push((
            format!("bus/{}", described.name),
            format!("{kind}, {format}, receive buffer {bytes} bytes"),
        ));
    }
    let metadata = vec![
        ("program", facts::program(&mcap.command_line, nanos)),
        ("machine", facts::machine(&Quantiles::of(idle, 1e-3))),
        ("configuration", facts::configuration(&options.skin, run)),
        ("configuration_hashes", facts::hashes(&options.skin)),
    ];
    Head { nanos, metadata, attachments: mcap.attachments.clone() }
}

/// What a bus and its receiver have in common with others.
struct Seat {
    index: usize,
    ear: Ear,
    slot: Slot,
    view: Arc<Mutex<View>>,
    outlet: Option<feed::Outlet>,
}

/// Starts a bus' receiver.
fn listen(
    options: &Options,
    seat: Seat,
    shared: &Arc<Shared>,
    news: mpsc::Sender<(usize, News)>,
) -> Result<(Lane, Line), RunError> {
    let Seat { index, ear, slot, view, outlet } = seat;
    let link = Arc::clone(&ear.link);
    let mut table = Table::new(&options.skin, index);
    if !Ears::of(&options.skin, index, outlet.is_some()).all_sums {
        table.hear_sums_of_roots_only();
    }
    let (snapshots, snapshot) = triple_buffer::triple_buffer(table.snapshot());
    let (positions, of_broadcasts) = rtrb::RingBuffer::<(Epoch, [f64; WORDS])>::new(64);
    let format = options.skin.buses.get(index).map_or(Format::Fd, |bus| bus.format);
    let (works, commands) = (Arc::clone(link.works()), Arc::clone(link.commands()));
    let returned = Arc::clone(link.returned());
    let line = Line { format, snapshot, positions, works, commands, returned };
    let receiver = Receiver {
        index,
        ear,
        gather: Duration::from_nanos(options.skin.timing.tick_nanos()).min(GATHER),
        table,
        roots: Roots::of(&options.skin, index),
        snapshots,
        positions: of_broadcasts,
        outlet,
        shared: Arc::clone(shared),
        view: Arc::clone(&view),
        news,
    };
    let name = format!("rx {}", link.name());
    let thread = thread::Builder::new().name(name).spawn(move || receiver.run());
    let thread = thread.map_err(|error| RunError::Failed(format!("cannot start a thread: {error}")))?;
    Ok((Lane { link, slot: Some(slot), view, receiver: Some(thread) }, line))
}

impl Bench<'_> {
    /// Starts the cells, listens for another gateway, and waits until all cells are ready.
    pub(super) fn begin(&mut self) -> Result<(), RunError> {
        let options = self.options;
        let listened = Instant::now() + LISTEN;
        if options.spawn {
            if self.served.len() < self.lanes.len() {
                self.find_alone(listened)?;
            }
            let program = program("cell-node", options.cell_node.as_deref())?;
            self.processes = Processes::start(&Plan {
                program: &program,
                skin_file: &options.skin_file,
                skin: &options.skin,
                kinds: &Kinds::exactly(self.lanes.iter().map(|lane| (lane.link.name(), lane.link.kind()))),
                directory: options.directory.as_deref(),
                per_process: options.cells_per_process,
                flash: options.flash.as_deref(),
            })?;
        }
        let patience = if options.spawn { STARTING } else { SHOWING };
        let (mut most, mut progress) = (0, Instant::now());
        loop {
            thread::sleep(Duration::from_millis(5));
            self.hear_while_starting()?;
            // Who has no parameters will not get any by waiting.
            let ready = self.count(|cell| cell.ready || cell.unconfigured);
            if ready > most {
                (most, progress) = (ready, Instant::now());
            }
            // Where the machine was away for a moment, all may look dead that were ready before it: they speak again.
            if Instant::now() >= listened
                && (ready == options.skin.cells.len() || progress.elapsed() > patience)
            {
                break;
            }
        }
        self.judge_start()?;
        self.wake_up()?;
        self.go_on_after_others();
        self.switch_cells()?;
        // What they have counted and feel, and where they are in their networks.
        self.say(&Message::Report)?;
        self.organise()
    }

    /// Cells that a gateway before this one has halted go on.
    fn wake_up(&mut self) -> Result<(), RunError> {
        self.say(&Message::Resume)?;
        let halted = |bench: &Self| bench.count(|cell| cell.halted);
        if halted(self) == 0 {
            return Ok(());
        }
        // Their next heartbeats say so.
        self.say(&Message::Sync)?;
        let give_up = Instant::now() + SHOWING;
        while halted(self) > 0 && Instant::now() < give_up {
            thread::sleep(Duration::from_millis(5));
            self.hear_while_starting()?;
        }
        Ok(())
    }

    /// A bus that was there before may have a gateway, or cells whose numbers ours would take: nobody is
    /// disturbed by listening first.
    fn find_alone(&mut self, until: Instant) -> Result<(), RunError> {
        while Instant::now() < until {
            thread::sleep(Duration::from_millis(5));
            self.hear_while_starting()?;
        }
        let there = self.names(|cell| cell.heard);
        if there.is_empty() {
            return Ok(());
        }
        let embedded = self.lanes.iter().any(|lane| lane.link.kind() == BusKind::Embedded);
        let remedy = if embedded { format!("stop them, or {ELSEWHERE}") } else { "or stop them".to_owned() };
        Err(RunError::Failed(format!(
            "cells are on the bus already: {there}; use them with --no-spawn, {remedy}"
        )))
    }

    /// Cells that were there before have heard another gateway: its epochs go on.
    fn go_on_after_others(&mut self) {
        if self.options.spawn {
            return;
        }
        let heard = |_: &str, view: &View| {
            let ready = view.cells.iter().filter(|cell| cell.ready);
            ready.map(|cell| cell.last_joints).collect::<Vec<_>>()
        };
        let last = after(&self.each_view(heard).concat());
        self.first_epoch = last.next();
        if let Some(cycle) = &mut self.cycle {
            cycle.start_after(last);
        }
    }

    fn judge_start(&self) -> Result<(), RunError> {
        let silent = self.names(|cell| !cell.ready && !cell.unconfigured);
        let unconfigured = self.names(|cell| cell.unconfigured);
        let ready = self.count(|cell| cell.ready);
        if !unconfigured.is_empty() && (ready == 0 || self.options.spawn) {
            return Err(RunError::Failed(format!(
                "cells without parameters: {unconfigured}; write them with `gateway commission`, or delete \
                 their flash files if these are damaged"
            )));
        }
        if ready == 0 || (self.options.spawn && !silent.is_empty()) {
            let remedy = if self.options.spawn {
                "see their own messages above"
            } else {
                "start them with cell-node, or leave out --no-spawn"
            };
            return Err(RunError::Failed(format!("cells that are not ready: {silent}; {remedy}")));
        }
        let other = self.names(|cell| cell.ready && cell.other);
        if !other.is_empty() {
            let remedy = "write it into them with `gateway commission`, or delete their flash files";
            return Err(RunError::Failed(format!(
                "cells that are configured for another skin than {}: {other}; {remedy}",
                self.options.skin_file.display()
            )));
        }
        if !self.options.quiet {
            for (what, who) in [("do not answer", silent), ("have no parameters", unconfigured)] {
                if !who.is_empty() {
                    say(&format!("cells that {what}, the run goes on without them: {who}"));
                }
            }
        }
        Ok(())
    }

    /// Another gateway, a process that ends or a bus that is gone end the start.
    pub(super) fn hear_while_starting(&mut self) -> Result<(), RunError> {
        if self.signalled.load(Ordering::Relaxed) {
            return Err(interrupted());
        }
        for (bus, news) in self.news.try_iter() {
            match news {
                News::Notice(Notice::Rival) => return Err(self.rival(bus)),
                News::Down(why) | News::Lost(why) | News::Refused(why) => return Err(RunError::Failed(why)),
                News::Notice(_) | News::Up => {}
            }
        }
        if let Some(ended) = self.processes.ended().first() {
            let (cells, status) = (self.cells_of(ended), ended.status);
            let why = format!("{cells} ended while starting ({status}); see the message above");
            return Err(RunError::Failed(why));
        }
        Ok(())
    }

    /// Another gateway is on a bus.
    pub(super) fn rival(&self, bus: usize) -> RunError {
        let Some(link) = self.lanes.get(bus).map(|lane| &lane.link) else {
            return RunError::Failed("another gateway is on the bus".to_owned());
        };
        let remedy = match link.kind() {
            BusKind::SocketCan => "give this one another bus",
            BusKind::Embedded => ELSEWHERE,
        };
        RunError::Failed(format!("another gateway is on {}: stop one of the two, or {remedy}", link.name()))
    }

    /// The cells of a process that has ended, for people.
    pub(super) fn cells_of(&self, ended: &Ended) -> String {
        let bus = self.options.skin.buses.get(ended.bus).map_or("", |bus| bus.name.as_str());
        match ended.nodes {
            (first, last) if first == last => format!("cell {first} on {bus}"),
            (first, last) => format!("cells {first} to {last} on {bus}"),
        }
    }

    pub(super) fn count(&self, wanted: impl Fn(&CellView) -> bool) -> usize {
        self.each_view(|_, view| view.cells.iter().filter(|cell| wanted(cell)).count()).into_iter().sum()
    }

    /// The names of some cells, for people: `1, 2, 5 on vcan0`.
    fn names(&self, wanted: impl Fn(&CellView) -> bool) -> String {
        let names = self.each_view(|bus, view| {
            let nodes = view.cells.iter().filter(|cell| wanted(cell)).map(|cell| cell.node.to_string());
            let nodes: Vec<_> = nodes.collect();
            match nodes.len() {
                0 => String::new(),
                count @ 13.. => {
                    format!("{count} cells on {bus} ({} ...)", nodes.get(..6).unwrap_or_default().join(", "))
                }
                _ => format!("{} on {bus}", nodes.join(", ")),
            }
        });
        names.into_iter().filter(|names| !names.is_empty()).collect::<Vec<_>>().join("; ")
    }

    pub(super) fn each_view<T>(&self, look: impl Fn(&str, &View) -> T) -> Vec<T> {
        let look = |lane: &Lane| lane.view.lock().ok().map(|view| look(lane.link.name(), &view));
        self.lanes.iter().filter_map(look).collect()
    }

    /// Sends a command on every bus.
    pub(super) fn say(&self, message: &Message) -> Result<(), RunError> {
        for (lane, described) in self.lanes.iter().zip(&self.options.skin.buses) {
            let frames: Vec<Frame> = message.encode().frames(described.format).collect();
            match lane.link.send(&frames).map_err(BusError::from) {
                Ok(()) => lane.link.commands().fetch_add(1, Ordering::Relaxed),
                // Counted; a bus that is lost for a while costs no run its end.
                Err(error) if may_return(&error) => {
                    self.shared.unsent.fetch_add(frames.len() as u64, Ordering::Relaxed)
                }
                Err(error) => return Err(error.into()),
            };
        }
        Ok(())
    }

    /// Lets the receivers end and takes what they leave.
    pub(super) fn stop_receivers(&mut self) -> Vec<Option<Left>> {
        self.shared.stop.store(true, Ordering::Relaxed);
        let end = |lane: &mut Lane| lane.receiver.take().and_then(|thread| thread.join().ok());
        self.lanes.iter_mut().map(end).collect()
    }

    /// Ends the recording, when nobody hands over more.
    pub(super) fn finish_recording(&mut self, received: &[Option<Left>]) -> Option<Recording> {
        let add = |all: Unrecorded, one: &Left| Unrecorded {
            frames: all.frames + one.unrecorded.frames,
            epochs: all.epochs + one.unrecorded.epochs,
        };
        let unrecorded = received.iter().flatten().fold(Unrecorded::default(), add);
        let ticks = self.shared.records_unrecorded.load(Ordering::Relaxed);
        self.recorder.take().map(|recorder| recorder.finish(unrecorded, ticks))
    }

    /// The queue through which the loop's records come, both ends.
    pub(super) fn records() -> (rtrb::Producer<Timed>, rtrb::Consumer<Timed>) {
        rtrb::RingBuffer::new(RECORDS)
    }
}

fn interrupted() -> RunError {
    RunError::Failed("interrupted while starting".to_owned())
}

/// The epoch after which to begin on cells that have taken these last, the first cell's if that can be: joints of the
/// epoch that a cell has taken last it takes for repeated ones. Buses need not have had the same.
fn after(taken: &[Epoch]) -> Epoch {
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
        let first = |taken: &[u8]| after(&taken.iter().map(|&epoch| Epoch(epoch)).collect::<Vec<_>>()).0;
        assert_eq!(first(&[]), 0);
        assert_eq!(first(&[7, 7, 7]), 7);
        assert_eq!(first(&[7, 7, 200, 200]), 7);
        assert_eq!(first(&[255, 255, 0, 0, 1]), 1, "0 would be repeated on one bus, and 1 on another");
    }
}
