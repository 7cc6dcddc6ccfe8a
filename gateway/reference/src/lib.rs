//! Computes the torques of a cell with the cell's own code. The gateway compares replies with them, and the test
//! vectors for cells by other authors contain them.

use cell_node::contact::{Force, Torque};
use cell_node::kernel::{Kernel, Wrench};
use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::message::SkinSensors;
use protocol::parameters::{Contact, MAX_JOINTS, Parameters};
use protocol::sine::SineMethod;

/// The part of a step by which the rounding of a torque may be off, because a cell rounds the force to 2^-16 N.
const ROUNDING_SLACK_STEPS: f64 = 0.01;

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

    /// Makes the cell compute with the sine of another build.
    #[must_use]
    pub fn with_sine(mut self, sine: SineMethod) -> Self {
        self.kernel.set_sine(sine);
        self
    }

    /// Returns true if a force exists for which the cell would send these words of torques, at joint positions in
    /// quarter turns or m.
    ///
    /// Each word bounds the force, F = tau / J within half a step; the bounds of all words must have a force in common.
    #[must_use]
    pub fn can_send(&self, joints: &[Q1_14; MAX_JOINTS], words: &[i16]) -> bool {
        let step = f64::from(self.format.fraction_bits()).exp2().recip();
        let (mut least, mut most) = (f64::NEG_INFINITY, f64::INFINITY);
        for (row, word) in self.jacobian(joints).into_iter().zip(words) {
            if matches!(*word, i16::MIN | i16::MAX) {
                continue; // saturated
            }
            let torque = f64::from(*word) * step;
            let (row, half) = (row.to_f64(), (0.5 + ROUNDING_SLACK_STEPS) * step);
            if row == 0.0 {
                if *word != 0 {
                    return false;
                }
                continue;
            }
            let bounds = [(torque - half) / row, (torque + half) / row];
            least = least.max(bounds[0].min(bounds[1]));
            most = most.min(bounds[0].max(bounds[1]));
        }
        least <= most
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
