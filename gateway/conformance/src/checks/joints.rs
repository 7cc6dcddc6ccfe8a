//! Checks of joints: the epochs and counts that the cell accepts, its counters, and its answers.

use protocol::can::Frame;
use protocol::packet::{Epoch, Length, Packet, Words};
use protocol::parameters::{MAX_JOINTS, Parameters};
use protocol::time::{Micros, Span};

use crate::arm;
use crate::bus::StopReason;
use crate::session::Session;

const POSITIONS: [i16; MAX_JOINTS] =
    [0x0400, -0x2100, 0x1700, -0x0300, 0x2900, 0x0100, 0, 0, 0, 0, 0, 0, 0, 0];

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    if !session.prepare_cell(&arm::example_parameters(6))? {
        return Ok(());
    }
    session.stimulate_and_send_joints(&POSITIONS, arm::press_with_sum(4_096))?;
    check_epoch_jumps(session)?;
    check_repeated_epochs(session)?;
    check_joint_counts(session)?;
    check_contact_changes(session)
}

/// Checks that joints of any epoch other than the last one are accepted, at any distance from it, and more than 256 in
/// a row.
fn check_epoch_jumps(session: &mut Session<'_>) -> Result<(), StopReason> {
    let before = session.counters()?.heard;
    let mut torque: Option<Words> = None;
    let mut epoch = session.known.last_epoch;
    let jumps: [u8; 13] = [255, 254, 128, 127, 129, 2, 250, 100, 200, 255, 1, 3, 64];
    for step in jumps.into_iter().chain(core::iter::repeat_n(1, 270)).chain([255, 255, 255]) {
        epoch = epoch.wrapping_add(step);
        let came = session.send_joints_at_epoch(epoch, &POSITIONS)?.torque;
        session.check("JOINTS-1", came.is_some(), || {
            format!(
                "the cell must answer the joints message of epoch {epoch}, {} epochs after the last one, with \
                 a torque message, but it sent none",
                step.cast_signed()
            )
        });
        if let (Some(came), Some(before)) = (came, torque) {
            let words = |words: &Words| arm::format_words(words.as_slice());
            session.check("TORQUE-1", came == before, || {
                format!(
                    "the same joint positions must give the same torque words, but they gave {}, and {} \
                     before",
                    words(&came),
                    words(&before)
                )
            });
        }
        torque = came.or(torque);
    }
    let after = session.counters()?.heard;
    // The counters add up, and only few joints may have come too late.
    let skipped = after.joints_late.wrapping_sub(before.joints_late);
    let late = session.skips;
    session.check("JOINTS-5", skipped <= late, || {
        format!(
            "the cell counted {skipped} joints messages as skipped, but only {late} were delayed enough to \
             be skipped"
        )
    });
    Ok(())
}

/// Checks that the epoch of the last joints is dropped when it is repeated; epoch 0 is not special.
fn check_repeated_epochs(session: &mut Session<'_>) -> Result<(), StopReason> {
    for is_zero in [false, true] {
        session.stimulate_and_send_joints(&POSITIONS, arm::press_with_sum(4_096))?;
        let before = session.counters()?.heard;
        let first = if is_zero { 0 } else { session.next_epoch() };
        session.send_joints_at_epoch(first, &POSITIONS)?;
        for positions in [POSITIONS, [0x1234; MAX_JOINTS]] {
            let joints = session.joints_message(first, &positions);
            let exchange = session.exchange_messages(&[joints])?;
            session.check("JOINTS-1", exchange.is_silent(), || {
                format!("the cell must not answer a repeated joints message of epoch {first}, but it did")
            });
        }
        // A pending stimulus must not be latched by repeated joints.
        session.send_stimulus(arm::press_with_sum(2_000))?;
        let joints = session.joints_message(first, &POSITIONS);
        session.exchange_messages(&[joints])?;
        let skin = session.read_latched_skin()?;
        session.check("JOINTS-1", skin == Some(arm::press_with_sum(4_096)), || {
            format!(
                "a repeated joints message must not latch a stimulus, but {} is latched",
                arm::format_skin(skin)
            )
        });
        let second = session.next_epoch();
        session.send_joints_at_epoch(second, &POSITIONS)?;
        // After other joints, the same epoch counts as a new one.
        session.send_joints_at_epoch(first, &POSITIONS)?;
        session.send_joints_at_epoch(second, &POSITIONS)?;
        let after = session.counters()?.heard;
        let counted = after.joints_repeated.wrapping_sub(before.joints_repeated);
        session.check("JOINTS-1", counted == 3, || {
            format!("the cell must count 3 repeated joints messages as repeated, but it counted {counted}")
        });
    }
    Ok(())
}

/// Checks that joints are dropped if their count is not that of the chain, or is impossible.
fn check_joint_counts(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.stimulate_and_send_joints(&POSITIONS, arm::press_with_sum(4_096))?;
    let mut before = session.counters()?;
    for count in [5, 1, 4, 0, 7, 15, 255] {
        let epoch = session.next_epoch();
        // The stimulus is latched by the next valid joints, whatever their epoch.
        let sum = 4_096 + i32::from(count) * 8;
        let before_press = session.read_latched_skin()?;
        session.send_stimulus(arm::press_with_sum(sum))?;
        before = session.counters()?;
        let frames = joints_frames(session, epoch, count, Length::Six);
        let exchange = session.exchange_frames(&frames)?;
        let skin = session.read_latched_skin()?;
        session.check("JOINTS-2", skin == before_press, || {
            format!(
                "a joints message with count {count} must not latch a stimulus, but {} is latched",
                arm::format_skin(skin)
            )
        });
        session.check("JOINTS-2", exchange.is_silent(), || {
            format!(
                "because the chain has 6 joints, the cell must not answer a joints message with count {count}, \
                 but it did"
            )
        });
        let after = session.counters()?;
        let is_so =
            after.refused.meaning == before.refused.meaning.wrapping_add(1) && after.heard == before.heard;
        let id = if (1..=6).contains(&count) { "JOINTS-2" } else { "COUNT-1" };
        session.check(id, is_so, || {
            format!(
                "a joints message with count {count} must raise only the counter of \
                 packets with invalid contents ('meaning'), but the counters are {after}; before: {before}"
            )
        });
        // The epoch of the dropped joints does not become the last one.
        let step = session.send_joints_at_epoch(epoch, &POSITIONS)?;
        session.check("JOINTS-2", step.torque.is_some(), || {
            format!(
                "after a joints message with a wrong count byte, the cell must answer the next valid one, of \
                 epoch {epoch}, but it did not"
            )
        });
        before = session.counters()?;
    }
    // The order of a cell's checks: impossible counts, then repetitions, then the count of the chain.
    let last = session.known.last_epoch;
    for (count, is_repeated) in [(5, true), (0, false)] {
        let frames = joints_frames(session, last, count, Length::Six);
        session.exchange_frames(&frames)?;
        let after = session.counters()?;
        let repeated = after.heard.joints_repeated.wrapping_sub(before.heard.joints_repeated);
        let meaning = after.refused.meaning.wrapping_sub(before.refused.meaning);
        let id = if is_repeated { "JOINTS-1" } else { "COUNT-1" };
        session.check(id, (repeated, meaning) == (is_repeated.into(), (!is_repeated).into()), || {
            format!(
                "a joints message that repeats the last epoch, with the value {count} in its count byte, must \
                 raise the counter {} by 1; the counter 'repeated' rose by {repeated}, and 'meaning' by {meaning}",
                if is_repeated { "'repeated'" } else { "'meaning'" }
            )
        });
        before = after;
    }
    if session.format == protocol::can::Format::Fd {
        let epoch = session.next_epoch();
        let frames = joints_frames(session, epoch, 7, Length::Eight);
        session.exchange_frames(&frames)?;
        let after = session.counters()?;
        let is_so = after.refused.meaning == before.refused.meaning.wrapping_add(1)
            && after.refused.length == before.refused.length;
        session.check("JOINTS-2", is_so, || {
            format!(
                "a joints message with count 7 in 20 bytes must raise the counter of packets with \
                 invalid contents ('meaning'), but the counters are {after}; before: {before}"
            )
        });
    }
    Ok(())
}

/// Returns the frames of joints with this count, which need not match the chain.
fn joints_frames(session: &Session<'_>, epoch: u8, count: u8, length: Length) -> Vec<Frame> {
    let id = session.joints_message(epoch, &POSITIONS).id();
    let packet = Packet { id, words: Words::new(length, POSITIONS), epoch: Epoch(epoch), count };
    packet.frames(session.format).collect()
}

/// Checks touches and releases: in contact each joints message is answered with a torque, a release with one torque of
/// zeros, and later joints with nothing.
fn check_contact_changes(session: &mut Session<'_>) -> Result<(), StopReason> {
    for round in 0..4 {
        for sum in [3_000, 3_000, 0, 0, 0, 9_000, 0, 0] {
            let positions = POSITIONS.map(|word| word.wrapping_add(round * 0x0111));
            session.stimulate_and_send_joints(&positions, arm::press_with_sum(sum))?;
        }
        session.send_stimulus(arm::press_with_sum(500))?;
        for _ in 0..3 {
            session.send_next_joints(&POSITIONS)?;
        }
        session.stimulate_and_send_joints(&POSITIONS, arm::press_with_sum(0))?;
        session.send_next_joints(&POSITIONS)?;
    }
    Ok(())
}

/// Checks joints that are older than a period of 1 us when the cell processes them.
pub(super) fn check_old_joints(session: &mut Session<'_>) -> Result<(), StopReason> {
    if !session.prepare_cell(&arm::example_parameters(6))? {
        return Ok(());
    }
    let mut shown = BurstResults::default();
    for press in [4_096, 1_024, 2_048, 512] {
        send_joints_burst(session, press, &mut shown)?;
    }
    if !shown.any {
        session
            .findings
            .mark_not_tested("JOINTS-4", "the cell processed every joints message at once and skipped none");
    }
    session.known.active = None;
    check_no_joints_lost(session)?;
    session.prepare_cell(&arm::example_parameters(6))?;
    Ok(())
}

/// The results of the bursts of joints so far.
#[derive(Debug, Default)]
struct BurstResults {
    /// The number of bursts in which old joints were answered.
    answered: usize,
    any: bool,
}

/// The number of bursts of joints; JOINTS-4 fails if old joints are answered in all of them.
const BURST_COUNT: usize = 4;

fn send_joints_burst(
    session: &mut Session<'_>,
    press: i32,
    shown: &mut BurstResults,
) -> Result<(), StopReason> {
    const JOINTS_PER_BURST: u8 = 24;
    // In contact: skipped joints change the contact as little as the commit does.
    session.commit_parameters(&arm::example_parameters(6))?;
    session.stimulate_and_send_joints(&POSITIONS, arm::press_with_sum(press + 1))?;
    session.commit_parameters(&Parameters { period_us: 1, ..arm::example_parameters(6) })?;
    session.exchange_messages(&[])?;
    let before = session.counters()?;
    session.send_stimulus(arm::press_with_sum(press))?;
    session.begin_exchange();
    let mut sent: Vec<(u8, Micros)> = Vec::new();
    let mut frames = Vec::new();
    for _ in 0..JOINTS_PER_BURST {
        let epoch = session.next_epoch();
        sent.push((epoch, Micros(0)));
        frames.extend(session.frames(&session.joints_message(epoch, &POSITIONS)));
    }
    let times = session.send_all(&frames)?;
    let each = frames.len() / usize::from(JOINTS_PER_BURST);
    for (sent, at) in sent.iter_mut().zip(times.chunks(each)) {
        sent.1 = at.last().copied().unwrap_or_default();
    }
    session.receive_for(Span::from_millis(60))?;
    session.mark_packets_expected();
    let answers: Vec<_> = session.answers().iter().filter_map(|it| Some((it.at, it.torque()?.0.0))).collect();
    if let Some(text) = find_old_answer(&sent, &answers) {
        (shown.any, shown.answered) = (true, shown.answered + 1);
        // The time stamps of the bus differ from those of the cell: a single burst proves nothing.
        session.check("JOINTS-4", shown.answered < BURST_COUNT, || text);
    }
    session.known.epoch = None;
    // A cell may lose some joints of a burst.
    session.forget_counters();
    let after = session.counters()?;
    let [joints, skipped, torques] = [
        after.heard.joints.wrapping_sub(before.heard.joints),
        after.heard.joints_late.wrapping_sub(before.heard.joints_late),
        after.heard.torques.wrapping_sub(before.heard.torques),
    ];
    let taken = joints.wrapping_add(skipped);
    let is_so =
        taken <= u16::from(JOINTS_PER_BURST) && usize::from(torques) == answers.len() && joints >= torques;
    session.check("JOINTS-4", is_so, || {
        format!(
            "the counters must match the {JOINTS_PER_BURST} joints messages sent and the torque messages \
             received, but the cell counted {joints} joints messages, {skipped} skipped ones and {torques} \
             torques, and sent {} torque messages",
            answers.len()
        )
    });
    shown.any |= skipped > 0;
    if skipped > 0 && taken == u16::from(JOINTS_PER_BURST) {
        // Skipped joints still count as the last ones, latch stimuli and leave ACTIVE unchanged.
        let page = session.read_latched_skin()?;
        session.check("STIM-8", page == Some(arm::press_with_sum(press)), || {
            format!(
                "a skipped joints message must latch a pending stimulus, but {} is latched",
                arm::format_skin(page)
            )
        });
        session.known.epoch = Some(session.known.last_epoch);
        session.known.active = Some(true);
        session.exchange_messages(&[])?;
        let joints = session.joints_message(session.known.last_epoch, &POSITIONS);
        session.exchange_messages(&[joints])?;
        let again = session.counters()?.heard.joints_repeated.wrapping_sub(after.heard.joints_repeated);
        session.check("JOINTS-3", again == 1, || {
            "a joints message with the epoch of a skipped one must be counted as repeated, but it was not"
                .to_owned()
        });
    }
    Ok(())
}

/// Returns a description of joints that were answered although they were too old, if there are any. A cell that answers
/// one joints message after the next one has come is too late for that next one, and must not answer it.
fn find_old_answer(sent: &[(u8, Micros)], answers: &[(Micros, u8)]) -> Option<String> {
    const OLD_JOINTS_TIME_MARGIN: Span = Span(100);
    let late = answers.windows(2).find(|pair| match pair {
        [(before, _), (_, epoch)] => {
            sent.iter().any(|(of, at)| of == epoch && before.elapsed_since(*at) > OLD_JOINTS_TIME_MARGIN)
        }
        _ => false,
    });
    let Some([(before, first), (_, epoch)]) = late else { return None };
    Some(format!(
        "with a period of 1 us, the cell must skip the joints message of epoch {epoch} as too old, because it \
         arrived before the answer to epoch {first} at {} us, but the cell answered it",
        before.0
    ))
}

/// Checks that joints that wait in the cell's receive queue are accepted too: the counters add up to the number sent.
fn check_no_joints_lost(session: &mut Session<'_>) -> Result<(), StopReason> {
    const WAITING_JOINTS: usize = 3;
    session.commit_parameters(&arm::example_parameters(6))?;
    session.stimulate_and_send_joints(&POSITIONS, arm::press_with_sum(4_096))?;
    session.counters()?;
    for _ in 0..8 {
        session.begin_exchange();
        let all: Vec<_> = (0..WAITING_JOINTS)
            .map(|_| {
                let epoch = session.next_epoch();
                session.joints_message(epoch, &POSITIONS)
            })
            .collect();
        let frames: Vec<_> = all.iter().flat_map(|joints| session.frames(joints)).collect();
        session.send(&frames)?;
        session.known.epoch = Some(session.known.last_epoch);
        session.receive_for(Span::from_millis(4))?;
        session.mark_packets_expected();
    }
    session.known.active = None;
    session.counters()?;
    Ok(())
}
