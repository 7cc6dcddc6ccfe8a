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

/// Surveys a bus on which cell 1 is told to commit, and returns its hash where the part from 1 µs on begins. Steps: `h`
/// and `H`, a heartbeat with the former and the new configuration; `c` and `C`, a commit to the cell and to every cell;
/// `a` and `r`, its answer, written and refused; `|`, the begin of the part. Latched messages are before a `~`.
fn hash_after(steps: &str) -> InitialValue<u16> {
    let (cell, commit) = (CellId::new(1).unwrap(), Parameter::Commit.number());
    let to_commit =
        |to| Message::Configure { to, tag: 1, request: Request::Write { number: commit, words: [0; 6] } };
    let answer = |answer| Message::Configured { from: cell, tag: 1, answer };
    let (latched, steps) = steps.split_once('~').unwrap_or(("", steps));
    let mut bus =
        CountingBus(Survey::new(TimeRange { from: (!steps.starts_with('|')).then_some(1_000), to: None }), 0);
    let mut sent = 10;
    let mut message_of = |step| {
        sent += u16::from("hHar".contains(step));
        let heartbeat = |configuration| Message::Network {
            from: Node::Cell(cell),
            epoch: Epoch(0),
            page: NetworkPage::Heartbeat(Heartbeat { configuration, sent: sent - 1, ..Heartbeat::default() }),
        };
        match step {
            'h' => heartbeat(7),
            'H' => heartbeat(9),
            'c' => to_commit(Node::Cell(cell)),
            'C' => to_commit(Node::Everyone),
            'a' => answer(Answer::Value { number: commit, written: true, words: [0; 6] }),
            _ => answer(Answer::Refused { number: commit, reason: Answer::REFUSED_WRONG_HASH }),
        }
    };
    // Latched messages are 1 s apart.
    let frames = latched.chars().zip(1..).map(|(step, at)| {
        let frame = message_of(step).encode().frames(Format::Fd).next().unwrap();
        LatchedFrame { bus: "vcan0".into(), own: true, frame, nanos: at * 1_000_000_000 }
    });
    let frames: Vec<_> = frames.collect();
    bus.0.add_latched_frames(&frames);
    bus.1 = 100_000_000_000;
    for step in steps.chars() {
        bus.1 += if step == '|' { 1_000 } else { 1 };
        if step != '|' {
            bus.take(&message_of(step));
        }
    }
    bus.0.finish();
    bus.0.buses[0].cells[&cell].hash
}

#[test]
fn a_part_that_begins_after_a_commit_begins_with_the_new_configuration() {
    let (former, new) = (InitialValue::Value(7), InitialValue::Value(9));
    for (steps, expected) in [
        ("h|hcaH", former),
        ("c|haH", new),
        ("hch|haH", new),
        ("hch|hrh", former),
        ("hC|haH", new),
        ("hca|H", new),
        ("hcaH|H", new),
        // The answer is not in the capture.
        ("hc|hhH", new),
        ("hc|hhhcaH", former),
        // It came before the capture, or its commit did.
        ("hc~|HH", new),
        ("hch~|haH", new),
        ("hchhhhH~|H", new),
        // It is not known.
        ("hc|acaH", InitialValue::TooLate),
    ] {
        assert_eq!(hash_after(steps), expected, "{steps}");
    }
}
