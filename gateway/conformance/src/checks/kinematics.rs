//! Checks of J for arms of many shapes, and of torque words bit for bit.

use model::central::CentralComputation;
use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::parameters::{Abilities, MAX_JOINTS, Parameters, Pose, Row, RowKind};

use crate::arm::{self, ChainShape, TestRandom};
use crate::bus::StopReason;
use crate::session::Session;

/// The number of joint positions per arm.
const POSES_PER_ARM: usize = 20;
/// The number of joint positions per arm, for arms that differ only in their number of joints.
const POSES_PER_LENGTH: usize = 4;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    let mut dice = TestRandom::new(1);
    for parameters in test_arms(&mut dice, session.about.abilities) {
        check_arm(session, &mut dice, &parameters, POSES_PER_ARM)?;
    }
    for parameters in arms_of_each_length(&mut dice, session.about.abilities) {
        check_arm(session, &mut dice, &parameters, POSES_PER_LENGTH)?;
    }
    check_jacobian_saturation(session)
}

/// Returns arms that the cell can compute: a UR5, six revolute joints of any shape, and the further shapes that its
/// identity allows.
fn test_arms(dice: &mut TestRandom, abilities: Abilities) -> Vec<Parameters> {
    let mut arms: Vec<_> = [2, 6, 1].map(arm::example_parameters).into();
    arms.extend(arms_with_half_turns());
    let six = |prismatic, rows| ChainShape { joints: 6, rows, prismatic };
    arms.extend((0..4).map(|_| arm::random_parameters(dice, six(false, 6))));
    let (joints, rows) = (abilities.max_joints(), abilities.max_rows());
    // Few joints, many joints, and other kinds of rows.
    let more = [
        ChainShape { joints: 1, rows: 1, prismatic: false },
        ChainShape { joints: 3, rows: 3, prismatic: false },
        six(true, 6),
        ChainShape { joints: 3, rows: 6, prismatic: false },
        ChainShape { joints: 7, rows: 9, prismatic: true },
        ChainShape { joints: 10, rows: 14, prismatic: false },
        ChainShape { joints: 14, rows: 20, prismatic: true },
        ChainShape { joints: 14, rows: 32, prismatic: true },
    ];
    for shape in more.into_iter().filter(|shape| shape.joints <= joints && shape.rows <= rows) {
        let parameters = arm::random_parameters(dice, shape);
        if abilities.first_missing(&parameters).is_none() {
            arms.push(parameters);
        }
    }
    for format in [TorqueFormat::Q5_10, TorqueFormat::Q7_8] {
        let parameters = Parameters { torque_format: format, ..arm::example_parameters(6) };
        if abilities.first_missing(&parameters).is_none() {
            arms.push(parameters);
        }
    }
    arms
}

/// Returns two UR5s with angles of half a turn, which is the lowest word: in two twists, and in two joint offsets.
fn arms_with_half_turns() -> [Parameters; 2] {
    let half = |places: [usize; 2], turn: fn(&mut Row)| {
        let mut parameters = arm::example_parameters(6);
        for place in places {
            parameters.rows.iter_mut().skip(place).take(1).for_each(turn);
        }
        parameters
    };
    [half([1, 4], |row| row.alpha = Q1_14::MIN), half([0, 3], |row| row.theta_offset = Q1_14::MIN)]
}

/// Returns arms of each number of joints above six, with a row for each joint and the cell at the tip.
fn arms_of_each_length(dice: &mut TestRandom, abilities: Abilities) -> Vec<Parameters> {
    let most = abilities.max_joints().min(abilities.max_rows());
    let of = |joints| {
        let arm = arm::random_parameters(dice, ChainShape { joints, rows: joints, prismatic: false });
        Parameters { joint: arm.joints, ..arm }
    };
    (7..=most).map(of).collect()
}

/// Checks one arm at many joint positions.
fn check_arm(
    session: &mut Session<'_>,
    dice: &mut TestRandom,
    parameters: &Parameters,
    poses: usize,
) -> Result<(), StopReason> {
    if !session.prepare_cell(parameters)? {
        return Ok(());
    }
    let central = CentralComputation::for_single_cell(parameters);
    let format = parameters.torque_format;
    let mut positions = [0; MAX_JOINTS];
    for pose in 0..session.reduced_attempts(poses) {
        let next = arm::random_positions(dice, parameters);
        // Every third time only joints beyond the sixth move.
        let stays = if pose % 3 == 2 && parameters.joints > 6 { 6 } else { 0 };
        positions.iter_mut().zip(next).skip(stays).for_each(|(position, next)| *position = next);
        let j = session
            .stimulate_and_send_joints(&positions, arm::press_with_sum(arm::unit_press_sum(format)))?
            .words();
        check_jacobian(session, parameters, &central, &positions, &j);
        // The same joints again, with any force: J is known now.
        let press = arm::press_with_sum(i32::from(dice.random_word()).abs() * 3);
        let words = session.stimulate_and_send_joints(&positions, press)?.words();
        check_torque_words(
            session,
            parameters,
            &j,
            arm::expected_force(&parameters.contact, &press),
            &words,
            "TORQUE-1",
        );
    }
    Ok(())
}

fn check_jacobian(
    session: &mut Session<'_>,
    parameters: &Parameters,
    central: &CentralComputation,
    positions: &[i16; MAX_JOINTS],
    j: &[i16; MAX_JOINTS],
) {
    let exact = arm::exact_jacobian(central, positions);
    let off =
        j.iter().zip(exact).map(|(&word, exact)| arm::rounding_error_steps(word, exact)).max().unwrap_or(0);
    let most = arm::jacobian_tolerance_steps(parameters);
    let joints = usize::from(parameters.joints);
    session.check("J-3", off <= most, || {
        let nearest = exact.map(|x| Q1_14::nearest(x).to_bits());
        format!(
            "the Jacobian J is {}, which is {off} steps off the expected {}, but at most {most} steps are \
             allowed",
            arm::format_words(j.get(..joints).unwrap_or_default()),
            arm::format_words(nearest.get(..joints).unwrap_or_default())
        )
    });
}

/// Checks the words of a torque with known J and force.
pub(super) fn check_torque_words(
    session: &mut Session<'_>,
    parameters: &Parameters,
    j: &[i16; MAX_JOINTS],
    force: i64,
    words: &[i16; MAX_JOINTS],
    id: &'static str,
) {
    let expected = j.map(|j| arm::torque_word(j, force, parameters.torque_format));
    let joints = usize::from(parameters.joints);
    session.check(id, expected == *words, || {
        format!(
            "the torque words for a force of {force} steps of 2^-16 N are {}, but they must be {}, because \
             the Jacobian J is {}",
            arm::format_words(words.get(..joints).unwrap_or_default()),
            arm::format_words(expected.get(..joints).unwrap_or_default()),
            arm::format_words(j.get(..joints).unwrap_or_default())
        )
    });
}

/// Checks that J saturates with levers of 3.8 m: one of a link, and one of a prismatic joint that slides beyond the
/// range of a word.
fn check_jacobian_saturation(session: &mut Session<'_>) -> Result<(), StopReason> {
    let far = Q1_14::from_bits(31_000);
    let mut long = Parameters { joint: 1, joints: 1, ..arm::example_parameters(1) };
    long.rows = [Row { a: far, ..Row::default() }; protocol::parameters::MAX_ROWS];
    long.pose.position = [far, Q1_14::ZERO, Q1_14::ZERO];
    check_saturated_jacobian(session, &long, &[0x2345; MAX_JOINTS], [0, 0x4000, 0])?;
    // The second joint slides along y of the first; the force is along x.
    let mut slides = Parameters { joint: 2, joints: 2, row: 2, table_rows: 2, ..arm::example_parameters(2) };
    slides.rows = [Row::default(); protocol::parameters::MAX_ROWS];
    if let [first, second, ..] = slides.rows.as_mut_slice() {
        first.alpha = Q1_14::from_bits(-0x4000);
        (second.kind, second.d) = (RowKind::Prismatic, far);
    }
    slides.pose.position = [Q1_14::ZERO; 3];
    if session.about.abilities.first_missing(&slides).is_none() {
        let mut positions = [0; MAX_JOINTS];
        positions.iter_mut().skip(1).take(1).for_each(|slide| *slide = far.to_bits());
        check_saturated_jacobian(session, &slides, &positions, [-0x4000, 0, 0])?;
    }
    Ok(())
}

/// Checks that J of the first joint saturates: at its lowest word with this normal of the cell, and at its highest word
/// with the opposite normal.
fn check_saturated_jacobian(
    session: &mut Session<'_>,
    arm: &Parameters,
    positions: &[i16; MAX_JOINTS],
    normal: [i16; 3],
) -> Result<(), StopReason> {
    for sign in [1, -1] {
        let pose = Pose { normal: normal.map(|word| Q1_14::from_bits(word * sign)), ..arm.pose };
        let parameters = Parameters { pose, ..*arm };
        if !session.prepare_cell(&parameters)? {
            return Ok(());
        }
        let press = arm::press_with_sum(arm::unit_press_sum(parameters.torque_format));
        let [first, ..] = session.stimulate_and_send_joints(positions, press)?.words();
        let is_held = if sign > 0 { first <= i16::MIN + 8 } else { first >= i16::MAX - 8 };
        session.check("J-2", is_held, || {
            let word = if sign > 0 { "8000" } else { "7FFF" };
            format!(
                "with a lever arm of {:.1} m about the joint's axis, the Jacobian J must saturate at {word}, but it is {first:04X}",
                -3.78 * f64::from(sign)
            )
        });
    }
    Ok(())
}
