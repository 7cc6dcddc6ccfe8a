//! Computes the torques of a cell with the cell's own code. The gateway compares replies with them, and the test
//! vectors for cells by other authors contain them.

use cell_node::contact::{Force, Torque};
use cell_node::kernel::{Kernel, Wrench};
use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::message::SkinSensors;
use protocol::parameters::{Contact, MAX_JOINTS, Parameters};

/// The arithmetic of a cell with a configuration: its Jacobian, force and torques.
#[derive(Clone, Debug)]
pub struct ReferenceCell {
    kernel: Wrench,
    contact: Contact,
    format: TorqueFormat,
}

impl ReferenceCell {
    /// Creates a cell with these parameters.
    #[must_use]
    pub fn new(parameters: &Parameters) -> Self {
        Self {
            kernel: Wrench::new(parameters),
            contact: parameters.contact,
            format: parameters.torque_format,
        }
    }

    /// Returns the torque about each joint for a force of 1 N on the cell, in m, at joint positions in quarter turns.
    /// For prismatic joints it is dimensionless, at positions in m.
    #[must_use]
    pub fn jacobian(&self, joints: &[Q1_14; MAX_JOINTS]) -> [Q1_14; MAX_JOINTS] {
        self.kernel.jacobian(joints)
    }

    /// Returns the format in which the cell sends torques.
    #[must_use]
    pub const fn format(&self) -> TorqueFormat {
        self.format
    }

    /// Returns the words of the torques that the cell would send with these sensor values, at joint positions in
    /// quarter turns or m.
    #[must_use]
    pub fn torque(&self, joints: &[Q1_14; MAX_JOINTS], sensors: &SkinSensors) -> [i16; MAX_JOINTS] {
        self.torque_words(joints, Force::fuse(sensors.contact, sensors.proximity, &self.contact))
    }

    /// Returns the words of the torques of a force on the cell in N, whatever its sensors measure. The force is rounded
    /// to 2^-16 N.
    #[must_use]
    pub fn torque_for_force(&self, joints: &[Q1_14; MAX_JOINTS], newtons: f64) -> [i16; MAX_JOINTS] {
        #[expect(clippy::cast_possible_truncation, reason = "held within what a force can be")]
        let steps = (newtons * 65_536.0).round() as i64;
        self.torque_words(joints, Force::from_steps(steps))
    }

    fn torque_words(&self, joints: &[Q1_14; MAX_JOINTS], force: Force) -> [i16; MAX_JOINTS] {
        Torque::new(&self.jacobian(joints), force).torque_words(self.format)
    }
}

#[cfg(test)]
mod tests;
