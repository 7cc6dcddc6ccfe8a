//! Cells wired at random become a tree, number themselves, lose wires and neighbours, and never count one twice.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::{BTreeMap, BTreeSet};

use protocol::id::CellId;
use protocol::time::Span;
use skinbus_tests::network::{End, PERIOD, Wiring};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Cells are started in any order within a third of a second, and have until then to be a tree.
const ORGANISED: Span = Span::from_millis(2_000);

/// Starts all cells at random times, and waits until they are organised.
fn organise(wiring: &mut Wiring, dice: &mut Pcg64Mcg) {
    let mut starts: Vec<(u64, usize)> =
        (0..wiring.cells.len()).map(|cell| (dice.random_range(0..300), cell)).collect();
    starts.sort_unstable();
    for (at, cell) in starts {
        let until = Span::from_millis(at).0.saturating_sub(wiring.now().0);
        wiring.run(Span(until));
        wiring.start(cell);
    }
    wiring.run(ORGANISED);
}

/// The tree spans what can be reached, numbers are dense and unique, and neighbours agree on their wires.
fn check_organised(wiring: &Wiring, seed: u64) {
    let reachable = wiring.reachable();
    let mut numbers = BTreeSet::new();
    for (place, cell) in wiring.cells.iter().enumerate() {
        let reached = reachable.contains(&place);
        assert_eq!(cell.number.is_some(), reached, "seed {seed}, cell {place}: {cell:?}");
        if let Some(number) = cell.number {
            assert!(numbers.insert(number.get()), "seed {seed}: number {number} twice");
            assert!(wiring.way(place).is_some(), "seed {seed}: cell {place} has no way: {:?}", cell.tree);
        }
    }
    let dense = (1..=u8::try_from(numbers.len()).unwrap()).collect::<BTreeSet<_>>();
    assert_eq!(numbers, dense, "seed {seed}: dense");
    for &place in &reachable {
        let ports = wiring.cells[place].ports.expect("who is settled reports its ports").ports;
        for (port, state) in ports.iter().enumerate() {
            match wiring.cells[place].wires[port] {
                Some(End::Cell(other, at)) => {
                    assert!(state.works, "seed {seed}: cell {place} port {port}");
                    let there = wiring.cells[other].number.map_or(0, CellId::get);
                    assert_eq!((state.number, usize::from(state.port)), (there, at), "seed {seed}");
                }
                Some(End::Gateway(_)) | None => assert!(!state.hears, "seed {seed}"),
            }
        }
    }
}

fn deepest(wiring: &Wiring) -> u8 {
    let depths = wiring.reachable().into_iter().filter_map(|cell| wiring.way(cell)).map(|way| way.len() - 1);
    u8::try_from(depths.max().unwrap_or(0)).unwrap()
}

/// Everything that can be in a sum is in it, all the time.
fn press_all(wiring: &mut Wiring) {
    wiring.switch(deepest(wiring), false);
    wiring.run(Span::from_millis(1));
    for cell in 0..wiring.cells.len() {
        wiring.press(cell, true);
    }
    wiring.begin();
    wiring.run(Span(4 * PERIOD.0));
}

/// How many epochs in a row were not complete after something broke; the last of them must be.
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
    let wanted = Wiring::bits(&wiring.reachable());
    let took: Vec<bool> = wiring.took[from.saturating_sub(1)..wiring.took.len() - 1]
        .iter()
        .map(|took| took.cells == wanted)
        .collect();
    let last = took.iter().rposition(|complete| !complete);
    match last {
        None => Some(0),
        Some(last) if last + 1 < took.len() => Some(last + 1),
        Some(_) => None,
    }
}

/// What breaks, or comes back.
fn break_something(wiring: &mut Wiring, dice: &mut Pcg64Mcg) -> String {
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
            wiring.cut(cell, port, true);
            format!("cut {cell} port {port}")
        }
        4 => {
            wiring.cut(cell, port, true);
            if let Some(End::Cell(other, at)) = wiring.cells[cell].wires[port] {
                wiring.cut(other, at, true);
            }
            format!("cut {cell} port {port} both ways")
        }
        _ => {
            for port in 0..4 {
                wiring.cut(cell, port, false);
            }
            if wiring.runs(cell) { format!("mend {cell}") } else { restart(wiring, cell) }
        }
    }
}

fn restart(wiring: &mut Wiring, cell: usize) -> String {
    wiring.go_on(cell);
    if !wiring.runs(cell) {
        wiring.start(cell);
    }
    wiring.run(Span::from_millis(700));
    wiring.tell_cuts(cell);
    wiring.switch(deepest(wiring), false);
    wiring.press(cell, true);
    format!("restart {cell}")
}

#[test]
fn random_wirings_organise_themselves_and_never_count_a_cell_twice() {
    let mut repairs = BTreeMap::<String, usize>::new();
    for seed in 0..WIRINGS {
        let mut dice = Pcg64Mcg::seed_from_u64(seed);

        let mut wiring = Wiring::random(seed);
        organise(&mut wiring, &mut dice);
        check_organised(&wiring, seed);
        press_all(&mut wiring);
        assert_eq!(incomplete(&mut wiring, 3), Some(0), "seed {seed}: all is in, before anything breaks");
        for _ in 0..4 {
            let what = break_something(&mut wiring, &mut dice);

            let before = wiring.ways();
            let after = incomplete(&mut wiring, 80);
            let after = after.unwrap_or_else(|| {
                wiring.say(&protocol::message::Message::Report);
                wiring.run(Span(5_000));
                for (place, cell) in wiring.cells.iter().enumerate() {
                    println!("{place}: {:?} {:?}", cell.tree, cell.wires);
                }
                let (took, reachable) = (wiring.took.iter().rev().nth(1), wiring.reachable());
                panic!(
                    "seed {seed}: never whole again after {what}: {took:?} of {reachable:?}; {}",
                    wiring.ways()
                )
            });
            if after > std::env::var("OVER").map_or(20, |over| over.parse().unwrap())
                && std::env::var("TRACE").is_ok_and(|kind| what.starts_with(&kind))
            {
                panic!("seed {seed} {what}: {after}, before: {before}; now {}", wiring.ways());
            }
            *repairs.entry(format!("{after:3} {}", what.split(' ').next().unwrap())).or_default() += 1;
        }
    }
    for (what, times) in repairs {
        println!("{what}: {times}");
    }
}

const WIRINGS: u64 = 2_000;
