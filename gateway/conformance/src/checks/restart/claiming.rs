//! Checks of a cell that claims its node id: the packets that it accepts, gives way to, and answers.

use protocol::id::Node;
use protocol::message::{Message, Request, SensorPage, State};
use protocol::packet::padded_words;
use protocol::parameters::{MAX_JOINTS, Parameter};
use protocol::time::{Micros, Span};

use super::super::claims::twin_heartbeat;
use super::{claim, restart, restart_with, settled};
use crate::arm;
use crate::bus::StopReason;
use crate::session::{CellPacket, Session};

/// The maximum number of restarts for one check, which is repeated if the bench was late.
const MAX_RESTARTS_PER_CHECK: usize = 4;
/// The maximum time that a cell which waits for a processor takes to process a frame; beyond it, the whole group is
/// repeated.
const FRAME_PROCESSING_MARGIN: Span = Span::from_millis(100);
const CLAIM_OVER_REMARK: &str = "this computer was late in every attempt and sent after the end of the claim";

/// Returns the earliest end of a cell's claim, from the time of its first heartbeat.
fn earliest_claim_end(session: &Session<'_>, claimed: Micros) -> Micros {
    let Span(whole) = claim(session);
    claimed + Span(whole - whole / 100 - 2_000)
}

/// Checks the packets that a claiming cell accepts and those that it ignores.
pub(super) fn check_while_claiming(
    session: &mut Session<'_>,
    after_test_mode: bool,
) -> Result<(), StopReason> {
    // Test mode is off after a start, whatever it was before.
    if session.about.test_mode {
        session.switch_test_mode(false)?;
    }
    for _ in 0..MAX_RESTARTS_PER_CHECK {
        if send_ignored_packets(session, after_test_mode)? {
            return Ok(());
        }
    }
    session.findings.mark_not_tested("CLAIM-2", CLAIM_OVER_REMARK);
    session.receive_for(claim(session))?;
    session.known.may_be_silent = false;
    session.excuse_silence_until_now();
    session.prepare_cell(&arm::example_parameters(2))?;
    Ok(())
}

/// Sends packets that a claiming cell must ignore. Returns true if all of them arrived while it was claiming.
fn send_ignored_packets(session: &mut Session<'_>, after_test_mode: bool) -> Result<bool, StopReason> {
    let claimed = restart(session)?;
    let end = earliest_claim_end(session, claimed);
    let state = session
        .answers()
        .last()
        .and_then(CellPacket::heartbeat_and_epoch)
        .map(|(beat, _)| beat.state)
        .unwrap_or_default();
    let presses = state.has(State::TEST_MODE);
    session.check("CONF-9", presses == after_test_mode || !session.about.test_mode, || {
        "test mode must have the same initial value after each restart, but the cell kept an earlier value"
            .to_owned()
    });
    session.begin_expected_exchange();
    session.send_stimulus(arm::press_with_sum(4_096))?;
    let first = session.next_epoch();
    let second = session.next_epoch();
    let own = Node::Cell(session.cell);
    let request = |number, request| Message::Configure { to: own, tag: number, request };
    let write = Request::Write { number: 1, words: padded_words([999, 999]) };
    let all = [
        session.joints_message(first, &[0; MAX_JOINTS]),
        Message::Sync,
        Message::Report,
        request(1, Request::Read { number: 0 }),
        request(2, write),
        request(3, Request::Read { number: 77 }),
        request(
            4,
            Request::Write { number: Parameter::Mode.number(), words: padded_words([(!presses).into()]) },
        ),
        request(5, Request::Write { number: Parameter::Sensing.number(), words: padded_words([2]) }),
        request(
            6,
            Request::Write { number: Parameter::Mode.number(), words: padded_words([(!presses).into()]) },
        ),
        session.joints_message(second, &[0; MAX_JOINTS]),
        Message::Halt,
    ];
    let mut last = claimed;
    for message in all {
        last = session.send_messages(&[message])?;
        session.receive_for(Span::from_millis(3))?;
    }
    if last + FRAME_PROCESSING_MARGIN >= end {
        // The cell had to answer some of them, and may send sensor values from now on.
        session.receive_for(Span::from_millis(200))?;
        session.mark_packets_expected();
        session.known.senses = true;
        return Ok(false);
    }
    session.receive_for(Span::from_millis(20))?;
    let came = session.answers().iter().filter(|it| it.at < end);
    let came: Vec<_> = came.map(|it| it.message.id().kind.name()).collect();
    session.check("CLAIM-2", came.is_empty(), || {
        format!("a claiming cell must not answer requests, but it sent {}", came.join(", "))
    });
    let at = settled(session, claimed)?;
    if at.is_none() {
        return Ok(true);
    }
    session.known.epoch = Some(second);
    session.known.halted = Some(true);
    session.known.hash = session.known.parameters.map(|it| it.hash());
    let is_on = session.exchange_messages(&[])?.state().has(State::TEST_MODE);
    session.check("CLAIM-2", is_on == presses, || {
        "a claiming cell must ignore a write of parameter 5, but it executed the write".to_owned()
    });
    let counters = session.counters()?;
    let is_so = counters.heard.joints == 2 && counters.heard.torques == 0;
    session.check("CLAIM-2", is_so, || {
        format!(
            "a claiming cell must count 2 joints messages and no torques, but the counters are {counters}"
        )
    });
    let refused = protocol::message::RejectedCounts { stimuli: u16::from(!presses), ..Default::default() };
    session.check("CLAIM-2", counters.refused == refused, || {
        format!("a claiming cell must not count packets that it ignores, but the counters are {counters}")
    });
    if presses {
        let report = session.request_report()?;
        let skin = report.iter().find_map(|it| match it.sensors() {
            Some((_, SensorPage::Skin(skin))) => Some(*skin),
            _ => None,
        });
        session.check("STIM-8", skin == Some(arm::press_with_sum(4_096)), || {
            format!("a claiming cell must latch a stimulus, but {} is latched", arm::format_skin(skin))
        });
    }
    session.prepare_cell(&arm::example_parameters(2))?;
    Ok(true)
}

/// Checks that the cell does not give way to claims with a higher serial number, before and after its first heartbeat.
pub(super) fn check_keeps_node_id(session: &mut Session<'_>) -> Result<(), StopReason> {
    let own = session.about.serial.unwrap_or_default();
    let Some(higher) = own.checked_add(1) else {
        session.findings.mark_not_tested("CLAIM-3", "there is no serial number higher than that of the cell");
        return Ok(());
    };
    let Some(claimed) = claim_during_start(session, higher)? else { return Ok(()) };
    let low_is_lower = if own & 0xFFFF > 0 { own.checked_add(0xFFFF) } else { None };
    let end = earliest_claim_end(session, claimed);
    for serial in [Some(higher), low_is_lower, Some(u32::MAX)].into_iter().flatten() {
        session.begin_expected_exchange();
        let claim = twin_heartbeat(session, serial, true);
        let at = session.send_messages(&[claim])?;
        if at + Span::from_millis(20) >= end {
            session.findings.mark_not_tested(
                "CLAIM-3",
                "claims with a higher serial number, because the cell had stopped claiming",
            );
            break;
        }
        let came = session.wait_for_packets(at + Span::from_millis(100), |heard| {
            heard.iter().any(|it| it.heartbeat_and_epoch().is_some())
        })?;
        let answer = session.answers().iter().find_map(|it| Some((it.at, it.heartbeat_and_epoch()?.0.state)));
        session.mark_packets_expected();
        session.check("CLAIM-3", came, || {
            format!(
                "a claiming cell must answer a claim with the higher serial number {serial}, but it did not"
            )
        });
        if let Some((answered, state)) = answer {
            session.record_answer_time("heartbeat to a claimant", at, answered);
            let is_so = state.has(State::CLAIMING_NODE_ID) || answered >= end;
            session.check("CLAIM-3", is_so, || {
                "a claiming cell must set CLAIMING in its answer to a claim, but the bit is clear".to_owned()
            });
            session.check("CLAIM-7", state.has(State::DUPLICATE), || {
                "a claiming cell must set DUPLICATE in its answer to a claim, but the bit is clear".to_owned()
            });
        }
        session.receive_for(Span::from_millis(30))?;
    }
    session.begin_expected_exchange();
    let at = settled(session, claimed)?;
    session.check("CLAIM-3", at.is_some(), || {
        "the cell must not give way to a claim with a higher serial number, but it did".to_owned()
    });
    session.known.hash = None;
    session.prepare_cell(&arm::example_parameters(2))?;
    Ok(())
}

/// Sends claims with a higher serial number continuously while the cell starts, and returns the time of its first
/// heartbeat. That heartbeat is sent (serial mod 64) ms after the start, and must have DUPLICATE if a claim came before
/// it. A late computer may delay the claims, so the check is then repeated.
fn claim_during_start(session: &mut Session<'_>, higher: u32) -> Result<Option<Micros>, StopReason> {
    const MAX_CHECK_ATTEMPTS: usize = 3;
    let rest = twin_heartbeat(session, higher, true);
    let is_long = session.about.serial.unwrap_or_default() % 64 >= 30;
    let longest = Span::from_millis(3_000);
    for attempt in 1..=MAX_CHECK_ATTEMPTS {
        // With pauses: each claim is answered only 10 ms after the last answer.
        let claimed = restart_with(session, longest, |session| session.send_messages(&[rest]).map(|_| ()))?;
        let Some(claimed) = claimed else {
            session.check("CLAIM-3", false, || {
                format!(
                    "the cell must not give way to claims with the higher serial number {higher}, but it \
                     sent no heartbeat"
                )
            });
            return Ok(None);
        };
        // The answer, and then a regular heartbeat.
        session.receive_for(Span::from_millis(80))?;
        let new = session
            .answers()
            .iter()
            .filter(|it| it.at >= claimed)
            .filter_map(CellPacket::heartbeat_and_epoch);
        let is_set = new.clone().next().is_some_and(|(beat, _)| beat.state.has(State::DUPLICATE));
        let is_answered = new.count() > 1;
        if is_set && is_answered || !is_long || attempt == MAX_CHECK_ATTEMPTS {
            session.check("CLAIM-7", is_set || !is_long, || {
                "DUPLICATE must be set in the first heartbeat if claims arrived before it, but the bit is \
                 clear"
                    .to_owned()
            });
            session.check("CLAIM-3", is_answered || !is_long, || {
                "the cell must answer claims that arrive before its first heartbeat, but it did not"
                    .to_owned()
            });
            return Ok(Some(claimed));
        }
        settled(session, claimed)?;
    }
    Ok(None)
}

/// Checks that a claiming cell ignores a `4nn` of a page that does not exist.
pub(super) fn check_invalid_page_ignored(session: &mut Session<'_>) -> Result<(), StopReason> {
    let claimed = restart(session)?;
    session.begin_expected_exchange();
    let mut packet = twin_heartbeat(session, 0, true).encode();
    packet.count = 7;
    let mut frames: Vec<_> = packet.frames(session.format).collect();
    let mut other = twin_heartbeat(session, 0, true).encode();
    other.count = 9;
    frames.extend(other.frames(session.format));
    session.send(&frames)?;
    let at = settled(session, claimed)?;
    session.check("CLAIM-3", at.is_some(), || {
        "the cell must ignore a network packet (4nn) with an unknown page, but it gave way to it".to_owned()
    });
    let is_set = session
        .answers()
        .iter()
        .filter_map(CellPacket::heartbeat_and_epoch)
        .any(|(beat, _)| beat.state.has(State::DUPLICATE));
    session.check("COUNT-1", !is_set, || {
        "a network packet (4nn) with an unknown page must not set DUPLICATE, but the bit is set".to_owned()
    });
    session.known.hash = None;
    Ok(())
}

/// Checks that a claiming cell gives way to a packet, and is silent after it.
pub(super) fn check_gives_way(
    session: &mut Session<'_>,
    what: &str,
    other: &Message,
) -> Result<(), StopReason> {
    for _ in 0..MAX_RESTARTS_PER_CHECK {
        let claimed = restart(session)?;
        session.begin_expected_exchange();
        let at = session.send_messages(&[*other])?;
        if at + FRAME_PROCESSING_MARGIN < earliest_claim_end(session, claimed) {
            return check_silent_after_giving_way(session, claimed, what);
        }
    }
    session.findings.mark_not_tested("CLAIM-3", CLAIM_OVER_REMARK);
    Ok(())
}

/// Checks that a cell that gave way sends nothing.
fn check_silent_after_giving_way(
    session: &mut Session<'_>,
    claimed: Micros,
    what: &str,
) -> Result<(), StopReason> {
    session.receive_for(Span::from_millis(3))?;
    session.mark_packets_expected();
    session.begin_expected_exchange();
    for message in [Message::Sync, Message::Report] {
        session.send_messages(&[message])?;
    }
    let claim = twin_heartbeat(session, u32::MAX, true);
    session.send_messages(&[claim])?;
    let until = claimed + time_to_claim_end(session);
    session.wait_for_packets(until, |_| false)?;
    let came = session.answers().len();
    session.mark_packets_expected();
    let serial = session.about.serial.unwrap_or_default();
    session.check("CLAIM-3", came == 0, || {
        format!(
            "once the cell (serial number {serial}) receives {what}, it must stop sending, but it then sent \
             {came} packets"
        )
    });
    session.check("CLAIM-4", came == 0, || {
        format!("after the cell gave way to {what}, it must be silent, but it sent {came} packets")
    });
    Ok(())
}

/// Returns the time after which claiming is over and a further heartbeat is due.
fn time_to_claim_end(session: &Session<'_>) -> Span {
    Span(claim(session).0 + 60_000)
}
