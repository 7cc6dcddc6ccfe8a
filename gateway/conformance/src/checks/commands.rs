//! The commands halt, resume, sync and report.

use model::central::CentralComputation;
use protocol::fixed::{Q1_14, Q3_12, Q5_10, Q9_6};
use protocol::id::Node;
use protocol::message::{Message, SensorPage, SensorReadings, SkinSensors, State, StimulusStart};
use protocol::parameters::MAX_JOINTS;
use protocol::time::Span;

use crate::arm;
use crate::bus::StopReason;
use crate::session::{ANSWER_TIMEOUT, Exchange, Session};

const FIRST_POSITIONS: [i16; MAX_JOINTS] =
    [0x0400, -0x2100, 0x1700, -0x0300, 0x2900, 0x0100, 0, 0, 0, 0, 0, 0, 0, 0];
const SECOND_POSITIONS: [i16; MAX_JOINTS] =
    [-0x1400, 0x1100, -0x0700, 0x2300, -0x1900, 0x0800, 0, 0, 0, 0, 0, 0, 0, 0];

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    if !session.prepare_cell(&arm::example_parameters(6))? {
        return Ok(());
    }
    check_answer_counts(session)?;
    check_halt(session)?;
    check_syncs(session)?;
    check_report(session)
}

fn check_command(
    session: &mut Session<'_>,
    command: Message,
    id: &'static str,
) -> Result<Exchange, StopReason> {
    let is_halt = command == Message::Halt;
    session.known.halted = Some(is_halt);
    if is_halt {
        session.known.active = Some(false);
    }
    let exchange = session.exchange_messages(&[command])?;
    session.check(id, exchange.is_silent(), || {
        "the cell must not answer a halt or a resume, but it sent packets besides the heartbeat for the next \
         sync"
            .to_owned()
    });
    let is_set = exchange.state().has(State::HALTED);
    session.check(id, is_set == is_halt, || {
        format!(
            "a halt must set HALTED and a resume must clear it, but HALTED is {}set after the command",
            if is_set { "" } else { "not " }
        )
    });
    Ok(exchange)
}

/// Checks that a halt or a resume is not answered, and that a halted cell answers a sync with one heartbeat. Commands
/// are sent at times when no regular heartbeat is due.
fn check_answer_counts(session: &mut Session<'_>) -> Result<(), StopReason> {
    const MAX_CHECK_ATTEMPTS: usize = 3;
    let cases = [
        ("a halt", Message::Halt, "CMD-1"),
        ("a sync", Message::Sync, "CMD-3"),
        ("a resume", Message::Resume, "CMD-1"),
    ];
    for (what, message, id) in cases {
        let expected = usize::from(message == Message::Sync);
        for attempt in 1..=MAX_CHECK_ATTEMPTS {
            session.wait_for_heartbeat_gap(Span::from_millis(120))?;
            session.begin_exchange();
            let at = session.send_messages(&[message])?;
            session.wait_for_packets(at + Span::from_millis(25 + 60 * expected as u64), |heard| {
                expected > 0 && heard.iter().any(|it| it.heartbeat_and_epoch().is_some())
            })?;
            let came = session.answers().len();
            session.mark_packets_expected();
            if came == expected || attempt == MAX_CHECK_ATTEMPTS {
                session.check(id, came == expected, || {
                    let halted = if expected > 0 { " to a halted cell" } else { "" };
                    format!(
                        "{what}{halted} must be answered with {expected} packets, but the cell sent {came}"
                    )
                });
                break;
            }
        }
        session.known.halted = Some(message != Message::Resume);
        session.known.active = Some(false);
    }
    session.exchange_messages(&[])?;
    Ok(())
}

fn check_halt(session: &mut Session<'_>) -> Result<(), StopReason> {
    let unit = arm::press_with_sum(arm::unit_press_sum(protocol::fixed::TorqueFormat::Q3_12));
    let central = CentralComputation::for_single_cell(&arm::example_parameters(6));
    for round in 0..2 {
        session.stimulate_and_send_joints(&FIRST_POSITIONS, unit)?;
        let exchange = check_command(session, Message::Halt, "CMD-1")?;
        session.check("STATE-1", !exchange.state().has(State::ACTIVE), || {
            "ACTIVE must be clear after a halt, but it is set".to_owned()
        });
        if round == 1 {
            check_command(session, Message::Halt, "CMD-1")?;
        } else {
            // Only a resume ends a halt: neither a commit nor an exchange does.
            session.commit_parameters(&protocol::parameters::Parameters {
                period_us: 46_500,
                ..arm::example_parameters(6)
            })?;
            session.commit_parameters(&arm::example_parameters(6))?;
            session.exchange_messages(&[])?;
        }
        let before = session.counters()?.heard;
        for positions in
            [FIRST_POSITIONS, FIRST_POSITIONS, FIRST_POSITIONS, FIRST_POSITIONS, SECOND_POSITIONS]
        {
            let epoch = session.next_epoch();
            session.send_joints_at_epoch(epoch, &positions)?;
        }
        let after = session.counters()?.heard;
        let taken = |of: &protocol::message::ReceivedCounts| of.joints.wrapping_add(of.joints_late);
        let counted = taken(&after).wrapping_sub(taken(&before));
        session.check("CMD-1", counted == 5, || {
            format!("a halted cell must count 5 joints messages, but it counted {counted}")
        });
        session.check("CMD-1", after.torques == before.torques, || {
            "a halted cell must not count torque messages, but its counter 'torques' changed".to_owned()
        });
        check_command(session, Message::Resume, "CMD-2")?;
        let step = session.send_next_joints(&SECOND_POSITIONS)?;
        let exact = arm::exact_jacobian(&central, &SECOND_POSITIONS);
        let off = step
            .words()
            .iter()
            .zip(exact)
            .map(|(word, exact)| arm::rounding_error_steps(*word, exact))
            .max()
            .unwrap_or(0);
        session.check("CMD-2", off <= 8, || {
            format!(
                "the first torque message after a resume must match the new joint positions, but its words \
                 are {}",
                arm::format_words(&step.words())
            )
        });
        // A release while halted clears ACTIVE, so no torque of zeros is due.
        check_command(session, Message::Halt, "CMD-1")?;
        session.stimulate_and_send_joints(&FIRST_POSITIONS, arm::press_with_sum(0))?;
        check_command(session, Message::Resume, "CMD-2")?;
        let step = session.send_next_joints(&SECOND_POSITIONS)?;
        session.check("CMD-1", step.torque.is_none(), || {
            "after a touch has ended during a halt, the cell must send no torque message, but it sent one"
                .to_owned()
        });
    }
    // A resume does not change a cell that is not halted.
    session.stimulate_and_send_joints(&FIRST_POSITIONS, unit)?;
    check_command(session, Message::Resume, "CMD-2")?;
    session.stimulate_and_send_joints(&FIRST_POSITIONS, arm::press_with_sum(0))?;
    session.send_next_joints(&FIRST_POSITIONS)?;
    Ok(())
}

/// Checks that each sync is answered with one heartbeat.
fn check_syncs(session: &mut Session<'_>) -> Result<(), StopReason> {
    const SYNCS: usize = 8;
    session.begin_exchange();
    let mut beats = 0;
    let began = session.now();
    for _ in 0..SYNCS {
        let at = session.send_messages(&[Message::Sync])?;
        let before = beats;
        let count = |heard: &[crate::session::CellPacket]| {
            heard.iter().filter(|it| it.heartbeat_and_epoch().is_some()).count()
        };
        session.wait_for_packets(at + ANSWER_TIMEOUT, |heard| count(heard) > before)?;
        session.receive_for(Span::from_millis(4))?;
        beats = count(session.answers());
    }
    // Regular heartbeats may come between.
    let regular = 1 + usize::try_from(session.now().elapsed_since(began).0 / 250_000).unwrap_or(0);
    session.check("CMD-3", (SYNCS..=SYNCS + regular).contains(&beats), || {
        format!(
            "the cell must answer each of {SYNCS} syncs with one heartbeat, but it sent {beats} heartbeats"
        )
    });
    Ok(())
}

fn check_report(session: &mut Session<'_>) -> Result<(), StopReason> {
    let skin = SkinSensors {
        contact: [100, -200, 300].map(Q5_10::from_bits),
        proximity: Q1_14::from_bits(0x1234),
        temperature: [1_600, -64].map(Q9_6::from_bits),
    };
    let acceleration = [11, -22, 4_096].map(Q3_12::from_bits);
    let to = Node::Cell(session.cell);
    let page = SensorPage::Acceleration(acceleration);
    session.send_messages(&[Message::Stimulus { to, from: StimulusStart::Next, page }])?;
    session.stimulate_and_send_joints(&FIRST_POSITIONS, skin)?;
    // Pending values are not reported yet.
    session.send_stimulus(arm::press_with_sum(77))?;
    for _ in 0..3 {
        session.begin_exchange();
        let asked = session.send_messages(&[Message::Report])?;
        let answers = session.report_pages(asked)?;
        session.receive_for(Span::from_millis(5))?;
        if let Some(last) = answers.last() {
            session.record_answer_time("report", asked, last.at);
        }
        let epochs_right =
            answers.iter().all(|heard| heard.message.epoch().map(|it| it.0) == session.known.epoch);
        session.check("JOINTS-3", epochs_right, || {
            "all pages of a report must have the epoch of the last joints message, but one has another epoch"
                .to_owned()
        });
        let sent: Vec<_> =
            answers.iter().filter_map(|heard| heard.sensors().map(|(_, page)| *page)).collect();
        let mut latched = SensorReadings::default();
        [SensorPage::Skin(skin), page].iter().for_each(|page| latched.set_page(page));
        let latched = latched.simulated_pages();
        session.check("SENSE-1", sent.len() == latched.len(), || {
            format!(
                "the cell must answer a report with every latched sensors page, but it sent {} sensors pages",
                sent.len()
            )
        });
        session.check("SENSE-2", sent == latched, || {
            let text = |pages: &[SensorPage]| {
                pages.iter().map(|page| arm::format_page(*page)).collect::<Vec<_>>().join("; ")
            };
            format!(
                "a report must contain the latched sensor values, but it contains {}; the latched values are \
                 {}",
                text(&sent),
                text(&latched)
            )
        });
    }
    session.stimulate_and_send_joints(&FIRST_POSITIONS, arm::press_with_sum(0))?;
    session.send_next_joints(&FIRST_POSITIONS)?;
    Ok(())
}
