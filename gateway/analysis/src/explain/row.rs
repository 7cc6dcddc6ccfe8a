//! One word of a cell's torque: its expected value, and the cause if it differs.

use protocol::fixed::{Accumulator, TorqueFormat, is_saturated};
use protocol::packet::Words;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::Joint;
use serde::Serialize;

use super::ForceSteps;

/// Maximum error of J in a cell with 16-bit arithmetic, in steps of 2^-14 m: the 5e-4 m that the kernels guarantee for
/// arms of any shape. Each row of the chain after the sixth, up to the cell's, adds one.
pub const MAX_JACOBIAN_ERROR_STEPS: i64 = 8;

/// The torque of one cell on one joint: as sent, and as computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TorqueRow {
    /// Number of the joint in the robot, from 1.
    pub joint: u8,
    /// Unit of the torques on the joint: Nm, or N for a prismatic joint.
    pub unit: &'static str,
    /// The exact element J of the Jacobian with the quantised parameters, in m; absent if unknown.
    pub jacobian_m: Option<f64>,
    /// The product J F_z in double precision, in Nm.
    pub product_nm: Option<f64>,
    /// The product J F_z, rounded to a step of 2^-12 Nm and clamped to the range of a word.
    pub nearest_word: Option<i16>,
    /// The word in the cell's torque.
    pub word: Option<i16>,
    /// The value of that word in Nm.
    pub word_nm: Option<f64>,
    /// The sent word minus the nearest word, in steps of 2^-12 Nm.
    pub difference_steps: Option<i32>,
    /// The cause of the difference, if there is one.
    pub verdict: WordVerdict,
}

/// The cause of a difference between a sent word and the exact product.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "is")]
pub enum WordVerdict {
    /// The word is the step nearest to the exact product.
    Nearest,
    /// The product is out of the range of a word, and the word is saturated as required.
    Saturated,
    /// The cell's 16-bit arithmetic: a J near the exact one gives this word.
    Rounded {
        /// The J that gives the word, in m.
        jacobian_m: f64,
        /// The distance of that J from the exact one, in steps of 2^-14 m.
        jacobian_steps: f64,
    },
    /// No J near the exact one gives this word.
    Unexplained,
    /// The word or its expected value is unknown, so that they cannot be compared.
    Open,
}

/// Returns a joint's number, from 1, given its index in the robot.
pub(super) fn joint_number(joint: usize) -> u8 {
    u8::try_from(joint + 1).unwrap_or(u8::MAX)
}

#[expect(clippy::too_many_arguments, reason = "each is a column of the row")]
pub(super) fn torque_row(
    &(joint, described): &(usize, &Joint),
    at: usize,
    steps: Option<i64>,
    force: Option<&ForceSteps>,
    exact: &[f64; MAX_JOINTS],
    unit: &[f64; MAX_JOINTS],
    format: TorqueFormat,
    words: Option<&Words>,
) -> TorqueRow {
    let of = |values: &[f64; MAX_JOINTS]| force.and_then(|_| values.get(at).copied());
    let (jacobian_m, product_nm) = (of(unit), of(exact));
    let nearest = product_nm.map(|product| format.nearest_word(product));
    let word = words.and_then(|words| words.as_slice().get(at).copied());
    let difference = nearest.zip(word).map(|(nearest, word)| i32::from(word) - i32::from(nearest));
    let verdict = match (force, jacobian_m, nearest, word) {
        (Some(force), Some(jacobian), Some(nearest), Some(word)) => {
            word_verdict(force.force_steps, jacobian, steps, format, nearest, word)
        }
        (_, _, _, _) => WordVerdict::Open,
    };
    TorqueRow {
        joint: joint_number(joint),
        unit: described.kind.torque_unit(),
        jacobian_m,
        product_nm,
        nearest_word: nearest,
        word,
        word_nm: word.map(|word| format.to_real(word)),
        difference_steps: difference,
        verdict,
    }
}

/// Returns the maximum error of J in steps of 2^-14 m, for a cell on the row with this number.
pub(super) fn max_jacobian_error_steps(rows: usize) -> i64 {
    MAX_JACOBIAN_ERROR_STEPS
        + i64::try_from(rows.saturating_sub(6)).unwrap_or(i64::MAX - MAX_JACOBIAN_ERROR_STEPS)
}

/// Returns the cause of the difference between a word and its expected value `nearest`. For a joint that does not move
/// the cell, J is exactly zero and `steps` is `None`.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    reason = "J is within +-2 m: 2^15 steps"
)]
fn word_verdict(
    force_steps: i64,
    jacobian_m: f64,
    steps: Option<i64>,
    format: TorqueFormat,
    nearest: i16,
    word: i16,
) -> WordVerdict {
    if word == nearest {
        return if is_saturated(word) { WordVerdict::Saturated } else { WordVerdict::Nearest };
    }
    let Some(within) = steps else { return WordVerdict::Unexplained };
    let exact = jacobian_m * 16_384.0;
    let middle = exact.round() as i64;
    let mut near: Vec<i64> = (middle - within - 1..=middle + within + 1).collect();
    let off = |steps: i64| steps as f64 - exact;
    near.sort_by(|one, other| off(*one).abs().total_cmp(&off(*other).abs()));
    let gives = |steps: i64| format.round(Accumulator::<30>::from_steps(steps * force_steps)) == word;
    let found = near.into_iter().find(|&steps| off(steps).abs() <= within as f64 && gives(steps));
    found.map_or(WordVerdict::Unexplained, |steps| WordVerdict::Rounded {
        jacobian_m: steps as f64 / 16_384.0,
        jacobian_steps: off(steps),
    })
}
