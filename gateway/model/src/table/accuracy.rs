//! The errors of distributed torques compared with central ones.

use protocol::fixed::{TorqueFormat, is_saturated};
use protocol::packet::Words;
use protocol::parameters::MAX_JOINTS;

use super::errors::TorqueErrors;
use super::replies::ExpectedTorques;

/// The errors of a torque format: exact torques rounded to its words.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RoundingErrors {
    /// Rounding errors of the torques within the range of the format.
    pub errors: TorqueErrors,
    /// Number of torques beyond the range of the format, whose words saturate.
    pub beyond: u64,
}

impl RoundingErrors {
    fn add_rounding_error(&mut self, format: TorqueFormat, torque: f64) {
        let word = format.nearest_word(torque);
        if is_saturated(word) {
            self.beyond += 1;
        } else {
            self.errors.add(format.to_real(word) - torque);
        }
    }

    fn merged(self, other: Self) -> Self {
        Self { errors: self.errors.merged(other.errors), beyond: self.beyond + other.beyond }
    }
}

/// Errors of distributed torques. A cell's torque is compared only on the joints that a contact on it loads.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct TorqueAccuracy {
    /// Errors of single cells against the central computation with the same quantised words.
    pub single: TorqueErrors,
    /// Errors of single cells against the central computation with unrounded angles, lengths and poses.
    pub unquantised: TorqueErrors,
    /// Errors of the summed torque of the whole skin, on all joints, in epochs that all cells answered in time.
    pub whole: TorqueErrors,
    /// Errors of a bus's torque as summed along the tree, in epochs with complete sums in time, on the joints that some
    /// cell in the sums loads.
    pub sums: TorqueErrors,
    /// Errors as in `sums`, but averaged over 32 consecutive epochs in which no contact changed.
    pub sums_averaged: TorqueErrors,
    /// Number of saturated words, which are not compared.
    pub saturated: u64,
    /// Rounding errors of the central torques of `single`, saturated ones included, in each of [`TorqueFormat::ALL`].
    #[serde(skip)]
    pub formats: [RoundingErrors; TorqueFormat::ALL.len()],
    /// The errors of `single` for each joint.
    #[serde(skip)]
    pub single_by_joint: [TorqueErrors; MAX_JOINTS],
    /// The errors of `whole` for each joint.
    #[serde(skip)]
    pub whole_by_joint: [TorqueErrors; MAX_JOINTS],
}

impl TorqueAccuracy {
    /// Compares one cell's torque with the central one, and adds the errors to those of the cell, too. Returns the
    /// distributed minus the central torque of each joint; zero for saturated words.
    pub(super) fn compare_cell_torque(
        &mut self,
        joint: usize,
        format: TorqueFormat,
        words: &Words,
        expected: &ExpectedTorques,
        of_cell: &mut TorqueErrors,
    ) -> [f64; MAX_JOINTS] {
        let mut errors = [0.0; MAX_JOINTS];
        let both = expected.quantised.iter().zip(&expected.unquantised);
        let joints = errors.iter_mut().zip(&mut self.single_by_joint);
        for (((error, of_joint), &word), (quantised, unquantised)) in
            joints.zip(words.as_slice()).zip(both).take(joint)
        {
            for (rounded, format) in self.formats.iter_mut().zip(TorqueFormat::ALL) {
                rounded.add_rounding_error(format, *quantised);
            }
            if is_saturated(word) {
                self.saturated += 1;
                continue;
            }
            let torque = format.to_real(word);
            *error = torque - quantised;
            self.single.add(*error);
            of_cell.add(*error);
            of_joint.add(*error);
            self.unquantised.add(torque - unquantised);
        }
        errors
    }

    pub(super) fn add_whole_skin_errors(&mut self, errors: &[f64]) {
        for (&error, of_joint) in errors.iter().zip(&mut self.whole_by_joint) {
            self.whole.add(error);
            of_joint.add(error);
        }
    }

    /// Merges the errors of two buses.
    #[must_use]
    pub fn merged(self, other: Self) -> Self {
        let joint_by_joint = |mut sum: [TorqueErrors; MAX_JOINTS], other: [TorqueErrors; MAX_JOINTS]| {
            for (sum, other) in sum.iter_mut().zip(other) {
                *sum = sum.merged(other);
            }
            sum
        };
        let mut formats = self.formats;
        for (sum, other) in formats.iter_mut().zip(other.formats) {
            *sum = sum.merged(other);
        }
        Self {
            formats,
            single_by_joint: joint_by_joint(self.single_by_joint, other.single_by_joint),
            whole_by_joint: joint_by_joint(self.whole_by_joint, other.whole_by_joint),
            single: self.single.merged(other.single),
            unquantised: self.unquantised.merged(other.unquantised),
            whole: self.whole.merged(other.whole),
            sums: self.sums.merged(other.sums),
            sums_averaged: self.sums_averaged.merged(other.sums_averaged),
            saturated: self.saturated + other.saturated,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn torques_beyond_the_range_of_a_format_are_counted_apart() {
        let (format, mut rounded) = (TorqueFormat::Q3_12, RoundingErrors::default());
        [1.0, 1.0 + 0.25 / 4_096.0, 8.0, -9.0]
            .into_iter()
            .for_each(|torque| rounded.add_rounding_error(format, torque));
        assert_eq!((rounded.errors.count(), rounded.errors.max(), rounded.beyond), (2, 0.25 / 4_096.0, 2));
        assert_eq!(rounded.merged(rounded).beyond, 4);
    }
}
