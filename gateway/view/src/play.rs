//! Plays a recording to pages: runs the player, a thread that builds the index, and the server.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use protocol::skin::Skin;
use trace::capture::Reader;

use crate::curves::RecordedCurves;
use crate::foxglove::{FoxgloveOptions, FoxgloveServer, PlayedTopics};
use crate::index::Progress;
use crate::live::StatusMessage;
use crate::page_command::{PageCommand, PlaybackCommand};
use crate::player::{PlayError, Player};
use crate::pressed::TouchRegistry;
use crate::scene::Scene;
use crate::serve::ServeError;
use crate::server::{PageAccess, Server, ServerCounts};
use crate::surface::{RowMesh, pack_meshes};
use crate::tape::EventKind;

/// The interval between snapshots.
const SNAPSHOT_INTERVAL: Duration = Duration::from_millis(33);
/// The number of snapshots between two status messages.
const SNAPSHOTS_PER_STATUS: u64 = 6;
/// The number of equal parts of the time line that are marked if they contain events.
const TIMELINE_PARTS: u16 = 600;

/// The recording to be played, and the settings of the server.
#[derive(Debug)]
pub struct PlayOptions {
    /// A candump log, or all parts of an MCAP recording.
    pub paths: Vec<PathBuf>,
    /// The skin whose buses were recorded.
    pub skin: Skin,
    /// The surface of the robot's links; empty if it is unknown.
    pub surface: Vec<RowMesh>,
    /// The socket that pages connect to.
    pub listener: TcpListener,
    /// The rights of the pages, and the token that they need.
    pub access: PageAccess,
    /// The position at which playback is paused at first, in s of the run or in s since the first frame. If it is
    /// `None`, playback starts at the beginning.
    pub at_s: Option<f64>,
    /// The server of Foxglove's viewers, if there is one.
    pub foxglove: Option<FoxgloveOptions>,
}

/// Plays a recording until `stop` is set. Calls `is_served` once pages can connect, and `warns` with each defect of the
/// recording when it is found.
///
/// # Errors
/// Returns an error if a thread cannot be started, or if the recording cannot be read or is damaged. The pages show the
/// part before the damage.
pub fn play_recording(
    options: PlayOptions,
    stop: &AtomicBool,
    is_served: impl FnOnce(),
    warns: impl Fn(&str) + Sync,
) -> Result<ServerCounts, ServeError> {
    let PlayOptions { paths, skin, surface, listener, access, at_s, foxglove } = options;
    let mut player = Player::open(&paths, skin.clone())?;
    let reader = Reader::open_with_all_topics(&paths).map_err(PlayError::from)?;
    let (shells, corners) = pack_meshes(&surface);
    let scene =
        serde_json::to_string(&Scene { shells, ..Scene::from_skin(&skin, false) }).unwrap_or_default();
    let server = Server::start(listener, access, scene, corners).map_err(ServeError::Server)?;
    let viewers = foxglove.map(|options| serve_viewers(options, reader.name(), &paths)).transpose()?;
    let (_viewers, mut topics) = viewers.unzip();
    is_served();
    let (index, times) = (player.index(), (player.first_frame_ns(), player.time_origin_ns()));
    server.set_recording(RecordedCurves::new(Arc::clone(&index), skin.clone(), times.1));
    let name = reader.name().to_owned();
    thread::scope(|scope| {
        let (index, name, warns) = (&index, &name, &warns);
        let build = move || {
            index.build(reader, skin, times, stop);
            let Progress { failed, unfinished, .. } = index.progress();
            let unfinished = unfinished.map(|what| format!("{name}: {what}"));
            failed.iter().chain(&unfinished).for_each(|what| warns(what));
        };
        thread::Builder::new().spawn_scoped(scope, build).map_err(ServeError::Thread)?;
        match at_s {
            Some(at_s) => player.seek(at_s).map_err(PlayError::from)?,
            None => player.play(1.0),
        }
        publish_and_execute(&mut player, (&server, topics.as_mut()), stop);
        Ok::<_, ServeError>(())
    })?;
    index.progress().failed.map_or_else(|| Ok(server.counts()), |what| Err(PlayError::Damaged(what).into()))
}

/// Starts the server of viewers. Returns it with the topics that it sends.
fn serve_viewers(
    options: FoxgloveOptions,
    name: &str,
    paths: &[PathBuf],
) -> Result<(FoxgloveServer, PlayedTopics), ServeError> {
    let FoxgloveOptions { listener, token, robot: _ } = options;
    let name = format!("skinbus: {name}");
    let server = FoxgloveServer::start(listener, token, name, true).map_err(ServeError::Viewers)?;
    let topics = PlayedTopics::open(&server, paths).map_err(PlayError::from)?;
    Ok((server, topics))
}

/// Sends the state of the player to the pages and viewers, and executes the commands of pages.
fn publish_and_execute(
    player: &mut Player,
    (server, mut viewers): (&Server, Option<&mut PlayedTopics>),
    stop: &AtomicBool,
) {
    let nobody = TouchRegistry::default();
    let (mut next, mut before) = (Instant::now(), Instant::now());
    let (mut number, mut jumps) = (0_u64, u64::MAX);
    let mut marks = (usize::MAX, BTreeMap::new());
    while !stop.load(Ordering::Relaxed) {
        let mut failed = None;
        // The cells of a recording cannot be pressed or halted.
        let commands = server.commands().filter_map(|(_, command)| match command {
            PageCommand::Playback(command) => Some(command),
            PageCommand::Control(_) | PageCommand::Select(_) => None,
        });
        let commands: Vec<_> = commands.collect();
        let mut is_changed = !commands.is_empty();
        for (place, command) in commands.iter().enumerate() {
            // A slider sends many positions. Only the last of consecutive ones is used.
            let is_passed = matches!(commands.get(place + 1), Some(PlaybackCommand::Seek { .. }));
            if matches!(command, PlaybackCommand::Seek { .. }) && is_passed {
                continue;
            }
            failed = execute_command(player, *command).err().or(failed);
        }
        let elapsed = std::mem::replace(&mut before, Instant::now()).elapsed();
        match player.advance_time(elapsed) {
            Ok(changed) => is_changed |= changed,
            Err(error) => failed = Some(error.to_string()),
        }
        if let Some(failed) = failed {
            player.pause_with_error(failed);
        }
        if let Some(topics) = &mut viewers {
            topics.publish_until(player.position_ns(), player.is_at_end(), player.jump_count());
        }
        if server.page_count() > 0 {
            let now = player.now();
            if jumps != player.jump_count() {
                jumps = player.jump_count();
                server.publish_history(player.encode_torque_history());
            }
            let said = number.is_multiple_of(SNAPSHOTS_PER_STATUS).then(|| {
                let playback = player.status();
                if marks.0 != playback.events {
                    marks = (
                        playback.events,
                        EventKind::ALL
                            .map(|kind| (kind, player.parts_with_events(kind, TIMELINE_PARTS)))
                            .into(),
                    );
                }
                let live = player.live();
                let playback = Some(playback.with_event_marks(marks.1.clone()));
                let mut said = StatusMessage { playback, ..live.status_message(now) };
                let text = |said: &StatusMessage| serde_json::to_string(said).unwrap_or_default();
                let all = text(&said);
                let own = server.selected_cells().into_iter().map(|(page, chosen)| {
                    said.detail = live.cell_detail(&chosen, now);
                    (page, text(&said))
                });
                (all, own.collect())
            });
            if is_changed || said.is_some() {
                server.publish_snapshot(player.live().snapshot(now, &nobody), said);
            }
            number += 1;
        }
        next = (next + SNAPSHOT_INTERVAL).max(Instant::now());
        thread::sleep(next.saturating_duration_since(Instant::now()).max(Duration::from_millis(1)));
    }
}

/// Executes a command of a page to the player.
fn execute_command(player: &mut Player, command: PlaybackCommand) -> Result<(), String> {
    let done = match command {
        PlaybackCommand::Play { speed } => {
            player.play(speed);
            Ok(())
        }
        PlaybackCommand::Pause {} => {
            player.pause();
            Ok(())
        }
        PlaybackCommand::Seek { at_s } => player.seek(at_s),
        PlaybackCommand::Step { forward } => player.step_epoch(forward),
        PlaybackCommand::Jump { to, forward } => player.jump_to_event(to, forward).map(|_| ()),
    };
    done.map_err(|error| error.to_string())
}
