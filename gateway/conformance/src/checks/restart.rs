//! Checks of requirements that need a restart of the cell: the address claim, and the values that survive.

mod claiming;
#[cfg(test)]
mod tests;

use protocol::id::Node;
use protocol::message::{Message, NetworkPage, Request, State};
use protocol::packet::{WORDS, Words, padded_words};
use protocol::parameters::{Events, MAX_JOINTS, Parameter, Parameters};
use protocol::time::{Micros, Span};

use super::claims::{twin_heartbeat, twin_page};
use crate::arm;
use crate::bus::StopReason;
use crate::session::{ANSWER_TIMEOUT, CellPacket, KnownCellState, Reply, Session};
use claiming::{check_gives_way, check_invalid_page_ignored, check_keeps_node_id, check_while_claiming};

/// The time limit from switching the cell off to its first packet.
const BOOT_TIMEOUT: Span = Span::from_millis(8_000);

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::example_parameters(2))?;
    let after_test_mode = survives(session)?;
    check_while_claiming(session, after_test_mode)?;
    check_keeps_node_id(session)?;
    check_invalid_page_ignored(session)?;
    let own = session.about.serial.unwrap_or_default();
    // CLAIMING and a higher serial number have these meanings in a heartbeat only.
    let state = State::CLAIMING_NODE_ID.0 | 1 << 12;
    let other = protocol::message::RejectedCounts {
        length: 0xFFFF,
        crc: 0xFFFF,
        stimuli: state,
        ..Default::default()
    };
    let lower = own.wrapping_sub(0x1_0000).wrapping_add(1);
    let others = [
        ("a claim with a lower serial number", twin_heartbeat(session, own.wrapping_sub(1), true)),
        (
            "a claim with a lower serial number, whose low word is higher",
            twin_heartbeat(session, lower, true),
        ),
        ("network page 2", twin_page(session, NetworkPage::Rejected(other))),
        ("a claim with the cell's own serial number", twin_heartbeat(session, own, true)),
        ("a heartbeat without CLAIMING", twin_heartbeat(session, own.wrapping_add(1), false)),
        (
            "network page 1",
            twin_page(session, NetworkPage::Received(protocol::message::ReceivedCounts::default())),
        ),
    ];
    let has_lower = |what: &str| match what.contains("low word") {
        true => own >= 0x1_0000 && own & 0xFFFF != 0xFFFF,
        false => own > 0 || !what.contains("lower"),
    };
    for (what, other) in others.into_iter().filter(|(what, _)| has_lower(what)) {
        check_gives_way(session, what, &other)?;
    }
    in_the_middle(session)
}

/// Returns the time from the first heartbeat to the end of claiming.
fn claim(session: &Session<'_>) -> Span {
    Span(250_000 + u64::from(session.cell.get()) * 250_000 / 255)
}

/// Switches the cell off and on, and returns the time of its first packet.
fn restart(session: &mut Session<'_>) -> Result<Micros, StopReason> {
    let came = restart_with(session, BOOT_TIMEOUT, |_| Ok(()))?;
    came.ok_or_else(|| {
        let what =
            "the cell must send a heartbeat with CLAIMING within 8 s after a restart, but it sent none";
        session.check("CLAIM-1", false, || what.to_owned());
        StopReason::Restart(what.to_owned())
    })
}

/// Switches the cell off and on, and returns the time of its first packet, or `None` if none comes within a time limit.
/// Calls `meanwhile` repeatedly until then.
fn restart_with(
    session: &mut Session<'_>,
    longest: Span,
    meanwhile: impl FnMut(&mut Session<'_>) -> Result<(), StopReason>,
) -> Result<Option<Micros>, StopReason> {
    let keep = KnownCellState {
        last_epoch: session.known.last_epoch,
        joints: session.known.joints,
        ..KnownCellState::default()
    };
    let (parameters, senses) = (session.known.parameters, session.known.senses);
    session.mark_packets_expected();
    session.begin_restart()?;
    session.known = KnownCellState { may_be_silent: true, ..keep };
    session.begin_expected_exchange();
    let done = await_claim(session, longest, meanwhile);
    session.end_restart();
    done?;
    let Some(came) = session.first_claim_time() else { return Ok(None) };
    // Packets from before the cell was switched off: it was settled, and may have received requests.
    let is_old = |it: &CellPacket| {
        let is_answer = matches!(it.message, Message::Configured { .. });
        is_answer || it.heartbeat_and_epoch().is_some() || senses && it.sensors().is_some()
    };
    let stray = session.answers().iter().take_while(|it| it.at < came).any(|it| !is_old(it));
    session.check("CLAIM-1", !stray, || {
        "the first packet after a restart must be a heartbeat with CLAIMING, but the cell sent another one \
         first"
            .to_owned()
    });
    session.known.parameters = parameters;
    session.known.staged = None;
    Ok(Some(came))
}

/// Waits until the restart is done and the cell has started again, up to a time limit.
fn await_claim(
    session: &mut Session<'_>,
    longest: Span,
    mut meanwhile: impl FnMut(&mut Session<'_>) -> Result<(), StopReason>,
) -> Result<(), StopReason> {
    const POLL_INTERVAL: Span = Span::from_millis(12);
    let give_up = session.now() + longest;
    let is_claim = |it: &CellPacket| {
        it.heartbeat_and_epoch().is_some_and(|(beat, _)| beat.state.has(State::CLAIMING_NODE_ID))
    };
    loop {
        let is_restarting = session.is_restarting()?;
        if session.first_claim_time().is_some() {
            if !is_restarting {
                return Ok(());
            }
            session.receive_for(POLL_INTERVAL)?;
        } else if is_restarting || session.now() < give_up {
            let until = session.now() + POLL_INTERVAL;
            session.wait_for_packets(until, |heard| heard.last().is_some_and(is_claim))?;
            if session.first_claim_time().is_none() {
                meanwhile(session)?;
            }
        } else {
            return Ok(());
        }
    }
}

/// Waits until the node id is settled, and returns the time of the first heartbeat without CLAIMING.
fn settled(session: &mut Session<'_>, claimed: Micros) -> Result<Option<Micros>, StopReason> {
    let is_settled = |it: &CellPacket| {
        it.at > claimed
            && it.heartbeat_and_epoch().is_some_and(|(beat, _)| !beat.state.has(State::CLAIMING_NODE_ID))
    };
    let until = claimed + claim(session) + Span::from_millis(300);
    // It may have come in an earlier exchange, if the bench was late.
    let first = |session: &Session<'_>| {
        let since = session.packets.iter().rev().take_while(|it| it.at > claimed);
        since.filter(|it| is_settled(it)).last().map(|it| it.at)
    };
    if first(session).is_none() {
        session.wait_for_packets(until, |heard| heard.iter().any(is_settled))?;
    }
    let at = first(session);
    session.mark_packets_expected();
    let expected = claim(session);
    session.check("CLAIM-5", at.is_some(), || {
        format!(
            "{} ms after its first heartbeat, the cell must send a heartbeat in which CLAIMING is clear, but \
             it sent none",
            expected.0 / 1_000
        )
    });
    session.known.may_be_silent = false;
    session.excuse_silence_until_now();
    Ok(at)
}

/// Checks the values that a restart keeps, discards and sets to 0. Returns true if test mode is on in the first
/// heartbeat.
fn survives(session: &mut Session<'_>) -> Result<bool, StopReason> {
    let kept = arm::distinct_parameters(session.about.abilities);
    session.prepare_cell(&kept)?;
    let before = touched(session)?;
    session.send_stimulus(arm::press_with_sum(0))?;
    session.send_next_joints(&[0; MAX_JOINTS])?;
    let staged = Parameters { period_us: 44_000, ..arm::example_parameters(4) };
    session.stage_parameters(&staged)?;
    if session.about.sensing {
        session.known.senses = true;
        // Sensor pages are set to come only after the cell is switched off.
        session.write_first_words(7, [1, i16::MAX])?;
        session.write_first_words(8, [1, 2, 3, 4, 5])?;
    }
    session.begin_exchange();
    session.send_messages(&[Message::Halt])?;
    let claimed = restart(session)?;
    // Earlier packets belong to the time before the restart.
    let mut new = session.answers().iter().filter(|it| it.at >= claimed);
    let first = new
        .find_map(|it| Some((*it.heartbeat_and_epoch()?.0, it.heartbeat_and_epoch()?.1)))
        .unwrap_or_default();
    let is_new = (first.0.sent, first.0.rejected, first.1.0) == (0, 0, 0);
    session.check("CLAIM-1", is_new, || {
        format!(
            "'sent', 'refused' and epoch of the first heartbeat after a restart must be 0, but they are {}, \
             {} and {}",
            first.0.sent, first.0.rejected, first.1
        )
    });
    session.check("STATE-3", !first.0.state.has(State::HALTED), || {
        "HALTED must be clear after a restart, but it is set".to_owned()
    });
    session.check("STATE-1", !first.0.state.has(State::ACTIVE), || {
        "ACTIVE must be clear after a restart, but it is set".to_owned()
    });
    let others = session.answers().iter().filter(|it| it.at >= claimed).count();
    let at = settled(session, claimed)?;
    if let Some(at) = at {
        let (took, expected) = (at.elapsed_since(claimed).0, claim(session).0);
        let late = session.bench_lateness().0;
        let range = expected - expected / 100 - 2_000..=expected + expected / 100 + 22_000 + late;
        session.check("CLAIM-5", range.contains(&took), || {
            format!(
                "the cell stopped claiming its node id after {:.1} ms; it must stop after {:.1} ms",
                took as f64 / 1e3,
                expected as f64 / 1e3
            )
        });
    }
    session.check("CLAIM-1", others >= 1, || {
        "the cell must send a heartbeat after a restart, but it sent none".to_owned()
    });
    let same = first.0.configuration == kept.hash() && first.0.state.has(State::CONFIGURED);
    session.check("CONF-8", same, || {
        format!(
            "after a restart the configuration is {:04X}, but it must be the committed configuration {:04X}",
            first.0.configuration,
            kept.hash()
        )
    });
    session.check("ID-3", at.is_some(), || {
        "after a restart the cell must keep its node id, but it did not settle on that node id".to_owned()
    });
    session.known.hash = Some(kept.hash());
    (session.known.halted, session.known.epoch) = (Some(false), Some(0));
    session.exchange_messages(&[])?;
    for parameter in Parameter::stored_for_rows(kept.all_rows().len()) {
        let reply = session.read_parameter(parameter.number())?;
        session.check("CONF-8", reply == Reply::Value(kept.words(parameter)), || {
            format!(
                "after a restart, parameter {} must have its committed value, but it reads as {reply}",
                parameter.number()
            )
        });
    }
    // Values that were only staged are gone.
    let hash = staged.hash().cast_signed();
    let reply = session.write_first_words(Parameter::Commit.number(), [hash])?;
    session.check("CONF-2", reply == Reply::Refused(16), || {
        format!(
            "a restart must discard staged values, so their commit must be refused with reason 16, but the \
             answer was {reply}"
        )
    });
    volatile(session)?;
    (session.known.parameters, session.known.staged) = (Some(kept), Some(kept));
    // The staged copy equals the values in use.
    let next = Parameters { period_us: 45_250, ..kept };
    session.known.active = None;
    let done = session.commit_parameters(&next)?;
    session.switch_test_mode(session.about.test_mode)?;
    session.check("CONF-2", done, || {
        "after a restart the staged copy must equal the values in use, but a commit that changes one value \
         failed"
            .to_owned()
    });
    let after = if session.known.test_mode == Some(true) { touched(session)? } else { None };
    session.check("CONF-8", after.is_none() || before.is_none() || before == after, || {
        let words =
            |words: Option<Words>| words.map_or_else(String::new, |it| arm::format_words(it.as_slice()));
        format!(
            "the same touch must give the same torque words, but it gave {} before a restart and {} after it",
            words(before),
            words(after)
        )
    });
    let counters = session.counters()?;
    session.check("BEAT-4", counters.refused == protocol::message::RejectedCounts::default(), || {
        format!("counters must start at 0 after a restart, but they are {counters}")
    });
    Ok(first.0.state.has(State::TEST_MODE))
}

/// Checks that volatile parameters have their initial values after a restart.
fn volatile(session: &mut Session<'_>) -> Result<(), StopReason> {
    let events = if session.about.sensing { Events::default().words() } else { [0; WORDS] };
    for (number, expected) in [(6, [0; WORDS]), (7, [0; WORDS]), (8, events), (9, [0; WORDS])] {
        let reply = session.read_parameter(number)?;
        session.check("CONF-9", reply == Reply::Value(expected), || {
            format!(
                "after a restart parameter {number} is {reply}, but it must be {}",
                Reply::Value(expected)
            )
        });
    }
    // A simulated cell may be started with test mode on.
    let reply = session.read_parameter(5)?;
    session.known.test_mode = reply.words().map(|words| words.first() == Some(&1));
    Ok(())
}

/// Presses the cell at fixed joint positions, and returns its torque, if the cell has test mode.
fn touched(session: &mut Session<'_>) -> Result<Option<Words>, StopReason> {
    if !session.about.test_mode {
        return Ok(None);
    }
    session.known.active = None;
    let positions =
        core::array::from_fn(|place| [0x0777, -0x0555, 0x0333].get(place % 3).copied().unwrap_or(0));
    Ok(session.stimulate_and_send_joints(&positions, arm::press_with_sum(9_000))?.torque)
}

/// Checks a reset just after a commit was requested: the cell uses the old or the new configuration, or reports that
/// its flash is damaged.
fn in_the_middle(session: &mut Session<'_>) -> Result<(), StopReason> {
    let claimed = restart(session)?;
    settled(session, claimed)?;
    session.known.hash = None;
    let (old, new) =
        (arm::example_parameters(2), Parameters { period_us: 44_000, ..arm::example_parameters(4) });
    session.prepare_cell(&old)?;
    session.stage_parameters(&new)?;
    let request = Request::Write {
        number: Parameter::Commit.number(),
        words: padded_words([new.hash().cast_signed()]),
    };
    session.send_messages(&[Message::Configure { to: Node::Cell(session.cell), tag: 1, request }])?;
    session.mark_packets_expected();
    let claimed = restart(session)?;
    settled(session, claimed)?;
    session.begin_expected_exchange();
    let sync = session.send_messages(&[Message::Sync])?;
    session.wait_for_packets(sync + ANSWER_TIMEOUT, |heard| {
        heard.iter().any(|it| it.heartbeat_and_epoch().is_some())
    })?;
    let beat = session
        .answers()
        .iter()
        .rev()
        .find_map(|it| it.heartbeat_and_epoch().map(|(beat, _)| *beat))
        .unwrap_or_default();
    session.mark_packets_expected();
    let is_whole =
        beat.state.has(State::CONFIGURED) && [old.hash(), new.hash()].contains(&beat.configuration);
    let is_noticed = !beat.state.has(State::CONFIGURED) && beat.state.has(State::FLASH_DAMAGED);
    session.check("CONF-8", is_whole || is_noticed, || {
        format!(
            "after a reset during a commit, the old or the new configuration must be in use or FLASH_DAMAGED \
             must be set, but the configuration is {:04X} and the state is {:04X}",
            beat.configuration, beat.state.0
        )
    });
    (session.known.parameters, session.known.staged, session.known.hash) = (None, None, None);
    Ok(())
}
