//! Runs are recorded, and replayed to cells that were just started or have another history: their replies must equal
//! those recorded, bit for bit, or the difference must be reported.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::cell::Cell as Counter;
use std::fs;
use std::time::Duration;

use model::generate::{self, Format};
use process::replay::{FRESH, Replayed, TOUCHED, by_hand, cell, changed, is_torque, without};
use process::{TestDir, example, skin_of};
use protocol::candump::{CandumpLine, parse};
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, Request, SensorPage, SkinSensors, State, StimulusStart};
use protocol::packet::{Packet, WORDS};
use protocol::parameters::Parameter;
use protocol::skin::Skin;
use rustix::process::Signal;

#[test]
fn a_run_comes_back_bit_for_bit_at_its_own_times_in_lockstep_and_as_fast_as_it_can() {
    let place = TestDir::new();
    place.records(8);
    let mut counts = Vec::new();
    for route in
        ["", "--lockstep --speed 4", "--speed max", "--speed max SKINBUS_CELLS_PER_PROCESS=8", "--speed max"]
    {
        let (ended, replayed) = place.replayed("run.log", &format!("{FRESH} {route}"));
        place.is_left_clean();
        let count = if route.contains("--speed max") || route.contains("--lockstep") {
            replayed.all_came_back(&ended)
        } else {
            replayed.all_came_back_in_time(&ended)
        };
        counts.push(count);
        let timed = !route.contains("--speed max") && !route.contains("--lockstep");
        assert_eq!(!replayed.0["late_us"].is_null(), timed);
        assert_eq!(ended.stdout.contains("lateness"), timed, "{}", ended.stdout);
        assert_eq!(replayed.number("/refused") + replayed.number("/lost"), 0);
        assert!(ended.stdout.contains("bit for bit"), "{}", ended.stdout);
    }
    let sent = Replayed(serde_json::from_str(&place.read("replay.json")).unwrap()).number("/sent");
    // A tenth of the torques of a machine that is always in time.
    assert!(counts[0] > 75 && counts.iter().all(|count| *count == counts[0]), "{counts:?}");
    let inputs = without(&place.read("run.log"), |message| {
        !matches!(
            message,
            Message::Halt
                | Message::Joints { .. }
                | Message::Sync
                | Message::Resume
                | Message::Report
                | Message::Configure { .. }
                | Message::Stimulus { .. }
        )
    });
    assert_eq!(inputs.lines().count() as u64, sent, "all inputs, and nothing else");
}

#[test]
fn a_recording_brings_its_own_skin() {
    let place = TestDir::new();
    place.skin(5);
    place.scenario(process::PRESSED);
    place.bench(2.0, "--record run.mcap").end().succeeded();
    fs::remove_file(place.path("skin.toml")).unwrap();
    let mut counts = Vec::new();
    for file in ["run.mcap", "run.log"] {
        let skin = if file == "run.log" { " --skin again.toml" } else { "" };
        place.skin(5);
        fs::rename(place.path("skin.toml"), place.path("again.toml")).unwrap();
        let (ended, replayed) = place.replayed(file, &format!("--expect --spawn --speed max{skin}"));
        counts.push((replayed.all_came_back(&ended), replayed.number("/sent")));
        place.is_left_clean();
    }
    // The log and the recording are of the same run.
    assert!(counts[0].0 > 60 && counts[0] == counts[1], "{counts:?}");
}

#[test]
fn the_second_file_of_a_recording_begins_with_what_was_latched() {
    let place = TestDir::new();
    place.skin(5);
    place.scenario(process::PRESSED);
    place.bench(2.5, "--record run.mcap --record-split 1s").end().succeeded();
    let (ended, first) = place.replayed("run.mcap", &format!("{FRESH} --speed max"));
    let first = first.all_came_back(&ended);
    let (ended, second) = place.replayed("run-1.mcap", &format!("{FRESH} --speed max"));
    // It was pressed in the first file, and is in contact in the second.
    let second = second.all_came_back(&ended);
    assert!(first > 10 && second > 10, "{first} and {second}");
    place.is_left_clean();
}

#[test]
fn two_buses_of_classic_frames_come_back_too() {
    let place = TestDir::new();
    place.write("skin.toml", &skin_of(9, 2, Format::Classic));
    place.scenario(process::PRESSED);
    place.bench(2.0, "").end().succeeded();
    for route in ["--speed max", "--lockstep --from 1"] {
        let (ended, replayed) = place.replayed("run.log", &format!("{FRESH} {route}"));
        assert!(replayed.all_came_back(&ended) > 50, "{:#}", replayed.0);
        assert_eq!(replayed.0["buses"].as_array().unwrap().len(), 2);
        assert!(replayed.number("/buses/1/sent") > 6, "{:#}", replayed.0);
        place.is_left_clean();
    }
}

/// Returns the times of the first and the last such message, in s after the first frame of a log.
fn seconds(log: &str, is: impl Fn(&Message) -> bool) -> [f64; 2] {
    let records = || {
        log.lines()
            .map(|line| if let Ok(CandumpLine::Frame(it)) = parse(line) { it } else { panic!("{line}") })
    };
    let first = records().next().unwrap().time.nanos;
    let they = records().filter(|it| {
        let packet = Packet::from_fd(&it.frame).ok();
        packet.and_then(|packet| Message::decode(&packet).ok()).is_some_and(|message| is(&message))
    });
    let times: Vec<_> = they.map(|it| (it.time.nanos - first) as f64 * 1e-9).collect();
    [times[0], times[times.len() - 1]]
}

/// Returns the time at which the loop of [`Place::records`] began, and the time of the last request that changed the
/// configuration of cell 4.
fn begins_and_changes(log: &str) -> [f64; 2] {
    let fourth = Node::Cell(cell(4));
    let [begins, _] = seconds(log, |message| matches!(message, Message::Joints { .. }));
    let [_, changes] =
        seconds(log, |message| matches!(message, Message::Configure { to, .. } if *to == fourth));
    [begins, changes]
}

#[test]
fn from_the_middle_on_the_torques_are_the_same() {
    let place = TestDir::new();
    place.records(8);
    let log = place.read("run.log");
    let [begins, changes] = begins_and_changes(&log);
    let [halted, _] = seconds(&log, |message| *message == Message::Halt);
    let [_, ends] = seconds(&log, |message| matches!(message, Message::Joints { .. }));
    assert!(begins < changes && changes < halted && halted < ends, "{begins} {changes} {halted} {ends}");
    let (ended, all) = place.replayed("run.log", &format!("{FRESH} --speed max"));
    let all = all.all_came_back(&ended);
    let mut before = all;
    // The second one begins while the cells are halted, and after cell 4 was configured again.
    let middle = (halted + ends) / 2.0;
    for from in [(begins + changes) / 2.0, halted + 1e-3, middle, (middle + ends) / 2.0] {
        let (ended, part) = place.replayed("run.log", &format!("{FRESH} --speed max --from {from:.6}"));
        let count = part.all_came_back(&ended);
        assert!(count > 0 && count < before, "{count} of {before} from {from} on");
        before = count;
    }
    let part = format!("{FRESH} --speed max --from {middle:.6} --to {:.6}", middle + 0.5);
    let (ended, thrice) = place.replayed("run.log", &format!("{part} --loop 3"));
    let (again, once) = place.replayed("run.log", &part);
    assert_eq!(thrice.all_came_back(&ended), 3 * once.all_came_back(&again));
    place.is_left_clean();
}

#[test]
fn cells_with_another_history_answer_as_they_did_then() {
    let place = TestDir::new();
    place.records(8);
    let [begins, changes] = begins_and_changes(&place.read("run.log"));
    let _bench = by_hand(&place, "1-8");
    let test_client = place.test_client();
    for round in 0..2 {
        // Pressed, halted, and in an epoch that comes soon.
        let page = SensorPage::Skin(SkinSensors {
            contact: [protocol::fixed::Q5_10::nearest(3.0); 3],
            ..SkinSensors::default()
        });
        test_client.send(&Message::Stimulus { to: Node::Everyone, from: StimulusStart::Next, page });
        test_client.send(&Message::Joints {
            epoch: protocol::packet::Epoch(3),
            joints: protocol::message::Joints { in_use: 6, ..Default::default() },
        });
        test_client.send(&Message::Halt);
        // The configuration was changed in the middle of the run, and a replay from there applies it again.
        let (part, at) =
            if round == 0 { ("--to", (begins + changes) / 2.0) } else { ("--from", changes + 0.5) };
        let (ended, replayed) = place.replayed("run.log", &format!("--expect --speed max {part} {at:.6}"));
        assert!(replayed.all_came_back(&ended) > 5, "{:#}", replayed.0);
    }
    // Now cell 4 has another configuration than at the beginning.
    let ended = place.replay("run.log", "--expect --speed max --quiet").end();
    let line = ended.refusal(1);
    assert!(
        line.contains("these cells have a different configuration in the recording: 4 (recorded "),
        "{line}"
    );
}

#[test]
fn cells_with_other_parameters_and_cells_that_are_not_there_are_named() {
    let place = TestDir::new();
    place.records(8);
    let text = place.read("skin.toml");
    // Cell 3 is 10 cm elsewhere.
    let third = text.match_indices("\nposition = [").nth(2).unwrap().0;
    let moved = text[..third].to_owned()
        + &text[third..].replacen("position = [", "position = [0.1, 0.0, 0.1] # [", 1);
    place.write("moved.toml", &moved);
    let ended = place.replay("run.log", "--expect --spawn --skin moved.toml --quiet").end();
    let line = ended.refusal(1);
    let said = "skinbus: these cells have a different configuration in the recording: 3 (recorded ";
    assert!(
        line.starts_with(said) && line.ends_with("on vcan0; name the recording's skin with --skin"),
        "{line}"
    );

    place.write("other.toml", &text.replace("force_threshold_n = 0.1", "force_threshold_n = 0.3"));
    let ended = place.replay("run.log", "--expect --spawn --skin other.toml --quiet").end();
    let line = ended.refusal(1);
    assert!(
        line.starts_with(
            "skinbus: the recording was made with another skin: the configurations of all 8 cells differ: "
        ),
        "{line}"
    );
    place.is_left_clean();

    let bench = by_hand(&place, "1-6");
    let ended = place.replay("run.log", "--expect --quiet").end();
    let said = "skinbus: these cells of the recording are not on the bus: 7, 8 on vcan0; start them with cell-node, \
                or start all cells with --spawn";
    assert_eq!(ended.refusal(1), said);
    let ended = place.replay("run.log", &format!("{FRESH} --quiet")).end();
    let said =
        "skinbus: these cells are already on vcan0: 1, 2, 3, 4, 5, 6; omit --spawn to use them, or stop them";
    assert_eq!(ended.refusal(1), said);
    drop(bench);
}

#[test]
fn a_torque_that_is_not_the_recorded_one_is_shown_word_by_word() {
    let place = TestDir::new();
    place.records(8);
    let log = place.read("run.log");
    let wrong = changed(&log, 5, |message| is_torque(message, 2), |words| words[1] += 3);
    place.write("wrong.log", &wrong);
    let (ended, replayed) = place.replayed("wrong.log", &format!("{FRESH} --speed max"));
    place.is_left_clean();
    assert_eq!((ended.code(), &replayed.replies()[1..]), (Some(1), &[1, 0, 0][..]), "{:#}", replayed.0);
    assert!(
        ended.stderr.contains("skinbus: replies differ from the recorded ones: 1 different"),
        "{ended:#?}"
    );
    let text = replayed.text("/expect/first/text");
    assert!(ended.stdout.contains(text) && text.contains("cell 2 on vcan0, joints message "), "{text}");
    let lines: Vec<_> = text.lines().map(str::trim).collect();
    assert!(lines[1].starts_with("recorded  torque 2 epoch ") && lines[1].ends_with(" Nm"), "{text}");
    assert!(lines[2].starts_with("now       torque 2 epoch "), "{text}");
    assert_eq!(lines[3], "joint 2: 3 steps lower (0.0007 Nm)", "{text}");

    // Within a tolerance a reply counts as equal.
    for (steps, code, replies) in [("2", 1, [1, 0]), ("3", 0, [0, 1])] {
        let (ended, replayed) =
            place.replayed("wrong.log", &format!("{FRESH} --speed max --tolerance {steps}"));
        let [equal, different, missing, extra] = replayed.replies();
        let tolerated = replayed.number("/expect/tolerated");
        assert_eq!((ended.code(), missing, extra), (Some(code), 0, 0), "{:#}", replayed.0);
        assert_eq!([different, tolerated], replies, "{:#}", replayed.0);
        let words = &replayed.0["expect"]["torque_words"];
        assert_eq!((&words["by_steps"][3], &words["max"]), (&1.into(), &3.into()), "{:#}", replayed.0);
        assert!(equal > 15 && ended.stdout.contains("torque words that differ by 3"), "{}", ended.stdout);
        let said = "1 different, torque words differ by up to 3 steps (--tolerance 2)";
        assert_eq!(ended.stderr.contains(said), code == 1, "{ended:#?}");
    }

    // A reply that was not recorded, and one that cannot come.
    let counted = Counter::new(0);
    let gone = without(&log, |message| {
        let it = is_torque(message, 2) || is_torque(message, 3);
        it && counted.replace(counted.get() + 1) == 5
    });
    // The recording must not have counters that show that it is incomplete.
    let silent =
        |message: &Message| matches!(message, Message::Network { page: NetworkPage::Received(_), .. });
    let beats = Counter::new(0);
    let heartbeat = |message: &Message| {
        let it = matches!(message, Message::Network { page: NetworkPage::Heartbeat(beat), .. } if !beat.state.has(State::CLAIMING_NODE_ID));
        it && beats.replace(beats.get() + 1) >= 8
    };
    // Pages that a cell sends with its heartbeats cannot be compared without these.
    let beside = |message: &Message| matches!(message, Message::Sensors { page, .. } if !matches!(page, SensorPage::Skin(_)));
    let is_left_out = |message: &Message| silent(message) || heartbeat(message) || beside(message);
    place.write("gone.log", &without(&gone, is_left_out));
    let (ended, replayed) = place.replayed("gone.log", &format!("{FRESH} --speed max"));
    let [_, different, missing, extra] = replayed.replies();
    // Without counters a reply that a busy machine kept out of the recording is extra, too. Pages that a cell sent with a
    // heartbeat that is left out here are missing.
    assert!(ended.code() == Some(1) && different == 0 && extra >= 1, "{:#}", replayed.0);
    if missing == 0 {
        assert_eq!(replayed.text("/expect/first/how"), "extra");
    } else {
        assert!(replayed.text("/expect/first/text").contains("\n  recorded  sensors "), "{:#}", replayed.0);
    }
    // The counters show that the recording is the cause.
    place.write("gone.log", &gone);
    let (ended, replayed) = place.replayed("gone.log", &format!("{FRESH} --speed max"));
    replayed.all_came_back(&ended);
    // A busy machine during the recording is another cause, and the two cannot be distinguished.
    let lacking = ["unrecorded", "untaken"].map(|why| replayed.number(&format!("/expect/lacking/{why}")));
    assert!(lacking.iter().sum::<u64>() >= 1, "{:#}", replayed.0);
}

/// Returns true for a sum of a cell, of at least one cell.
fn is_sum(message: &Message, cell: u8) -> bool {
    matches!(message, Message::Sum { from, count, .. } if from.get() == cell && *count > 0)
}

#[test]
fn sums_without_their_children_come_back_in_any_tree() {
    let place = TestDir::new();
    let expected = generate::SkinRequest {
        cells: 12,
        reply: generate::ReplyMode::Sum,
        ..generate::SkinRequest::default()
    };
    place.write("skin.toml", &generate::generate(&expected).unwrap());
    place.scenario(TOUCHED);
    place.bench(4.0, "--record run.mcap").end().succeeded();
    place.is_left_clean();
    for file in ["run.mcap", "run.log"] {
        let (ended, replayed) = place.replayed(file, &format!("{FRESH} --lockstep"));
        replayed.all_came_back(&ended);
        place.is_left_clean();
        let lacking = |why| replayed.number(&format!("/expect/lacking/{why}"));
        assert_eq!(lacking("tree_unknown"), 0, "{:#}", replayed.0);
        // On a busy machine cells search for other parents, and some sums are omitted.
        let sums = replayed.number("/expect/sums");
        assert!(sums > 75, "{:#}", replayed.0);
    }

    // The root, which is not in contact, adds something to the sums that it forwards.
    let skin = Skin::read(&place.path("skin.toml")).unwrap();
    let root = skin.cells.iter().find(|cell| cell.root).unwrap().node;
    let wrong = (20..30).fold(place.read("run.log"), |log, nth| {
        changed(&log, nth, |message| is_sum(message, root.get()), |words| words[1] += 5)
    });
    place.write("wrong.log", &wrong);
    let (ended, replayed) = place.replayed("wrong.log", &format!("{FRESH} --lockstep"));
    let [_, different, missing, extra] = replayed.replies();
    assert_eq!((ended.code(), missing, extra), (Some(1), 0, 0), "{:#}", replayed.0);
    // A cell that changes its parent is left out, and so is a resent sum with more cells in it.
    assert!((1..=10).contains(&different), "{:#}", replayed.0);
    let text = replayed.text("/expect/first/text");
    assert!(
        text.starts_with(&format!("the first difference: cell {root} on vcan0, joints message ")),
        "{text}"
    );
    let lines: Vec<_> = text.lines().map(str::trim).collect();
    assert!(lines[1].starts_with(&format!("recorded  sum {root} epoch ")), "{text}");
    assert!(lines[1].contains("; without its child"), "{text}");
    // In another tree this cell may have nothing to forward.
    if lines[2] == "now       nothing" {
        assert!(lines[1].ends_with(": 0.000 0.020 0.000 0.000 0.000 0.000 Nm"), "{text}");
    } else {
        assert_eq!(lines.get(3), Some(&"joint 2: 5 steps lower (0.0195 Nm)"), "{text}");
    }
    place.is_left_clean();
}

#[test]
fn a_killed_cell_is_named_and_its_replies_are_missing() {
    let place = TestDir::new();
    place.records(8);
    let replay = place.replay("run.log", &format!("{FRESH} --lockstep"));
    place.test_client().waits_for_epoch(30);
    process::signal(replay.cell(1), Signal::KILL);
    let ended = replay.end();
    place.is_left_clean();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    assert!(ended.stderr.contains("cell 1 on vcan0 does not answer within "), "{ended:#?}");
    assert!(ended.stderr.contains("the process of cell 1 on vcan0 ended (signal: 9"), "{ended:#?}");
    let replayed = Replayed(serde_json::from_str(&place.read("replay.json")).unwrap());
    assert_eq!(replayed.0["lockstep"]["silent_cells"], serde_json::json!(["1 on vcan0"]));
    let [_, different, missing, extra] = replayed.replies();
    assert!(different == 0 && missing > 5 && extra == 0, "{:#}", replayed.0);
}

#[test]
fn a_foreign_capture_goes_to_another_bus_as_it_is() {
    let place = TestDir::new();
    let log = "(10.000000) can7 123#DEADBEEF\n(10.001000) can7 1F334455#R4\n# a comment\n\
               (10.002000) can8 00C##3AABB\n(10.002000) can7 20000004#0001000000000000\n(10.003000) can7 7FF#\n";
    place.write("foreign.log", log);
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let dump = place.start("skinbus", "dump vcan0 --bus-kind embedded -n 4");
    dump.wait_for_stderr("vcan0, a bus of kind embedded");
    let (ended, replayed) = place.replayed("foreign.log", "--map can7=vcan0 --map can8=vcan0");
    ended.succeeded();
    let ended = dump.end().succeeded();
    let seen: Vec<_> = ended.stdout.lines().map(|line| line.split([' ', '\t']).nth(2).unwrap()).collect();
    // The frames of one recorded bus keep their order; those of two buses may overtake each other on a busy machine.
    let (of_can8, of_can7): (Vec<_>, Vec<_>) = seen.iter().partition(|frame| frame.starts_with("00C"));
    assert_eq!((of_can7, of_can8), (vec!["123#DEADBEEF", "1F334455#R4", "7FF#"], vec!["00C##7AABB"]));
    assert_eq!(replayed.number("/sent"), 4);
    assert_eq!(replayed.0["skipped"], serde_json::json!({"error frame": 1, "note": 1}));
}

#[test]
fn a_cell_that_measures_obeys_for_the_replay_with_test_mode() {
    let place = TestDir::new();
    place.records(8);
    let [begins, changes] = begins_and_changes(&place.read("run.log"));
    let to = format!("--to {:.6}", (begins + changes) / 2.0);
    let _bench = by_hand(&place, "1-8");
    let test_client = place.test_client();
    let mode = |tag, request| Message::Configure { to: Node::Cell(cell(3)), tag, request };
    let number = Parameter::Mode.number();
    let answers = |tag: u8, expected: i16| {
        move |message: &Message| {
            matches!(message, Message::Configured { tag: of, answer: protocol::message::Answer::Value { words, .. }, .. }
                if *of == tag && words[0] == expected)
        }
    };
    test_client.waits_for("a cell that has settled", |message| {
        matches!(message, Message::Network { from, page: NetworkPage::Heartbeat(beat), .. }
            if *from == Node::Cell(cell(3)) && !beat.state.has(State::CLAIMING_NODE_ID))
    });
    test_client.send(&mode(1, Request::Write { number, words: [0; WORDS] }));
    test_client.waits_for("a cell that measures", answers(1, 0));
    let ended = place.replay("run.log", &format!("--expect {to} --quiet")).end();
    let said = "skinbus: these cells use their own sensors and ignore stimuli, unlike in the recording: 3; use \
                --test-mode, which puts them into test mode during the replay";
    assert_eq!(ended.refusal(1), said);
    let (ended, replayed) = place.replayed("run.log", &format!("--expect --speed max {to} --test-mode"));
    assert!(replayed.all_came_back(&ended) > 5, "{:#}", replayed.0);
    test_client.send(&mode(2, Request::Read { number }));
    test_client.waits_for("a cell that measures again", answers(2, 0));
}

/// The whole skin, while it is stroked: a few seconds of it, twice.
#[test]
fn two_hundred_and_fifty_three_fresh_cells_answer_as_the_others_did_twice() {
    let place = TestDir::new();
    fs::copy(example("ur5-253.toml"), place.path("skin.toml")).unwrap();
    fs::copy(example("demo.toml"), place.path("scenario.toml")).unwrap();
    place.bench(4.0, "").end().succeeded();
    place.is_left_clean();
    let mut counts = Vec::new();
    for route in ["--lockstep", "--speed max"] {
        let replay = place.replay("run.log", &format!("{FRESH} {route}"));
        let ended = replay.end_after(Duration::from_secs(120));
        let replayed = Replayed(serde_json::from_str(&place.read("replay.json")).unwrap());
        counts.push(replayed.all_came_back(&ended));
        place.is_left_clean();
    }
    assert!(counts[0] > 100 && counts[0] == counts[1], "{counts:?}");
}
