//! The values besides the force that a touch sets: keys of `[[touch]]`, their checks, and their effect on a cell.

use protocol::document::{Checked, KeyPath};
use protocol::fixed::{Q, Q1_14, Q9_6};
use protocol::message::SensorReadings;
use serde_json::{Value, json};

use super::raw;

/// The values of a touch besides its force.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TouchValues {
    /// The proximity during the touch, 0 to 1.
    pub proximity: Q1_14,
    /// The temperatures of the touched cells, in °C.
    pub temperature: Option<[Q9_6; 2]>,
}

impl TouchValues {
    /// Checks the keys of a touch.
    pub(super) fn check(at: &KeyPath, raw: &raw::Touch) -> Checked<Self> {
        if !(0.0..=1.0).contains(&raw.proximity) {
            return Err(at.with_key("proximity").fault(raw.proximity, "must be 0 (nothing near) to 1"));
        }
        let degrees = |got| at.with_key("temperature_c").to_fixed(got, Q::try_nearest);
        let temperature = match raw.temperature_c {
            Some([first, second]) => Some([degrees(first)?, degrees(second)?]),
            None => None,
        };
        Ok(Self { proximity: Q1_14::nearest(raw.proximity), temperature })
    }

    /// Applies the values after those of earlier touches in the file: the nearest proximity counts, and the last
    /// temperature.
    pub(super) fn apply(&self, readings: &mut SensorReadings) {
        readings.skin.proximity = readings.skin.proximity.max(self.proximity);
        readings.skin.temperature = self.temperature.unwrap_or(readings.skin.temperature);
    }

    /// Returns the keys and rounded values that the file sets.
    pub fn key_values(&self) -> impl Iterator<Item = (&'static str, Value)> {
        let proximity = self.proximity.to_f64();
        let proximity = (proximity > 0.0).then(|| json!((proximity * 1e4).round() / 1e4));
        let temperature = self.temperature.map(|both| both.map(|one| (one.to_f64() * 1e2).round() / 1e2));
        let all = [("proximity", proximity), ("temperature_c", temperature.map(|both| json!(both)))];
        all.into_iter().filter_map(|(key, value)| Some((key, value?)))
    }
}
