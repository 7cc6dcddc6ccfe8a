//! The errors of distributed torques against central ones.

use protocol::fixed::{TorqueFormat, is_saturated};
use protocol::packet::Words;
use protocol::parameters::MAX_JOINTS;
use serde::ser::{Serialize, SerializeStruct, Serializer};

use super::replies::Expected;
use super::root_totals;

/// Epochs over which errors of sums are averaged.
const AVERAGED: u32 = 32;

/// Mean and maximum of some absolute errors, in Nm; serialised as `mean_nm`, `max_nm` and `count`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    sum: f64,
    max: f64,
    count: u64,
}

impl Serialize for Errors {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut errors = serializer.serialize_struct("Errors", 3)?;
        errors.serialize_field("mean_nm", &self.mean())?;
        errors.serialize_field("max_nm", &self.max)?;
        errors.serialize_field("count", &self.count)?;
        errors.end()
    }
}

impl FromIterator<f64> for Errors {
    /// Collects errors in Nm, of either sign.
    fn from_iter<T: IntoIterator<Item = f64>>(errors: T) -> Self {
        let mut all = Self::default();
        errors.into_iter().for_each(|error| all.add(error));
        all
    }
}

impl Errors {
    fn add(&mut self, error: f64) {
        self.sum += error.abs();
        self.max = self.max.max(error.abs());
        self.count += 1;
    }

    /// How many torques were compared.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// The mean absolute error in Nm; `None` without anything compared.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "a count of comparisons")]
    pub fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }

    /// The maximum absolute error in Nm.
    #[must_use]
    pub const fn max(&self) -> f64 {
        self.max
    }

    /// Both together.
    #[must_use]
    pub fn with(self, other: Self) -> Self {
        Self { sum: self.sum + other.sum, max: self.max.max(other.max), count: self.count + other.count }
    }
}

/// Exact torques in a torque format: what rounding to it alone makes of them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rounded {
    /// Of the torques within its range.
    pub errors: Errors,
    /// Torques beyond its range, whose words are saturated.
    pub beyond: u64,
}

impl Rounded {
    fn take(&mut self, format: TorqueFormat, torque: f64) {
        let word = format.nearest(torque);
        if is_saturated(word) {
            self.beyond += 1;
        } else {
            self.errors.add(format.real(word) - torque);
        }
    }

    fn with(self, other: Self) -> Self {
        Self { errors: self.errors.with(other.errors), beyond: self.beyond + other.beyond }
    }
}

/// Distributed against central torques, over the joints that a contact loads (l <= k).
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Accuracy {
    /// Single cells, against the central computation on the same words.
    pub single: Errors,
    /// Single cells, against the central computation on unrounded angles, lengths and poses.
    pub unquantised: Errors,
    /// The whole skin's torque in epochs that all cells answered in time, all joints.
    pub whole: Errors,
    /// The whole bus' torque as sums along a tree brought it, in epochs whose sums were complete in time, over
    /// the joints that some cell in them loads.
    pub sums: Errors,
    /// The same, each error averaged over 32 such epochs in a row with the same contact state of every cell.
    pub sums_averaged: Errors,
    /// Words that were left out because they were saturated.
    pub saturated: u64,
    /// The central torques of `single`, saturated ones too, in each of [`TorqueFormat::ALL`].
    #[serde(skip)]
    pub formats: [Rounded; TorqueFormat::ALL.len()],
    /// `single` joint by joint.
    #[serde(skip)]
    pub single_by_joint: [Errors; MAX_JOINTS],
    /// `whole` joint by joint.
    #[serde(skip)]
    pub whole_by_joint: [Errors; MAX_JOINTS],
}

impl Accuracy {
    /// Compares one cell's torque, also in the cell's own account; returns distributed less central, zero where
    /// saturated.
    pub(super) fn compare(
        &mut self,
        joint: usize,
        format: TorqueFormat,
        words: &Words,
        expected: &Expected,
        of_cell: &mut Errors,
    ) -> [f64; MAX_JOINTS] {
        let mut errors = [0.0; MAX_JOINTS];
        let both = expected.quantised.iter().zip(&expected.unquantised);
        let joints = errors.iter_mut().zip(&mut self.single_by_joint);
        for (((error, of_joint), &word), (quantised, unquantised)) in
            joints.zip(words.as_slice()).zip(both).take(joint)
        {
            for (rounded, format) in self.formats.iter_mut().zip(TorqueFormat::ALL) {
                rounded.take(format, *quantised);
            }
            if is_saturated(word) {
                self.saturated += 1;
                continue;
            }
            let torque = format.real(word);
            *error = torque - quantised;
            self.single.add(*error);
            of_cell.add(*error);
            of_joint.add(*error);
            self.unquantised.add(torque - unquantised);
        }
        errors
    }

    pub(super) fn whole_skin(&mut self, errors: &[f64]) {
        for (&error, of_joint) in errors.iter().zip(&mut self.whole_by_joint) {
            self.whole.add(error);
            of_joint.add(error);
        }
    }

    /// The accuracy of several buses together.
    #[must_use]
    pub fn with(self, other: Self) -> Self {
        let joint_by_joint = |mut sum: [Errors; MAX_JOINTS], other: [Errors; MAX_JOINTS]| {
            for (sum, other) in sum.iter_mut().zip(other) {
                *sum = sum.with(other);
            }
            sum
        };
        let mut formats = self.formats;
        for (sum, other) in formats.iter_mut().zip(other.formats) {
            *sum = sum.with(other);
        }
        Self {
            formats,
            single_by_joint: joint_by_joint(self.single_by_joint, other.single_by_joint),
            whole_by_joint: joint_by_joint(self.whole_by_joint, other.whole_by_joint),
            single: self.single.with(other.single),
            unquantised: self.unquantised.with(other.unquantised),
            whole: self.whole.with(other.whole),
            sums: self.sums.with(other.sums),
            sums_averaged: self.sums_averaged.with(other.sums_averaged),
            saturated: self.saturated + other.saturated,
        }
    }
}

/// Errors of sums, epoch after epoch.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SumError {
    pub(super) each: Errors,
    pub(super) averaged: Errors,
    /// Words that were left out because they were saturated.
    pub(super) saturated: u64,
    /// Epochs in a row, and their errors together.
    epochs: u32,
    sum: [f64; MAX_JOINTS],
    /// The errors of the epoch that was compared last.
    pub(super) last: Option<[f64; MAX_JOINTS]>,
}

impl SumError {
    /// Compares the sum of a complete epoch, in steps of Q7.8.
    pub(super) fn take(
        &mut self,
        words: &[i32; MAX_JOINTS],
        saturated: bool,
        expected: &root_totals::Expected,
    ) {
        if !expected.constant {
            self.interrupt();
        }
        if saturated {
            self.saturated += expected.joints as u64;
            return self.interrupt();
        }
        let mut errors = [0.0; MAX_JOINTS];
        let compared = errors.iter_mut().zip(words).zip(expected.torque).zip(&mut self.sum);
        for (((error, &word), torque), sum) in compared.take(expected.joints) {
            *error = f64::from(word) / 256.0 - torque;
            self.each.add(*error);
            *sum += *error;
        }
        self.last = Some(errors);
        self.epochs += 1;
        if self.epochs == AVERAGED {
            let sums = self.sum;
            for sum in sums.iter().take(expected.joints) {
                self.averaged.add(sum / f64::from(AVERAGED));
            }
            self.interrupt();
        }
    }

    /// The next epoch begins a new average.
    pub(super) const fn interrupt(&mut self) {
        (self.epochs, self.sum) = (0, [0.0; MAX_JOINTS]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_have_a_mean_and_a_maximum_and_add_up() {
        let mut errors = Errors::default();
        assert_eq!(errors.mean(), None);
        [0.5, -1.0, 3.0].into_iter().for_each(|error| errors.add(error));
        assert_eq!((errors.mean(), errors.max(), errors.count()), (Some(1.5), 3.0, 3));
        assert_eq!((errors.with(errors).mean(), errors.with(errors).count()), (Some(1.5), 6));
    }

    #[test]
    fn torques_beyond_the_range_of_a_format_are_counted_apart() {
        let (format, mut rounded) = (TorqueFormat::Q3_12, Rounded::default());
        [1.0, 1.0 + 0.25 / 4_096.0, 8.0, -9.0].into_iter().for_each(|torque| rounded.take(format, torque));
        assert_eq!((rounded.errors.count(), rounded.errors.max(), rounded.beyond), (2, 0.25 / 4_096.0, 2));
        assert_eq!(rounded.with(rounded).beyond, 4);
    }
}
