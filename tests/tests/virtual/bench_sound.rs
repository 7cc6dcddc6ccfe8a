//! Complete benches without faults.

#![allow(clippy::unwrap_used, reason = "a test may stop")]

use model::scenario::Scenario;
use model::table::{CellStatus, FrameEvent, Replies, UplinkCounts};
use protocol::can::Format;
use protocol::id::Kind;
use protocol::message::StimulusStart;
use protocol::packet::WORDS;
use protocol::parameters::MAX_JOINTS;
use protocol::time::{Micros, Span};
use skinbus_tests::accounts;
use skinbus_tests::bench::Bench;
use skinbus_tests::gateway::epoch_of;
use skinbus_tests::skins;

/// The documented mean error of a single torque, in Nm.
const PROMISED_NM: f64 = 1.2e-4;

fn totals(bench: &Bench) -> (UplinkCounts, Replies) {
    let cells = || bench.gateway.table.cells().iter();
    (cells().map(|cell| cell.uplink()).sum(), Replies::total(cells().map(|cell| cell.replies)))
}

/// Checks that nothing is lost, late, unknown, repeated, or irregular in any way.
fn assert_flawless(bench: &Bench) {
    accounts::check(bench);
    let (uplink, replies) = totals(bench);
    assert_eq!((uplink.sent, uplink.lost, uplink.surplus), (uplink.delivered, 0, 0), "{uplink:?}");
    assert_eq!((replies.in_time, replies.missing), (replies.due, 0), "{replies:?}");
    let counters = bench.gateway.table.counters();
    for event in FrameEvent::ALL.into_iter().filter(|event| *event != FrameEvent::Saturated) {
        assert_eq!(counters.event_count(event), 0, "{}", event.name());
    }
    assert_eq!(counters.epochs_complete, counters.epochs_due);
    assert_eq!(bench.gateway.notices, []);
}

fn assert_accurate(bench: &Bench) {
    let accuracy = bench.gateway.table.accuracy();
    assert!(accuracy.single.mean().unwrap() < PROMISED_NM, "{accuracy:?}");
    assert!(accuracy.single.max() < 8.0 * PROMISED_NM, "{accuracy:?}");
}

#[test]
fn without_faults_every_reply_that_is_due_comes_in_time_and_is_right() {
    for format in [Format::Fd, Format::Classic] {
        let mut bench = Bench::new(&skins::arm(12, format), 1).started();
        for place in [0, 3, 5, 11] {
            bench.press(place, 1.0 + 0.1 * place as f64);
        }
        bench.run_epochs(100);
        let statuses: Vec<_> = bench.gateway.table.statuses(bench.now()).map(|(_, status)| status).collect();
        for (place, status) in statuses.into_iter().enumerate() {
            let pressed = [0, 3, 5, 11].contains(&place);
            assert_eq!(status, if pressed { CellStatus::Active } else { CellStatus::Quiet }, "{place}");
        }
        assert_eq!(bench.gateway.table.snapshot().sums.contributing, 4);
        bench.finish();
        assert_flawless(&bench);
        assert_accurate(&bench);
        let (_, replies) = totals(&bench);
        let epochs = bench.gateway.broadcasts();
        assert_eq!((replies.due, replies.unasked), (4 * (epochs - 2), 0), "all but those before the touch");
        assert_eq!(bench.gateway.table.accuracy().whole.count(), 6 * (epochs - 2));
    }
}

#[test]
fn a_contact_ends_with_one_zero_torque_and_nothing_is_held() {
    let mut bench = Bench::new(&skins::arm(3, Format::Fd), 2).started();
    bench.press(1, 3.0);
    bench.run_epochs(10);
    bench.press(1, 0.0);
    bench.run_epochs(2);
    let snapshot = bench.gateway.table.snapshot().sums;
    assert_eq!((snapshot.torque, snapshot.contributing), ([0.0; MAX_JOINTS], 0));
    let torques = bench.torques(1);
    bench.run_epochs(10);
    assert_eq!(bench.torques(1), torques, "silence after the zeros");
    assert_eq!(torques.last().unwrap().1, [0; WORDS]);
    assert_eq!(torques.iter().filter(|(_, words)| *words == [0; WORDS]).count(), 1);
    bench.finish();
    assert_flawless(&bench);
    assert_eq!(totals(&bench).1.unasked, 1, "the zeros");
}

#[test]
fn epochs_wrap_around_without_notices() {
    let mut bench = Bench::new(&skins::arm(2, Format::Fd), 3).started();
    // Pressed from an epoch on that lies beyond the wrap-around.
    bench.run_epochs(200);
    let from = epoch_of(bench.gateway.broadcasts() + 100);
    bench.press_from(0, 2.0, StimulusStart::Epoch(from));
    bench.run_epochs(99);
    assert_eq!(bench.torques(0), [], "not yet");
    bench.run_epochs(400);
    assert_eq!(bench.torques(0)[0].0, from.0, "in its epoch");
    bench.finish();
    assert_flawless(&bench);
    assert!(totals(&bench).1.due > 256);
    assert_accurate(&bench);
}

#[test]
fn the_arm_yields_and_the_torques_stay_right_as_it_moves() {
    let mut bench = Bench::new(&skins::arm(12, Format::Fd), 4).started();
    (0..12).for_each(|place| bench.press(place, 2.0));
    bench.run_epochs(120);
    let moved = bench.gateway.last().unwrap().q;
    assert!(moved.iter().any(|q| q.abs() > 0.1), "{moved:?}");
    bench.finish();
    assert_flawless(&bench);
    assert_accurate(&bench);
}

#[test]
fn the_253_cell_arm_runs_its_demo_without_a_flaw() {
    let skin = skins::ur5_253();
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../gateway/examples/demo.toml");
    let scenario = Scenario::read(path.as_ref(), &skin).unwrap();
    let mut bench = Bench::with(&skin, &scenario, 5, |place| Micros(place as u64 * 500));
    bench.settle();
    bench.begin();
    bench.run(scenario.duration);
    bench.finish();
    assert_flawless(&bench);
    assert_accurate(&bench);
    let (uplink, replies) = totals(&bench);
    assert!(replies.due > 1_000 && uplink.sent > 253 * 40, "{replies:?} {uplink:?}");
    let heartbeats = bench.gateway.table.counters().received_count(Kind::Network);
    assert!(heartbeats > 253 * 4 * 12, "{heartbeats}");
}

#[test]
fn all_253_cells_pressed_at_once_answer_every_epoch() {
    let skin = skins::ur5_253();
    let mut bench = Bench::new(&skin, 6).started();
    (0..253).for_each(|place| bench.press(place, 1.5));
    bench.run_epochs(60);
    assert_eq!(bench.gateway.table.snapshot().sums.contributing, 253);
    bench.finish();
    assert_flawless(&bench);
    assert_accurate(&bench);
    assert!(totals(&bench).1.due >= 253 * 60);
}

#[test]
fn cells_answer_in_a_few_microseconds_of_virtual_time() {
    let mut bench = Bench::new(&skins::arm(4, Format::Fd), 7).started();
    (0..4).for_each(|place| bench.press(place, 1.0));
    bench.run_epochs(50);
    bench.finish();
    let last = bench.gateway.table.delays().last_reply_delays();
    assert!(last.len() > 49 && last.max() < 500, "{} {}", last.len(), last.max());
    assert_eq!(bench.epoch(), Span(16_000));
}
