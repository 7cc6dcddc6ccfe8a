//! Parameters: reading, staging, the hash, the commit, and the addressing of requests.

use protocol::fixed::{Q1_14, Q3_12};
use protocol::id::{CellId, Node};
use protocol::message::{Message, Request};
use protocol::packet::{WORDS, padded_words};
use protocol::parameters::{MAX_JOINTS, Parameter, Parameters};

use crate::arm;
use crate::bus::StopReason;
use crate::session::{Reply, Session};

/// Returns a configuration that differs from `arm::document` in each parameter.
fn all_different_parameters() -> Parameters {
    let mut other = Parameters { joint: 6, period_us: 50_000, ..arm::example_parameters(6) };
    other.contact.alpha_c = Q3_12::from_bits(5_000);
    other.pose.position = [0x0777, -0x0333, 0x0123].map(Q1_14::from_bits);
    for (row, step) in other.rows.iter_mut().zip(1..=6) {
        row.theta_offset = Q1_14::from_bits(0x0101 * step);
    }
    other
}

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    let (one, other) = (arm::example_parameters(2), all_different_parameters());
    if !session.prepare_cell(&one)? {
        return Ok(());
    }
    check_parameter_reads(session, &one, "CONF-1")?;
    session.stage_parameters(&other)?;
    // Staged values are neither read, hashed nor used for computing.
    check_parameter_reads(session, &one, "CONF-2")?;
    session.exchange_messages(&[])?;
    check_torque_parameters(session, &one, &other, "CONF-2")?;
    if session.about.test_mode {
        // The joints of the chain are those in use, too.
        session.stage_parameters(&Parameters { joints: 3, joint: 3, ..other })?;
        let step = session.stimulate_and_send_joints(&[0x0222; MAX_JOINTS], arm::press_with_sum(4_096))?;
        session.check("JOINTS-2", step.torque.is_some(), || {
            "while a shorter chain is staged, the cell must answer joints messages of the chain in use, but it did \
             not"
                .to_owned()
        });
        session.stimulate_and_send_joints(&[0x0222; MAX_JOINTS], arm::press_with_sum(0))?;
        session.stage_parameters(&other)?;
    }
    for wrong in [0x0001, 0x0080, 0x0100, 0x8000, 0xFFFF, one.hash() ^ other.hash(), other.hash()] {
        let hash = other.hash() ^ wrong;
        let reply = session.write_first_words(Parameter::Commit.number(), [hash.cast_signed()])?;
        session.check("CONF-7", reply == Reply::Refused(16), || {
            format!("a commit with hash {hash:04X} while {:04X} is staged must be refused with reason 16, but the answer was {reply}", other.hash())
        });
    }
    check_parameter_reads(session, &one, "CONF-5")?;
    session.known.active = None;
    session.commit_parameters(&other)?;
    check_parameter_reads(session, &other, "CONF-7")?;
    session.exchange_messages(&[])?;
    check_torque_parameters(session, &other, &one, "CONF-7")?;
    let reply = session.read_parameter(Parameter::Commit.number())?;
    session.check("CONF-1", reply == Reply::Value([0; WORDS]), || {
        format!("the commit parameter (127) must read as 0, but it reads as {reply}")
    });
    check_unused_words_zeroed(session)?;
    check_answer_tags(session)
}

/// Checks that each stored parameter reads as the value in use.
fn check_parameter_reads(
    session: &mut Session<'_>,
    expected: &Parameters,
    id: &'static str,
) -> Result<(), StopReason> {
    for parameter in Parameter::stored_for_rows(6) {
        let reply = session.read_parameter(parameter.number())?;
        let words = expected.words(parameter);
        session.check(id, reply == Reply::Value(words), || {
            format!(
                "parameter {} reads as {reply}, but it must read as {}",
                parameter.number(),
                Reply::Value(words)
            )
        });
    }
    Ok(())
}

/// Checks that the torque follows from the parameters `expected`, and not from `not`.
fn check_torque_parameters(
    session: &mut Session<'_>,
    expected: &Parameters,
    not: &Parameters,
    id: &'static str,
) -> Result<(), StopReason> {
    if !session.about.test_mode {
        return Ok(());
    }
    let positions = [0x0111, -0x1222, 0x2333, 0x0444, -0x0555, 0x0666, 0, 0, 0, 0, 0, 0, 0, 0];
    debug_assert_eq!(positions.len(), MAX_JOINTS);
    let press = arm::press_with_sum(4_096);
    let step = session.stimulate_and_send_joints(&positions, press)?;
    let near = |parameters: &Parameters| {
        let central = model::central::CentralComputation::for_single_cell(parameters);
        let exact = arm::exact_jacobian(&central, &positions);
        let force = arm::expected_force(&parameters.contact, &press);
        let word = |x: f64| {
            i32::from(arm::torque_word(Q1_14::nearest(x).to_bits(), force, parameters.torque_format))
        };
        step.words().iter().zip(exact).all(|(got, x)| (i32::from(*got) - word(x)).abs() <= 24)
    };
    debug_assert!(!near(expected) || !near(not), "they are apart");
    session.check(id, near(expected), || {
        format!(
            "the torque words must follow from the parameters in use, but they are {}",
            arm::format_words(&step.words())
        )
    });
    session.stimulate_and_send_joints(&positions, arm::press_with_sum(0))?;
    Ok(())
}

/// Checks that words which a parameter does not use become 0, in the answer to a write and in the hash.
fn check_unused_words_zeroed(session: &mut Session<'_>) -> Result<(), StopReason> {
    let expected = Parameters { period_us: 57_001, ..arm::example_parameters(3) };
    session.stage_parameters(&expected)?;
    session.known.staged = None;
    for parameter in Parameter::stored_for_rows(6).filter(|it| *it != Parameter::Pose) {
        let clean = expected.words(parameter);
        let used = if parameter == Parameter::Timing { 1 } else { 5 };
        let mut dirty = clean;
        dirty
            .iter_mut()
            .skip(used)
            .zip([0x1234, -2, 7, 0x7FFF, i16::MIN])
            .for_each(|(word, junk)| *word = junk);
        let reply = session.write_parameter(parameter.number(), dirty)?;
        session.check("CONF-3", reply == Reply::Value(clean), || {
            format!(
                "the unused words in a write of parameter {} must become 0, but the answer was {reply}",
                parameter.number()
            )
        });
    }
    let hash = expected.hash();
    let reply = session.write_parameter(Parameter::Commit.number(), [hash.cast_signed(), 1, 2, 3, 4, 5])?;
    let is_so = reply == Reply::Value(padded_words([hash.cast_signed()]));
    session.check("CONF-3", is_so, || {
        format!(
            "the hash must count unused words as 0, but a commit with that hash ({hash:04X}) was answered \
             with {reply}"
        )
    });
    if is_so {
        session.known.parameters = Some(expected);
        session.known.staged = Some(expected);
        session.known.hash = Some(hash);
        session.known.active = None;
        check_parameter_reads(session, &expected, "CONF-3")?;
    } else {
        session.known.parameters = None;
        session.known.hash = None;
    }
    Ok(())
}

fn check_answer_tags(session: &mut Session<'_>) -> Result<(), StopReason> {
    let own = Node::Cell(session.cell);
    let (number, on) = (Parameter::Mode.number(), i16::from(session.about.test_mode));
    for tag in [0, 1, 0x7E, 0x7F, 0x80, 0xFE, 0xFF, 0xFF, 0] {
        session.request_with(own, tag, Request::Read { number: 2 })?;
        session.request_with(own, tag, Request::Write { number, words: padded_words([on]) })?;
        session.request_with(own, tag, Request::Read { number: 99 })?;
    }
    // An identical request is answered each time.
    let pose = arm::example_parameters(3).words(Parameter::Pose);
    let hash = session.known.hash.unwrap_or_default().cast_signed();
    session.write_parameter(Parameter::Pose.number(), pose)?;
    let staged = session.known.staged.take();
    let requests = [
        (Request::Read { number: 2 }, "CONF-1"),
        (Request::Write { number: 2, words: pose }, "CONF-4"),
        (Request::Write { number, words: padded_words([on]) }, "CONF-4"),
        (Request::Write { number: 0, words: [1; 6] }, "CONF-6"),
        (Request::Write { number: Parameter::Commit.number(), words: padded_words([!hash]) }, "CONF-6"),
    ];
    for (request, id) in requests {
        let replies = [session.request_with(own, 0x2A, request)?, session.request_with(own, 0x2A, request)?];
        let [first, second] = replies;
        session.check(id, first == second, || {
            format!(
                "the same request must get the same answer again, but the second answer was {second}, and \
                 the first was {first}"
            )
        });
    }
    session.known.staged =
        staged.map(|staged| Parameters { pose: arm::example_parameters(3).pose, ..staged });
    session.known.skin = session.about.test_mode.then(Default::default);
    session.known.pending = None;
    Ok(())
}

/// Checks the answers to requests to everyone and to other cells, and to requests for parameters that do not exist.
pub(super) fn check_addressing(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::example_parameters(2))?;
    let reply = session.request(Node::Everyone, Request::Read { number: 2 })?;
    let expected = arm::example_parameters(2).words(Parameter::Pose);
    session.check("CONF-11", reply == Reply::Value(expected), || {
        format!("a read sent to everyone must return the value in use, but the answer was {reply}")
    });
    let number = Parameter::Pose.number();
    let pose = all_different_parameters().words(Parameter::Pose);
    let reply = session.request(Node::Everyone, Request::Write { number, words: pose })?;
    session.check("CONF-11", reply == Reply::Value(pose), || {
        format!(
            "a write sent to everyone must be answered with the written words, but the answer was {reply}"
        )
    });
    let on = [i16::from(session.about.test_mode), 0, 0, 0, 0, 0];
    let mode = Request::Write { number: Parameter::Mode.number(), words: on };
    let reply = session.request(Node::Everyone, mode)?;
    session.check("CONF-11", reply == Reply::Value(on), || {
        format!(
            "a write of the mode (parameter 5) sent to everyone must be answered with the written words, but \
             the answer was {reply}"
        )
    });
    let staged = Parameters { pose: all_different_parameters().pose, ..arm::example_parameters(2) };
    session.known.staged = Some(staged);
    // A commit to everyone is a commit of this cell.
    let hash = padded_words([staged.hash().cast_signed()]);
    let commit = Request::Write { number: Parameter::Commit.number(), words: hash };
    let reply = session.request(Node::Everyone, commit)?;
    session.check("CONF-11", reply == Reply::Value(hash), || {
        format!("a commit sent to everyone must be answered with its hash, but the answer was {reply}")
    });
    session.known.active = None;
    let done = reply == Reply::Value(hash);
    (session.known.parameters, session.known.hash) =
        if done { (Some(staged), Some(staged.hash())) } else { (None, None) };
    session.exchange_messages(&[])?;
    session.commit_parameters(&staged)?;
    check_unknown_parameters(session)?;
    check_other_cells_ignored(session)
}

fn check_unknown_parameters(session: &mut Session<'_>) -> Result<(), StopReason> {
    for number in (10..=10).chain(13..16).chain(48..127) {
        // Reads and writes alternate.
        let reply = if number % 2 == 0 {
            session.read_parameter(number)?
        } else {
            session.write_first_words(number, [1, 2, 3])?
        };
        session.check("CONF-13", reply == Reply::Refused(18), || {
            format!("parameter {number} does not exist and must be refused with reason 18 (unknown parameter), but the answer was {reply}")
        });
    }
    for number in [10, 15, 48, 126] {
        let replies = [session.read_parameter(number)?, session.write_first_words(number, [0])?];
        session.check("CONF-13", replies == [Reply::Refused(18); 2], || {
            let [read, write] = replies;
            format!(
                "parameter {number} does not exist and must be refused with reason 18 (unknown parameter), but a read was \
                 answered with {read} and a write with {write}"
            )
        });
    }
    Ok(())
}

/// Checks that a packet for another cell gets no answer and has no effect.
fn check_other_cells_ignored(session: &mut Session<'_>) -> Result<(), StopReason> {
    let before = session.counters()?;
    let own = session.cell.get();
    let near = [own ^ 1, own ^ 0x80, own.wrapping_add(1), own.wrapping_sub(1)];
    let cells = near.into_iter().filter(|node| *node != own);
    for cell in cells.filter_map(|node| CellId::new(node.into()).ok()) {
        let to = Node::Cell(cell);
        let read = Message::Configure { to, tag: 9, request: Request::Read { number: 0 } };
        let press = protocol::message::SensorPage::Skin(arm::press_with_sum(4_096));
        let press = Message::Stimulus { to, from: protocol::message::StimulusStart::Next, page: press };
        let exchange = session.exchange_messages(&[read, press])?;
        session.check("ID-2", exchange.is_silent(), || {
            format!("this cell must not answer a request to cell {cell}, but it did")
        });
        session.send_next_joints(&[0; MAX_JOINTS])?;
    }
    let after = session.counters()?;
    session.check("COUNT-1", before.refused == after.refused, || {
        format!("packets for other cells must not be counted, but the counters are {after}; before: {before}")
    });
    Ok(())
}
