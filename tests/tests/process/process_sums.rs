//! Benches of real processes whose cells answer with sums along their tree: complete, with links down, and up again.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::collections::BTreeMap;

use process::log::Log;
use process::sums::{
    CELLS, ROOTS, end, goes_on_without_a_wire, goes_round_a_cell, grid, holds, keeps_ways_without_a_touch,
    neighbors, unrecorded, wired,
};
use process::test_client::TestClient;
use process::{PRESSED, TestDir};
use protocol::can::Format;
use protocol::id::Kind;
use rustix::process::Signal;

#[test]
fn the_gateway_receives_its_roots_alone_and_every_cell_is_in_their_sums() {
    let place = TestDir::new();
    grid(&place, Format::Fd);
    place.scenario(PRESSED);
    let bench = unrecorded(&place, 600.0, "");
    bench.wait_for_loop();
    holds(&TestClient::on(&place, "vcan0", Format::Fd), CELLS.into());
    let said = end(&place, bench).stderr;
    assert!(said.contains("the cells of vcan0 formed a tree of depth "), "{said}");
    let summary = place.summary();
    let sums = |key: &str| summary.of_bus(&format!("/sums/{key}"));
    let broadcasts = summary.number("/loop/broadcasts");
    assert_eq!((sums("roots"), sums("overheard")), (2, 0), "{:#}", summary.0);
    // Each root sends once an epoch, and resent sums are counted.
    assert!(sums("first") > 0 && sums("first") <= 2 * broadcasts, "{:#}", summary.0);
    assert_eq!(summary.count("/buses/0/received", "sum"), sums("received"));
    assert!(summary.of_bus("/uplink/unheard") > 0, "ten cells sent to others: {:#}", summary.0);
    let unasked = summary.of_bus("/sums/contributions/unasked");
    assert!(unasked == 0 || said.contains("fallen silent"), "{said}{:#}", summary.0);
    assert!(summary.of_bus("/epochs_complete") > 0, "{:#}", summary.0);
    assert_eq!(
        summary.count("/buses/0/events", "foreign"),
        0,
        "wire frames are not foreign: {:#}",
        summary.0
    );
    assert!((2..=11).contains(&summary.of_bus("/network/deepest")), "{:#}", summary.0);
    assert!(summary.figure("/buses/0/network/tree_ready_s") >= 0.0);
    assert_eq!(summary.0["buses"][0]["network"]["differences"].as_array().unwrap().len(), 0);
    // Half a step of each cell, and the carried remainder.
    let errors = ["mean", "max"].map(|which| summary.figure(&format!("/accuracy/sums/{which}_nm")));
    assert!(errors[0] <= 0.0065 && errors[1] <= 12.0 / 256.0, "{:#}", summary.0);
    assert_eq!(summary.number("/accuracy/single/count"), 0);
}

#[test]
fn a_recording_holds_every_sum_and_no_wire() {
    let place = TestDir::new();
    grid(&place, Format::Fd);
    place.scenario(PRESSED);
    let bench = place.running_bench(600.0, "");
    holds(&TestClient::on(&place, "vcan0", Format::Fd), CELLS.into());
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
fn sums_bypass_a_cell_that_is_killed_or_hangs_until_it_comes_back() {
    goes_round_a_cell(&TestDir::new(), Format::Fd);
}

#[test]
fn sums_bypass_a_cell_in_classic_frames_too() {
    goes_round_a_cell(&TestDir::new(), Format::Classic);
}

#[test]
fn without_a_touch_hellos_show_lost_cells_and_the_rest_finds_another_route() {
    keeps_ways_without_a_touch(&TestDir::new(), Format::Fd);
}

// JOIN-6
#[test]
fn an_unreachable_cell_is_named_and_the_rest_finds_another_route() {
    goes_on_without_a_wire(&TestDir::new(), Format::Fd);
}

#[test]
fn an_unreachable_cell_is_named_in_classic_frames_too() {
    goes_on_without_a_wire(&TestDir::new(), Format::Classic);
}

#[test]
fn cells_that_are_wired_otherwise_than_described_are_named() {
    let place = TestDir::new();
    // The wires from 6 to 10 and from 7 to 11 are swapped: they lead to 11 and 10; 8 and 12 are not wired.
    wired(&place, Format::Fd, |cell| {
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
    grid(&place, Format::Fd);
    place.scenario(PRESSED);
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let words = format!("--bus vcan0 --bus-kind {} --nodes 1-12 --skin wired.toml", place.kind());
    let cells = place.start("cell-node", &words);
    let bench = unrecorded(&place, 600.0, "--no-spawn");
    bench.wait_for_loop();
    holds(&TestClient::on(&place, "vcan0", Format::Fd), 12);
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    drop((cells, server));
    let summary = place.summary();
    let differences = summary.0["buses"][0]["network"]["differences"].as_array().unwrap();
    let lines: Vec<_> = differences.iter().map(|line| line.as_str().unwrap()).collect();
    assert_eq!(
        lines,
        [
            "port 3 of cell 6 is wired to port 2 of cell 11 instead of port 2 of cell 10: correct the \
             wiring or the skin",
            "port 3 of cell 7 is wired to port 2 of cell 10 instead of port 2 of cell 11: correct the \
             wiring or the skin",
            "the wire from port 3 of cell 8 to port 2 of cell 12 does not work: check its connectors",
        ]
    );
}
