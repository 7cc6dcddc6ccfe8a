//! What a cell would answer, by the cell's own code: for comparison, and for the test vectors of people who write cells
//! elsewhere.

use cell_node::contact::{Force, Torque};
use cell_node::kernel::{Kernel, Wrench};
use protocol::fixed::{Q1_14, Q3_12};
use protocol::message::SkinSensors;
use protocol::parameters::{Contact, MAX_JOINTS, Parameters};

/// A cell with a configuration, and nothing else of it.
#[derive(Clone, Debug)]
pub struct Reference {
    kernel: Wrench,
    contact: Contact,
}

impl Reference {
    /// A cell with these parameters.
    #[must_use]
    pub fn new(parameters: &Parameters) -> Self {
        Self { kernel: Wrench::new(parameters), contact: parameters.contact }
    }

    /// The torque about each joint of one newton on the cell, in m, at joint positions in quarter turns.
    #[must_use]
    pub fn jacobian(&self, joints: &[Q1_14; MAX_JOINTS]) -> [Q1_14; MAX_JOINTS] {
        self.kernel.jacobian(joints)
    }

    /// The torques in Nm that it would send with these sensors at joint positions in quarter turns.
    #[must_use]
    pub fn torque(&self, joints: &[Q1_14; MAX_JOINTS], sensors: &SkinSensors) -> [Q3_12; MAX_JOINTS] {
        let force = Force::fuse(sensors.contact, sensors.proximity, &self.contact);
        Torque::new(&self.jacobian(joints), force).words()
    }
}
