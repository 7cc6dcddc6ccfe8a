//! Checks of Algorithm 1 and of torque words, bit for bit. J is measured first, with a force for which the torque words
//! equal J.

use protocol::fixed::{Q1_14, Q3_12, Q5_10, TorqueFormat};
use protocol::message::SkinSensors;
use protocol::parameters::{Contact, MAX_JOINTS, Parameters};

use super::kinematics::check_torque_words;
use crate::arm::{self, TestRandom};
use crate::bus::StopReason;
use crate::session::Session;

/// The number of random forces for each of several rules.
const RANDOM_FORCE_COUNT: usize = 40;
/// The number of forces that are sent to reveal a rounding error.
const ROUNDING_FORCE_COUNT: usize = 12;

/// The sensor words of a press: three of contact, and one of proximity.
type SensorWords = ([i16; 3], i16);

/// Joint positions, and the words of J that were measured at them.
struct MeasuredPose {
    positions: [i16; MAX_JOINTS],
    j: [i16; MAX_JOINTS],
}

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    let mut dice = TestRandom::new(2);
    let parameters = arm::example_parameters(6);
    if !session.prepare_cell(&parameters)? {
        return Ok(());
    }
    let mut known = Vec::new();
    for _ in 0..4 {
        let positions = arm::random_positions(&mut dice, &parameters);
        let j = session
            .stimulate_and_send_joints(
                &positions,
                arm::press_with_sum(arm::unit_press_sum(TorqueFormat::Q3_12)),
            )?
            .words();
        known.push(MeasuredPose { positions, j });
    }
    check_rounding_ties(session, &parameters, &known)?;
    for (contact, crafted) in contact_rule_cases() {
        let parameters = Parameters { contact, ..parameters };
        if session.prepare_cell(&parameters)? {
            check_contact_rule(session, &mut dice, &parameters, &known, &crafted)?;
        }
    }
    for format in [TorqueFormat::Q5_10, TorqueFormat::Q7_8] {
        let parameters = Parameters { torque_format: format, contact: arm::UNIT_GAIN_CONTACT, ..parameters };
        if session.about.abilities.first_missing(&parameters).is_none()
            && session.prepare_cell(&parameters)?
        {
            check_rounding_ties(session, &parameters, &known)?;
        }
    }
    Ok(())
}

/// Checks one press at joint positions with a known J.
fn check_press(
    session: &mut Session<'_>,
    parameters: &Parameters,
    known: &MeasuredPose,
    skin: SkinSensors,
    id: &'static str,
) -> Result<(), StopReason> {
    let step = session.stimulate_and_send_joints(&known.positions, skin)?;
    let force = arm::expected_force(&parameters.contact, &skin);
    let is_there = step.torque.is_some_and(|words| !words.is_zero() || force > 0);
    let sensed = || {
        format!(
            "contact words {} and proximity {}",
            arm::format_words(&skin.contact.map(Q5_10::to_bits)),
            skin.proximity.to_bits()
        )
    };
    session.check(id, is_there == (force > 0), || {
        let came = if is_there { "the cell sent a nonzero torque" } else { "the cell sent no torque" };
        format!("with {}, the force F_z must be {force} steps of 2^-16 N, but {came}", sensed())
    });
    if is_there {
        check_torque_words(session, parameters, &known.j, force, &step.words(), id);
    }
    Ok(())
}

/// Checks products that end in exactly half a step, and words at the limits of their range.
fn check_rounding_ties(
    session: &mut Session<'_>,
    parameters: &Parameters,
    known: &[MeasuredPose],
) -> Result<(), StopReason> {
    let format = parameters.torque_format;
    let bits = 30 - i64::from(format.fraction_bits());
    let product = |j: i16, sum: i32| i64::from(j) * i64::from(sum) * 64;
    for known in known {
        let words: Vec<_> = known.j.iter().copied().filter(|j| *j != 0).collect();
        let is_tie =
            |sum: i32| words.iter().any(|j| product(*j, sum).rem_euclid(1 << bits) == 1 << (bits - 1));
        let is_end = |sum: i32| {
            words.iter().any(|j| {
                let word = (product(*j, sum) + (1 << (bits - 1))) >> bits;
                word == i64::from(i16::MAX) || word == i64::from(i16::MIN)
            })
        };
        let most = 3 * i32::from(i16::MAX);
        let mut sums: Vec<_> = (1..most).filter(|sum| is_tie(*sum)).step_by(97).take(6).collect();
        sums.extend((1..most).filter(|sum| is_end(*sum)).take(2));
        sums.extend([most, 1, 2, 9_000, 40_000]);
        for sum in sums {
            check_press(session, parameters, known, arm::press_with_sum(sum), "TORQUE-1")?;
        }
    }
    Ok(())
}

/// Returns gains and thresholds, each with sensor words at their corner cases.
fn contact_rule_cases() -> Vec<(Contact, Vec<SensorWords>)> {
    let rule = |words: [i16; 5]| {
        let [alpha_c, alpha_p, contact, proximity, force] = words;
        Contact {
            alpha_c: Q3_12::from_bits(alpha_c),
            alpha_p: Q5_10::from_bits(alpha_p),
            contact_threshold: Q5_10::from_bits(contact),
            proximity_threshold: Q1_14::from_bits(proximity),
            force_threshold: Q5_10::from_bits(force),
        }
    };
    let big = i16::MAX;
    let max = i16::MAX;
    vec![
        // Thresholds: a value equal to the threshold counts.
        (
            arm::example_contact(),
            vec![
                ([103, 0, 0], 0),
                ([102, 0, 0], 0),
                ([34, 34, 35], 0),
                ([34, 34, 34], 0),
                ([-897, 500, 500], 0),
                ([-898, 500, 500], 0),
                ([max, max, max], 0),
                ([i16::MIN, i16::MIN, i16::MIN], 0),
                ([max, i16::MIN, 200], 0),
            ],
        ),
        // F_c is wider than a word; forces are never negative.
        (
            rule([4096, 1024, 0, 0x0334, 0]),
            vec![
                ([0, 0, 0], 0x0334),
                ([0, 0, 0], 0x0333),
                ([0, 0, 0], -5),
                ([0, 0, 0], i16::MIN),
                ([-3, 1, 1], 0),
                ([-300, 0, 0], 0x4000),
                ([big, big, 2], 0x4000),
                ([big, 1, 0], 0),
            ],
        ),
        // Steps below 2^-16 N: 127 of 2^-24 round down to none, 128 round up to one.
        (
            rule([1, 1, 0, 0, 0]),
            vec![
                ([0, 0, 0], 127),
                ([0, 0, 0], 128),
                ([0, 0, 0], 383),
                ([0, 0, 0], 384),
                ([31, 0, 0], 3),
                ([32, 0, 0], 0),
                ([max, max, max], max),
            ],
        ),
        // F_z,th is compared with all bits of F_z.
        (
            rule([5, 3, 0, 0, 1]),
            vec![([818, 0, 0], 8), ([818, 0, 0], 7), ([819, 0, 0], 1), ([0, 0, 0], 5461), ([0, 0, 0], 5462)],
        ),
        // F_c and F_p each have their own threshold, and F_z has another one.
        (
            rule([0x0CCD, 0x0666, 200, 4000, 300]),
            vec![
                ([199, 0, 0], 3999),
                ([200, 0, 0], 3999),
                ([199, 0, 0], 4000),
                ([200, 0, 0], 4000),
                ([374, 0, 0], 0),
                ([375, 0, 0], 0),
                ([100, 100, 170], 0),
            ],
        ),
        (rule([max, max, 0, 0, 0]), vec![([max, max, max], max), ([1, 0, 0], 0), ([0, 0, 0], 1)]),
    ]
}

fn check_contact_rule(
    session: &mut Session<'_>,
    dice: &mut TestRandom,
    parameters: &Parameters,
    known: &[MeasuredPose],
    crafted: &[SensorWords],
) -> Result<(), StopReason> {
    let skin = |(contact, proximity): SensorWords| SkinSensors {
        contact: contact.map(Q5_10::from_bits),
        proximity: Q1_14::from_bits(proximity),
        ..SkinSensors::default()
    };
    for (place, words) in crafted.iter().enumerate() {
        if let Some(known) = known.get(place % known.len().max(1)) {
            check_press(session, parameters, known, skin(*words), "FORCE-1")?;
        }
    }
    let mut random = |shift: u32| {
        let contact = [0; 3].map(|_| dice.random_word() >> shift);
        (contact, (dice.random_word() >> shift) & i16::MAX)
    };
    for place in 0..session.reduced_attempts(RANDOM_FORCE_COUNT) {
        let shift = [0, 2, 4, 7];
        let (Some(known), Some(shift)) = (known.get(place % 4), shift.get(place / 2 % 4)) else { continue };
        check_press(session, parameters, known, skin(random(*shift)), "FORCE-1")?;
    }
    // Forces for which truncating F_z instead of rounding it gives another word.
    let mut shown = 0;
    for attempt in 0..4_000 {
        let (Some(known), skin) = (known.get(attempt % 4), skin(random(3))) else { continue };
        let force = arm::expected_force(&parameters.contact, &skin);
        let shows = |j: &i16| {
            let word = |force| arm::torque_word(*j, force, parameters.torque_format);
            word(force) != word(force - 1) && !protocol::fixed::is_saturated(word(force))
        };
        if force > 1 && is_force_rounded_up(&parameters.contact, &skin) && known.j.iter().any(shows) {
            check_press(session, parameters, known, skin, "FORCE-1")?;
            shown += 1;
            if shown >= session.reduced_attempts(ROUNDING_FORCE_COUNT) {
                break;
            }
        }
    }
    Ok(())
}

/// Returns true if F_z is rounded up, so that truncating it would give one step of 2^-16 N less.
fn is_force_rounded_up(contact: &Contact, skin: &SkinSensors) -> bool {
    let bits = |word: i16| i64::from(word);
    let sum: i64 = skin.contact.iter().map(|word| bits(word.to_bits())).sum();
    let sum = if sum < bits(contact.contact_threshold.to_bits()) { 0 } else { sum };
    let p = bits(skin.proximity.to_bits());
    let p = if p < bits(contact.proximity_threshold.to_bits()) { 0 } else { p };
    let all = ((bits(contact.alpha_c.to_bits()) * sum) << 2) + bits(contact.alpha_p.to_bits()) * p;
    all.rem_euclid(256) >= 128
}
