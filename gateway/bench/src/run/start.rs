//! Start of a run: from a description to open buses with receivers.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use protocol::bus::{Bus, BusKind, BusOptions, Filter, KindChoice};
use protocol::can::Format;
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{self, SkinReply};
use protocol::usage::eprint_line;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGXFSZ};

use super::RunOptions;
use super::bench::{Bench, RunBus};
use super::commander::SwitchedBuses;
use super::hosts::OtherHosts;
use super::network::Network;
use super::receiver::{BusEvent, Receiver, check_interval};
use crate::bus::follow::Follower;
use crate::bus::link::{BusSlot, ReceiveEnd, SharedBus};
use crate::bus::realtime;
use crate::bus::roots::{ReceiveFilter, RootWires};
use crate::bus::served::{AbsentBusAction, BusTarget, ServedBus, open_or_serve, open_or_serve_all};
use crate::emulate::{self, Emulation, Emulator};
use crate::error::RunError;
use crate::processes::ended::EndedProcesses;
use crate::processes::{Processes, program_path, raise_open_file_limit};
use crate::record::feed::{self, RecorderFeed, RecorderSender};
use crate::record::{McapOutput, Recorder, RecordingOutputs, backlog, facts};
use crate::signals::{SignalError, catch_signals};
use crate::threads::spawn;
use crate::view::BusView;
use control::controller::{Controller, PlannedController};
use control::cycle::ControlCycle;
use control::cycle::turn::{BusPort, SharedRunState, TimedRecord};
use control::motion::controller_for_motion;
use control::robot::SimulatedArm;
use model::table::BusTable;
use protocol::quantiles::Quantiles;
use trace::capture::bus_time_property;
use trace::recording::layout::Layout;
use trace::recording::series::FileHead;

/// Maximum time for which the sending of stimuli and commands waits for a full bus. The loop's own frames never wait.
const SEND_TIMEOUT: Duration = Duration::from_millis(10);
/// Maximum time for which a receiver gathers frames; it normally gathers for the time of a tick.
const MAX_GATHER_TIME: Duration = Duration::from_millis(10);
/// Remark on a receive buffer that is smaller than the requested size.
const SMALL_BUFFER_REMARK: &str =
    ", the maximum that net.core.rmem_max allows: frames of a burst may be lost (and are counted)";

/// Claims files and opens buses; [`Bench::bring_up_cells`] starts the cells.
pub(super) fn start(options: &RunOptions) -> Result<Bench<'_>, RunError> {
    let began = Instant::now();
    let emulator = check_options(options)?;
    let skin = &options.skin;
    let signalled = catch_signals(&[SIGHUP, SIGINT, SIGTERM])?;
    // Ignore the signal, so that a file at its size limit is an ordinary write error.
    signal_hook::flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false)))
        .map_err(|source| SignalError { signal: SIGXFSZ, source })?;
    let outputs =
        RecordingOutputs::open_outputs(&options.record, &signalled, eprint_line).map_err(|refused| {
            if signalled.load(Ordering::Relaxed) { RunError::Interrupted } else { refused.into() }
        })?;
    let numbered = options.record.candump.as_ref().is_some_and(|candump| candump.numbered);
    let log = outputs.candump_path().filter(|_| numbered).map(Path::to_owned);
    // From here on an external controller can connect, so that it is ready when the loop starts.
    let controller: Box<dyn Controller> = match &options.planned {
        Some(motion) => {
            let motion = motion.clone();
            Box::new(PlannedController::new(skin, move |seconds| motion.state_at(seconds).position))
        }
        None => controller_for_motion(skin, &options.scenario.motion)?,
    };
    let arm = SimulatedArm::new(skin, options.scenario.motion.start);
    let cycle = Some(ControlCycle::new(skin, controller, Box::new(arm)));
    let idle = realtime::idle_lateness(skin.timing.tick_nanos());
    let backlog_dropped = backlog::dropped_packets();
    let (mut served, mut processes) = (Vec::new(), Processes::new()?);
    // Commission the cells before this run opens its buses, because the run would take the commissioning for another
    // gateway.
    let emulation = emulator
        .map(|emulator| start_emulated_cells(options, &emulator, &mut served, &mut processes, &signalled));
    let emulation = emulation.transpose()?;
    let targets = skin.buses.iter().enumerate().map(|(index, bus)| {
        let receive_filter = ReceiveFilter::for_bus(skin, index, !outputs.is_empty());
        bus_target(options, bus, receive_filter.filters)
    });
    let targets: Vec<_> = targets.collect();
    let (opened, own) = open_or_serve_all(&targets, action_if_bus_absent(options))?;
    served.extend(own);
    let opened = skin.buses.iter().zip(targets).zip(opened);
    let opened = opened.map(|((bus, target), opened)| create_link(options, bus, target.options, opened));
    let opened = opened.collect::<Result<Vec<_>, _>>()?;
    let shared = Arc::new(SharedRunState::default());
    let (tell, bus_event) = mpsc::channel();
    let (mut bus_links, mut feeds) = (Vec::new(), Vec::new());
    for (index, (receive_end, slot)) in opened.into_iter().enumerate() {
        let view = Arc::new(Mutex::new(BusView::default()));
        let recorded = || {
            feed::bus_feed(
                skin.buses.len(),
                outputs.records_all(),
                Arc::clone(&view),
                Arc::clone(&receive_end.link.state),
            )
        };
        let (outlet, feed) = (!outputs.is_empty()).then(recorded).unzip();
        feeds.extend(feed);
        bus_links.push(start_receiver(
            options,
            index,
            (receive_end, slot),
            view,
            outlet,
            &shared,
            tell.clone(),
        )?);
    }
    let (recorder, recorded) = start_recorder(options, outputs, feeds, &bus_links, &idle)?;
    Ok(Bench {
        options,
        began,
        idle,
        backlog_dropped,
        shared,
        bus_links,
        events: bus_event,
        signalled,
        cycle,
        first_epoch: Epoch(0),
        recorder,
        recorded,
        remotes: Vec::new(),
        is_end_requested: false,
        commanded: SwitchedBuses::default(),
        ended: EndedProcesses::default(),
        log,
        processes,
        _emulation: emulation,
        served,
    })
}

/// Returns an error if this program cannot run a valid description, or if a program or directory is missing. Otherwise
/// returns the emulator, if cells are to be emulated.
fn check_options(options: &RunOptions) -> Result<Option<Emulator<'_>>, RunError> {
    if options.spawn {
        program_path("cell-node")?;
    }
    if let Some(flash) = options.flash.as_ref().filter(|flash| !flash.is_dir()) {
        return Err(RunError::NoFlash(flash.clone()));
    }
    if let Some(error) = RunError::bus_fault(&options.scenario, &options.skin) {
        return Err(error);
    }
    let buses = options.skin.buses.len();
    let clients =
        (0..buses).map(|bus| options.skin.cells_on_bus(bus).count().div_ceil(options.cells_per_process));
    raise_open_file_limit(buses, clients.max().unwrap_or(0))?;
    Ok(options.emulated.as_ref().map(Emulator::new).transpose()?)
}

/// Starts emulated cells and commissions them, on buses that are served meanwhile.
fn start_emulated_cells(
    options: &RunOptions,
    emulator: &Emulator<'_>,
    served: &mut Vec<ServedBus>,
    processes: &mut Processes,
    signalled: &AtomicBool,
) -> Result<Emulation, RunError> {
    let RunOptions { skin, kinds, directory, flash, .. } = options;
    for bus in &skin.buses {
        let target =
            BusOptions { filters: Vec::new(), directory: directory.clone(), ..BusOptions::default() };
        let target = BusOptions { fd: bus.format == Format::Fd, ..target };
        let time = options.bus_time.served_time(bus);
        let target = BusTarget { name: &bus.name, kind: kinds.kind_of(&bus.name), options: target, time };
        let (_, own) = open_or_serve(target, action_if_bus_absent(options))?;
        served.extend(own);
    }
    let bench =
        emulate::EmulationSetup { skin, kinds, directory: directory.as_deref(), flash: flash.as_deref() };
    let emulation = emulator.start(&bench, processes)?;
    let said = emulator.commission(&bench, processes, signalled)?;
    if !options.quiet {
        eprint_line(&said);
    }
    Ok(emulation)
}

/// Returns the action for a bus that does not exist. It is refused if other programs use it: with emulated cells, or
/// with cells that are not started here.
const fn action_if_bus_absent(options: &RunOptions) -> AbsentBusAction {
    if options.spawn && options.emulated.is_none() { AbsentBusAction::Create } else { AbsentBusAction::Fail }
}

/// Returns the options for opening a bus.
fn bus_target<'a>(options: &RunOptions, described: &'a skin::SkinBus, filters: Vec<Filter>) -> BusTarget<'a> {
    let name = &described.name;
    let target = BusOptions {
        fd: described.format == Format::Fd,
        filters,
        own_frames: true,
        error_mask: u32::MAX,
        receive_buffer: options.receive_buffer,
        send_timeout: SEND_TIMEOUT,
        directory: options.directory.clone(),
    };
    let time = options.bus_time.served_time(described);
    BusTarget { name, kind: options.kinds.kind_of(name), options: target, time }
}

/// Creates the link of an opened bus.
fn create_link(
    options: &RunOptions,
    described: &skin::SkinBus,
    target: BusOptions,
    bus: Bus,
) -> Result<(ReceiveEnd, BusSlot), RunError> {
    let name = &described.name;
    if described.reply != SkinReply::Torque && bus.kind().is_interface() && !bus.is_virtual()? {
        return Err(RunError::RealWires(name.clone()));
    }
    if !options.quiet {
        let (kind, bytes) = (bus.kind(), bus.receive_buffer_bytes());
        let less = if bytes < options.receive_buffer { SMALL_BUFFER_REMARK } else { "" };
        let why = match (options.kinds.kind_of(name), kind) {
            (KindChoice::Auto, BusKind::Embedded) => format!(" (there is no interface {name})"),
            _ => String::new(),
        };
        eprint_line(&format!("{name} is {kind}{why}, with a receive buffer of {} KiB{less}", bytes / 1_024));
    }
    let (_, receive_end, slot) = SharedBus::new(bus, target);
    Ok((receive_end, slot))
}

/// Starts the recorder, if anything is to be recorded. Returns it with the queue for the loop's records.
fn start_recorder(
    options: &RunOptions,
    outputs: RecordingOutputs,
    bus_feeds: Vec<feed::BusFeed>,
    bus_links: &[RunBus],
    idle: &Histogram<u64>,
) -> Result<(Option<Recorder>, Option<rtrb::Producer<TimedRecord>>), RunError> {
    if outputs.is_empty() {
        return Ok((None, None));
    }
    let (recorded, ticks) =
        outputs.records_all().then(|| rtrb::RingBuffer::new(feed::TICK_QUEUE_LENGTH)).unzip();
    let head = options
        .record
        .mcap
        .as_ref()
        .map(|mcap| recording_head(options, mcap, bus_links, idle))
        .unwrap_or_default();
    let feed = RecorderFeed { bus_feeds, ticks };
    let mut layout = Layout::new(&options.skin);
    if let Some(robot) = options.record.mcap.as_ref().and_then(|mcap| mcap.robot.clone()) {
        layout = layout.with_robot(robot);
    }
    Ok((Some(outputs.start(feed, layout, head)?), recorded))
}

/// Returns the head that each file of a recording begins with.
fn recording_head(
    options: &RunOptions,
    mcap: &McapOutput,
    bus_links: &[RunBus],
    idle: &Histogram<u64>,
) -> FileHead {
    let nanos = realtime::wall_clock_ns();
    let mut run = vec![
        ("duration_s".to_owned(), options.scenario.duration.seconds().to_string()),
        ("spawn".to_owned(), options.spawn.to_string()),
        ("cells_per_process".to_owned(), options.cells_per_process.to_string()),
    ];
    run.extend(bus_links.iter().map(|RunBus { link, format, .. }| {
        let format = format.name();
        let how = format!("{}, {format}, receive buffer {} bytes", link.kind, link.receive_buffer);
        (format!("bus/{}", link.name), how)
    }));
    let timed = bus_links.iter().filter(|bus_link| bus_link.link.is_timed);
    run.extend(timed.map(|timed| bus_time_property(&timed.link.name)));
    let metadata = vec![
        ("program", facts::program_metadata(&mcap.command_line, nanos)),
        ("machine", facts::machine_metadata(&Quantiles::from_histogram(idle, 1e-3))),
        ("configuration", facts::configuration_metadata(&options.skin, run)),
        ("configuration_hashes", facts::configuration_hashes(&options.skin)),
    ];
    FileHead { nanos, metadata, attachments: mcap.attachments.clone() }
}

/// Starts the receiver of a bus.
fn start_receiver(
    options: &RunOptions,
    index: usize,
    (receive_end, slot): (ReceiveEnd, BusSlot),
    view: Arc<Mutex<BusView>>,
    outlet: Option<RecorderSender>,
    shared: &Arc<SharedRunState>,
    bus_event: mpsc::Sender<(usize, BusEvent)>,
) -> Result<RunBus, RunError> {
    let skin = &options.skin;
    let (link, shared) = (Arc::clone(&receive_end.link), Arc::clone(shared));
    let mut table = BusTable::new(skin, index);
    if !ReceiveFilter::for_bus(skin, index, outlet.is_some()).all_sums {
        table.receive_root_sums_only();
    }
    let root_wires = RootWires::for_bus(skin, index);
    if root_wires.is_some() {
        table.use_root_wires_not_tree_pages();
    }
    let (snapshots, snapshot) = triple_buffer::triple_buffer(table.snapshot());
    let (positions, of_broadcasts) = rtrb::RingBuffer::<(Epoch, [f64; MAX_JOINTS])>::new(64);
    let format = skin.buses.get(index).map_or(Format::Fd, |bus| bus.format);
    let line = BusPort { format, snapshot, positions, state: Arc::clone(&link.state) };
    let (in_doubt, not_reached) = mpsc::channel();
    let receiver = Receiver {
        index,
        receive_end,
        follower: Follower::new(
            root_wires,
            Duration::from_nanos(skin.timing.tick_nanos()).min(MAX_GATHER_TIME),
        ),
        check_interval: check_interval(skin.cells.len()),
        table,
        snapshots,
        positions: of_broadcasts,
        outlet,
        shared: Arc::clone(&shared),
        view: Arc::clone(&view),
        events: bus_event,
        possibly_missed: not_reached,
    };
    let receiver = Some(spawn(&format!("rx {}", link.name), move || receiver.run())?);
    let network = Network::for_bus(skin, index);
    let line = Some((line, slot));
    let figures_before = link.request_figures();
    Ok(RunBus {
        link,
        format,
        port: line,
        view,
        receiver,
        possibly_missed: in_doubt,
        hosts: OtherHosts::new(),
        network,
        shared,
        figures_before,
    })
}
