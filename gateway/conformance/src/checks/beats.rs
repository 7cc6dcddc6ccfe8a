//! Checks of the times at which heartbeats come.

use protocol::message::{Message, State};
use protocol::packet::Epoch;
use protocol::parameters::MAX_JOINTS;
use protocol::time::{Micros, Span};

use super::claims::twin_heartbeat;
use crate::arm;
use crate::bus::StopReason;
use crate::session::{CellPacket, Session};

const HEARTBEAT_INTERVAL_US: u64 = 250_000;
/// The allowed lateness of a heartbeat, in us.
const MAX_LATENESS_US: u64 = 20_000;
/// The allowed error of the cell's clock and of the bench's time stamps, in us.
const CLOCK_TOLERANCE_US: u64 = 3_000;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::fast_example_parameters(2))?;
    session.wait_for_late_packets()?;
    let first = check_regular_heartbeats(session, 1_300)?;
    check_heartbeats_not_shifted(session)?;
    if session.about.test_mode && session.about.committed {
        check_early_heartbeats(session)?;
    } else {
        let why = "without test mode (parameter 5), the test cannot simulate a touch";
        session.findings.mark_not_tested("BEAT-2", why);
    }
    let last = check_held_state(session)?;
    if let (Some(first), Some(last)) = (first, last) {
        check_clock_rate(session, first, last);
    }
    Ok(())
}

/// The regular heartbeats of an interval.
#[derive(Clone, Copy, Debug)]
struct HeartbeatGrid {
    /// The latest time at which the first heartbeat was due, in us.
    due: u64,
    /// The mean interval between two heartbeats, in us.
    each: u64,
}

/// Formats times in us as ms.
pub(super) fn format_ms(times: impl Iterator<Item = u64>) -> String {
    times.map(|us| (us / 1_000).to_string()).collect::<Vec<_>>().join(", ")
}

/// Returns the times of the heartbeats since the exchange began, in us.
fn heartbeat_times_us(session: &Session<'_>) -> Vec<u64> {
    session.answers().iter().filter(|it| it.heartbeat_and_epoch().is_some()).map(|it| it.at.0).collect()
}

/// Checks that a halt and a latched stimulus last longer than 2 s, and that heartbeats continue meanwhile.
fn check_held_state(session: &mut Session<'_>) -> Result<Option<HeartbeatGrid>, StopReason> {
    let presses = session.about.test_mode && session.about.committed;
    if presses {
        session.stimulate_and_send_joints(&[0; MAX_JOINTS], arm::press_with_sum(4_096))?;
    }
    session.send_messages(&[Message::Halt])?;
    (session.known.halted, session.known.active) = (Some(true), Some(false));
    let first = session.packets.len();
    let grid = check_regular_heartbeats(session, 2_300)?;
    let beats =
        session.packets.get(first..).unwrap_or_default().iter().filter_map(CellPacket::heartbeat_and_epoch);
    let is_halted = beats.clone().all(|(beat, _)| beat.state.has(State::HALTED));
    session.check("CMD-1", is_halted, || {
        "HALTED must stay set until a resume, but it was clear in a heartbeat".to_owned()
    });
    session.send_next_joints(&[0; MAX_JOINTS])?;
    session.send_messages(&[Message::Resume])?;
    session.known.halted = Some(false);
    if presses {
        let step = session.send_next_joints(&[0; MAX_JOINTS])?;
        let is_there = step.torque.is_some();
        session.check("STIM-7", is_there, || {
            "a latched stimulus must stay in effect for more than 2 s, but the cell sent no torque message \
             after that time"
                .to_owned()
        });
        session.stimulate_and_send_joints(&[0; MAX_JOINTS], arm::press_with_sum(0))?;
    }
    Ok(grid)
}

/// Checks that without any request a heartbeat comes every 250 ms, at most 20 ms late. Returns the measured times if
/// that is so.
fn check_regular_heartbeats(session: &mut Session<'_>, ms: u64) -> Result<Option<HeartbeatGrid>, StopReason> {
    let due = usize::try_from(ms * 1_000 / HEARTBEAT_INTERVAL_US).unwrap_or_default();
    for attempt in 0..3 {
        session.begin_exchange();
        session.receive_for(Span::from_millis(ms))?;
        let late = session.bench_lateness();
        let times = heartbeat_times_us(session);
        session.mark_packets_expected();
        let apart: Vec<_> = times.windows(2).filter_map(|pair| Some(pair.get(1)? - pair.first()?)).collect();
        let (from, to) = (
            HEARTBEAT_INTERVAL_US - MAX_LATENESS_US - CLOCK_TOLERANCE_US,
            HEARTBEAT_INTERVAL_US + MAX_LATENESS_US + CLOCK_TOLERANCE_US,
        );
        let is_so =
            (due..=due + 1).contains(&times.len()) && apart.iter().all(|span| (from..=to).contains(span));
        if is_so || attempt == 2 || late.0 < 1_000 {
            session.check("BEAT-1", is_so, || {
                format!(
                    "the cell must send a heartbeat every 250 ms, at most 20 ms late, but it sent {} in {ms} \
                     ms, at intervals of {} ms",
                    times.len(),
                    format_ms(apart.iter().copied())
                )
            });
            let due = times
                .iter()
                .zip(0..)
                .map(|(at, place)| at.saturating_sub(place * HEARTBEAT_INTERVAL_US))
                .min();
            let each = apart.iter().sum::<u64>().checked_div(apart.len() as u64);
            let grid = due.zip(each).map(|(due, each)| HeartbeatGrid { due, each });
            return Ok(grid.filter(|_| is_so));
        }
    }
    Ok(None)
}

/// Checks that heartbeats that answer a sync or a claimant do not shift the regular ones.
fn check_heartbeats_not_shifted(session: &mut Session<'_>) -> Result<(), StopReason> {
    let claim = twin_heartbeat(session, 1, true);
    for (what, message, offset) in
        [("a sync", Message::Sync, 100), ("a claim", claim, 170), ("a sync", Message::Sync, 60)]
    {
        for attempt in 0..3 {
            let Some(grid) = next_beat(session)? else { return Ok(()) };
            session.receive_for(Span::from_millis(offset))?;
            session.begin_exchange();
            let at = session.send_messages(&[message])?;
            session.receive_for(Span(
                (grid.0 + 2 * HEARTBEAT_INTERVAL_US + 60_000).saturating_sub(session.now().0),
            ))?;
            let late = session.bench_lateness();
            let times = heartbeat_times_us(session);
            session.mark_packets_expected();
            // The answer, and two regular heartbeats.
            let is_so = match times.as_slice() {
                [answer, first, second] => {
                    answer - at.0 < MAX_LATENESS_US + CLOCK_TOLERANCE_US
                        && first.abs_diff(grid.0 + HEARTBEAT_INTERVAL_US)
                            <= MAX_LATENESS_US + CLOCK_TOLERANCE_US
                        && second.abs_diff(grid.0 + 2 * HEARTBEAT_INTERVAL_US)
                            <= MAX_LATENESS_US + CLOCK_TOLERANCE_US
                }
                _ => false,
            };
            if is_so || attempt == 2 || late.0 < 1_000 {
                session.check("BEAT-3", is_so, || {
                    let times = format_ms(times.iter().map(|at| at - grid.0));
                    format!(
                        "{what} {offset} ms after a regular heartbeat must be answered with a heartbeat at once, \
                         and must not shift the regular ones 250 and 500 ms after it; the cell sent heartbeats \
                         {times} ms after it"
                    )
                });
                break;
            }
        }
    }
    Ok(())
}

/// Waits for the next regular heartbeat, and returns its time.
fn next_beat(session: &mut Session<'_>) -> Result<Option<Micros>, StopReason> {
    session.wait_for_late_packets()?;
    let until = session.now() + Span(HEARTBEAT_INTERVAL_US + MAX_LATENESS_US + 50_000);
    let came =
        session.wait_for_packets(until, |heard| heard.iter().any(|it| it.heartbeat_and_epoch().is_some()))?;
    session.check("BEAT-1", came, || {
        "the cell must send a heartbeat every 250 ms, but it sent none for 320 ms".to_owned()
    });
    let at = session.answers().iter().rev().find(|it| it.heartbeat_and_epoch().is_some()).map(|it| it.at);
    session.mark_packets_expected();
    Ok(at)
}

/// Checks the heartbeats while joints come every 16 ms: each may be early by at most that period.
fn check_early_heartbeats(session: &mut Session<'_>) -> Result<(), StopReason> {
    const JOINTS_PERIOD_US: u64 = 16_000;
    for press in [4_096, 0] {
        for attempt in 0..3 {
            let Some(grid) = next_beat(session)? else { return Ok(()) };
            session.begin_exchange();
            session.send_stimulus(arm::press_with_sum(press))?;
            for step in 1..=64 {
                let due = grid + Span(5_000 + step * JOINTS_PERIOD_US);
                session.wait_for_packets(due, |_| false)?;
                let epoch = session.next_epoch();
                let joints = session.joints_message(epoch, &[0; MAX_JOINTS]);
                session.send_messages(&[joints])?;
                session.known.epoch = Some(epoch);
            }
            session.receive_for(Span::from_millis(40))?;
            let late = session.bench_lateness();
            let times = heartbeat_times_us(session);
            if press > 0 {
                check_torque_before_heartbeat(session);
            }
            session.mark_packets_expected();
            session.known.pending = None;
            session.known.skin = Some(arm::press_with_sum(press));
            session.known.active = Some(press > 0);
            // 1024 ms: each heartbeat is at most a period and a bit early, and each 250 ms have one.
            let slots: Vec<_> = times
                .iter()
                .map(|at| {
                    let since = at.saturating_sub(grid.0) + JOINTS_PERIOD_US + CLOCK_TOLERANCE_US;
                    (since / HEARTBEAT_INTERVAL_US, since % HEARTBEAT_INTERVAL_US)
                })
                .collect();
            let is_early = |(place, (slot, rest)): (u64, &(u64, u64))| {
                *slot == place && *rest <= JOINTS_PERIOD_US + MAX_LATENESS_US + 2 * CLOCK_TOLERANCE_US
            };
            let is_so = (4..=5).contains(&slots.len()) && (1..).zip(&slots).all(is_early);
            if is_so || attempt == 2 || late.0 < 1_000 {
                session.check("BEAT-2", is_so, || {
                    let times = format_ms(times.iter().map(|at| at.saturating_sub(grid.0)));
                    format!(
                        "with a joints message every 16 ms, heartbeats must follow 250, 500, 750 and 1000 ms \
                         after a regular one, or up to 16 ms earlier, but they followed after {times} ms"
                    )
                });
                break;
            }
        }
    }
    session.send_next_joints(&[0; MAX_JOINTS])?;
    Ok(())
}

/// Checks that a regular heartbeat follows the torque of its epoch. One exception is allowed: the cell may send a
/// heartbeat between receiving joints and answering them.
fn check_torque_before_heartbeat(session: &mut Session<'_>) {
    let before = |place: usize, of: Epoch| {
        let later = session.answers().get(place..).unwrap_or_default();
        later.iter().any(|it| it.torque().is_some_and(|(epoch, _)| epoch == of))
    };
    let answers = session.answers().iter().enumerate();
    let first = answers
        .filter(|(place, it)| it.heartbeat_and_epoch().is_some_and(|(_, epoch)| before(*place, epoch)))
        .count();
    session.check("TIME-3", first <= 1, || {
        format!(
            "a regular heartbeat must follow the torque message of its epoch, but {first} heartbeats \
             preceded it"
        )
    });
}

/// Checks the cell's clock by two groups of regular heartbeats, which are several seconds apart.
fn check_clock_rate(session: &mut Session<'_>, first: HeartbeatGrid, last: HeartbeatGrid) {
    let span = last.due.saturating_sub(first.due);
    let each = ((first.each + last.each) / 2).max(1);
    let beats = (span + each / 2) / each;
    // 1 %, plus the lateness that the earliest of five heartbeats may have.
    let allowed = span / 100 + MAX_LATENESS_US / 4 + CLOCK_TOLERANCE_US;
    let off = span.abs_diff(beats * HEARTBEAT_INTERVAL_US);
    session.begin_expected_exchange();
    session.check("TIME-1", off <= allowed, || {
        format!(
            "over {beats} heartbeats in {} ms, the cell's clock is off by {} us, but at most {allowed} us are allowed",
            span / 1_000,
            off
        )
    });
}
