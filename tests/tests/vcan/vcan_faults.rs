//! Failures on a real kernel's bus: the interface, a cell, the gateway, a full queue.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::wildcard_enum_match_arm, reason = "a test looks for what it looks for")]

use skinbus_tests::process;

use process::log::Log;
use process::vcan::{Candump, Vcan, Vcan0, cansend, small_skin};
use process::{Ended, PRESSED, Running, Summary, TestDir, is_stopped, until};
use protocol::can::Format;
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, State};
use rustix::process::{Pid, Signal};

const CELLS: usize = 6;
const DOWN: &str = "vcan0 is down: bring it up with `";
const INVALID: &str = "the torque is not valid";
const ON_CELLS: &str = "--bus vcan0 --nodes 1-6 --skin skin.toml";

/// Creates six cells that are all pressed, and an arm that moves under the touch.
fn prepare() -> TestDir {
    let place = TestDir::on_vcan();
    place.write("skin.toml", &small_skin(CELLS));
    place.scenario(&PRESSED.replace("hold", "kinesthetic"));
    place
}

/// Returns a predicate for a torque of a pressed cell.
fn torque_of(cell: u8) -> impl Fn(&Message) -> bool {
    move |message| {
        matches!(message, Message::Torque { from, torque, .. }
            if from.get() == cell && !torque.is_zero())
    }
}

fn all_answer(place: &TestDir) {
    for cell in 1..=6 {
        place.test_client().waits_for("torques", torque_of(cell));
    }
}

/// Checks that everything is accounted for, although the cells may have been unable to send on a bus that accepted
/// nothing.
fn adds_up_though_the_bus_took_nothing(summary: &Summary) {
    let of = |pointer: &str| summary.of_bus(pointer);
    let reasons = ["in_time", "late", "too_late", "skipped", "not_heard", "lost", "in_doubt", "unknown"];
    let replies: u64 = reasons.map(|reason| of(&format!("/replies/{reason}"))).iter().sum();
    assert_eq!(replies, of("/replies/due"), "{:#}", summary.0);
    // The replies to the joints at which the bus stopped accepting frames: their cells could not send them.
    assert!(of("/replies/unknown") <= CELLS as u64, "{:#}", summary.0);
    let [dropped, backlog, outage, unknown] =
        ["dropped", "backlog", "outage", "unknown"].map(|why| of(&format!("/uplink/{why}")));
    let arrived = of("/uplink/delivered") + of("/uplink/rejected");
    assert_eq!(
        of("/uplink/sent") + of("/uplink/surplus"),
        arrived + dropped + backlog + outage + unknown,
        "{:#}",
        summary.0
    );
    assert_eq!(dropped, 0, "{:#}", summary.0);
}

/// Waits until a cell reports that the robot is halted, acknowledges, and checks that the same cells answer again.
fn goes_on_when_reported(place: &TestDir, bench: &Running, cells: &[(Pid, String)]) {
    place.test_client().waits_for("the cells to be halted", |message| {
        matches!(message, Message::Network { from: Node::Cell(_), page: NetworkPage::Heartbeat(heartbeat), .. }
            if heartbeat.state.has(State::HALTED))
    });
    place.start("skinbus", "frame resume --bus vcan0 --bus-kind socketcan").end().succeeded();
    bench.wait_for_stderr("the robot continues");
    all_answer(place);
    assert_eq!(bench.cells(), cells, "no cell was restarted");
}

/// Ends a bench whose bus accepted nothing for a while, and checks that the losses are exactly the expected ones.
fn ends_well_after_a_pause(place: &TestDir, bench: Running) {
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    adds_up_though_the_bus_took_nothing(&summary);
    assert!(summary.0["halted"].is_null(), "{:#}", summary.0);
    assert!(summary.number("/loop/unsent") > 0, "{:#}", summary.0);
    assert!(summary.count("/loop/bad_cycles", INVALID) >= 25, "{:#}", summary.0);
    assert_eq!(summary.total("/loop/bad_cycles"), summary.count("/loop/bad_cycles", INVALID));
    assert_eq!((summary.of_bus("/uplink/restarts"), summary.silent().len()), (0, 0), "{:#}", summary.0);
    assert_eq!(summary.odd(0), 0, "{:#}", summary.0);
    // A halted cell answers nothing before a resume.
    let log = Log::read(&place.read("run.log"), Format::Fd);
    let after = |index: usize, expected: &Message| {
        let mut rest = log.messages.iter().enumerate().skip(index);
        rest.find(|(_, (message, _))| message == expected).unwrap().0
    };
    let halt = after(0, &Message::Halt);
    let resume = after(halt, &Message::Resume);
    let joints = |until: usize| {
        log.messages[..until].iter().filter(|(message, _)| matches!(message, Message::Joints { .. })).count()
    };
    let halted = joints(halt)..joints(resume);
    assert!(!halted.is_empty());
    let torques = log.torques();
    let answers = torques.iter().filter(|(number, ..)| halted.contains(number));
    assert_eq!(answers.count(), 0, "halted cells answer nothing");
    assert!(torques.iter().any(|(number, ..)| *number >= halted.end));
}

#[test]
#[ignore = "needs vcan"]
fn a_bus_that_goes_down_halts_the_robot_and_works_again_when_it_is_up() {
    let (vcan0, place) = (Vcan0, prepare());
    let bench = place.running_bench(600.0, "");
    all_answer(&place);
    let cells = bench.cells();
    vcan0.down();
    bench.wait_for_stderr(DOWN);
    let hint = "`skinbus frame resume --bus vcan0 --bus-kind socketcan` resumes it";
    bench.wait_for_stderr(&format!("the robot is halted: too many bad cycles in a row: {INVALID}; {hint}"));
    for cell in 1..=6 {
        bench.wait_for_event(cell, "fallen silent");
    }
    let refused = place.start("skinbus", "frame resume --bus vcan0 --bus-kind socketcan").end();
    let said = refused.refusal(2);
    assert!(said.starts_with(&format!("skinbus: {DOWN}")), "{said}");
    vcan0.up();
    bench.wait_for_stderr("vcan0 works again");
    for cell in 1..=6 {
        bench.wait_for_event(cell, "come back");
    }
    assert!(!bench.stderr().contains("the robot continues"), "{}", bench.stderr());
    goes_on_when_reported(&place, &bench, &cells);
    assert_eq!(bench.stderr().matches("works again").count(), 1, "{}", bench.stderr());
    ends_well_after_a_pause(&place, bench);
}

#[test]
#[ignore = "needs vcan"]
fn a_transmit_queue_that_stays_full_costs_what_could_not_be_sent_and_nothing_after() {
    let (vcan0, place) = (Vcan0, prepare());
    let bench = place.running_bench(600.0, "");
    all_answer(&place);
    let cells = bench.cells();
    vcan0.fill();
    bench.wait_for_stderr(&format!("the robot is halted: too many bad cycles in a row: {INVALID}"));
    bench.wait_for_event(1, "fallen silent");
    let full = place.start("skinbus", "frame sync --bus vcan0 --bus-kind socketcan").end();
    let said = "skinbus: vcan0 accepted no frame for 100 ms: its queue is full; send less, or check that another node is on \
                the bus";
    assert_eq!(full.refusal(1), said);
    vcan0.empty();
    for cell in 1..=6 {
        bench.wait_for_event(cell, "come back");
    }
    goes_on_when_reported(&place, &bench, &cells);
    ends_well_after_a_pause(&place, bench);
}

#[test]
#[ignore = "needs vcan"]
fn cells_alone_outlive_a_bus_that_goes_down() {
    let (vcan0, place) = (Vcan0, prepare());
    let cells = place.start("cell-node", ON_CELLS);
    place.test_client().waits_for_settled_cells(CELLS);
    for epoch in 1..=3 {
        vcan0.down();
        // The cells must send a heartbeat during this time, get an error, and survive it.
        std::thread::sleep(std::time::Duration::from_millis(400));
        vcan0.up();
        place.test_client().waits_for_settled_cells(CELLS);
        let test_client = place.test_client();
        cansend(&place, "stimulus --cell 2 --force 3");
        cansend(&place, &format!("joints --epoch {epoch} --rad 0 -1.2 1.0 -1.4 -1.57 0"));
        test_client.waits_for("a torque", torque_of(2));
    }
    cells.signal(Signal::TERM);
    let ended = cells.end();
    assert_eq!((ended.signal(), ended.stderr.as_str()), (Some(15), ""), "{ended:#?}");
}

#[test]
#[ignore = "needs vcan"]
fn an_interface_that_is_removed_ends_the_run_with_one_line_and_the_log_is_kept() {
    let place = prepare();
    place.write("skin.toml", &small_skin(CELLS).replace("vcan0", "vcan5"));
    let removed = "vcan5 was removed while it was in use: create it again, then open it again";
    let vcan5 = Vcan::make("vcan5");
    let bench = place.running_bench(600.0, "");
    vcan5.remove();
    let Ended { status, stdout, stderr } = bench.end();
    assert!(status.code() == Some(1) && stdout.contains(" s, failed "), "{stdout}{stderr}");
    assert_eq!(stderr.lines().last(), Some(format!("skinbus: {removed}").as_str()));
    assert_eq!(stderr.matches(removed).count(), 1, "{stderr}");
    assert!(!stderr.contains("cell-node: "), "{stderr}");
    place.is_left_clean();
    assert_eq!(place.files(), ["run.json", "run.log", "scenario.toml", "skin.toml"]);
    assert_eq!(place.summary().0["failure"], removed);
    let log = Log::read(&place.read("run.log"), Format::Fd);
    assert!(!log.torques().is_empty());
    assert!(
        stderr.contains(&format!("{} frames received before the run ended are in run.log", log.frames.len())),
        "{stderr}"
    );

    // Cells that were started by hand report it themselves.
    let vcan5 = Vcan::make("vcan5");
    let cells = place.start("cell-node", "--bus vcan5 --nodes 1-6 --skin skin.toml");
    let lists = || {
        let list = |of: &str| {
            std::fs::read_to_string(format!("/proc/thread-self/net/can/rcvlist_{of}")).unwrap_or_default()
        };
        ["sff", "fil", "all"].into_iter().any(|of| list(of).contains("vcan5 "))
    };
    until("cells on vcan5", || lists().then_some(()));
    vcan5.remove();
    assert_eq!(cells.end().refusal(1), format!("cell-node: {removed}"));
}

#[test]
#[ignore = "needs vcan"]
fn a_bus_that_cannot_be_used_is_refused_with_its_hint() {
    let (vcan0, place) = (Vcan0, prepare());
    let run = |bus: &str| {
        place.write("skin.toml", &small_skin(CELLS).replace("vcan0", bus));
        let gateway = place.bench(1.0, "--quiet").end().refusal(2).to_owned();
        let cell = place
            .start("cell-node", &format!("--bus {bus} --bus-kind socketcan --node 1 --skin skin.toml"))
            .end()
            .refusal(2)
            .to_owned();
        assert_eq!(gateway.strip_prefix("skinbus: "), cell.strip_prefix("cell-node: "));
        gateway
    };
    vcan0.down();
    let says = |bus: &str, wrong: &str| {
        let said = run(bus);
        assert!(said.starts_with(&format!("skinbus: {wrong}")), "{said}");
    };
    says("vcan0", DOWN);
    let _narrow = Vcan::with_mtu("vcan6", 16);
    says("vcan6", "vcan6 has MTU 16, but CAN FD needs 72: set it with `");
    says("vcan7", "there is no interface vcan7: make it with `");
    says("lo", "lo is not a CAN interface");
}

#[test]
#[ignore = "needs vcan"]
fn cells_that_are_killed_started_by_hand_stopped_and_continued_are_named_and_accounted_for() {
    let place = prepare();
    let bench = place.running_bench(600.0, "");
    all_answer(&place);
    let (killed, stopped) = (bench.cell(3), bench.cell(5));
    process::signal(killed, Signal::KILL);
    bench.wait_for_stderr("the process of cell 3 on vcan0 ended (signal: 9 (SIGKILL))");
    bench.wait_for_event(3, "fallen silent");
    process::signal(stopped, Signal::STOP);
    until("a stopped cell", || is_stopped(stopped).then_some(()));
    bench.wait_for_event(5, "fallen silent");
    let by_hand = place.start("cell-node", "--bus vcan0 --node 3 --skin skin.toml");
    bench.wait_for_stderr("cell 3 on vcan0 restarted");
    // Its contact state is restored: the touch is as long as the run, and the bench resends it.
    place.test_client().waits_for("a torque of the new cell", torque_of(3));
    process::signal(stopped, Signal::CONT);
    bench.wait_for_event(5, "come back");
    all_answer(&place);
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    drop(by_hand);
    place.is_left_clean();
    let summary = place.summary();
    assert_eq!(summary.adds_up().silent().len(), 0);
    assert_eq!((summary.of_bus("/uplink/restarts"), summary.odd(0)), (1, 0), "{:#}", summary.0);
    assert!(
        summary.of_bus("/replies/in_doubt") > 0,
        "the last replies of cell 3 are in doubt: {:#}",
        summary.0
    );
    assert!(summary.of_bus("/replies/skipped") > 0, "cell 5 answers no old joints: {:#}", summary.0);
}

#[test]
#[ignore = "needs vcan"]
fn a_gateway_after_one_that_was_killed_goes_on_with_the_next_epoch_on_cells_that_outlived_it() {
    let place = prepare();
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    let cells = place.start("cell-node", ON_CELLS);
    place.test_client().waits_for_settled_cells(CELLS);
    let first = place.running_bench(600.0, "--no-spawn");
    place.test_client().waits_for_epoch(20);
    first.signal(Signal::KILL);
    assert_eq!(first.end().signal(), Some(9));
    let left = ["candump.log", "run.log", "scenario.toml", "skin.toml"];
    assert_eq!(place.files(), left, "its log is there, and nothing half done");
    place.bench(3.0, "--no-spawn").end().succeeded();
    let summary = place.summary();
    summary.adds_up();
    assert_eq!((summary.odd(0), summary.of_bus("/uplink/restarts")), (0, 0), "{:#}", summary.0);
    assert!(summary.of_bus("/replies/in_time") > 36, "{:#}", summary.0);
    cells.signal(Signal::TERM);
    assert_eq!(cells.end().signal(), Some(15));

    let log = Log::from_frames(candump.frames(), Format::Fd);
    let epochs = log.messages.iter().filter_map(|(message, _)| match message {
        Message::Joints { epoch, .. } => Some(*epoch),
        _ => None,
    });
    let epochs: Vec<_> = epochs.collect();
    let ours = Log::read(&place.read("run.log"), Format::Fd).joints().len();
    assert!(epochs.len() > ours + 10, "{} and {ours}", epochs.len());
    for (number, pair) in epochs.windows(2).enumerate() {
        assert_eq!(
            pair[1],
            pair[0].next(),
            "broadcast {number} of {}, the second run's begin {ours} before the end",
            epochs.len()
        );
    }
}

#[test]
#[ignore = "needs vcan"]
fn a_second_gateway_is_refused_and_the_first_is_undisturbed() {
    let place = prepare();
    let bench = place.running_bench(600.0, "");
    all_answer(&place);
    let second = "run skin.toml --scenario scenario.toml --duration 1 --summary second.json --candump second.log --overwrite --quiet";
    for more in ["", " --no-spawn"] {
        let ended = place.start("skinbus", &format!("{second}{more}")).end();
        let said =
            "skinbus: another gateway is on vcan0: stop one of the two, or run this one on another bus";
        assert_eq!(ended.refusal(1), said);
    }
    assert_eq!(place.files(), ["run.log", "scenario.toml", "second.json", "second.log", "skin.toml"]);
    all_answer(&place);
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    place.is_left_clean();
    let summary = place.summary();
    assert_eq!(summary.adds_up().silent().len(), 0);
    assert!(summary.0["halted"].is_null(), "{:#}", summary.0);
    let disturbed = summary.of_bus("/uplink/restarts") + summary.of_bus("/uplink/surplus");
    assert_eq!((disturbed, summary.odd(0)), (0, 0), "{:#}", summary.0);
    // The bus has no frame that the first gateway does not know of.
    assert_eq!(summary.count("/buses/0/received", "command"), 0, "{:#}", summary.0);
}

#[test]
#[ignore = "needs vcan"]
fn of_two_gateways_that_start_at_the_same_time_at_most_one_goes_on() {
    let place = prepare();
    for more in ["", "--no-spawn"] {
        let cells = (!more.is_empty()).then(|| {
            let cells = place.start("cell-node", ON_CELLS);
            place.test_client().waits_for_settled_cells(CELLS);
            cells
        });
        let run = |name: &str| {
            let words = format!(
                "run skin.toml --scenario scenario.toml --duration 2 --quiet --summary {name}.json --overwrite {more}"
            );
            place.start("skinbus", &words)
        };
        let both = ["one", "other"].map(run).map(Running::end);
        let good = both.iter().filter(|ended| ended.code() == Some(0)).count();
        assert!(good <= 1, "{both:#?}");
        // The next run finds a bus that works.
        place.bench(2.0, more).end().succeeded();
        let summary = place.summary();
        assert_eq!(summary.adds_up().silent().len(), 0);
        assert!(summary.of_bus("/replies/in_time") > 24, "{:#}", summary.0);
        drop(cells);
        place.is_left_clean();
    }
}
