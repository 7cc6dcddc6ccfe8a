//! Tests of the table of a bus whose cells answer with torques.

use super::*;
use protocol::can::{Format, Frame};
use protocol::id::Node;
use protocol::message::{Answer, Joints, Message, NetworkPage, ReceivedCounts, Request, SensorPage, State};
use protocol::packet::{self, Packet};
use protocol::parameters::Parameter;

/// Returns a table that received these messages in the frames of the bus, from the gateway itself or from a cell.
fn table(heard: &[(bool, Message)]) -> BusTable {
    let mut table = BusTable::new(&crate::testing::one_cell_skin(), 0);
    for (own, message) in heard {
        let packet: Packet = message.encode();
        for frame in packet.frames(Format::Fd) {
            table.handle_frame(Micros(0), *own, &frame, &mut |_| None);
        }
    }
    table
}

#[test]
fn what_is_no_packet_is_rejected_with_a_cells_identifier_and_foreign_with_an_unused_one() {
    let mut skin = crate::testing::one_cell_skin();
    for format in [Format::Fd, Format::Classic] {
        skin.buses[0].format = format;
        let mut table = BusTable::new(&skin, 0);
        let mut hear = |id, byte, at| {
            let data = [byte; 16];
            let (length, flags) = if format == Format::Fd { (16, 1) } else { (8, 0) };
            let frame = Frame::with_data(id, format, flags, &data[..length]).unwrap();
            table.handle_frame(Micros(at), false, &frame, &mut |_| None);
        };
        // Frames of the only cell; of a cell that does not exist; a command that does not exist; joints.
        for at in 0..9_u8 {
            for id in [0x201, 0x263, 0x077, 0x001] {
                hear(id, at, 1_000 * u64::from(at));
            }
        }
        let of = |event| table.counters().event_count(event);
        let events = [FrameEvent::Foreign, FrameEvent::Crc, FrameEvent::Incomplete].map(of);
        // Segments: eight of nine were dropped of each; an incomplete packet counts once.
        assert_eq!(events, if format == Format::Fd { [18, 18, 0] } else { [16, 0, 8] }, "{format:?}");
    }
}

#[test]
fn a_torque_from_before_an_outage_does_not_come_back_with_the_bus() {
    let cell = CellId::new(1).unwrap();
    let joints =
        |epoch| Message::Joints { epoch: Epoch(epoch), joints: Joints { in_use: 6, ..Joints::default() } };
    let torque = |epoch| Message::Torque { from: cell, epoch: Epoch(epoch), torque: [i16::MAX; 6].into() };
    let hear = |table: &mut BusTable, own, message: Message| {
        for frame in message.encode().frames(Format::Fd) {
            table.handle_frame(Micros(0), own, &frame, &mut |_| None);
        }
        table.snapshot().sums.contributing
    };
    for (interrupted, next, contributing) in [(false, 2, 1), (true, 2, 0), (false, 8, 1), (false, 9, 0)] {
        let mut table = table(&[(true, joints(1)), (false, torque(1))]);
        assert_eq!(table.snapshot().sums.contributing, 1);
        if interrupted {
            table.handle_bus_loss();
            assert_eq!(table.snapshot().sums.contributing, 1, "the loop lets it decay");
        }
        let after = hear(&mut table, true, joints(next));
        assert_eq!(after, contributing, "{interrupted}, joints {next} after joints 1");
        assert_eq!(hear(&mut table, false, torque(next)), 1, "new ones count again");
    }
}

#[test]
fn after_an_outage_no_reply_is_due_before_a_heartbeat_and_a_clear_contact() {
    let cell = CellId::new(1).unwrap();
    let joints = |epoch| {
        (true, Message::Joints { epoch: Epoch(epoch), joints: Joints { in_use: 6, ..Joints::default() } })
    };
    let heartbeat = |sent| {
        let state = State::CONFIGURED.with_flags(State::TEST_MODE, true);
        let page = NetworkPage::Heartbeat(Heartbeat { sent, state, ..Heartbeat::default() });
        (false, Message::Network { from: Node::Cell(cell), epoch: Epoch(0), page })
    };
    let contact = [protocol::fixed::Q5_10::nearest(2.0); 3];
    let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
    let press = (
        true,
        Message::Stimulus { to: Node::Cell(cell), from: protocol::message::StimulusStart::Next, page },
    );
    let hear = |table: &mut BusTable, heard: &[(bool, Message)]| {
        for (own, message) in heard {
            for frame in message.encode().frames(Format::Fd) {
                table.handle_frame(Micros(0), *own, &frame, &mut |_| None);
            }
        }
        let replies = table.cells().first().unwrap().replies;
        (replies.due, replies.missing, replies.in_doubt)
    };
    let mut table = table(&[]);
    let untouched = (
        false,
        Message::Network {
            from: Node::Cell(cell),
            epoch: Epoch(0),
            page: NetworkPage::Received(ReceivedCounts::default()),
        },
    );
    assert_eq!(hear(&mut table, &[heartbeat(1), untouched, press, joints(1), joints(2)]), (2, 0, 0));
    table.handle_bus_loss();
    // The cell may return later than the bus, and so may have missed this stimulus.
    assert_eq!(hear(&mut table, &[joints(3), press, joints(4)]), (2, 2, 2));
    assert_eq!(table.drain_notices().count(), 0);
    assert_eq!(hear(&mut table, &[heartbeat(9), joints(5)]), (2, 2, 2), "its sensors are unknown");
    assert_eq!(table.drain_notices().collect::<Vec<_>>(), [Notice::Returned(cell)]);
    assert_eq!(hear(&mut table, &[press, joints(6)]), (2, 2, 2), "others may wait in it");
    let (number, words) = (Parameter::Mode.number(), packet::padded_words([1]));
    let write = (
        true,
        Message::Configure { to: Node::Cell(cell), tag: 0, request: Request::Write { number, words } },
    );
    let answer = Answer::Value { number, written: true, words };
    let confirm = (false, Message::Configured { from: cell, tag: 0, answer });
    assert_eq!(hear(&mut table, &[write, press, joints(7)]), (2, 2, 2), "it has not confirmed");
    assert_eq!(hear(&mut table, &[confirm, joints(8), heartbeat(11), joints(9)]), (4, 2, 2));
    assert_eq!(table.drain_notices().count(), 0, "reported once");
    let uplink = table.cells().first().unwrap().uplink();
    assert_eq!((uplink.lost, uplink.outage), (6, 6));
}

#[test]
fn a_start_that_was_none_takes_no_counters_that_explain_missing_replies() {
    let cell = CellId::new(1).unwrap();
    let joints = |epoch| {
        (true, Message::Joints { epoch: Epoch(epoch), joints: Joints { in_use: 6, ..Joints::default() } })
    };
    let network = |page| (false, Message::Network { from: Node::Cell(cell), epoch: Epoch(0), page });
    let heartbeat = |sent| {
        let state = State::CONFIGURED.with_flags(State::TEST_MODE, true);
        network(NetworkPage::Heartbeat(Heartbeat { sent, state, ..Heartbeat::default() }))
    };
    let heard = |joints, joints_late| {
        network(NetworkPage::Received(ReceivedCounts { joints, joints_late, ..ReceivedCounts::default() }))
    };
    let contact = [protocol::fixed::Q5_10::nearest(2.0); 3];
    let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
    let press = (
        true,
        Message::Stimulus { to: Node::Cell(cell), from: protocol::message::StimulusStart::Next, page },
    );
    let mut table = table(&[]);
    let mut ms = 0;
    let mut hear = |table: &mut BusTable, heard: &[(bool, Message)]| {
        for (own, message) in heard {
            ms += 10;
            for frame in message.encode().frames(Format::Fd) {
                table.handle_frame(Micros(ms * 1_000), *own, &frame, &mut |_| None);
            }
        }
        let cell = table.cells().first().unwrap();
        (cell.replies.missing, cell.replies.in_doubt, cell.unanswered_joint_counts())
    };
    // It receives two of six joints, and answers none of them.
    let before = [
        heartbeat(900),
        heard(100, 7),
        press,
        joints(1),
        joints(2),
        joints(3),
        joints(4),
        joints(5),
        joints(6),
    ];
    assert_eq!(hear(&mut table, &before), (2, 0, Some((0, 6))));
    // An old heartbeat looks like a start; after two more joints, the cell's own heartbeat disproves it.
    assert_eq!(hear(&mut table, &[heartbeat(100), press, joints(7)]), (6, 6, None));
    let taken_back = hear(&mut table, &[heartbeat(902)]);
    assert_eq!(taken_back, (7, 5, Some((0, 7))), "only what was outstanding is in doubt");
    assert_eq!(hear(&mut table, &[press, joints(8), heard(102, 13)]).2, Some((6, 0)));
}

#[test]
fn lost_joints_that_passed_a_report_on_its_way_are_counted() {
    let joints = |epoch| {
        (true, Message::Joints { epoch: Epoch(epoch), joints: Joints { in_use: 6, ..Joints::default() } })
    };
    let report = |epoch, joints| {
        let page = NetworkPage::Received(ReceivedCounts { joints, ..ReceivedCounts::default() });
        (false, Message::Network { from: Node::Cell(CellId::new(1).unwrap()), epoch: Epoch(epoch), page })
    };
    let unanswered = |heard: &[_]| table(heard).cells().first().unwrap().unanswered_joint_counts();
    // The cell did not receive the first joints, or joints before its first report.
    assert_eq!(unanswered(&[report(0, 0), joints(1), joints(2), report(2, 1)]), Some((0, 1)));
    assert_eq!(unanswered(&[joints(1), report(0, 0), joints(2), report(2, 1)]), Some((0, 1)));
    assert_eq!(unanswered(&[joints(1), report(0, 0), joints(2), report(2, 2)]), Some((0, 0)));
    assert_eq!(unanswered(&[joints(1), report(1, 1), joints(2), report(2, 2)]), Some((0, 0)));
    // A cell that started before this gateway has larger counters.
    assert_eq!(unanswered(&[joints(8), joints(9), report(8, 70), joints(10), report(10, 72)]), Some((0, 0)));
}

#[test]
fn an_address_claim_for_a_taken_node_id_does_not_change_its_owner() {
    let (cell, contact) = (CellId::new(1).unwrap(), [protocol::fixed::Q5_10::nearest(2.0); 3]);
    let says = |serial, sent, state| {
        let page = NetworkPage::Heartbeat(Heartbeat { serial, sent, state, ..Heartbeat::default() });
        (false, Message::Network { from: Node::Cell(cell), epoch: Epoch(0), page })
    };
    let settled = State::CONFIGURED.with_flags(State::TEST_MODE, true);
    let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
    let press =
        Message::Stimulus { to: Node::Cell(cell), from: protocol::message::StimulusStart::Next, page };
    let joints = |epoch| {
        let joints = Joints { in_use: 6, ..Joints::default() };
        (true, Message::Joints { epoch: Epoch(epoch), joints })
    };
    let result = |intruded| {
        let untouched = NetworkPage::Received(ReceivedCounts::default());
        let untouched = Message::Network { from: Node::Cell(cell), epoch: Epoch(0), page: untouched };
        let mut said = vec![says(7, 40, settled), (false, untouched), (true, press), joints(1)];
        said.extend([joints(2), says(7, 44, settled), joints(3)]);
        if intruded {
            said.insert(4, says(9, 0, State::CLAIMING_NODE_ID));
        }
        let mut table = table(&said);
        assert_eq!(table.drain_notices().count(), 0, "no restart");
        let cell = table.cells().first().unwrap();
        let uplink = cell.uplink();
        (
            cell.heartbeat(),
            cell.sensors(),
            cell.replies,
            cell.is_ready(),
            uplink.sent,
            uplink.lost,
            uplink.restarts,
        )
    };
    assert_eq!(result(true), result(false));
    assert_eq!((result(true).2.due, result(true).5, result(true).6), (3, 2, 0));
}

#[test]
fn heartbeats_say_for_how_long_joints_were_not_taken() {
    let cell = CellId::new(1).unwrap();
    let joints = |epoch| Message::Joints { epoch, joints: Joints { in_use: 6, ..Joints::default() } };
    let mut table = BusTable::new(&crate::testing::one_cell_skin(), 0);
    let mut hear = |at_ms: u64, message: Message| {
        let own = matches!(message, Message::Joints { .. });
        for frame in message.encode().frames(Format::Fd) {
            table.handle_frame(Micros(at_ms * 1_000), own, &frame, &mut |_| None);
        }
        let delays = table.delays().pending_joints_ages();
        // A histogram has three significant digits.
        (delays.len(), delays.max() / 1_000)
    };
    let beat = |epoch, sent, state| {
        let page = NetworkPage::Heartbeat(Heartbeat { serial: 7, sent, state, ..Heartbeat::default() });
        Message::Network { from: Node::Cell(cell), epoch: Epoch(epoch), page }
    };
    hear(0, joints(Epoch(1)));
    hear(16, joints(Epoch(2)));
    assert_eq!(hear(17, beat(0, 1, State::default())), (0, 0), "its first one: it may have begun just now");
    assert_eq!(hear(18, beat(2, 2, State::default())), (1, 0), "it has taken the newest");
    assert_eq!(hear(20, beat(1, 3, State::default())), (2, 4), "epoch 2 stands there since 16 ms");
    assert_eq!(hear(40, beat(1, 4, State::HALTED)), (2, 4), "halted it takes none");
    hear(48, joints(Epoch(3)));
    assert_eq!(hear(90, beat(1, 5, State::default())), (3, 74), "since the first that it has not taken");
}

#[test]
fn a_cell_is_active_stale_or_quiet_by_the_torque_that_is_held() {
    let cell = CellId::new(1).unwrap();
    let mut table = table(&[]);
    let mut hear = |message: Message| {
        let own = matches!(message, Message::Joints { .. });
        for frame in message.encode().frames(Format::Fd) {
            table.handle_frame(Micros(0), own, &frame, &mut |_| None);
        }
        table.statuses(Micros(0)).next().unwrap().1
    };
    let joints = |epoch| {
        let joints = Joints { in_use: 6, ..Joints::default() };
        Message::Joints { epoch: Epoch(epoch), joints }
    };
    let torque = |epoch, word| Message::Torque { from: cell, epoch: Epoch(epoch), torque: [word; 6].into() };
    assert_eq!(hear(joints(1)), CellStatus::Unknown);
    let said = [torque(1, 100), joints(2), joints(3), torque(3, 100)];
    let [active, stale, quiet] = [CellStatus::Active, CellStatus::Stale, CellStatus::Quiet];
    assert_eq!(said.map(&mut hear), [active, active, stale, active]);
    let said = [joints(4), torque(4, 0), joints(5), joints(6)];
    assert_eq!(said.map(&mut hear), [active, quiet, quiet, quiet]);
}

/// A cell that started before the gateway, with a stimulus from another sender that did not arrive here.
struct There {
    table: BusTable,
    epoch: u8,
}

impl There {
    const CELL: i64 = 1;

    fn new(stimuli: u16) -> Self {
        let mut there = Self { table: table(&[]), epoch: 10 };
        there.table.set_torque_comparison(true);
        let state = State::CONFIGURED.with_flags(State::TEST_MODE, true);
        there.says(NetworkPage::Heartbeat(Heartbeat { sent: 70, state, ..Heartbeat::default() }));
        there.says(NetworkPage::Received(ReceivedCounts {
            stimuli,
            joints: 50,
            ..ReceivedCounts::default()
        }));
        there.hear(false, &Message::Sensors { from: Self::cell(), epoch: Epoch(10), page: Self::press(0.0) });
        there
    }

    fn cell() -> CellId {
        CellId::new(Self::CELL).unwrap()
    }

    fn press(newtons: f64) -> SensorPage {
        let contact = [protocol::fixed::Q5_10::nearest(newtons / 3.0); 3];
        SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() })
    }

    fn hear(&mut self, own: bool, message: &Message) {
        for frame in message.encode().frames(Format::Fd) {
            self.table.handle_frame(Micros(0), own, &frame, &mut |_| None);
        }
    }

    fn says(&mut self, page: NetworkPage) {
        self.hear(
            false,
            &Message::Network { from: Node::Cell(Self::cell()), epoch: Epoch(self.epoch), page },
        );
    }

    fn stimulate(&mut self, newtons: f64) {
        let from = protocol::message::StimulusStart::Next;
        let page = Self::press(newtons);
        self.hear(true, &Message::Stimulus { to: Node::Cell(Self::cell()), from, page });
    }

    /// Sends this number of joints; the cell answers each with 1 Nm.
    fn answered(&mut self, joints: usize) -> Replies {
        for _ in 0..joints {
            self.epoch = self.epoch.wrapping_add(1);
            let epoch = Epoch(self.epoch);
            self.hear(true, &Message::Joints { epoch, joints: Joints { in_use: 6, ..Joints::default() } });
            let torque = [4_096; 6].into();
            self.hear(false, &Message::Torque { from: Self::cell(), epoch, torque });
        }
        self.table.cells().first().unwrap().replies
    }

    fn compared(&self) -> (u64, u64) {
        (self.table.accuracy().single.count(), self.table.accuracy().whole.count())
    }
}

#[test]
fn a_cell_that_was_pressed_before_is_neither_due_nor_compared() {
    let mut there = There::new(1);
    assert!(there.table.cells()[0].has_unseen_stimuli());
    let replies = there.answered(125);
    assert_eq!((replies.due, replies.unasked, replies.contact_unknown, replies.unexpected), (0, 125, 125, 0));
    assert_eq!(there.compared(), (0, 0));
    // A stimulus of the gateway does not help: an earlier one may be latched at a later epoch.
    there.stimulate(2.0);
    assert_eq!(there.answered(3).due, 0);
    // By now all earlier stimuli are latched; the next stimulus is the last one.
    there.answered(1);
    there.stimulate(2.0);
    assert_eq!((there.answered(5).due, there.compared().0 > 0), (5, true));
}

#[test]
fn a_page_of_a_cell_counts_when_no_stimulus_from_before_can_wait() {
    let mut there = There::new(1);
    let page = |epoch| Message::Sensors { from: There::cell(), epoch: Epoch(epoch), page: There::press(3.0) };
    there.answered(128);
    there.hear(false, &page(there.epoch));
    assert_eq!(there.answered(1).due, 0, "one may wait for these very joints");
    there.hear(false, &page(there.epoch.wrapping_sub(1)));
    assert_eq!(there.answered(1).due, 0, "the page is of joints before the newest");
    there.hear(false, &page(there.epoch));
    assert_eq!(there.answered(4).due, 4);
}

#[test]
fn a_cell_without_stimuli_before_is_known_at_once_and_a_torque_of_it_is_unexpected() {
    let mut there = There::new(0);
    assert!(!there.table.cells()[0].has_unseen_stimuli());
    let replies = there.answered(5);
    assert_eq!((replies.due, replies.unasked, replies.contact_unknown, replies.unexpected), (0, 5, 0, 5));
    assert_eq!(there.compared(), (0, 0), "what is not due is not compared");
    there.stimulate(2.0);
    assert_eq!((there.answered(5).due, there.compared().0 > 0), (5, true));
}

#[test]
fn epochs_with_a_torque_that_was_not_due_are_not_the_whole_skin() {
    let mut there = There::new(0);
    there.stimulate(2.0);
    there.answered(5);
    let whole = there.compared().1;
    assert!(whole > 0);
    // After another gateway's write, the contact is unknown until the next stimulus.
    let request = Request::Write { number: Parameter::Reply.number(), words: packet::padded_words([0]) };
    there.hear(false, &Message::Configure { to: Node::Everyone, tag: 0, request });
    let replies = there.answered(5);
    assert_eq!((replies.contact_unknown, replies.unasked), (5, 5));
    assert!(there.compared().1 <= whole + 6, "the epoch before may still close");
}

#[test]
fn a_cell_measures_unless_its_heartbeats_say_test_mode() {
    let from = Node::Cell(CellId::new(1).unwrap());
    let heartbeat = |state| {
        let page = NetworkPage::Heartbeat(Heartbeat { state, ..Heartbeat::default() });
        (false, Message::Network { from, epoch: Epoch(0), page })
    };
    for (heard, is_measuring) in [
        (vec![], None),
        (vec![heartbeat(State::CONFIGURED)], Some(true)),
        (vec![heartbeat(State(State::CONFIGURED.0 | State::TEST_MODE.0))], Some(false)),
    ] {
        assert_eq!(table(&heard).cells()[0].is_measuring(), is_measuring);
    }
}
