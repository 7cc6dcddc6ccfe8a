//! Tests on constructed captures with one or two cells, whose joints, stimuli and torques are lost, changed and moved.

use super::*;
use model::testing::ONE_CELL_SKIN_TOML;
use protocol::fixed::{Q1_14, Q5_10};
use protocol::id::Node;
use protocol::message::{Heartbeat, NetworkPage, SensorPage, SkinSensors, State, StimulusStart};
use protocol::packet::{Epoch, pad_with_defaults, padded_words};

mod property;

const PERIOD: u64 = 16_000_000;
const BEGAN: u64 = 1_700_000_000_000_000_000;

pub(super) type Frames = Vec<(u64, &'static str, Message)>;

pub(super) fn skin() -> Skin {
    Skin::parse("skin.toml", ONE_CELL_SKIN_TOML).unwrap()
}

/// Returns a skin with two buses with one cell each; the second answers with sums.
fn two_buses() -> Skin {
    let (head, cell) = ONE_CELL_SKIN_TOML.split_once("[[cell]]").unwrap();
    let cell = cell.replace("bus = \"vcan0\"", "bus = \"vcan1\"") + "root = true\n";
    let bus = "[[bus]]\nname = \"vcan1\"\nreply = \"sum\"\nslot_us = 500\nformat = \"fd\"\n\n[controller]";
    let head = head.replace("[controller]", bus);
    let first = ONE_CELL_SKIN_TOML.split_once("[[cell]]").unwrap().1;
    Skin::parse("skin.toml", &format!("{head}[[cell]]{first}\n[[cell]]{cell}")).unwrap()
}

pub(super) fn cell(node: i64) -> CellId {
    CellId::new(node).unwrap()
}

pub(super) fn epoch(number: u64) -> Epoch {
    Epoch(u8::try_from(number % 256).unwrap())
}

/// Returns the time of the joints with this number.
pub(super) fn at(number: u64) -> u64 {
    BEGAN + number * PERIOD
}

pub(super) fn joints(number: u64) -> Message {
    let word = i16::try_from(number * 7 % 30_000).unwrap();
    let positions = pad_with_defaults(&[Q1_14::from_bits(word), Q1_14::from_bits(-word)]);
    Message::Joints { epoch: epoch(number), joints: protocol::message::Joints { positions, in_use: 6 } }
}

pub(super) fn torque(node: i64, number: u64, word: i16) -> Message {
    Message::Torque { from: cell(node), epoch: epoch(number), torque: padded_words([3, word]).into() }
}

fn heartbeat(skin: &Skin, sent: u16) -> Message {
    let configuration = skin.parameters(&skin.cells[0]).hash();
    let state =
        State::CONFIGURED.with_flags(State::TEST_MODE, true).with_flags(State::CLAIMING_NODE_ID, sent == 0);
    let page = NetworkPage::Heartbeat(Heartbeat { configuration, state, sent, ..Heartbeat::default() });
    Message::Network { from: Node::Cell(cell(1)), epoch: Epoch(0), page }
}

fn press(from: StimulusStart, newtons: f64) -> Message {
    let contact = [Q5_10::nearest(newtons); 3];
    let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
    Message::Stimulus { to: Node::Cell(cell(1)), from, page }
}

/// Returns a run: a heartbeat, then joints, each with a torque 1 ms later; cell 1 is pressed from joints 5 on.
fn run(skin: &Skin, numbers: std::ops::Range<u64>) -> Frames {
    // The contact state of a cell that has just started is known.
    let sent = if numbers.start == 0 { 0 } else { 500 };
    let mut frames = vec![(at(numbers.start) - 20_000_000, "vcan0", heartbeat(skin, sent))];
    for number in numbers {
        if number == 5 {
            frames.push((at(5) - 1_000_000, "vcan0", press(StimulusStart::Epoch(Epoch(5)), 1.0)));
        }
        frames.push((at(number), "vcan0", joints(number)));
        if number >= 5 {
            frames.push((at(number) + 1_000_000, "vcan0", torque(1, number, 100)));
        }
    }
    frames
}

/// Reads two captures in lockstep; also returns the maximum number of joints that were held.
pub(super) fn read<'a>(
    skin: &'a Skin,
    (options, starts): (CompareOptions, PerCapture<Option<u64>>),
    a: &Frames,
    b: &Frames,
) -> (Comparison<'a>, usize) {
    let mut comparison = Comparison::new(skin, options, starts);
    let mut frames = PerCapture { a: a.iter(), b: b.iter() };
    let mut held = 0;
    while let Some(which) = comparison.next_side() {
        match frames.get_mut(which).next() {
            Some((nanos, bus, message)) => comparison.receive(which, *nanos, bus, Some(message)),
            None => comparison.end_capture(which, false),
        }
        held = held.max(comparison.held());
    }
    (comparison, held)
}

fn compared(skin: &Skin, options: CompareOptions, a: &Frames, b: &Frames) -> CompareReport {
    read(skin, (options, PerCapture::default()), a, b).0.report()
}

fn equal(skin: &Skin, a: &Frames, b: &Frames) -> CompareReport {
    compared(skin, CompareOptions::default(), a, b)
}

/// Returns the frames with the first message that satisfies `is` replaced by `to`, or removed.
fn changed(frames: &Frames, is: impl Fn(&Message) -> bool, to: Option<Message>) -> Frames {
    let mut frames = frames.clone();
    let at = frames.iter().position(|(_, _, message)| is(message)).unwrap();
    match to {
        Some(to) => frames[at].2 = to,
        None => drop(frames.remove(at)),
    }
    frames
}

fn is_torque_of(number: u64) -> impl Fn(&Message) -> bool {
    move |message| matches!(message, Message::Torque { epoch: it, .. } if *it == epoch(number))
}

#[test]
fn the_same_run_is_equal_whenever_it_was_and_however_late_it_answered() {
    let skin = skin();
    let a = run(&skin, 0..600);
    let b: Frames = a
        .iter()
        .map(|(nanos, bus, message)| {
            let late = u64::from(matches!(message, Message::Torque { .. })) * 17_000_000;
            (nanos + 5_000_000_000 + late, *bus, *message)
        })
        .collect();
    let mut b = b;
    b.sort_by_key(|(nanos, ..)| *nanos);
    let report = equal(&skin, &a, &b);
    assert!(report.equal && report.first.is_none(), "{report:?}");
    assert_eq!((report.epochs.compared, report.torques.equal), (600, 595));
    assert_eq!(report.epochs, EpochCounts { compared: 600, ..EpochCounts::default() });
    // The last torque arrived after the last joints.
    assert_eq!((report.captures.a.late, report.captures.b.late), (0, 594));
    let [a, b] = [report.captures.a.reply_us.unwrap().p50, report.captures.b.reply_us.unwrap().p50];
    assert!((a - 1e3).abs() < 10.0 && (b - 18e3).abs() < 100.0, "{a} {b}");
}

#[test]
fn a_word_that_is_one_step_off_is_found_and_explained() {
    let skin = skin();
    let a = run(&skin, 0..300);
    let b = changed(&a, is_torque_of(14), Some(torque(1, 14, 101)));
    let report = equal(&skin, &a, &b);
    let first = report.first.clone().unwrap();
    assert_eq!(report.differs, ["torques"]);
    assert_eq!((report.torques.different, report.torques.different_with_same_inputs), (1, 1));
    assert_eq!((first.what, first.how, first.cell, first.joint), ("torque", "different", Some(1), Some(2)));
    assert_eq!((first.epoch, first.number), (14, 14));
    // Joints 270 have this epoch, too.
    let mut late = a.clone();
    let at_270 = late.iter().rposition(|(_, _, message)| is_torque_of(270)(message)).unwrap();
    late[at_270].2 = torque(1, 270, 98);
    let report = equal(&skin, &a, &late);
    let first = report.first.unwrap();
    assert_eq!((first.epoch, first.number), (14, 270));
    assert_eq!(first.occurrence, PerCapture { a: Some(2), b: Some(2) });
    assert_eq!(first.words, PerCapture { a: Some(100), b: Some(98) });
    assert_eq!(
        (first.steps, first.inputs.as_slice(), first.unknown_inputs.as_slice()),
        (Some(2), &[][..], &[][..])
    );
    assert!((first.time_s.a.unwrap() - 4.32).abs() < 1e-9);
    let tolerant =
        |tolerance| compared(&skin, CompareOptions { tolerance, ..CompareOptions::default() }, &a, &late);
    assert!(tolerant(2).equal && tolerant(2).torques.tolerated == 1);
    assert!(!tolerant(1).equal);
}

#[test]
fn an_input_that_differs_is_named() {
    let skin = skin();
    let a = run(&skin, 0..40);
    // Another force, and so another torque.
    let b = changed(
        &a,
        |it| matches!(it, Message::Stimulus { .. }),
        Some(press(StimulusStart::Epoch(Epoch(5)), 2.0)),
    );
    let b = changed(&b, is_torque_of(5), Some(torque(1, 5, 200)));
    let first = equal(&skin, &a, &b).first.unwrap();
    assert_eq!((first.number, first.inputs.as_slice()), (5, &["stimulus"][..]));
    // The touch arrives an epoch later: a contact that only A has, and its torque.
    let b = changed(
        &a,
        |it| matches!(it, Message::Stimulus { .. }),
        Some(press(StimulusStart::Epoch(Epoch(6)), 1.0)),
    );
    let b = changed(&b, is_torque_of(5), None);
    let report = equal(&skin, &a, &b);
    assert_eq!(report.differs, ["contacts", "torques"]);
    assert_eq!((report.contacts.both, report.contacts.only), (34, UnpairedCounts { only_a: 1, only_b: 0 }));
    let first = report.first.unwrap();
    assert_eq!((first.what, first.how, first.number), ("contact", "missing in b", 5));
    // Other joints.
    let b = changed(&a, |it| *it == joints(9), Some(joints(10)));
    let Message::Joints { joints: other, .. } = joints(10) else { panic!() };
    let b = changed(&b, |it| *it == joints(10), Some(Message::Joints { epoch: Epoch(9), joints: other }));
    let report = equal(&skin, &a, &b);
    assert_eq!((report.differs.as_slice(), report.joints.max_steps), (&["joints"][..], 7));
    let first = report.first.unwrap();
    assert_eq!((first.what, first.number, first.joint, first.unit), ("joints", 9, Some(1), Some("rad")));
    let options = CompareOptions { joints_tolerance: 7, ..CompareOptions::default() };
    assert!(compared(&skin, options, &a, &b).equal);
}

#[test]
fn a_restart_in_one_of_them_is_an_input() {
    let skin = skin();
    let a = run(&skin, 0..80);
    let mut b = a.clone();
    // The cell restarted after joints 39, and knows of no touch.
    let place = b.iter().position(|(_, _, it)| *it == joints(40)).unwrap();
    b.retain(|(_, _, it)| !(40..80).any(|number| is_torque_of(number)(it)));
    b.insert(place, (at(40) - 2_000_000, "vcan0", heartbeat(&skin, 90)));
    b.insert(place + 1, (at(40) - 1_000_000, "vcan0", heartbeat(&skin, 0)));
    let report = equal(&skin, &a, &b);
    assert_eq!(report.captures.b.restarts, 1);
    assert_eq!((report.torques.missing_in_b, report.torques.open), (36, 4));
    assert_eq!(report.contacts.only.only_a, 40);
    let first = report.first.unwrap();
    assert_eq!((first.what, first.number), ("contact", 40));
    assert_eq!(first.inputs, ["restart"]);
}

#[test]
fn missing_replies_count_but_for_those_that_the_end_left_open() {
    let skin = skin();
    let a = run(&skin, 0..100);
    let b = changed(&changed(&a, is_torque_of(50), None), is_torque_of(98), None);
    let report = equal(&skin, &a, &b);
    assert_eq!((report.torques.missing_in_b, report.torques.open, report.torques.equal), (1, 1, 93));
    assert_eq!(report.first.as_ref().map(|it| (it.how, it.number)), Some(("missing in b", 50)));
    assert_eq!(report.cells.iter().map(|row| row.node).collect::<Vec<_>>(), [1]);
    let report = equal(&skin, &b, &a);
    assert_eq!((report.torques.missing_in_a, report.differs.as_slice()), (1, &["torques"][..]));
    let options = CompareOptions { missing: 1, ..CompareOptions::default() };
    assert!(compared(&skin, options, &a, &b).equal);
    // The first difference is one that counts.
    let b = changed(&b, is_torque_of(60), Some(torque(1, 60, 7)));
    assert_eq!(compared(&skin, options, &a, &b).first.map(|it| it.number), Some(60));
    assert_eq!(equal(&skin, &a, &b).first.map(|it| it.number), Some(50));
}

#[test]
fn what_one_has_before_and_after_the_other_is_no_difference_but_a_missing_epoch_is() {
    let skin = skin();
    let a = run(&skin, 0..600);
    let b = run(&skin, 100..500);
    let report = equal(&skin, &a, &b);
    assert!(report.equal, "{report:?}");
    let (before, after) =
        (UnpairedCounts { only_a: 100, only_b: 0 }, UnpairedCounts { only_a: 100, only_b: 0 });
    assert_eq!((report.epochs.before, report.epochs.after, report.epochs.compared), (before, after, 400));
    let b = changed(&b, |it| *it == joints(256), None);
    let report = equal(&skin, &a, &b);
    assert_eq!((report.differs.as_slice(), report.epochs.missing_in_b), (&["epochs"][..], 1));
    let first = report.first.unwrap();
    assert_eq!((first.what, first.how, first.number, first.epoch), ("epoch", "missing in b", 256, 0));
    assert_eq!(first.time_s.b, None);
    // A recording that was cut off lacks joints that the other one has.
    let mut comparison = Comparison::new(&skin, CompareOptions::default(), PerCapture::default());
    for (which, frames) in [(CaptureSide::A, &a), (CaptureSide::B, &run(&skin, 0..300))] {
        frames.iter().for_each(|(nanos, bus, message)| comparison.receive(which, *nanos, bus, Some(message)));
    }
    comparison.end_capture(CaptureSide::B, true);
    comparison.end_capture(CaptureSide::A, false);
    let report = comparison.report();
    assert_eq!((report.differs.as_slice(), report.epochs.missing_in_b), (&["epochs"][..], 300));
}

#[test]
fn joints_that_are_lost_for_more_than_256_epochs_do_not_move_what_follows() {
    let skin = skin();
    let a = run(&skin, 0..2_000);
    for lost in [200, 255, 257, 300, 512, 900] {
        let gone = |number: u64| (700..700 + lost).contains(&number);
        let mut b = a.clone();
        b.retain(|(nanos, ..)| *nanos < at(0) || !gone((nanos + 2_000_000 - BEGAN) / PERIOD));
        let report = equal(&skin, &a, &b);
        // The joints after 255 lost ones have the epoch of those before: they count as repeated.
        let more = u64::from(lost == 255);
        assert_eq!(report.epochs.missing_in_b, lost + more, "{lost}");
        assert_eq!((report.joints.different, report.torques.different), (0, 0), "{lost}");
        assert_eq!(report.differs, ["epochs"], "{lost}");
    }
}

#[test]
fn a_capture_without_a_common_epoch_is_different_and_extra_cells_are_named() {
    let skin = skin();
    let report = equal(&skin, &run(&skin, 0..10), &run(&skin, 100..120));
    assert_eq!((report.equal, report.epochs.compared), (false, 0));
    let a = run(&skin, 0..50);
    let mut b = a.clone();
    b.push((at(49) + 2_000_000, "vcan0", torque(9, 49, 1)));
    let report = equal(&skin, &a, &b);
    let extra = ExtraCell { bus: "vcan0".to_owned(), node: 9, only_in: "b" };
    assert_eq!((report.differs.as_slice(), report.extra_cells.as_slice()), (&["cells"][..], &[extra][..]));
}

#[test]
fn buses_are_compared_each_and_sums_by_their_roots() {
    let skin = two_buses();
    let sum = |number, word: i16, count| Message::Sum {
        from: cell(1),
        epoch: epoch(number),
        torque: padded_words([word]).into(),
        count,
    };
    let mut a = Frames::new();
    for number in 0..300 {
        a.push((at(number), "vcan0", joints(number)));
        a.push((at(number) + 10, "vcan1", joints(number)));
        a.push((at(number) + 1_000, "vcan0", torque(1, number, 5)));
        // The first sum does not include all cells yet.
        a.push((at(number) + 2_000, "vcan1", sum(number, 3, 1)));
        a.push((at(number) + 3_000, "vcan1", sum(number, 9, 2)));
    }
    let report = equal(&skin, &a, &a);
    assert!(report.equal, "{report:?}");
    assert_eq!((report.epochs.compared, report.sums.equal, report.torques.equal), (600, 300, 300));
    let of = |number: u64| move |it: &Message| matches!(it, Message::Sum { epoch: e, count: 2, .. } if *e == epoch(number));
    let b = changed(&a, of(30), Some(sum(30, 10, 2)));
    let report = equal(&skin, &a, &b);
    assert_eq!((report.differs.as_slice(), report.sums.different), (&["sums"][..], 1));
    let first = report.first.unwrap();
    assert_eq!((first.what, first.bus.as_str(), first.steps), ("sum", "vcan1", Some(1)));
    let values = (first.values.a.unwrap(), first.values.b.unwrap());
    assert!((values.1 - values.0 - 1.0 / 256.0).abs() < 1e-12);
    assert!(compared(&skin, CompareOptions { tolerance: 1, ..CompareOptions::default() }, &a, &b).equal);
    // A sum that lacks a cell is different, even with the same words.
    let b = changed(&a, of(30), Some(sum(30, 9, 3)));
    let first = equal(&skin, &a, &b).first.unwrap();
    assert!(first.inputs.contains(&"cells"), "{first:?}");
    // One bus was down for a while: its joints are missing, and those of the other one are compared.
    let mut b = a.clone();
    b.retain(|(nanos, bus, _)| *bus == "vcan0" || !(at(20)..at(290)).contains(nanos));
    let report = equal(&skin, &a, &b);
    assert_eq!((report.epochs.missing_in_b, report.epochs.compared, report.torques.equal), (270, 330, 300));
    // The first difference is the earliest one, on any bus.
    let first = report.first.unwrap();
    assert_eq!((first.what, first.bus.as_str(), first.number), ("epoch", "vcan1", 20));
}

#[test]
fn few_joints_are_held_however_long_the_captures_are() {
    let skin = skin();
    let a = run(&skin, 0..12_000);
    let mut b = a.clone();
    b.retain(|(nanos, ..)| !(at(3_000)..at(6_000)).contains(nanos));
    // The cell is touched but does not answer.
    b.retain(|(nanos, _, it)| *nanos < at(8_000) || !matches!(it, Message::Torque { .. }));
    let (comparison, held) = read(&skin, (CompareOptions::default(), PerCapture::default()), &a, &b);
    assert!(held <= 80, "{held} joints were held");
    let report = comparison.report();
    assert_eq!((report.epochs.missing_in_b, report.torques.missing_in_b), (3_000, 3_996));
    // One bus is silent for a long time, and one for ever.
    let skin = two_buses();
    let both = (0..9_000).flat_map(|number| {
        [(at(number), "vcan0", joints(number)), (at(number) + 10, "vcan1", joints(number))]
    });
    let a: Frames = both.collect();
    for end in [5_000, 9_000] {
        let mut b = a.clone();
        b.retain(|(nanos, bus, _)| *bus == "vcan1" || !(at(1_000)..at(end)).contains(nanos));
        let (comparison, held) = read(&skin, (CompareOptions::default(), PerCapture::default()), &a, &b);
        assert!(held <= 300, "{held} joints were held");
        let report = comparison.report();
        assert_eq!((report.epochs.missing_in_b, report.epochs.compared), (end - 1_000, 19_000 - end));
    }
}

#[test]
fn a_part_is_put_where_its_joints_are() {
    let skin = skin();
    let trace = |frames: &Frames| {
        let mut trace = JointTrace::new(&skin);
        frames.iter().for_each(|(nanos, bus, message)| trace.record_message(*nanos, bus, message));
        trace
    };
    let a = run(&skin, 0..2_000);
    for first in [1, 100, 256, 300, 1_000, 1_900] {
        let b = run(&skin, first..2_000);
        let starts = first_joints_numbers(&trace(&a), &trace(&b));
        assert_eq!(starts, PerCapture { a: Some(0), b: Some(first) });
        let report = read(&skin, (CompareOptions::default(), starts), &a, &b).0.report();
        assert_eq!((report.equal, report.epochs.before.only_a), (true, first));
        assert_eq!(report.captures.b.first, Some(first));
    }
    // If all joints are equal, only the epochs count.
    let standing = |frames: &Frames| -> Frames {
        let same = |message: &Message| {
            let (Message::Joints { epoch, .. }, Message::Joints { joints, .. }) = (*message, joints(0))
            else {
                return *message;
            };
            Message::Joints { epoch, joints }
        };
        frames.iter().map(|(nanos, bus, message)| (*nanos, *bus, same(message))).collect()
    };
    let found = first_joints_numbers(&trace(&standing(&a)), &trace(&standing(&run(&skin, 300..900))));
    assert_eq!(found, PerCapture { a: Some(0), b: Some(44) });
}

#[test]
fn a_capture_of_another_skin_is_known_by_its_buses_joints_and_configurations() {
    let skin = skin();
    let a = run(&skin, 0..10);
    let not_found = |b: &Frames| {
        read(&skin, (CompareOptions::default(), PerCapture::default()), &a, b)
            .0
            .not_found_reason(CaptureSide::B)
    };
    assert_eq!(not_found(&a), None);
    let elsewhere: Frames = a.iter().map(|(nanos, _, message)| (*nanos, "can9", *message)).collect();
    assert!(matches!(not_found(&elsewhere), Some(JointsNotFound::Buses { .. })));
    assert!(matches!(not_found(&a[..1].to_vec()), Some(JointsNotFound::Joints { .. })));
    let mut robot = a.clone();
    for (.., message) in &mut robot {
        if let Message::Joints { joints, .. } = message {
            joints.in_use = 5;
        }
    }
    assert!(matches!(not_found(&robot), Some(JointsNotFound::Robot { came: 5, chain: 6, .. })));
    let other = changed(&a, |_| true, None);
    let page = NetworkPage::Heartbeat(Heartbeat { configuration: 77, ..Heartbeat::default() });
    let mut configured = other;
    configured.insert(
        0,
        (at(0) - 5, "vcan0", Message::Network { from: Node::Cell(cell(1)), epoch: Epoch(0), page }),
    );
    let comparison = read(&skin, (CompareOptions::default(), PerCapture::default()), &a, &configured).0;
    assert_eq!(comparison.reported_and_matching_cells(CaptureSide::A), None);
    assert_eq!(comparison.reported_and_matching_cells(CaptureSide::B), Some((1, 0)));
}
