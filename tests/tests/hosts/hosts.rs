//! A bus over several hosts: two folders of embedded buses are two hosts, or two network namespaces with a cable.
//!
//! Ignored unless `tests/hosts` runs them: it builds `vcan-link` and gives them a network of their own.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::wildcard_enum_match_arm, reason = "a test looks for what it looks for")]

#[path = "proxy.rs"]
mod proxy;
#[path = "secured.rs"]
mod secured;

use skinbus_tests::process;

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use process::{Ended, PRESSED, Running, TIMEOUT, TestDir, program, skin, until};
use protocol::bus::{Bus, BusKind, BusOptions, Inbox, KindChoice};
use protocol::can::Frame;
use proxy::Proxy;
use rustix::process::Signal;
use serde_json::Value;

const CELLS: usize = 12;

/// Returns the program `vcan-setup`, whose command `link` runs the program that `SKINBUS_VCAN_LINK` names.
fn link_program() -> PathBuf {
    assert!(std::env::var_os("SKINBUS_VCAN_LINK").is_some(), "tests/hosts says where vcan-link is");
    program("vcan-setup")
}

/// Returns an unused port.
fn port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A host with an embedded bus `vcan0`, in a network namespace if it has one.
struct Host {
    place: TestDir,
    name: &'static str,
    namespace: Option<String>,
    _server: Running,
}

impl Host {
    fn new(name: &'static str, namespace: Option<String>) -> Self {
        let place = TestDir::new();
        place.write("skin.toml", &skin(CELLS));
        place.scenario(PRESSED);
        let server = place.start("vcan-setup", "serve vcan0");
        server.wait_for_stdout("serving vcan0 at ");
        Self { place, name, namespace, _server: server }
    }

    fn start(&self, program: &Path, words: &str) -> Running {
        let command = match &self.namespace {
            Some(namespace) => {
                let words = format!("netns exec {namespace} {} {words}", program.display());
                self.place.command_of(Path::new("ip"), &words)
            }
            None => self.place.command_of(program, words),
        };
        Running::start(command)
    }

    fn link(&self, how: &str) -> Running {
        let name = self.name;
        let link = self
            .start(&link_program(), &format!("link vcan0 --bus-kind embedded --host {name} --json {how}"));
        link.wait_for_stderr(&format!("is linked under the name '{name}'"));
        link
    }

    fn cells(&self) -> Running {
        let words = format!("--bus vcan0 --nodes 1-{CELLS} --skin skin.toml --bus-kind embedded --reconnect");
        self.start(&program("cell-node"), &words)
    }

    /// Starts a bench whose cells are on another host, and waits until its loop runs.
    fn bench(&self) -> Running {
        let words = "run skin.toml --bus-kind embedded --scenario scenario.toml --duration 600 --no-spawn --summary run.json";
        let bench = self.start(&program("skinbus"), words);
        bench.wait_for_loop();
        bench
    }
}

/// Two hosts with their links; the cells are on one of them, and a proxy may be between them.
struct Pair {
    robot: Host,
    cells: Host,
    proxy: Proxy,
    robot_link: Running,
    cells_link: Running,
    _cells: Running,
}

impl Pair {
    fn new() -> Self {
        let port = port();
        let (robot, cells, proxy) = (Host::new("robot", None), Host::new("cells", None), Proxy::before(port));
        let robot_link = robot.link(&format!("--listen tcp/127.0.0.1:{port}"));
        let cells_link = cells.link(&format!("--connect tcp/127.0.0.1:{}", proxy.port));
        robot_link.wait_for_stderr("host 'cells' has joined");
        cells_link.wait_for_stderr("host 'robot' has joined");
        let running = cells.cells();
        Self { robot, cells, proxy, robot_link, cells_link, _cells: running }
    }

    /// Runs a bench, calls `happens` after its loop has begun, and ends it when all cells answer after that.
    fn bench(&mut self, happens: impl FnOnce(&mut Self, &Running)) -> (Ended, Value) {
        let bench = self.robot.bench();
        happens(self, &bench);
        self.robot.place.test_client().waits_for_torques(1..=12);
        bench.signal(Signal::TERM);
        let ended = bench.end().succeeded();
        let summary = self.robot.place.summary();
        summary.adds_up();
        let bus = summary.0["buses"][0].clone();
        let answered = ["in_time", "late"].map(|how| bus["replies"][how].as_u64().unwrap());
        assert!(answered.iter().sum::<u64>() > 0, "{bus:#}");
        assert_eq!(bus["hosts"][0]["cells"], CELLS, "{bus:#}");
        assert_eq!(bus["hosts"][0]["at_end"], true, "{bus:#}");
        (ended, bus)
    }

    /// Ends the links, and checks that their counts of frames add up.
    fn end(self) {
        for (link, other) in [(self.robot_link, "cells"), (self.cells_link, "robot")] {
            let report = ended_link(link);
            let heard = &report["hosts"][other]["heard"];
            let of = |key: &str| heard[key].as_u64().unwrap();
            let missing = of("before") + of("dropped_there") + of("lost");
            assert_eq!(of("numbered"), missing + of("taken"), "{report:#}");
            assert_eq!(of("taken"), of("sent") + of("dropped_here") + of("refused"), "no copies: {report:#}");
            assert_eq!(report["returned"], 0, "{report:#}");
        }
    }
}

/// A client of a host's bus that is neither a cell nor a gateway.
struct Client(Bus);

impl Client {
    fn on(host: &Host) -> Self {
        let options = BusOptions { directory: Some(host.place.buses()), ..BusOptions::default() };
        Self(Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap())
    }

    /// Returns the received frames.
    fn received(&self) -> Vec<Frame> {
        let (mut inbox, mut all) = (Inbox::new(), Vec::new());
        while self.0.receive(&mut inbox).unwrap() > 0 {
            all.extend(inbox.frames().map(|received| received.frame));
        }
        all
    }
}

fn ended_link(link: Running) -> Value {
    link.signal(Signal::TERM);
    serde_json::from_str(&link.end().succeeded().stdout).unwrap()
}

#[test]
#[ignore = "tests/hosts runs it"]
fn cells_of_another_host_answer_as_if_they_were_here() {
    let mut pair = Pair::new();
    let (ended, bus) = pair.bench(|pair, _| {
        // `vcan-setup status` shows it too.
        let status = pair.robot.place.start("vcan-setup", "status vcan0").end().succeeded();
        let linked = "vcan0 is linked under the name 'robot' with 'cells' (12 cells)";
        assert!(status.stdout.contains(linked), "{status:#?}");
    });
    let of = |pointer: &str| bus.pointer(pointer).unwrap().as_u64().unwrap();
    assert_eq!((of("/hosts/0/gone"), of("/uplink/hosts")), (0, 0), "{bus:#}");
    assert!(ended.stderr.contains("host 'cells' of vcan0 is connected"), "{}", ended.stderr);
    assert!(ended.stdout.contains("host cells") && ended.stdout.contains("12 cells"), "{}", ended.stdout);
    pair.end();
}

#[test]
#[ignore = "tests/hosts runs it"]
fn a_connection_that_is_cut_is_made_again_and_each_missing_reply_explained() {
    let mut pair = Pair::new();
    let (_, bus) = pair.bench(|pair, bench| {
        bench.wait_for_stderr("host 'cells' of vcan0 is connected");
        pair.proxy.cut(true);
        bench.wait_for_stderr("host 'cells' of vcan0 is gone or unreachable");
        bench.wait_for_stderr("fallen silent");
        pair.proxy.cut(false);
        bench.wait_for_stderr("host 'cells' of vcan0 is reachable again");
        bench.wait_for_stderr("come back");
    });
    assert_eq!(bus["hosts"][0]["gone"], 1, "{bus:#}");
    pair.end();
}

#[test]
#[ignore = "tests/hosts runs it"]
fn a_connection_that_falls_silent_is_noticed_and_made_again() {
    let mut pair = Pair::new();
    let (_, bus) = pair.bench(|pair, bench| {
        bench.wait_for_stderr("host 'cells' of vcan0 is connected");
        pair.proxy.stall(true);
        bench.wait_for_stderr("host 'cells' of vcan0 is gone or unreachable");
        pair.proxy.stall(false);
        bench.wait_for_stderr("host 'cells' of vcan0 is reachable again");
    });
    assert_eq!(bus["hosts"][0]["gone"], 1, "{bus:#}");
    pair.end();
}

#[test]
#[ignore = "tests/hosts runs it"]
fn links_that_are_killed_are_joined_again() {
    let mut pair = Pair::new();
    let (ended, bus) = pair.bench(|pair, bench| {
        bench.wait_for_stderr("host 'cells' of vcan0 is connected");
        pair.cells_link.signal(Signal::KILL);
        bench.wait_for_stderr("host 'cells' of vcan0 is gone or unreachable");
        // A link that is back after 40 ms loses nothing visible.
        thread::sleep(Duration::from_secs(1));
        pair.cells_link = pair.cells.link(&format!("--connect tcp/127.0.0.1:{}", pair.proxy.port));
        bench.wait_for_stderr("host 'cells' of vcan0 is reachable again");
    });
    assert_eq!(bus["hosts"][0]["gone"], 1, "{bus:#}");
    assert!(ended.stderr.contains("come back") || bus["uplink"]["outage"] != 0, "{bus:#}\n{}", ended.stderr);
    pair.end();
}

#[test]
#[ignore = "tests/hosts runs it"]
fn the_link_of_the_gateways_host_may_be_killed() {
    let mut pair = Pair::new();
    let listen = format!("--listen tcp/127.0.0.1:{}", pair.proxy.to);
    let (_, bus) = pair.bench(|pair, bench| {
        bench.wait_for_stderr("host 'cells' of vcan0 is connected");
        pair.robot_link.signal(Signal::KILL);
        bench.wait_for_stderr("the link of vcan0 to other hosts has ended");
        pair.robot_link = pair.robot.link(&listen);
        bench.wait_for_stderr("host 'cells' of vcan0 is reachable again");
    });
    assert_eq!(bus["hosts"][0]["gone"], 1, "{bus:#}");
    pair.end();
}

#[test]
#[ignore = "tests/hosts runs it"]
fn a_connection_with_a_delay_of_20_ms_makes_replies_late_and_none_unexplained() {
    let mut pair = Pair::new();
    let (_, bus) = pair.bench(|pair, bench| {
        bench.wait_for_stderr("host 'cells' of vcan0 is connected");
        pair.proxy.delay(Duration::from_millis(20));
        pair.robot.place.test_client().waits_for_joints(100);
    });
    assert!(bus["replies"]["late"].as_u64().unwrap() > 0, "{bus:#}");
    assert_eq!(bus["uplink"]["hosts"], 0, "nothing is lost: {bus:#}");
    pair.end();
}

#[test]
#[ignore = "tests/hosts runs it"]
fn in_a_ring_of_three_hosts_no_frame_comes_twice() {
    let hosts = ["a", "b", "c"].map(|name| Host::new(name, None));
    let ports = [port(), port(), port()];
    let links: Vec<_> = (0..3)
        .map(|it| {
            hosts[it].link(&format!(
                "--listen tcp/127.0.0.1:{} --connect tcp/127.0.0.1:{}",
                ports[it],
                ports[(it + 1) % 3]
            ))
        })
        .collect();
    for (link, name) in links.iter().zip(["a", "b", "c"]) {
        for other in ["a", "b", "c"].iter().filter(|other| **other != name) {
            link.wait_for_stderr(&format!("host '{other}' has joined"));
        }
    }
    let clients: Vec<_> = hosts.iter().map(Client::on).collect();
    let count = 200_u32;
    for number in 0..count {
        for (from, client) in clients.iter().enumerate() {
            let id = 0x8000_0000 | (0x100 * u32::try_from(from).unwrap());
            client.0.send(&[Frame::fd(id, 0, &number.to_le_bytes()).unwrap()]).unwrap();
        }
        thread::sleep(Duration::from_millis(1));
    }
    let mut all = vec![Vec::new(); 3];
    let give_up = Instant::now() + TIMEOUT;
    while all.iter().any(|came| came.len() < 2 * count as usize) && Instant::now() < give_up {
        clients.iter().zip(&mut all).for_each(|(client, came)| came.extend(client.received()));
        thread::sleep(Duration::from_millis(5));
    }
    let reports: Vec<_> = links.into_iter().map(ended_link).collect();
    for (at, came) in all.iter().enumerate() {
        for from in (0..3_u32).filter(|&from| from as usize != at) {
            let of_it = came.iter().filter(|frame| frame.id() == 0x100 * from);
            let numbers: Vec<_> = of_it.map(|frame| frame.data().to_vec()).collect();
            let expected: Vec<_> = (0..count).map(|number| number.to_le_bytes().to_vec()).collect();
            assert_eq!(numbers, expected, "from {from} at {at}: each once, in order: {reports:#?}");
        }
    }
    for report in reports {
        assert_eq!(report["returned"], 0, "{report:#}");
        for (_, host) in report["hosts"].as_object().unwrap() {
            assert_eq!(
                (&host["heard"]["lost"], &host["heard"]["repeated"]),
                (&0.into(), &0.into()),
                "{report:#}"
            );
        }
    }
}

#[test]
#[ignore = "tests/hosts runs it"]
fn a_circle_that_something_else_makes_is_cut_and_said() {
    let port = port();
    let (one, two) = (Host::new("one", None), Host::new("two", None));
    let links = [
        one.link(&format!("--listen tcp/127.0.0.1:{port}")),
        two.link(&format!("--connect tcp/127.0.0.1:{port}")),
    ];
    links[0].wait_for_stderr("host 'two' has joined");
    links[1].wait_for_stderr("host 'one' has joined");
    // A relay beside the link forwards all frames of one bus to the other.
    let relay = [&one, &two].map(Client::on);
    let (watcher, source) = (Client::on(&one), Client::on(&one));
    source.0.send(&[Frame::fd(0x8000_0777, 0, &[1, 2, 3]).unwrap()]).unwrap();
    let pass_on = || {
        for (from, to) in [(0, 1), (1, 0)] {
            let frames = relay[from].received();
            relay[to].0.send(&frames).unwrap();
        }
    };
    until("the circle to be noticed", || {
        pass_on();
        links.iter().any(|link| link.stderr().contains("come back over this bus")).then_some(())
    });
    for _ in 0..50 {
        pass_on();
        thread::sleep(Duration::from_millis(10));
    }
    let times = watcher.received().iter().filter(|frame| frame.id() == 0x777).count();
    assert!((1..=4).contains(&times), "it does not go around for ever: {times}");
    let returned: u64 = links.map(|link| ended_link(link)["returned"].as_u64().unwrap()).into_iter().sum();
    assert!(returned > 0);
}

#[test]
#[ignore = "tests/hosts runs it"]
fn two_network_namespaces_and_a_cable_that_is_pulled() {
    let ip = |words: &str| {
        let done = Command::new("ip").args(words.split(' ')).output().unwrap();
        assert!(done.status.success(), "ip {words}: {done:?}");
    };
    for namespace in ["robot", "cells"] {
        ip(&format!("netns add {namespace}"));
        ip(&format!("-n {namespace} link set lo up"));
    }
    ip("link add cable netns robot type veth peer name cable netns cells");
    for (namespace, address) in [("robot", "10.99.0.1/24"), ("cells", "10.99.0.2/24")] {
        ip(&format!("-n {namespace} address add {address} dev cable"));
        ip(&format!("-n {namespace} link set cable up"));
    }
    let [robot, cells] = ["robot", "cells"].map(|name| Host::new(name, Some(name.to_owned())));
    let robot_link = robot.link("--listen tcp/10.99.0.1:7447");
    let cells_link = cells.link("--connect tcp/10.99.0.1:7447");
    robot_link.wait_for_stderr("host 'cells' has joined");
    let _cells = cells.cells();
    let bench = robot.bench();
    bench.wait_for_stderr("host 'cells' of vcan0 is connected");
    ip("-n robot link set cable down");
    bench.wait_for_stderr("host 'cells' of vcan0 is gone or unreachable");
    ip("-n robot link set cable up");
    bench.wait_for_stderr("host 'cells' of vcan0 is reachable again");
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    let summary = robot.place.summary();
    summary.adds_up();
    assert_eq!(summary.0["buses"][0]["hosts"][0]["gone"], 1, "{:#}", summary.0["buses"][0]);
    for link in [robot_link, cells_link] {
        ended_link(link);
    }
    drop((robot, cells));
    for namespace in ["robot", "cells"] {
        ip(&format!("netns del {namespace}"));
    }
}

#[test]
#[ignore = "tests/hosts runs it"]
fn wrong_use_is_one_line() {
    let host = Host::new("robot", None);
    let refused = |words: &str| {
        let ended = host.start(&link_program(), &format!("link vcan0 --bus-kind embedded {words}")).end();
        ended.refusal(2).to_owned()
    };
    assert!(refused("").contains("no endpoint: give the address of another host"));
    assert!(refused("--listen udp/127.0.0.1:1").contains("an endpoint is tcp/HOST:PORT or tls/HOST:PORT"));
    assert!(refused("--listen tcp/127.0.0.1:0 --host a/b").contains("it contains one of"));
    let _link = host.link("--listen tcp/127.0.0.1:0");
    assert!(refused("--listen tcp/127.0.0.1:0").contains("already linked by a process"));
}
