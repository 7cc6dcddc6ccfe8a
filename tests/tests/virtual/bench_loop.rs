//! Complete benches on which the loop halts, resumes, and is late.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use control::controller::BadCycle;
use control::cycle::Halt;
use model::table::Replies;
use protocol::can::Format;
use protocol::id::{Command, Id, Kind};
use protocol::message::{Message, State};
use protocol::parameters::MAX_JOINTS;
use protocol::skin::MAX_ROBOT_JOINTS;
use protocol::time::{Micros, Span};
use skinbus_tests::accounts;
use skinbus_tests::bench::{Act, Bench};
use skinbus_tests::fault::{Fault, Harm, Party};
use skinbus_tests::skins;

fn pressed(seed: u64) -> Bench {
    let mut bench = Bench::new(&skins::arm(4, Format::Fd), seed).started();
    (0..4).for_each(|place| bench.press(place, 2.0));
    bench.run_epochs(5);
    bench
}

fn replies(bench: &Bench) -> Replies {
    Replies::total(bench.gateway.table.cells().iter().map(|cell| cell.replies))
}

fn on_the_wire(bench: &Bench, command: Command, from: Party) -> Vec<Micros> {
    let id = u32::from(Id::command(command).to_bits());
    bench.wire.iter().filter(|it| it.frame.id() == id && it.from == from).map(|it| it.at).collect()
}

fn finish(bench: &mut Bench) {
    bench.finish();
    accounts::check(bench);
}

fn halted(bench: &Bench) -> Option<Halt> {
    bench.gateway.last().unwrap().halted
}

fn q(bench: &Bench) -> [u64; MAX_ROBOT_JOINTS] {
    bench.gateway.last().unwrap().q.map(f64::to_bits)
}

#[test]
fn a_halt_from_any_sender_stops_robot_and_cells_and_a_resume_continues_both() {
    let mut bench = pressed(1);
    bench.act(Act::Inject(Message::Halt));
    bench.run(Span(5_000));
    assert_eq!(halted(&bench), Some(Halt::Frame));
    assert_eq!(
        (bench.gateway.table.snapshot().sums.torque, bench.gateway.table.snapshot().sums.contributing),
        ([0.0; MAX_JOINTS], 0)
    );
    let (stands, due, sent) = (q(&bench), replies(&bench).due, bench.torques(0).len());
    bench.run_epochs(30);
    assert_eq!(q(&bench), stands);
    assert_eq!((replies(&bench).due, bench.torques(0).len()), (due, sent), "nothing is due, nothing comes");
    for cell in bench.gateway.table.cells() {
        assert!(cell.heartbeat().unwrap().state.has(State::HALTED) && !cell.is_ready());
    }

    bench.act(Act::Inject(Message::Resume));
    bench.run_epochs(30);
    assert_eq!(halted(&bench), None);
    assert_ne!(q(&bench), stands);
    assert!(replies(&bench).due >= due + 4 * 29, "{:?}", replies(&bench));
    finish(&mut bench);
    assert_eq!((replies(&bench).missing, replies(&bench).unasked), (0, 0), "{:?}", replies(&bench));
}

#[test]
fn bad_cycles_in_a_row_halt_the_robot_until_someone_resumes() {
    let mut bench = pressed(2);
    let limit = u64::from(bench.skin.safety.bad_cycles);
    bench.gateway.works = false;
    bench.run(Span(bench.gateway.period().0 * (limit - 2)));
    assert_eq!(halted(&bench), None, "not yet");
    bench.gateway.works = true;
    bench.run(Span(bench.gateway.period().0));
    bench.gateway.works = false;
    bench.run(Span(bench.gateway.period().0 * (limit - 1)));
    assert_eq!(halted(&bench), None, "a good one restarts the count");
    assert_eq!(on_the_wire(&bench, Command::Halt, Party::Gateway), []);
    bench.run(Span(bench.gateway.period().0 * 50));
    assert_eq!(halted(&bench), Some(Halt::BadCycles(BadCycle::Torque)));
    assert_eq!(on_the_wire(&bench, Command::Halt, Party::Gateway).len(), 1, "said once");
    let first = bench.gateway.records.iter().position(|record| record.halted.is_some()).unwrap();
    let before =
        bench.gateway.records[..first].iter().rev().take_while(|record| record.bad.is_some()).count();
    assert_eq!(before as u64, limit - 1, "the last one of so many halts");

    bench.gateway.works = true;
    let (stands, due) = (q(&bench), replies(&bench).due);
    bench.run_epochs(20);
    assert_eq!((q(&bench), replies(&bench).due), (stands, due), "working again is not enough");
    bench.act(Act::Inject(Message::Resume));
    bench.run_epochs(20);
    assert_eq!(halted(&bench), None);
    assert_ne!(q(&bench), stands);
    finish(&mut bench);
    assert_eq!((replies(&bench).missing, replies(&bench).unasked), (0, 0), "{:?}", replies(&bench));
}

#[test]
fn a_cell_that_lost_a_halt_is_found_by_its_heartbeat() {
    let mut bench = pressed(3);
    bench.fault(Fault::new(Harm::Lose, 1.0).at_receiver(Party::CellSlot(0)).from(Party::UnknownNode));
    bench.act(Act::Inject(Message::Halt));
    bench.faults.clear();
    bench.run(Span(400_000));
    let halted: Vec<_> = bench
        .gateway
        .table
        .cells()
        .iter()
        .map(|cell| cell.heartbeat().unwrap().state.has(State::HALTED))
        .collect();
    assert!(!halted[1..].contains(&false), "{halted:?}");
    finish(&mut bench);
}

#[test]
fn skipped_ticks_skip_whole_broadcasts_and_are_counted() {
    let mut bench = pressed(4);
    let (before, skipped) = (bench.gateway.broadcasts(), bench.gateway.broadcasts_skipped);
    let ticks = u64::from(bench.skin.timing.ticks_per_broadcast);
    bench.gateway.skip_ticks(5 * ticks);
    bench.run_epochs(10);
    assert_eq!(bench.gateway.broadcasts_skipped - skipped, 5 - 1);
    assert!(bench.gateway.records.iter().any(|record| record.skipped == 5 * ticks));
    let broadcasts = bench.gateway.broadcasts() - before;
    assert!((5..=6).contains(&broadcasts), "{broadcasts}");
    // The phase is unchanged: all broadcasts but the one after the gap are one period apart.
    let times = on_the_wire(&bench, Command::Joints, Party::Gateway);
    let phases: Vec<_> = times.iter().rev().take(4).map(|at| at.0 % bench.epoch().0).collect();
    let first = times[1].0 % bench.epoch().0;
    assert!(phases.iter().all(|&phase| phase.abs_diff(first) < 100), "{phases:?} {first}");
    finish(&mut bench);
    assert_eq!(replies(&bench).missing, 0);
}

#[test]
fn a_gateway_that_stops_broadcasting_holds_its_torques_and_no_cell_is_stale() {
    let mut bench = pressed(5);
    bench.run(Span(1_000));
    let torque = bench.gateway.table.snapshot().sums.torque;
    bench.gateway.skip_ticks(100);
    bench.run(Span::from_millis(190));
    assert_eq!(bench.gateway.table.snapshot().sums.torque.map(f64::to_bits), torque.map(f64::to_bits));
    assert_eq!(bench.gateway.table.snapshot().sums.stale, 0);
    bench.run_epochs(5);
    finish(&mut bench);
    assert_eq!(replies(&bench).missing, 0);
}

#[test]
fn a_press_moves_the_joints_the_way_it_pushes() {
    // One cell on joint 1, half a metre along x, its normal along the frame's z.
    let mut skin = skins::arm(1, Format::Fd);
    let cell = &mut skin.cells[0];
    (cell.joint, cell.position, cell.normal) = (1, [0.5, 0.0, 0.0], [0.0, 0.0, 1.0]);
    let mut bench = Bench::new(&skin, 6).started();
    bench.press(0, 4.0);
    bench.run_epochs(2);
    // Frame 1 has its z axis along minus y of the base: the force -4 N along it pushes towards plus y.
    let torque = bench.gateway.table.snapshot().sums.torque;
    assert!((torque[0] - 2.0).abs() < 0.01, "{torque:?}");
    bench.run_epochs(10);
    assert!(f64::from_bits(q(&bench)[0]) > 0.01);
    finish(&mut bench);
    assert_eq!(bench.gateway.table.counters().received_count(Kind::Sum), 0);
}
