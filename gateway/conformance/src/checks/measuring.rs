//! Checks of a cell outside test mode: the bench does not know the cell's sensor values, but the cell's answers must
//! agree with its ACTIVE bit.

use protocol::message::State;
use protocol::parameters::MAX_JOINTS;

use crate::arm;
use crate::bus::StopReason;
use crate::session::Session;

/// The number of joints messages that are sent.
const JOINTS_MESSAGES: i16 = 12;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    if !session.prepare_cell(&arm::example_parameters(2))? {
        return Ok(());
    }
    if session.about.test_mode {
        session.switch_test_mode(false)?;
    }
    session.known.active = None;
    let mut before = None;
    for number in 0..JOINTS_MESSAGES {
        let skips = session.skips;
        let step = session.send_next_joints(&[number << 9; MAX_JOINTS])?;
        let Some((beat, _)) = step.exchange.beat.filter(|_| skips == session.skips) else {
            before = None;
            continue;
        };
        let is_active = beat.state.has(State::ACTIVE);
        let wrong = match (step.torque, is_active, before) {
            (None, true, _) => Some("ACTIVE is set, but the cell sent no torque message"),
            (None, false, Some(true)) => {
                Some("ACTIVE was cleared, but the cell sent no torque message of zeros")
            }
            (Some(_), false, Some(false)) => {
                Some("the cell sent a torque message, but ACTIVE was set neither before nor after it")
            }
            (Some(torque), false, _) if !torque.is_zero() => {
                Some("the cell sent a torque message with nonzero words, but ACTIVE is not set")
            }
            (Some(_), ..) | (None, false, Some(false) | None) => None,
        };
        session.check("JOINTS-6", wrong.is_none(), || {
            format!(
                "outside test mode, answers to joints messages must agree with the bit ACTIVE: {}",
                wrong.unwrap_or_default()
            )
        });
        before = Some(is_active);
    }
    session.prepare_cell(&arm::example_parameters(2))?;
    Ok(())
}
