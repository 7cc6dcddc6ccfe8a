//! Complete benches on which frames come twice, late, in the wrong order, in segments, or from other senders.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use model::table::{FrameEvent, Notice, Replies, UplinkCounts};
use protocol::can::Format;
use protocol::id::{Kind, Node};
use protocol::message::{Heartbeat, Joints, Message, NetworkPage, Request, StimulusStart};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::Parameter;
use protocol::time::{Micros, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skinbus_tests::accounts;
use skinbus_tests::bench::{Act, Bench};
use skinbus_tests::fault::{Fault, Harm, Party};
use skinbus_tests::gateway::epoch_of;
use skinbus_tests::skins;

const CELLS: usize = 4;

/// Returns a bench with all cells pressed, after some epochs.
fn pressed(format: Format, seed: u64) -> Bench {
    let mut bench = Bench::new(&skins::arm(4, format), seed).started();
    (0..CELLS).for_each(|place| bench.press(place, 1.0 + 0.2 * place as f64));
    bench.run_epochs(3);
    bench
}

fn replies(bench: &Bench) -> Replies {
    Replies::total(bench.gateway.table.cells().iter().map(|cell| cell.replies))
}

fn uplink(bench: &Bench) -> UplinkCounts {
    bench.gateway.table.uplink()
}

fn events(bench: &Bench, event: FrameEvent) -> u64 {
    bench.gateway.table.counters().event_count(event)
}

fn finish(bench: &mut Bench) {
    bench.faults.clear();
    bench.finish();
    accounts::check(bench);
}

#[test]
fn torques_that_come_twice_are_dropped_and_counted() {
    let mut bench = pressed(Format::Fd, 1);
    let before = bench.gateway.table.counters().received_count(Kind::Torque);
    bench.fault(Fault::new(Harm::Duplicate, 1.0).at_receiver(Party::Gateway).of_kind(Kind::Torque));
    bench.run_epochs(50);
    finish(&mut bench);
    let twice = events(&bench, FrameEvent::RepeatedTorque);
    assert_eq!(twice, 50 * CELLS as u64);
    let torques = bench.gateway.table.counters().received_count(Kind::Torque) - before;
    assert_eq!(torques, 2 * twice + CELLS as u64, "the last epoch was clean");
    assert_eq!((replies(&bench).missing, replies(&bench).unasked), (0, 0));
    assert_eq!(uplink(&bench).surplus, twice);
}

#[test]
fn joints_that_come_twice_are_answered_once() {
    let mut bench = pressed(Format::Fd, 2);
    bench.fault(Fault::new(Harm::Duplicate, 1.0).on_the_wire().of_kind(Kind::Command));
    bench.run_epochs(50);
    finish(&mut bench);
    assert_eq!((replies(&bench).missing, replies(&bench).unasked), (0, 0));
    assert_eq!(events(&bench, FrameEvent::RepeatedTorque) + events(&bench, FrameEvent::StaleTorque), 0);
    for cell in bench.gateway.table.cells() {
        assert_eq!(cell.pages().received.unwrap().joints_repeated, 50);
        assert_eq!(cell.unanswered_joint_counts(), Some((0, 0)));
    }
}

#[test]
fn a_torque_that_was_overtaken_by_a_later_one_is_dropped_as_stale() {
    let mut bench = pressed(Format::Fd, 3);
    // Each of them comes one to three epochs late, and some overtake others.
    let delay = Harm::Delay(Span(3 * bench.epoch().0));
    bench.fault(Fault::new(delay, 0.5).at_receiver(Party::Gateway).of_kind(Kind::Torque));
    bench.run_epochs(200);
    finish(&mut bench);
    let Replies { due, in_time, late, missing, .. } = replies(&bench);
    let stale = events(&bench, FrameEvent::StaleTorque);
    assert!(late > 10 && stale > 10 && in_time > due / 3, "{:?} {stale}", replies(&bench));
    assert_eq!(missing, stale, "what was overtaken counts as missing");
    assert!(
        bench.gateway.table.accuracy().single.max() < 1e-3,
        "late ones are compared with their own epoch"
    );
}

#[test]
fn a_torque_may_be_three_epochs_late_and_not_four() {
    for (late, used) in [(1, true), (2, true), (3, true), (4, false)] {
        let mut bench = pressed(Format::Fd, 4);
        let epoch = bench.epoch();
        // Another client sends cell 1's next torque some epochs late, while the cell's own torques are lost.
        bench.fault(Fault::new(Harm::Lose, 1.0).on_the_wire().of_kind(Kind::Torque).from(Party::CellSlot(0)));
        bench.run_epochs(1);
        let answers = epoch_of(bench.gateway.broadcasts() - 1);
        let before = bench.gateway.table.cells()[0].replies;
        bench.run_epochs(late);
        let torque = [5; WORDS];
        let from = bench.cell_slots[0].identity.cell.unwrap();
        bench.oracle.compares = false;
        bench.act(Act::Inject(Message::Torque { from, epoch: answers, torque: torque.into() }));
        bench.run(Span(epoch.0 / 4));
        let now = bench.gateway.table.cells()[0].replies;
        assert_eq!(now.late - before.late, u64::from(used), "{late} epochs late");
        assert_eq!(events(&bench, FrameEvent::StaleTorque), u64::from(!used), "{late} epochs late");
        finish(&mut bench);
    }
}

#[test]
fn a_broadcast_that_the_gateway_does_not_read_back_confuses_no_torque() {
    for harm in [Harm::Lose, Harm::Reorder, Harm::Delay(Span::from_millis(40))] {
        let mut bench = pressed(Format::Fd, 5);
        bench.fault(
            Fault::new(harm, 0.3).at_receiver(Party::Gateway).from(Party::Gateway).of_kind(Kind::Command),
        );
        bench.run_epochs(200);
        finish(&mut bench);
        let accuracy = bench.gateway.table.accuracy();
        assert!(accuracy.single.max() < 1e-3, "{harm:?}: {accuracy:?}");
        assert!(bench.gateway.table.snapshot().sums.contributing > 0);
    }
}

#[test]
fn broadcasts_that_change_places_on_the_wire_are_answered_forward_and_back() {
    let mut bench = pressed(Format::Fd, 6);
    let fault = Fault::new(Harm::Delay(Span(2 * bench.epoch().0)), 0.3);
    bench.fault(fault.on_the_wire().of_kind(Kind::Command));
    bench.run_epochs(200);
    finish(&mut bench);
    let Replies { due, in_time, late, missing, .. } = replies(&bench);
    assert!(in_time + late > due * 9 / 10, "{:?}", replies(&bench));
    // A cell answers the frames in the wire's order, so it misses nothing.
    assert_eq!(missing, 0);
    assert!(bench.gateway.table.accuracy().single.max() < 1e-3);
}

#[test]
fn epochs_may_jump_forward_and_back() {
    let mut bench = pressed(Format::Fd, 7);
    let mut dice = Pcg64Mcg::seed_from_u64(7);
    let before = replies(&bench);
    for _ in 0..300 {
        bench.run(Span(bench.epoch().0 / 2));
        // Like a restarted gateway, or a replayed recording; not the epoch of the last or next broadcast.
        let ours = bench.gateway.broadcasts();
        let epoch = Epoch(epoch_of(ours).0.wrapping_add(dice.random_range(10..240)));
        let joints = Joints { in_use: 6, ..Joints::default() };
        bench.act(Act::SendFromGateway(Message::Joints { epoch, joints }));
        bench.run(Span(bench.epoch().0 / 2));
    }
    let now = replies(&bench);
    assert_eq!(now.due - before.due, now.in_time - before.in_time, "{now:?}");
    assert!(now.due - before.due >= 600 * CELLS as u64, "{now:?}");
    finish(&mut bench);
    assert!(bench.gateway.table.accuracy().single.max() < 1e-3);
}

#[test]
fn a_late_stimulus_holds_from_the_next_joints_on_and_is_counted() {
    let mut bench = pressed(Format::Fd, 8);
    for late in 0..20 {
        let from = StimulusStart::Epoch(epoch_of(bench.gateway.broadcasts() - 1 - late % 3));
        bench.press_from(0, 1.5 + 0.05 * late as f64, from);
        bench.run_epochs(2);
    }
    finish(&mut bench);
    assert_eq!(bench.gateway.table.cells()[0].pages().received.unwrap().stimuli_late, 20);
    assert_eq!(replies(&bench).missing, 0);
    assert!(bench.gateway.table.accuracy().single.max() < 1e-3, "both sides take it at the same joints");
}

#[test]
fn a_lost_stimulus_of_a_touch_shows_as_missing_replies() {
    let mut bench = Bench::new(&skins::arm(4, Format::Fd), 9).started();
    bench.fault(Fault::new(Harm::Lose, 1.0).at_receiver(Party::CellSlot(0)).of_kind(Kind::Stimulus));
    bench.press(0, 2.0);
    bench.run_epochs(30);
    finish(&mut bench);
    let replies = replies(&bench);
    assert!(replies.due >= 30 && replies.missing == replies.due, "{replies:?}");
    assert_eq!(bench.gateway.table.counters().epochs_complete, 0);
    assert_eq!(bench.gateway.table.cells()[0].unanswered_joint_counts(), Some((0, 0)), "it heard all joints");
}

#[test]
fn a_lost_stimulus_of_a_release_shows_as_torques_that_are_not_due() {
    let mut bench = pressed(Format::Fd, 10);
    bench.fault(Fault::new(Harm::Lose, 1.0).at_receiver(Party::CellSlot(0)).of_kind(Kind::Stimulus));
    bench.press(0, 0.0);
    bench.run_epochs(30);
    finish(&mut bench);
    let replies = replies(&bench);
    assert!(replies.unasked >= 29 && replies.missing == 0, "{replies:?}");
    let single = bench.gateway.table.accuracy().single;
    assert!(
        replies.unexpected >= 29 && replies.contact_unknown == 0,
        "torques that should not be: {replies:?}"
    );
    assert!(single.max() < 1e-3, "they are compared with nothing: {single:?}");
}

#[test]
fn a_cell_that_others_switch_is_not_due_to_answer() {
    let mut bench = pressed(Format::Fd, 11);
    let words = [0; 6];
    let request = Request::Write { number: Parameter::Mode.number(), words };
    bench.act(Act::Inject(Message::Configure { to: Node::Everyone, tag: 9, request }));
    bench.run_epochs(40);
    finish(&mut bench);
    let replies = replies(&bench);
    assert_eq!(events(&bench, FrameEvent::OtherWriter), 1);
    assert_eq!(replies.missing, replies.in_doubt, "{replies:?}");
    assert!(replies.missing <= 4 * bench.skin.cells.len() as u64, "{replies:?}");
}

#[test]
fn a_second_gateway_is_noticed_by_its_joints_and_by_its_heartbeat() {
    let joints = Joints { in_use: 6, ..Joints::default() };
    let joints = Message::Joints { epoch: Epoch(77), joints };
    let page = NetworkPage::Heartbeat(Heartbeat::default());
    let heartbeat = Message::Network { from: Node::Gateway, epoch: Epoch(0), page };
    for message in [joints, heartbeat] {
        let mut bench = pressed(Format::Fd, 11);
        bench.act(Act::Inject(message));
        bench.run(Span(5_000));
        assert_eq!(events(&bench, FrameEvent::OtherGateway), 1);
        let notices =
            |bench: &Bench| bench.gateway.notices.iter().map(|(_, notice)| *notice).collect::<Vec<_>>();
        assert_eq!(notices(&bench), [], "one frame may come from anybody");
        for _ in 0..3 {
            bench.act(Act::Inject(message));
            bench.run(Span(16_000));
        }
        let goes_on = message == joints;
        let expected: &[_] = if goes_on { &[Notice::OtherGateway] } else { &[] };
        assert_eq!(notices(&bench), expected);
        assert_eq!(bench.gateway.table.snapshot().sums.other_gateways, u32::from(goes_on));
        assert_eq!(events(&bench, FrameEvent::OtherGateway), 4);
        finish(&mut bench);
        // This gateway uses none of the cells' answers to the other one.
        assert!(bench.gateway.table.accuracy().single.max() < 1e-3);
    }
}

#[test]
fn a_lost_segment_loses_its_packet_and_no_other() {
    for seed in 0..20 {
        let mut bench = pressed(Format::Classic, seed);
        bench.fault(Fault::new(Harm::Lose, 0.1).at_receiver(Party::Gateway).of_kind(Kind::Torque));
        bench.run_epochs(100);
        finish(&mut bench);
        let Replies { due, missing, late, unasked, .. } = replies(&bench);
        // One of two segments is lost in 18 of 100 packets, both in one.
        assert!(missing > 0 && missing < due * 28 / 100, "{:?}", replies(&bench));
        assert_eq!((late, unasked), (0, 0));
        let incomplete = events(&bench, FrameEvent::Incomplete);
        assert!(incomplete > 0 && incomplete <= missing, "{incomplete} of {missing}");
        assert!(bench.gateway.table.accuracy().single.max() < 1e-3, "no segments of two packets are joined");
    }
}

#[test]
fn cells_reassemble_segments_as_the_gateway_does() {
    for seed in 0..20 {
        let mut bench = pressed(Format::Classic, seed);
        bench.act(Act::SendFromGateway(Message::Report));
        bench.run(Span(2_000));
        bench.fault(Fault::new(Harm::Lose, 0.1).at_receiver(Party::CellSlot(0)).of_kind(Kind::Command));
        bench.run_epochs(100);
        finish(&mut bench);
        let cell = &bench.gateway.table.cells()[0];
        let (skipped, unheard) = cell.unanswered_joint_counts().unwrap();
        assert!(cell.pages().rejected.unwrap().incomplete > 0);
        assert_eq!((skipped, unheard), (0, cell.replies.missing));
        assert!(bench.gateway.table.accuracy().single.max() < 1e-3);
    }
}

#[test]
fn neither_the_order_of_starts_nor_that_of_replies_changes_a_single_torque() {
    let skin = skins::arm(6, Format::Fd);
    let run = |seed: u64| {
        let mut dice = Pcg64Mcg::seed_from_u64(seed);
        let starts: Vec<u64> = (0..6).map(|_| dice.random_range(0..400_000)).collect();
        let idle = model::scenario::Scenario::idle(Span(0));
        let mut bench = Bench::with(&skin, &idle, seed, |place| Micros(starts[place]));
        for cell_slot in &mut bench.cell_slots {
            // Within a tick; otherwise the arm, which gives way to the sum, would move differently.
            cell_slot.thinks = Span(dice.random_range(0..1_500));
        }
        bench.settle();
        bench.begin();
        for step in 0..60_u32 {
            for place in 0..6 {
                let newtons = f64::from((step * 7 + place * 5) % 11) * 0.3;
                let from = StimulusStart::Epoch(epoch_of(bench.gateway.broadcasts() + 2));
                bench.press_from(place as usize, newtons, from);
            }
            bench.run_epochs(1);
        }
        bench.finish();
        accounts::check(&bench);
        let order: Vec<u32> = bench.wire.iter().map(|it| it.frame.id()).collect();
        let torques: Vec<_> = (0..6).map(|place| bench.torques(place)).collect();
        (order, torques, bench.gateway.last().unwrap().q.map(f64::to_bits))
    };
    let (order, torques, q) = run(0);
    assert!(torques.iter().all(|torques| torques.len() > 40), "{torques:?}");
    for seed in 1..30 {
        let (other_order, other_torques, other_q) = run(seed);
        assert_ne!(order, other_order, "another order on the wire");
        assert_eq!(torques, other_torques);
        assert_eq!(q, other_q, "the sum does not depend on the order either");
    }
}
