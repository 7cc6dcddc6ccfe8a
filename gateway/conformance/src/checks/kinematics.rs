//! J of arms of many shapes, and torque words to the bit.

use model::central::Central;
use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::parameters::{Abilities, MAX_JOINTS, Parameters, Pose, Row};

use crate::arm::{self, Dice, Shape};
use crate::bus::Stop;
use crate::session::Session;

/// Joint positions of one arm.
const POSES: usize = 20;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), Stop> {
    let mut dice = Dice::new(1);
    for parameters in arms(&mut dice, session.about.abilities) {
        one(session, &mut dice, &parameters)?;
    }
    out_of_reach(session)
}

/// Arms that the cell can compute: a UR5, six revolute joints of any shape, and what else its identity says.
fn arms(dice: &mut Dice, abilities: Abilities) -> Vec<Parameters> {
    let mut arms: Vec<_> = [2, 6, 1].map(arm::document).into();
    let six = |prismatic, rows| Shape { joints: 6, rows, prismatic };
    arms.extend((0..4).map(|_| arm::random(dice, six(false, 6))));
    let (joints, rows) = (abilities.joints(), abilities.rows());
    // Few joints, many joints, and other kinds of rows.
    let more = [
        Shape { joints: 1, rows: 1, prismatic: false },
        Shape { joints: 3, rows: 3, prismatic: false },
        six(true, 6),
        Shape { joints: 3, rows: 6, prismatic: false },
        Shape { joints: 7, rows: 9, prismatic: true },
        Shape { joints: 10, rows: 14, prismatic: false },
        Shape { joints: 14, rows: 20, prismatic: true },
        Shape { joints: 14, rows: 32, prismatic: true },
    ];
    for shape in more.into_iter().filter(|shape| shape.joints <= joints && shape.rows <= rows) {
        let parameters = arm::random(dice, shape);
        if abilities.lacks(&parameters).is_none() {
            arms.push(parameters);
        }
    }
    for format in [TorqueFormat::Q5_10, TorqueFormat::Q7_8] {
        let parameters = Parameters { torque_format: format, ..arm::document(6) };
        if abilities.lacks(&parameters).is_none() {
            arms.push(parameters);
        }
    }
    arms
}

/// One arm at many joint positions.
fn one(session: &mut Session<'_>, dice: &mut Dice, parameters: &Parameters) -> Result<(), Stop> {
    if !session.ready(parameters)? {
        return Ok(());
    }
    let central = Central::of_cell(parameters);
    let format = parameters.torque_format;
    for _ in 0..session.attempts(POSES) {
        let positions = arm::positions(dice, parameters);
        let j = session.pressed(&positions, arm::press(arm::unit_press(format)))?.words();
        look_at_j(session, parameters, &central, &positions, &j);
        // The same joints again, with any force: J is known now.
        let press = arm::press(i32::from(dice.word()).abs() * 3);
        let words = session.pressed(&positions, press)?.words();
        look_at_words(session, parameters, &j, arm::force(&parameters.contact, &press), &words, "TORQUE-1");
    }
    Ok(())
}

fn look_at_j(
    session: &mut Session<'_>,
    parameters: &Parameters,
    central: &Central,
    positions: &[i16; MAX_JOINTS],
    j: &[i16; MAX_JOINTS],
) {
    let exact = arm::exact_jacobian(central, positions);
    let off = j.iter().zip(exact).map(|(&word, exact)| arm::off(word, exact)).max().unwrap_or(0);
    let most = arm::tolerance(parameters);
    let joints = usize::from(parameters.joints);
    session.check("J-3", off <= most, || {
        let nearest = exact.map(|x| Q1_14::nearest(x).to_bits());
        format!(
            "J is {:?}, {off} steps off {:?}; {most} are allowed",
            j.get(..joints).unwrap_or_default(),
            nearest.get(..joints).unwrap_or_default()
        )
    });
}

/// Words of a torque of which J and the force are known.
pub(super) fn look_at_words(
    session: &mut Session<'_>,
    parameters: &Parameters,
    j: &[i16; MAX_JOINTS],
    force: i64,
    words: &[i16; MAX_JOINTS],
    id: &'static str,
) {
    let expected = j.map(|j| arm::word(j, force, parameters.torque_format));
    let joints = usize::from(parameters.joints);
    session.check(id, expected == *words, || {
        format!(
            "the torque of {force} steps of 2^-16 N is {:?}, not {:?}; J is {:?}",
            words.get(..joints).unwrap_or_default(),
            expected.get(..joints).unwrap_or_default(),
            j.get(..joints).unwrap_or_default()
        )
    });
}

/// A lever of 3.8 m.
fn out_of_reach(session: &mut Session<'_>) -> Result<(), Stop> {
    let far = Q1_14::from_bits(31_000);
    for sign in [1, -1] {
        let mut parameters = Parameters { joint: 1, joints: 1, ..arm::document(1) };
        parameters.rows = [Row::default(); protocol::parameters::MAX_ROWS];
        if let Some(row) = parameters.rows.first_mut() {
            row.a = far;
        }
        let normal = [0, 0x4000 * sign, 0].map(Q1_14::from_bits);
        parameters.pose = Pose { position: [far, Q1_14::ZERO, Q1_14::ZERO], normal };
        if !session.ready(&parameters)? {
            return Ok(());
        }
        let press = arm::press(arm::unit_press(parameters.torque_format));
        let [first, ..] = session.pressed(&[0x2345; MAX_JOINTS], press)?.words();
        // The force is against the normal.
        let is_held = if sign > 0 { first <= i16::MIN + 8 } else { first >= i16::MAX - 8 };
        session.check("J-2", is_held, || {
            let word = if sign > 0 { "8000" } else { "7FFF" };
            format!(
                "a lever of {:.1} m: J is {first:04X}, and has to be held at {word}",
                -3.78 * f64::from(sign)
            )
        });
    }
    Ok(())
}
