//! Times and durations in a scenario's file.

use protocol::document::{Checked, KeyPath, span_from_seconds};
use protocol::time::{Micros, Span};

/// The duration of a scenario in s, which limits the times in its file.
#[derive(Clone, Copy)]
pub(super) struct ScenarioDuration(pub(super) f64);

impl ScenarioDuration {
    /// Checks that a time in s is from 0 to before the end of the scenario.
    pub(super) fn check_time_before_end(self, at: &KeyPath, seconds: f64) -> Checked<Micros> {
        if (0.0..self.0).contains(&seconds) {
            return Ok(Micros(span_from_seconds(seconds).0));
        }
        self.out_of_range_error(at, seconds)
    }

    /// Checks that a time in s is from 0 to the end of the scenario, the end included.
    pub(super) fn check_time_up_to_end(self, at: &KeyPath, seconds: f64) -> Checked<Micros> {
        if (0.0..=self.0).contains(&seconds) {
            return Ok(Micros(span_from_seconds(seconds).0));
        }
        self.out_of_range_error(at, seconds)
    }

    fn out_of_range_error(self, at: &KeyPath, seconds: f64) -> Checked<Micros> {
        let why = format_args!("must be within the scenario, from 0 to duration_s = {}", self.0);
        Err(at.fault(seconds, why))
    }
}

/// The longest duration in s: one year.
pub(super) const MAX_DURATION_S: f64 = 3.2e7;

/// Checks a duration in s: above 0 and at most [`MAX_DURATION_S`].
pub(super) fn check_duration(at: &KeyPath, seconds: f64) -> Checked<Span> {
    if (1e-6..=MAX_DURATION_S).contains(&seconds) {
        return Ok(span_from_seconds(seconds));
    }
    Err(at.fault(seconds, "must be above 0, and at most 3.2e7"))
}
