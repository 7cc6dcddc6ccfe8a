//! Cells as processes in a network: node ids and sums over simulated wires, and a bus that is lost and comes back.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::wildcard_enum_match_arm,
    reason = "a test may stop"
)]

use skinbus_tests::process;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::time::{Duration, Instant};

use cell_node::flash;
use cell_node::identity::Identity;
use model::decode::Decoded;
use model::generate::{Format as Target, ReplyMode, generate};
use model::network::Uplinks;
use process::test_client::TestClient;
use process::{Running, TIMEOUT, TestDir, names, until};
use protocol::bus::Inbox;
use protocol::can::Frame;
use protocol::fixed::Q5_10;
use protocol::id::{CellId, Node};
use protocol::message::{
    Heartbeat, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, State, StimulusStart, TreePage,
};
use protocol::packet::Epoch;
use protocol::parameters::{Parameter, ReplyKind as Answers, SumSchedule};
use protocol::port::LinkId;
use protocol::skin::{BusWires, Skin};
use protocol::time::Micros;
use rustix::process::Signal;

/// The number of cells in most skins.
const CELLS: u8 = 12;
/// The hash that a cell without a configuration reports.
const UNCONFIGURED: u16 = 0;

/// Writes a skin of cells that answer with sums.
fn sums(place: &TestDir, cells: u8, format: Target) -> Skin {
    let cells = usize::from(cells);
    let expected =
        model::generate::SkinRequest { cells, reply: ReplyMode::Sum, format, ..Default::default() };
    place.write("skin.toml", &generate(&expected).unwrap());
    Skin::read(&place.path("skin.toml")).unwrap()
}

fn server(place: &TestDir) -> Running {
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    server
}

fn cells(place: &TestDir, which: &str, more: &str) -> Running {
    let words = format!("--bus vcan0 --bus-kind {} {which} --skin skin.toml {more}", place.kind());
    place.start("cell-node", &words)
}

/// The gateway's side of the bus: the other end of the roots' wires, and a receiver.
struct Side {
    test_client: TestClient,
    cells: usize,
    roots: Vec<(CellId, LinkId)>,
    uplinks: Uplinks,
    start: Instant,
    heartbeats: BTreeMap<u8, Heartbeat>,
    trees: BTreeMap<u8, TreePage>,
    /// The last sum's count, by epoch and sender.
    sums: BTreeMap<(u8, u8), u8>,
}

impl Side {
    fn new(place: &TestDir, skin: &Skin) -> Self {
        let wires: BusWires = skin.wires(0);
        let roots: Vec<_> = wires.roots_with_link_ids().collect();
        Self {
            test_client: TestClient::on(place, "vcan0", skin.buses[0].format),
            cells: skin.cells.len(),
            uplinks: Uplinks::new(roots.len(), 0, Micros(0)),
            roots,
            start: Instant::now(),
            heartbeats: BTreeMap::new(),
            trees: BTreeMap::new(),
            sums: BTreeMap::new(),
        }
    }

    fn now(&self) -> Micros {
        Micros(u64::try_from(self.start.elapsed().as_micros()).unwrap())
    }

    /// Runs until the condition holds.
    fn until(&mut self, what: &str, expected: impl Fn(&Self) -> bool) {
        let give_up = Instant::now() + TIMEOUT;
        while !expected(self) {
            assert!(
                Instant::now() < give_up,
                "{what}: {:?} {:?} {:?}",
                self.heartbeats,
                self.trees,
                self.sums
            );
            self.turn(Duration::from_millis(10));
        }
    }

    /// Receives and answers messages for this time.
    fn turn(&mut self, time: Duration) {
        let end = Instant::now() + time;
        let mut inbox = Inbox::new();
        loop {
            self.uplinks.handle_time(self.now());
            while let Some((root, message)) = self.uplinks.poll_transmit() {
                self.test_client.bus.send(&[self.roots[root].1.encode_frame(message)]).unwrap();
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            self.test_client.bus.wait(Some(left.min(Duration::from_millis(1)))).unwrap();
            self.test_client.bus.receive(&mut inbox).unwrap();
            for received in inbox.frames() {
                self.take(&received.frame);
            }
        }
    }

    fn take(&mut self, frame: &Frame) {
        let now = self.now();
        if let Some(link) = LinkId::from_raw_id(frame.raw_id()) {
            let root = self.roots.iter().position(|(_, ours)| ours.reversed() == link);
            if let (Some(root), Some(message)) = (root, link.decode_frame(frame)) {
                self.uplinks.handle_message(now, root, message);
            }
            return;
        }
        let message = match self.test_client.decodes(now, frame) {
            Decoded::Message(message) => message,
            Decoded::Segment { .. } => return,
            other => panic!("{other:?}"),
        };
        match message {
            Message::Network { from: Node::Cell(cell), page: NetworkPage::Heartbeat(heartbeat), .. } => {
                self.uplinks.mark_node_id_used(cell);
                self.heartbeats.insert(cell.get(), heartbeat);
            }
            Message::Network { from: Node::Cell(cell), page: NetworkPage::Tree(tree), .. } => {
                self.trees.insert(cell.get(), tree);
            }
            Message::Sum { from, epoch, count, .. } => {
                self.sums.insert((epoch.0, from.get()), count);
            }
            _ => {}
        }
    }

    /// Returns true if every cell has a unique node id and a parent.
    fn is_tree_ready(&self) -> bool {
        let settled = |heartbeat: &&Heartbeat| !heartbeat.state.has(State::CLAIMING_NODE_ID);
        self.heartbeats.values().filter(settled).count() == self.cells
            && self.trees.len() == self.cells
            && self.trees.values().all(|tree| tree.parent.is_some())
    }

    /// Returns the node ids, by serial number.
    fn numbers(&self) -> BTreeMap<u32, u8> {
        self.heartbeats.iter().map(|(&number, heartbeat)| (heartbeat.serial, number)).collect()
    }
}

// ID-2, ID-3, NODE-1, NODE-2, NODE-3
#[test]
fn new_cells_get_node_ids_over_their_wires_and_keep_them() {
    for format in [Target::Fd, Target::Classic] {
        let place = TestDir::new();
        let skin = sums(&place, CELLS, format);
        fs::create_dir(place.path("flash")).unwrap();
        let server = server(&place);
        let start = || {
            // Some share a process, and most of their neighbours are in another one.
            let shared = ["--nodes 1-5", "--nodes 6-9"].into_iter().map(str::to_owned);
            let alone = (10..=CELLS).map(|node| format!("--node {node}"));
            shared
                .chain(alone)
                .map(|which| cells(&place, &which, "--fresh --flash flash"))
                .collect::<Vec<_>>()
        };
        let running = start();
        let mut side = Side::new(&place, &skin);
        side.until("a tree of cells with node ids", Side::is_tree_ready);
        let numbers = side.numbers();
        let serials: BTreeSet<_> = skin.cells.iter().map(|cell| cell.serial).collect();
        assert_eq!(numbers.keys().copied().collect::<BTreeSet<_>>(), serials);
        assert_eq!(numbers.values().copied().collect::<BTreeSet<_>>(), (1..=CELLS).collect());
        assert!(side.heartbeats.values().all(|heartbeat| heartbeat.configuration == UNCONFIGURED));
        drop(running);

        let expected: Vec<_> = serials.iter().map(|serial| format!("vcan0-s{serial}.flash")).collect();
        assert_eq!(names(&place.path("flash")), expected);
        for (&serial, &number) in &numbers {
            let bytes = fs::read(place.path(&format!("flash/vcan0-s{serial}.flash"))).unwrap();
            let kept = flash::decode(Identity { cell: None, serial }, &bytes).unwrap();
            assert_eq!((kept.number.map(CellId::get), kept.parameters), (Some(number), None));
        }
        // This time no node ids are assigned; the cells have theirs from the start.
        let running = start();
        let mut side = Side::new(&place, &skin);
        side.roots.clear();
        side.uplinks = Uplinks::new(0, 0, Micros(0));
        side.until("all numbers", |side| side.heartbeats.len() == usize::from(CELLS));
        assert_eq!(side.numbers(), numbers);
        drop(running);
        drop(server);
    }
}

#[test]
fn sums_reach_the_roots_whichever_cells_share_a_process() {
    for (format, count, shared) in [
        (Target::Fd, 12, vec!["--nodes 1-12"]),
        (Target::Classic, 12, vec!["--nodes 1-12"]),
        (Target::Fd, 12, vec!["--nodes 1-4", "--node 5", "--nodes 6-12"]),
        (Target::Classic, 12, vec!["--nodes 1-7", "--nodes 8-12"]),
        // More identifiers and wires than a socket can have filters.
        (Target::Fd, 100, vec!["--nodes 1-99", "--node 100"]),
    ] {
        let place = TestDir::new();
        let skin = sums(&place, count, format);
        let server = server(&place);
        let running: Vec<_> = shared.iter().map(|which| cells(&place, which, "")).collect();
        let mut side = Side::new(&place, &skin);
        side.until("a tree", Side::is_tree_ready);
        assert!(side.numbers().iter().all(|(&serial, &number)| {
            skin.cells.iter().any(|cell| cell.serial == serial && cell.node.get() == number)
        }));

        let deepest = side.trees.values().map(|tree| tree.depth).max().unwrap();
        let slot_us = u16::try_from(12_000 / (u32::from(deepest) + 1)).unwrap();
        let reply = Answers::Sum(SumSchedule { slot_us, deepest, carry: true });
        let request = Request::Write { number: Parameter::Reply.number(), words: reply.words() };
        side.test_client.send(&Message::Configure { to: Node::Everyone, tag: 1, request });
        let touch = SkinSensors { contact: [Q5_10::nearest(1.0); 3], ..SkinSensors::default() };
        side.test_client.send(&Message::Stimulus {
            to: Node::Everyone,
            from: StimulusStart::Next,
            page: SensorPage::Skin(touch),
        });
        // A parent receives a child's sums from the epoch on that the child has announced.
        let (root, _) = side.roots[0];
        let give_up = Instant::now() + TIMEOUT;
        let mut epoch = 0_u8;
        loop {
            epoch = epoch.wrapping_add(1);
            side.test_client.send(&Message::Joints {
                epoch: Epoch(epoch),
                joints: Joints { in_use: 6, ..Joints::default() },
            });
            side.turn(Duration::from_millis(16));
            if side.sums.get(&(epoch, root.get())) == Some(&count) {
                break;
            }
            assert!(Instant::now() < give_up, "{shared:?} {:?} {:?}", side.sums, side.trees);
        }
        drop((running, server));
    }
}

#[test]
fn a_bus_that_comes_back_finds_its_cells_as_they_were() {
    let place = TestDir::new();
    let skin = sums(&place, CELLS, Target::Fd);
    let away = "no embedded bus vcan0 is served in";
    let refused = cells(&place, "--node 1", "").end();
    assert!(refused.refusal(2).contains(away), "{refused:?}");
    // Cells wait for the bus at the start, too.
    let shared = cells(&place, "--nodes 1-11", "--reconnect");
    shared.wait_for_stderr(away);
    let first = server(&place);
    let last = cells(&place, "--node 12", "--reconnect");
    let mut side = Side::new(&place, &skin);
    side.until("a tree", Side::is_tree_ready);
    let without = cells(&place, "--node 1", "");
    let said = without.end();
    assert!(said.refusal(1).contains("cell 1 is already on vcan0"), "{said:?}");

    let before = heard(&mut side);
    first.signal(Signal::TERM);
    first.end().succeeded();
    let second = server(&place);
    let mut side = Side::new(&place, &skin);
    let after = heard(&mut side);
    for (cell, heartbeat) in &after {
        assert!(!heartbeat.state.has(State::CLAIMING_NODE_ID), "cell {cell} did not restart");
        assert!(heartbeat.sent.wrapping_sub(before[cell].sent) < 0x8000, "cell {cell} went on counting");
    }
    side.test_client.send(&Message::Report);
    side.until("a tree again", Side::is_tree_ready);
    until("no other message", || (shared.stderr().lines().count() == 1).then_some(()));
    assert_eq!(last.stderr(), "");

    // A cell without the option to wait ends with its bus.
    drop((shared, last));
    let leaves = cells(&place, "--node 3", "");
    let mut side = Side::new(&place, &skin);
    side.until("cell 3", |side| side.heartbeats.contains_key(&3));
    drop(side);
    second.signal(Signal::TERM);
    second.end().succeeded();
    assert_eq!(leaves.end().refusal(1), "cell-node: the embedded bus vcan0 was closed: its server ended");
}

/// Returns a heartbeat of each cell.
fn heard(side: &mut Side) -> BTreeMap<u8, Heartbeat> {
    side.heartbeats.clear();
    side.until("a heartbeat of each", |side| side.heartbeats.len() == usize::from(CELLS));
    side.heartbeats.clone()
}

#[test]
fn flash_of_another_node_id_is_not_used() {
    let place = TestDir::new();
    let skin = sums(&place, CELLS, Target::Fd);
    fs::create_dir(place.path("flash")).unwrap();
    let server = server(&place);
    let serial = skin.cells[1].serial;
    let kept = flash::FlashContent { number: CellId::new(7).ok(), parameters: None };
    fs::write(place.path("flash/vcan0-2.flash"), flash::encode(serial, &kept)).unwrap();
    let cell = cells(&place, "--node 2", "--flash flash");
    cell.wait_for_stderr(&format!(
        "flash of cell 2 (flash/vcan0-2.flash) is not used: the flash image belongs to cell 7 with serial \
         number {serial}"
    ));
    drop((cell, server));
}
