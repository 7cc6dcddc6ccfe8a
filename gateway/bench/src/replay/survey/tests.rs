use protocol::candump::Timestamp;
use protocol::message::{Heartbeat, ReceivedCounts};

use super::*;

#[test]
fn counters_that_cannot_be_of_one_life_account_for_no_joints() {
    let mut cell = SurveyedCell::new(0, None);
    let mut report = |joints, after, last| {
        cell.add_counters(ReceivedCounts { joints, ..ReceivedCounts::default() }, Some((after, last)));
        (cell.untaken, cell.accounted.clone())
    };
    assert_eq!(report(0, 100, 10), (0, vec![]));
    // An old heartbeat looked like a restart, and then the cell's own counters came.
    assert_eq!(report(2_000, 150, 20), (0, vec![]));
    assert_eq!(report(2_040, 200, 30), (10, vec![(20, 30)]));
    assert_eq!(report(2_090, 250, 40), (10, vec![(20, 40)]));
}

#[test]
fn a_part_has_counters_elsewhere_though_one_of_its_buses_began_lost() {
    let torque = Message::Torque { from: CellId::new(1).unwrap(), epoch: Epoch(3), torque: [0; 6].into() };
    let frames: Vec<_> = torque.encode().frames(Format::Fd).collect();
    let time = Timestamp { nanos: 5, nine_digits: true, min_digits: 0 };
    let of = |latched: &[LatchedFrame]| {
        let mut survey = Survey::new(TimeRange::default());
        survey.add_latched_frames(latched);
        for interface in ["vcan0", "vcan1"] {
            survey.add_frame(&Record { time, interface, frame: frames[0], direction: None });
        }
        survey.finish();
        let buses = survey.buses.iter().filter(|bus| !bus.cells.is_empty());
        buses.map(|bus| bus.cells.values().next().unwrap().is_covered_by_counters(5)).collect::<Vec<_>>()
    };
    assert_eq!(of(&[]), [true, true], "a log of a bench that has no counters");
    let frame = Message::Resume.encode().frames(Format::Fd).next().unwrap();
    let latched = LatchedFrame { bus: "vcan0".into(), own: true, frame, nanos: 1 };
    assert_eq!(of(&[latched]), [false, false]);
}

/// A bus on which one cell sends a page of counters after some joints, 16 ms apart.
struct CountingBus(Survey, u64);

impl CountingBus {
    fn take(&mut self, message: &Message) {
        for frame in message.encode().frames(Format::Fd) {
            let time = Timestamp { nanos: self.1, nine_digits: true, min_digits: 0 };
            self.0.add_frame(&Record { time, interface: "vcan0", frame, direction: None });
        }
    }

    fn joints(&mut self, epochs: core::ops::RangeInclusive<u8>) {
        for epoch in epochs {
            self.1 += 16_000_000;
            self.take(&Message::Joints {
                epoch: Epoch(epoch),
                joints: Joints { in_use: 6, ..Joints::default() },
            });
        }
    }

    fn page(&mut self, epoch: u8, page: NetworkPage) -> u64 {
        let from = CellId::new(1).unwrap();
        self.take(&Message::Network { from: Node::Cell(from), epoch: Epoch(epoch), page });
        self.0.buses[0].cells[&from].untaken
    }

    fn heard(&mut self, epoch: u8, joints: u16) -> u64 {
        self.page(epoch, NetworkPage::Received(ReceivedCounts { joints, ..ReceivedCounts::default() }))
    }
}

#[test]
fn a_page_counts_up_to_the_joints_that_it_names() {
    let mut bus = CountingBus(Survey::new(TimeRange::default()), 0);
    bus.joints(1..=10);
    assert_eq!(bus.heard(8, 700), 0);
    bus.joints(11..=20);
    assert_eq!(bus.heard(20, 712), 0, "of the twelve after epoch 8 it took all");
    bus.joints(21..=30);
    assert_eq!(bus.heard(29, 720), 1, "of the nine until epoch 29 it took eight");
    assert_eq!(bus.heard(30, 721), 1);
}

#[test]
fn a_cell_may_have_taken_joints_before_its_first_heartbeat() {
    let mut bus = CountingBus(Survey::new(TimeRange::default()), 0);
    let heartbeat = |sent, state| NetworkPage::Heartbeat(Heartbeat { sent, state, ..Heartbeat::default() });
    bus.joints(1..=10);
    bus.page(10, heartbeat(900, Flags::default()));
    bus.joints(11..=20);
    bus.page(20, heartbeat(0, Flags::CLAIMING_NODE_ID));
    bus.joints(21..=30);
    // The cell began with epoch 15 and received all joints but three; which three is unknown.
    assert_eq!(bus.heard(30, 13), 4);
}

#[test]
fn a_heartbeat_from_before_a_commit_is_answered_is_not_of_the_part_that_begins_with_it() {
    let cell = CellId::new(1).unwrap();
    let commit = Parameter::Commit.number();
    let write = Message::Configure {
        to: Node::Cell(cell),
        tag: 1,
        request: Request::Write { number: commit, words: [0; 6] },
    };
    let answer = |answer| Message::Configured { from: cell, tag: 1, answer };
    let (written, refused) = (
        answer(Answer::Value { number: commit, written: true, words: [0; 6] }),
        answer(Answer::Refused { number: commit, reason: Answer::REFUSED_WRONG_HASH }),
    );
    let heartbeat = |configuration, sent| {
        NetworkPage::Heartbeat(Heartbeat { configuration, sent, ..Heartbeat::default() })
    };
    let hash = |answer: Option<&Message>, pause, heartbeats: [u16; 2]| {
        // The part begins between the commit and its answer.
        let mut bus = CountingBus(Survey::new(TimeRange { from: Some(1_000), to: None }), 0);
        bus.take(&write);
        bus.1 = pause;
        bus.page(0, heartbeat(heartbeats[0], 10));
        bus.1 += 1_000;
        if let Some(answer) = answer {
            bus.take(answer);
        }
        bus.page(0, heartbeat(heartbeats[1], 11 + u16::from(answer.is_some())));
        bus.0.buses[0].cells[&cell].hash
    };
    assert_eq!(hash(Some(&written), 2_000, [7, 9]), InitialValue::Value(9));
    assert_eq!(hash(Some(&refused), 2_000, [7, 7]), InitialValue::Value(7));
    assert_eq!(hash(None, 2_000, [7, 7]), InitialValue::No, "the commit may still come");
    assert_eq!(hash(None, COMMIT_TIMEOUT_NS + 1_000, [7, 7]), InitialValue::Value(7), "it was lost");
    // A commit of the part itself: the part begins with the former configuration.
    let mut bus = CountingBus(Survey::new(TimeRange::default()), 0);
    bus.page(0, heartbeat(7, 10));
    for message in [&write, &written] {
        bus.take(message);
    }
    bus.page(0, heartbeat(9, 12));
    assert_eq!(bus.0.buses[0].cells[&cell].hash, InitialValue::Value(7));
}
