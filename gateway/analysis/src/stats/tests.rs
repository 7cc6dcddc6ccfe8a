use super::*;
use model::decode::settle::OrderedDecoder;
use protocol::can::{Format, Frame};
use protocol::candump::Timestamp;
use protocol::id::Node;
use protocol::message::{self, Heartbeat, TreePage};
use protocol::port;

/// A capture under construction.
#[derive(Default)]
struct Tape {
    stats: CaptureStats,
    settler: Option<OrderedDecoder<(u64, String, Frame)>>,
    ms: u64,
}

impl Tape {
    fn frame(&mut self, bus: &str, frame: Frame) {
        self.ms += 1;
        let nanos = self.ms * 1_000_000;
        let settler = self.settler.get_or_insert_with(|| OrderedDecoder::new(None));
        settler.push(Micros(nanos / 1_000), bus, &frame, (nanos, bus.to_owned(), frame));
        settler.finish();
        while let Some(((nanos, bus, frame), decoded)) = settler.pop() {
            let time = Timestamp::with_six_digits(nanos);
            self.stats.record(&Record { time, interface: &bus, frame, direction: None }, &decoded);
        }
    }

    fn say(&mut self, message: &Message) {
        let frame = message.encode().frames(Format::Fd).next().unwrap();
        self.frame("vcan0", frame);
    }

    fn joints(&mut self, epoch: u8) {
        self.say(&Message::Joints {
            epoch: Epoch(epoch),
            joints: message::Joints { in_use: 6, ..message::Joints::default() },
        });
    }

    fn torque(&mut self, epoch: u8, word: i16) {
        self.say(&Message::Torque { from: cell(), epoch: Epoch(epoch), torque: [word; 6].into() });
    }

    fn heartbeat(&mut self, epoch: u8, sent: u16, state: State) {
        let heartbeat = Heartbeat { sent, state, rejected: 3, ..Heartbeat::default() };
        let page = NetworkPage::Heartbeat(heartbeat);
        self.say(&Message::Network { from: Node::Cell(cell()), epoch: Epoch(epoch), page });
    }

    fn page(&mut self, heartbeat: Heartbeat) {
        let page = NetworkPage::Heartbeat(heartbeat);
        self.say(&Message::Network { from: Node::Cell(cell()), epoch: Epoch(0), page });
    }

    fn bus(&self) -> BusReport {
        self.stats.report().buses.remove(0)
    }

    fn cell(&self) -> CellReport {
        self.bus().cells.remove(0)
    }
}

fn cell() -> CellId {
    CellId::new(12).unwrap()
}

#[test]
fn joints_that_are_missing_or_come_again_are_counted_around_the_corner() {
    let mut tape = Tape::default();
    for epoch in [254, 255, 1, 1, 4, 0] {
        tape.joints(epoch);
    }
    let expected = EpochStatistics { first: Some(254), last: Some(0), missing: 1 + 2, repeated: 1, jumps: 1 };
    assert_eq!(tape.bus().epochs, expected);
    let joints = KindReport { kind: "joints", packets: 6, packets_per_s: Some(1_000.0), span_s: 0.005 };
    assert_eq!(tape.bus().kinds, [joints]);
}

#[test]
fn epochs_that_a_cell_in_contact_does_not_answer_are_missed_and_others_are_not() {
    let mut tape = Tape::default();
    for epoch in 250..=255 {
        tape.joints(epoch);
    }
    tape.torque(250, 7);
    tape.torque(251, 7);
    tape.torque(254, 7);
    tape.torque(254, 7);
    tape.joints(0);
    tape.joints(1);
    tape.torque(1, 0);
    // Without contact, silence is correct.
    for epoch in 2..=9 {
        tape.joints(epoch);
    }
    tape.torque(9, i16::MAX);
    let cell = tape.cell();
    assert_eq!((cell.unanswered, cell.repeated, cell.saturated), (2 + 2, 1, 1));
    assert_eq!((cell.first_epoch, cell.last_epoch, cell.torques), (Some(250), Some(9), 6));
    // A later heartbeat reports the end of the contact: its last torque was lost.
    tape.heartbeat(9, 0, State::default());
    tape.joints(10);
    tape.joints(11);
    tape.joints(12);
    tape.torque(12, 7);
    assert_eq!(tape.cell().unanswered, 4);
}

#[test]
fn an_old_heartbeat_does_not_end_a_contact() {
    let mut tape = Tape::default();
    tape.joints(1);
    tape.joints(2);
    tape.torque(2, 7);
    tape.heartbeat(1, 1, State::default());
    tape.joints(3);
    tape.joints(4);
    tape.torque(4, 7);
    assert_eq!(tape.cell().unanswered, 1);
}

#[test]
fn what_a_cell_counts_and_is_not_here_is_lost() {
    let mut tape = Tape::default();
    tape.heartbeat(0, 65_534, State::CONFIGURED);
    tape.joints(1);
    tape.torque(1, 7);
    tape.heartbeat(1, 0, State::CONFIGURED);
    assert_eq!(tape.cell().lost, 0);
    tape.heartbeat(1, 4, State::CONFIGURED.with_flags(State::ACTIVE, true));
    let cell = tape.cell();
    assert_eq!((cell.lost, cell.heartbeats, cell.refused, cell.restarts), (3, 3, Some(3), 0));
    assert_eq!(cell.state, ["configured", "active"]);
    tape.heartbeat(1, 0, State::CLAIMING_NODE_ID);
    tape.heartbeat(1, 1, State::CONFIGURED);
    let cell = tape.cell();
    assert_eq!((cell.lost, cell.restarts), (3, 1));
}

#[test]
fn what_is_refused_is_counted_by_reason_and_bus() {
    let mut tape = Tape::default();
    let packet = "20C##1001000F80100000000000000070175D6";
    for text in [
        packet,
        packet,
        "1F334455#11",
        "20C#R8",
        "20000004#0001000000000000",
        "20D##1001000F80100000000000000070175D6",
        "20C##10011",
        "20C##1001000F80100000000000000070175D7",
        "20C#001000F801000000",
    ] {
        let frame = protocol::candump::parse_frame(text).unwrap();
        for bus in ["can0", "can1"] {
            tape.frame(bus, frame);
        }
    }
    tape.stats.record_dropped("can1", 5);
    tape.stats.record_dropped("", 7);
    let report = tape.stats.report();
    let expected = RefusedFrames { length: 1, crc: 1, meaning: 0, incomplete: 1 };
    for bus in &report.buses {
        assert_eq!((bus.refused, bus.frames), (expected, 9));
        let ForeignFrames { frames, standard, extended, remote, error, .. } = bus.foreign;
        assert_eq!((frames, standard, extended, remote, error), (4, 1, 1, 1, 1));
        let ids: Vec<_> = bus.foreign.identifiers.iter().map(|id| (id.id.as_str(), id.of)).collect();
        let (data, remote, error) = (FrameType::Data, FrameType::Remote, FrameType::Error);
        assert_eq!(ids, [("20D", data), ("1F334455", data), ("20C", remote), ("20000004", error)]);
        assert_eq!(bus.foreign.identifiers[0].wrong_crc, 1);
    }
    let dropped: Vec<_> = report.buses.iter().map(|bus| (bus.bus.as_str(), bus.dropped)).collect();
    assert_eq!((dropped, report.dropped), (vec![("can0", 0), ("can1", 5)], 7));
}

#[test]
fn wires_are_counted_apart_and_are_no_frames_of_the_bus() {
    let mut tape = Tape::default();
    let bus_stats = port::LinkId { wire: 3, back: false };
    tape.joints(0);
    tape.frame("vcan0", bus_stats.encode_frame(port::PortMessage::Join));
    tape.frame("vcan0", bus_stats.encode_frame(port::PortMessage::Leave));
    tape.joints(1);
    let bus = tape.bus();
    assert_eq!((bus.frames, bus.wires, bus.wires_per_s), (2, 2, Some(1_000.0)));
    assert_eq!((bus.refused, bus.kinds.len(), tape.stats.report().frames), (RefusedFrames::default(), 1, 4));
}

#[test]
fn resent_sums_and_the_place_in_the_tree_are_counted() {
    let mut tape = Tape::default();
    let sum = |epoch, word, count| {
        let torque = [word; 6];
        Message::Sum { from: cell(), epoch: Epoch(epoch), torque: torque.into(), count }
    };
    for message in [sum(1, 5, 1), sum(1, 6, 2), sum(2, i16::MAX, 2)] {
        tape.say(&message);
    }
    assert_eq!((tape.cell().parent, tape.cell().depth), (None, None));
    let tree = |parent, depth| {
        let page = NetworkPage::Tree(TreePage { parent, depth, ..TreePage::default() });
        Message::Network { from: Node::Cell(cell()), epoch: Epoch(2), page }
    };
    tape.say(&tree(Some(7), 3));
    let cell = tape.cell();
    assert_eq!((cell.sums, cell.resent, cell.saturated), (3, 1, 1));
    assert_eq!((cell.parent, cell.depth), (Some(7), Some(3)));
    tape.say(&tree(None, 3));
    assert_eq!((tape.cell().parent, tape.cell().depth), (None, None));
}

#[test]
fn memory_is_bounded_whatever_buses_a_capture_names() {
    let mut tape = Tape::default();
    let frame = Frame::classic(1, &[]).unwrap();
    for bus in 0..1_000 {
        tape.frame(&format!("can{bus}"), frame);
    }
    let report = tape.stats.report();
    assert_eq!((report.buses.len(), report.frames_of_other_buses, report.frames), (MAX_BUSES, 936, 1_000));
}

#[test]
fn a_rate_needs_two_times_of_its_own_bus() {
    let mut stats = CaptureStats::default();
    let frame = Frame::classic(0x7F0, &[1]).unwrap();
    for (bus, nanos) in [("a", 5), ("b", 7), ("a", 5), ("a", 5), ("b", 1_000_000_007)] {
        let mut settler = OrderedDecoder::new(None);
        settler.push(Micros(0), bus, &frame, ());
        settler.finish();
        let ((), decoded) = settler.pop().unwrap();
        let time = Timestamp::with_nine_digits(nanos);
        stats.record(&Record { time, interface: bus, frame, direction: None }, &decoded);
    }
    let rates = |stats: &CaptureStats| {
        let rate =
            |bus: &BusReport| (bus.frames_per_s.is_some(), bus.foreign.identifiers[0].frames_per_s.is_some());
        stats.report().buses.iter().map(rate).collect::<Vec<_>>()
    };
    assert_eq!(rates(&stats), [(false, false), (true, true)]);
    stats.mark_untimed();
    assert_eq!(rates(&stats), [(false, false); 2]);
}

#[test]
fn times_that_run_backwards_are_counted_and_the_duration_is_that_of_all() {
    let mut tape = Tape::default();
    for ms in [1_000, 3_000, 2_000] {
        tape.ms = ms;
        tape.joints(0);
    }
    let report = tape.stats.report();
    assert_eq!((report.times_backwards, report.frames), (1, 3));
    assert!((report.duration_s - 2.0).abs() < 1e-9, "{report:?}");
}

#[test]
fn times_of_each_bus_are_compared_with_its_own() {
    let backwards = |times: [(&str, u64); 4]| {
        let mut tape = Tape::default();
        for (bus, ms) in times {
            tape.ms = ms;
            tape.frame(bus, Frame::classic(1, &[]).unwrap());
        }
        tape.stats.report().times_backwards
    };
    assert_eq!(backwards([("can0", 30), ("can1", 10), ("can0", 40), ("can1", 20)]), 0);
    assert_eq!(backwards([("can0", 30), ("can1", 20), ("can0", 40), ("can1", 10)]), 1);
}

#[test]
fn a_claim_of_an_owned_node_id_is_no_restart_and_no_loss() {
    let counts = |intruded: bool, lost: u16| {
        let mut tape = Tape::default();
        let owner = |sent| Heartbeat { serial: 7, sent, state: State::CONFIGURED, ..Heartbeat::default() };
        tape.page(owner(40));
        tape.joints(1);
        tape.torque(1, 7);
        if intruded {
            tape.page(Heartbeat { serial: 9, state: State::CLAIMING_NODE_ID, ..Heartbeat::default() });
        }
        tape.joints(2);
        tape.joints(3);
        tape.torque(3, 7);
        tape.page(owner(43 + lost));
        let CellReport { lost, restarts, unanswered, refused, state, .. } = tape.cell();
        (lost, restarts, unanswered, refused, state)
    };
    assert_eq!(counts(true, 0), counts(false, 0));
    assert_eq!(
        (counts(true, 5).0, counts(true, 5).1, counts(true, 5).2),
        (5, 0, 1),
        "what is lost is still lost"
    );
    assert_eq!(counts(true, 5), counts(false, 5));
}

#[test]
fn a_claim_before_the_first_packet_of_the_owner_is_no_restart() {
    let mut tape = Tape::default();
    tape.page(Heartbeat { serial: 9, state: State::CLAIMING_NODE_ID, ..Heartbeat::default() });
    for sent in [40, 41] {
        tape.page(Heartbeat { serial: 7, sent, ..Heartbeat::default() });
    }
    assert_eq!((tape.cell().restarts, tape.cell().lost), (0, 0));
    // Another cell owns the node id now, which counts as a restart.
    tape.page(Heartbeat { serial: 9, sent: 3, ..Heartbeat::default() });
    assert_eq!((tape.cell().restarts, tape.cell().lost), (1, 0));
}

#[test]
fn a_restart_is_detected_by_the_counter_and_a_late_heartbeat_is_none() {
    let mut tape = Tape::default();
    let mut say = |sent| {
        tape.page(Heartbeat { serial: 7, sent, ..Heartbeat::default() });
        (tape.cell().restarts, tape.cell().lost)
    };
    assert_eq!([say(300), say(299), say(302), say(1), say(2)], [(0, 0), (0, 0), (0, 0), (1, 0), (1, 0)]);
}
