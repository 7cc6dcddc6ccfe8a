//! Faults in benches of real processes: they are named and counted, and the loop goes on.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]
#![allow(clippy::wildcard_enum_match_arm, reason = "a test looks for what it looks for")]

use skinbus_tests::process;

use std::os::unix::fs::PermissionsExt;

use model::generate::Format as Wire;
use process::log::Log;
use process::test_client::TestClient;
use process::{PRESSED, Running, Summary, TestDir, is_stopped, skin, until};
use protocol::can::{Format, Frame};
use protocol::id::{CellId, Kind, Node};
use protocol::message::{Message, NetworkPage, State};
use protocol::packet::{Epoch, WORDS};
use rustix::process::Signal;

const TO_PROCESSES: &str = r#"
[[fault]]
at_s = 1.0
kind = "kill"
bus = "vcan0"
cells = [2]

[[fault]]
at_s = 1.0
kind = "restart"
bus = "vcan0"
cells = [3]

[[fault]]
at_s = 1.0
kind = "stop"
bus = "vcan0"
cells = [4]

[[fault]]
at_s = 5.0
kind = "continue"
bus = "vcan0"
cells = [4]
"#;

/// Returns a predicate for a torque of a cell.
fn torque_of(cell: u8) -> impl Fn(&Message) -> bool {
    move |message| matches!(message, Message::Torque { from, .. } if from.get() == cell)
}

#[test]
fn a_scenario_kills_restarts_stops_and_continues_cells_and_the_loop_goes_on() {
    let place = TestDir::new();
    place.skin(8);
    place.scenario(&format!("{PRESSED}{TO_PROCESSES}"));
    let bench = place.running_bench(600.0, "");
    for said in [
        "scenario: Kill cell 2 on vcan0",
        "the process of cell 2 on vcan0 ended (signal: 9 (SIGKILL))",
        "cell 3 on vcan0 restarted",
    ] {
        bench.wait_for_stderr(said);
    }
    for (cell, what) in [(2, "fallen silent"), (4, "fallen silent"), (4, "come back")] {
        bench.wait_for_event(cell, what);
    }
    place.test_client().waits_for_torques(3..=4);
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    assert_eq!(summary.adds_up().silent(), [2]);
    assert_eq!(summary.of_bus("/uplink/restarts"), 1);
    assert_eq!(summary.of_bus("/cells/dead"), 1);
    assert!(summary.of_bus("/replies/skipped") > 0, "cell 4 answers no old joints: {:#}", summary.0);
    assert!(summary.of_bus("/replies/in_doubt") > 0, "what cell 2 did last is unknown: {:#}", summary.0);
    assert!(summary.number("/loop/ticks") + summary.number("/loop/ticks_skipped") >= 2_000);

    let log = Log::read(&place.read("run.log"), Format::Fd);
    let claims = |message: &Message| {
        matches!(message, Message::Network { from: Node::Cell(cell), page: NetworkPage::Heartbeat(heartbeat), .. }
            if cell.get() == 3 && heartbeat.sent == 0)
    };
    let started = log.messages.iter().rposition(|(message, _)| claims(message)).unwrap();
    assert!(log.torques_after(started, 3) > 0, "it answers again");
    assert_eq!(log.torques_after(started, 2), 0, "it was killed at the same time");
    // A cell that was stopped answers none of the joints that arrived meanwhile.
    let answers: Vec<_> = log.torques().into_iter().filter(|(_, (cell, ..), _)| *cell == 4).collect();
    let gap = answers.windows(2).map(|pair| pair[1].0 - pair[0].0).max().unwrap();
    assert!(gap > 20, "it was stopped for 4 s, and missed {gap} joints in a row");
}

#[test]
fn a_cell_that_is_killed_from_outside_is_named() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    process::signal(bench.cell(6), Signal::KILL);
    bench.wait_for_stderr("the process of cell 6 on vcan0 ended (signal: 9 (SIGKILL))");
    bench.wait_for_event(6, "fallen silent");
    bench.signal(Signal::TERM);
    let ended = bench.end().succeeded();
    place.is_left_clean();
    assert_eq!(place.summary().adds_up().silent(), [6]);
    assert!(ended.stdout.contains("1 dead"), "{}", ended.stdout);
}

#[test]
fn a_cell_that_is_stopped_and_continued_skips_what_it_missed_and_comes_back() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    let cell = bench.cell(7);
    process::signal(cell, Signal::STOP);
    until("a stopped cell", || is_stopped(cell).then_some(()));
    bench.wait_for_event(7, "fallen silent");
    let test_client = place.test_client();
    process::signal(cell, Signal::CONT);
    bench.wait_for_event(7, "come back");
    test_client.waits_for("a torque of cell 7", torque_of(7));
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    let summary = place.summary();
    assert_eq!(summary.adds_up().silent().len(), 0);
    assert!(summary.of_bus("/replies/skipped") > 0, "{:#}", summary.0);
    assert_eq!(summary.of_bus("/uplink/restarts"), 0);
}

#[test]
fn several_cells_in_a_killed_process_are_all_named() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "--cells-per-process 4");
    let (first, _) = bench.cells().into_iter().find(|(_, nodes)| nodes == "1-4").unwrap();
    process::signal(first, Signal::KILL);
    bench.wait_for_stderr("the process of cells 1 to 4 on vcan0 ended");
    bench.wait_for_event(4, "fallen silent");
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    assert_eq!(place.summary().adds_up().silent(), [1, 2, 3, 4]);
}

/// Makes the cells of vcan1 end with an error of their own: they lose their bus, and may not search its folder again.
/// Afterwards the bus is served again.
fn errors_on_vcan1(place: &TestDir, bench: &Running, server: Running, processes: usize) -> Running {
    let mode = |mode| std::fs::set_permissions(place.buses(), std::fs::Permissions::from_mode(mode)).unwrap();
    let serve = || {
        let server = place.start("vcan-setup", "serve vcan1");
        server.wait_for_stdout("serving vcan1 at ");
        server
    };
    let all = bench.cells().len();
    mode(0o755);
    server.signal(Signal::KILL);
    server.end();
    until("the ends of its cells", || (bench.cells().len() == all - processes).then_some(()));
    mode(0o700);
    let server = serve();
    TestClient::on(place, "vcan1", Format::Fd).waits_for_joints(10);
    server
}

#[test]
fn cells_that_end_by_an_error_of_their_own_are_the_runs_outcome_and_their_reason_is_given_once() {
    for (per_process, quiet) in [(1, true), (4, false)] {
        let place = TestDir::new();
        place.write("skin.toml", &process::skin_of(8, 2, Wire::Fd));
        place.scenario(PRESSED);
        let first = place.start("vcan-setup", "serve vcan1");
        first.wait_for_stdout("serving vcan1 at ");
        let more = if quiet { "--quiet" } else { "" };
        let bench = place.bench(600.0, &format!("{more} --cells-per-process {per_process}"));
        TestClient::on(&place, "vcan1", Format::Fd).waits_for_joints(10);
        let server = errors_on_vcan1(&place, &bench, first, 4 / per_process);
        bench.signal(Signal::TERM);
        let ended = bench.end();
        server.signal(Signal::TERM);
        server.end().succeeded();
        place.is_left_clean();
        assert_eq!(ended.code(), Some(5), "{ended:#?}");
        let summary = place.summary();
        summary.adds_up();
        assert_eq!(summary.0["outcome"], "cell_error", "{:#}", summary.0);
        let [error] = summary.0["cell_errors"].as_array().unwrap().as_slice() else {
            panic!("{:#}", summary.0)
        };
        assert_eq!(error["cells"], serde_json::json!([{ "bus": "vcan1", "nodes": [1, 2, 3, 4] }]));
        let why = error["reason"].as_str().unwrap();
        // The gateway itself may not search it either.
        let given = ended.stderr.lines().filter(|line| !line.starts_with("vcan1 cannot be reopened yet"));
        assert_eq!(given.filter(|line| line.contains(why)).count(), 1, "{ended:#?}");
        let last = ended.stderr.lines().last().unwrap();
        if quiet {
            assert_eq!(ended.stderr.lines().count(), 1, "{ended:#?}");
            let line = format!("skinbus: 4 cells ended with errors: 1-4 on vcan1 ({why})");
            assert_eq!(last, line);
        } else {
            assert_eq!(last, "skinbus: 4 cells ended with errors (see above): 1-4 on vcan1");
            let note = format!("the process of cells 1 to 4 on vcan1 ended (exit status: 1: {why})\n");
            assert!(ended.stderr.contains(&note), "{ended:#?}");
        }
        assert!(ended.stdout.contains("4 cells ended with errors"), "{}", ended.stdout);
    }
}

#[test]
fn a_second_gateway_ends_with_one_line_and_the_first_goes_on_undisturbed() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    let second = "run skin.toml --bus-kind embedded --scenario scenario.toml --duration 1 --summary second.json \
                  --candump second.log --overwrite --quiet";
    for more in ["", " --no-spawn"] {
        let ended = place.start("skinbus", &format!("{second}{more}")).end();
        let said = "skinbus: another gateway is on vcan0: stop one of the two, or set SKINBUS_DIR to \
                    another directory for this run";
        assert_eq!(ended.refusal(1), said);
    }
    let files = ["buses", "run.log", "scenario.toml", "second.json", "second.log", "skin.toml"];
    assert_eq!(place.files(), files.sorted());
    place.test_client().waits_for("a torque", torque_of(1));
    assert_eq!(bench.cells().len(), 8);
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    assert_eq!(summary.adds_up().silent().len(), 0);
    let disturbed = summary.of_bus("/uplink/restarts") + summary.of_bus("/uplink/surplus");
    assert_eq!((disturbed, summary.odd(0)), (0, 0), "{:#}", summary.0);
}

trait Sorted {
    fn sorted(self) -> Self;
}

impl<const N: usize> Sorted for [&str; N] {
    fn sorted(mut self) -> Self {
        self.sort_unstable();
        self
    }
}

#[test]
fn cells_on_the_bus_are_not_started_twice() {
    let place = TestDir::new();
    place.pressed();
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let cells = place.start("cell-node", "--bus vcan0 --bus-kind embedded --nodes 2-3 --skin skin.toml");
    place.test_client().waits_for(
        "cell 3",
        |message| matches!(message, Message::Network { from: Node::Cell(cell), .. } if cell.get() == 3),
    );
    let said = "skinbus: these cells are already on the bus: 2, 3 on vcan0; use them with --no-spawn, stop them, or \
                set SKINBUS_DIR to another directory for this run";
    assert_eq!(place.bench(1.0, "--quiet").end().refusal(1), said);
    drop((cells, server));
}

#[test]
fn a_newcomer_with_a_taken_node_id_ends_with_one_line() {
    let place = TestDir::new();
    place.pressed();
    place.write("other.toml", &skin(8).replace("serial = 100003\n", "serial = 777\n"));
    // An unknown cell, and a duplicate with the same description.
    for skin in ["other.toml", "skin.toml"] {
        let bench = place.running_bench(600.0, "");
        let newcomer =
            place.start("cell-node", &format!("--bus vcan0 --bus-kind embedded --node 3 --skin {skin}"));
        let said = "cell-node: cell 3 is already on vcan0, with serial number 100003: stop it, or give this \
                    cell another node id";
        assert_eq!(newcomer.end().refusal(1), said);
        place.test_client().waits_for("a torque of cell 3", torque_of(3));
        bench.signal(Signal::TERM);
        let ended = bench.end().succeeded();
        let summary = place.summary();
        assert_eq!(summary.silent().len(), 0);
        // The gateway may also have received from cell 3 before the duplicate sent anything.
        let named = ended
            .stderr
            .contains("cell 3 on vcan0 shares its node id with another cell: stop one of the two");
        assert!(!named || summary.count("/buses/0/events", "duplicate number") > 0, "{:#}", summary.0);
        // The duplicate looks like a restart of the cell, so its messages are in the cell's accounts.
        if skin == "other.toml" {
            summary.adds_up();
        }
    }
}

/// Returns frames, each with the reason under which it is counted.
fn odd_frames() -> Vec<(Frame, &'static str)> {
    let cell = |node| CellId::new(node).unwrap();
    let torque = |node| {
        let torque = Message::Torque { from: cell(node), epoch: Epoch(0), torque: [4_096; WORDS].into() };
        torque.encode().frames(Format::Fd).next().unwrap()
    };
    let good = torque(5);
    let mut bytes: [u8; 16] = good.data().try_into().unwrap();
    bytes[3] ^= 0x10;
    let of = |id, bytes: &[u8]| Frame::fd(id, 1, bytes).unwrap();
    let meaningless = |kind: Kind, count| {
        let packet = protocol::packet::Packet {
            id: protocol::id::Id::new(kind, Node::Cell(cell(5))),
            words: [0; WORDS].into(),
            epoch: Epoch(0),
            count,
        };
        packet.frames(Format::Fd).next().unwrap()
    };
    vec![
        (of(0x205, &[1; 12]), "wrong length"),
        (of(0x205, &[]), "wrong length"),
        (Frame::classic(0x205, &[1; 8]).unwrap(), "wrong length"),
        (of(0x205, &bytes), "wrong CRC"),
        // The packet of another cell: the CRC is over the identifier too.
        (of(0x206, good.data()), "wrong CRC"),
        (of(0x305, &[0; 16]), "wrong CRC"),
        (meaningless(Kind::Sensors, 9), "no meaning"),
        (meaningless(Kind::Torque, 2), "no meaning"),
        (torque(200), "unknown node"),
        (Frame::classic(0x8000_0000 | 0x1_0205, &[0; 8]).unwrap(), "foreign"),
        (Frame::remote(0x205, 8).unwrap(), "foreign"),
    ]
}

#[test]
fn frames_that_cannot_be_used_are_counted_by_reason_and_none_is_used() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    test_client.waits_for_epoch(5);
    let odd = odd_frames();
    for _ in 0..3 {
        for (frame, _) in &odd {
            test_client.bus.send(&[*frame]).unwrap();
        }
    }
    test_client.waits_for("torques after that", torque_of(8));
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    let summary = place.summary();
    let mut expected: Vec<_> = odd.iter().map(|(_, reason)| *reason).collect();
    expected.sort_unstable();
    expected.dedup();
    for reason in expected {
        let sent = 3 * odd.iter().filter(|(_, why)| *why == reason).count();
        assert_eq!(summary.count("/buses/0/events", reason), sent as u64, "{reason}: {:#}", summary.0);
    }
    assert_eq!(summary.odd(0), 3 * odd.len() as u64, "{:#}", summary.0);
    // A used torque would differ from the one that the cell should have sent.
    assert!(summary.figure("/accuracy/single/max_nm") < 0.002, "{:#}", summary.0);
    summary.adds_up();
    log_has_all(&place, &summary);
}

/// Checks that the log has every frame, including unusable ones.
fn log_has_all(place: &TestDir, summary: &Summary) {
    let packets = summary.total("/buses/0/received") + summary.total("/buses/0/sent");
    let frames = packets + summary.count("/buses/0/events", "foreign");
    let log = Log::read(&place.read("run.log"), Format::Fd);
    assert_eq!((log.frames.len() as u64, summary.number("/recording/frames")), (frames, frames));
}

#[test]
fn a_halt_from_a_shell_halts_the_robot_and_ack_resumes_it() {
    let place = TestDir::new();
    // A busy machine must not halt the robot.
    place.write("skin.toml", &(skin(8) + "\n[safety]\nbad_cycles = 10000\n"));
    // The touch moves the arm.
    place.scenario(&PRESSED.replace("hold", "kinesthetic"));
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    test_client.waits_for_motion();
    let sent = place.start("skinbus", "frame halt --bus vcan0 --bus-kind embedded").end().succeeded();
    assert_eq!(sent.stderr, "sent on vcan0 (embedded)\n");
    bench.wait_for_stderr(
        "the robot is halted: a halt frame was received; `skinbus frame resume --bus vcan0 --bus-kind embedded` resumes it",
    );
    place.start("skinbus", "frame resume --skin skin.toml --bus-kind embedded").end().succeeded();
    bench.wait_for_stderr("the robot continues");
    let test_client = place.test_client();
    test_client.waits_for("a torque", torque_of(1));
    test_client.waits_for_motion();
    test_client.send(&Message::Halt);
    let halted = || bench.stderr().matches("the robot is halted").count() == 2;
    until("a second halt", || halted().then_some(()));
    bench.signal(Signal::TERM);
    let ended = bench.end();
    assert_eq!(ended.code(), Some(3), "{ended:#?}");
    place.is_left_clean();
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.0["halted"], "a halt frame was received");
    let until: Vec<_> =
        summary.0["halts"].as_array().unwrap().iter().map(|it| it["until_s"].is_null()).collect();
    assert_eq!(until, [false, true], "the first one was resumed");
    assert!(ended.stdout.contains("a halt frame was received"), "{}", ended.stdout);

    let log = Log::read(&place.read("run.log"), Format::Fd);
    let at = |expected: &Message| log.messages.iter().rposition(|(message, _)| message == expected).unwrap();
    let halt = log.messages.iter().position(|(message, _)| *message == Message::Halt).unwrap();
    let resume = at(&Message::Resume);
    assert!(halt < resume);
    let joints = |messages: &[(Message, protocol::packet::Packet)]| {
        let mut all: Vec<_> = messages
            .iter()
            .filter_map(|(message, _)| match message {
                Message::Joints { joints, .. } => Some(joints.positions.map(|word| word.to_bits())),
                _ => None,
            })
            .collect();
        all.dedup();
        all.len()
    };
    // From the tick after the halt on the joints stand still; one broadcast may have been on its way.
    assert!(joints(&log.messages[halt..resume]) <= 2, "a halted robot stands");
    assert!(joints(&log.messages[..halt]) > 2 && joints(&log.messages[resume..]) > 2, "else it moves");
}

#[test]
fn a_cell_that_restarts_while_the_robot_is_halted_is_halted_too() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    test_client.waits_for("a torque", torque_of(3));
    test_client.send(&Message::Halt);
    bench.wait_for_stderr("the robot is halted");
    process::signal(bench.cell(3), Signal::KILL);
    bench.wait_for_stderr("the process of cell 3 on vcan0 ended");
    let _cell = place.start("cell-node", "--bus vcan0 --bus-kind embedded --node 3 --skin skin.toml");
    bench.wait_for_stderr("cell 3 on vcan0 restarted");
    // A gateway that knows nothing of its predecessor.
    let test_client = place.test_client();
    let state = |message: &Message| match message {
        Message::Network { from, page: NetworkPage::Heartbeat(heartbeat), .. } => {
            (from.to_byte() == 3).then_some(heartbeat.state)
        }
        _ => None,
    };
    let says = |bits| move |message: &Message| state(message).is_some_and(|state| state.has(bits));
    let settled = |message: &Message| state(message).is_some_and(|state| !state.has(State::CLAIMING_NODE_ID));
    test_client.waits_for("cell 3 that has its node id", settled);
    test_client.waits_for("another halt", |message| *message == Message::Halt);
    test_client.waits_for("a cell 3 that is halted", says(State::HALTED));
    place.start("skinbus", "frame resume --skin skin.toml --bus-kind embedded").end().succeeded();
    test_client.waits_for("its torque", torque_of(3));
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.summary().adds_up();

    let log = Log::read(&place.read("run.log"), Format::Fd);
    let from = |index: usize, expected: &dyn Fn(&Message) -> bool| {
        index + log.messages[index..].iter().position(|(message, _)| expected(message)).unwrap()
    };
    let halt = from(0, &|message| *message == Message::Halt);
    let restarted = from(from(halt, &says(State::CLAIMING_NODE_ID)), &settled);
    let halted = from(restarted, &|message| *message == Message::Halt);
    let resumed = from(halted, &|message| *message == Message::Resume);
    assert_eq!(log.torques_after(halted, 3) - log.torques_after(resumed, 3), 0, "torques of a halted cell");
}
