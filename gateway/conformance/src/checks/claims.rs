//! Checks of a settled cell whose node id another sender claims or uses, in packets `4nn` with that id.

use protocol::id::Node;
use protocol::message::{
    Heartbeat, Message, NetworkPage, PortsPage, ReceivedCounts as HeardPage, RejectedCounts, State, TreePage,
};
use protocol::packet::Epoch;
use protocol::parameters::Parameter;
use protocol::time::{Micros, Span};

use crate::arm;
use crate::bus::StopReason;
use crate::session::Session;

/// The minimum time between two claims that a cell answers.
const MIN_CLAIM_ANSWER_INTERVAL: Span = Span::from_millis(10);

/// Returns a heartbeat of another cell with the node id of the cell under test.
pub(super) fn twin_heartbeat(session: &Session<'_>, serial: u32, claiming: bool) -> Message {
    let state = State::default().with_flags(State::CLAIMING_NODE_ID, claiming).with_joint(0);
    let beat = Heartbeat { serial, state, ..Heartbeat::default() };
    Message::Network { from: Node::Cell(session.cell), epoch: Epoch(0), page: NetworkPage::Heartbeat(beat) }
}

/// Returns a network page, other than a heartbeat, of another cell with the node id of the cell under test.
pub(super) fn twin_page(session: &Session<'_>, page: NetworkPage) -> Message {
    Message::Network { from: Node::Cell(session.cell), epoch: Epoch(0), page }
}

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::example_parameters(2))?;
    let own = session.about.serial.unwrap_or_default();
    for serial in [own.wrapping_sub(1), own.wrapping_add(1), 0, u32::MAX, own] {
        check_claim_defence(session, serial)?;
    }
    check_simultaneous_claims(session, own)?;
    // The words of a heartbeat's serial number and CLAIMING have other meanings in these pages.
    let state = State::CLAIMING_NODE_ID.0 | 1 << 12;
    let pages = [
        NetworkPage::Received(HeardPage::default()),
        NetworkPage::Rejected(RejectedCounts::default()),
        NetworkPage::Received(HeardPage { joints: 1, torques: state, ..HeardPage::default() }),
        NetworkPage::Rejected(RejectedCounts { length: 1, stimuli: state, ..RejectedCounts::default() }),
        NetworkPage::Tree(TreePage::default()),
        NetworkPage::Ports(PortsPage::default()),
    ];
    let mut others: Vec<_> = pages.into_iter().map(|it| twin_page(session, it)).collect();
    others.push(twin_heartbeat(session, own.wrapping_sub(1), false));
    others.push(twin_heartbeat(session, own, false));
    for other in others {
        check_non_claim_unanswered(session, &other)?;
    }
    // A claim is answered regardless of the packets before it.
    session.wait_for_heartbeat_gap(Span::from_millis(120))?;
    let other = twin_page(session, NetworkPage::Received(HeardPage::default()));
    session.send_messages(&[other])?;
    check_claim_defence(session, own.wrapping_sub(1))?;
    session.exchange_messages(&[])?;
    Ok(())
}

/// Returns the time and the state of each heartbeat since the exchange began.
fn heartbeat_states(session: &Session<'_>) -> Vec<(Micros, State)> {
    session.answers().iter().filter_map(|it| Some((it.at, it.heartbeat_and_epoch()?.0.state))).collect()
}

/// Checks that a claim is answered at once with DUPLICATE, and that DUPLICATE is clear in the next heartbeat.
fn check_claim_defence(session: &mut Session<'_>, serial: u32) -> Result<(), StopReason> {
    // The time of the answer is a matter of TIME-2.
    session.wait_for_heartbeat_gap(Span::from_millis(160))?;
    session.begin_exchange();
    let claim = twin_heartbeat(session, serial, true);
    let at = session.send_messages(&[claim])?;
    let came = session.wait_for_packets(at + Span::from_millis(120), |heard| {
        heard.iter().any(|it| it.heartbeat_and_epoch().is_some())
    })?;
    session.check("CLAIM-6", came, || {
        format!(
            "the cell must answer a claim of its node id by serial number {serial} with a heartbeat, but it \
             sent none"
        )
    });
    if let Some((answered, state)) = heartbeat_states(session).first().copied() {
        session.record_answer_time("heartbeat to a claimant", at, answered);
        session.check("CLAIM-7", state.has(State::DUPLICATE), || {
            format!("DUPLICATE must be set in the answer to a claim, but the state is {:04X}", state.0)
        });
        session.check("CLAIM-6", !state.has(State::CLAIMING_NODE_ID), || {
            "a settled cell must clear CLAIMING in its answer to a claim, but CLAIMING is set".to_owned()
        });
    }
    session.receive_for(Span::from_millis(5))?;
    let count = heartbeat_states(session).len();
    session.check("CLAIM-6", count <= 1, || {
        format!("the cell must answer a claim with one heartbeat, but it sent {count}")
    });
    session.mark_packets_expected();
    // The heartbeat that answers the sync is checked as usual.
    session.exchange_messages(&[])?;
    session.receive_for(MIN_CLAIM_ANSWER_INTERVAL)
}

/// Checks that of three claims within 10 ms only one is answered, and that DUPLICATE in the next heartbeat shows the
/// others.
fn check_simultaneous_claims(session: &mut Session<'_>, own: u32) -> Result<(), StopReason> {
    if session.are_answers_slow() {
        let why = "claims within 10 ms, because the connection to the cell is too slow";
        session.findings.mark_not_tested("CLAIM-6", why);
        return Ok(());
    }
    for _ in 0..3 {
        session.wait_for_heartbeat_gap(Span::from_millis(120))?;
        session.begin_exchange();
        let frames: Vec<_> = (1..=3)
            .flat_map(|it| session.frames(&twin_heartbeat(session, own.wrapping_add(it), true)))
            .collect();
        let times = session.send_all(&frames)?;
        let apart = times
            .last()
            .copied()
            .unwrap_or_default()
            .elapsed_since(times.first().copied().unwrap_or_default());
        session.receive_for(Span::from_millis(25))?;
        let count = heartbeat_states(session).len();
        session.mark_packets_expected();
        if apart > Span::from_millis(7) {
            continue;
        }
        session.check("CLAIM-6", count == 1, || {
            format!(
                "the cell must answer three claims that arrive within {} us with one heartbeat, but it sent {count}",
                apart.0
            )
        });
        // The next heartbeat shows the later claims.
        session.begin_exchange();
        let at = session.send_messages(&[Message::Sync])?;
        session.wait_for_packets(at + Span::from_millis(50), |heard| {
            heard.iter().any(|it| it.heartbeat_and_epoch().is_some())
        })?;
        let is_set = heartbeat_states(session).first().is_some_and(|(_, state)| state.has(State::DUPLICATE));
        session.check("CLAIM-7", is_set, || {
            "DUPLICATE must be set in the heartbeat after a claim that was not answered, but it is clear"
                .to_owned()
        });
        session.mark_packets_expected();
        session.exchange_messages(&[])?;
        return Ok(());
    }
    let why = "claims within 10 ms, because this computer was late in every attempt";
    session.findings.mark_not_tested("CLAIM-6", why);
    Ok(())
}

/// Checks that a `4nn` that is not a claim gets no answer, and sets DUPLICATE in one heartbeat.
fn check_non_claim_unanswered(session: &mut Session<'_>, other: &Message) -> Result<(), StopReason> {
    session.wait_for_heartbeat_gap(Span::from_millis(80))?;
    session.begin_exchange();
    session.send_messages(&[*other])?;
    session.receive_for(Span::from_millis(25))?;
    let count = heartbeat_states(session).len();
    session.check("CLAIM-6", count == 0, || {
        "the cell must not answer a network packet (4nn) that is not a claim, but it sent a heartbeat"
            .to_owned()
    });
    session.mark_packets_expected();
    // A read of the identity shows DUPLICATE, and does not clear it.
    let reply = session.read_parameter(Parameter::Identity.number())?;
    let shown = reply.words().map(|[.., state, _]| State(state.cast_unsigned())).unwrap_or_default();
    let is_set = shown.has(State::DUPLICATE);
    session.check("CONF-1", is_set, || {
        format!(
            "after another cell has sent a network packet with the same node id, DUPLICATE must be set in \
             the identity, but the state is {:04X}",
            shown.0
        )
    });
    session.begin_exchange();
    let at = session.send_messages(&[Message::Sync])?;
    session.wait_for_packets(at + Span::from_millis(50), |heard| {
        heard.iter().any(|it| it.heartbeat_and_epoch().is_some())
    })?;
    let state = heartbeat_states(session).last().map(|(_, state)| *state).unwrap_or_default();
    session.check("CLAIM-7", state.has(State::DUPLICATE), || {
        format!(
            "after another cell has sent a network packet with the same node id, DUPLICATE must be set in \
             the next heartbeat, but the state is {:04X}",
            state.0
        )
    });
    session.mark_packets_expected();
    session.exchange_messages(&[])?;
    Ok(())
}
