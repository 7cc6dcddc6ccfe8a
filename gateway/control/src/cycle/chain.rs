//! Chain of a bus among the joints of the robot.

use protocol::fixed::Q1_14;
use protocol::message::Joints;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{JointKind, MAX_ROBOT_JOINTS, Skin};

/// Joints of a chain, with their last broadcast words.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Chain {
    /// Index among the robot's joints, and kind, of each joint.
    joints: Vec<(usize, JointKind)>,
    /// Last broadcast words.
    said: Joints,
}

impl Chain {
    pub(super) fn new(skin: &Skin, bus: usize) -> Self {
        let joints: Vec<_> = skin.joints_on_bus(bus).map(|(index, joint)| (index, joint.kind)).collect();
        let in_use = u8::try_from(joints.len()).unwrap_or(u8::MAX);
        Self { joints, said: Joints { positions: [Q1_14::ZERO; MAX_JOINTS], in_use } }
    }

    /// The last broadcast words.
    pub(super) const fn broadcast_joints(&self) -> Joints {
        self.said
    }

    /// Converts the robot's positions to words. A position that is not a number keeps its last word; a robot refuses
    /// velocities that lead there anyway.
    pub(super) fn set_positions(&mut self, q: &[f64; MAX_ROBOT_JOINTS]) {
        for (word, &(joint, kind)) in self.said.positions.iter_mut().zip(&self.joints) {
            if let Some(said) = q.get(joint).and_then(|&q| kind.word(q)) {
                *word = said;
            }
        }
    }

    /// Positions of the chain's joints in rad or m.
    pub(super) fn positions(&self, q: &[f64; MAX_ROBOT_JOINTS]) -> [f64; MAX_JOINTS] {
        let mut positions = [0.0; MAX_JOINTS];
        for (position, (joint, _)) in positions.iter_mut().zip(&self.joints) {
            *position = q.get(*joint).copied().unwrap_or_default();
        }
        positions
    }

    /// Adds a fraction of the chain's torques to the robot's: a joint that chains share gets both.
    pub(super) fn add(&self, part: f64, torque: &[f64; MAX_JOINTS], sum: &mut [f64; MAX_ROBOT_JOINTS]) {
        for ((joint, _), torque) in self.joints.iter().zip(torque) {
            if let Some(sum) = sum.get_mut(*joint) {
                *sum += part * torque;
            }
        }
    }
}
