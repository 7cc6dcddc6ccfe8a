//! Benches of real processes whose cells answer with sums along their tree: whole, broken and mended.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

mod process;

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use gateway::generate::{Reply, Wanted, generate};
use process::log::Log;
use process::{Ended, Guest, PATIENCE, PRESSED, Place, Running, is_stopped, until};
use protocol::bus::Inbox;
use protocol::can::Format;
use protocol::id::{Kind, Node};
use protocol::message::{Message, NetworkPage};
use protocol::packet::Packet;
use rustix::process::Signal;

/// Cells, in rows of four; those at two opposite corners are roots.
const CELLS: u8 = 12;
const ROOTS: [u8; 2] = [1, 12];

/// Where the ports of a cell of the grid lead: left, right, up, down.
fn neighbors(cell: u8) -> [u8; 4] {
    let (row, column) = ((cell - 1) / 4, (cell - 1) % 4);
    [
        if column > 0 { cell - 1 } else { 0 },
        if column < 3 { cell + 1 } else { 0 },
        if row > 0 { cell - 4 } else { 0 },
        if row < 2 { cell + 4 } else { 0 },
    ]
}

/// `skin.toml`: a grid, with joints so seldom that a machine that does something else too keeps up.
fn grid(place: &Place) {
    wired(place, neighbors);
}

fn wired(place: &Place, neighbors: impl Fn(u8) -> [u8; 4]) {
    let text = generate(&Wanted { cells: CELLS.into(), reply: Reply::Sum, ..Wanted::default() }).unwrap();
    let mut node = 0;
    let mut lines = Vec::new();
    for line in text.lines() {
        let value = line.split_once(" = ").map(|(_, value)| value);
        match line.split(' ').next() {
            Some("node") => node = value.unwrap().parse().unwrap(),
            Some("root") => continue,
            Some("joint_broadcast_hz") => {
                lines.push("joint_broadcast_hz = 20.0".to_owned());
                continue;
            }
            Some("slot_us") => {
                lines.push("slot_us = 6000".to_owned());
                continue;
            }
            Some("neighbors") => {
                lines.push(format!("neighbors = {:?}", neighbors(node)));
                lines.push(format!("root = {}", ROOTS.contains(&node)));
                continue;
            }
            _ => {}
        }
        lines.push(line.to_owned());
    }
    place.write("skin.toml", &(lines.join("\n") + "\n"));
}

/// A bench that records nothing.
fn unrecorded(place: &Place, seconds: f64, more: &str) -> Running {
    let words = format!(
        "run skin.toml --bus-kind {} --scenario scenario.toml --duration {seconds} --summary run.json {more}",
        place.kind()
    );
    place.start("gateway", &words)
}

/// Waits until the roots' sums of three epochs in a row hold so many cells.
fn holds(guest: &Guest, wanted: u32) {
    let (mut epoch, mut counts, mut row) = (None, BTreeMap::<u8, u8>::new(), 0);
    // A root that found another way is in another one's sum.
    let mut below = BTreeSet::new();
    guest.sends(&Message::Report);
    let mut seen = Vec::new();
    let give_up = Instant::now() + PATIENCE;
    let mut inbox = Inbox::new();
    while Instant::now() < give_up {
        guest.0.wait(Some(Duration::from_millis(100))).unwrap();
        guest.0.receive(&mut inbox).unwrap();
        let packets = inbox.frames().filter_map(|received| Packet::from_fd(&received.frame).ok());
        for message in packets.filter_map(|packet| Message::decode(&packet).ok()) {
            match message {
                Message::Joints { epoch: of, .. } => {
                    let roots = counts.iter().filter(|(root, _)| !below.contains(*root));
                    let count: u32 = roots.map(|(_, &count)| u32::from(count)).sum();
                    seen.push(count);
                    row = if epoch.is_some() && count == wanted { row + 1 } else { 0 };
                    if row == 3 {
                        return;
                    }
                    (epoch, counts) = (Some(of), BTreeMap::new());
                }
                Message::Sum { from, epoch: of, count, .. }
                    if ROOTS.contains(&from.get()) && epoch == Some(of) =>
                {
                    let most = counts.entry(from.get()).or_default();
                    *most = count.max(*most);
                }
                Message::Network { from: Node::Cell(cell), page: NetworkPage::Tree(tree), .. } => {
                    if tree.parent == Some(0) {
                        below.remove(&cell.get())
                    } else {
                        below.insert(cell.get())
                    };
                }
                Message::Halt
                | Message::Sync
                | Message::Resume
                | Message::Report
                | Message::Sum { .. }
                | Message::Torque { .. }
                | Message::Sensors { .. }
                | Message::Network { .. }
                | Message::Configure { .. }
                | Message::Configured { .. }
                | Message::Stimulus { .. } => {}
            }
        }
    }
    panic!("waited {PATIENCE:?} for sums of {wanted} cells; they were of {seen:?}");
}

/// Waits until, by what cells say, each of these has a way to a root that leads over these only.
fn have_ways(guest: &Guest, cells: &BTreeSet<u8>) {
    let mut parents = BTreeMap::new();
    let leads = |parents: &BTreeMap<u8, Option<u8>>, cell: u8| {
        let up = |cell: &u8| parents.get(cell).copied().flatten();
        let mut way = std::iter::successors(Some(cell), up).take(usize::from(CELLS) + 1);
        way.find(|cell| !cells.contains(cell)) == Some(0)
    };
    guest.sends(&Message::Report);
    let give_up = Instant::now() + PATIENCE;
    let mut inbox = Inbox::new();
    while !cells.iter().all(|&cell| leads(&parents, cell)) {
        assert!(Instant::now() < give_up, "waited {PATIENCE:?} for ways of {cells:?}: {parents:?}");
        guest.0.wait(Some(Duration::from_millis(100))).unwrap();
        guest.0.receive(&mut inbox).unwrap();
        let packets = inbox.frames().filter_map(|received| Packet::from_fd(&received.frame).ok());
        for message in packets.filter_map(|packet| Message::decode(&packet).ok()) {
            if let Message::Network { from: Node::Cell(cell), page: NetworkPage::Tree(tree), .. } = message {
                parents.insert(cell.get(), tree.parent);
            }
        }
    }
}

/// Ends a bench, and sees that all is accounted for.
fn end(place: &Place, bench: Running) -> Ended {
    bench.signal(Signal::TERM);
    let ended = bench.end().well();
    place.is_left_clean();
    place.summary().adds_up();
    ended
}

#[test]
fn the_gateway_hears_its_roots_and_nobody_else_and_every_cell_is_in_their_sums() {
    let place = Place::new();
    grid(&place);
    place.scenario(PRESSED);
    let bench = unrecorded(&place, 60.0, "");
    bench.hears_the_loop();
    holds(&place.guest(), CELLS.into());
    let said = bench.stderr();
    end(&place, bench);
    assert!(said.contains("the cells of vcan0 are a tree, "), "{said}");
    let summary = place.summary();
    let sums = |key: &str| summary.of_bus(&format!("/sums/{key}"));
    let broadcasts = summary.number("/loop/broadcasts");
    assert_eq!((sums("roots"), sums("overheard")), (2, 0), "{:#}", summary.0);
    // Each root once an epoch, and what it says again is counted.
    assert!(sums("first") > 0 && sums("first") <= 2 * broadcasts, "{:#}", summary.0);
    assert_eq!(summary.count("/buses/0/received", "sum"), sums("received"));
    assert!(summary.of_bus("/uplink/unheard") > 0, "ten cells spoke to others: {:#}", summary.0);
    assert_eq!(summary.of_bus("/sums/contributions/unasked"), 0);
    assert!(summary.of_bus("/epochs_complete") > 0, "{:#}", summary.0);
    assert_eq!(summary.count("/buses/0/events", "foreign"), 0, "wires are nobody's: {:#}", summary.0);
    assert!((2..=11).contains(&summary.of_bus("/network/deepest")), "{:#}", summary.0);
    assert!(summary.figure("/buses/0/network/organised_s") >= 0.0);
    assert_eq!(summary.0["buses"][0]["network"]["differences"].as_array().unwrap().len(), 0);
    // Half a step of each cell, and what is carried.
    let errors = ["mean", "max"].map(|which| summary.figure(&format!("/accuracy/sums/{which}_nm")));
    assert!(errors[0] <= 0.0065 && errors[1] <= 12.0 / 256.0, "{:#}", summary.0);
    assert_eq!(summary.number("/accuracy/single/count"), 0);
}

#[test]
fn a_recording_holds_every_sum_and_no_wire() {
    let place = Place::new();
    grid(&place);
    place.scenario(PRESSED);
    let bench = place.running_bench(60.0, "");
    holds(&place.guest(), CELLS.into());
    end(&place, bench);
    let summary = place.summary();
    let log = Log::read(&place.read("run.log"), Format::Fd);
    assert!(log.frames.iter().all(|frame| !frame.is_extended()), "a wire's frame is in the log");
    let sums = log.messages.iter().filter(|(_, packet)| packet.id.kind == Kind::Sum);
    let senders: BTreeMap<u8, usize> = sums.fold(BTreeMap::new(), |mut senders, (_, packet)| {
        *senders.entry(packet.id.node).or_default() += 1;
        senders
    });
    assert_eq!(senders.len(), usize::from(CELLS), "{senders:?}");
    let of_roots: usize = ROOTS.iter().map(|root| senders[root]).sum();
    let all: usize = senders.values().sum();
    let counted = |key: &str| usize::try_from(summary.of_bus(&format!("/sums/{key}"))).unwrap();
    assert_eq!(counted("overheard"), all - of_roots, "{:#}", summary.0);
    assert_eq!(counted("first") + counted("resent") + counted("stale"), of_roots, "{:#}", summary.0);
    assert_eq!(summary.of_bus("/uplink/unheard"), 0, "{:#}", summary.0);
}

#[test]
fn sums_go_round_a_cell_that_is_killed_or_hangs_and_who_comes_back_is_in_them_again() {
    let place = Place::new();
    grid(&place);
    place.scenario(PRESSED);
    let bench = unrecorded(&place, 120.0, "");
    bench.hears_the_loop();
    let guest = place.guest();
    holds(&guest, 12);

    process::signal(bench.cell(6), Signal::KILL);
    holds(&guest, 11);
    bench.tells(6, "fallen silent");

    let stopped = bench.cell(7);
    process::signal(stopped, Signal::STOP);
    until("a stopped cell", || is_stopped(stopped).then_some(()));
    holds(&guest, 10);
    process::signal(stopped, Signal::CONT);
    holds(&guest, 11);

    // It is told again when to speak, and what it feels.
    let words = format!("--bus vcan0 --bus-kind {} --node 6 --skin skin.toml", place.kind());
    let again = place.start("cell-node", &words);
    bench.hears("cell 6 on vcan0 started anew");
    holds(&guest, 12);
    bench.signal(Signal::TERM);
    bench.end().well();
    drop(again);
    let summary = place.summary();
    summary.adds_up();
    assert!(summary.of_bus("/network/parent_changes") >= 12, "{:#}", summary.0);
    assert!(summary.of_bus("/sums/contributions/missing") > 0, "{:#}", summary.0);
}

#[test]
fn without_a_touch_hellos_tell_who_is_gone_and_the_rest_finds_another_way() {
    let place = Place::new();
    grid(&place);
    place.scenario(PRESSED.split("[[touch]]").next().unwrap());
    let bench = unrecorded(&place, 120.0, "");
    bench.hears_the_loop();
    let guest = place.guest();
    let mut cells: BTreeSet<u8> = (1..=CELLS).collect();
    have_ways(&guest, &cells);
    process::signal(bench.cell(6), Signal::KILL);
    cells.remove(&6);
    have_ways(&guest, &cells);
    let stopped = bench.cell(7);
    process::signal(stopped, Signal::STOP);
    cells.remove(&7);
    have_ways(&guest, &cells);
    process::signal(stopped, Signal::CONT);
    cells.insert(7);
    have_ways(&guest, &cells);
    end(&place, bench);
}

/// Wires are cut while the loop runs: one of many in one direction, and all of the cell in a corner.
const CUTS: &str = r#"
[[fault]]
at_s = 2.0
kind = "cut"
cells = [6, 5]
one_way = true

[[fault]]
at_s = 5.0
kind = "cut"
cells = [3, 4]
for_s = 8.0

[[fault]]
at_s = 5.0
kind = "cut"
cells = [8, 4]
for_s = 8.0
"#;

#[test]
fn who_has_no_way_any_more_is_named_and_the_rest_finds_another() {
    let place = Place::new();
    grid(&place);
    place.scenario(&format!("{PRESSED}{CUTS}"));
    let bench = unrecorded(&place, 120.0, "");
    bench.hears_the_loop();
    let guest = place.guest();
    bench.hears("scenario: Cut the wires one way, from cell 6 and cell 5 on vcan0");
    holds(&guest, 12);
    bench.hears("cell 4 on vcan0 has no way to a root: no sum holds it since");
    holds(&guest, 11);
    bench.hears("scenario: Mend the wires between cell 8 and cell 4 on vcan0");
    bench.hears("cell 4 on vcan0 has a way to a root again, after");
    holds(&guest, 12);
    end(&place, bench);
    let summary = place.summary();
    assert!(summary.figure("/buses/0/network/longest_without_way_s") > 1.0, "{:#}", summary.0);
    assert_eq!(summary.0["buses"][0]["network"]["without_way"].as_array().unwrap().len(), 0);
}

#[test]
fn cells_that_are_wired_otherwise_than_described_are_named() {
    let place = Place::new();
    // What leads from 6 to 10 leads to 11, and what leads from 7 to 11 leads to 10; 8 and 12 are not wired.
    wired(&place, |cell| {
        let [left, right, up, down] = neighbors(cell);
        match cell {
            6 => [left, right, up, 11],
            7 => [left, right, up, 10],
            8 => [left, right, up, 0],
            10 => [left, right, 7, down],
            11 => [left, right, 6, down],
            12 => [left, right, 0, down],
            _ => [left, right, up, down],
        }
    });
    std::fs::rename(place.path("skin.toml"), place.path("wired.toml")).unwrap();
    grid(&place);
    place.scenario(PRESSED);
    let server = place.start("vcan-setup", "serve vcan0");
    server.prints("serving vcan0 at ");
    let words = format!("--bus vcan0 --bus-kind {} --nodes 1-12 --skin wired.toml", place.kind());
    let cells = place.start("cell-node", &words);
    let bench = unrecorded(&place, 60.0, "--no-spawn");
    bench.hears_the_loop();
    holds(&place.guest(), 12);
    bench.signal(Signal::TERM);
    bench.end().well();
    drop((cells, server));
    let summary = place.summary();
    let differences = summary.0["buses"][0]["network"]["differences"].as_array().unwrap();
    let lines: Vec<_> = differences.iter().map(|line| line.as_str().unwrap()).collect();
    assert_eq!(
        lines,
        [
            "port 3 of cell 6 leads to port 2 of cell 11 and should lead to port 2 of cell 10: plug it there, or \
             change the description",
            "port 3 of cell 7 leads to port 2 of cell 10 and should lead to port 2 of cell 11: plug it there, or \
             change the description",
            "the wire from port 3 of cell 8 to port 2 of cell 12 does not work: look at its plugs",
        ]
    );
}
