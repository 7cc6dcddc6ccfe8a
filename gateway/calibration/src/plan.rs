//! The planner: finds the motion that adds most information on the places of cells, within limits and a time.
//!
//! The candidates are poses within the limits, and swings about them. The planner repeatedly chooses the candidate that
//! adds most information per time (Fisher's information of the estimate) on assumed cells on each link. Static poses
//! determine orientation, bias and gain; swings determine positions.

use core::f64::consts::TAU;

use nalgebra::{Cholesky, Matrix3, UnitQuaternion, Vector3};
use protocol::parameters::RowKind;
use protocol::skin::{JointKind, Skin};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use thiserror::Error;

use crate::cell::{
    CellModel, InformationMatrix, MODEL_INPUT_COUNT, POSITION_UNKNOWNS, READING_AGE_STEP_S,
    ROTATION_UNKNOWNS, motion_numbers, prior_inverse_variances,
};
use crate::motion::{MotionPlan, MotionStep, RISING_CURVE_PEAKS};
use crate::sums::ReadingSums;
use model::accelerometer::kinematics::{ArmKinematics, STANDARD_GRAVITY};
use model::accelerometer::sensor::DataSheet;

/// The limits of a plan.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanBounds {
    /// The pose about which the robot moves, by joint in rad or m; the motion begins and ends at this pose.
    pub center: Vec<f64>,
    /// The maximum distance of each joint from the center, in rad or m.
    pub within: f64,
    /// The maximum duration in s.
    pub length_s: f64,
    /// The maximum speed, as a fraction of the joints' maximum speeds.
    pub speed: f64,
    /// The maximum acceleration of a joint, in rad/s² or m/s².
    pub acceleration: f64,
    /// The maximum acceleration that one swinging joint may cause at any point of the robot, in g.
    pub force_g: f64,
    /// The seed of the random poses.
    pub seed: u64,
}

/// The error for a plan that cannot be made.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum PlanError {
    /// The center has too few or too many joints.
    #[error(
        "the pose has {got} positions, but the robot has {joints} joints: give one position for each joint"
    )]
    Joints {
        /// The number of positions.
        got: usize,
        /// The number of joints.
        joints: usize,
    },
    /// A joint is outside its limits.
    #[error("joint {name} cannot be at {got}: its limits are {min} to {max}; choose a position between them")]
    Limits {
        /// The joint.
        name: String,
        /// The position of the joint.
        got: f64,
        /// The lower limit of the joint.
        min: f64,
        /// The upper limit of the joint.
        max: f64,
    },
    /// The duration is too short or too long.
    #[error("the motion cannot last {got} s: choose 20 to 3600 s")]
    Length {
        /// The duration in s.
        got: f64,
    },
}

const CANDIDATE_POSES: usize = 24;
/// The time that the robot stands at a pose, in s.
const POSE_HOLD_S: f64 = 0.6;
pub(crate) const SWING_DURATION_S: f64 = 3.2;
/// The assumed duration of a move to another pose, in s.
const ASSUMED_MOVE_DURATION_S: f64 = 1.6;
/// The frequency of a joint that swings alone.
const SINGLE_SWING_HZ: f64 = 1.1;
/// The frequencies of joints that swing together; they differ, so that the joints can be separated.
const JOINT_SWING_HZ: [f64; 7] = [0.8, 1.3, 1.0, 1.5, 0.9, 1.2, 1.4];
/// The interval between the moments at which a candidate's information is computed, in s.
const SAMPLE_INTERVAL_S: f64 = 1.0 / 15.0;
/// The standard deviations at which an estimate counts as good: of the position in m, and of the orientation in rad.
pub(crate) const TARGET_DEVIATIONS: [f64; 2] = [0.5e-3, 0.2 * TAU / 360.0];

impl PlanBounds {
    /// Returns limits about the middle of each joint's range, or about 0 if it turns by more than half a turn each way.
    #[must_use]
    pub fn from_skin(skin: &Skin) -> Self {
        let middle = |[min, max]: [f64; 2], kind: JointKind| {
            let wide = kind == JointKind::Revolute && max - min > 0.99 * TAU;
            if wide { 0.0_f64.clamp(min, max) } else { f64::midpoint(min, max) }
        };
        let joints = skin.robot.joints.iter();
        Self {
            center: joints.map(|joint| middle(joint.limits, joint.kind)).collect(),
            within: 1.0,
            length_s: 150.0,
            speed: 0.8,
            acceleration: 8.0,
            force_g: 0.7,
            seed: 1,
        }
    }

    fn check(&self, skin: &Skin) -> Result<(), PlanError> {
        let (got, joints) = (self.center.len(), skin.robot.joints.len());
        if got != joints {
            return Err(PlanError::Joints { got, joints });
        }
        for (joint, &got) in skin.robot.joints.iter().zip(&self.center) {
            let [min, max] = joint.limits;
            if !(min..=max).contains(&got) {
                return Err(PlanError::Limits { name: joint.name.clone(), got, min, max });
            }
        }
        if (20.0..=3600.0).contains(&self.length_s) {
            Ok(())
        } else {
            Err(PlanError::Length { got: self.length_s })
        }
    }
}

/// A candidate step: a hold at a pose, or a swing about it.
struct CandidateStep {
    pose: usize,
    step: MotionStep,
    seconds: f64,
    /// The information that the step adds on each assumed cell.
    information: Vec<InformationMatrix>,
}

/// A cell that the planner assumes at some place of a link, to rate candidates by it.
pub(crate) struct ProbeCell {
    pub(crate) bus: usize,
    pub(crate) row: usize,
    pub(crate) model: CellModel,
}

/// Plans the motion that adds most information on the places of cells within the bounds.
///
/// # Errors
/// Returns [`PlanError`] if the bounds do not fit the robot.
pub fn plan_motion(
    skin: &Skin,
    bounds: &PlanBounds,
    sheet: &DataSheet,
    gravity: [f64; 3],
) -> Result<MotionPlan, PlanError> {
    bounds.check(skin)?;
    let swings = SwingAmplitudes::new(skin, bounds);
    let poses = candidate_poses(skin, bounds, &swings);
    let buses = (0..skin.buses.len()).filter(|&bus| skin.cells_on_bus(bus).next().is_some());
    let arms: Vec<_> = buses.map(|bus| (bus, ArmKinematics::new(skin, bus, gravity))).collect();
    let supposed = probe_cells(skin, &arms);
    let mut candidates = Vec::new();
    for (pose, at) in poses.iter().enumerate() {
        let hold = (POSE_HOLD_S, MotionStep::Hold { at: at.clone() });
        for (seconds, step) in
            core::iter::once(hold).chain(swings.swings_about(at).map(|step| (SWING_DURATION_S, step)))
        {
            let information = step_information(skin, &arms, &supposed, &step, seconds, sheet);
            candidates.push(CandidateStep { pose, step, seconds, information });
        }
    }
    let chosen = choose_candidates(&candidates, &supposed, bounds, sheet);
    Ok(order_steps(skin, bounds, &poses, &candidates, &chosen))
}

/// The amplitudes with which joints may swing.
pub(crate) struct SwingAmplitudes {
    amplitudes: Vec<f64>,
}

impl SwingAmplitudes {
    pub(crate) fn new(skin: &Skin, bounds: &PlanBounds) -> Self {
        let rate = TAU * SINGLE_SWING_HZ;
        let joints = skin.robot.joints.iter().zip(&skin.controller.max_speed).enumerate();
        let amplitudes = joints.map(|(index, (joint, max_speed))| {
            let reach = reach_m(skin, index);
            let [min, max] = joint.limits;
            let force = bounds.force_g * STANDARD_GRAVITY
                / if joint.kind == JointKind::Revolute { reach } else { 1.0 };
            let speed = bounds.speed * max_speed / rate;
            let acceleration = bounds.acceleration.min(force) / (rate * rate);
            speed.min(acceleration).min(bounds.within / 2.0).min((max - min) / 4.0)
        });
        Self { amplitudes: amplitudes.collect() }
    }

    /// Returns swings about a pose: of each joint alone, and of all joints together.
    pub(crate) fn swings_about<'a>(&'a self, pose: &'a [f64]) -> impl Iterator<Item = MotionStep> + 'a {
        let joints = self.amplitudes.len();
        let swing = |amplitude: Vec<f64>, rate_hz: Vec<f64>| MotionStep::Swing {
            about: pose.to_vec(),
            amplitude,
            rate_hz,
        };
        let alone = (0..joints).map(move |joint| {
            let own = |(at, amplitude): (usize, &f64)| if at == joint { *amplitude } else { 0.0 };
            swing(self.amplitudes.iter().enumerate().map(own).collect(), vec![SINGLE_SWING_HZ; joints])
        });
        let rates: Vec<_> = JOINT_SWING_HZ.iter().cycle().take(joints).copied().collect();
        let share =
            |(amplitude, rate): (&f64, &f64)| amplitude * 0.4 * (SINGLE_SWING_HZ / rate).powi(2).min(1.0);
        let together = swing(self.amplitudes.iter().zip(&rates).map(share).collect(), rates);
        alone.chain(core::iter::once(together))
    }
}

/// Returns the total length of the links behind a joint, in m and at least 0.1: no point of the robot is farther from
/// the joint's axis.
fn reach_m(skin: &Skin, joint: usize) -> f64 {
    let of_chain = |chain: &protocol::skin::Chain| {
        let at = chain.joints.iter().position(|&it| it == joint)?;
        let row = chain.row_of(u8::try_from(at + 1).ok()?)?;
        let rows = chain.rows.get(usize::from(row).saturating_sub(1)..)?;
        Some(rows.iter().map(|row| row.table.a.hypot(row.table.d)).sum::<f64>())
    };
    skin.robot.chains.iter().filter_map(of_chain).fold(0.1, f64::max)
}

/// Returns the center and random poses, all of which leave room for every swing within the limits.
pub(crate) fn candidate_poses(skin: &Skin, bounds: &PlanBounds, swings: &SwingAmplitudes) -> Vec<Vec<f64>> {
    let mut dice = Pcg64Mcg::seed_from_u64(bounds.seed);
    let ranges = skin.robot.joints.iter().zip(&bounds.center).zip(&swings.amplitudes);
    let ranges: Vec<_> = ranges
        .map(|((joint, center), amplitude)| {
            let [min, max] = joint.limits;
            let (low, high) = (
                (center - bounds.within).max(min) + amplitude,
                (center + bounds.within).min(max) - amplitude,
            );
            (low.min(high), high.max(low))
        })
        .collect();
    let center = bounds.center.iter().zip(&ranges).map(|(at, (low, high))| at.clamp(*low, *high)).collect();
    let mut drawn = || ranges.iter().map(|(low, high)| low + (high - low) * dice.random::<f64>()).collect();
    let mut poses = vec![center];
    poses.extend((1..CANDIDATE_POSES).map(|_| drawn()));
    poses
}

/// Returns assumed cells on each link: near its joint, in its middle, and at its end.
fn probe_cells(skin: &Skin, arms: &[(usize, ArmKinematics)]) -> Vec<ProbeCell> {
    let mut all = Vec::new();
    for &(bus, _) in arms {
        let chain = skin.chain(bus);
        for joint in 1..=u8::try_from(chain.joints.len()).unwrap_or_default() {
            let row = usize::from(chain.row_of(joint).unwrap_or_default());
            let Some(table) = chain.rows.get(row.saturating_sub(1)) else { continue };
            let length = if table.kind == RowKind::Revolute { table.table.a } else { 0.0 };
            for (share, turn) in [(0.2, 0.5), (0.8, 2.1)] {
                let position = Vector3::new(-length * share, 0.06, 0.04 * share);
                let rotation = UnitQuaternion::from_euler_angles(turn, 0.3 * turn, 0.7 - turn);
                all.push(ProbeCell { bus, row, model: CellModel::with_ideal_sensor(rotation, position) });
            }
        }
    }
    all
}

/// Returns the information that a step adds on each assumed cell.
pub(crate) fn step_information(
    skin: &Skin,
    arms: &[(usize, ArmKinematics)],
    supposed: &[ProbeCell],
    step: &MotionStep,
    seconds: f64,
    sheet: &DataSheet,
) -> Vec<InformationMatrix> {
    let mut motion = MotionPlan::default();
    motion.push_step(seconds, step.clone());
    let mut sums: Vec<Option<ReadingSums>> = vec![None; supposed.len()];
    let (mut time, look) = (SAMPLE_INTERVAL_S / 2.0, skin.timing.broadcast_hz() * SAMPLE_INTERVAL_S);
    while time < seconds {
        for (bus, arm) in arms {
            let joints = &skin.chain(*bus).joints;
            let ages = [-READING_AGE_STEP_S, 0.0, READING_AGE_STEP_S];
            let motions =
                ages.map(|age| arm.row_motions(&motion.state_at((time - age).max(0.0)).chain_state(joints)));
            // The cells of one link see the same motion: they share the sums of the first one.
            let mut seen = usize::MAX;
            for (one, sum) in supposed.iter().zip(&mut sums) {
                if one.bus != *bus || one.row == seen {
                    continue;
                }
                seen = one.row;
                let mut moment = [1.0; MODEL_INPUT_COUNT];
                let all =
                    motions.iter().flat_map(|rows| rows.get(one.row).map(motion_numbers).unwrap_or_default());
                moment.iter_mut().zip(all).for_each(|(to, from)| *to = from);
                sum.get_or_insert_with(ReadingSums::default).add_reading(&moment, &[0.0; 3], look);
            }
        }
        time += SAMPLE_INTERVAL_S;
    }
    let variance = sheet.reading_deviation().powi(2) + 0.003_f64.powi(2);
    let mut last = None;
    let each = supposed.iter().zip(&sums).map(|(one, sum)| {
        last = sum.as_ref().or(last);
        last.map_or_else(InformationMatrix::zeros, |sum| {
            sum.information_and_gradient(&one.model).0 / variance
        })
    });
    each.collect()
}

/// Returns the chosen candidates, in the order in which they were chosen.
fn choose_candidates(
    candidates: &[CandidateStep],
    supposed: &[ProbeCell],
    bounds: &PlanBounds,
    sheet: &DataSheet,
) -> Vec<usize> {
    let prior = InformationMatrix::from_diagonal(&prior_inverse_variances(sheet));
    let mut known = vec![prior; supposed.len()];
    let mut scores: Vec<_> = known.iter().map(uncertainty_score).collect();
    let mut chosen: Vec<usize> = Vec::new();
    // The moves from the center and back.
    let mut left = bounds.length_s - 2.0 * ASSUMED_MOVE_DURATION_S;
    loop {
        let visited =
            |pose: usize| chosen.iter().any(|&it| candidates.get(it).is_some_and(|it| it.pose == pose));
        let rate = |(index, candidate): (usize, &CandidateStep)| {
            let seconds = candidate.seconds
                + if visited(candidate.pose) { 0.0 } else { ASSUMED_MOVE_DURATION_S + POSE_HOLD_S };
            // Repeating a step adds the same information only.
            if seconds > left || chosen.contains(&index) {
                return None;
            }
            let each = known.iter().zip(&scores).zip(&candidate.information);
            let gained: f64 =
                each.map(|((known, before), more)| before - uncertainty_score(&(known + more))).sum();
            Some((gained / seconds, index, seconds))
        };
        let best =
            candidates.iter().enumerate().filter_map(rate).max_by(|one, other| one.0.total_cmp(&other.0));
        let Some((_, index, seconds)) = best else { return chosen };
        if let Some(candidate) = candidates.get(index) {
            for ((known, score_of), more) in known.iter_mut().zip(&mut scores).zip(&candidate.information) {
                *known += more;
                *score_of = uncertainty_score(known);
            }
        }
        chosen.push(index);
        left -= seconds;
    }
}

/// Returns a measure of the uncertainty that remains with this information: 0 for a cell that is known exactly.
fn uncertainty_score(information: &InformationMatrix) -> f64 {
    let Some(covariance) = Cholesky::new(*information).map(|it| it.inverse()) else { return 1e3 };
    let part = |start: usize, aim: f64| {
        let part: Matrix3<f64> = covariance.fixed_view::<3, 3>(start, start).into_owned();
        part.diagonal().iter().map(|variance| (variance / (aim * aim)).ln_1p()).sum::<f64>()
    };
    part(POSITION_UNKNOWNS.start, TARGET_DEVIATIONS[0]) + part(ROTATION_UNKNOWNS.start, TARGET_DEVIATIONS[1])
}

/// Returns the motion of the chosen steps, pose by pose; each next pose is the nearest one to the previous pose.
fn order_steps(
    skin: &Skin,
    bounds: &PlanBounds,
    poses: &[Vec<f64>],
    candidates: &[CandidateStep],
    chosen: &[usize],
) -> MotionPlan {
    let mut left: Vec<_> = (0..poses.len()).collect();
    left.retain(|pose| chosen.iter().any(|&it| candidates.get(it).is_some_and(|it| it.pose == *pose)));
    let mut motion = MotionPlan::default();
    let mut at = bounds.center.clone();
    motion.push_step(POSE_HOLD_S, MotionStep::Hold { at: at.clone() });
    let distance = |from: &[f64], pose: usize| {
        poses.get(pose).map_or(f64::INFINITY, |to| move_duration_s(skin, bounds, from, to))
    };
    while let Some((place, &pose)) = left
        .iter()
        .enumerate()
        .min_by(|(_, one), (_, other)| distance(&at, **one).total_cmp(&distance(&at, **other)))
    {
        left.remove(place);
        let Some(to) = poses.get(pose) else { continue };
        push_move(skin, bounds, &mut motion, &mut at, to);
        motion.push_step(POSE_HOLD_S, MotionStep::Hold { at: to.clone() });
        let swings = chosen.iter().filter_map(|&it| candidates.get(it)).filter(|it| it.pose == pose);
        for CandidateStep { step, seconds, .. } in swings {
            if matches!(step, MotionStep::Swing { .. }) {
                motion.push_step(*seconds, step.clone());
            }
        }
    }
    push_move(skin, bounds, &mut motion, &mut at, &bounds.center);
    motion.push_step(POSE_HOLD_S, MotionStep::Hold { at });
    motion
}

fn push_move(skin: &Skin, bounds: &PlanBounds, motion: &mut MotionPlan, at: &mut Vec<f64>, to: &[f64]) {
    let seconds = move_duration_s(skin, bounds, at, to);
    if seconds > 0.0 {
        motion.push_step(seconds, MotionStep::Move { from: at.clone(), to: to.to_vec() });
        *at = to.to_vec();
    }
}

fn move_duration_s(skin: &Skin, bounds: &PlanBounds, from: &[f64], to: &[f64]) -> f64 {
    let [speed_peak, acceleration_peak] = RISING_CURVE_PEAKS;
    let joints = from.iter().zip(to).zip(&skin.controller.max_speed);
    let longest = joints.map(|((from, to), max_speed)| {
        let way = (to - from).abs();
        let by_speed = speed_peak * way / (bounds.speed * max_speed);
        by_speed.max((acceleration_peak * way / bounds.acceleration.min(4.0)).sqrt())
    });
    longest.fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use model::testing;

    #[test]
    fn a_plan_stays_within_limits_speeds_and_its_time() {
        for skin in [testing::ur5_skin(), testing::panda_skin()] {
            let bounds = PlanBounds::from_skin(&skin);
            let motion =
                plan_motion(&skin, &bounds, &DataSheet::default(), [0.0, 0.0, -STANDARD_GRAVITY]).unwrap();
            assert!(motion.length_s() < 180.0 && motion.length_s() > 100.0, "{}", motion.length_s());
            let mut time = 0.0;
            while time < motion.length_s() {
                let state = motion.state_at(time);
                for (index, joint) in skin.robot.joints.iter().enumerate() {
                    let (position, speed) = (state.position[index], state.speed[index]);
                    assert!(position >= joint.limits[0] && position <= joint.limits[1], "{time}: {position}");
                    assert!((position - bounds.center[index]).abs() < bounds.within + 1e-9);
                    assert!(speed.abs() < 0.85 * skin.controller.max_speed[index], "{time}: {speed}");
                }
                time += 0.01;
            }
        }
    }

    #[test]
    fn a_pose_outside_of_limits_is_refused() {
        let skin = testing::panda_skin();
        let mut bounds = PlanBounds::from_skin(&skin);
        bounds.center[3] = 0.5;
        let error =
            plan_motion(&skin, &bounds, &DataSheet::default(), [0.0, 0.0, -STANDARD_GRAVITY]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "joint joint4 cannot be at 0.5: its limits are -3.0718 to -0.0698; choose a position between them"
        );
        bounds.center.pop();
        let error =
            plan_motion(&skin, &bounds, &DataSheet::default(), [0.0, 0.0, -STANDARD_GRAVITY]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the pose has 6 positions, but the robot has 7 joints: give one position for each joint"
        );
    }
}
