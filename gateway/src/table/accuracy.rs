//! How far distributed torques are from central ones.

use protocol::packet::WORDS;

use super::cell::{Expected, word_to_nm};

/// Mean and greatest of some absolute errors, in Nm.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    sum: f64,
    max: f64,
    count: u64,
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

    /// The greatest absolute error in Nm.
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

/// Distributed against central torques, over the joints that a contact loads (l <= k).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Accuracy {
    /// Single cells, against the central computation on the same words.
    pub single: Errors,
    /// Single cells, against the central computation on unrounded angles, lengths and poses.
    pub unquantised: Errors,
    /// The whole skin's torque in epochs that everybody answered in time, all joints.
    pub whole: Errors,
    /// Words that were left out because they were saturated.
    pub saturated: u64,
}

impl Accuracy {
    /// Compares one cell's torque; returns distributed less central, zero where saturated.
    pub(super) fn compare(
        &mut self,
        joint: usize,
        words: &[i32; WORDS],
        expected: &Expected,
    ) -> [f64; WORDS] {
        let mut errors = [0.0; WORDS];
        let both = expected.quantised.iter().zip(&expected.unquantised);
        for ((error, &word), (quantised, unquantised)) in errors.iter_mut().zip(words).zip(both).take(joint) {
            if word == i32::from(i16::MAX) || word == i32::from(i16::MIN) {
                self.saturated += 1;
                continue;
            }
            *error = word_to_nm(word) - quantised;
            self.single.add(*error);
            self.unquantised.add(word_to_nm(word) - unquantised);
        }
        errors
    }

    pub(super) fn whole_skin(&mut self, errors: &[f64; WORDS]) {
        for &error in errors {
            self.whole.add(error);
        }
    }

    /// The accuracy of several buses together.
    #[must_use]
    pub fn with(self, other: Self) -> Self {
        Self {
            single: self.single.with(other.single),
            unquantised: self.unquantised.with(other.unquantised),
            whole: self.whole.with(other.whole),
            saturated: self.saturated + other.saturated,
        }
    }
}
