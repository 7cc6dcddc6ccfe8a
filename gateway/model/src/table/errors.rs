//! Mean and maximum of errors.

use serde::ser::{Serialize, SerializeStruct, Serializer};

/// Mean and maximum of absolute errors, in Nm; serialised as `mean_nm`, `max_nm` and `count`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TorqueErrors {
    sum: f64,
    max: f64,
    count: u64,
}

impl Serialize for TorqueErrors {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut errors = serializer.serialize_struct("Errors", 3)?;
        errors.serialize_field("mean_nm", &self.mean())?;
        errors.serialize_field("max_nm", &self.max)?;
        errors.serialize_field("count", &self.count)?;
        errors.end()
    }
}

impl FromIterator<f64> for TorqueErrors {
    /// Collects errors in Nm, of either sign.
    fn from_iter<T: IntoIterator<Item = f64>>(errors: T) -> Self {
        let mut all = Self::default();
        errors.into_iter().for_each(|error| all.add(error));
        all
    }
}

impl TorqueErrors {
    pub(super) fn add(&mut self, error: f64) {
        self.sum += error.abs();
        self.max = self.max.max(error.abs());
        self.count += 1;
    }

    /// Returns the number of compared torques.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// Returns the mean absolute error in Nm; `None` without a comparison.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "a count of comparisons")]
    pub fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }

    /// Returns the maximum absolute error in Nm.
    #[must_use]
    pub const fn max(&self) -> f64 {
        self.max
    }

    /// Merges two sets of errors.
    #[must_use]
    pub fn merged(self, other: Self) -> Self {
        Self { sum: self.sum + other.sum, max: self.max.max(other.max), count: self.count + other.count }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_have_a_mean_and_a_maximum_and_add_up() {
        let mut errors = TorqueErrors::default();
        assert_eq!(errors.mean(), None);
        [0.5, -1.0, 3.0].into_iter().for_each(|error| errors.add(error));
        assert_eq!((errors.mean(), errors.max(), errors.count()), (Some(1.5), 3.0, 3));
        assert_eq!((errors.merged(errors).mean(), errors.merged(errors).count()), (Some(1.5), 6));
    }
}
