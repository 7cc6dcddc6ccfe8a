//! Tests of the table of a bus whose cells answer with sums.

use protocol::can::Format;
use protocol::fixed::{Q1_14, Q5_10};
use protocol::id::Node;
use protocol::message::{
    Joints, Message, NetworkPage, ReceivedCounts, SensorPage, State, StimulusStart, TreePage,
};
use protocol::packet::{self, Length, Words};
use protocol::time::Span;

use super::*;
use crate::tracker::DEAD_AFTER;

/// Returns a skin with four cells on one bus, of which 1 and 2 are roots.
fn skin() -> Skin {
    let head =
        crate::testing::ONE_CELL_SKIN_TOML.replace("reply = \"torque\"", "reply = \"sum\"\nslot_us = 1500");
    let (head, cell) = head.split_at(head.find("[[cell]]").unwrap());
    let cells = (1..=4).map(|node| {
        let root = if node <= 2 { "root = true\n" } else { "" };
        cell.replace("node = 1", &format!("node = {node}\n{root}neighbors = {}", NEIGHBORS[node - 1]))
    });
    Skin::parse("skin.toml", &format!("{head}{}", cells.collect::<String>())).unwrap()
}

/// Wiring: 1 - 3 - 4, and 2 alone.
const NEIGHBORS: [&str; 4] = ["[3, 0, 0, 0]", "[0, 0, 0, 0]", "[1, 4, 0, 0]", "[3, 0, 0, 0]"];

struct Bench {
    table: BusTable,
    at: u64,
}

fn cell(node: i64) -> CellId {
    CellId::new(node).unwrap()
}

impl Bench {
    /// All cells are ready, some of them pressed with 1 N in each contact word.
    fn new(pressed: &[i64]) -> Self {
        let mut bench = Self { table: BusTable::new(&skin(), 0), at: 0 };
        bench.table.set_torque_comparison(true);
        for node in 1..=4 {
            bench.heartbeat(node, 0, State::default());
        }
        for node in (1..=4).filter(|_| !pressed.is_empty()) {
            // The cell has received no stimulus before.
            let page = NetworkPage::Received(ReceivedCounts::default());
            bench.say(false, Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(0), page });
        }
        for &node in pressed {
            bench.press(node, 1.0);
        }
        bench
    }

    fn say(&mut self, own: bool, message: Message) {
        self.at += 100;
        for frame in message.encode().frames(Format::Fd) {
            self.table.handle_frame(Micros(self.at), own, &frame, &mut |_| None);
        }
    }

    fn heartbeat(&mut self, node: i64, sent: u16, more: State) {
        let state = State::CONFIGURED.with_flags(State::TEST_MODE, true).with_flags(more, true);
        let configuration = self.table.cells().first().unwrap().configuration;
        let page = NetworkPage::Heartbeat(Heartbeat { serial: 1, configuration, sent, rejected: 0, state });
        self.say(false, Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(0), page });
    }

    fn press(&mut self, node: i64, newtons: f64) {
        let contact = [Q5_10::nearest(newtons); 3];
        let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
        self.say(true, Message::Stimulus { to: Node::Cell(cell(node)), from: StimulusStart::Next, page });
    }

    fn joints(&mut self, epoch: u8) -> BusTotals {
        let joints = Joints { in_use: 6, ..Joints::default() };
        self.say(true, Message::Joints { epoch: Epoch(epoch), joints });
        self.table.snapshot().sums
    }

    /// Sends a sum of `count` cells with this number of steps in its first word.
    fn sum(&mut self, node: i64, epoch: u8, count: u8, steps: i16) -> BusTotals {
        let torque = packet::padded_words([steps]).into();
        self.say(false, Message::Sum { from: cell(node), epoch: Epoch(epoch), torque, count });
        self.table.snapshot().sums
    }

    fn counts(&self) -> SumCounts {
        self.table.sum_counts().unwrap().0
    }

    fn contributions(&self) -> Contributions {
        self.table.sum_counts().unwrap().1
    }
}

/// Returns the first joint's torque in steps of Q7.8, and the number of cells in it.
fn first(sums: &BusTotals) -> (f64, u32) {
    (sums.torque[0] * 256.0, sums.contributing)
}

#[test]
fn the_torque_is_the_total_of_the_roots_and_the_sum_with_the_most_cells_counts() {
    let mut bench = Bench::new(&[1, 2, 3, 4]);
    bench.joints(7);
    assert_eq!(first(&bench.sum(1, 7, 1, 10)), (10.0, 1));
    assert_eq!(first(&bench.sum(2, 7, 1, 5)), (15.0, 2));
    assert_eq!(first(&bench.sum(1, 7, 3, 40)), (45.0, 4), "it came again with its children's");
    assert_eq!(first(&bench.sum(1, 7, 3, 99)), (45.0, 4), "one with no more cells");
    assert_eq!(first(&bench.sum(1, 7, 2, 99)), (45.0, 4), "one with fewer");
    assert_eq!(first(&bench.sum(3, 7, 2, 30)), (45.0, 4), "no root: it is in its parent's");
    assert_eq!(first(&bench.sum(1, 3, 3, 99)), (45.0, 4), "of an epoch that was not");
    assert_eq!(bench.counts(), SumCounts { received: 7, first: 2, resent: 3, overheard: 1, stale: 1 });
    bench.joints(8);
    let counters = bench.table.counters();
    assert_eq!((counters.epochs_due, counters.epochs_complete), (1, 1));
}

#[test]
fn contributions_in_time_late_and_missing_add_up_to_those_due() {
    let mut bench = Bench::new(&[1, 3, 4]);
    bench.joints(0);
    bench.sum(1, 0, 2, 20);
    bench.joints(1);
    bench.sum(1, 1, 3, 30);
    assert_eq!(first(&bench.sum(1, 0, 3, 99)), (30.0, 3), "the third is late, and the newer sum stays");
    bench.joints(2);
    bench.sum(1, 2, 1, 10);
    for epoch in 3..7 {
        bench.joints(epoch);
        bench.sum(1, epoch, 3, 30);
    }
    bench.table.finish();
    let contributions = bench.contributions();
    assert_eq!(
        contributions,
        Contributions { due: 21, in_time: 18, late: 1, missing: 2, unasked: 0, contact_unknown: 0 }
    );
    let counters = bench.table.counters();
    assert_eq!((counters.epochs_due, counters.epochs_complete), (7, 5));
    assert!(
        bench.table.cells().iter().all(|cell| cell.replies == Replies::default()),
        "no single torque is due"
    );
}

#[test]
fn a_roots_sum_is_held_and_decays_as_a_torque_does_and_no_heartbeat_releases_it() {
    let mut bench = Bench::new(&[3, 4]);
    let SafetyLimits { hold_epochs, decay_epochs, .. } = skin().safety;
    bench.joints(0);
    bench.sum(1, 0, 2, 64);
    bench.sum(2, 0, 1, 100);
    bench.sum(2, 0, 0, 0);
    assert_eq!(first(&bench.table.snapshot().sums), (164.0, 3), "no cell is no more than one");
    bench.joints(1);
    assert_eq!(first(&bench.sum(2, 1, 0, 0)), (64.0, 2), "a sum of no cell ends the contacts");
    for epoch in 2..=1 + hold_epochs {
        // The root is not in contact itself; its children may be.
        bench.heartbeat(1, u16::try_from(epoch).unwrap(), State::default());
        let sums = bench.joints(u8::try_from(epoch).unwrap());
        assert_eq!((first(&sums), sums.age, sums.stale), ((64.0, 2), epoch - 1, 2));
    }
    for gone in 1..decay_epochs {
        let sums = bench.joints(u8::try_from(1 + hold_epochs + gone).unwrap());
        let left = 64.0 * f64::from(decay_epochs - gone) / f64::from(decay_epochs);
        assert!((first(&sums).0 - left).abs() < 1.0, "{sums:?} is not {left}");
        assert_eq!(sums.contributing, 2);
    }
    let sums = bench.joints(u8::try_from(1 + hold_epochs + decay_epochs).unwrap());
    assert_eq!((first(&sums), sums.age, sums.stale), ((0.0, 0), 0, 2), "nothing of it counts any more");
}

#[test]
fn a_restarted_root_keeps_its_childrens_torque() {
    let mut bench = Bench::new(&[1, 3, 4]);
    bench.joints(0);
    bench.sum(1, 0, 3, 64);
    bench.heartbeat(1, 0, State::CLAIMING_NODE_ID);
    assert_eq!(bench.table.drain_notices().collect::<Vec<_>>(), [Notice::Restarted(cell(1))]);
    assert_eq!(first(&bench.table.snapshot().sums), (64.0, 3));
    let all = skin().safety;
    let last =
        (1..=1 + all.hold_epochs + all.decay_epochs).map(|epoch| bench.joints(u8::try_from(epoch).unwrap()));
    assert_eq!(first(&last.last().unwrap()), (0.0, 0), "yet it decays");
    assert_eq!(first(&bench.sum(1, bench.table.newest_joints().unwrap().1.0, 1, 9)), (9.0, 1));
    // The sum of a silent root is released at once.
    bench.table.handle_time(Micros(bench.at) + DEAD_AFTER + Span(1));
    assert_eq!(first(&bench.table.snapshot().sums), (0.0, 0));
}

#[test]
fn cells_that_moved_to_another_root_do_not_count_twice() {
    let mut bench = Bench::new(&[1, 2, 3, 4]);
    bench.joints(0);
    bench.sum(1, 0, 3, 30);
    bench.sum(2, 0, 1, 10);
    bench.joints(1);
    // The first root is silent; its sum is held.
    assert_eq!(first(&bench.sum(2, 1, 1, 10)), (40.0, 4));
    bench.joints(2);
    assert_eq!(first(&bench.sum(2, 2, 3, 29)), (29.0, 3), "two of its cells have come to the other one");
    bench.joints(3);
    bench.sum(2, 3, 3, 29);
    assert_eq!(first(&bench.sum(1, 3, 1, 11)), (40.0, 4), "it sends again");
    bench.joints(4);
    assert_eq!(first(&bench.sum(2, 4, 4, 39)), (50.0, 5), "the first one may only be late");
}

#[test]
fn a_root_below_another_cell_is_in_that_ones_sum() {
    let mut bench = Bench::new(&[1, 2, 3, 4]);
    bench.joints(0);
    bench.sum(1, 0, 3, 30);
    assert_eq!(first(&bench.sum(2, 0, 1, 10)), (40.0, 4));
    bench.table.set_root_feeds_gateway(cell(2), false);
    assert_eq!(first(&bench.table.snapshot().sums), (30.0, 3), "it is about to come with the first one's");
    bench.joints(1);
    bench.sum(2, 1, 1, 10);
    assert_eq!(first(&bench.sum(1, 1, 4, 41)), (41.0, 4));
    assert_eq!((bench.counts().overheard, bench.counts().first), (1, 3));
    bench.table.set_root_feeds_gateway(cell(2), true);
    bench.joints(2);
    bench.sum(1, 2, 3, 31);
    assert_eq!(first(&bench.sum(2, 2, 1, 9)), (40.0, 4));
}

#[test]
fn a_root_that_found_a_parent_before_the_gateway_is_not_counted_twice() {
    for by_wire in [true, false] {
        let mut bench = Bench::new(&[1, 2, 3, 4]);
        let tree = |parent| {
            let page = NetworkPage::Tree(TreePage { parent: Some(parent), ..TreePage::default() });
            Message::Network { from: Node::Cell(cell(2)), epoch: Epoch(0), page }
        };
        if by_wire {
            bench.table.use_root_wires_not_tree_pages();
            bench.table.set_root_feeds_gateway(cell(1), true);
        }
        bench.say(false, tree(3));
        bench.joints(0);
        bench.sum(2, 0, 1, 10);
        assert_eq!(first(&bench.sum(1, 0, 4, 41)), (41.0, 4), "its sum is in that of root 1");
        assert_eq!(bench.counts().overheard, 1);
        bench.say(false, tree(0));
        if by_wire {
            bench.joints(1);
            bench.sum(1, 1, 3, 31);
            assert_eq!(first(&bench.sum(2, 1, 1, 10)), (31.0, 3), "its wire counts, and not its page");
            bench.table.set_root_feeds_gateway(cell(2), true);
        }
        bench.joints(2);
        bench.sum(1, 2, 3, 31);
        assert_eq!(first(&bench.sum(2, 2, 1, 10)), (41.0, 4));
        bench.table.finish();
        assert_eq!(bench.contributions().unasked, 0);
    }
}

#[test]
fn a_halt_releases_sums_and_no_cell_is_due() {
    let mut bench = Bench::new(&[1, 3, 4]);
    bench.joints(0);
    bench.sum(1, 0, 3, 64);
    bench.say(true, Message::Halt);
    assert_eq!(first(&bench.table.snapshot().sums), (0.0, 0));
    bench.joints(1);
    bench.joints(2);
    bench.table.finish();
    assert_eq!(bench.contributions().due, 3);
}

#[test]
fn the_error_of_whole_sums_is_taken_of_complete_epochs_only_and_averaged_over_32() {
    let mut bench = Bench::new(&[1, 3]);
    let skin = skin();
    let central = CentralComputation::new(&skin);
    let page = SkinSensors { contact: [Q5_10::nearest(1.0); 3], ..SkinSensors::default() };
    let frames = central.link_frames(&[Q1_14::ZERO; 6]);
    let one = central.cell_torque(0, &frames, central.cell_force(0, &page));
    // Errors alternate between half a step too high and too low, so that the average is smaller than each.
    let off = |up| {
        let word = |nm: f64| ((nm * 2.0 * 256.0) + if up { 0.6 } else { -0.4 }).floor() as i16;
        Words::new(Length::Six, one.map(word))
    };
    for epoch in 0..33 {
        bench.joints(epoch);
        let count = if epoch == 0 { 1 } else { 2 };
        bench.say(
            false,
            Message::Sum { from: cell(1), epoch: Epoch(epoch), torque: off(epoch % 2 == 0), count },
        );
    }
    bench.joints(33);
    let TorqueAccuracy { sums, sums_averaged, single, whole, .. } = bench.table.accuracy();
    assert_eq!((sums.count(), sums_averaged.count()), (32 * 3, 3), "joints 1 to 3 are loaded");
    assert!(sums.max() < 1.0 / 256.0 && sums_averaged.max() <= sums.max(), "{sums:?} {sums_averaged:?}");
    assert_eq!((single.count(), whole.count()), (0, 0));
}

#[test]
fn sums_that_may_contain_a_cell_of_unknown_contact_are_not_compared() {
    let of = |pressed: &[i64], unknown: bool| {
        let mut bench = Bench::new(pressed);
        if unknown {
            // Cell 4 returns from an outage: it may have received stimuli from other senders.
            bench.table.handle_unreachable_cells(|it| it == cell(4));
            bench.heartbeat(4, 0, State::default());
        }
        bench.joints(0);
        bench.sum(1, 0, 2, 10);
        bench.joints(1);
        bench.table.finish();
        let Contributions { due, in_time, unasked, contact_unknown, .. } = bench.contributions();
        (bench.table.accuracy().sums.count(), due, in_time, unasked, contact_unknown)
    };
    assert_eq!(of(&[1, 3], false), (3, 4, 2, 0, 0));
    assert_eq!(of(&[1, 3], true), (0, 4, 2, 0, 0), "it may be one of the two");
    assert_eq!(of(&[1], true), (0, 2, 1, 1, 1));
    assert_eq!(of(&[1], false), (0, 2, 1, 1, 0));
}

#[test]
fn packets_that_the_gateway_does_not_receive_are_counted_by_their_sender() {
    let mut bench = Bench::new(&[]);
    bench.table.receive_root_sums_only();
    let tree = |sent| NetworkPage::Tree(TreePage { sent, ..TreePage::default() });
    let page = |bench: &mut Bench, sent| {
        let from = Node::Cell(cell(3));
        bench.say(false, Message::Network { from, epoch: Epoch(0), page: tree(sent) });
    };
    page(&mut bench, 0);
    bench.joints(0);
    page(&mut bench, 5);
    // Two pages, five sums, and one lost packet.
    bench.heartbeat(3, 9, State::default());
    bench.table.finish();
    let uplink = bench.table.cells()[2].uplink();
    assert_eq!((uplink.sent, uplink.delivered, uplink.unheard, uplink.lost), (10, 4, 5, 1), "{uplink:?}");
    let total = bench.table.uplink();
    assert_eq!((total.unheard, total.lost), (5, 1));
}

#[test]
fn the_network_is_of_all_cells_that_are_described_or_heard() {
    let mut bench = Bench::new(&[]);
    let tree = TreePage { parent: Some(1), depth: 1, ..TreePage::default() };
    let page = NetworkPage::Tree(tree);
    bench.say(false, Message::Network { from: Node::Cell(cell(3)), epoch: Epoch(0), page });
    bench.heartbeat(9, 0, State::default());
    let seen = |bench: &Bench, at: Micros| {
        let of = |seen: ObservedCell| {
            (seen.node, seen.serial.is_some(), seen.heartbeat.is_some(), seen.alive, seen.tree)
        };
        bench.table.observed_cells(at).map(of).collect::<Vec<_>>()
    };
    let expected = |alive| {
        let described = |node| (cell(node), true, true, alive, Some(tree).filter(|_| node == 3));
        let mut all: Vec<_> = (1..=4).map(described).collect();
        all.push((cell(9), false, true, true, None));
        all
    };
    let now = Micros(bench.at);
    assert_eq!(seen(&bench, now), expected(true));
    assert_eq!(seen(&bench, now + DEAD_AFTER + Span(1)), expected(false));
}
