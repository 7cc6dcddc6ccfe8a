//! Sensors frames of cells as processes, switched by their skin and from a shell.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use process::log::Log;
use process::{PRESSED, Running, TestDir, skin};
use protocol::bus::{Bus, Inbox};
use protocol::can::{Format, Frame};
use protocol::fixed::{Q, Q5_10};
use protocol::id::{CellId, Kind, Node};
use protocol::message::{Answer, Message, NetworkPage, SensorPage, SkinSensors, State, StimulusStart};
use protocol::packet::Packet;
use protocol::touch::contact_force;
use rustix::process::Signal;
use serde_json::json;

const CELLS: u8 = 8;

/// Creates a place whose skin has these keys of its bus.
fn place(sensing: &str, scenario: &str) -> TestDir {
    let place = TestDir::new();
    let format = "format = \"fd\"";
    let text = skin(CELLS.into());
    assert!(text.contains(format), "{text}");
    place.write("skin.toml", &text.replacen(format, &format!("{format}\n{sensing}"), 1));
    place.scenario(scenario);
    place
}

fn ends(bench: Running) {
    bench.signal(Signal::TERM);
    bench.end().succeeded();
}

/// Runs a command in this place successfully, and returns its output.
fn switches(place: &TestDir, words: &str) -> String {
    place
        .start("skinbus", &format!("frame sensing {words} --bus vcan0 --bus-kind embedded"))
        .end()
        .succeeded()
        .stdout
}

fn refusal(place: &TestDir, words: &str, code: i32) -> String {
    place
        .start("skinbus", &format!("frame sensing {words} --bus vcan0 --bus-kind embedded"))
        .end()
        .refusal(code)
        .to_owned()
}

#[test]
fn a_skin_switches_its_cells_to_events_and_the_summary_has_every_touch() {
    let place = place("sensing = \"event\"", PRESSED);
    let bench = place.running_bench(600.0, "");
    // A rate needs a second.
    place.test_client().waits_for_epoch(120);
    ends(bench);
    place.is_left_clean();
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.odd(0), 0, "{:#}", summary.0);
    let sensors = &summary.0["buses"][0]["sensors"];
    // Each is pressed from the first joints on, until the end.
    assert_eq!((sensors["touches"].as_u64(), sensors["releases"].as_u64()), (Some(8), Some(0)), "{sensors}");
    let frames = summary.count("/buses/0/received", "sensors");
    assert_eq!(sensors["frames"].as_u64(), Some(frames));
    assert!(sensors["min_hz"].as_f64().unwrap() > 0.2, "{sensors}");
    // At its start a cell would be switched twice, and answer twice: it has the default thresholds, so once.
    assert_eq!(summary.count("/buses/0/received", "configured"), 8, "{:#}", summary.0);
}

#[test]
fn a_running_bench_is_switched_from_a_shell_for_one_cell_and_for_all() {
    let place = place("", PRESSED);
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    let tells = |cell: u8| {
        test_client.waits_for(&format!("a sensors frame of cell {cell}"), |message| {
            matches!(message, Message::Sensors { from, page: SensorPage::Skin(skin), .. }
                if from.get() == cell && contact_force(skin) > 0)
        });
    };
    assert_eq!(switches(&place, "event --cell 3"), "cell 3 on vcan0 (embedded): event\n");
    tells(3);
    let all = "8 cells on vcan0 (embedded): continuous, every 20 ms\n";
    assert_eq!(switches(&place, "continuous 50"), all);
    (1..=CELLS).for_each(tells);
    assert_eq!(switches(&place, "off"), "8 cells on vcan0 (embedded): off\n");

    let why = "skinbus: cell 99 on vcan0 sent no answer: start the cell, or give the frame format of the bus \
               with --format classic";
    assert_eq!(refusal(&place, "event --cell 99", 1), why);
    ends(bench);
    place.is_left_clean();
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.odd(0), 0, "{:#}", summary.0);
}

#[test]
fn a_cell_that_restarts_is_switched_again_to_what_it_was() {
    let restart = "\n[[fault]]\nat_s = 1.5\nkind = \"restart\"\ncells = [5]\nbus = \"vcan0\"\n";
    let place = place("sensing = \"continuous\"\nsensing_hz = 20.0", &format!("{PRESSED}{restart}"));
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    let fifth = CellId::new(5).unwrap();
    bench.wait_for_stderr("cell 5 on vcan0 restarted");
    test_client.waits_for("its confirmation", |message| {
        matches!(message, Message::Configured { from, answer: Answer::Value { number: 7, written: true, words }, .. }
            if *from == fifth && words[..2] == [1, 50])
    });
    test_client.waits_for(
        "its sensors",
        |message| matches!(message, Message::Sensors { from, .. } if *from == fifth),
    );
    ends(bench);
    place.is_left_clean();
    place.summary().adds_up();
}

/// Returns the sizes of a cell's torques in a log, in their order.
fn sizes(log: &Log, cell: u8) -> Vec<i32> {
    let size = |(message, _): &(Message, _)| {
        let Message::Torque { from, torque, .. } = message else { return None };
        let size = torque.padded().iter().map(|word| i32::from(*word).abs()).sum();
        (from.get() == cell).then_some(size)
    };
    log.messages.iter().filter_map(size).collect()
}

/// Ten degrees in eight seconds, with offsets that would all be contacts without a baseline.
#[test]
fn cells_whose_sensors_drift_feel_what_touches_them_and_nothing_else() {
    let place = TestDir::new();
    let head = skin(4);
    place.write("skin.toml", &head.replacen("[controller]", "[baseline]\nlimit_n = 2.0\n\n[controller]", 1));
    place.scenario(
        "duration_s = 8.0\n[motion]\nkind = \"hold\"\n[[touch]]\nat_s = 2.0\nfor_s = 5.0\ncells = [2]\nforce_n = 1.0\n\
         [sensors]\ntemperature_c = [[0.0, 25.0], [8.0, 35.0]]\n[sensors.force]\nkind = \"piezoresistive\"\n",
    );
    place.bench(8.0, "").end().succeeded();
    place.is_left_clean();
    let log = Log::read(&place.read("run.log"), Format::Fd);
    let torques = sizes(&log, 2);
    assert!(torques.len() > 30, "{} torques of a touch", torques.len());
    // The last one is zeros; its neighbours may be of the touch's first and last epochs.
    let (first, last) = (torques[2], torques[torques.len() - 3]);
    assert!(f64::from(last) > 0.95 * f64::from(first), "{first} {last}");
    assert_eq!(torques.last(), Some(&0), "after the release nothing is there");
    for cell in [1, 3, 4] {
        assert_eq!(sizes(&log, cell), [0; 0], "cell {cell}");
    }
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.odd(0), 0, "{:#}", summary.0);
}

/// A robot that stands, and one that a controller moves, both without a touch.
#[test]
fn accelerometers_of_a_robot_at_rest_show_gravity_in_the_frames_of_their_cells() {
    for motion in ["hold", "kinesthetic"] {
        let place = place(
            "sensing = \"continuous\"\nsensing_hz = 20.0",
            &format!("[motion]\nkind = \"{motion}\"\n[sensors.acceleration]\nkind = \"perfect\"\n"),
        );
        place.bench(2.0, "").end().succeeded();
        place.is_left_clean();
        let log = Log::read(&place.read("run.log"), Format::Fd);
        let mut shown = std::collections::BTreeMap::new();
        for (message, _) in &log.messages {
            if let Message::Sensors { from, page: SensorPage::Acceleration(words), .. } = message {
                shown.insert(from.get(), *words);
            }
        }
        assert_eq!(shown.len(), usize::from(CELLS), "{motion}: {shown:?}");
        let size =
            |words: &[Q<12>; 3]| words.map(Q::to_f64).map(|word| word * word).iter().sum::<f64>().sqrt();
        assert!(shown.values().all(|it| (size(it) - 1.0).abs() < 1e-3), "{motion}: {shown:?}");
        let ways: std::collections::BTreeSet<_> = shown.values().collect();
        assert!(ways.len() > 5, "{motion}: most face in other directions: {shown:?}");
        place.summary().adds_up();
    }
}

#[test]
fn an_invalid_request_is_refused_in_one_line() {
    let place = TestDir::new();
    assert_eq!(
        refusal(&place, "continuous", 2),
        "skinbus: continuous needs a rate, such as `continuous 62.5`"
    );
    assert_eq!(
        refusal(&place, "event 10", 2),
        "skinbus: HZ = 10: only the mode continuous has a rate: leave it out"
    );
    assert_eq!(
        refusal(&place, "continuous 60", 2),
        "skinbus: HZ = 60: its period must be a whole number of ms; the nearest rates are 58.8235 and 62.5000 Hz"
    );
    let nowhere = refusal(&place, "event", 2);
    assert!(nowhere.starts_with("skinbus: ") && nowhere.contains("vcan0"), "{nowhere}");
}

/// Cells that have accepted stimuli before a gateway listens: from another sender, and from a gateway that was killed.
#[test]
fn cells_that_were_pressed_before_are_compared_only_once_their_contact_is_known() {
    let place = TestDir::new();
    place.skin(8);
    let head = "version = 1\n[motion]\nkind = \"hold\"\nstart_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]\n";
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let cells = place.start("cell-node", "--bus vcan0 --bus-kind embedded --nodes 1-8 --skin skin.toml");
    let test_client = place.test_client();
    let third = Node::Cell(process::replay::cell(3));
    test_client.waits_for("cell 3", |message| {
        matches!(*message, Message::Network { from, page: NetworkPage::Heartbeat(beat), .. }
            if from == third && !beat.state.has(State::CLAIMING_NODE_ID))
    });
    let contact = [Q5_10::nearest(1.0); 3];
    let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
    test_client.send(&Message::Stimulus { to: third, from: StimulusStart::Next, page });

    // A run without touches leaves the cell as it is, and reports that its contact is unknown.
    place.scenario(head);
    let ended = place.bench(1.5, "--no-spawn").end().succeeded();
    let said =
        "it is unknown whether these cells are in contact, so their torques are not compared: 3 on vcan0;";
    assert!(ended.stderr.contains(said), "{}", ended.stderr);
    let summary = place.summary();
    let unknown = summary.of_bus("/replies/contact_unknown");
    let reason = format!("{unknown} not due: it is unknown whether the cells were touched");
    assert!(unknown > 0 && ended.stdout.contains(&reason), "{}", ended.stdout);
    assert_eq!(summary.adds_up().of_bus("/replies/due"), 0, "{:#}", summary.0);
    assert_eq!(summary.number("/accuracy/single/count"), 0, "{:#}", summary.0);

    // A gateway that is killed leaves stimuli for epochs to come; the next one touches another cell.
    let touch = "[[touch]]\nat_s = 0.0\nfor_s = 50.0\nforce_n = 3.0\n";
    place.scenario(&format!("{head}{touch}cells = [3]\nprofile = \"ramp\"\n"));
    let killed = place.running_bench(600.0, "--no-spawn");
    let node = process::replay::cell(3);
    test_client
        .waits_for("its torque", |message| matches!(*message, Message::Torque { from, .. } if from == node));
    killed.signal(Signal::KILL);
    killed.end();
    place.scenario(&format!("{head}{touch}cells = [5]\n"));
    place.bench(1.5, "--no-spawn").end().succeeded();
    let summary = place.summary();
    summary.adds_up();
    let due = summary.of_bus("/replies/due");
    assert!(due > 0, "{:#}", summary.0);
    assert_eq!(summary.cells()[4]["due"].as_u64(), Some(due), "from the first epoch on: {:#}", summary.0);
    assert_eq!(summary.of_bus("/replies/contact_unknown"), 0, "{:#}", summary.0);
    assert_eq!(summary.of_bus("/replies/unexpected"), 0, "{:#}", summary.0);
    assert!(summary.figure("/accuracy/single/max_nm") < 1e-3, "{:#}", summary.0);
    drop((cells, server, test_client));
}

/// Ends the forwarding threads, also when the test fails.
struct Stops<'a>(&'a AtomicBool);

impl Drop for Stops<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Forwards frames, changed by `change`, until it is stopped.
fn pass_on(from: &Bus, to: &Bus, stop: &AtomicBool, mut change: impl FnMut(&Frame) -> Frame) {
    let mut inbox = Inbox::new();
    while !stop.load(Ordering::Relaxed) {
        from.wait(Some(Duration::from_millis(20))).unwrap();
        from.receive(&mut inbox).unwrap();
        let frames: Vec<_> = inbox.frames().map(|received| change(&received.frame)).collect();
        to.send(&frames).unwrap();
    }
}

#[test]
fn a_cell_that_sends_one_torque_for_ever_is_named_in_the_table_the_summary_and_the_report() {
    // The cell is on a bus of its own, and its packets arrive changed at the others.
    let [place, behind] = [TestDir::new(), TestDir::new()];
    let moving = PRESSED
        .replace("hold", "sine")
        .replace("start_rad", "period_s = 2.0\namplitude = [0.4, 0.4, 0.4, 0.0, 0.0, 0.0]\nstart");
    for place in [&place, &behind] {
        place.skin(8);
        place.scenario(&moving);
    }
    let servers = [&place, &behind].map(|place| place.start("vcan-setup", "serve vcan0"));
    let (bench, far) = (place.test_client().bus, behind.test_client().bus);
    let cells = [("1-4", &place), ("6-8", &place), ("5-5", &behind)].map(|(nodes, on)| {
        let words = format!("--bus vcan0 --bus-kind embedded --nodes {nodes} --skin skin.toml");
        on.start("cell-node", &words)
    });
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let stops = Stops(&stop);
        scope.spawn(|| pass_on(&bench, &far, &stop, |frame| *frame));
        scope.spawn(|| {
            let mut first = None;
            pass_on(&far, &bench, &stop, |frame| match Packet::from_fd(frame) {
                Ok(mut packet) if packet.id.kind == Kind::Torque && !packet.words.is_zero() => {
                    packet.words = *first.get_or_insert(packet.words);
                    packet.frames(Format::Fd).next().unwrap()
                }
                _ => *frame,
            });
        });
        place.test_client().waits_for_settled_cells(8);
        let ended = place.bench(6.0, "--no-spawn --record run.mcap").end().succeeded();
        drop(stops);
        assert!(ended.stdout.contains("stuck: cell 5"), "{}", ended.stdout);
    });
    drop((cells, servers));
    let summary = place.summary();
    let stuck = summary.0["cells"].as_array().unwrap().iter().filter(|cell| cell["stuck"] != json!({}));
    let stuck: Vec<_> =
        stuck.map(|cell| (&cell["node"], cell["stuck"]["torque"].as_u64() > Some(31))).collect();
    assert_eq!(stuck, [(&json!(5), true)], "{:#}", summary.0["cells"]);
    place.start("skinbus", "report run.mcap -o run.html").end().succeeded();
    let page = place.read("run.html");
    assert!(
        page.contains("stuck cells, which sent constant words while the expected words changed (vcan0 5: "),
        "not in the report"
    );
}
