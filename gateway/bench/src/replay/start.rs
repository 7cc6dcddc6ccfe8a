//! From options to buses that are open and cells that are as they have to be.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::Write as _;
use std::os::fd::AsRawFd;
use std::path::PathBuf;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::{Bus, BusError, BusKind, Choice, Filter, Inbox, Kinds, Options as BusOptions};
use protocol::can::{Format, Frame};
use protocol::id::{CellId, Command, Id, Kind, Node};
use protocol::message::{Message, State as Flags};
use protocol::skin::Skin;
use protocol::time::Micros;
use rustix::fs::{MemfdFlags, memfd_create};

use super::hall::Hall;
use super::judge::Judge;
use super::live::{Lane, mode};
use super::reel::Only;
use super::survey::{Known, Survey};
use super::teller::Teller;
use super::{Options, Spawn};
use crate::run::RunError;
use crate::run::launch::{LISTEN, Plan, Processes, STARTING, ServedBus, open_or_serve, program};
use crate::run::roots::{Ears, Roots};
use model::decode::{Decoded, Decoder};
use trace::capture::Extras;

/// Cells that were there before say something within this time, by heartbeats alone.
const SHOWING: Duration = Duration::from_secs(1);
/// Cells of which none more finds a way up for so long have none: two hellos, and a search.
const ORGANISING: Duration = Duration::from_secs(2);
/// How often it is looked.
const LOOK: Duration = Duration::from_millis(5);

/// Where the capture's buses go.
#[derive(Clone, Debug)]
pub(super) struct Routes {
    /// By the capture's buses: the lane, if its frames are sent.
    pub(super) lanes: Vec<Option<usize>>,
    /// By lane: which of the capture's buses it is, and what it is called now.
    pub(super) names: Vec<(usize, String)>,
}

impl Routes {
    /// By `--bus` and `--map`.
    pub(super) fn new(options: &Options, survey: &Survey, capture: &str) -> Result<Self, RunError> {
        let known = |name: &str, option: &str| match survey.bus_named(name) {
            Some(bus) => Ok(bus),
            None => Err(RunError::Usage(format!(
                "{option}: {capture} has no bus {name}; it has {}",
                survey.names()
            ))),
        };
        let mut wanted = BTreeSet::new();
        for name in &options.buses {
            wanted.insert(known(name, &format!("--bus {name}"))?);
        }
        let mut targets: Vec<_> = survey.buses.iter().map(|bus| bus.name.clone()).collect();
        let mut mapped = BTreeSet::new();
        for (from, to) in &options.map {
            let bus = known(from, &format!("--map {from}={to}"))?;
            if !mapped.insert(bus) {
                return Err(RunError::Usage(format!(
                    "--map names {from} twice: a bus goes to one other bus"
                )));
            }
            if let Some(target) = targets.get_mut(bus) {
                target.clone_from(to);
            }
        }
        let mut routes = Self { lanes: Vec::new(), names: Vec::new() };
        for (bus, target) in targets.into_iter().enumerate() {
            let goes = wanted.is_empty() || wanted.contains(&bus);
            routes.lanes.push(goes.then_some(routes.names.len()));
            if goes {
                routes.names.push((bus, target));
            }
        }
        let names = routes.names.iter().map(|(_, name)| name.as_str());
        options.kinds.clone().only(names).map_err(|error| RunError::Usage(error.to_string()))?;
        let distinct: BTreeSet<_> = routes.names.iter().map(|(_, name)| name).collect();
        if options.hears() && distinct.len() < routes.names.len() {
            return Err(RunError::Usage(
                "two buses of the capture go to one: whose cells would answer? give each a bus of its own, or leave \
                 out --expect, --lockstep and --only inputs"
                    .to_owned(),
            ));
        }
        Ok(routes)
    }
}

/// Buses, and the processes that were started for them.
#[derive(Debug)]
pub(super) struct Buses {
    pub(super) lanes: Arc<Vec<Lane>>,
    /// Which of them nobody served before.
    pub(super) own: Vec<bool>,
    /// The gateway's side of the wires to their roots, where cells reply with sums and wires are simulated; taken by
    /// who hears.
    pub(super) roots: Vec<Option<Roots>>,
    /// Where there are such.
    wired: Vec<bool>,
    // In this order they end: the cells before their buses.
    pub(super) processes: Processes,
    _served: Vec<ServedBus>,
}

/// The skin of the cells that are started.
#[derive(Debug)]
pub(super) struct Wearing {
    pub(super) skin: Skin,
    pub(super) file: PathBuf,
    /// Where an attached one is kept, so that cells can read it.
    _memory: Option<std::fs::File>,
}

/// The skin of the cells that are started: the one that is named, or the one that the recording has.
pub(super) fn wearing(
    spawn: &Spawn,
    routes: &Routes,
    extras: &Extras,
    file: &str,
) -> Result<Wearing, RunError> {
    let mut wearing = if let Some(path) = &spawn.skin {
        Wearing { skin: Skin::read(path)?, file: path.clone(), _memory: None }
    } else {
        let attached = extras.attachments.iter().find(|(name, _)| name == "skin.toml");
        let Some((_, bytes)) = attached else {
            return Err(RunError::Usage(format!(
                "--spawn: {file} has no skin attached, as recordings of `gateway run --record` have: name it with \
                 --skin SKIN.toml"
            )));
        };
        let text = String::from_utf8_lossy(bytes);
        let skin = Skin::parse(&format!("the skin in {file}"), &text)?;
        let in_memory = || -> std::io::Result<std::fs::File> {
            let mut file = std::fs::File::from(memfd_create("skin.toml", MemfdFlags::CLOEXEC)?);
            file.write_all(bytes)?;
            Ok(file)
        };
        let memory = in_memory().map_err(|error| RunError::Failed(format!("a file in memory: {error}")))?;
        let file = PathBuf::from(format!("/proc/{}/fd/{}", std::process::id(), memory.as_raw_fd()));
        Wearing { skin, file, _memory: Some(memory) }
    };
    for (_, name) in &routes.names {
        if wearing.skin.bus_named(name).is_none() {
            let names = wearing.skin.buses.iter().map(|bus| bus.name.as_str()).collect::<Vec<_>>().join(", ");
            return Err(RunError::Usage(format!(
                "--spawn: the capture goes to {name}, and the skin {} has {names}: send it there with --map",
                wearing.skin.name
            )));
        }
    }
    // Cells on other buses would have nobody to hear.
    let buses = wearing.skin.buses.clone();
    let goes =
        |bus: usize| buses.get(bus).is_some_and(|bus| routes.names.iter().any(|(_, name)| *name == bus.name));
    wearing.skin.cells.retain(|cell| goes(cell.bus));
    Ok(wearing)
}

/// The skin that a recording has, if it has one that can be read.
pub(super) fn recorded_skin(extras: &Extras) -> Option<Skin> {
    let (_, bytes) = extras.attachments.iter().find(|(name, _)| name == "skin.toml")?;
    Skin::parse("skin.toml", &String::from_utf8_lossy(bytes)).ok()
}

/// Opens all buses. What is `recorded` is the skin of the cells that are there already, if it is known.
pub(super) fn open(
    options: &Options,
    survey: &Survey,
    routes: &Routes,
    wearing: Option<&Wearing>,
    recorded: Option<&Skin>,
) -> Result<Buses, RunError> {
    let (mut lanes, mut own, mut served) = (Vec::new(), Vec::new(), Vec::new());
    let mut roots = Vec::new();
    for (bus, name) in &routes.names {
        let Some(surveyed) = survey.buses.get(*bus) else { continue };
        let described = wearing.and_then(|wearing| wearing.skin.buses.iter().find(|bus| bus.name == *name));
        let format = described.map(|bus| bus.format).or(surveyed.format);
        let worn = wearing.map(|wearing| (&wearing.skin, name)).or_else(|| Some((recorded?, &surveyed.name)));
        let worn = worn.and_then(|(skin, name)| Some((skin, skin.bus_named(name)?)));
        let ears = worn.map_or_else(|| vec![Filter::ALL], |(skin, bus)| Ears::of(skin, bus, true).filters);
        let wanted = BusOptions {
            fd: surveyed.has_fd || format == Some(Format::Fd),
            filters: if options.hears() { ears } else { Vec::new() },
            receive_buffer: options.receive_buffer,
            send_patience: options.patience,
            ..BusOptions::default()
        };
        let (bus, of_ours) = match wearing {
            Some(_) => open_or_serve(name, options.kinds.of(name), &wanted, options.vcan_setup.as_deref())?,
            None => (Bus::open(name, options.kinds.of(name), &wanted)?, None),
        };
        // On a real bus the wires are real.
        let has_wires = options.hears() && (bus.kind() == BusKind::Embedded || bus.is_virtual()?);
        roots.push(worn.filter(|_| has_wires).and_then(|(skin, bus)| Roots::of(skin, bus)));
        own.push(of_ours.is_some());
        served.extend(of_ours);
        lanes.push(Lane { bus: Arc::new(bus), format: format.unwrap_or(Format::Fd) });
    }
    let wired = roots.iter().map(Option::is_some).collect();
    Ok(Buses { lanes: Arc::new(lanes), own, roots, wired, processes: Processes::default(), _served: served })
}

impl Buses {
    /// Listens on the buses that were there before, as long as two gateways need to notice each other.
    pub(super) fn listen(&self) -> Result<Vec<BTreeSet<CellId>>, RunError> {
        let mut heard = vec![BTreeSet::new(); self.lanes.len()];
        let wanted = BusOptions {
            filters: vec![Filter::exact(Id::command(Command::Joints)), Filter::kind(Kind::Network)],
            ..BusOptions::default()
        };
        let mut open = Vec::new();
        for (index, (lane, own)) in self.lanes.iter().zip(&self.own).enumerate() {
            if !own {
                let fd = lane.format == Format::Fd;
                open.push((
                    index,
                    Bus::open(
                        lane.bus.name(),
                        Choice::Only(lane.bus.kind()),
                        &BusOptions { fd, ..wanted.clone() },
                    )?,
                ));
            }
        }
        let (until, mut inbox, mut decoder) = (Instant::now() + LISTEN, Inbox::new(), Decoder::new(None));
        while !open.is_empty() && Instant::now() < until {
            thread::sleep(LOOK);
            for (index, bus) in &open {
                if bus.receive(&mut inbox)? == 0 {
                    continue;
                }
                for received in inbox.frames() {
                    let at = Micros(received.at_nanos / 1_000);
                    match speaker(&decoder.decode(at, bus.name(), &received.frame)) {
                        Some(Node::Gateway) => return Err(rival(bus.name())),
                        Some(Node::Cell(cell)) => {
                            if let Some(cells) = heard.get_mut(*index) {
                                cells.insert(cell);
                            }
                        }
                        Some(Node::Everyone) | None => {}
                    }
                }
            }
        }
        Ok(heard)
    }

    /// Starts the cells of a skin on buses where there are none.
    pub(super) fn start_cells(
        &mut self,
        spawn: &Spawn,
        wearing: &Wearing,
        heard: &[BTreeSet<CellId>],
    ) -> Result<(), RunError> {
        let there = self.lanes.iter().zip(heard).find(|(_, cells)| !cells.is_empty());
        if let Some((lane, cells)) = there {
            let cells: Vec<_> = cells.iter().copied().collect();
            return Err(RunError::Failed(format!(
                "cells are on {} already: {}; leave out --spawn to use them, or stop them",
                lane.bus.name(),
                names(&cells)
            )));
        }
        let kinds = Kinds::exactly(self.lanes.iter().map(|lane| (lane.bus.name(), lane.bus.kind())));
        self.processes = Processes::start(&Plan {
            directory: None,
            program: &program("cell-node", spawn.cell_node.as_deref())?,
            skin_file: &wearing.file,
            skin: &wearing.skin,
            kinds: &kinds,
            per_process: spawn.cells_per_process,
            flash: None,
        })?;
        Ok(())
    }

    /// Waits until the cells that have to be there answer, or nobody more does.
    pub(super) fn call_the_roll(
        &mut self,
        hall: &Hall,
        wanted: &[BTreeSet<CellId>],
        interrupted: impl Fn() -> bool,
    ) -> Result<(), RunError> {
        let patience = if self.processes.pids().next().is_some() { STARTING } else { SHOWING };
        for lane in self.lanes.iter() {
            send(lane, &Message::Sync)?;
        }
        let (mut most, mut progress) = (0, Instant::now());
        loop {
            thread::sleep(LOOK);
            if interrupted() {
                return Err(RunError::Failed("interrupted while starting".to_owned()));
            }
            if let Some(ended) = self.processes.ended().first() {
                let ((first, last), status) = (ended.nodes, ended.status);
                return Err(RunError::Failed(format!(
                    "the process of cells {first} to {last} ended while starting ({status}); see its message above"
                )));
            }
            let judge = hall.judge();
            if let Some(lane) = judge.rival() {
                return Err(rival(self.lanes.get(lane).map_or("", |lane| lane.bus.name())));
            }
            let settled = |(lane, cells): (usize, &BTreeSet<CellId>)| {
                judge
                    .present(lane)
                    .filter(|(cell, present)| cells.contains(cell) && present.claim.is_settled())
                    .count()
            };
            let there: usize = wanted.iter().enumerate().map(settled).sum();
            if there > most {
                (most, progress) = (there, Instant::now());
            }
            if there == wanted.iter().map(BTreeSet::len).sum::<usize>() || progress.elapsed() > patience {
                return Ok(());
            }
        }
    }
}

impl Buses {
    /// Waits until all cells that reply with sums have a way to the gateway, or nobody more finds one.
    pub(super) fn let_them_organise(
        &self,
        hall: &Hall,
        teller: &Teller,
        interrupted: impl Fn() -> bool,
    ) -> Result<(), RunError> {
        let wired: Vec<_> =
            (0..self.wired.len()).filter(|lane| self.wired.get(*lane) == Some(&true)).collect();
        for lane in wired.iter().filter_map(|lane| self.lanes.get(*lane)) {
            send(lane, &Message::Report)?;
        }
        let (mut least, mut progress) = (usize::MAX, Instant::now());
        loop {
            let judge = hall.judge();
            let without: Vec<_> = wired.iter().map(|lane| (*lane, judge.without_a_way(*lane))).collect();
            drop(judge);
            let count: usize = without.iter().map(|(_, cells)| cells.len()).sum();
            if count < least {
                (least, progress) = (count, Instant::now());
            }
            if count == 0 || interrupted() {
                return Ok(());
            }
            if progress.elapsed() > ORGANISING {
                for (lane, cells) in without.iter().filter(|(_, cells)| !cells.is_empty()) {
                    let name = self.lanes.get(*lane).map_or("", |lane| lane.bus.name());
                    teller
                        .say(&format!("cells on {name} have no way to the gateway's side: {}", names(cells)));
                }
                return Ok(());
            }
            thread::sleep(LOOK);
        }
    }
}

/// What has to hold of the cells before a comparison with a recording means anything.
#[derive(Clone, Debug)]
pub(super) struct Checks {
    pub(super) survey: Arc<Survey>,
    pub(super) routes: Routes,
    /// Whether replies are compared.
    pub(super) expects: bool,
    /// Whether cells were started here.
    pub(super) spawned: bool,
    /// What the capture is called.
    pub(super) name: String,
}

impl Checks {
    /// The cells that the recording has in the part that is replayed, by lane.
    pub(super) fn recorded(&self) -> Vec<BTreeSet<CellId>> {
        let bounds = self.survey.bounds();
        let of = |(bus, _): &(usize, String)| {
            let bus = self.survey.buses.get(*bus);
            bus.map(|bus| bus.cells_in(bounds).map(|(cell, _)| cell).collect()).unwrap_or_default()
        };
        self.routes.names.iter().map(of).collect()
    }

    /// Whether the state in force where the replay begins has to be brought about with new parameters: then cells
    /// have them only after that.
    pub(super) fn configures(&self) -> bool {
        self.routes
            .names
            .iter()
            .any(|(bus, _)| self.survey.buses.get(*bus).is_some_and(|bus| bus.state.configures()))
    }

    /// The cells have to be there, with the configuration that they had.
    pub(super) fn hashes(&self, judge: &Judge) -> Result<(), String> {
        if !self.expects {
            return Ok(());
        }
        let (mut checked, mut absent, mut other) = (0_usize, String::new(), String::new());
        let (mut others, mut count) = (0_usize, 0_usize);
        for (lane, ((bus, name), cells)) in self.routes.names.iter().zip(self.recorded()).enumerate() {
            let there = judge.present(lane).filter(|(_, present)| present.claim.is_settled());
            let there: Vec<_> = there
                .filter_map(|(cell, present)| Some((cell, present.claim.heartbeat()?.configuration)))
                .collect();
            let missing: Vec<_> =
                cells.iter().copied().filter(|cell| !there.iter().any(|(it, _)| it == cell)).collect();
            if !missing.is_empty() {
                let _ = write!(absent, "{}{} on {name}", comma(&absent), names(&missing));
            }
            count += cells.len();
            let mut differing = Vec::new();
            for cell in cells {
                let recorded =
                    self.survey.buses.get(*bus).and_then(|bus| bus.cells.get(&cell)).map(|it| it.hash);
                let now = there.iter().find(|(it, _)| *it == cell).map(|(_, hash)| *hash);
                let (Some(Known::Yes(recorded)), Some(now)) = (recorded, now) else { continue };
                checked += 1;
                if recorded != now {
                    differing.push(format!("{cell} (recorded {recorded:04X}, now {now:04X})"));
                }
            }
            others += differing.len();
            if !differing.is_empty() {
                let more = if differing.len() > 4 { ", ..." } else { "" };
                let shown = differing.get(..differing.len().min(4)).unwrap_or_default().join(", ");
                let _ = write!(other, "{}{shown}{more} on {name}", comma(&other));
            }
        }
        let remedy = if self.spawned {
            "name the recording's skin with --skin"
        } else {
            "configure them for the recording's skin, or start them from it with --spawn"
        };
        if count > 0 && others == count {
            return Err(format!(
                "the recording is of another skin: all {count} cells have another configuration than then, {other}; \
                 {remedy}"
            ));
        }
        if others > 0 {
            return Err(format!("cells have another configuration than in the recording: {other}; {remedy}"));
        }
        if !absent.is_empty() {
            return Err(format!(
                "cells of the recording are absent: {absent}; start them with cell-node, or all with --spawn"
            ));
        }
        if checked == 0 {
            return Err(
                "nothing can be compared: the recording has no heartbeat of a cell, so nothing says of which skin it \
                 is; record for half a second at least"
                    .to_owned(),
            );
        }
        Ok(())
    }

    /// The cells on each lane that measure, though in the recording they obeyed stimuli.
    pub(super) fn measuring(&self, judge: &Judge) -> Vec<Vec<CellId>> {
        let measures = |(lane, (bus, _)): (usize, &(usize, String))| {
            let obeyed = |cell: &CellId| {
                let recorded = self.survey.buses.get(*bus).and_then(|bus| bus.cells.get(cell));
                recorded.is_some_and(|recorded| !recorded.measured)
            };
            let now = judge
                .present(lane)
                .filter(|(_, present)| present.claim.is_settled() && !present.claim.says(Flags::TEST_MODE));
            now.map(|(cell, _)| cell).filter(obeyed).collect()
        };
        self.routes.names.iter().enumerate().map(measures).collect()
    }
}

/// Puts cells that measure into test mode, or says who they are.
pub(super) fn into_test_mode(
    options: &Options,
    lanes: &[Lane],
    measuring: &[Vec<CellId>],
    hall: &Hall,
) -> Result<(), RunError> {
    if !options.test_mode {
        return Ok(());
    }
    for (lane, cells) in lanes.iter().zip(measuring) {
        for cell in cells {
            send(lane, &mode(Node::Cell(*cell), true))?;
        }
        if !cells.is_empty() {
            send(lane, &Message::Sync)?;
        }
    }
    let give_up = Instant::now() + SHOWING;
    loop {
        let judge = hall.judge();
        let obeys = |(lane, cells): (usize, &Vec<CellId>)| {
            cells.iter().all(|cell| {
                let mut present = judge.present(lane).filter(|(it, _)| it == cell);
                present.any(|(_, it)| it.claim.says(Flags::TEST_MODE))
            })
        };
        if measuring.iter().enumerate().all(obeys) {
            return Ok(());
        }
        drop(judge);
        if Instant::now() > give_up {
            let all: Vec<_> = measuring.iter().flatten().copied().collect();
            return Err(RunError::Failed(format!("cells do not go into test mode: {}", names(&all))));
        }
        thread::sleep(LOOK);
    }
}

/// Sends one message.
pub(super) fn send(lane: &Lane, message: &Message) -> Result<(), RunError> {
    let frames: Vec<Frame> = lane.frames(message).collect();
    Ok(lane.bus.send(&frames).map_err(BusError::from)?)
}

/// Who speaks, when it is a gateway or a cell that is there for good.
const fn speaker(decoded: &Decoded) -> Option<Node> {
    if let Decoded::Message(Message::Network { from, .. }) = decoded {
        Some(*from)
    } else if let Decoded::Message(Message::Joints { .. }) = decoded {
        Some(Node::Gateway)
    } else {
        None
    }
}

/// Another gateway is on a bus.
pub(super) fn rival(bus: &str) -> RunError {
    RunError::Failed(format!(
        "another gateway is on {bus}: stop it, or send the capture to another bus with --map"
    ))
}

fn comma(text: &str) -> &'static str {
    if text.is_empty() { "" } else { "; " }
}

/// The numbers of some cells, for people.
pub(super) fn names(cells: &[CellId]) -> String {
    let numbers: Vec<_> = cells.iter().map(ToString::to_string).collect();
    match numbers.len() {
        count @ 13.. => format!("{count} cells ({} ...)", numbers.get(..6).unwrap_or_default().join(", ")),
        _ => numbers.join(", "),
    }
}

impl Options {
    /// Whether cells are listened to.
    pub(super) fn hears(&self) -> bool {
        self.expect || self.lockstep || self.only == Only::Inputs
    }
}
