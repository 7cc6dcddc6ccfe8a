//! Cells wired at random become a tree with node ids, lose wires and neighbours, and never count a cell twice.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic, reason = "a test may stop")]
#![allow(clippy::print_stdout, reason = "the times until all cells are in again are of interest")]

use std::collections::{BTreeMap, BTreeSet};

use protocol::id::CellId;
use protocol::time::Span;
use skinbus_tests::network::{PERIOD, PortEnd, Wiring};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// The time limit for the tree; the cells are started in any order within a third of a second.
const TREE_READY: Span = Span::from_millis(2_000);

/// Starts all cells at random times, and waits for the tree.
fn wait_for_tree(wiring: &mut Wiring, dice: &mut Pcg64Mcg) {
    let mut starts: Vec<(u64, usize)> =
        (0..wiring.cells.len()).map(|cell| (dice.random_range(0..300), cell)).collect();
    starts.sort_unstable();
    for (at, cell) in starts {
        let until = Span::from_millis(at).0.saturating_sub(wiring.now().0);
        wiring.run(Span(until));
        wiring.start(cell);
    }
    wiring.run(TREE_READY);
}

/// Checks that the tree spans all reachable cells, node ids are dense and unique, and neighbours agree on their wires.
fn check_tree_ready(wiring: &Wiring, seed: u64) {
    let reachable = wiring.reachable();
    let mut node_ids = BTreeSet::new();
    for (place, cell) in wiring.cells.iter().enumerate() {
        let reached = reachable.contains(&place);
        assert_eq!(cell.node_id.is_some(), reached, "seed {seed}, cell {place}: {cell:?}");
        if let Some(node_id) = cell.node_id {
            assert!(node_ids.insert(node_id.get()), "seed {seed}: node id {node_id} twice");
            assert!(
                wiring.route(place).is_some(),
                "seed {seed}: cell {place} has no route: {}",
                wiring.routes()
            );
        }
    }
    let dense = (1..=u8::try_from(node_ids.len()).unwrap()).collect::<BTreeSet<_>>();
    assert_eq!(node_ids, dense, "seed {seed}: dense");
    for &place in &reachable {
        let ports = wiring.cells[place].ports.expect("a settled cell reports its ports").ports;
        for (port, state) in ports.iter().enumerate() {
            match wiring.cells[place].wires[port] {
                Some(PortEnd::Cell(other, at)) => {
                    assert!(state.works, "seed {seed}: cell {place} port {port}");
                    let there = wiring.cells[other].node_id.map_or(0, CellId::get);
                    assert_eq!((state.number, usize::from(state.port)), (there, at), "seed {seed}");
                }
                Some(PortEnd::Gateway(_)) | None => assert!(!state.receives, "seed {seed}"),
            }
        }
    }
}

fn deepest(wiring: &Wiring) -> u8 {
    let depths =
        wiring.reachable().into_iter().filter_map(|cell| wiring.route(cell)).map(|route| route.len() - 1);
    u8::try_from(depths.max().unwrap_or(0)).unwrap()
}

/// Presses all cells, so that every reachable cell is in every sum.
fn press_all(wiring: &mut Wiring) {
    wiring.switch(deepest(wiring), false);
    wiring.run(Span::from_millis(1));
    for cell in 0..wiring.cells.len() {
        wiring.press(cell, true);
    }
    wiring.begin();
    wiring.run(Span(4 * PERIOD.0));
}

/// Runs for some epochs after a fault, and returns the number of epochs up to the last incomplete one; `None` if the
/// last epoch is incomplete.
fn incomplete(wiring: &mut Wiring, epochs: u64) -> Option<usize> {
    let from = wiring.took.len();
    for _ in 0..epochs {
        wiring.run(PERIOD);
        // As the gateway does when the tree has become deeper than its slots.
        let depth = deepest(wiring);
        if depth > wiring.deepest {
            wiring.switch(depth, false);
        }
    }
    let expected = Wiring::bits(&wiring.reachable());
    let took: Vec<bool> = wiring.took[from.saturating_sub(1)..wiring.took.len() - 1]
        .iter()
        .map(|took| took.cells == expected)
        .collect();
    let last = took.iter().rposition(|complete| !complete);
    match last {
        None => Some(0),
        Some(last) if last + 1 < took.len() => Some(last + 1),
        Some(_) => None,
    }
}

/// Injects a random fault, or ends one.
fn inject_fault(wiring: &mut Wiring, dice: &mut Pcg64Mcg) -> String {
    let cell = dice.random_range(0..wiring.cells.len());
    let port = dice.random_range(0..4);
    match dice.random_range(0..6) {
        0 => {
            wiring.kill(cell);
            format!("kill {cell}")
        }
        1 => {
            wiring.hang(cell);
            format!("hang {cell}")
        }
        2 | 3 => {
            wiring.set_link_down(cell, port, true);
            format!("link_down {cell} port {port}")
        }
        4 => {
            wiring.set_link_down(cell, port, true);
            if let Some(PortEnd::Cell(other, at)) = wiring.cells[cell].wires[port] {
                wiring.set_link_down(other, at, true);
            }
            format!("link_down {cell} port {port} both ways")
        }
        _ => {
            for port in 0..4 {
                wiring.set_link_down(cell, port, false);
            }
            if wiring.runs(cell) { format!("link_up {cell}") } else { restart(wiring, cell) }
        }
    }
}

fn restart(wiring: &mut Wiring, cell: usize) -> String {
    wiring.go_on(cell);
    if !wiring.runs(cell) {
        wiring.start(cell);
    }
    wiring.run(Span::from_millis(700));
    wiring.send_links_down(cell);
    wiring.switch(deepest(wiring), false);
    wiring.press(cell, true);
    format!("restart {cell}")
}

/// Returns the number of wirings of each kind; `SKINBUS_WIRINGS=10000` runs more.
fn wirings() -> u64 {
    std::env::var("SKINBUS_WIRINGS").map_or(600, |wirings| wirings.parse().unwrap())
}

/// Waits for the tree, presses every cell, injects four faults, and prints the number of incomplete epochs after each.
fn campaign(seeds: impl Iterator<Item = u64>) {
    let mut repairs = BTreeMap::<(String, usize), usize>::new();
    for seed in seeds {
        let mut dice = Pcg64Mcg::seed_from_u64(seed);
        let mut wiring = Wiring::random(seed);
        wait_for_tree(&mut wiring, &mut dice);
        check_tree_ready(&wiring, seed);
        press_all(&mut wiring);
        assert_eq!(incomplete(&mut wiring, 3), Some(0), "seed {seed}: all are in, before any fault");
        for _ in 0..4 {
            let what = inject_fault(&mut wiring, &mut dice);
            let after = incomplete(&mut wiring, 40).unwrap_or_else(|| {
                let (took, reachable) = (wiring.took.iter().rev().nth(1), wiring.reachable());
                panic!(
                    "seed {seed}: not complete again after {what}: {took:?} of {reachable:?}; {}",
                    wiring.routes()
                )
            });
            let kind = what.split(' ').next().unwrap().to_owned();
            *repairs.entry((kind, after)).or_default() += 1;
        }
    }
    println!("epochs without some cell, after");
    for ((what, epochs), times) in &repairs {
        println!("  {what:10}{epochs:4}: {times}");
    }
    let broken = |(what, _): &&(String, usize)| ["link_down", "hang", "kill"].contains(&what.as_str());
    let of = |expected: &dyn Fn(usize) -> bool| {
        repairs
            .iter()
            .filter(|(key, _)| broken(key) && expected(key.1))
            .map(|(_, times)| times)
            .sum::<usize>()
    };
    // Slower cases lose their root, or find a route only through cells that were below them.
    assert!(
        of(&|epochs| epochs > 3) * 10 < of(&|epochs| epochs > 0) * 3,
        "most are complete again in 3 epochs"
    );
    assert_eq!(of(&|epochs| epochs > 12), 0, "all are, soon");
}

// This covers SUM-1, SUM-7, LEASE-1, LEASE-3, NACK-1, NACK-3, NACK-4, NACK-5, HELLO-2, HELLO-3, JOIN-1, JOIN-2, JOIN-3,
// JOIN-4, JOIN-5, LOSS-1, LOSS-2, LOSS-3, LOSS-4, REPAIR-1, REPAIR-2, REPAIR-3, REPAIR-4, LINK-1.
#[test]
fn random_wirings_become_trees_and_never_count_a_cell_twice() {
    campaign((0..wirings()).step_by(2));
}

#[test]
fn other_random_wirings_become_trees_and_never_count_a_cell_twice() {
    campaign((1..wirings()).step_by(2));
}

#[test]
fn lost_messages_on_wires_never_count_a_cell_twice() {
    for seed in 0..wirings() / 4 {
        let mut dice = Pcg64Mcg::seed_from_u64(seed);
        let mut wiring = Wiring::random(seed);
        wait_for_tree(&mut wiring, &mut dice);
        press_all(&mut wiring);
        // The cells in a sum are checked in every epoch, see `Wiring`.
        wiring.loss = 0.05;
        for _ in 0..4 {
            inject_fault(&mut wiring, &mut dice);
            wiring.run(Span(20 * PERIOD.0));
        }
        wiring.loss = 0.0;
        assert!(
            incomplete(&mut wiring, 80).is_some(),
            "seed {seed}: not complete again; {}",
            wiring.routes()
        );
    }
}

#[test]
fn without_a_touch_all_cells_have_a_route_again_within_a_second() {
    let mut slowest = 0;
    for seed in 0..wirings() / 2 {
        let mut dice = Pcg64Mcg::seed_from_u64(seed);
        let mut wiring = Wiring::random(seed);
        wait_for_tree(&mut wiring, &mut dice);
        wiring.switch(deepest(&wiring), false);
        wiring.begin();
        wiring.run(Span::from_millis(300));
        for _ in 0..4 {
            let what = inject_fault(&mut wiring, &mut dice);
            let repairs = what.starts_with("link_up") || what.starts_with("restart");
            let from = wiring.now();
            let whole = |wiring: &Wiring| {
                let mut reachable = wiring.reachable().into_iter();
                let goes = |cell| {
                    wiring.route(cell).is_some_and(|route| route.iter().all(|&cell| wiring.runs(cell)))
                };
                reachable.all(|cell| wiring.cells[cell].node_id.is_none() || goes(cell))
            };
            // A silent port times out after 600 ms.
            wiring.run(Span::from_millis(600));
            while !whole(&wiring) {
                let (took, routes) = (wiring.now().elapsed_since(from), wiring.routes());
                assert!(
                    took <= Span::from_millis(1_000) || repairs,
                    "seed {seed}, {what}: {took:?}, {routes}"
                );
                wiring.run(Span::from_millis(20));
            }
            slowest = slowest.max(wiring.now().elapsed_since(from).0);
            wiring.run(Span::from_millis(400));
        }
    }
    println!("the slowest has a route again after {} ms", slowest / 1_000);
}

#[test]
fn a_cell_that_waits_for_children_is_woken_by_them_and_without_joints_by_a_timeout() {
    let mut wiring = Wiring::new(3, 1);
    wiring.wire(0, 0, 1, 0);
    wiring.wire(1, 1, 2, 1);
    wiring.add_root(0);
    wait_for_tree(&mut wiring, &mut Pcg64Mcg::seed_from_u64(1));
    press_all(&mut wiring);
    let waits = |wiring: &Wiring| [0, 1, 2].map(|cell| wiring.waits_for_children(cell));
    assert_eq!(waits(&wiring), [false; 3]);
    assert_eq!(incomplete(&mut wiring, 20), Some(0));
    assert_eq!(waits(&wiring), [true, true, false], "the leaf has nobody to wait for");
    wiring.kill(2);
    assert_eq!(incomplete(&mut wiring, 10), Some(0), "cell 1 looks by itself when nobody wakes it");
    assert_eq!(waits(&wiring), [true, false, false]);
    wiring.stop();
    wiring.run(Span(2 * PERIOD.0));
    assert_eq!(waits(&wiring), [false; 3], "joints wake again");
    wiring.begin();
    assert_eq!(incomplete(&mut wiring, 20), Some(0));
    assert_eq!(waits(&wiring), [true, false, false]);
}
