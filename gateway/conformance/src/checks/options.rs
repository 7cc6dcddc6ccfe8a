//! Volatile parameters, options that a cell may lack, and contents that it must ignore.

use protocol::can::{Format, Frame};
use protocol::id::{Command, Id, Kind, Node};
use protocol::message::{Message, State};
use protocol::packet::{Epoch, Packet, WORDS, padded_words};
use protocol::parameters::{Events, MAX_JOINTS, Parameter};

use crate::arm;
use crate::bus::StopReason;
use crate::session::{Reply, Session};

const REPLY_PARAMETER: u8 = 6;
const SENSING_PARAMETER: u8 = 7;
const EVENTS_PARAMETER: u8 = 8;
const LINKS_PARAMETER: u8 = 9;
const BASELINE_PARAMETER: u8 = 11;
const TARE_PARAMETER: u8 = 12;

pub(super) fn check_switches(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::example_parameters(2))?;
    session.known.senses = true;
    check_test_mode(session)?;
    check_reply_mode(session)?;
    check_sensing_parameters(session)?;
    check_no_baseline(session)?;
    check_links(session)?;
    check_impossible_row(session)?;
    session.write_first_words(SENSING_PARAMETER, [0])?;
    session.wait_for_late_packets()?;
    session.known.senses = false;
    Ok(())
}

/// Writes a parameter, and checks the reply.
fn expect_reply(
    session: &mut Session<'_>,
    id: &'static str,
    number: u8,
    written: [i16; WORDS],
    expected: Reply,
) -> Result<(), StopReason> {
    let reply = session.write_parameter(number, written)?;
    session.check(id, reply == expected, || {
        format!("a write of {} to parameter {number} must be answered with {expected}, but the answer was {reply}", Reply::Value(written))
    });
    Ok(())
}

/// Writes an impossible value, and checks that it is refused and changes nothing.
fn expect_refusal(
    session: &mut Session<'_>,
    id: &'static str,
    number: u8,
    written: [i16; WORDS],
) -> Result<(), StopReason> {
    let before = session.read_parameter(number)?;
    expect_reply(session, id, number, written, Reply::Refused(19))?;
    let after = session.read_parameter(number)?;
    session.check("CONF-5", before == after, || {
        format!("a refused write must not change parameter {number}, but changed it from {before} to {after}")
    });
    Ok(())
}

/// Checks that a write of 1 to parameter 5 switches test mode on at once, and that every other value switches it off.
fn check_test_mode(session: &mut Session<'_>) -> Result<(), StopReason> {
    if !session.about.test_mode {
        expect_reply(session, "OPT-1", 5, [0; WORDS], Reply::Value([0; WORDS]))?;
        return expect_refusal(session, "OPT-1", 5, padded_words([1]));
    }
    for (written, on) in
        [(2, false), (1, true), (-1, false), (1, true), (0x0101, false), (0, false), (1, true)]
    {
        let junk = [written, 7, -7, 9, 0x7FFF, 1];
        expect_reply(session, "CONF-3", 5, junk, Reply::Value(padded_words([on.into()])))?;
        session.known.test_mode = Some(on);
        session.known.skin = on.then(Default::default);
        let reply = session.read_parameter(5)?;
        session.check("CONF-9", reply == Reply::Value(padded_words([on.into()])), || {
            format!(
                "a write of 1 to parameter 5 must switch test mode on, and any other value off, but after a \
                 write of {written} it reads as {reply}"
            )
        });
        let state = session.exchange_messages(&[])?.state();
        session.check("CONF-9", state.has(State::TEST_MODE) == on, || {
            format!(
                "a write of 1 to parameter 5 must set TEST_MODE, and any other value must clear it, but \
                 after a write of {written} the state is {:04X}",
                state.0
            )
        });
    }
    Ok(())
}

fn check_reply_mode(session: &mut Session<'_>) -> Result<(), StopReason> {
    for bad in [[2, 0, 0, 0, 0, 0], [-1, 0, 0, 0, 0, 0], [1, 0, 3, 0, 0, 0], [1, 500, 254, 0, 0, 0]] {
        expect_refusal(session, "CONF-10", REPLY_PARAMETER, bad)?;
    }
    for bad in [[1, 500, -1, 0, 0, 0], [1, 500, 3, 2, 0, 0], [1, 500, 3, -1, 0, 0]] {
        expect_refusal(session, "CONF-10", REPLY_PARAMETER, bad)?;
    }
    if session.about.ports {
        let sum = padded_words([1, 500, 3, 1]);
        expect_reply(session, "CONF-10", REPLY_PARAMETER, sum, Reply::Value(sum))?;
    } else {
        expect_refusal(session, "OPT-1", REPLY_PARAMETER, padded_words([1, 500, 3, 1]))?;
    }
    expect_reply(session, "CONF-3", REPLY_PARAMETER, [0, 5, 6, 7, 8, 9], Reply::Value([0; WORDS]))?;
    let reply = session.read_parameter(REPLY_PARAMETER)?;
    session.check("CONF-9", reply == Reply::Value([0; WORDS]), || {
        format!("parameter 6 must read as 0 after a write of 0, but it reads as {reply}")
    });
    Ok(())
}

fn check_sensing_parameters(session: &mut Session<'_>) -> Result<(), StopReason> {
    if !session.about.sensing {
        for number in [SENSING_PARAMETER, EVENTS_PARAMETER] {
            expect_reply(session, "OPT-1", number, [0; WORDS], Reply::Value([0; WORDS]))?;
            let reply = session.read_parameter(number)?;
            session.check("OPT-1", reply == Reply::Value([0; WORDS]), || {
                format!(
                    "parameter {number} of an option that the cell lacks must read as 0, but it reads as \
                     {reply}"
                )
            });
            expect_refusal(session, "OPT-1", number, padded_words([1, 50]))?;
        }
        session.findings.mark_not_applicable("SENSE-3", "the cell sends no sensor values without a request");
        return Ok(());
    }
    for bad in [[3, 50], [-1, 50], [1, 0], [i16::MAX, 1]] {
        expect_refusal(session, "SENSE-3", SENSING_PARAMETER, padded_words(bad))?;
    }
    expect_reply(session, "CONF-3", SENSING_PARAMETER, [2, 50, 3, 4, 5, 6], Reply::Value(padded_words([2])))?;
    expect_reply(session, "CONF-3", SENSING_PARAMETER, [0, 50, 3, 4, 5, 6], Reply::Value([0; WORDS]))?;
    // 65 535 ms.
    expect_reply(
        session,
        "SENSE-3",
        SENSING_PARAMETER,
        [1, -1, 3, 4, 5, 6],
        Reply::Value(padded_words([1, -1])),
    )?;
    expect_refusal(session, "SENSE-3", SENSING_PARAMETER, padded_words([1, 0]))?;
    expect_reply(session, "SENSE-3", SENSING_PARAMETER, [0; WORDS], Reply::Value([0; WORDS]))?;
    let usual = Events::default().words();
    for place in 0..5 {
        let mut bad = usual;
        bad.iter_mut().skip(place).take(1).for_each(|word| *word = -1);
        expect_refusal(session, "SENSE-3", EVENTS_PARAMETER, bad)?;
    }
    let [a, b, c, d, ..] = usual;
    expect_refusal(session, "SENSE-3", EVENTS_PARAMETER, [a, b, c, d, 0x4001, 0])?;
    for good in [[0, 0, 0, 0, 0x4000, 0], [i16::MAX, i16::MAX, i16::MAX, i16::MAX, 0, 0], usual] {
        let [a, b, c, d, e, _] = good;
        expect_reply(session, "SENSE-3", EVENTS_PARAMETER, [a, b, c, d, e, 77], Reply::Value(good))?;
        let reply = session.read_parameter(EVENTS_PARAMETER)?;
        session.check("CONF-9", reply == Reply::Value(good), || {
            format!("parameter 8 must read as it was written, but it reads as {reply}")
        });
    }
    Ok(())
}

/// Checks that a cell without a baseline accepts only zeros in parameters 11 and 12.
fn check_no_baseline(session: &mut Session<'_>) -> Result<(), StopReason> {
    let reply = session.read_parameter(BASELINE_PARAMETER)?;
    if session.about.baseline || reply == Reply::Refused(18) {
        return Ok(());
    }
    for number in [BASELINE_PARAMETER, TARE_PARAMETER] {
        expect_reply(session, "OPT-1", number, [0; WORDS], Reply::Value([0; WORDS]))?;
        expect_refusal(session, "OPT-1", number, padded_words([1, 102]))?;
    }
    Ok(())
}

fn check_links(session: &mut Session<'_>) -> Result<(), StopReason> {
    if session.about.test_mode {
        if session.about.ports {
            expect_reply(
                session,
                "LINK-1",
                LINKS_PARAMETER,
                padded_words([0x1F]),
                Reply::Value(padded_words([0x1F])),
            )?;
        } else {
            expect_refusal(session, "OPT-1", LINKS_PARAMETER, padded_words([1]))?;
        }
        // Bits 5 to 15 are not used.
        expect_reply(session, "CONF-3", LINKS_PARAMETER, [-32, 9, 9, 9, 9, 9], Reply::Value([0; WORDS]))?;
        session.switch_test_mode(false)?;
    }
    for written in [padded_words([0]), padded_words([1])] {
        expect_refusal(session, "LINK-1", LINKS_PARAMETER, written)?;
    }
    if session.about.test_mode {
        session.switch_test_mode(true)?;
    }
    Ok(())
}

/// Checks the first row that the cell cannot have: it reads as 0, and accepts only 0.
fn check_impossible_row(session: &mut Session<'_>) -> Result<(), StopReason> {
    let most = session.about.abilities.max_rows();
    let Some(number) = u8::try_from(most).ok().filter(|most| *most < 32).map(|most| 16 + most) else {
        return Ok(());
    };
    let reply = session.read_parameter(number)?;
    session.check("OPT-1", reply == Reply::Value([0; WORDS]), || {
        format!("row {} of a cell with at most {most} rows must read as 0, but it reads as {reply}", most + 1)
    });
    expect_reply(session, "OPT-1", number, [0; WORDS], Reply::Value([0; WORDS]))?;
    expect_refusal(session, "OPT-1", number, padded_words([1, 2, 3, 4]))
}

/// Checks that the cell ignores words, bytes and bits that a packet does not use.
pub(super) fn check_unused_bits_ignored(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::example_parameters(2))?;
    let junk = |command| Packet {
        id: Id::command(command),
        words: [1, -1, 0x7FFF, 3, 4, 5].into(),
        epoch: Epoch(77),
        count: 0x85,
    };
    let frames =
        |session: &Session<'_>, packet: Packet| packet.frames(session.format).collect::<Vec<Frame>>();
    session.known.halted = Some(true);
    let halted = session.exchange_frames(&frames(session, junk(Command::Halt)))?;
    session.check("OPT-2", halted.state().has(State::HALTED), || {
        "the cell must ignore unused words, epoch and count of a halt, but the halt had no effect".to_owned()
    });
    session.known.halted = Some(false);
    let resumed = session.exchange_frames(&frames(session, junk(Command::Resume)))?;
    session.check("OPT-2", !resumed.state().has(State::HALTED), || {
        "the cell must ignore unused words, epoch and count of a resume, but the resume had no effect"
            .to_owned()
    });
    session.begin_exchange();
    let asked = session.send(&frames(session, junk(Command::Report)))?;
    let pages = session.report_pages(asked)?;
    session.check("OPT-2", !pages.is_empty(), || {
        "the cell must ignore unused words of a report, but it did not answer the report".to_owned()
    });
    let frames_of_sync = frames(session, junk(Command::Sync));
    session.begin_exchange();
    let at = session.send(&frames_of_sync)?;
    let is_there = session.wait_for_packets(at + crate::session::ANSWER_TIMEOUT, |heard| {
        heard.iter().any(|it| it.heartbeat_and_epoch().is_some())
    })?;
    session.check("OPT-2", is_there, || {
        "the cell must ignore unused words of a sync, but it did not answer the sync".to_owned()
    });
    check_read_with_words(session)?;
    if session.format == Format::Fd {
        // A frame without the bit-rate switch.
        let sync = Message::Sync.encode();
        let frame = Frame::fd(sync.id.to_bits().into(), 0, &sync.encode());
        session.begin_exchange();
        let frames: Vec<_> = frame.into_iter().collect();
        let at = session.send(&frames)?;
        let is_there = session.wait_for_packets(at + crate::session::ANSWER_TIMEOUT, |heard| {
            heard.iter().any(|it| it.heartbeat_and_epoch().is_some())
        })?;
        session.check("OPT-2", is_there, || {
            "if a sync arrives in an FD frame that has no bit-rate switch, the cell must answer it, but it did not"
                .to_owned()
        });
    }
    if session.about.test_mode && session.about.committed {
        check_extra_words(session)?;
    }
    Ok(())
}

/// Checks that the words of a read are ignored.
fn check_read_with_words(session: &mut Session<'_>) -> Result<(), StopReason> {
    let id = Id::new(Kind::Configure, Node::Cell(session.cell));
    let packet = Packet { id, words: [9, 8, 7, 6, 5, 4].into(), epoch: Epoch(3), count: 2 };
    let frames: Vec<_> = packet.frames(session.format).collect();
    let exchange = session.exchange_frames(&frames)?;
    let expected = arm::example_parameters(2).words(Parameter::Pose);
    let answer = protocol::message::Answer::Value { number: 2, written: false, words: expected };
    let answer = Message::Configured { from: session.cell, tag: 3, answer };
    let is_so = exchange.answers.iter().any(|heard| heard.message == answer);
    session.check("OPT-2", is_so, || {
        "the cell must ignore unused words of a read, but the answer was not the value of parameter 2"
            .to_owned()
    });
    Ok(())
}

/// Checks that further words do not change the torque: after the joints of a shorter chain, and in a stimulus whose
/// page has fewer words.
fn check_extra_words(session: &mut Session<'_>) -> Result<(), StopReason> {
    let short = protocol::parameters::Parameters { joints: 3, ..arm::example_parameters(2) };
    if !session.prepare_cell(&short)? {
        return Ok(());
    }
    let positions = [0x0123, -0x2345, 0x0456, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    let expected = session.stimulate_and_send_joints(&positions, arm::press_with_sum(4_096))?.words();
    let epoch = session.next_epoch();
    let id = Id::command(Command::Joints);
    let words = [0x0123, -0x2345, 0x0456, 0x7777, -1, 0x1111].into();
    let packet = Packet { id, words, epoch: Epoch(epoch), count: 3 };
    let frames: Vec<_> = packet.frames(session.format).collect();
    session.known.epoch = Some(epoch);
    let exchange = session.exchange_frames(&frames)?;
    let got = exchange.answers.iter().find_map(|heard| heard.torque()).map(|(_, words)| words.padded());
    session.check("OPT-2", got == Some(expected), || {
        let got = got.map_or_else(|| "nothing".to_owned(), |got| arm::format_words(&got));
        format!(
            "the cell must ignore the words of a joints message beyond the joints of the chain, but they \
             changed the torque from {} to {got}",
            arm::format_words(&expected)
        )
    });
    // Page 1 has three words.
    let id = Id::new(Kind::Stimulus, Node::Cell(session.cell));
    let packet = Packet { id, words: [1, 2, 3, 4, 5, 6].into(), epoch: Epoch(200), count: 0x81 };
    let frames: Vec<_> = packet.frames(session.format).collect();
    session.begin_exchange();
    session.send(&frames)?;
    let after = session.send_next_joints(&positions)?.words();
    session.check("OPT-2", after == expected, || {
        "the cell must ignore unused words of an acceleration stimulus, but they changed the torque"
            .to_owned()
    });
    session.stimulate_and_send_joints(&[0; MAX_JOINTS], arm::press_with_sum(0))?;
    Ok(())
}
