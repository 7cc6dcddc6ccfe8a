use super::parameters::pad_with_zeros;
use super::*;
use protocol::fixed::{Q3_12, Q5_10};
use protocol::id::CellId;
use protocol::message::{Answer, Heartbeat, Joints, RejectedCounts, Request, SkinSensors};
use protocol::packet::{Reassembler, WORDS, Words};
use protocol::parameters::{Contact, Parameter, Parameters, Pose, Row};

/// Returns the parameters of a wheel: one joint about z, and a cell on the rim that faces the direction of
/// motion.
fn wheel() -> Parameters {
    let [zero, one] = [Q1_14::ZERO, Q1_14::nearest(1.0)];
    let mut parameters = Parameters {
        joint: 1,
        joints: 1,
        pose: Pose { position: [Q1_14::nearest(0.5), zero, zero], normal: [zero, one, zero] },
        contact: Contact {
            alpha_c: Q3_12::nearest(1.0),
            force_threshold: Q5_10::nearest(0.5),
            ..Contact::default()
        },
        period_us: 16_000,
        ..Parameters::default()
    };
    parameters.rows[0] = Row::default();
    parameters
}

fn cell() -> CellId {
    CellId::new(12).unwrap()
}

fn identity() -> Identity {
    Identity { cell: Some(cell()), serial: 100_012 }
}

/// Returns a cell that owns its node id, started with these contents of flash.
fn settled(flash: FlashState) -> Node {
    settle(Node::new(identity(), Format::Fd, &flash, true, Micros(0)))
}

fn settle(mut node: Node) -> Node {
    for _ in 0..2 {
        node.handle_timeout(node.poll_timeout());
        drain(&mut node);
    }
    node
}

/// Returns a cell that has just sent its address claim, together with that message.
fn claiming(identity: Identity) -> (Node, Message) {
    let mut node = Node::new(identity, Format::Fd, &FlashState::Valid(wheel()), true, Micros(0));
    node.handle_timeout(node.poll_timeout());
    let claim = drain(&mut node)[0];
    (node, claim)
}

fn drain(node: &mut Node) -> Vec<Message> {
    core::iter::from_fn(|| node.poll_transmit().copied())
        .map(|packet| Message::decode(&packet).unwrap())
        .collect()
}

const NOW: Micros = Micros(300_000);

fn tell(node: &mut Node, message: &Message) -> Vec<Message> {
    for frame in message.encode().frames(Format::Fd) {
        node.handle_frame(NOW, Span(0), &frame);
    }
    drain(node)
}

fn joints(epoch: u8) -> Message {
    Message::Joints { epoch: Epoch(epoch), joints: Joints { in_use: 1, ..Joints::default() } }
}

fn press(newtons: f64, from: StimulusStart) -> Message {
    let contact = [Q5_10::nearest(newtons), Q5_10::ZERO, Q5_10::ZERO];
    let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
    Message::Stimulus { to: Address::Cell(cell()), from, page }
}

fn torque(epoch: u8, nm: f64) -> Message {
    let torque = Words::from(pad_with_zeros([Q3_12::nearest(nm).to_bits()]));
    Message::Torque { from: cell(), epoch: Epoch(epoch), torque }
}

fn heartbeat(messages: &[Message]) -> Heartbeat {
    match messages {
        [Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. }] => *heartbeat,
        other => panic!("one heartbeat expected, not {other:?}"),
    }
}

fn heard(node: &mut Node) -> (ReceivedCounts, RejectedCounts) {
    match tell(node, &Message::Report).as_slice() {
        [
            Message::Network { page: NetworkPage::Received(heard), .. },
            Message::Network { page: NetworkPage::Rejected(refused), .. },
            Message::Sensors { .. },
            Message::Sensors { .. },
        ] => (*heard, *refused),
        other => panic!("{other:?}"),
    }
}

// JOINTS-3, JOINTS-5, JOINTS-6
#[test]
fn a_pressed_cell_answers_each_joints_frame_and_the_end_of_contact_with_one_zero() {
    let mut node = settled(FlashState::Valid(wheel()));
    assert_eq!(tell(&mut node, &joints(0)), [], "quiet: nothing touches it");
    assert_eq!(tell(&mut node, &press(4.0, StimulusStart::Epoch(Epoch(2)))), []);
    assert_eq!(tell(&mut node, &joints(1)), [], "not yet");
    // A push of 4 N against the normal at 0.5 m turns the wheel.
    assert_eq!(tell(&mut node, &joints(2)), [torque(2, -2.0)]);
    assert_eq!(tell(&mut node, &joints(3)), [torque(3, -2.0)]);
    assert_eq!(tell(&mut node, &press(0.0, StimulusStart::Next)), []);
    assert_eq!(tell(&mut node, &joints(4)), [torque(4, 0.0)]);
    assert_eq!(tell(&mut node, &joints(5)), []);
    let (heard, refused) = heard(&mut node);
    assert_eq!(heard, ReceivedCounts { joints: 6, stimuli: 2, torques: 3, ..ReceivedCounts::default() });
    assert_eq!(refused, RejectedCounts::default());
}

// JOINTS-1, JOINTS-4
#[test]
fn repeated_and_old_joints_are_counted_and_any_jump_is_followed() {
    let mut node = settled(FlashState::Valid(wheel()));
    tell(&mut node, &press(4.0, StimulusStart::Next));
    assert_eq!(tell(&mut node, &joints(7)).len(), 1);
    assert_eq!(tell(&mut node, &joints(7)), []);
    for frame in joints(8).encode().frames(Format::Fd) {
        node.handle_frame(NOW, Span(16_001), &frame);
    }
    assert_eq!(drain(&mut node), []);
    assert_eq!(tell(&mut node, &joints(200)).len(), 1);
    assert_eq!(tell(&mut node, &joints(3)).len(), 1);
    let (heard, _) = heard(&mut node);
    assert_eq!((heard.joints, heard.joints_repeated, heard.joints_late), (3, 1, 1));
}

// JOINTS-4, STIM-8
#[test]
fn a_cell_that_hung_latches_the_stimuli_that_came_meanwhile() {
    let mut node = settled(FlashState::Valid(wheel()));
    tell(&mut node, &press(4.0, StimulusStart::Next));
    assert_eq!(tell(&mut node, &joints(0)), [torque(0, -2.0)]);
    // Twenty stimuli and joints waited while it hung, more than can be pending; the last one releases.
    for epoch in 1..=20 {
        tell(&mut node, &press(if epoch < 20 { 3.0 } else { 0.0 }, StimulusStart::Epoch(Epoch(epoch))));
        for frame in joints(epoch).encode().frames(Format::Fd) {
            node.handle_frame(NOW, Span(50_000), &frame);
        }
    }
    assert_eq!(drain(&mut node), []);
    assert_eq!(tell(&mut node, &joints(21)), [torque(21, 0.0)]);
    let (heard, refused) = heard(&mut node);
    assert_eq!((heard.joints, heard.joints_late, refused.stimuli), (2, 20, 0));
}

// CMD-1, CMD-2, STATE-1, SUM-7
#[test]
fn a_halted_cell_is_silent_until_a_resume() {
    let mut node = settled(FlashState::Valid(wheel()));
    tell(&mut node, &press(4.0, StimulusStart::Next));
    assert_eq!(tell(&mut node, &joints(0)).len(), 1);
    assert_eq!(tell(&mut node, &Message::Halt), []);
    assert_eq!(tell(&mut node, &joints(1)), []);
    let state = heartbeat(&tell(&mut node, &Message::Sync)).state;
    assert!(state.has(State::HALTED) && !state.has(State::ACTIVE));
    assert_eq!(tell(&mut node, &Message::Resume), []);
    assert_eq!(tell(&mut node, &joints(2)), [torque(2, -2.0)]);
}

// BEAT-2
#[test]
fn a_heartbeat_that_is_due_before_the_next_joints_is_sent_with_the_answer_and_keeps_its_phase() {
    let mut node = settled(FlashState::Valid(wheel()));
    let due = node.poll_timeout();
    let mut epoch = Epoch(0);
    let mut joints_at = |node: &mut Node, at: u64| {
        epoch = epoch.next();
        let joints = Message::Joints { epoch, joints: Joints { in_use: 1, ..Joints::default() } };
        for frame in joints.encode().frames(Format::Fd) {
            node.handle_frame(Micros(at), Span(0), &frame);
        }
        drain(node).len()
    };
    assert_eq!(joints_at(&mut node, due.0 - 16_000), 0, "the next joints come in time for it");
    assert_eq!(node.poll_timeout(), due);
    assert_eq!(joints_at(&mut node, due.0 - 15_999), 1);
    assert_eq!(node.poll_timeout(), due + HEARTBEAT_INTERVAL, "neither drifts nor comes twice");
    node.handle_timeout(due);
    assert_eq!(drain(&mut node), []);
    // Without joints it is sent when it is due.
    node.handle_timeout(due + HEARTBEAT_INTERVAL);
    assert_eq!(drain(&mut node).len(), 1);
}

// CLAIM-1, CLAIM-5, BEAT-1, BEAT-4
#[test]
fn heartbeats_come_four_times_a_second_at_the_cells_own_phase() {
    let mut node = Node::new(identity(), Format::Fd, &FlashState::Valid(wheel()), true, Micros(0));
    assert_eq!(drain(&mut node), [], "nothing yet");
    let mut times = vec![];
    while times.len() < 4 {
        let at = node.poll_timeout();
        node.handle_timeout(at - Span(1));
        assert_eq!(drain(&mut node), [], "early is harmless");
        node.handle_timeout(at);
        let heartbeat = heartbeat(&drain(&mut node));
        assert_eq!(heartbeat.state.has(State::CLAIMING_NODE_ID), times.is_empty());
        times.push((at.0, heartbeat.sent));
    }
    assert_eq!(times, [(44_000, 0), (305_764, 1), (555_764, 2), (805_764, 3)]);
    // A hang of a second costs its heartbeats and keeps the phase.
    node.handle_timeout(Micros(2_000_000));
    assert_eq!(node.poll_timeout(), Micros(2_055_764));
}

// CLAIM-3, CLAIM-6, CLAIM-7
#[test]
fn a_claiming_cell_gives_way_to_the_owner_of_the_node_id() {
    let mut other = settled(FlashState::Valid(wheel()));
    // The newcomer's claim reaches the owner, which defends its node id.
    let (mut newcomer, claim) = claiming(Identity { serial: 7, ..identity() });
    let defence = tell(&mut other, &claim);
    assert!(heartbeat(&defence).state.has(State::DUPLICATE));
    assert_eq!(newcomer.other_owner(), None);
    tell(&mut newcomer, &defence[0]);
    assert_eq!(newcomer.other_owner(), Some(100_012));
    assert_eq!(other.other_owner(), None);
    // Two settled cells notice each other and do not answer each other forever.
    assert_eq!(tell(&mut other, &defence[0]), []);
    assert!(heartbeat(&tell(&mut other, &Message::Sync)).state.has(State::DUPLICATE));
}

// CLAIM-3
#[test]
fn of_two_simultaneous_claims_the_lower_serial_number_wins() {
    let (mut low, from_low) = claiming(Identity { serial: 1, ..identity() });
    let (mut high, from_high) = claiming(Identity { serial: 2, ..identity() });
    tell(&mut low, &from_high);
    tell(&mut high, &from_low);
    assert_eq!((low.other_owner(), high.other_owner()), (None, Some(1)));
}

// CLAIM-2, JOINTS-5, STIM-8
#[test]
fn a_claiming_cell_listens_and_answers_nothing() {
    let (mut node, _) = claiming(identity());
    let to = Address::Everyone;
    let request = Message::Configure { to, tag: 0, request: Request::Read { number: 0 } };
    for message in [Message::Sync, Message::Report, request, press(4.0, StimulusStart::Next), joints(0)] {
        assert_eq!(tell(&mut node, &message), []);
    }
    node.handle_timeout(node.poll_timeout());
    assert_eq!(drain(&mut node).len(), 1);
    assert_eq!(tell(&mut node, &joints(1)), [torque(1, -2.0)], "the stimulus was latched");
}

// CONF-8, STATE-3
#[test]
fn a_cell_without_sound_flash_flags_it_and_sends_no_torque() {
    let mut node = settled(FlashState::Damaged);
    tell(&mut node, &press(4.0, StimulusStart::Next));
    assert_eq!(tell(&mut node, &joints(0)), []);
    let heartbeat = heartbeat(&tell(&mut node, &Message::Sync));
    assert!(heartbeat.state.has(State::FLASH_DAMAGED) && !heartbeat.state.has(State::CONFIGURED));
    assert_eq!((heartbeat.configuration, heartbeat.state.joint()), (0, 0));
}

// CONF-1, CONF-2, CONF-5, CONF-7, CONF-12
#[test]
fn a_configuration_is_taken_as_a_whole_or_not_at_all() {
    let mut node = settled(FlashState::Damaged);
    let to = Address::Cell(cell());
    let request = |node: &mut Node, request| {
        let answer = tell(node, &Message::Configure { to, tag: 77, request });
        match answer.as_slice() {
            [Message::Configured { tag: 77, answer, .. }] => Some(*answer),
            [] => None,
            other => panic!("{other:?}"),
        }
    };
    for parameter in Parameter::stored_for_rows(1) {
        let (number, words) = (parameter.number(), wheel().words(parameter));
        let answer = request(&mut node, Request::Write { number, words });
        assert_eq!(answer, Some(Answer::Value { number, written: true, words }));
        assert_eq!(
            request(&mut node, Request::Read { number }),
            Some(Answer::Value { number, written: false, words })
        );
    }
    let commit = |hash: u16| Request::Write { number: 127, words: pad_with_zeros([hash.cast_signed()]) };
    let refused = |reason| Some(Answer::Refused { number: 127, reason });
    assert_eq!(request(&mut node, commit(wheel().hash() ^ 1)), refused(Answer::REFUSED_WRONG_HASH));
    assert_eq!(tell(&mut node, &joints(0)), [], "still not configured");

    assert_eq!(request(&mut node, commit(wheel().hash())), None, "flash first");
    assert_eq!(node.poll_store(), Some(FlashContent { number: Some(cell()), parameters: Some(wheel()) }));
    node.handle_stored(false);
    let failed =
        Message::Configured { from: cell(), tag: 77, answer: refused(Answer::REFUSED_FLASH_FAILED).unwrap() };
    assert_eq!(drain(&mut node), [failed]);

    request(&mut node, commit(wheel().hash()));
    node.handle_stored(true);
    assert_eq!(drain(&mut node).len(), 1);
    assert_eq!(node.poll_store(), None);
    tell(&mut node, &press(4.0, StimulusStart::Next));
    assert_eq!(tell(&mut node, &joints(1)), [torque(1, -2.0)]);
    let state = heartbeat(&tell(&mut node, &Message::Sync)).state;
    assert!(state.has(State::CONFIGURED) && !state.has(State::FLASH_DAMAGED), "repaired");

    // An invalid value is refused, and the active parameters stay in use.
    let mut words = wheel().words(Parameter::Mount);
    words[0] = 2;
    request(&mut node, Request::Write { number: 1, words });
    let hash = Parameters { joint: 2, ..wheel() }.hash();
    assert_eq!(request(&mut node, commit(hash)), refused(3));
    assert_eq!(tell(&mut node, &joints(2)), [torque(2, -2.0)]);
    assert_eq!(
        request(&mut node, Request::Read { number: 99 }),
        Some(Answer::Refused { number: 99, reason: Answer::REFUSED_UNKNOWN_PARAMETER })
    );
}

// STIM-1
#[test]
fn a_write_that_is_refused_changes_nothing() {
    let mut node = settled(FlashState::Damaged);
    let to = Address::Cell(cell());
    let mut mount = |request| match *tell(&mut node, &Message::Configure { to, tag: 7, request }).as_slice() {
        [Message::Configured { answer, .. }] => answer,
        ref other => panic!("{other:?}"),
    };
    let number = Parameter::Mount.number();
    let staged = pad_with_zeros([1, 7]);
    let value = |written| Answer::Value { number, written, words: staged };
    assert_eq!(mount(Request::Write { number, words: staged }), value(true), "it is looked at with the rest");
    for (words, reason) in [([300, 5], 3), ([2, -1], 2), ([300, 300], 2)] {
        let refused = Answer::Refused { number, reason };
        assert_eq!(mount(Request::Write { number, words: pad_with_zeros(words) }), refused, "{words:?}");
        assert_eq!(mount(Request::Read { number }), value(false), "{words:?}");
    }
}

#[test]
fn a_cell_that_measures_refuses_stimuli() {
    let mut node = settled(FlashState::Valid(wheel()));
    let to = Address::Everyone;
    tell(
        &mut node,
        &Message::Configure { to, tag: 0, request: Request::Write { number: 5, words: [0; WORDS] } },
    );
    tell(&mut node, &press(4.0, StimulusStart::Next));
    assert_eq!(tell(&mut node, &joints(0)), []);
    assert_eq!(heard(&mut node).1.stimuli, 1);
}

// COUNT-1, JOINTS-2
#[test]
fn what_cannot_be_used_is_counted_by_its_reason() {
    let mut node = settled(FlashState::Valid(wheel()));
    let mut hear = |frame: Frame| node.handle_frame(NOW, Span(0), &frame);
    let good = joints(0).encode().frames(Format::Fd).next().unwrap();
    let mut wrong_crc = *good.data().first_chunk::<16>().unwrap();
    wrong_crc[15] ^= 1;
    hear(Frame::fd(0x001, 1, &wrong_crc).unwrap());
    hear(Frame::fd(0x001, 1, &good.data()[..12]).unwrap());
    hear(Frame::classic(0x001, &good.data()[..8]).unwrap());
    hear(Frame::remote(0x001, 8).unwrap());
    hear(Packet { count: 7, ..joints(0).encode() }.frames(Format::Fd).next().unwrap());
    hear(Packet { count: 2, ..joints(0).encode() }.frames(Format::Fd).next().unwrap()); // a robot of two joints
    hear(Frame::fd(0x2FF, 1, &[0; 16]).unwrap()); // not for this cell
    let (_, refused) = heard(&mut node);
    assert_eq!(
        refused,
        RejectedCounts { length: 2, crc: 1, foreign: 1, meaning: 2, incomplete: 0, stimuli: 0 }
    );
    assert_eq!(heartbeat(&tell(&mut node, &Message::Sync)).rejected, 6);
}

// TORQUE-2, STATE-2
#[test]
fn a_torque_that_does_not_fit_is_marked_as_saturated() {
    let mut node = settled(FlashState::Valid(wheel()));
    tell(&mut node, &press(31.0, StimulusStart::Next));
    assert_eq!(tell(&mut node, &joints(0)), [torque(0, -100.0)]);
    assert!(heartbeat(&tell(&mut node, &Message::Sync)).state.has(State::SATURATED));
    assert!(!heartbeat(&tell(&mut node, &Message::Sync)).state.has(State::SATURATED), "since the last one");
}

// COUNT-3
#[test]
fn the_classic_format_works_in_segments() {
    let flash = FlashState::Valid(wheel());
    let mut node = settle(Node::new(identity(), Format::Classic, &flash, true, Micros(0)));
    let hear = |node: &mut Node, message: &Message| {
        for frame in message.encode().frames(Format::Classic) {
            node.handle_frame(NOW, Span(0), &frame);
        }
        drain(node)
    };
    assert_eq!(hear(&mut node, &press(4.0, StimulusStart::Next)), []);
    assert_eq!(hear(&mut node, &joints(0)), [torque(0, -2.0)]);
    // A lost segment loses its packet but not the next one.
    let first = joints(1).encode().frames(Format::Classic).next().unwrap();
    node.handle_frame(NOW, Span(0), &first);
    assert_eq!(hear(&mut node, &joints(2)), [torque(2, -2.0)]);
    // The distance of segments depends on their arrival, not on the time of processing.
    let within = Reassembler::max_gap(Id::command(Command::Joints));
    let mut apart = |epoch, second: Micros, age| {
        let mut segments = joints(epoch).encode().frames(Format::Classic);
        node.handle_frame(NOW, Span(0), &segments.next().unwrap());
        node.handle_frame(second, age, &segments.next().unwrap());
        drain(&mut node)
    };
    assert_eq!(apart(3, NOW + within + Span(7), Span(7)), [torque(3, -2.0)]);
    assert_eq!(apart(4, NOW + within + Span(7), Span(6)), []);
}

#[test]
fn the_age_of_a_packet_is_that_of_its_last_segment() {
    // JOINTS-4: the segments arrive 10 ms apart, twice the period.
    let flash = FlashState::Valid(Parameters { period_us: 5_000, ..wheel() });
    let mut node = settle(Node::new(identity(), Format::Classic, &flash, true, Micros(0)));
    for (segment, age) in [(0, Span(0)), (1, Span(5_000))] {
        let frame = joints(1).encode().frames(Format::Classic).nth(segment).unwrap();
        node.handle_frame(NOW + Span(segment as u64 * 10_000), age, &frame);
    }
    drain(&mut node);
    assert_eq!(node.received, ReceivedCounts { joints: 1, ..ReceivedCounts::default() });
}

#[test]
fn skipped_joints_leave_active_as_it_is() {
    // STATE-1
    let mut node = settled(FlashState::Valid(wheel()));
    tell(&mut node, &press(4.0, StimulusStart::Next));
    assert_eq!(tell(&mut node, &joints(0)), [torque(0, -2.0)]);
    tell(&mut node, &press(0.0, StimulusStart::Next));
    for frame in joints(1).encode().frames(Format::Fd) {
        node.handle_frame(NOW, Span(16_001), &frame);
    }
    assert!(heartbeat(&tell(&mut node, &Message::Sync)).state.has(State::ACTIVE));
    assert_eq!(tell(&mut node, &joints(2)), [torque(2, 0.0)]);
    assert!(!heartbeat(&tell(&mut node, &Message::Sync)).state.has(State::ACTIVE));
}

#[test]
fn joints_need_not_wake_a_cell_that_nothing_touches() {
    let rests = |node: &Node| node.may_receive_deferred(Id::command(Command::Joints));
    let mut node = settled(FlashState::Valid(wheel()));
    let mut epochs = 0..;
    let mut hear = |node: &mut Node, count| {
        for epoch in epochs.by_ref().take(count) {
            tell(node, &joints(epoch));
        }
        (node.poll_received_ids(), rests(node))
    };
    assert_eq!(hear(&mut node, 15), (false, false));
    assert_eq!(hear(&mut node, 1), (true, true));
    assert_eq!(hear(&mut node, 30), (false, true));
    tell(&mut node, &press(4.0, StimulusStart::Next));
    assert_eq!((node.poll_received_ids(), rests(&node)), (true, false), "before the joints that it answers");
    assert_eq!(hear(&mut node, 40), (false, false), "touched");
    tell(&mut node, &press(0.0, StimulusStart::Next));
    assert_eq!(hear(&mut node, 17), (true, true), "one answer of zero, and 16 joints");
    tell(&mut node, &press(4.0, StimulusStart::Epoch(Epoch(130))));
    assert_eq!(hear(&mut node, 20), (true, false), "a stimulus waits");
}

#[test]
fn no_frame_makes_a_cell_panic() {
    use proptest::prelude::*;
    let frames =
        proptest::collection::vec((0_u32..0x800, proptest::collection::vec(any::<u8>(), 0..=64)), 0..40);
    proptest!(|(frames in frames)| {
        let mut node = settled(FlashState::Valid(wheel()));
        for (id, data) in frames {
            // With a correct CRC, so that the code after the check is reached.
            let id = Id::from_bits(u16::try_from(id).unwrap() & 0x70F | 12);
            let length = Length::ALL[data.len() % 4];
            let mut words = [0_i16; MAX_JOINTS];
            for (word, chunk) in words.iter_mut().zip(data.as_chunks::<2>().0) {
                *word = i16::from_le_bytes(*chunk);
            }
            let (epoch, count) = (Epoch(data.first().copied().unwrap_or(0)), data.last().copied().unwrap_or(0));
            let words = Words::new(length, words);
            for frame in (Packet { id, words, epoch, count }).frames(Format::Fd) {
                node.handle_frame(NOW, Span(0), &frame);
            }
            node.handle_frame(NOW, Span(0), &Frame::fd(u32::from(id.to_bits()), 0, &data).unwrap());
            node.handle_stored(true);
            while node.poll_transmit().is_some() {}
        }
    });
}
