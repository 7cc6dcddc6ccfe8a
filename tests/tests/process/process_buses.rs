//! Several buses, some with CAN FD and some with classic frames: losing one does not affect the others, and it comes
//! back.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::wildcard_enum_match_arm, reason = "a test looks for what it looks for")]

use skinbus_tests::process;

use std::fs::{DirBuilder, Permissions};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};

use model::decode::{Decoded, Decoder};
use model::generate::{Format as Wire, ReplyMode, SkinRequest, generate};
use process::buses::{carries, mixed_skin};
use process::test_client::TestClient;
use process::{PRESSED, Running, TestDir, signal, skin_of, until};
use protocol::bus::embedded::{HelloReply, MAX_HELLO_BYTES, seqpacket_socket, socket_address};
use protocol::can::{Format, Frame};
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, Request};
use protocol::parameters::Parameter;
use protocol::time::Micros;
use rustix::net::{RecvFlags, SendFlags, Shutdown, SocketFlags};
use rustix::process::{Pid, Signal};

/// vcan0 and vcan2 carry CAN FD, vcan1 classic frames.
const BUSES: [(&str, Format); 3] = [("vcan0", Format::Fd), ("vcan1", Format::Classic), ("vcan2", Format::Fd)];
const CELLS: usize = 12;
const LOST: &str = "the embedded bus vcan1 was closed: its server ended; the other buses continue";

/// Creates twelve cells on three buses, all pressed, and an arm that moves under the touch.
fn place() -> TestDir {
    let place = TestDir::new();
    place.write("skin.toml", &mixed_skin(&skin_of(CELLS, 3, Wire::Fd), &["vcan1"]));
    place.scenario(&PRESSED.replace("hold", "kinesthetic"));
    place
}

/// Serves a bus, as another program would.
fn serve(place: &TestDir, bus: &str) -> Running {
    let server = place.start("vcan-setup", &format!("serve {bus}"));
    server.wait_for_stdout(&format!("serving {bus} at "));
    server
}

/// Returns the process that serves a bus for the gateway.
fn server(place: &TestDir, bus: &str) -> Pid {
    let found = || place.processes().into_iter().find(|(_, line)| line.contains(&format!(" serve {bus} ")));
    until("a server", found).0
}

/// Opens a client on each bus.
fn test_clients(place: &TestDir) -> [TestClient; 3] {
    BUSES.map(|(bus, format)| TestClient::on(place, bus, format))
}

/// Ends a bench and the server of vcan1; checks that all counts add up on all buses, and that only vcan1 was lost, this
/// number of times.
fn ended_well(place: &TestDir, bench: Running, server: Option<Running>, times: u64) {
    bench.signal(Signal::TERM);
    let ended = bench.end().succeeded();
    if let Some(server) = server {
        server.signal(Signal::TERM);
        server.end().succeeded();
    }
    place.is_left_clean();
    let summary = place.summary();
    summary.adds_up();
    for (index, (bus, _)) in BUSES.iter().enumerate() {
        let of = |key: &str| &summary.0["buses"][index]["outages"][key];
        let lost = if *bus == "vcan1" { times } else { 0 };
        assert_eq!(
            (of("times").as_u64(), of("at_end").as_bool()),
            (Some(lost), Some(false)),
            "{:#}",
            summary.0
        );
        assert_eq!(of("lost_s").as_f64() > Some(0.0), lost > 0, "{:#}", summary.0);
        assert_eq!(of("ticks").as_u64() > Some(0), lost > 0, "{:#}", summary.0);
        let silent = summary.0["buses"][index]["silent_cells"].as_array().unwrap();
        assert_eq!((silent.len(), summary.number(&format!("/buses/{index}/uplink/restarts"))), (0, 0));
        assert_eq!(summary.0["buses"][index]["name"], *bus);
    }
    assert!(ended.stdout.contains("ticks ran without this bus"), "{}", ended.stdout);
}

#[test]
fn a_bus_of_ours_that_ends_is_served_and_opened_again_and_its_cells_are_the_same() {
    let place = place();
    let bench = place.running_bench(600.0, "--record run.mcap");
    test_clients(&place).iter().for_each(|bus| bus.waits_for_torques(1..=4));
    let cells = bench.cells();
    for times in 1..=2 {
        signal(server(&place, "vcan1"), Signal::KILL);
        let said =
            |words: &str| until(words, || (bench.stderr().matches(words).count() == times).then_some(()));
        said(LOST);
        said("the process that served vcan1 ended (signal: 9 (SIGKILL)); a new process serves it");
        said("vcan1 works again");
        test_clients(&place).iter().for_each(|bus| bus.waits_for_torques(1..=4));
    }
    assert_eq!(bench.cells(), cells, "no cell was restarted");
    ended_well(&place, bench, None, 2);
    let summary = place.summary();
    assert_eq!(summary.total("/loop/bad_cycles"), 0, "{:#}", summary.0);
    assert!(summary.0["halted"].is_null(), "{:#}", summary.0);
    // The cells' answers in that time were lost with the bus, and do not count as differences.
    for capture in ["run.mcap", "run.log"] {
        place.start("skinbus", &format!("convert {capture} notes.log --overwrite")).end().succeeded();
        let lines = place.read("notes.log");
        assert_eq!(
            lines.lines().filter(|line| *line == "# the bus 'vcan1' was lost").count(),
            2,
            "{capture}"
        );
        assert_eq!(
            lines.lines().filter(|line| *line == "# the bus 'vcan1' works again").count(),
            2,
            "{capture}"
        );
        let replay =
            format!("replay {capture} --skin skin.toml --spawn --expect --lockstep --bus-kind embedded");
        place.start("skinbus", &replay).end().succeeded();
    }
}

#[test]
fn each_bus_has_its_own_tree_which_is_complete_again_when_the_bus_is_back() {
    let place = place();
    let expected = SkinRequest { cells: CELLS, buses: 3, reply: ReplyMode::Sum, ..SkinRequest::default() };
    place.write("skin.toml", &mixed_skin(&generate(&expected).unwrap(), &["vcan1"]));
    let bench = place.running_bench(600.0, "");
    let whole = || test_clients(&place).iter().for_each(|bus| bus.waits_for_a_sum_of(4));
    whole();
    let cells = bench.cells();
    signal(server(&place, "vcan1"), Signal::KILL);
    bench.wait_for_stderr("vcan1 works again");
    whole();
    assert_eq!(bench.cells(), cells, "no cell was restarted");
    ended_well(&place, bench, None, 1);
    assert_eq!(place.summary().total("/loop/bad_cycles"), 0, "{:#}", place.summary().0);
}

#[test]
fn while_a_bus_is_away_the_others_go_on_and_changes_are_sent_to_it_afterwards() {
    let place = place();
    let first = serve(&place, "vcan1");
    let bench = place.running_bench(600.0, "--record run.mcap");
    test_clients(&place).iter().for_each(|bus| bus.waits_for_torques(1..=4));
    let cells = bench.cells();
    first.signal(Signal::KILL);
    first.end();
    bench.wait_for_stderr(LOST);
    (1..=4).for_each(|cell| bench.wait_for_event_on("vcan1", cell, "fallen silent"));
    for (bus, format) in [BUSES[0], BUSES[2]] {
        let test_client = TestClient::on(&place, bus, format);
        test_client.waits_for_joints(30);
        test_client.waits_for_torques(1..=4);
    }
    // The robot is halted and resumed while the bus does not receive that.
    place.start("skinbus", "frame halt --bus vcan0 --bus-kind embedded").end().succeeded();
    bench.wait_for_stderr("the robot is halted: a halt frame was received; `skinbus frame resume --bus vcan0 --bus-kind embedded`");
    let second = serve(&place, "vcan1");
    bench.wait_for_stderr("vcan1 works again");
    (1..=4).for_each(|cell| bench.wait_for_event_on("vcan1", cell, "come back"));
    let [_, vcan1, _] = test_clients(&place);
    vcan1.waits_for_halted_cells(1..=4);
    place.start("skinbus", "frame resume --bus vcan2 --bus-kind embedded").end().succeeded();
    bench.wait_for_stderr("the robot continues");
    test_clients(&place).iter().for_each(|bus| bus.waits_for_torques(1..=4));
    assert_eq!(bench.cells(), cells, "no cell was restarted");
    ended_well(&place, bench, Some(second), 1);
    assert_eq!(place.summary().total("/loop/bad_cycles"), 0, "{:#}", place.summary().0);
    assert!(place.summary().number("/loop/unsent") > 0, "{:#}", place.summary().0);
    // All frames of the buses are in the log, each with its bus.
    let log = place.read("run.log");
    for (bus, format) in BUSES {
        assert!(carries(&log, bus, format), "{bus}");
    }
}

#[test]
fn cells_that_were_away_receive_a_missed_resume_and_a_missed_touch() {
    let place = place();
    let late = "at_s = 2.0\nfor_s = 600.0\nbus = \"vcan1\"";
    let text = place.read("scenario.toml");
    let touch = text.find("[[touch]]").unwrap();
    let others =
        ["vcan0", "vcan2"].map(|bus| text[touch..].replacen("at_s", &format!("bus = \"{bus}\"\nat_s"), 1));
    let vcan1 = text[touch..].replacen("at_s = 0.0\nfor_s = 600.0", late, 1);
    place.scenario(&[&text[..touch], &others[0], "\n", &others[1], "\n", &vcan1].concat());
    let first = serve(&place, "vcan1");
    let bench = place.running_bench(600.0, "");
    place.start("skinbus", "frame halt --bus vcan0 --bus-kind embedded").end().succeeded();
    TestClient::on(&place, "vcan1", Format::Classic).waits_for_halted_cells(1..=4);
    first.signal(Signal::KILL);
    first.end();
    bench.wait_for_stderr(LOST);
    place.start("skinbus", "frame resume --bus vcan0 --bus-kind embedded").end().succeeded();
    bench.wait_for_stderr("the robot continues");
    // More than the two seconds after which the absent cells are touched.
    TestClient::on(&place, "vcan2", Format::Fd).waits_for_joints(150);
    let second = serve(&place, "vcan1");
    test_clients(&place).iter().for_each(|bus| bus.waits_for_torques(1..=4));
    ended_well(&place, bench, Some(second), 1);
}

#[test]
fn a_bus_that_is_lost_at_the_end_makes_the_run_fail_with_its_figures() {
    let place = place();
    let vcan1 = serve(&place, "vcan1");
    let bench = place.running_bench(600.0, "");
    test_clients(&place).iter().for_each(|bus| bus.waits_for_torques(1..=4));
    vcan1.signal(Signal::KILL);
    vcan1.end();
    bench.wait_for_stderr(LOST);
    TestClient::on(&place, "vcan0", Format::Fd).waits_for_joints(30);
    bench.signal(Signal::TERM);
    let ended = bench.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    assert!(
        ended.stderr.ends_with("skinbus: these buses did not work when the run ended: vcan1\n"),
        "{ended:#?}"
    );
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.0["buses"][1]["outages"]["at_end"], true, "{:#}", summary.0);
    assert_eq!(summary.number("/buses/0/outages/times") + summary.number("/buses/2/outages/times"), 0);
    assert_eq!(summary.total("/loop/bad_cycles"), 0, "{:#}", summary.0);
    assert!(ended.stdout.contains("lost") && ended.stdout.contains("also at the end"), "{}", ended.stdout);
}

#[test]
fn a_robot_that_must_not_go_on_without_a_bus_is_halted_until_it_is_back() {
    let place = place();
    let safety = "[safety]\nlost_bus = \"halt\"\n\n[controller]";
    place.write("skin.toml", &place.read("skin.toml").replacen("[controller]", safety, 1));
    let first = serve(&place, "vcan1");
    let bench = place.running_bench(600.0, "");
    test_clients(&place).iter().for_each(|bus| bus.waits_for_torques(1..=4));
    first.signal(Signal::KILL);
    first.end();
    bench.wait_for_stderr("the robot is halted: too many bad cycles in a row: the torque is not valid");
    let second = serve(&place, "vcan1");
    bench.wait_for_stderr("vcan1 works again");
    place.start("skinbus", "frame resume --skin skin.toml --bus-kind embedded").end().succeeded();
    bench.wait_for_stderr("the robot continues");
    test_clients(&place).iter().for_each(|bus| bus.waits_for_torques(1..=4));
    ended_well(&place, bench, Some(second), 1);
    assert!(place.summary().count("/loop/bad_cycles", "the torque is not valid") >= 25);
}

#[test]
fn a_gateway_that_has_no_bus_left_ends() {
    let place = place();
    let servers = BUSES.map(|(bus, _)| serve(&place, bus));
    let bench = place.running_bench(600.0, "");
    let [vcan0, vcan1, vcan2] = servers;
    for (server, bus) in [(vcan0, "vcan0"), (vcan2, "vcan2")] {
        server.signal(Signal::TERM);
        server.end().succeeded();
        bench.wait_for_stderr(&format!(
            "the embedded bus {bus} was closed: its server ended; the other buses continue"
        ));
    }
    vcan1.signal(Signal::TERM);
    vcan1.end().succeeded();
    let ended = bench.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let said = "skinbus: the embedded bus vcan1 was closed: its server ended\n";
    assert!(ended.stderr.ends_with(said), "{ended:#?}");
    place.is_left_clean();
    let summary = place.summary();
    assert_eq!(
        (&summary.0["outcome"], summary.adds_up().0["buses"].as_array().unwrap().len()),
        (&"failed".into(), 3)
    );
}

#[test]
fn each_bus_has_the_requested_kind() {
    let place = place();
    let run = |kinds: &str| {
        place
            .start("skinbus", &format!("run skin.toml --scenario scenario.toml --duration 1 --quiet {kinds}"))
    };
    let refused = |kinds: &str| run(kinds).end().refusal(2).to_owned();
    assert_eq!(
        refused("--bus-kind embedded --bus-kind vcan7=embedded"),
        "skinbus: --bus-kind vcan7=embedded: there is no bus vcan7; the buses are vcan0, vcan1, vcan2"
    );
    assert_eq!(
        refused("--bus-kind vcan1=embedded --bus-kind vcan1=socketcan"),
        "skinbus: --bus-kind is given twice for vcan1: embedded and socketcan; leave out one"
    );
    let said = refused("--bus-kind vcan1=vcan");
    assert!(said.contains("\"vcan1=vcan\" is not a bus kind: use auto, socketcan or embedded"), "{said}");
    // Whatever the kernel has, it has no vcan1 of ours.
    let said = refused("--bus-kind embedded --bus-kind vcan1=socketcan");
    assert!(
        said.starts_with("skinbus: vcan1: this kernel has no") || said.contains("no interface vcan1"),
        "{said}"
    );
    run("--bus-kind vcan0=embedded --bus-kind vcan1=embedded --bus-kind vcan2=embedded").end().succeeded();
    place.is_left_clean();
}

/// A server of vcan0 that the test itself plays.
struct PlayedServer {
    listener: OwnedFd,
    decoder: Decoder,
    /// The number of received packets.
    packets: u16,
}

impl PlayedServer {
    fn at(place: &TestDir) -> Self {
        let directory = place.buses();
        DirBuilder::new().recursive(true).mode(0o700).create(&directory).unwrap();
        std::fs::set_permissions(&directory, Permissions::from_mode(0o700)).unwrap();
        let listener = seqpacket_socket(SocketFlags::empty()).unwrap();
        rustix::net::bind(&listener, &socket_address(&directory, "vcan0").unwrap()).unwrap();
        rustix::net::listen(&listener, 8).unwrap();
        Self { listener, decoder: Decoder::new(None), packets: 0 }
    }

    /// Accepts a client. A client that only checks for a listener sends no hello.
    fn admits(&self) -> OwnedFd {
        let client = loop {
            let client = rustix::net::accept(&self.listener).unwrap();
            if rustix::net::recv(&client, &mut [0; MAX_HELLO_BYTES], RecvFlags::empty())
                .is_ok_and(|(len, _)| len > 0)
            {
                break client;
            }
        };
        let answer = HelloReply::Welcome { granted: 1 << 20, version: 3, stamps: false }.encode();
        rustix::net::send(&client, &answer, SendFlags::NOSIGNAL).unwrap();
        client
    }

    /// Returns the next message of a cell, or `None` after it has sent everything that it can.
    fn receives(&mut self, client: &OwnedFd) -> Option<Message> {
        loop {
            let mut bytes = [0; 72];
            let (length, _) = rustix::net::recv(client, &mut bytes, RecvFlags::empty()).unwrap();
            let frame = Frame::from_bytes(bytes.get(..length).filter(|bytes| !bytes.is_empty())?).unwrap();
            let Decoded::Message(message) = self.decoder.decode(Micros(0), "vcan0", &frame) else { continue };
            if let Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } = &message {
                assert_eq!(heartbeat.sent, self.packets, "what it counts as sent has come");
            }
            self.packets += 1;
            return Some(message);
        }
    }
}

#[test]
fn what_a_cell_counts_as_sent_was_taken_by_its_bus_however_often_it_is_hung_up_on() {
    let place = TestDir::new();
    place.write("skin.toml", &skin_of(CELLS, 1, Wire::Fd));
    let mut server = PlayedServer::at(&place);
    let words = "--bus vcan0 --bus-kind embedded --node 5 --skin skin.toml --reconnect";
    let cell = place.start("cell-node", words);
    let request = Request::Read { number: Parameter::Reply.number() };
    let request = Message::Configure { to: Node::Everyone, tag: 1, request }.encode();
    for _ in 0..4 {
        // The connection that wakes the cell, and the one for deferred frames.
        let [bus, deferred] = [(); 2].map(|()| server.admits());
        let mut heartbeats = 0;
        while heartbeats < 3 {
            let message = server.receives(&bus).unwrap();
            heartbeats +=
                u32::from(matches!(message, Message::Network { page: NetworkPage::Heartbeat(_), .. }));
        }
        // From here on the cell cannot send; it notices that when it answers.
        rustix::net::shutdown(&bus, Shutdown::Read).unwrap();
        while server.receives(&bus).is_some() {}
        for frame in request.frames(Format::Fd) {
            // Its heartbeat may have come first, and then the connection is gone already.
            let _ = rustix::net::send(&bus, &frame.to_bytes()[..frame.byte_len()], SendFlags::NOSIGNAL);
        }
        drop((bus, deferred));
    }
    drop(cell);
}
