//! Complete benches on which cells fall silent, hang, restart, or share a node id.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::node::{HEARTBEAT_INTERVAL, MAX_PENDING_STIMULI, MIN_CLAIM_TIME};
use model::table::{CellStatus, FrameEvent, Notice, Replies};
use model::tracker::DEAD_AFTER;
use protocol::can::Format;
use protocol::id::{Kind, Node};
use protocol::message::{Message, Request, State};
use protocol::packet::padded_words;
use protocol::parameters::{MAX_JOINTS, Parameter};
use protocol::time::{Micros, Span};
use skinbus_tests::accounts;
use skinbus_tests::bench::{Act, Bench};
use skinbus_tests::fault::{Fault, Harm, Party};
use skinbus_tests::skins;

const CELL: usize = 1;

fn bench(seed: u64) -> Bench {
    Bench::new(&skins::arm(4, Format::Fd), seed).started()
}

/// A time longer than a cell needs from its start to its first torque.
const START_TIMEOUT: Span = Span(2 * MIN_CLAIM_TIME.0 + 2 * HEARTBEAT_INTERVAL.0);

fn status(bench: &Bench, place: usize) -> CellStatus {
    bench.gateway.table.statuses(bench.now()).nth(place).unwrap().1
}

fn replies(bench: &Bench, place: usize) -> Replies {
    bench.gateway.table.cells()[place].replies
}

fn finish(bench: &mut Bench) {
    bench.finish();
    accounts::check(bench);
}

fn magnitude(torque: &[f64; MAX_JOINTS]) -> f64 {
    torque.iter().map(|torque| torque.abs()).sum()
}

#[test]
fn a_stale_cells_torque_is_held_and_then_decays_to_zero() {
    let mut bench = bench(1);
    bench.press(CELL, 3.0);
    bench.run_epochs(3);
    let whole = magnitude(&bench.gateway.table.snapshot().sums.torque);
    assert!(whole > 0.01);
    // The cell goes on to report a contact, but none of its torques arrives.
    bench.fault(
        Fault::new(Harm::Lose, 1.0)
            .at_receiver(Party::Gateway)
            .of_kind(Kind::Torque)
            .from(Party::CellSlot(CELL)),
    );
    let course: Vec<_> = (0..10)
        .map(|_| {
            bench.run_epochs(1);
            let snapshot = bench.gateway.table.snapshot().sums;
            let part = (magnitude(&snapshot.torque) / whole * 20.0).round() / 20.0;
            (part, snapshot.age, snapshot.stale, snapshot.contributing)
        })
        .collect();
    // The newest broadcast may still be answered; then the torque is held for 2 epochs, and decays over 4.
    let expected = [
        (1.0, 0, 0, 1),
        (1.0, 1, 1, 1),
        (1.0, 2, 1, 1),
        (0.75, 3, 1, 1),
        (0.5, 4, 1, 1),
        (0.25, 5, 1, 1),
        (0.0, 0, 1, 0),
        (0.0, 0, 1, 0),
    ];
    for (got, expected) in course.iter().zip(&expected) {
        assert_eq!(got, expected, "{course:?}");
    }
    assert_eq!(
        status(&bench, CELL),
        CellStatus::Stale,
        "it says that it is in contact, so zero is not known"
    );
    bench.faults.clear();
    bench.run_epochs(2);
    assert_eq!(status(&bench, CELL), CellStatus::Active);
    finish(&mut bench);
}

#[test]
fn a_heartbeat_of_a_quiet_cell_clears_a_held_torque() {
    let mut skin = skins::arm(4, Format::Fd);
    skin.safety.hold_epochs = 10_000;
    let mut bench = Bench::new(&skin, 2).started();
    bench.press(CELL, 3.0);
    bench.run_epochs(3);
    bench.fault(Fault::new(Harm::Lose, 1.0).at_receiver(Party::Gateway).of_kind(Kind::Torque));
    bench.press(CELL, 0.0);
    let released = bench.now();
    while bench.gateway.table.snapshot().sums.contributing > 0 {
        bench.run(Span::from_millis(1));
        assert!(
            bench.now().elapsed_since(released) <= Span(HEARTBEAT_INTERVAL.0 + bench.epoch().0),
            "held for ever"
        );
    }
    assert_eq!(bench.gateway.table.snapshot().sums.torque.map(f64::to_bits), [0; MAX_JOINTS]);
    assert_eq!(status(&bench, CELL), CellStatus::Quiet);
    finish(&mut bench);
}

#[test]
fn a_killed_cell_is_dead_after_the_documented_time_and_back_when_it_returns() {
    for seed in 0..20 {
        let mut bench = bench(seed);
        bench.press(CELL, 2.0);
        bench.run(Span(100_000 + seed * 7_919));
        bench.act(Act::Kill(CELL));
        let killed = bench.now();
        bench.run(Span(DEAD_AFTER.0 + HEARTBEAT_INTERVAL.0));
        let node = bench.cell_slots[CELL].identity.cell.unwrap();
        let [(dead, Notice::Dead(who))] = bench.gateway.notices[..] else {
            panic!("{:?}", bench.gateway.notices)
        };
        assert_eq!(who, node);
        // It answered every epoch, so its last packet is at most an epoch old.
        let after = dead.elapsed_since(killed);
        assert!((DEAD_AFTER.0 - bench.epoch().0..DEAD_AFTER.0 + 5_000).contains(&after.0), "{after:?}");
        assert_eq!((status(&bench, CELL), bench.gateway.table.snapshot().sums.dead), (CellStatus::Dead, 1));
        assert_eq!(bench.gateway.table.snapshot().sums.contributing, 0);

        bench.act(Act::Start(CELL));
        bench.run(START_TIMEOUT);
        let notices: Vec<_> = bench.gateway.notices[1..].iter().map(|(_, notice)| *notice).collect();
        assert_eq!(notices, [Notice::Revived(node), Notice::Restarted(node)]);
        assert_eq!(status(&bench, CELL), CellStatus::Active, "it was told what touches it");
        assert_eq!(bench.gateway.table.snapshot().sums.dead, 0);
        let before = replies(&bench, CELL);
        bench.run_epochs(20);
        let now = replies(&bench, CELL);
        assert_eq!((now.due, now.in_time), (before.due + 20, before.in_time + 20), "{now:?}");
        finish(&mut bench);
        let uplink = bench.gateway.table.cells()[CELL].uplink();
        assert_eq!((uplink.restarts, uplink.lost, uplink.surplus), (1, 0, 0), "{uplink:?}");
    }
}

#[test]
fn nothing_is_held_of_a_dead_cell_however_long_torques_are_held() {
    let mut skin = skins::arm(4, Format::Fd);
    skin.safety.hold_epochs = 10_000;
    let mut bench = Bench::new(&skin, 11).started();
    bench.press(CELL, 2.0);
    bench.run_epochs(5);
    bench.act(Act::Kill(CELL));
    bench.run(Span(DEAD_AFTER.0 - bench.epoch().0));
    assert_eq!(bench.gateway.table.snapshot().sums.contributing, 1, "held");
    bench.run(Span(2 * bench.epoch().0));
    assert_eq!(bench.gateway.table.snapshot().sums.contributing, 0, "dead");
    assert_eq!(bench.gateway.table.snapshot().sums.torque.map(f64::to_bits), [0; MAX_JOINTS]);
    finish(&mut bench);
}

#[test]
fn outstanding_replies_of_a_restarted_cell_are_in_doubt() {
    let mut bench = bench(12);
    bench.press(CELL, 2.0);
    bench.run_epochs(20);
    bench.run(Span(1_000));
    bench.act(Act::Kill(CELL));
    bench.act(Act::Start(CELL));
    bench.run(Span::from_millis(70)); // its claim
    let Replies { due, in_time, missing, in_doubt, .. } = replies(&bench, CELL);
    assert!(missing >= 1 && missing == in_doubt, "{missing} {in_doubt}");
    assert_eq!(due, in_time + missing, "settled at once");
    finish(&mut bench);
}

#[test]
fn a_restart_without_its_claim_is_detected_by_the_counter() {
    for seed in 0..20 {
        let mut bench = bench(seed);
        bench.press(CELL, 2.0);
        bench.run(Span(600_000 + seed * 7_919));
        bench.act(Act::Kill(CELL));
        bench.act(Act::Start(CELL));
        // Its claim is lost; the first received packet comes when the node id is its own.
        let claim = bench.now()..bench.now() + MIN_CLAIM_TIME;
        bench.fault(
            Fault::new(Harm::Lose, 1.0).at_receiver(Party::Gateway).from(Party::CellSlot(CELL)).during(claim),
        );
        bench.run(START_TIMEOUT);
        let node = bench.cell_slots[CELL].identity.cell.unwrap();
        let notices: Vec<_> = bench.gateway.notices.iter().map(|(_, notice)| *notice).collect();
        assert_eq!(notices, [Notice::Restarted(node)]);
        assert_eq!(status(&bench, CELL), CellStatus::Active, "it was told what touches it");
        finish(&mut bench);
        let uplink = bench.gateway.table.cells()[CELL].uplink();
        assert!(uplink.restarts == 1 && uplink.lost <= 1 && uplink.sent < 1_000, "{uplink:?}");
    }
}

#[test]
fn a_restarted_cell_is_not_in_contact_until_the_stimulus_is_sent_again() {
    let mut bench = bench(3);
    bench.gateway.reminds = false;
    bench.press(CELL, 2.0);
    bench.run_epochs(10);
    bench.act(Act::Kill(CELL));
    bench.act(Act::Start(CELL));
    bench.run(START_TIMEOUT);
    assert_eq!(status(&bench, CELL), CellStatus::Quiet);
    let (due, sent) = (replies(&bench, CELL).due, bench.torques(CELL).len());
    bench.run_epochs(20);
    assert_eq!((replies(&bench, CELL).due, bench.torques(CELL).len()), (due, sent), "nothing is due");
    bench.press(CELL, 1.0);
    bench.run_epochs(3);
    assert_eq!(status(&bench, CELL), CellStatus::Active);
    finish(&mut bench);
}

#[test]
fn joints_older_than_a_period_are_skipped_and_explain_what_is_missing() {
    for seed in 0..20 {
        let mut bench = bench(seed);
        bench.press(CELL, 2.0);
        bench.run_epochs(10);
        bench.act(Act::SendFromGateway(Message::Report));
        bench.run(Span(2_000));
        bench.act(Act::Hang(CELL));
        bench.run(Span(100_000 + seed * 3_137));
        bench.act(Act::Continue(CELL));
        bench.run_epochs(20);
        finish(&mut bench);
        assert_eq!(bench.gateway.notices, [], "too short to be dead");
        let cell = &bench.gateway.table.cells()[CELL];
        let (skipped, unheard) = cell.unanswered_joint_counts().unwrap();
        let replies = replies(&bench, CELL);
        assert!(skipped >= 5 && unheard == 0, "{skipped} {unheard}");
        // The last broadcast of the hang may be recent enough to be answered late.
        assert_eq!(replies.missing, skipped, "{replies:?}");
        assert!(replies.late <= 1, "{replies:?}");
    }
}

#[test]
fn lost_joints_and_skipped_joints_are_counted_apart() {
    let mut bench = bench(4);
    bench.press(CELL, 2.0);
    bench.run_epochs(5);
    bench.act(Act::SendFromGateway(Message::Report));
    bench.run(Span(2_000));
    bench.fault(Fault::new(Harm::Lose, 0.3).at_receiver(Party::CellSlot(CELL)).of_kind(Kind::Command));
    bench.run_epochs(100);
    bench.faults.clear();
    finish(&mut bench);
    let (skipped, unheard) = bench.gateway.table.cells()[CELL].unanswered_joint_counts().unwrap();
    assert_eq!((skipped, unheard), (0, replies(&bench, CELL).missing));
    assert!(unheard > 10, "{unheard}");
    assert_eq!(bench.gateway.table.cells()[0].unanswered_joint_counts(), Some((0, 0)));
}

#[test]
fn a_long_run_does_not_confuse_the_count_of_joints() {
    // One tick per broadcast, and more of them than a counter of 16 bits holds.
    let mut skin = skins::arm(1, Format::Fd);
    (skin.timing.control_hz, skin.timing.ticks_per_broadcast) = (62.5, 1);
    let mut bench = Bench::new(&skin, 5).started();
    bench.act(Act::SendFromGateway(Message::Report));
    bench.run_epochs(65_536 + 1_000);
    finish(&mut bench);
    assert_eq!(bench.gateway.table.cells()[0].unanswered_joint_counts(), Some((0, 0)));
}

#[test]
fn a_cell_that_hung_takes_the_stimuli_of_meanwhile_and_refuses_none() {
    let mut bench = bench(6);
    bench.run_epochs(5);
    bench.act(Act::Hang(CELL));
    for step in 0..2 * MAX_PENDING_STIMULI {
        bench.press(CELL, 1.0 + 0.1 * step as f64);
        bench.run_epochs(1);
    }
    bench.press(CELL, 0.0);
    bench.run_epochs(2);
    bench.act(Act::Continue(CELL));
    bench.run_epochs(5);
    assert_eq!(status(&bench, CELL), CellStatus::Quiet);
    finish(&mut bench);
    assert_eq!(bench.gateway.table.cells()[CELL].pages().rejected.unwrap().stimuli, 0);
}

#[test]
fn of_two_cells_with_one_node_id_exactly_one_stays_whenever_they_start() {
    for apart in (0..900_000).step_by(17_000) {
        for (serial, seed) in [(1, 1), (900_000, 2)] {
            let skin = skins::arm(2, Format::Fd);
            let mut bench = Bench::new(&skin, seed);
            bench.oracle.compares = false;
            let first = bench.cell_slots[0].identity;
            let flash = FlashState::Valid(skin.parameters(&skin.cells[0]));
            let second = bench.add(Identity { serial, ..first }, flash);
            bench.at(Micros(apart), Act::Start(second));
            bench.run(Span::from_millis(2_000));
            let gave_up = [0, second].map(|cell_slot| bench.cell_slots[cell_slot].gave_up().is_some());
            assert_ne!(gave_up[0], gave_up[1], "{apart} us apart, serial {serial}");
            if apart + 64_000 < MIN_CLAIM_TIME.0 {
                let greater = usize::from(serial > first.serial);
                assert!(gave_up[greater], "{apart} us apart both claim, so the lesser serial number stays");
            }
            assert!(bench.gateway.table.cells()[0].is_ready());
        }
    }
}

#[test]
fn an_address_claim_for_a_settled_cells_node_id_changes_nothing_and_is_noticed() {
    let mut claims = [0, 0];
    for start in 0..12 {
        let serial = [1, 1_023][start % 2];
        let skin = skins::arm(2, Format::Fd);
        let mut bench = Bench::new(&skin, 7).started();
        bench.press(0, 2.0);
        bench.run_epochs(60);
        bench.run(Span(21_000 * start as u64));
        let before = replies(&bench, 0);
        let flash = FlashState::Valid(skin.parameters(&skin.cells[0]));
        let newcomer = bench.add(Identity { serial, ..bench.cell_slots[0].identity }, flash);
        bench.act(Act::Start(newcomer));
        for _ in 0..60 {
            bench.run_epochs(1);
            assert_eq!(bench.gateway.table.snapshot().sums.contributing, 1, "the torque is held throughout");
        }
        assert_eq!(bench.cell_slots[newcomer].gave_up(), Some(bench.cell_slots[0].identity.serial));
        let now = replies(&bench, 0);
        assert_eq!((now.due, now.in_time), (before.due + 60, before.in_time + 60), "{now:?}");
        // It may receive a heartbeat before it sends its first packet, and then sends none.
        let claim = bench.wire.iter().find(|it| it.from == Party::CellSlot(newcomer)).map(|it| it.at);
        let claimed = claim.is_some();
        claims[usize::from(claimed)] += 1;
        let node = bench.cell_slots[0].identity.cell.unwrap();
        let notices: Vec<_> = bench.gateway.notices.iter().map(|(_, notice)| *notice).collect();
        assert_eq!(notices, if claimed { vec![Notice::Duplicate(node)] } else { vec![] });
        if let (Some(claim), Some((at, _))) = (claim, bench.gateway.notices.first()) {
            assert!(at.elapsed_since(claim) < Span::from_millis(6), "a claim is answered at once");
        }
        assert_eq!(bench.gateway.table.counters().event_count(FrameEvent::Duplicate), u64::from(claimed));
        finish(&mut bench);
        let uplink = bench.gateway.table.cells()[0].uplink();
        let got = (uplink.restarts, uplink.lost, uplink.surplus);
        assert_eq!(got, (0, 0, u64::from(claimed)), "{uplink:?}");
    }
    assert!(claims[0] > 0 && claims[1] > 0, "{claims:?}");
}

#[test]
fn a_cell_that_is_replaced_by_another_one_is_taken_for_what_it_is() {
    let skin = skins::arm(2, Format::Fd);
    let mut bench = Bench::new(&skin, 8).started();
    bench.press(0, 2.0);
    bench.run_epochs(60);
    bench.act(Act::Kill(0));
    let flash = FlashState::Valid(skin.parameters(&skin.cells[0]));
    let other = bench.add(Identity { serial: 77, ..bench.cell_slots[0].identity }, flash);
    bench.act(Act::Start(other));
    bench.run(START_TIMEOUT);
    assert_eq!(status(&bench, 0), CellStatus::Active, "it was told what touches it");
    assert_eq!(bench.gateway.table.cells()[0].heartbeat().unwrap().serial, 77);
    finish(&mut bench);
    let uplink = bench.gateway.table.cells()[0].uplink();
    assert_eq!((uplink.restarts, uplink.lost), (1, 0), "{uplink:?}");
}

#[test]
fn a_damaged_flash_is_reported_and_nothing_is_due() {
    let skin = skins::arm(2, Format::Fd);
    let mut bench = Bench::with(&skin, &model::scenario::Scenario::idle(Span(0)), 9, |_| Micros(0));
    bench.cell_slots[0].flash = FlashState::Damaged;
    bench.run(Span::from_millis(1_000));
    bench.begin();
    bench.press(0, 2.0);
    bench.run_epochs(20);
    let heartbeat = bench.gateway.table.cells()[0].heartbeat().unwrap();
    assert!(heartbeat.state.has(State::FLASH_DAMAGED) && !heartbeat.state.has(State::CONFIGURED));
    finish(&mut bench);
    assert_eq!((replies(&bench, 0), bench.torques(0).len()), (Replies::default(), 0));
}

fn stuck(bench: &Bench) -> Vec<(usize, &'static str)> {
    let cells = bench.gateway.table.cells().iter().enumerate();
    cells.flat_map(|(place, cell)| cell.stuck_word_runs().map(move |(kind, _)| (place, kind))).collect()
}

#[test]
fn a_cell_whose_torque_never_changes_is_stuck_once_the_arm_or_the_touch_has_moved() {
    for moved_by in ["the arm", "touches"] {
        let mut bench = bench(7);
        bench.cell_slots[CELL].is_stuck = true;
        if moved_by == "the arm" {
            (0..4).for_each(|place| bench.press(place, 3.0));
            bench.run_epochs(300);
        } else {
            for newtons in [3.0, 1.0, 2.0, 4.0, 1.5, 3.0] {
                (0..4).for_each(|place| bench.press(place, newtons));
                bench.run_epochs(20);
            }
        }
        assert_eq!(stuck(&bench), [(CELL, "torque")], "{moved_by}");
        assert!(bench.gateway.table.cells()[CELL].is_stuck());
        bench.cell_slots[CELL].is_stuck = false;
        bench.run_epochs(2);
        assert!(!bench.gateway.table.cells()[CELL].is_stuck(), "it answers rightly again");
        finish(&mut bench);
    }
}

#[test]
fn a_right_cell_is_not_stuck_whether_pressed_or_not_measuring_or_halted() {
    let mut bench = bench(8);
    bench.run_epochs(100);
    assert_eq!(stuck(&bench), [], "nothing touches the skin");
    for newtons in [3.0, 0.4, 2.0, 0.0, 1.0, 6.0] {
        bench.press(CELL, newtons);
        bench.run_epochs(40);
    }
    bench.act(Act::Kill(0));
    bench.run_epochs(40);
    bench.act(Act::SendFromGateway(Message::Halt));
    bench.run_epochs(100);
    let (node, number) = (Node::Everyone, Parameter::Mode.number());
    let request = Request::Write { number, words: padded_words([0]) };
    bench.act(Act::SendFromGateway(Message::Configure { to: node, tag: 0, request }));
    bench.run_epochs(100);
    assert_eq!(stuck(&bench), []);
}
