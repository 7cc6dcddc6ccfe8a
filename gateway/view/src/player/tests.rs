//! Tests that the player shows the same state at a position, whichever way it got there, as after reading the recording
//! up to there from its beginning.

use std::io::Write;

use super::*;
use crate::command::CellReference;
use crate::curves::RecordedCurves;
use crate::live::StatusMessage;
use crate::page_command::SelectedCell;
use crate::pressed::TouchRegistry;
use proptest::prelude::*;
use protocol::can::Format;
use protocol::candump::{Record, Timestamp};
use protocol::fixed::{Q1_14, Q5_10};
use protocol::id::{CellId, Node};
use protocol::message::{
    Heartbeat, Joints, Message, NetworkPage, SensorPage, SkinSensors, State, StimulusStart,
};
use protocol::packet::Epoch;

/// The time of the first frame, in ns since 1970.
const BEGAN: u64 = 1_700_000_000_000_000_000;
const MS: u64 = 1_000_000;
/// The length of the log in ms. It has an epoch every `EPOCH_MS`.
const LENGTH_MS: u64 = 40_000;
const EPOCH_MS: u64 = 16;
const CELLS: u8 = 24;

fn skin() -> Skin {
    Skin::parse("ur5", include_str!("../../../examples/ur5-253.toml")).unwrap()
}

/// Writes a log of 24 cells. Cell 5 is touched from 6 s to 9 s and from 30 s on, cell 7 is silent from 20 s on, replies
/// are missing at 12 s, and the robot is halted from 25 s to 26 s.
fn log(skin: &Skin) -> Vec<u8> {
    let mut out = Vec::new();
    let mut say = |ms: u64, micros: u64, message: &Message| {
        for frame in message.encode().frames(Format::Fd) {
            let time = Timestamp::with_six_digits(BEGAN + ms * MS + micros * 1_000);
            let record = Record { time, interface: "vcan0", frame, direction: None };
            writeln!(out, "{record}").unwrap();
        }
    };
    let cell = |node: u8| CellId::new(node.into()).unwrap();
    let mut sent = [0_u16; 256];
    for ms in 0..LENGTH_MS {
        for node in (1..=CELLS).filter(|node| ms % 250 == u64::from(*node) * 10) {
            if node == 7 && ms >= 20_000 {
                continue;
            }
            let state = State(0x1000 | State::CONFIGURED.0 | State::TEST_MODE.0 | 2 << 8);
            let configuration = skin.parameters(&skin.cells[usize::from(node) - 1]).hash();
            let serial = 100_000 + u32::from(node);
            let sent = sent[usize::from(node)].to_le_bytes()[0].into();
            let heartbeat = Heartbeat { serial, configuration, state, sent, ..Heartbeat::default() };
            let page = NetworkPage::Heartbeat(heartbeat);
            say(ms, 3, &Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(0), page });
        }
        let force = |n: f64| {
            let sensors = SkinSensors { contact: [Q5_10::nearest(n); 3], ..SkinSensors::default() };
            Message::Stimulus {
                to: Node::Cell(cell(5)),
                from: StimulusStart::Next,
                page: SensorPage::Skin(sensors),
            }
        };
        match ms {
            6_000 | 30_000 => say(ms, 7, &force(1.0)),
            9_000 => say(ms, 7, &force(0.0)),
            25_000 => say(ms, 8, &Message::Halt),
            26_000 => say(ms, 8, &Message::Resume),
            _ => {}
        }
        if ms % EPOCH_MS == 0 {
            let epoch = Epoch((ms / EPOCH_MS).to_le_bytes()[0]);
            let mut positions = [Q1_14::ZERO; protocol::parameters::MAX_JOINTS];
            positions[0] = Q1_14::from_radians(f64::from(u32::try_from(ms).unwrap()) * 5e-5).unwrap();
            positions[1] = Q1_14::from_radians(-1.2).unwrap();
            say(ms, 10, &Message::Joints { epoch, joints: Joints { positions, in_use: 6 } });
            let touched = (6_016..9_000).contains(&ms) || ms >= 30_016;
            if touched && !(12_000..12_200).contains(&ms) {
                sent[5] += 1;
                let torque = [(ms % 97) as i16, -200, 0, 0, 0, 0].into();
                say(ms, 900, &Message::Torque { from: cell(5), epoch, torque });
            }
        }
    }
    out
}

/// Returns the snapshot without its number, and the status.
fn shown(tape: &mut LiveState, now: Micros) -> (Vec<u8>, String) {
    let detail = tape.cell_detail(&SelectedCell { cell: CellReference("5".to_owned()), frame: None }, now);
    let said = StatusMessage { detail, ..tape.status_message(now) };
    (tape.snapshot(now, &TouchRegistry::default()).split_off(4), serde_json::to_string(&said).unwrap())
}

/// Returns the same as [`shown`] after reading the recording from its beginning up to `until`.
fn straight(bytes: &[u8], skin: &Skin, until: u64) -> (Vec<u8>, String) {
    let mut reader = Reader::from_read("log", std::io::Cursor::new(bytes.to_vec())).unwrap();
    let mut tape = PlaybackState::new(skin.clone(), BEGAN + 10_000);
    loop {
        match tape.step_until(until) {
            PlaybackStep::NeedsEntries => tape.read_entry(&mut reader).unwrap(),
            PlaybackStep::Reached | PlaybackStep::Over => break,
            PlaybackStep::Updated | PlaybackStep::Applied { .. } => {}
        }
    }
    shown(tape.live_mut(), Micros(until / 1_000))
}

struct Bench {
    _folder: tempfile::TempDir,
    paths: [PathBuf; 1],
    skin: Skin,
    bytes: Vec<u8>,
}

impl Bench {
    fn new() -> Self {
        Self::of(log(&skin()))
    }

    fn of(bytes: Vec<u8>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        std::fs::write(&path, &bytes).unwrap();
        Self { _folder: folder, paths: [path], skin: skin(), bytes }
    }

    fn player(&self) -> Player {
        Player::open(&self.paths, self.skin.clone()).unwrap()
    }

    fn build(&self, player: &Player) {
        let reader = Reader::open_with_all_topics(&self.paths).unwrap();
        player.index().build(
            reader,
            self.skin.clone(),
            (player.first_frame_ns(), player.time_origin_ns()),
            &false.into(),
        );
    }
}

#[test]
fn events_are_found_and_gone_to() {
    let bench = Bench::new();
    let mut player = bench.player();
    bench.build(&player);
    let mut at = |kind, forward| {
        assert!(player.jump_to_event(kind, forward).unwrap(), "{kind:?}");
        player.status().at_s
    };
    let near = |found: f64, expected: f64| (expected..expected + 0.06).contains(&found);
    assert!(near(at(EventKind::Touch, true), 6.0));
    assert!(near(at(EventKind::Touch, true), 30.0));
    assert!(near(at(EventKind::Touch, false), 6.0));
    assert!(near(at(EventKind::Halt, true), 25.0));
    let silent = at(EventKind::Silence, false);
    assert!((20.3..20.8).contains(&silent), "{silent}");
    assert!(!player.jump_to_event(EventKind::Silence, true).unwrap(), "only one cell falls silent");
    assert_eq!(player.parts_with_events(EventKind::Touch, 100), [15, 75]);
    let said = player.status();
    assert!((39.9..40.1).contains(&said.of_s) && said.read == 1.0 && said.others == 0);
}

#[test]
fn curves_and_events_of_a_part_are_answered() {
    let bench = Bench::new();
    let player = bench.player();
    bench.build(&player);
    let curves = RecordedCurves::new(player.index(), bench.skin, player.time_origin_ns());
    let ask = |path: &str, query: &str| curves.answer(path, query).map(|(_, bytes)| bytes);
    let events = ask("/events", "token=x&from=5&to=25.5").unwrap();
    let events: Vec<serde_json::Value> = serde_json::from_slice(&events).unwrap();
    let kinds: Vec<_> = events.iter().map(|event| event["kind"].as_str().unwrap()).collect();
    assert!(kinds.starts_with(&["touch", "loss"]) && kinds.ends_with(&["silence", "halt"]), "{kinds:?}");
    assert_eq!((&events[0]["bus"], &events[0]["node"]), (&0.into(), &5.into()));

    // Returns the number of quantities, the begin, the length of an interval, and all ranges.
    let read = |query: &str| {
        let bytes = ask("/curves", query).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        let real = |at: usize| f64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        let values = bytes[24..].chunks(4).map(|value| f32::from_le_bytes(value.try_into().unwrap()));
        let values: Vec<_> = values.collect();
        assert_eq!(values.len(), 2 * word(0) * word(4));
        (word(0), real(8), real(16), values)
    };
    let (quantities, from, step, torques) = read("of=torques&from=5&to=7&count=50");
    assert_eq!(quantities, 18, "three for each joint");
    assert!(from <= 5.0 && from > 4.9 && (step - 0.04).abs() < 1e-9, "{from} {step}");
    let least = |values: &[f32]| values.iter().copied().fold(f32::NAN, f32::min);
    let of_joint = torques.len() / 18;
    assert_eq!(least(&torques[..of_joint]), 0.0, "the first joint's torque is positive");
    assert!(least(&torques[3 * of_joint..4 * of_joint]) < 0.0, "the second joint's torque is -200 words");
    let (_, from, step, force) = read("of=force&cell=vcan0%3A5&from=5&to=7&count=50");
    let touched = force.chunks(2).position(|range| range[1] > 0.0).unwrap();
    #[expect(clippy::cast_precision_loss)]
    let touched = from + step * touched as f64;
    assert!((5.9..6.1).contains(&touched), "{touched}");
    let (buses, .., loads) = read("of=loads&from=20&to=21&count=9");
    assert!(buses == 1 && loads.iter().all(|load| (0.0..1.0).contains(load)), "{loads:?}");
    let (.., lateness) = read("of=lateness&from=0&to=40&count=9");
    assert_eq!(lateness, Vec::<f32>::new(), "a log has no lateness");
    for (path, wrong) in [
        ("/curves", "of=torques&from=5&to=7"),
        ("/curves", "of=torques&from=x&to=7&count=9"),
        ("/curves", "of=torques&from=5&to=inf&count=9"),
        ("/curves", "of=torques&from=5&to=7&count=5000"),
        ("/curves", "of=force&from=5&to=7&count=9"),
        ("/curves", "of=force&cell=vcan9:5&from=5&to=7&count=9"),
        ("/curves", "of=all&from=5&to=7&count=9"),
        ("/events", "from=5"),
    ] {
        assert_eq!(ask(path, wrong), None, "{path} {wrong}");
    }
    assert!(ask("/curves", "of=torques&from=-1e300&to=1e300&count=4096").is_some());
}

#[test]
fn notes_of_a_run_are_events() {
    let mut bytes = log(&skin());
    bytes.extend(b"# view: kill cell 5 on vcan0\n# the bus 'vcan0' was lost\n# a remark\n");
    let bench = Bench::of(bytes);
    let player = bench.player();
    bench.build(&player);
    let all = player.index().events_between((0, u64::MAX), 9);
    let of = |kind| {
        let events = all.iter().filter(move |event| event.kind == kind);
        events.map(|event| (event.bus, event.text.as_deref())).collect::<Vec<_>>()
    };
    assert_eq!(of(EventKind::Command), [(None, Some("kill cell 5 on vcan0"))]);
    assert_eq!(of(EventKind::Bus), [(Some(0), Some("lost"))]);
}

#[test]
fn an_epoch_forth_and_back_is_where_it_began() {
    let bench = Bench::new();
    let mut player = bench.player();
    bench.build(&player);
    player.seek(7.0).unwrap();
    player.play(1.0);
    player.step_epoch(true).unwrap();
    let first = player.status();
    assert!(!first.playing && (first.at_s - 7.008).abs() < 1e-4, "{}", first.at_s);
    player.step_epoch(true).unwrap();
    assert!((player.status().at_s - 7.024).abs() < 1e-4);
    player.step_epoch(false).unwrap();
    assert_eq!(player.status().at_s, first.at_s);
    player.seek(0.0).unwrap();
    player.step_epoch(false).unwrap();
    assert!(player.status().at_s < 0.001);
    player.seek(1e300).unwrap();
    player.step_epoch(true).unwrap();
    assert!(player.status().at_s >= 39.9);
}

#[test]
fn time_passes_at_its_speed_and_ends_with_the_recording() {
    let bench = Bench::new();
    let mut player = bench.player();
    bench.build(&player);
    player.play(2.0);
    assert!(player.advance_time(Duration::from_millis(500)).unwrap());
    assert!((player.status().at_s - 1.0).abs() < 1e-6);
    player.play(f64::NAN);
    assert_eq!(player.status().speed, 1.0);
    player.play(1e9);
    assert_eq!(player.status().speed, 100.0);
    player.advance_time(Duration::from_secs(1)).unwrap();
    assert!(!player.status().playing, "it is over");
    assert!(!player.advance_time(Duration::from_secs(1)).unwrap());
    let history = player.encode_torque_history();
    let moments = u32::from_le_bytes(history[8..12].try_into().unwrap()) as usize;
    assert!((300..=625).contains(&moments), "{moments}");
    assert_eq!(history.len(), 16 + moments * (8 + 8 * 6));
}

#[test]
fn what_is_not_known_yet_is_said_and_is_exact_later() {
    let bench = Bench::new();
    let mut player = bench.player();
    player.seek(35.0).unwrap();
    assert!(!player.status().exact);
    let now = player.now();
    let glance = player.live().status_message(now);
    assert!(glance.contacts <= 1 && glance.buses[0].epochs_due < 250, "the last seconds");
    bench.build(&player);
    assert!(player.advance_time(Duration::ZERO).unwrap() && player.status().exact);
    let (now, until) = (player.now(), BEGAN + 10_000 + 35_000 * MS);
    assert_eq!(shown(player.live(), now), straight(&bench.bytes, &bench.skin, until));
}

#[test]
fn a_recording_without_frames_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("empty.log");
    std::fs::write(&path, "nothing\n").unwrap();
    let error = Player::open(&[path], skin()).unwrap_err().to_string();
    assert!(error.ends_with("empty.log: the recording contains no frames"), "{error}");
}

/// Generates times of frames: any times, times near the limits of 64 bits of ns, and times near each other.
fn times() -> impl Strategy<Value = Vec<u64>> {
    let near = |at: u64| (0..3_000_000_000_u64).prop_map(move |off| at.saturating_sub(off));
    let any = prop_oneof![any::<u64>(), near(u64::MAX), near(3_000_000_000), near(BEGAN), Just(u64::MAX)];
    proptest::collection::vec(any, 1..8)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn frames_of_any_time_are_played_to_the_end(times in times(), seeks in proptest::collection::vec(0.0..2e10, 3)) {
        let mut log = Vec::new();
        for nanos in times {
            let time = Timestamp::with_nine_digits(nanos);
            for frame in Message::Halt.encode().frames(Format::Fd) {
                writeln!(log, "{}", Record { time, interface: "vcan0", frame, direction: None }).unwrap();
            }
        }
        let bench = Bench::of(log);
        let mut player = bench.player();
        bench.build(&player);
        for at_s in seeks {
            player.seek(at_s).unwrap();
            player.step_epoch(true).unwrap();
            player.step_epoch(false).unwrap();
            player.jump_to_event(EventKind::Halt, true).unwrap();
            player.play(1e9);
            player.advance_time(Duration::from_secs(3)).unwrap();
            let now = player.now();
            prop_assert!(player.status().at_s >= 0.0 && !player.encode_torque_history().is_empty());
            shown(player.live(), now);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(6))]
    #[test]
    fn every_way_to_a_moment_shows_the_same(moves in proptest::collection::vec(0_u64..40_000_000, 1..5)) {
        let bench = Bench::new();
        let mut player = bench.player();
        bench.build(&player);
        for micros in moves {
            #[expect(clippy::cast_precision_loss)]
            player.seek(micros as f64 / 1e6).unwrap();
            let now = player.now();
            let expected = straight(&bench.bytes, &bench.skin, player.at);
            prop_assert_eq!(shown(player.live(), now), expected);
        }
    }
}
