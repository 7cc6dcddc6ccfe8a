//! Checks that a commit, a resume and a write of the mode leave the rest of the cell's state unchanged.

use protocol::id::Node;
use protocol::message::{Message, SensorPage, StimulusStart};
use protocol::packet::{Epoch, padded_words};
use protocol::parameters::{MAX_JOINTS, Parameter, Parameters};

use crate::arm;
use crate::bus::StopReason;
use crate::session::{Reply, Session};

const POSITIONS: [i16; MAX_JOINTS] =
    [0x0200, -0x1100, 0x0700, -0x0300, 0x1900, 0x0100, 0, 0, 0, 0, 0, 0, 0, 0];
const LATCHED_CONTACT_SUM: i32 = 4_444;
const PENDING_CONTACT_SUM: i32 = 5_555;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    if !session.prepare_cell(&arm::example_parameters(6))? {
        return Ok(());
    }
    check_state_kept_by_commit(session)?;
    check_stimuli_kept_by_resume(session)?;
    check_mode_write(session)?;
    session.prepare_cell(&arm::example_parameters(6))?;
    Ok(())
}

/// Presses the cell, and sends it a stimulus that stays pending. Returns the epoch of the pending stimulus.
fn touch_with_pending_stimulus(session: &mut Session<'_>) -> Result<u8, StopReason> {
    session.stimulate_and_send_joints(&POSITIONS, arm::press_with_sum(LATCHED_CONTACT_SUM))?;
    let later = session.known.last_epoch.wrapping_add(20);
    let to = Node::Cell(session.cell);
    let page = SensorPage::Skin(arm::press_with_sum(PENDING_CONTACT_SUM));
    session.send_messages(&[Message::Stimulus { to, from: StimulusStart::Epoch(Epoch(later)), page }])?;
    Ok(later)
}

/// Checks that the latched stimulus and the one pending for epoch `later` still exist.
fn check_stimuli_kept(
    session: &mut Session<'_>,
    later: u8,
    id: &'static str,
    what: &str,
) -> Result<(), StopReason> {
    let is_there = session.send_next_joints(&POSITIONS)?.torque.is_some();
    session.check(id, is_there, || {
        format!("{what} must keep the latched stimulus, but the cell sent no torque message after it")
    });
    session.known.skin = Some(arm::press_with_sum(PENDING_CONTACT_SUM));
    session.send_joints_at_epoch(later, &POSITIONS)?;
    let skin = session.read_latched_skin()?;
    session.check(id, skin == Some(arm::press_with_sum(PENDING_CONTACT_SUM)), || {
        format!(
            "{what} must keep a pending stimulus, but at the epoch of the stimulus {} is latched",
            arm::format_skin(skin)
        )
    });
    Ok(())
}

fn check_state_kept_by_commit(session: &mut Session<'_>) -> Result<(), StopReason> {
    let later = touch_with_pending_stimulus(session)?;
    let events = [101, 102, 103, 104, 105, 0];
    let (sensing, thresholds) = (Parameter::Sensing.number(), Parameter::Events.number());
    if session.about.sensing {
        session.known.senses = true;
        session.write_parameter(thresholds, events)?;
        // Only the two pages of the switch come meanwhile.
        session.write_first_words(sensing, [1, i16::MAX])?;
        session.wait_for_late_packets()?;
    }
    let before = session.counters()?;
    session.commit_parameters(&Parameters { period_us: 47_250, ..arm::example_parameters(6) })?;
    // The cell stays in contact until the next joints.
    session.exchange_messages(&[])?;
    let after = session.counters()?;
    session.check("CONF-7", before == after, || {
        format!("a commit must not change the counters, but they are {after}; before: {before}")
    });
    if session.about.sensing {
        for (number, expected) in [(thresholds, events), (sensing, padded_words([1, i16::MAX]))] {
            let reply = session.read_parameter(number)?;
            session.check("CONF-7", reply == Reply::Value(expected), || {
                format!("a commit must not change parameter {number}, but it reads as {reply}")
            });
        }
        session.write_first_words(sensing, [0])?;
        session.write_parameter(thresholds, protocol::parameters::Events::default().words())?;
        session.wait_for_late_packets()?;
        session.known.senses = false;
    }
    // The epoch does not begin again either.
    let joints = session.joints_message(session.known.last_epoch, &POSITIONS);
    let again = session.exchange_messages(&[joints])?;
    session.check("CONF-7", again.is_silent(), || {
        "the cell must not answer a joints message that is repeated after a commit, but it did".to_owned()
    });
    check_stimuli_kept(session, later, "CONF-7", "a commit")?;
    // A halted cell stays halted.
    session.send_messages(&[Message::Halt])?;
    (session.known.halted, session.known.active) = (Some(true), Some(false));
    session.commit_parameters(&arm::example_parameters(6))?;
    session.exchange_messages(&[])?;
    session.send_messages(&[Message::Resume])?;
    session.known.halted = Some(false);
    Ok(())
}

fn check_stimuli_kept_by_resume(session: &mut Session<'_>) -> Result<(), StopReason> {
    for is_halted in [true, false] {
        let later = touch_with_pending_stimulus(session)?;
        if is_halted {
            session.send_messages(&[Message::Halt])?;
            session.known.active = Some(false);
        }
        session.send_messages(&[Message::Resume])?;
        session.exchange_messages(&[])?;
        check_stimuli_kept(session, later, "CMD-2", "a resume")?;
    }
    Ok(())
}

/// Checks that a write of parameter 5 clears stimuli and changes nothing else, also if it is sent to everyone.
fn check_mode_write(session: &mut Session<'_>) -> Result<(), StopReason> {
    for to in [Node::Cell(session.cell), Node::Everyone] {
        touch_with_pending_stimulus(session)?;
        session.send_messages(&[Message::Halt])?;
        (session.known.halted, session.known.active) = (Some(true), Some(false));
        for on in [0, 1] {
            session.set_test_mode(to, on != 0)?;
            let is_on = session.exchange_messages(&[])?.state().has(protocol::message::State::TEST_MODE);
            session.check("CONF-11", is_on == (on != 0), || {
                format!("a write of {on} to parameter 5, sent to {to}, must change TEST_MODE, but it did not")
            });
        }
        let joints = session.joints_message(session.known.last_epoch, &POSITIONS);
        session.exchange_messages(&[joints])?;
        session.send_messages(&[Message::Resume])?;
        session.known.halted = Some(false);
        let step = session.send_next_joints(&POSITIONS)?;
        session.check("STIM-2", step.torque.is_none(), || {
            format!(
                "a write of parameter 5, sent to {to}, must clear all stimuli, but the cell sent a torque \
                 message after it"
            )
        });
    }
    Ok(())
}
