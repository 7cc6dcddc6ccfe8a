//! The chain of a bus, as a selection of the robot's joints.

use protocol::fixed::Q1_14;
use protocol::message::Joints;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{JointKind, MAX_ROBOT_JOINTS, Skin};

/// The joints of a chain, and the words of their last broadcast.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Chain {
    /// For each joint of the chain, its index among the robot's joints, and its kind.
    joints: Vec<(usize, JointKind)>,
    /// The words of the last broadcast.
    broadcast: Joints,
}

impl Chain {
    pub(super) fn new(skin: &Skin, bus: usize) -> Self {
        let joints: Vec<_> = skin.joints_on_bus(bus).map(|(index, joint)| (index, joint.kind)).collect();
        let in_use = u8::try_from(joints.len()).unwrap_or(u8::MAX);
        Self { joints, broadcast: Joints { positions: [Q1_14::ZERO; MAX_JOINTS], in_use } }
    }

    /// Returns the words of the last broadcast.
    pub(super) const fn broadcast_joints(&self) -> Joints {
        self.broadcast
    }

    /// Converts the robot's positions to the words of the next broadcast. A joint whose position is not a number keeps
    /// its last word; a robot also refuses velocities that lead to such a position.
    pub(super) fn set_positions(&mut self, q: &[f64; MAX_ROBOT_JOINTS]) {
        for (word, &(joint, kind)) in self.broadcast.positions.iter_mut().zip(&self.joints) {
            if let Some(said) = q.get(joint).and_then(|&q| kind.position_to_word(q)) {
                *word = said;
            }
        }
    }

    /// Returns the positions of the chain's joints in rad or m, given those of all joints of the robot.
    pub(super) fn positions(&self, q: &[f64; MAX_ROBOT_JOINTS]) -> [f64; MAX_JOINTS] {
        let mut positions = [0.0; MAX_JOINTS];
        for (position, (joint, _)) in positions.iter_mut().zip(&self.joints) {
            *position = q.get(*joint).copied().unwrap_or_default();
        }
        positions
    }

    /// Adds the fraction `part` of a chain's torques to the torques of the robot's joints. A joint that two chains
    /// share gets the torques of both.
    pub(super) fn add_torque_share(
        &self,
        part: f64,
        torque: &[f64; MAX_JOINTS],
        sum: &mut [f64; MAX_ROBOT_JOINTS],
    ) {
        for ((joint, _), torque) in self.joints.iter().zip(torque) {
            if let Some(sum) = sum.get_mut(*joint) {
                *sum += part * torque;
            }
        }
    }
}
