//! Checks of stimuli: the joints that latch them, the number that can be pending, and the events that clear them.

use protocol::id::Node;
use protocol::message::{Message, SensorPage, StimulusStart};
use protocol::packet::Epoch;
use protocol::parameters::{MAX_JOINTS, Parameters};

use super::kinematics::check_torque_words;
use crate::arm;
use crate::bus::StopReason;
use crate::session::Session;

const POSITIONS: [i16; MAX_JOINTS] =
    [0x0400, -0x2100, 0x1700, -0x0300, 0x2900, 0x0100, 0, 0, 0, 0, 0, 0, 0, 0];

/// A cell with a known J at [`POSITIONS`].
struct PressedCell {
    parameters: Parameters,
    j: [i16; MAX_JOINTS],
}

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    let parameters = arm::example_parameters(6);
    if !session.prepare_cell(&parameters)? {
        return Ok(());
    }
    let j = session
        .stimulate_and_send_joints(
            &POSITIONS,
            arm::press_with_sum(arm::unit_press_sum(parameters.torque_format)),
        )?
        .words();
    let cell = PressedCell { parameters, j };
    let before = session.counters()?;
    let mut count = check_stimuli_for_next_joints(session, &cell)?;
    count += check_stimulus_first_epochs(session, &cell)?;
    let late = check_late_stimuli(session, &cell)?;
    count += late;
    count += check_stimulus_order(session, &cell)?;
    let after = session.counters()?;
    let counted = after.heard.stimuli.wrapping_sub(before.heard.stimuli);
    session.check("STIM-3", counted == count, || {
        format!("{count} stimuli were sent, but the cell counted {counted}")
    });
    let counted = after.heard.stimuli_late.wrapping_sub(before.heard.stimuli_late);
    session.check("STIM-5", counted == late, || {
        format!("{late} stimuli were sent too late, but the cell counted {counted} as late")
    });
    let is_same = after.refused == before.refused;
    session.check("STIM-6", is_same, || {
        format!("stimuli must not be refused while fewer than 8 are pending, but the counters are {after}")
    });
    check_pending_limit(session, &cell)?;
    check_mode_write_clears(session, &cell)?;
    check_measuring_refuses_stimuli(session)?;
    check_halted_accepts_stimuli(session, &cell)
}

/// Sends joints of an epoch, and checks by the torque that a press with this sum of contact words is latched.
fn check_press_latched(
    session: &mut Session<'_>,
    cell: &PressedCell,
    epoch: u8,
    sum: i32,
    id: &'static str,
) -> Result<(), StopReason> {
    let skin = arm::press_with_sum(sum);
    session.known.skin = Some(skin);
    session.known.pending = None;
    let step = session.send_joints_at_epoch(epoch, &POSITIONS)?;
    let force = arm::expected_force(&cell.parameters.contact, &skin);
    let is_there = step.torque.is_some_and(|words| !words.is_zero());
    session.check(id, is_there == (sum > 0), || {
        format!(
            "the joints message of epoch {epoch} must latch a force of {} N, but the torque words are {}",
            f64::from(sum) / 1024.0,
            arm::format_words(&step.words())
        )
    });
    if is_there && sum > 0 {
        check_torque_words(session, &cell.parameters, &cell.j, force, &step.words(), id);
    }
    Ok(())
}

/// Checks stimuli for the next joints, and returns the number of stimuli sent.
fn check_stimuli_for_next_joints(session: &mut Session<'_>, cell: &PressedCell) -> Result<u16, StopReason> {
    let mut count = 0;
    let start = session.known.last_epoch;
    for (jump, sum) in [(1, 1_000), (200, 1_500), (3, 0), (128, 2_000), (255, 2_500)] {
        let epoch = session.known.last_epoch.wrapping_add(jump);
        session.send_stimulus(arm::press_with_sum(sum))?;
        check_press_latched(session, cell, epoch, sum, "STIM-4")?;
        check_press_latched(session, cell, epoch.wrapping_add(1), sum, "STIM-7")?;
        count += 1;
    }
    // The epoch byte is then ignored, and a stimulus to everyone counts too.
    let ahead = session.known.last_epoch.wrapping_add(60);
    for (epoch, to) in
        [(start, Node::Cell(session.cell)), (ahead, Node::Everyone), (ahead, Node::Cell(session.cell))]
    {
        let sum = 3_000 + i32::from(epoch);
        let page = SensorPage::Skin(arm::press_with_sum(sum));
        let mut packet = Message::Stimulus { to, from: StimulusStart::Next, page }.encode();
        packet.epoch = Epoch(epoch);
        let frames: Vec<_> = packet.frames(session.format).collect();
        session.send(&frames)?;
        let epoch = session.next_epoch();
        check_press_latched(session, cell, epoch, sum, "STIM-4")?;
        count += 1;
    }
    Ok(count)
}

/// Checks stimuli whose first epoch is near, far, or past the wrap-around, and returns the number of stimuli sent.
fn check_stimulus_first_epochs(session: &mut Session<'_>, cell: &PressedCell) -> Result<u16, StopReason> {
    let mut held = 4_000;
    let mut count = 1;
    session.send_stimulus(arm::press_with_sum(held))?;
    let epoch = session.next_epoch();
    check_press_latched(session, cell, epoch, held, "STIM-3")?;
    for (last, ahead) in [(10, 3), (250, 8), (250, 6), (100, 1), (20, 127), (200, 100)] {
        check_press_latched(session, cell, last, held, "STIM-3")?;
        let (first, sum) = (u8::wrapping_add(last, ahead), held + 111);
        session.send_stimulus_at_epoch(first, arm::press_with_sum(sum))?;
        count += 1;
        for step in [1, 2, ahead / 2, ahead - 1].into_iter().filter(|step| (1..ahead).contains(step)) {
            let epoch = last.wrapping_add(step);
            if epoch != session.known.last_epoch {
                check_press_latched(session, cell, epoch, held, "STIM-3")?;
            }
        }
        // The first epoch itself, or one or two after it.
        let epoch = first.wrapping_add(ahead % 3);
        check_press_latched(session, cell, epoch, sum, "STIM-3")?;
        held = sum;
    }
    // Two stimuli at once, each for its own epoch; joints with an earlier epoch do not latch later stimuli.
    let last = session.known.last_epoch;
    session.send_stimulus_at_epoch(last.wrapping_add(2), arm::press_with_sum(held + 300))?;
    session.send_stimulus_at_epoch(last.wrapping_add(3), arm::press_with_sum(held + 600))?;
    count += 2;
    check_press_latched(session, cell, last.wrapping_add(1), held, "STIM-3")?;
    check_press_latched(session, cell, last.wrapping_sub(20), held, "STIM-3")?;
    check_press_latched(session, cell, last.wrapping_add(2), held + 300, "STIM-3")?;
    check_press_latched(session, cell, last.wrapping_add(3), held + 600, "STIM-3")?;
    // The first epoch is exactly 128 ahead of the joints.
    let first = session.known.last_epoch.wrapping_add(100);
    session.send_stimulus_at_epoch(first, arm::press_with_sum(held + 900))?;
    check_press_latched(session, cell, first.wrapping_sub(128), held + 600, "STIM-3")?;
    check_press_latched(session, cell, first, held + 900, "STIM-3")?;
    Ok(count + 1)
}

/// Checks stimuli for epochs that are over, and returns the number of stimuli sent.
fn check_late_stimuli(session: &mut Session<'_>, cell: &PressedCell) -> Result<u16, StopReason> {
    let mut count = 0;
    for (behind, jump) in [(0, 1), (5, 1), (2, 250), (127, 1)] {
        let last = session.known.last_epoch;
        let sum = 5_000 + 100 * i32::from(behind) + i32::from(jump);
        session.send_stimulus_at_epoch(last.wrapping_sub(behind), arm::press_with_sum(sum))?;
        count += 1;
        check_press_latched(session, cell, last.wrapping_add(jump), sum, "STIM-5")?;
    }
    // Late for the joints of epoch 0.
    session.send_joints_at_epoch(0, &POSITIONS)?;
    session.send_stimulus_at_epoch(0, arm::press_with_sum(5_777))?;
    check_press_latched(session, cell, 1, 5_777, "STIM-5")?;
    Ok(count + 1)
}

/// Checks several stimuli for the same joints, and returns the number of stimuli sent.
fn check_stimulus_order(session: &mut Session<'_>, cell: &PressedCell) -> Result<u16, StopReason> {
    let mut count = 0;
    for (first, second, jump) in [(1, 1, 1), (2, 1, 2), (1, 2, 2), (3, 0, 3)] {
        let last = session.known.last_epoch;
        for (ahead, sum) in [(first, 6_000), (second, 7_000)] {
            if ahead > 0 {
                session.send_stimulus_at_epoch(last.wrapping_add(ahead), arm::press_with_sum(sum))?;
            } else {
                session.send_stimulus(arm::press_with_sum(sum))?;
            }
            count += 1;
        }
        // The acceleration is another page.
        let to = Node::Cell(session.cell);
        let page = SensorPage::Acceleration([1, 2, 3].map(protocol::fixed::Q3_12::from_bits));
        session.send_messages(&[Message::Stimulus { to, from: StimulusStart::Next, page }])?;
        count += 1;
        check_press_latched(session, cell, last.wrapping_add(jump), 7_000, "STIM-7")?;
        // A stimulus stays latched, whatever else comes.
        session.counters()?;
        session.read_parameter(1)?;
        for _ in 0..2 {
            let epoch = session.next_epoch();
            check_press_latched(session, cell, epoch, 7_000, "STIM-7")?;
        }
    }
    Ok(count)
}

/// Checks that eight stimuli can be pending, and the ninth is refused.
fn check_pending_limit(session: &mut Session<'_>, cell: &PressedCell) -> Result<(), StopReason> {
    let before = session.counters()?;
    let last = session.known.last_epoch;
    let to = Node::Cell(session.cell);
    for ahead in 1..=10 {
        let page = if ahead % 4 == 0 {
            SensorPage::Acceleration([protocol::fixed::Q3_12::from_bits(9); 3])
        } else {
            SensorPage::Skin(arm::press_with_sum(1_000 * i32::from(ahead)))
        };
        let first = StimulusStart::Epoch(Epoch(last.wrapping_add(20 + ahead)));
        session.send_messages(&[Message::Stimulus { to, from: first, page }])?;
    }
    let after = session.counters()?;
    let counted = (
        after.heard.stimuli.wrapping_sub(before.heard.stimuli),
        after.refused.stimuli.wrapping_sub(before.refused.stimuli),
    );
    session.check("STIM-6", counted == (8, 2), || {
        format!(
            "the cell must accept 8 of 10 stimuli and refuse 2, but it accepted {} and refused {}",
            counted.0, counted.1
        )
    });
    for ahead in [1, 2, 3, 5, 6, 7, 8, 9, 10, 11] {
        let expected = if ahead < 8 { 1_000 * i32::from(ahead) } else { 7_000 };
        check_press_latched(session, cell, last.wrapping_add(20 + ahead), expected, "STIM-6")?;
    }
    // There is room again.
    session.send_stimulus(arm::press_with_sum(1_234))?;
    let epoch = session.next_epoch();
    check_press_latched(session, cell, epoch, 1_234, "STIM-6")
}

/// Checks that a write of parameter 5 clears the latched and the pending stimuli.
fn check_mode_write_clears(session: &mut Session<'_>, cell: &PressedCell) -> Result<(), StopReason> {
    for on_between in [true, false] {
        session.send_stimulus(arm::press_with_sum(3_333))?;
        let epoch = session.next_epoch();
        check_press_latched(session, cell, epoch, 3_333, "STIM-2")?;
        session.send_stimulus_at_epoch(epoch.wrapping_add(2), arm::press_with_sum(4_444))?;
        if !on_between {
            session.switch_test_mode(false)?;
        }
        session.switch_test_mode(true)?;
        check_press_latched(session, cell, epoch.wrapping_add(1), 0, "STIM-2")?;
        check_press_latched(session, cell, epoch.wrapping_add(2), 0, "STIM-2")?;
    }
    Ok(())
}

/// Checks that a cell that measures accepts no stimuli.
fn check_measuring_refuses_stimuli(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.switch_test_mode(false)?;
    let before = session.counters()?;
    session.send_stimulus(arm::press_with_sum(5_555))?;
    session.known.pending = None;
    let last = session.known.last_epoch;
    session.send_stimulus_at_epoch(last.wrapping_add(1), arm::press_with_sum(6_666))?;
    let after = session.counters()?;
    let counted = after.refused.stimuli.wrapping_sub(before.refused.stimuli);
    session.check("STIM-1", counted == 2 && after.heard.stimuli == before.heard.stimuli, || {
        format!(
            "outside test mode, the cell must count 2 stimuli as refused, but it counted {counted}; the \
             counters are {after}"
        )
    });
    session.switch_test_mode(true)?;
    session.known.active = None;
    session.send_next_joints(&POSITIONS)?;
    let step = session.send_next_joints(&POSITIONS)?;
    session.check("STIM-1", step.torque.is_none(), || {
        "a stimulus sent outside test mode must not be latched, but the cell sent a torque message".to_owned()
    });
    Ok(())
}

/// Checks that a halted cell accepts and latches stimuli.
fn check_halted_accepts_stimuli(session: &mut Session<'_>, cell: &PressedCell) -> Result<(), StopReason> {
    let epoch = session.next_epoch();
    session.begin_exchange();
    session.send_messages(&[Message::Halt])?;
    (session.known.halted, session.known.active) = (Some(true), Some(false));
    session.send_stimulus_at_epoch(epoch.wrapping_add(1), arm::press_with_sum(2_222))?;
    session.send_joints_at_epoch(epoch, &POSITIONS)?;
    session.known.skin = Some(arm::press_with_sum(2_222));
    session.send_joints_at_epoch(epoch.wrapping_add(1), &POSITIONS)?;
    let skin = session.read_latched_skin()?;
    session.check("STIM-8", skin == Some(arm::press_with_sum(2_222)), || {
        format!("a halted cell must latch a stimulus, but {} is latched", arm::format_skin(skin))
    });
    session.send_messages(&[Message::Resume])?;
    session.known.halted = Some(false);
    check_press_latched(session, cell, epoch.wrapping_add(2), 2_222, "STIM-8")?;
    session.stimulate_and_send_joints(&POSITIONS, arm::press_with_sum(0))?;
    Ok(())
}
