//! Robots that follow joint velocities, and a simulated one.

use protocol::skin::{MAX_ROBOT_JOINTS, Skin};

/// A robot that follows joint velocities. Array elements of joints that it does not have are zero.
pub trait Robot {
    /// Moves the joints for `seconds` with these velocities in rad/s or m/s. The loop calls this once per tick, so it
    /// must not block, allocate, lock or log.
    fn step(&mut self, velocity: &[f64; MAX_ROBOT_JOINTS], seconds: f64) -> StepResult;

    /// Returns the joint positions in rad or m. Full turns are counted, so a position may exceed half a turn.
    fn positions(&self) -> [f64; MAX_ROBOT_JOINTS];

    /// Returns the joint velocities in rad/s or m/s.
    fn velocities(&self) -> [f64; MAX_ROBOT_JOINTS];
}

/// The result of a step of a robot.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct StepResult {
    /// Mask of the joints that stand at a limit and were commanded beyond it: bit 0 is joint 1.
    pub at_limit: u32,
    /// True if a velocity was not finite and was replaced by zero.
    pub refused: bool,
}

/// A simulated arm whose positions follow the commanded velocities exactly, up to the limits of its joints.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimulatedArm {
    positions: [f64; MAX_ROBOT_JOINTS],
    velocities: [f64; MAX_ROBOT_JOINTS],
    limits: [[f64; 2]; MAX_ROBOT_JOINTS],
}

impl SimulatedArm {
    /// Creates the robot of the skin, at rest at the positions `start` in rad or m, clamped to the joint limits.
    #[must_use]
    pub fn new(skin: &Skin, start: [f64; MAX_ROBOT_JOINTS]) -> Self {
        let mut limits = [[0.0; 2]; MAX_ROBOT_JOINTS];
        for (limits, joint) in limits.iter_mut().zip(&skin.robot.joints) {
            *limits = joint.limits;
        }
        let mut arm = Self { positions: start, velocities: [0.0; MAX_ROBOT_JOINTS], limits };
        for (position, [min, max]) in arm.positions.iter_mut().zip(arm.limits) {
            *position = position.clamp(min, max);
        }
        arm
    }
}

impl Robot for SimulatedArm {
    fn step(&mut self, velocity: &[f64; MAX_ROBOT_JOINTS], seconds: f64) -> StepResult {
        let mut moved = StepResult::default();
        let joints = self.positions.iter_mut().zip(&mut self.velocities).zip(&self.limits);
        for (joint, (((position, velocity), &[min, max]), &target)) in joints.zip(velocity).enumerate() {
            let finite = target.is_finite();
            moved.refused |= !finite;
            *velocity = if finite { target } else { 0.0 };
            let goal = *position + *velocity * seconds;
            *position = goal.clamp(min, max);
            if goal < min || goal > max {
                *velocity = 0.0;
                moved.at_limit |= 1 << joint;
            }
        }
        moved
    }

    fn positions(&self) -> [f64; MAX_ROBOT_JOINTS] {
        self.positions
    }

    fn velocities(&self) -> [f64; MAX_ROBOT_JOINTS] {
        self.velocities
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "what is held at a limit is exactly there")]
mod tests {
    use super::*;
    use model::testing::one_cell_skin;
    use proptest::prelude::*;
    use protocol::packet::pad_with_defaults;

    #[test]
    fn positions_follow_velocities_beyond_half_a_turn() {
        let mut arm = SimulatedArm::new(&one_cell_skin(), pad_with_defaults(&[0.5; 6]));
        for _ in 0..2_000 {
            assert_eq!(
                arm.step(&pad_with_defaults(&[1.0, -1.0, 0.0, 0.0, 0.0, 0.0]), 0.002),
                StepResult::default()
            );
        }
        let [q1, q2, q3, ..] = arm.positions();
        assert!((q1 - 4.5).abs() < 1e-9 && (q2 + 3.5).abs() < 1e-9 && q3 == 0.5);
        assert_eq!(arm.velocities()[..2], [1.0, -1.0]);
    }

    #[test]
    fn the_arm_stops_at_a_limit_reports_it_and_comes_back() {
        let mut skin = one_cell_skin();
        skin.robot.joints[2].limits = [-1.0, 0.5];
        let mut arm = SimulatedArm::new(&skin, pad_with_defaults(&[0.0, 0.0, 0.499, 0.0, 0.0, 0.0]));
        let moved = arm.step(&pad_with_defaults(&[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), 0.002);
        assert_eq!(moved, StepResult { at_limit: 0b100, refused: false });
        assert_eq!((arm.positions()[2], arm.velocities()[2]), (0.5, 0.0));
        assert_eq!(
            arm.step(&pad_with_defaults(&[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]), 0.002),
            StepResult::default()
        );
        assert!(arm.positions()[2] < 0.5);
    }

    #[test]
    fn a_velocity_that_is_no_number_moves_nothing() {
        let mut arm = SimulatedArm::new(&one_cell_skin(), pad_with_defaults(&[0.25; 6]));
        assert!(arm.step(&pad_with_defaults(&[f64::NAN, f64::INFINITY, 0.0, 0.0, 0.0, 0.0]), 0.002).refused);
        assert_eq!(arm.positions()[..6], [0.25; 6]);
    }

    proptest! {
        #[test]
        fn no_joint_ever_leaves_its_limits(steps in proptest::collection::vec(any::<[f64; 6]>(), 1..50)) {
            let skin = one_cell_skin();
            let mut arm = SimulatedArm::new(&skin, pad_with_defaults(&[0.0; 6]));
            for step in steps {
                arm.step(&pad_with_defaults(&step), 0.002);
                for (position, joint) in arm.positions().iter().zip(&skin.robot.joints) {
                    let [min, max] = &joint.limits;
                    prop_assert!(min <= position && position <= max);
                }
            }
        }
    }
}
