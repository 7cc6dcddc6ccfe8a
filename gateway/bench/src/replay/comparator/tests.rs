use super::bus_comparator::KnownCell;
use super::*;
use crate::replay::survey::{Survey, TimeRange};
use protocol::can::Format;
use protocol::candump::{Record, Timestamp};
use protocol::fixed::Q3_12;
use protocol::message::{Heartbeat, Joints, ReceivedCounts, SensorPage, State as Flags, TreePage};
use protocol::packet;
use protocol::parameters::Parameter as P;

const MS: u64 = 1_000_000;

fn cell(node: i64) -> CellId {
    CellId::new(node).unwrap()
}

fn torque(node: i64, epoch: u8, bits: i16) -> Message {
    let torque = packet::padded_words([bits]).into();
    Message::Torque { from: cell(node), epoch: Epoch(epoch), torque }
}

fn heartbeat(node: i64, epoch: u8, sent: u16, state: Flags) -> Message {
    let page = NetworkPage::Heartbeat(Heartbeat { sent, state, configuration: 7, ..Heartbeat::default() });
    Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(epoch), page }
}

fn heard(node: i64, epoch: u8, joints: u16) -> Message {
    let page = NetworkPage::Received(ReceivedCounts { joints, ..ReceivedCounts::default() });
    Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(epoch), page }
}

fn sum(node: i64, epoch: u8, bits: i16, count: u8) -> Message {
    let torque = packet::padded_words([bits]).into();
    Message::Sum { from: cell(node), epoch: Epoch(epoch), torque, count }
}

fn tree(node: i64, epoch: u8, parent: Option<u8>) -> Message {
    let page = NetworkPage::Tree(TreePage { parent, ..TreePage::default() });
    Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(epoch), page }
}

fn joints(epoch: u8) -> Message {
    Message::Joints { epoch: Epoch(epoch), joints: Joints { in_use: 6, ..Joints::default() } }
}

/// Compares a recording, with 1 ms between messages, with the present replies to the same joints.
fn rated(recording: &[Message], now: &[Message]) -> Comparator {
    rated_within(0, recording, now)
}

/// Compares with a tolerance in steps of torques.
fn rated_within(tolerance: u16, recording: &[Message], now: &[Message]) -> Comparator {
    let mut survey = Survey::new(TimeRange::default());
    let mut comparator = Comparator::new([("vcan0".to_owned(), BTreeMap::new())], 0, Some(tolerance));
    let times = (1_u64..).map(|at| at * MS);
    for (nanos, message) in times.clone().zip(recording) {
        let time = Timestamp::with_six_digits(nanos);
        for frame in message.encode().frames(Format::Fd) {
            survey.add_frame(&Record { time, interface: "vcan0", frame, direction: None });
        }
    }
    survey.finish();
    let cells = survey.buses[0].cells.clone();
    comparator.buses[0].known = cells.into_iter().map(|(node, cell)| (node, KnownCell::new(cell))).collect();
    comparator.set_muted(false);
    for (nanos, message) in times.zip(recording) {
        if let Message::Joints { epoch, .. } = *message {
            comparator.expect_joints(0, nanos, epoch, true);
        } else {
            comparator.expect_message(0, message, true);
        }
    }
    comparator.expect_end();
    let mut round = 0;
    for message in now {
        if let Message::Joints { epoch, .. } = *message {
            comparator.announce_joints(0, Some(round), epoch);
            round += 1;
        } else {
            comparator.observe_message(0, message);
        }
    }
    comparator.finish(true);
    comparator
}

fn counts(comparator: &Comparator) -> [u64; 4] {
    let ReplyTally { equal, different, missing, extra, .. } = comparator.tally;
    [equal, different, missing, extra]
}

/// A run in which cell 1 was in contact from epoch 1 to 3.
fn run() -> Vec<Message> {
    vec![
        heartbeat(1, 0, 10, Flags::TEST_MODE),
        joints(0),
        joints(1),
        torque(1, 1, 5),
        joints(2),
        torque(1, 2, 6),
        joints(3),
        torque(1, 3, 0),
        joints(4),
        heartbeat(1, 4, 14, Flags::TEST_MODE),
    ]
}

#[test]
fn the_same_again_is_equal_in_any_order_of_cells() {
    assert_eq!(counts(&rated(&run(), &run())), [3, 0, 0, 0]);
    // A late reply has the epoch of its joints.
    let mut late = run();
    late.swap(3, 4);
    assert_eq!(counts(&rated(&run(), &late)), [3, 0, 0, 0]);
    assert_eq!(counts(&rated(&late, &run())), [3, 0, 0, 0]);
}

#[test]
fn one_step_is_a_difference() {
    let mut now = run();
    now[5] = torque(1, 2, 7);
    let comparator = rated(&run(), &now);
    assert_eq!(counts(&comparator), [2, 1, 0, 0]);
    let first = comparator.first_difference().unwrap();
    assert_eq!(
        (first.how, first.when.map(|when| (when.joints, when.epoch))),
        (DifferenceKind::Different, Some((2, 2)))
    );
    assert!(first.text.ends_with("joint 1: 1 step higher (0.0002 Nm)"), "{first:?}");
}

#[test]
fn missing_and_extra_replies_are_distinguished() {
    let mut now = run();
    now.remove(5);
    let comparator = rated(&run(), &now);
    assert_eq!(
        (counts(&comparator), comparator.first_difference().unwrap().how),
        ([2, 0, 1, 0], DifferenceKind::Missing)
    );
    let mut now = run();
    now.insert(9, torque(1, 4, 9));
    let comparator = rated(&[&run()[..], &[joints(5)]].concat(), &now);
    assert_eq!(
        (counts(&comparator), comparator.first_difference().unwrap().how),
        ([3, 0, 0, 1], DifferenceKind::Extra)
    );
    // Two equal replies count as one, as for joints that were resent; two different ones do not.
    let mut now = run();
    now.insert(4, torque(1, 1, 5));
    assert_eq!(counts(&rated(&run(), &now)), [3, 0, 0, 0]);
    now[4] = torque(1, 1, 4);
    assert_eq!(counts(&rated(&run(), &now)), [3, 0, 0, 1]);
}

#[test]
fn what_the_recording_lost_is_not_blamed_on_the_cell() {
    // By its heartbeats the cell had sent one packet more.
    let mut lossy = run();
    lossy.remove(5);
    let comparator = rated(&lossy, &run());
    assert_eq!((counts(&comparator), comparator.tally.lacking.unrecorded), ([2, 0, 0, 0], 1));
    // The heartbeats explain no more losses than they count.
    lossy.remove(3);
    lossy[7] = heartbeat(1, 4, 13, Flags::TEST_MODE);
    let comparator = rated(&lossy, &run());
    assert_eq!((counts(&comparator), comparator.tally.lacking.unrecorded), ([1, 0, 0, 1], 1));
}

#[test]
fn joints_that_a_cell_did_not_take_then_explain_an_answer_now() {
    // The cell missed joints 3, and so sent the end of the contact one epoch later.
    let recording = [
        joints(0),
        heard(1, 0, 101),
        joints(1),
        torque(1, 1, 5),
        joints(2),
        torque(1, 2, 6),
        joints(3),
        joints(4),
        torque(1, 4, 0),
        joints(5),
        heard(1, 5, 105),
    ];
    let comparator = rated(&recording, &run());
    let UncomparedReplies { untaken, said_later, .. } = comparator.tally.lacking;
    assert_eq!((counts(&comparator), untaken, said_later), ([2, 0, 0, 0], 1, 1));
    let mut knows = recording;
    knows[10] = heard(1, 5, 106);
    assert_eq!(counts(&rated(&knows, &run())), [2, 0, 1, 1], "it took all, by its own counters");
}

#[test]
fn a_cell_that_was_silent_then_may_send_now() {
    let mut recording = run();
    recording.extend(std::iter::repeat_n(Message::Sync, 700));
    recording.extend([joints(5), joints(6)]);
    let now = [&run()[..], &[joints(5), torque(1, 5, 5), torque(2, 5, 1), joints(6)]].concat();
    let comparator = rated(&recording, &now);
    // The recording does not have cell 2.
    assert_eq!((counts(&comparator), comparator.tally.lacking.silent), ([3, 0, 0, 0], 2));
}

#[test]
fn the_end_of_a_recording_may_come_before_the_answers() {
    let recording = &run()[..7];
    let comparator = rated(recording, &run()[..8]);
    assert_eq!((counts(&comparator), comparator.tally.lacking.ended), ([2, 0, 0, 0], 1));
}

#[test]
fn answers_to_joints_that_were_not_recorded_are_named() {
    let mut recording = run();
    recording.remove(4);
    let comparator = rated(&recording, &run());
    assert_eq!(comparator.tally.lacking.joints_unrecorded, 1);
}

#[test]
fn a_cell_that_measured_is_not_compared() {
    let mut recording = run();
    recording[0] = heartbeat(1, 0, 10, Flags::default());
    let mut now = run();
    now[5] = torque(1, 2, 7);
    let comparator = rated(&recording, &now);
    assert_eq!((counts(&comparator), comparator.tally.lacking.measured), ([0, 0, 0, 0], 3));
}

#[test]
fn unrequested_sensors_frames_are_not_expected() {
    let says = |bits| {
        let contact = [protocol::fixed::Q5_10::from_bits(bits); 3];
        let skin = protocol::message::SkinSensors { contact, ..Default::default() };
        Message::Sensors { from: cell(1), epoch: Epoch(3), page: SensorPage::Skin(skin) }
    };
    let at = run().len() - 1;
    let mut recording = run();
    recording.insert(at, says(5));
    let comparator = rated(&recording, &run());
    assert_eq!(counts(&comparator), [3, 0, 1, 0], "it had been requested");
    let request = Request::Write { number: 7, words: [2, 0, 0, 0, 0, 0] };
    recording.insert(0, Message::Configure { to: Node::Everyone, tag: 0, request });
    let comparator = rated(&recording, &run());
    assert_eq!((counts(&comparator), comparator.tally.lacking.sensed_otherwise), ([3, 0, 0, 0], 1));
    let mut now = run();
    now.insert(at, says(6));
    assert_eq!(
        counts(&rated(&recording, &now)),
        [3, 1, 0, 0],
        "but what is sent at the same joints is compared"
    );
}

#[test]
fn the_contact_of_a_cell_before_its_first_joints_belongs_to_no_joints() {
    let sensors = |epoch| {
        let page = SensorPage::Acceleration([Q3_12::from_bits(4), Q3_12::ZERO, Q3_12::ZERO]);
        Message::Sensors { from: cell(1), epoch: Epoch(epoch), page }
    };
    // A report that was requested before the first joints, and answered after they were on the bus.
    let mut recording = run();
    recording.splice(2..2, [heard(1, 0, 0), sensors(0)]);
    assert_eq!(counts(&rated(&recording, &run())), [3, 0, 0, 0]);
    let late = |said: &[Message]| {
        let mut recording = recording.clone();
        recording.splice(5..5, said.iter().copied());
        counts(&rated(&recording, &run()))
    };
    // Its counters, its torque and another epoch show that it has received joints since.
    assert_eq!(late(&[heard(1, 0, 1), sensors(0)]), [3, 0, 1, 0]);
    assert_eq!(late(&[torque(1, 0, 0), sensors(0)]), [3, 0, 2, 0]);
    assert_eq!(late(&[heartbeat(1, 1, 12, Flags::TEST_MODE), sensors(1)]), [3, 0, 1, 0]);
    // For a cell that had received joints before, nothing changes.
    let mut recording = run();
    recording.splice(2..2, [heard(1, 0, 7), sensors(0)]);
    assert_eq!(counts(&rated(&recording, &run())), [3, 0, 1, 0]);
}

#[test]
fn joints_that_a_bus_did_not_take_have_no_answer() {
    let mut comparator = Comparator::new([("vcan0".to_owned(), BTreeMap::new())], 0, Some(0));
    comparator.set_muted(false);
    comparator.expect_joints(0, 1, Epoch(1), true);
    comparator.expect_message(0, &torque(1, 1, 5), true);
    comparator.announce_joints(0, Some(0), Epoch(1));
    comparator.mark_unsent(0, 0);
    comparator.finish(true);
    assert_eq!((counts(&comparator), comparator.tally.not_requested), ([0, 0, 0, 0], 1));
    assert!(!comparator.tally.has_only_equal_replies());
}

#[test]
fn answers_to_configure_are_compared_in_their_order() {
    let value = |number: P, word| Answer::Value {
        number: number.number(),
        written: true,
        words: [word, 0, 0, 0, 0, 0],
    };
    let says = |answer| Message::Configured { from: cell(1), tag: 3, answer };
    let recording =
        [joints(0), says(value(P::Pose, 1)), says(value(P::Identity, 1)), says(value(P::Pose, 2))];
    let now = [joints(0), says(value(P::Identity, 9)), says(value(P::Pose, 1)), says(value(P::Pose, 3))];
    let comparator = rated(&recording, &now);
    assert_eq!(counts(&comparator), [1, 1, 0, 0], "a cell's identity is not compared");
    let text = comparator.first_difference().unwrap().text.clone();
    assert!(text.contains("recorded  configured 1 tag 3: wrote pose"), "{text}");
}

#[test]
fn epochs_wrap_around_and_old_rounds_are_compared_on_the_way() {
    let mut all = Vec::new();
    for number in 0..1_000_i16 {
        let epoch = number.to_le_bytes()[0];
        all.extend([joints(epoch), torque(1, epoch, number)]);
    }
    let comparator = rated(&all, &all);
    assert_eq!(counts(&comparator), [1_000, 0, 0, 0]);
    let mut comparator = Comparator::new([("vcan0".to_owned(), BTreeMap::new())], 0, Some(0));
    for number in 0..1_000_u64 {
        let epoch = Epoch(number.to_le_bytes()[0]);
        comparator.expect_joints(0, number, epoch, true);
        comparator.announce_joints(0, Some(number), epoch);
        assert!(comparator.buses[0].rounds.len() <= 102);
    }
}

/// Cells 1 to 3 in a row; the first and the last are in contact.
fn row() -> Vec<Message> {
    let mut all = vec![
        heartbeat(1, 0, 10, Flags::TEST_MODE),
        heartbeat(2, 0, 10, Flags::TEST_MODE),
        heartbeat(3, 0, 10, Flags::TEST_MODE),
        tree(1, 0, Some(0)),
        tree(2, 0, Some(1)),
        tree(3, 0, Some(2)),
    ];
    for epoch in 0..6 {
        all.extend([joints(epoch), sum(3, epoch, 30, 1), sum(2, epoch, 30, 1)]);
        // The first sum came before the children's sums.
        all.extend([sum(1, epoch, 10, 1), sum(1, epoch, 40, 2)]);
    }
    all
}

/// Returns the messages of [`row`] with cells side by side, all of them roots.
fn beside(own: [i16; 2]) -> Vec<Message> {
    let mut all = row();
    all[4] = tree(2, 0, Some(0));
    all[5] = tree(3, 0, Some(0));
    all.truncate(6);
    for epoch in 0..6 {
        all.extend([joints(epoch), sum(1, epoch, own[0], 1), sum(3, epoch, own[1], 1)]);
    }
    all
}

#[test]
fn sums_less_their_children_are_equal_in_another_tree() {
    let comparator = rated(&row(), &row());
    assert_eq!((counts(&comparator), comparator.tally.sums), ([18, 0, 0, 0], 18), "all three sent");
    let comparator = rated(&row(), &beside([10, 30]));
    assert_eq!(
        (counts(&comparator), comparator.tally.sums),
        ([12, 0, 0, 0], 12),
        "{:?}",
        comparator.first_difference()
    );
    assert!(comparator.tally.has_only_equal_replies());
    let comparator = rated(&row(), &beside([11, 29]));
    assert_eq!(counts(&comparator), [12, 0, 0, 0], "one step is rounding");
}

#[test]
fn a_sum_that_differs_is_shown_with_its_children() {
    let comparator = rated(&row(), &beside([16, 30]));
    assert_eq!(counts(&comparator), [6, 6, 0, 0]);
    let text = comparator.first_difference().unwrap().text.clone();
    let expected = "the first difference: cell 1 on vcan0, joints message 0 (epoch 0, 0.007 s into the recording)
  recorded  sum 1 epoch 0: 0.156 0.000 0.000 0.000 0.000 0.000 Nm, cells 2; without its child 2: 0.039 0.000 0.000 0.000 0.000 0.000 Nm
  now       sum 1 epoch 0: 0.062 0.000 0.000 0.000 0.000 0.000 Nm, cells 1; without children: 0.062 0.000 0.000 0.000 0.000 0.000 Nm
  joint 1: 6 steps higher (0.0234 Nm)";
    assert_eq!(text, expected);
}

#[test]
fn a_cell_that_adds_nothing_any_more_is_missing() {
    let mut now = beside([10, 30]);
    now.retain(
        |message| !matches!(message, Message::Sum { from, epoch, .. } if from.get() == 3 && epoch.0 == 4),
    );
    let comparator = rated(&row(), &now);
    // It is unknown whether the parent received it then.
    assert_eq!(
        (counts(&comparator), comparator.first_difference().unwrap().how),
        ([11, 0, 1, 0], DifferenceKind::Missing)
    );
}

#[test]
fn a_cell_that_stopped_without_the_end_did_not_come_to_its_slot() {
    let mut late = row();
    let silent = |epoch| move |message: &Message| matches!(message, Message::Sum { from, epoch: of, .. } if from.get() == 1 && of.0 == epoch);
    late.retain(|message| !silent(3)(message));
    let comparator = rated(&late, &row());
    assert_eq!((counts(&comparator), comparator.tally.lacking.slot_skipped), ([17, 0, 0, 0], 1));
    // Before a contact can begin, a cell that had sent the end would have had to send the beginning.
    let mut ended = row();
    ended.retain(|message| !silent(2)(message) && !silent(3)(message));
    let at = ended.iter().position(|message| *message == joints(3)).unwrap();
    ended.insert(at, sum(1, 2, 0, 0));
    let comparator = rated(&ended, &row());
    assert_eq!(
        (comparator.tally.extra, comparator.tally.lacking.slot_skipped),
        (1, 0),
        "{:?}",
        comparator.tally
    );
}

#[test]
fn a_cell_that_changes_its_parent_is_omitted_in_that_epoch_and_counted() {
    let mut now = row();
    let at = now.iter().position(|message| *message == joints(3)).unwrap();
    // After joints 2: from joints 3 on, cell 3 is a root.
    now.insert(at, tree(3, 2, Some(0)));
    for message in &mut now[at..] {
        if let Message::Sum { from, epoch, .. } = *message {
            *message = match from.get() {
                1 => sum(1, epoch.0, 10, 1),
                2 => Message::Sync,
                _ => *message,
            };
        }
    }
    let comparator = rated(&row(), &now);
    // Cells 2 and 3 in the epochs before and after the change; later, cell 2 has nothing to forward.
    assert_eq!((comparator.tally.lacking.parent_changing, counts(&comparator)), (4, [6 + 2 + 4, 0, 0, 0]));
    assert!(comparator.tally.has_only_equal_replies());
}

#[test]
fn without_a_tree_nothing_is_compared_and_that_is_no_success() {
    let mut lost = row();
    lost.remove(5);
    let comparator = rated(&lost, &row());
    assert_eq!((counts(&comparator), comparator.tally.lacking.tree_unknown), ([0, 0, 0, 0], 18));
    assert!(!comparator.tally.has_only_equal_replies());
}

#[test]
fn joints_that_are_retried_have_the_sums_of_the_last_time() {
    let mut comparator = Comparator::new([("vcan0".to_owned(), BTreeMap::new())], 0, Some(0));
    comparator.set_muted(false);
    for message in &row()[3..6] {
        comparator.expect_message(0, message, true);
        comparator.observe_message(0, message);
    }
    comparator.observe_message(0, &heartbeat(1, 0, 0, Flags::TEST_MODE));
    comparator.expect_joints(0, 1, Epoch(7), true);
    comparator.expect_message(0, &sum(1, 7, 40, 1), true);
    comparator.announce_joints(0, Some(0), Epoch(7));
    comparator.observe_message(0, &sum(1, 7, 90, 2));
    assert_eq!(comparator.missing_reply_count(0, 0), 0);
    comparator.announce_joints(0, Some(0), Epoch(6));
    assert_eq!(comparator.missing_reply_count(0, 0), 1);
    comparator.observe_message(0, &sum(1, 7, 90, 2));
    comparator.observe_message(0, &sum(1, 6, 40, 1));
    assert_eq!(comparator.missing_reply_count(0, 0), 0);
    comparator.finish(true);
    assert_eq!(counts(&comparator), [1, 0, 0, 0]);
}

mod claims;
mod lockstep;
mod tolerance;
