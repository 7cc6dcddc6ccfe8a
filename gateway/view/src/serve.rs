//! Shows a bench to pages: receives on its buses, and runs the server.

use std::collections::BTreeMap;
use std::io;
use std::iter;
use std::net::TcpListener;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use bench::bus::follow::FollowedItem;
use bench::remote::{BenchState, JsonPipe};
use protocol::bus::{BusError, KindChoices};
use protocol::id::Node;
use protocol::message::{Message, SensorPage, StimulusStart};
use protocol::skin::Skin;
use protocol::time::Micros;

use crate::command::{ControlCommand, DirectCommand, ResolvedCommand};
use crate::followed::{BusOpener, FollowedBus, time_of_read_frames};
use crate::foxglove::{FoxgloveOptions, FoxgloveServer, LiveTopics};
use crate::live::{LiveState, StatusMessage};
use crate::lock_ignoring_poison;
use crate::page_command::PageCommand;
use crate::player::PlayError;
use crate::pressed::TouchRegistry;
use crate::scene::Scene;
use crate::server::{PageAccess, Server, ServerCounts};
use crate::surface::{RowMesh, pack_meshes};

/// The interval between snapshots.
const SNAPSHOT_INTERVAL: Duration = Duration::from_millis(33);
/// The number of snapshots between two status messages.
const SNAPSHOTS_PER_STATUS: u64 = 6;
/// The time for which a thread lets frames accumulate after the first one, so that it wakes up less often.
const FRAME_GATHER_TIME: Duration = Duration::from_millis(8);

/// The skin to be shown, and the settings of the server.
#[derive(Debug)]
pub struct ServeOptions {
    /// The skin to be shown.
    pub skin: Skin,
    /// The surface of the robot's links; empty if it is unknown.
    pub surface: Vec<RowMesh>,
    /// The kind of each bus.
    pub kinds: KindChoices,
    /// The directory of embedded buses; `None` for the default one.
    pub directory: Option<PathBuf>,
    /// The socket that pages connect to.
    pub listener: TcpListener,
    /// The rights of the pages, and the token that they need.
    pub access: PageAccess,
    /// True to wait for buses that do not exist yet.
    pub waits_for_buses: bool,
    /// The connection to the bench that the pages control. The view ends with the bench.
    pub bench: Option<JsonPipe>,
    /// The server of Foxglove's viewers, if there is one.
    pub foxglove: Option<FoxgloveOptions>,
}

/// The reason why a skin cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// A bus cannot be opened.
    #[error("{0}")]
    Bus(BusError),
    /// The recording cannot be played.
    #[error(transparent)]
    Play(#[from] PlayError),
    /// A thread for a bus or for the recording cannot be started.
    #[error("cannot start a thread: {0}")]
    Thread(io::Error),
    /// The server cannot be started.
    #[error("cannot serve the page: {0}")]
    Server(io::Error),
    /// The server of viewers cannot be started.
    #[error("--foxglove: cannot serve viewers: {0}")]
    Viewers(io::Error),
}

/// Shows a skin until `stop` is set. Calls `is_served` once pages can connect.
///
/// # Errors
/// Returns [`ServeError`] if a bus cannot be opened at the start and `patient` is false, or if a thread cannot be
/// started.
pub fn serve(
    options: ServeOptions,
    stop: &AtomicBool,
    is_served: impl FnOnce(),
) -> Result<ServerCounts, ServeError> {
    let ServeOptions {
        skin,
        surface,
        kinds,
        directory,
        listener,
        access,
        waits_for_buses: patient,
        bench,
        foxglove,
    } = options;
    let may_act = access.may_act;
    let opener = BusOpener { kinds: &kinds, directory: directory.as_deref() };
    let buses = skin.buses.iter().map(|bus| FollowedBus::open(bus, opener, patient));
    let buses: Vec<_> = buses.collect::<Result<_, _>>().map_err(ServeError::Bus)?;
    let (shells, corners) = pack_meshes(&surface);
    let scene = Scene { shells, ..Scene::from_skin(&skin, may_act) };
    let scene = serde_json::to_string(&scene).unwrap_or_default();
    let server = Server::start(listener, access, scene, corners).map_err(ServeError::Server)?;
    let viewers =
        foxglove.map(|options| serve_viewers(options, &skin)).transpose().map_err(ServeError::Viewers)?;
    let viewers = viewers.as_ref().map(|(_, topics)| topics);
    is_served();
    let live = Mutex::new(LiveState::new(skin));
    thread::scope(|scope| {
        for (index, bus) in buses.iter().enumerate() {
            let live = &live;
            let receive = move || {
                bus.receive(opener, FRAME_GATHER_TIME, stop, |follower| {
                    let mut live = lock_ignoring_poison(live);
                    let mut viewers = viewers.map(lock_ignoring_poison);
                    follower.for_each_item(|item| {
                        if let FollowedItem::Frame(received) = item {
                            live.apply_frame(index, Micros(received.at_nanos / 1_000), &received.frame);
                            if let Some(topics) = &mut viewers {
                                topics.publish_frame(index, received.at_nanos, &received.frame);
                            }
                        }
                    });
                    let dropped = follower.dropped_frames();
                    live.set_bus_state(index, !follower.is_lost(), dropped);
                    live.set_bus_timed(index, bus.is_timed());
                    if let Some(topics) = &mut viewers {
                        topics.publish_state(index, &live, dropped);
                    }
                });
            };
            if let Err(error) = thread::Builder::new().spawn_scoped(scope, receive) {
                stop.store(true, Ordering::Relaxed);
                return Err(ServeError::Thread(error));
            }
        }
        publish_and_execute(&live, &buses, (&server, viewers), bench, stop);
        Ok(())
    })?;
    Ok(server.counts())
}

/// Starts the server of viewers. Returns it with the topics that it sends.
fn serve_viewers(options: FoxgloveOptions, skin: &Skin) -> io::Result<(FoxgloveServer, Mutex<LiveTopics>)> {
    let FoxgloveOptions { listener, token, robot } = options;
    let name = format!("skinbus, live: {}", skin.name);
    let server = FoxgloveServer::start(listener, token, name, false)?;
    let topics = LiveTopics::new(&server, skin, robot)?;
    Ok((server, Mutex::new(topics)))
}

/// Sends snapshots to the pages, and passes their commands to the buses and to the bench.
fn publish_and_execute(
    live: &Mutex<LiveState>,
    buses: &[FollowedBus],
    (server, viewers): (&Server, Option<&Mutex<LiveTopics>>),
    mut bench: Option<JsonPipe>,
    stop: &AtomicBool,
) {
    let mut pressed = TouchRegistry::default();
    let mut state = None;
    let mut next = Instant::now();
    let mut number = 0_u64;
    while !stop.load(Ordering::Relaxed) {
        for (page, command) in server.commands() {
            let is_done = match command {
                PageCommand::Control(command) => execute_command(
                    (page, &command),
                    &lock_ignoring_poison(live),
                    &mut pressed,
                    buses,
                    bench.as_mut(),
                ),
                // The server handles selections, and there is no recording to be played.
                PageCommand::Select(_) | PageCommand::Playback(_) => false,
            };
            if !is_done {
                server.count_ignored_command();
            }
        }
        if let Some(run) = &mut bench {
            state = iter::from_fn(|| run.receive::<BenchState>()).last().or(state);
            if run.has_ended() {
                stop.store(true, Ordering::Relaxed);
            }
        }
        let now = time_of_read_frames(buses);
        let due = {
            let mut live = lock_ignoring_poison(live);
            live.handle_time(now);
            if let Some(topics) = viewers {
                lock_ignoring_poison(topics).publish_diagnostics(&live);
            }
            let due = pressed.due_stimuli(now, |cell| live.latched_sensors(cell, now));
            if server.page_count() > 0 {
                let snapshot = live.snapshot(now, &pressed);
                let said = number.is_multiple_of(SNAPSHOTS_PER_STATUS).then(|| {
                    let seen = |cell| state.as_ref().map(|state: &BenchState| state.for_cell(cell));
                    let mut said = StatusMessage { bench: seen(None), ..live.status_message(now) };
                    let all = to_json(&said);
                    let own = server.selected_cells().into_iter().map(|(page, chosen)| {
                        let cell = chosen.cell.find(live.skin()).ok();
                        said.bench = seen(cell.map(|(bus, node)| (bus, node.get())));
                        said.detail = live.cell_detail(&chosen, now);
                        (page, to_json(&said))
                    });
                    (all, own.collect::<BTreeMap<_, _>>())
                });
                drop(live);
                server.publish_snapshot(snapshot, said);
                number += 1;
            }
            due
        };
        for ((bus, node), sensors) in due {
            let page = SensorPage::Skin(sensors);
            let message = Message::Stimulus { to: Node::Cell(node), from: StimulusStart::Next, page };
            if let Some(bus) = buses.get(bus) {
                let _ = bus.send(&message);
            }
        }
        for (index, bus) in buses.iter().enumerate() {
            if let Some(figures) = bus.poll_figures() {
                lock_ignoring_poison(live).set_bus_figures(index, figures);
            }
        }
        next = (next + SNAPSHOT_INTERVAL).max(Instant::now());
        thread::sleep(next.saturating_duration_since(Instant::now()).max(Duration::from_millis(1)));
    }
}

fn to_json(said: &StatusMessage) -> String {
    serde_json::to_string(said).unwrap_or_default()
}

/// Executes a command of a page. Returns false if it has no effect: there is no such cell or bus, the cell may not be
/// pressed, no run takes the command, or it is not one of a page.
fn execute_command(
    (page, command): (u64, &ControlCommand),
    live: &LiveState,
    pressed: &mut TouchRegistry,
    buses: &[FollowedBus],
    bench: Option<&mut JsonPipe>,
) -> bool {
    // A touch that is not possible ends the one before it.
    let is_touch = matches!(command, ControlCommand::Press { .. } | ControlCommand::Release { .. });
    match command.resolve(live.skin()) {
        Ok(ResolvedCommand::Bench(command)) => return bench.is_some_and(|run| run.send(&command)),
        Ok(ResolvedCommand::Direct(DirectCommand::Press { cell, force_n })) if live.is_pressable(cell) => {
            pressed.press(page, cell, force_n);
        }
        Ok(ResolvedCommand::Direct(DirectCommand::Release { .. })) => pressed.release(page),
        Ok(ResolvedCommand::Direct(DirectCommand::Send(message))) => {
            buses.iter().for_each(|bus| _ = bus.send(&message));
        }
        Ok(ResolvedCommand::Direct(
            DirectCommand::Press { .. } | DirectCommand::Epochs { .. } | DirectCommand::Report,
        ))
        | Err(_) => {
            if is_touch {
                pressed.release(page);
            }
            return false;
        }
    }
    true
}
