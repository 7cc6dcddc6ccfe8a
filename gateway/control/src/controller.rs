//! Controllers, which turn torques into motion, once per tick.
//!
//! ```text
//!   ControllerInput { q, qdot, torque, age, valid, .. } ─> Controller::step ─┬─> Move(joint velocities)
//!                                                                            └─> Bad(reason)
//! ```
//!
//! [`KinestheticController`] moves the arm with the torque of a push. [`PlannedController`] follows a motion that is
//! known in advance and ignores torques. [`crate::external::ExternalController`] asks another program for each command.

use protocol::packet::pad_with_defaults;
use protocol::skin::{ControllerKind, MAX_ROBOT_JOINTS, Skin};
use protocol::time::Micros;
use thiserror::Error;

use crate::external::ControllerAbsence;

/// Input of a controller in one tick. The values of joints that the robot does not have are zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ControllerInput {
    /// Number of the tick.
    pub tick: u64,
    /// Nominal start of the tick since the start of the run.
    pub time: Micros,
    /// Joint positions in rad, or in m for prismatic joints.
    pub q: [f64; MAX_ROBOT_JOINTS],
    /// Joint velocities in rad/s, or in m/s for prismatic joints.
    pub qdot: [f64; MAX_ROBOT_JOINTS],
    /// Torque of the skin in each joint in Nm, or force in N for prismatic joints.
    pub torque: [f64; MAX_ROBOT_JOINTS],
    /// Number of epochs that the oldest contribution to the torque has missed.
    pub age: u32,
    /// Number of cells that contribute to the torque.
    pub contributing: u32,
    /// True if the controller may use the torque.
    pub valid: bool,
    /// Mask of lost buses, whose cells are missing from the torque or whose torques decay: bit n is bus n of the skin;
    /// bit 31 stands for all buses from the 32nd on.
    pub missing: u32,
    /// True if the robot is halted. Commands of a controller then have no effect.
    pub halted: bool,
}

/// Answer of a controller.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "one at a time, on the stack: the loop allocates nothing")]
pub enum ControllerOutput {
    /// Joint velocities in rad/s until the next tick. They are finite and within the speed limits.
    Move([f64; MAX_ROBOT_JOINTS]),
    /// A bad cycle: the controller has no command. The caller decides how the robot then moves.
    Bad(BadCycle),
}

/// Reason of a bad cycle.
#[derive(Clone, Copy, Debug, Eq, Error, Hash, Ord, PartialEq, PartialOrd)]
pub enum BadCycle {
    /// The torque is invalid, or is not a number.
    #[error("the torque is not valid")]
    Torque,
    /// The external controller has not sent a hello yet, or has ended.
    #[error("no external controller is connected")]
    NoPeer,
    /// The external controller has not answered the last tick in time.
    #[error("the external controller's answer is missing")]
    NoAnswer,
    /// The external controller sent an invalid datagram.
    #[error("the external controller sent nonsense")]
    Nonsense,
}

/// A controller, which turns torques into joint velocities.
pub trait Controller: Send {
    /// Computes the command of one tick. Must not block, allocate, lock or log.
    fn step(&mut self, input: &ControllerInput) -> ControllerOutput;

    /// Returns the controller's counters, each with its name. To be called at the end of a run, not in a tick.
    fn named_counters(&self) -> Vec<(String, u64)> {
        Vec::new()
    }

    /// Returns the reason for which the controller counts as absent at the end of a run; `None` if it does not.
    /// `silent` is the number of consecutive bad cycles at the end, if these are enough to halt a robot. To be called
    /// at the end of a run, not in a tick. A controller within this program is never absent.
    fn absence(&self, silent: Option<u32>) -> Option<ControllerAbsence> {
        let _ = silent;
        None
    }
}

/// Admittance control of each joint by `M q'' + D q' = tau`.
///
/// The controller stores no state. It starts each tick from the velocity that the robot reports, so that a joint at its
/// limit, or a halted robot, starts from rest.
///
/// The equation is integrated exactly for a torque that is constant over the tick, which is stable for any M, D and
/// tick: `v' = tau/D + (v - tau/D) e^(-D/M T)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KinestheticController {
    joints: [JointAdmittance; MAX_ROBOT_JOINTS],
}

/// Constants of the admittance of one joint.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct JointAdmittance {
    /// Mobility 1/D in rad/s per Nm.
    mobility: f64,
    /// Fraction of the velocity that remains after one tick without torque: `e^(-D/M T)`.
    remaining: f64,
    max_speed: f64,
}

impl KinestheticController {
    /// Creates the controller of the skin; `None` if the skin has a controller of another kind.
    #[must_use]
    pub fn new(skin: &Skin) -> Option<Self> {
        match &skin.controller.kind {
            ControllerKind::Kinesthetic { inertia, damping } => {
                Some(Self::from_parameters(skin, inertia, damping))
            }
            ControllerKind::External { .. } => None,
        }
    }

    pub(crate) fn from_parameters(skin: &Skin, inertia: &[f64], damping: &[f64]) -> Self {
        let tick = 1.0 / skin.timing.control_hz;
        let mut joints = [JointAdmittance::default(); MAX_ROBOT_JOINTS];
        let given = inertia.iter().zip(damping).zip(&skin.controller.max_speed);
        for (joint, ((inertia, damping), &max_speed)) in joints.iter_mut().zip(given) {
            *joint = JointAdmittance {
                mobility: damping.recip(),
                remaining: (-damping / inertia * tick).exp(),
                max_speed,
            };
        }
        Self { joints }
    }
}

impl Controller for KinestheticController {
    fn step(&mut self, input: &ControllerInput) -> ControllerOutput {
        if input.halted {
            return ControllerOutput::Move([0.0; MAX_ROBOT_JOINTS]);
        }
        if !input.valid || !input.torque.iter().chain(&input.qdot).all(|value| value.is_finite()) {
            return ControllerOutput::Bad(BadCycle::Torque);
        }
        let mut velocity = input.qdot;
        for ((velocity, torque), joint) in velocity.iter_mut().zip(input.torque).zip(&self.joints) {
            // Keep the value finite: the difference of two infinities below is not a number.
            let settled = (torque * joint.mobility).clamp(f64::MIN, f64::MAX);
            let next = settled + (*velocity - settled) * joint.remaining;
            *velocity = next.clamp(-joint.max_speed, joint.max_speed);
        }
        ControllerOutput::Move(velocity)
    }
}

/// A controller that follows positions known for all times, as fast as the speed limits allow.
#[derive(Clone, Copy, Debug)]
pub struct PlannedController<F> {
    at: F,
    pace: SpeedLimits,
}

impl<F: Fn(f64) -> [f64; MAX_ROBOT_JOINTS]> PlannedController<F> {
    /// Creates a controller that follows the positions `at(t)` in rad or m, where t is the time in s since the start of
    /// the run. `at` must not block, allocate, lock or log.
    #[must_use]
    pub fn new(skin: &Skin, at: F) -> Self {
        Self { at, pace: SpeedLimits::from_skin(skin) }
    }
}

impl<F: Fn(f64) -> [f64; MAX_ROBOT_JOINTS] + Send> Controller for PlannedController<F> {
    /// Computes the velocities that reach the position planned for the start of the next tick, so that the robot
    /// neither lags nor drifts.
    fn step(&mut self, input: &ControllerInput) -> ControllerOutput {
        let next = (self.at)(seconds(input.time) + self.pace.tick);
        ControllerOutput::Move(self.pace.velocities_towards(&next, input))
    }
}

/// The speed limits of the joints and the duration of a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SpeedLimits {
    /// Duration of a tick in s.
    tick: f64,
    max_speed: [f64; MAX_ROBOT_JOINTS],
}

impl SpeedLimits {
    pub(crate) fn from_skin(skin: &Skin) -> Self {
        Self { tick: 1.0 / skin.timing.control_hz, max_speed: pad_with_defaults(&skin.controller.max_speed) }
    }

    /// Returns the joint velocities that bring the robot to `goal` by the next tick, as far as the speed limits allow;
    /// zero while the robot is halted.
    pub(crate) fn velocities_towards(
        &self,
        goal: &[f64; MAX_ROBOT_JOINTS],
        input: &ControllerInput,
    ) -> [f64; MAX_ROBOT_JOINTS] {
        let mut velocity = *goal;
        for (velocity, q) in velocity.iter_mut().zip(input.q) {
            *velocity = (*velocity - q) / self.tick;
        }
        self.limit_velocities(velocity, input)
    }

    /// Returns the velocities clamped to the speed limits; zero while the robot is halted.
    pub(crate) fn limit_velocities(
        &self,
        mut velocity: [f64; MAX_ROBOT_JOINTS],
        input: &ControllerInput,
    ) -> [f64; MAX_ROBOT_JOINTS] {
        for (velocity, max_speed) in velocity.iter_mut().zip(self.max_speed) {
            *velocity = if input.halted { 0.0 } else { velocity.clamp(-max_speed, max_speed) };
        }
        velocity
    }
}

#[expect(clippy::cast_precision_loss, reason = "2^53 us are 285 years")]
fn seconds(time: Micros) -> f64 {
    time.0 as f64 * 1e-6
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "what does not move is exactly where it was")]
mod tests {
    use super::*;
    use crate::robot::{Robot, SimulatedArm};
    use model::testing::one_cell_skin;
    use proptest::prelude::*;

    const TICK: f64 = 0.002;

    fn kinesthetic() -> KinestheticController {
        KinestheticController::new(&one_cell_skin()).unwrap()
    }

    fn moved(step: ControllerOutput) -> [f64; MAX_ROBOT_JOINTS] {
        match step {
            ControllerOutput::Move(velocity) => velocity,
            ControllerOutput::Bad(why) => panic!("{why}"),
        }
    }

    fn pushed(torque: [f64; MAX_ROBOT_JOINTS]) -> ControllerInput {
        ControllerInput { torque, valid: true, ..ControllerInput::default() }
    }

    /// Runs the controller on a simulated arm for `ticks` ticks with a constant torque. Returns the arm.
    fn run(controller: &mut impl Controller, start: [f64; 6], ticks: u64, torque: [f64; 6]) -> SimulatedArm {
        let mut arm = SimulatedArm::new(&one_cell_skin(), pad_with_defaults(&start));
        for tick in 0..ticks {
            let (q, qdot) = (arm.positions(), arm.velocities());
            let input = ControllerInput {
                tick,
                time: Micros(tick * 2_000),
                q,
                qdot,
                ..pushed(pad_with_defaults(&torque))
            };
            arm.step(&moved(controller.step(&input)), TICK);
        }
        arm
    }

    #[test]
    fn a_constant_torque_gives_the_exact_velocity() {
        let mut controller = kinesthetic();
        let arm = run(&mut controller, [0.0; 6], 250, [2.0, -1.0, 0.0, 0.0, 0.0, 0.0]);
        // M = 1, D = 4, so after half a second v = tau/D (1 - e^-2).
        let target = 0.5 * (1.0 - (-2.0_f64).exp());
        let [v1, v2, v3, ..] = arm.velocities();
        assert!((v1 - target).abs() < 1e-12 && (v2 + target / 2.0).abs() < 1e-12 && v3.abs() < 1e-12);
        // The position sums the velocities at the ends of the ticks: at most one tick ahead.
        let exact = 0.5 * (0.5 - 0.25 * (1.0 - (-2.0_f64).exp()));
        assert!((arm.positions()[0] - exact).abs() < target * TICK);
    }

    #[test]
    fn without_torque_the_arm_comes_to_rest() {
        let mut controller = kinesthetic();
        let input =
            ControllerInput { qdot: pad_with_defaults(&[1.0; 6]), ..pushed(pad_with_defaults(&[0.0; 6])) };
        for velocity in moved(controller.step(&input)).into_iter().take(6) {
            assert!(velocity > 0.99 && velocity < 1.0);
        }
    }

    #[test]
    fn a_torque_that_must_not_be_used_is_a_bad_cycle() {
        let mut controller = kinesthetic();
        assert_eq!(controller.step(&ControllerInput::default()), ControllerOutput::Bad(BadCycle::Torque));
        assert_eq!(
            controller.step(&pushed(pad_with_defaults(&[f64::NAN; 6]))),
            ControllerOutput::Bad(BadCycle::Torque)
        );
        let halted = ControllerInput {
            halted: true,
            qdot: pad_with_defaults(&[1.0; 6]),
            ..pushed(pad_with_defaults(&[5.0; 6]))
        };
        assert_eq!(controller.step(&halted), ControllerOutput::Move(pad_with_defaults(&[0.0; 6])));
    }

    #[test]
    fn a_robot_that_holds_returns_no_quicker_than_it_may() {
        let at = [0.1, -0.2, 0.3, 0.0, 0.0, 0.0];
        let mut hold = PlannedController::new(&one_cell_skin(), |_| pad_with_defaults(&at));
        assert_eq!(
            moved(hold.step(&ControllerInput { q: pad_with_defaults(&at), ..ControllerInput::default() })),
            [0.0; MAX_ROBOT_JOINTS]
        );
        assert_eq!(moved(hold.step(&ControllerInput::default()))[..3], [2.0, -2.0, 2.0]);
        let arm = run(&mut hold, [0.0; 6], 200, [50.0; 6]);
        for (got, target) in arm.positions().iter().zip(at) {
            assert!((got - target).abs() < 1e-12, "torques do not move it");
        }
    }

    #[test]
    fn a_planned_motion_is_where_it_should_be_at_every_tick() {
        let start = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0];
        let swings =
            |seconds: f64| pad_with_defaults(&start.map(|start| start + 0.2 * (1.5 * seconds).sin()));
        let mut planned = PlannedController::new(&one_cell_skin(), swings);
        for ticks in [1_u32, 7, 500, 4_321] {
            let arm = run(&mut planned, start, ticks.into(), [0.0; 6]);
            let target = swings(f64::from(ticks) * TICK);
            for (got, target) in arm.positions().iter().zip(target) {
                assert!((got - target).abs() < 1e-9, "after {ticks} ticks {got} is not {target}");
            }
        }
    }

    proptest! {
        #[test]
        fn no_torque_makes_it_quicker_than_it_may_or_unstable(
            torque in any::<[f64; 6]>(), qdot in proptest::array::uniform6(-5.0..5.0),
        ) {
            let mut controller = kinesthetic();
            let input = ControllerInput { qdot: pad_with_defaults(&qdot), ..pushed(pad_with_defaults(&torque)) };
            match controller.step(&input) {
                ControllerOutput::Bad(why) => {
                    prop_assert_eq!(why, BadCycle::Torque);
                    prop_assert!(torque.iter().any(|torque| !torque.is_finite()));
                }
                ControllerOutput::Move(velocity) => {
                    for (velocity, limit) in velocity.iter().zip([2.0, 2.0, 2.0, 3.0, 3.0, 3.0]) {
                        prop_assert!(velocity.abs() <= limit, "{}", velocity);
                    }
                }
            }
        }
    }
}
