//! Advice: the motion that would determine a pose which the recorded motion did not.

use nalgebra::{Cholesky, Matrix3};
use protocol::skin::Skin;
use serde::Serialize;

use crate::cell::{InformationMatrix, POSITION_UNKNOWNS, ROTATION_UNKNOWNS};
use crate::estimate::Estimate;
use crate::motion::MotionStep;
use crate::plan::{
    ProbeCell, SWING_DURATION_S, SwingAmplitudes, TARGET_DEVIATIONS, candidate_poses, step_information,
};
use crate::settings::Settings;
use model::accelerometer::kinematics::ArmKinematics;

/// The motion that would help to determine a pose.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "help", rename_all = "kebab-case")]
pub enum MotionAdvice {
    /// A joint should swing more.
    Swing {
        /// The joint's name.
        joint: String,
    },
    /// The robot should stand in more poses.
    Poses,
    /// No motion of this robot helps.
    Nothing,
}

impl core::fmt::Display for MotionAdvice {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Swing { joint } => write!(f, "a larger swing of {joint} would help most"),
            Self::Poses => f.write_str("more poses would help most"),
            Self::Nothing => f.write_str("no motion of this robot would help"),
        }
    }
}

/// The fraction of the uncertainty that may remain after a motion that counts as a help.
const HELPFUL_UNCERTAINTY_RATIO: f64 = 0.7;

/// Finds the motion that would reduce the uncertainty of a cell's pose most.
pub(crate) fn suggest_motion(
    skin: &Skin,
    bus: usize,
    estimate: &Estimate,
    settings: &Settings,
) -> MotionAdvice {
    let swings = SwingAmplitudes::new(skin, &settings.bounds);
    let arms = [(bus, ArmKinematics::new(skin, bus, settings.gravity))];
    let row = usize::from(skin.chain(bus).row_of(estimate.joint).unwrap_or_default());
    let supposed = [ProbeCell { bus, row, model: estimate.model.clone() }];
    let Some(known) = estimate.covariance.try_inverse() else { return MotionAdvice::Nothing };
    let before = worst_uncertainty(&known);
    let mut best = (HELPFUL_UNCERTAINTY_RATIO, MotionAdvice::Nothing);
    for pose in candidate_poses(skin, &settings.bounds, &swings).iter().step_by(3) {
        let steps = core::iter::once(MotionStep::Hold { at: pose.clone() }).chain(swings.swings_about(pose));
        for step in steps {
            let informed = step_information(skin, &arms, &supposed, &step, SWING_DURATION_S, &settings.sheet);
            // As many repetitions as fit into a plan.
            let more = informed.first().copied().unwrap_or_else(InformationMatrix::zeros)
                * (settings.bounds.length_s / SWING_DURATION_S);
            let left = worst_uncertainty(&(known + more)) / before;
            if left >= best.0 {
                continue;
            }
            best = match &step {
                MotionStep::Swing { amplitude, .. } => {
                    let joints = skin.robot.joints.iter().zip(amplitude);
                    let swung = joints.max_by(|(_, one), (_, other)| one.total_cmp(other));
                    (
                        left,
                        MotionAdvice::Swing {
                            joint: swung.map_or_else(String::new, |(joint, _)| joint.name.clone()),
                        },
                    )
                }
                MotionStep::Hold { .. } | MotionStep::Move { .. } => (left, MotionAdvice::Poses),
            };
        }
    }
    best.1
}

/// Returns the standard deviation of a pose in its least certain direction, relative to [`TARGET_DEVIATIONS`].
fn worst_uncertainty(information: &InformationMatrix) -> f64 {
    let Some(covariance) = Cholesky::new(*information).map(|it| it.inverse()) else { return f64::INFINITY };
    let part = |start: usize, aim: f64| {
        let part: Matrix3<f64> = covariance.fixed_view::<3, 3>(start, start).into_owned();
        part.symmetric_eigenvalues().max().max(0.0).sqrt() / aim
    };
    part(POSITION_UNKNOWNS.start, TARGET_DEVIATIONS[0])
        .max(part(ROTATION_UNKNOWNS.start, TARGET_DEVIATIONS[1]))
}
