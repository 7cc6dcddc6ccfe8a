//! Checks of a cell without a configuration, as it leaves the factory. A configured cell cannot return to this state.

use protocol::message::Message;
use protocol::packet::{Epoch, Length, Packet, WORDS, Words};
use protocol::parameters::{MAX_JOINTS, Parameter};

use crate::arm;
use crate::bus::StopReason;
use crate::session::{Reply, Session};

const POSITIONS: [i16; MAX_JOINTS] = [0x0111; MAX_JOINTS];

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.begin_exchange();
    session.known.halted = Some(false);
    check_staged_reads(session)?;
    let skin = arm::press_with_sum(4_096);
    if session.about.test_mode {
        session.send_stimulus(skin)?;
        session.known.pending = None;
    }
    check_joints_unanswered(session)?;
    if session.about.test_mode {
        let latched = session.read_latched_skin()?;
        session.check("JOINTS-3", latched == Some(skin), || {
            format!(
                "a cell without a configuration must latch {}, but it latched {}",
                arm::format_skin(Some(skin)),
                arm::format_skin(latched)
            )
        });
        session.switch_test_mode(true)?;
    }
    session.known.epoch = None;
    Ok(())
}

/// Checks that a read returns the staged value while no configuration is in use.
fn check_staged_reads(session: &mut Session<'_>) -> Result<(), StopReason> {
    let pose = arm::example_parameters(2).words(Parameter::Pose);
    let number = Parameter::Pose.number();
    let before = session.read_parameter(number)?;
    session.write_parameter(number, pose)?;
    let reply = session.read_parameter(number)?;
    session.check("CONF-1", reply == Reply::Value(pose), || {
        format!(
            "before the cell is configured, a read of parameter {number} must return the written value {}, but \
             the answer was {reply}",
            Reply::Value(pose)
        )
    });
    session.write_parameter(number, before.words().unwrap_or([0; WORDS]))?;
    let reply = session.write_first_words(Parameter::Commit.number(), [0])?;
    let is_refused = matches!(reply, Reply::Refused(_));
    session.check("CONF-7", is_refused, || {
        format!("a cell without a configuration must refuse a commit with hash 0, but the answer was {reply}")
    });
    Ok(())
}

/// Checks that the cell accepts joints of any chain, if their count matches their length, and does not answer them.
fn check_joints_unanswered(session: &mut Session<'_>) -> Result<(), StopReason> {
    let before = session.counters()?;
    // The cell need not accept more joints than it can compute.
    let most = u8::try_from(session.about.abilities.max_joints()).unwrap_or(u8::MAX);
    for count in 1..=most {
        let epoch = session.next_epoch();
        let joints = session.joints_message_for_chain(epoch, &POSITIONS, count);
        session.known.epoch = Some(epoch);
        let exchange = session.exchange_messages(&[joints])?;
        session.check("JOINTS-5", exchange.is_silent(), || {
            format!(
                "a cell without a configuration must not answer joints messages, but it answered that of a \
                 chain of {count} joints"
            )
        });
        session.exchange_messages(&[joints])?;
    }
    let after = session.counters()?;
    let skipped = after.heard.joints_late.wrapping_sub(before.heard.joints_late);
    session.check("JOINTS-4", skipped == 0, || {
        format!("a cell without a configuration must not skip joints messages, but it skipped {skipped}")
    });
    let counted = after.heard.joints.wrapping_sub(before.heard.joints);
    session.check("JOINTS-2", counted == u16::from(most), || {
        format!(
            "a cell without a configuration must count joints messages of chains with 1 to {most} joints, \
             but it counted {counted} messages"
        )
    });
    let repeated = after.heard.joints_repeated.wrapping_sub(before.heard.joints_repeated);
    session.check("JOINTS-3", repeated == u16::from(most), || {
        format!(
            "if {most} joints messages are sent twice, a cell without a configuration must count {most} as \
             repeated, but it counted {repeated}"
        )
    });
    let wrong = [
        (7, Length::Six),
        (6, Length::Eight),
        (8, Length::Ten),
        (10, Length::Fourteen),
        (15, Length::Fourteen),
    ];
    let can = wrong.iter().filter(|(_, length)| length.words() <= usize::from(most));
    for &(count, length) in can.clone() {
        let epoch = session.next_epoch();
        let id = session.joints_message_for_chain(epoch, &POSITIONS, 1).id();
        let packet = Packet { id, words: Words::new(length, POSITIONS), epoch: Epoch(epoch), count };
        let frames: Vec<_> = packet.frames(session.format).collect();
        session.exchange_frames(&frames)?;
    }
    let last = session.counters()?;
    let counted = last.refused.meaning.wrapping_sub(after.refused.meaning);
    let expected = can.count();
    session.check("COUNT-1", usize::from(counted) == expected, || {
        format!(
            "{expected} joints messages whose count does not match their length must be counted as packets \
             with invalid contents (counter 'meaning'), but {counted} were"
        )
    });
    session.exchange_messages(&[Message::Resume])?;
    Ok(())
}
