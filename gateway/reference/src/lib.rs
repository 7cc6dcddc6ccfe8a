//! What a cell would answer, by the cell's own code: for comparison, and for the test vectors of people who write cells
//! elsewhere.

use cell_node::contact::{Force, Torque};
use cell_node::kernel::{Kernel, Wrench};
use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::message::SkinSensors;
use protocol::parameters::{Contact, MAX_JOINTS, Parameters};

/// A cell with a configuration, and nothing else of it.
#[derive(Clone, Debug)]
pub struct Reference {
    kernel: Wrench,
    contact: Contact,
    format: TorqueFormat,
}

impl Reference {
    /// A cell with these parameters.
    #[must_use]
    pub fn new(parameters: &Parameters) -> Self {
        Self {
            kernel: Wrench::new(parameters),
            contact: parameters.contact,
            format: parameters.torque_format,
        }
    }

    /// The torque about each joint of one newton on the cell, in m, at joint positions in quarter turns; of
    /// prismatic joints a number, at positions in m.
    #[must_use]
    pub fn jacobian(&self, joints: &[Q1_14; MAX_JOINTS]) -> [Q1_14; MAX_JOINTS] {
        self.kernel.jacobian(joints)
    }

    /// In which format it sends torques.
    #[must_use]
    pub const fn format(&self) -> TorqueFormat {
        self.format
    }

    /// The words of the torques that it would send with these sensors, at joint positions in quarter turns or m.
    #[must_use]
    pub fn torque(&self, joints: &[Q1_14; MAX_JOINTS], sensors: &SkinSensors) -> [i16; MAX_JOINTS] {
        self.under(joints, Force::fuse(sensors.contact, sensors.proximity, &self.contact))
    }

    /// The words of the torques that so many newtons on the cell make, whatever it measures: to the nearest 2^-16 N.
    #[must_use]
    pub fn torque_of(&self, joints: &[Q1_14; MAX_JOINTS], newtons: f64) -> [i16; MAX_JOINTS] {
        #[expect(clippy::cast_possible_truncation, reason = "held within what a force can be")]
        let steps = (newtons * 65_536.0).round() as i64;
        self.under(joints, Force::from_steps(steps))
    }

    fn under(&self, joints: &[Q1_14; MAX_JOINTS], force: Force) -> [i16; MAX_JOINTS] {
        Torque::new(&self.jacobian(joints), force).words(self.format)
    }
}

#[cfg(test)]
mod tests;
