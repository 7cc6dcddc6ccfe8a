//! Tests on single cells. `tests/tests/virtual/bench_explain.rs` explains whole benches.

use super::*;
use protocol::fixed::{Q1_14, Q5_10};
use protocol::id::{CellId, Node};
use protocol::message::{Heartbeat, Joints, Message, NetworkPage, Request, SensorPage, State, StimulusStart};
use protocol::packet::pad_with_defaults;
use protocol::packet::{self, Epoch};
use protocol::parameters::Parameter;

/// Returns a skin with cell 12 of the protocol document on the second link of a UR5. The next functions return the
/// joints, the touch and the torque of that document.
fn skin() -> Skin {
    let cell = "node = 12\njoint = 2\nposition = [0.1, 0.05, 0.06]";
    let text =
        model::testing::ONE_CELL_SKIN_TOML.replace("node = 1\njoint = 3\nposition = [0.2, 0.01, 0.15]", cell);
    let text = text.replace("[0.7071068, 0.0, 0.0, 0.7071068]", "[-0.4472135955, 0.0, 0.0, 0.894427191]");
    let contact =
        "alpha_p = 0.0\ncontact_threshold_n = 0.1\nproximity_threshold = 0.05\nforce_threshold_n = 0.1";
    let before =
        "alpha_p = 2.0\ncontact_threshold_n = 0.1\nproximity_threshold = 0.25\nforce_threshold_n = 0.3";
    let skin = Skin::parse("document.toml", &text.replace(before, contact)).unwrap();
    assert_eq!(skin.parameters(&skin.cells[0]).hash(), 0x266D, "the document's configuration");
    skin
}

fn cell() -> CellId {
    CellId::new(12).unwrap()
}

fn joints(epoch: u8) -> Message {
    let words: [u16; 6] = [0, 0xCF1C, 0x28BE, 0xC6F5, 0xC008, 0];
    let positions = words.map(|word| Q1_14::from_bits(word.cast_signed()));
    Message::Joints {
        epoch: Epoch(epoch),
        joints: Joints { positions: pad_with_defaults(&positions), in_use: 6 },
    }
}

fn press(from: StimulusStart, newtons: f64) -> Message {
    let page =
        SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() });
    Message::Stimulus { to: Node::Cell(cell()), from, page }
}

fn torque(epoch: u8, words: [i16; 2]) -> Message {
    Message::Torque { from: cell(), epoch: Epoch(epoch), torque: packet::padded_words(words).into() }
}

fn heartbeat(configuration: u16) -> Message {
    let state = State::CONFIGURED.with_flags(State::TEST_MODE, true);
    let page = NetworkPage::Heartbeat(Heartbeat { configuration, state, sent: 7, ..Heartbeat::default() });
    Message::Network { from: Node::Cell(cell()), epoch: Epoch(0), page }
}

/// Derives the torques at the requested joints from these messages, which are sent 1 ms apart.
fn explained(
    skin: &Skin,
    messages: &[Message],
    requested: RequestedJoints,
) -> Result<TorqueExplanation, JointsNotFound> {
    let mut watch = JointsWatcher::new(skin, requested);
    for (at, message) in (1..).zip(messages) {
        if watch.receive(at * 1_000_000, "vcan0", Some(message)) {
            break;
        }
    }
    watch.into_joints().map(|moments| explain(skin, &moments))
}

fn first(epoch: u8) -> RequestedJoints {
    RequestedJoints { epoch: Epoch(epoch), from_ns: 0, occurrence: 1 }
}

#[test]
fn the_worked_example_of_the_document_is_explained_step_by_step() {
    let skin = skin();
    let said = [heartbeat(0x266D), press(StimulusStart::Next, 1.0), joints(7), torque(7, [-1075, 3195])];
    let explanation = explained(&skin, &said, first(7)).unwrap();
    assert_eq!(explanation.missing, Vec::<String>::new());
    let [cell] = explanation.cells.as_slice() else { panic!("{explanation:?}") };
    let force = cell.force.unwrap();
    assert_eq!((force.force_steps, force.touch_n.to_bits()), (196_608, 3.0_f64.to_bits()));
    assert_eq!(force.origin, ContactOrigin::Stimulus { at_ns: 2_000_000, from_epoch: None, late: false });
    assert_eq!(cell.answered_after_ns, Some(1_000_000));
    let jacobian: Vec<_> =
        cell.rows.iter().map(|row| Q1_14::nearest(row.jacobian_m.unwrap()).to_bits()).collect();
    assert_eq!(jacobian, [-1433, 4260, 0, 0, 0, 0]);
    assert_eq!(cell.rows.iter().map(|row| row.word.unwrap()).collect::<Vec<_>>(), [-1075, 3195, 0, 0, 0, 0]);
    for row in &cell.rows {
        let off = row.product_nm.unwrap() * 4_096.0 - f64::from(row.nearest_word.unwrap());
        assert!(off.abs() <= 0.5, "{row:?}");
        assert!(!matches!(row.verdict, WordVerdict::Unexplained | WordVerdict::Open), "{row:?}");
    }
    assert_eq!(explanation.total[1].word_steps, 3195);
}

#[test]
fn a_word_that_no_jacobian_near_makes_is_not_explained() {
    let skin = skin();
    let verdicts = |words| {
        let said = [heartbeat(0x266D), press(StimulusStart::Next, 1.0), joints(7), torque(7, words)];
        let explanation = explained(&skin, &said, first(7)).unwrap();
        [0, 1].map(|at| explanation.cells[0].rows[at].verdict)
    };
    // 3 N times 8 steps of 2^-14 m make 6 steps of 2^-12 Nm.
    assert!(matches!(
        verdicts([-1075 + 5, 3195 - 5]),
        [WordVerdict::Rounded { .. }, WordVerdict::Rounded { .. }]
    ));
    assert_eq!(verdicts([-1075 + 9, 3195 - 9]), [WordVerdict::Unexplained; 2]);
    assert_eq!(verdicts([i16::MAX, -3195]), [WordVerdict::Unexplained; 2]);
}

#[test]
fn a_torque_in_a_joint_that_does_not_move_the_cell_is_not_explained() {
    let skin = skin();
    let mut wrong = torque(7, [-1075, 3195]);
    if let Message::Torque { torque, .. } = &mut wrong {
        *torque = [-1075, 3195, 1, 0, 0, 0].into();
    }
    let said = [heartbeat(0x266D), press(StimulusStart::Next, 1.0), joints(7), wrong];
    let explanation = explained(&skin, &said, first(7)).unwrap();
    assert_eq!(explanation.cells[0].rows[2].verdict, WordVerdict::Unexplained);
}

#[test]
fn beyond_the_word_saturated_is_right_and_anything_else_is_not() {
    let skin = skin();
    let verdict = |word| {
        let said =
            [heartbeat(0x266D), press(StimulusStart::Next, 30.0), joints(7), torque(7, [-32_250, word])];
        explained(&skin, &said, first(7)).unwrap().cells[0].rows[1].verdict
    };
    assert_eq!(verdict(i16::MAX), WordVerdict::Saturated);
    assert_eq!(verdict(32_000), WordVerdict::Unexplained);
}

#[test]
fn another_configuration_is_named_and_nothing_computed() {
    let skin = skin();
    let said = [heartbeat(0x1234), press(StimulusStart::Next, 1.0), joints(7), torque(7, [-1075, 3195])];
    let explanation = explained(&skin, &said, first(7)).unwrap();
    let expected = "vcan0 12: its configuration hash is 1234, but the skin's is 266D, so its force and torque \
                    cannot be computed from this skin";
    assert_eq!(explanation.missing, [expected]);
    assert!(explanation.cells[0].force.is_none());
    assert_eq!((explanation.total[0].open, explanation.total[0].word_steps), (1, -1075));
    // Its first report follows the torque; its configuration was the same before.
    let said = [press(StimulusStart::Next, 1.0), joints(7), torque(7, [-1075, 3195]), heartbeat(0x1234)];
    assert_eq!(explained(&skin, &said, first(7)).unwrap().missing, [expected]);
    let without = explained(&skin, &said[..3], first(7)).unwrap();
    let expected =
        "vcan0 12: it did not report its configuration hash, which is assumed to be that of the skin, 266D";
    assert_eq!(without.missing, [expected]);
    assert!(without.cells[0].force.is_some());
}

#[test]
fn a_measuring_cell_is_known_by_its_own_page_of_that_epoch_only() {
    let skin = skin();
    let measuring = {
        let page = NetworkPage::Heartbeat(Heartbeat {
            configuration: 0x266D,
            state: State::CONFIGURED,
            sent: 7,
            ..Heartbeat::default()
        });
        Message::Network { from: Node::Cell(cell()), epoch: Epoch(0), page }
    };
    let page = |epoch| {
        let skin = SkinSensors { contact: [Q5_10::nearest(1.0); 3], ..SkinSensors::default() };
        Message::Sensors { from: cell(), epoch: Epoch(epoch), page: SensorPage::Skin(skin) }
    };
    // A measuring cell refuses a stimulus.
    let said = [measuring, press(StimulusStart::Next, 9.0), page(6), joints(7), torque(7, [-1075, 3195])];
    let explanation = explained(&skin, &said, first(7)).unwrap();
    let expected = "vcan0 12: its contact state is not in the capture: it uses its own sensors, and sent no sensors page in this epoch";
    assert_eq!(explanation.missing, [expected]);
    let with_page = [&said[..], &[page(7)]].concat();
    let explanation = explained(&skin, &with_page, first(7)).unwrap();
    assert_eq!(explanation.missing, Vec::<String>::new());
    assert_eq!(explanation.cells[0].force.unwrap().force_steps, 196_608);
}

#[test]
fn joints_are_found_by_epoch_time_and_occurrence() {
    let skin = skin();
    let said: Vec<_> = (0..=255).chain(0..=20).map(joints).collect();
    let at = |requested: RequestedJoints| {
        explained(&skin, &said, requested).map(|explanation| explanation.buses[0].at_ns / 1_000_000)
    };
    assert_eq!(at(first(7)), Ok(8));
    assert_eq!(at(RequestedJoints { occurrence: 2, ..first(7) }), Ok(264));
    assert_eq!(at(RequestedJoints { from_ns: 100_000_000, ..first(7) }), Ok(264));
    let error = at(RequestedJoints { occurrence: 2, ..first(21) }).unwrap_err().to_string();
    let expected = "the capture contains no joints message of epoch 21 (occurrence 2); it contains 277 in a row, \
                    from epoch 0 at 0.000 s to epoch 20 at 0.276 s";
    assert_eq!(error, expected);
}

#[test]
fn what_is_not_there_is_named_with_what_is() {
    let skin = skin();
    let said = [joints(1), joints(2), joints(9)];
    let error = explained(&skin, &said, first(5)).unwrap_err().to_string();
    let expected = "the capture contains no joints message of epoch 5; it contains 2 in a row, from epoch 1 at \
                    0.000 s to epoch 2 at 0.001 s; one of epoch 9 at 0.002 s";
    assert_eq!(error, expected);
    let error = explained(&skin, &[heartbeat(0)], first(5)).unwrap_err().to_string();
    let expected =
        "the capture contains no joints message on vcan0: record while a gateway runs the control loop";
    assert_eq!(error, expected);
    let mut watch = JointsWatcher::new(&skin, first(5));
    watch.receive(0, "can7", None);
    let error = watch.into_joints().unwrap_err().to_string();
    let expected =
        "the skin has none of the capture's buses (can7), only vcan0: name the skin of this capture";
    assert_eq!(error, expected);
    // Memory is bounded for any input.
    let said: Vec<_> = (0..200).map(|epoch: u8| joints(epoch.wrapping_mul(3))).collect();
    let error =
        explained(&skin, &said, RequestedJoints { occurrence: 9, ..first(5) }).unwrap_err().to_string();
    assert!(error.ends_with("; 192 further runs"), "{error}");
}

#[test]
fn joints_that_a_cell_drops_are_none() {
    let skin = skin();
    let again = [joints(7), joints(7), joints(8), joints(7)];
    let explanation = explained(&skin, &again, RequestedJoints { occurrence: 2, ..first(7) }).unwrap();
    assert_eq!(explanation.buses[0].at_ns, 4_000_000, "the second of them was repeated");
}

#[test]
fn a_torque_after_four_more_joints_is_named_and_not_used() {
    let skin = skin();
    let said = |more: u8| {
        let mut said = vec![heartbeat(0x266D), press(StimulusStart::Next, 1.0), joints(7)];
        said.extend((8..8 + more).map(joints));
        said.push(torque(7, [-1075, 3195]));
        said
    };
    let in_time = explained(&skin, &said(3), first(7)).unwrap();
    assert_eq!((in_time.cells[0].answered_after_ns, in_time.missing), (Some(4_000_000), Vec::new()));
    let late = explained(&skin, &said(4), first(7)).unwrap();
    let expected = "vcan0 12: no torque of this epoch arrived in time: it arrived 5.000 ms after its joints message \
                    and after four newer ones, so it is not used; the sum of received words does not include it";
    assert_eq!((late.cells[0].answered_after_ns, late.missing), (None, vec![expected.to_owned()]));
}

#[test]
fn a_claim_of_an_owned_node_id_changes_nothing() {
    let skin = skin();
    let claim = {
        let heartbeat = Heartbeat { serial: 9, state: State::CLAIMING_NODE_ID, ..Heartbeat::default() };
        let page = NetworkPage::Heartbeat(heartbeat);
        Message::Network { from: Node::Cell(cell()), epoch: Epoch(0), page }
    };
    let mut said = vec![
        heartbeat(0x266D),
        press(StimulusStart::Next, 1.0),
        joints(6),
        joints(7),
        torque(7, [-1075, 3195]),
    ];
    let without = explained(&skin, &said, first(7)).unwrap();
    // The claim replaces other joints, so that the times are equal.
    said[2] = claim;
    let with = explained(&skin, &said, first(7)).unwrap();
    assert_eq!(with, without);
    assert_eq!((with.missing, with.cells.len()), (Vec::new(), 1));
}

#[test]
fn a_late_stimulus_is_called_late_and_a_written_mode_forgets_it() {
    let skin = skin();
    let said = [heartbeat(0x266D), joints(6), press(StimulusStart::Epoch(Epoch(6)), 1.0), joints(7)];
    let origin = |said: &[Message]| {
        let force =
            explained(&skin, &[said, &[torque(7, [0, 0])]].concat(), first(7)).unwrap().cells[0].force;
        force.map(|force| (force.origin, force.force_steps))
    };
    let late = ContactOrigin::Stimulus { at_ns: 3_000_000, from_epoch: Some(6), late: true };
    assert_eq!(origin(&said), Some((late, 196_608)));
    let request = Request::Write { number: Parameter::Mode.number(), words: [1, 0, 0, 0, 0, 0] };
    let mode = Message::Configure { to: Node::Everyone, tag: 0, request };
    let (before, joints) = said.split_at(3);
    let written = [before, &[mode], joints].concat();
    assert_eq!(origin(&written), Some((ContactOrigin::Mode { at_ns: 4_000_000 }, 0)));
}

#[test]
fn joints_of_a_bus_without_cells_are_not_kept() {
    let bus = "[[bus]]\nname = \"vcan1\"\nreply = \"torque\"\nformat = \"fd\"\n\n[controller]";
    let text = model::testing::ONE_CELL_SKIN_TOML.replace("[controller]", bus);
    let skin = Skin::parse("two.toml", &text).unwrap();
    let mut watch = JointsWatcher::for_all_joints(&skin);
    for (at, epoch) in (1..).zip(0..3) {
        for bus in ["vcan0", "vcan1"] {
            watch.receive(at * 1_000_000, bus, Some(&joints(epoch)));
        }
    }
    assert_eq!(watch.pop_joints(0, true).map(|(epoch, _)| epoch), Some(Epoch(0)));
    assert!(watch.pop_joints(1, true).is_none());
}
