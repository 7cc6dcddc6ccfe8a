//! Start of a replay: from options to open buses and started cells.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::{Bus, BusError, BusOptions, Filter, KindChoice, KindChoices};
use protocol::can::{Format, Frame};
use protocol::id::{CellId, Command, Id, Kind, Node};
use protocol::message::{Message, Request};
use protocol::parameters::Parameter;
use protocol::sine::SineMethod;
use protocol::skin::Skin;

use super::player::ReplaySpeed;
use super::replay_plan::SenderFilter;
use super::survey::Survey;
use super::{ReplayError, ReplayOptions, SpawnOptions};
use crate::bus::listen::{self, Listener};
use crate::bus::roots::{ReceiveFilter, RootWires};
use crate::bus::served::{AbsentBusAction, BusTarget, ServedBus, open_or_serve};
use crate::processes::{CellLaunch, GATEWAY_DETECTION_TIME, Processes, create_memory_file, program_path};
use crate::setup::format_cells;
use model::decode::Decoded;
use trace::capture::{RecordingExtras, SKIN_ATTACHMENT};

/// Interval between polls.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// Destinations of the capture's buses.
#[derive(Clone, Debug)]
pub(super) struct BusRoutes {
    /// Destination index of each bus of the capture; `None` if it is not replayed.
    pub(super) destinations: Vec<Option<usize>>,
    /// Index of each destination's bus in the capture, and name of the destination in this replay.
    pub(super) names: Vec<(usize, String)>,
}

impl BusRoutes {
    /// Evaluates `--bus` and `--map`.
    pub(super) fn new(options: &ReplayOptions, survey: &Survey, capture: &str) -> Result<Self, ReplayError> {
        let known = |name: &str, option: String| {
            let (capture, buses) = (capture.to_owned(), survey.bus_names());
            let bus = name.to_owned();
            survey.bus_named(name).ok_or(ReplayError::NoBus { option, capture, bus, buses })
        };
        let mut selected = BTreeSet::new();
        for name in &options.buses {
            selected.insert(known(name, format!("--bus {name}"))?);
        }
        let mut targets: Vec<_> = survey.buses.iter().map(|bus| bus.name.clone()).collect();
        let mut mapped = BTreeSet::new();
        for (from, to) in &options.map {
            let bus = known(from, format!("--map {from}={to}"))?;
            if !mapped.insert(bus) {
                return Err(ReplayError::MapTwice(from.clone()));
            }
            if let Some(target) = targets.get_mut(bus) {
                target.clone_from(to);
            }
        }
        let mut routes = Self { destinations: Vec::new(), names: Vec::new() };
        for (bus, target) in targets.into_iter().enumerate() {
            let is_replayed = selected.is_empty() || selected.contains(&bus);
            routes.destinations.push(is_replayed.then_some(routes.names.len()));
            if is_replayed {
                routes.names.push((bus, target));
            }
        }
        let names = routes.names.iter().map(|(_, name)| name.as_str());
        options.kinds.clone().restrict_to(names)?;
        let distinct: BTreeSet<_> = routes.names.iter().map(|(_, name)| name).collect();
        if options.receives_cell_messages() && distinct.len() < routes.names.len() {
            return Err(ReplayError::Merged);
        }
        Ok(routes)
    }
}

/// One open bus of a replay.
#[derive(Debug)]
pub(super) struct ReplayBus {
    pub(super) bus: Bus,
    pub(super) format: Format,
    /// True if this replay serves the bus.
    own: bool,
    /// True if the cells of the bus reply with sums over simulated wires.
    pub(super) wired: bool,
}

impl ReplayBus {
    pub(super) fn encode_frames(&self, message: &Message) -> impl Iterator<Item = Frame> + use<> {
        message.encode().frames(self.format)
    }

    /// Sends messages of this replay itself, which are not from the capture.
    pub(super) fn send(&self, messages: &[Message]) -> Result<(), BusError> {
        let frames: Vec<_> = messages.iter().flat_map(|message| self.encode_frames(message)).collect();
        Ok(self.bus.send(&frames)?)
    }
}

/// Open buses of a replay, and the processes that the replay has started for them.
#[derive(Debug)]
pub(super) struct Buses {
    pub(super) bus_links: Arc<Vec<ReplayBus>>,
    /// The gateway's ends of the wires to the roots, until the receiver takes them.
    pub(super) roots: Vec<Option<RootWires>>,
    // The order of the fields matters: the cells are dropped before their buses.
    pub(super) processes: Processes,
    _served: Vec<ServedBus>,
}

/// Skin of the cells to start.
#[derive(Debug)]
pub(super) struct SpawnSkin {
    pub(super) skin: Skin,
    pub(super) file: PathBuf,
    /// Memory file of an attached skin, from which cells read it.
    _memory: Option<std::fs::File>,
}

/// Returns the skin of the cells to start: the skin of the options, or else that of the recording.
pub(super) fn spawn_skin(
    spawn: &SpawnOptions,
    routes: &BusRoutes,
    extras: &RecordingExtras,
    file: &str,
) -> Result<SpawnSkin, ReplayError> {
    let mut skin_override = if let Some(path) = &spawn.skin {
        SpawnSkin { skin: Skin::read(path)?, file: path.clone(), _memory: None }
    } else {
        let attached = extras.attachments.iter().find(|(name, _)| name == SKIN_ATTACHMENT);
        let Some((_, bytes)) = attached else {
            return Err(ReplayError::NoSkin(file.to_owned()));
        };
        let text = String::from_utf8_lossy(bytes);
        let skin = Skin::parse_recorded(&format!("the skin in {file}"), &text)?;
        let (memory, file) = create_memory_file(bytes)?;
        SpawnSkin { skin, file, _memory: Some(memory) }
    };
    for (_, name) in &routes.names {
        if skin_override.skin.bus_index(name).is_none() {
            let buses =
                skin_override.skin.buses.iter().map(|bus| bus.name.as_str()).collect::<Vec<_>>().join(", ");
            let (bus, skin) = (name.clone(), skin_override.skin.name);
            return Err(ReplayError::NotOfSkin { bus, skin, buses });
        }
    }
    // The replay has only these buses: cells on others would receive no frames.
    let buses = skin_override.skin.buses.clone();
    let goes =
        |bus: usize| buses.get(bus).is_some_and(|bus| routes.names.iter().any(|(_, name)| *name == bus.name));
    skin_override.skin.cells.retain(|cell| goes(cell.bus));
    Ok(skin_override)
}

/// Returns the skin attached to a recording, if it is readable.
pub(super) fn recorded_skin(extras: &RecordingExtras) -> Option<Skin> {
    extras.skin()?.ok()
}

/// Opens all buses. `recorded` is the skin of cells that are already on the buses, if known.
pub(super) fn open_buses(
    options: &ReplayOptions,
    survey: &Survey,
    routes: &BusRoutes,
    skin_override: Option<&SpawnSkin>,
    recorded: Option<&Skin>,
) -> Result<Buses, ReplayError> {
    let (mut bus_links, mut roots, mut served) = (Vec::new(), Vec::new(), Vec::new());
    for (bus, name) in &routes.names {
        let Some(surveyed) = survey.buses.get(*bus) else { continue };
        let described = skin_override
            .and_then(|skin_override| skin_override.skin.buses.iter().find(|bus| bus.name == *name));
        let format = described.map(|bus| bus.format).or(surveyed.format);
        let bus_skin = skin_override
            .map(|skin_override| (&skin_override.skin, name))
            .or_else(|| Some((recorded?, &surveyed.name)));
        let spawned_skin = bus_skin.and_then(|(skin, name)| Some((skin, skin.bus_index(name)?)));
        let receive_filter = spawned_skin
            .map_or_else(|| vec![Filter::ALL], |(skin, bus)| ReceiveFilter::for_bus(skin, bus, true).filters);
        let bus_options = BusOptions {
            fd: surveyed.has_fd || format == Some(Format::Fd),
            filters: if options.receives_cell_messages() { receive_filter } else { Vec::new() },
            receive_buffer: options.receive_buffer,
            send_timeout: options.timeout,
            ..BusOptions::default()
        };
        let (bus, served_here) = match skin_override {
            Some(_) => {
                let kind = options.kinds.kind_of(name);
                let time =
                    spawned_skin.and_then(|(skin, bus)| options.bus_time.served_time(skin.buses.get(bus)?));
                let target = BusTarget { name, kind, options: bus_options, time };
                open_or_serve(target, AbsentBusAction::Create)?
            }
            None => match Bus::open(name, options.kinds.kind_of(name), &bus_options) {
                Err(error) if options.expect.is_some() && error.may_open_later() => {
                    return Err(ReplayError::BusAbsent(error));
                }
                opened => (opened?, None),
            },
        };
        // Real buses have real wires.
        let has_wires =
            options.receives_cell_messages() && (!bus.kind().is_interface() || bus.is_virtual()?);
        let root = spawned_skin.filter(|_| has_wires).and_then(|(skin, bus)| RootWires::for_bus(skin, bus));
        let (own, wired) = (served_here.is_some(), root.is_some());
        roots.push(root);
        served.extend(served_here);
        bus_links.push(ReplayBus { bus, format: format.unwrap_or(Format::Fd), own, wired });
    }
    Ok(Buses { bus_links: Arc::new(bus_links), roots, processes: Processes::default(), _served: served })
}

impl Buses {
    /// Receives on the buses that existed before this replay, for as long as two gateways need to detect each other.
    /// Returns the cells found, by bus.
    pub(super) fn find_cells(&self) -> Result<Vec<BTreeSet<CellId>>, ReplayError> {
        let mut found = vec![BTreeSet::new(); self.bus_links.len()];
        let filters = vec![Filter::exact(Id::command(Command::Joints)), Filter::for_kind(Kind::Network)];
        let again = |(index, bus_link): (usize, &ReplayBus)| {
            let options = BusOptions { filters: filters.clone(), ..BusOptions::default() };
            let kind = KindChoice::Only(bus_link.bus.kind());
            let bus = listen::open_bus(bus_link.bus.name(), kind, Some(bus_link.format), options)?;
            Ok((index, Listener::new(bus, None)))
        };
        let others = self.bus_links.iter().enumerate().filter(|(_, bus_link)| !bus_link.own);
        let mut open = others.map(again).collect::<Result<Vec<_>, BusError>>()?;
        let until = Instant::now() + GATEWAY_DETECTION_TIME;
        while !open.is_empty() && Instant::now() < until {
            thread::sleep(POLL_INTERVAL);
            for (index, listener) in &mut open {
                listener.receive(Duration::ZERO)?;
                let speakers: Vec<_> =
                    listener.decoded_frames().filter_map(|(_, decoded)| sender_node(&decoded)).collect();
                for speaker in speakers {
                    match (speaker, found.get_mut(*index)) {
                        (Node::Gateway, _) => {
                            return Err(ReplayError::OtherGateway(listener.bus().name().to_owned()));
                        }
                        (Node::Cell(cell), Some(cells)) => _ = cells.insert(cell),
                        (Node::Cell(_), None) | (Node::Everyone, _) => {}
                    }
                }
            }
        }
        Ok(found)
    }

    /// Starts the cells of a skin, on buses without cells.
    pub(super) fn start_cells(
        &mut self,
        spawn: &SpawnOptions,
        skin_override: &SpawnSkin,
        heard: &[BTreeSet<CellId>],
        sine: SineMethod,
    ) -> Result<(), ReplayError> {
        let there = self.bus_links.iter().zip(heard).find(|(_, cells)| !cells.is_empty());
        if let Some((bus_link, cells)) = there {
            let cells = format_cells(&cells.iter().copied().collect::<Vec<_>>(), "");
            return Err(ReplayError::CellsPresent { bus: bus_link.bus.name().to_owned(), cells });
        }
        let kinds = KindChoices::from_kinds(
            self.bus_links.iter().map(|bus_link| (bus_link.bus.name(), bus_link.bus.kind())),
        );
        self.processes = Processes::new()?;
        self.processes.start(&CellLaunch {
            directory: None,
            program: &program_path("cell-node")?,
            skin_file: &skin_override.file,
            skin: &skin_override.skin,
            kinds: &kinds,
            per_process: spawn.cells_per_process,
            flash: None,
            sine,
        })?;
        Ok(())
    }
}

/// Returns the sender if it is a gateway or a cell.
const fn sender_node(decoded: &Decoded) -> Option<Node> {
    if let Decoded::Message(Message::Network { from, .. }) = decoded {
        Some(*from)
    } else if let Decoded::Message(Message::Joints { .. }) = decoded {
        Some(Node::Gateway)
    } else {
        None
    }
}

impl ReplayOptions {
    /// Returns true if frames are sent at the times of the capture, and not as fast as possible or when cells have
    /// answered.
    pub(super) fn is_timed(&self) -> bool {
        matches!(self.pace, ReplaySpeed::Timed(_)) && !self.lockstep
    }

    /// Returns true if the replay receives messages of cells.
    pub(super) fn receives_cell_messages(&self) -> bool {
        self.expect.is_some() || self.lockstep || self.only == SenderFilter::Inputs
    }
}

/// Returns the message that makes a cell obey stimuli, or measure. In both cases, the cell then drops all stimuli.
pub(super) fn mode_message(cell: CellId, obeys: bool) -> Message {
    let words = core::array::from_fn(|place| i16::from(obeys && place == 0));
    let request = Request::Write { number: Parameter::Mode.number(), words };
    Message::Configure { to: Node::Cell(cell), tag: 0, request }
}
