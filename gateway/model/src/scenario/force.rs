//! The force of a touch over time, and the contact words that represent it.

use core::f64::consts::PI;

use protocol::fixed::Q5_10;
use protocol::time::{Micros, Span};

use super::curve::{interpolate, seconds};
use super::{ForceProfile, Touch};

/// The maximum total force of three contact words, in N.
pub const MAX_FORCE_N: f64 = 3.0 * 32_767.0 / 1_024.0;

/// Splits a force in N into three contact words that are as equal as possible. Their sum is exactly the force rounded
/// to the step of a word. Forces out of range saturate.
#[must_use]
#[expect(clippy::cast_possible_truncation, reason = "rounded; the cast saturates, and NaN becomes 0")]
pub fn contact_words(force_n: f64) -> [Q5_10; 3] {
    let steps = (force_n * 1_024.0).round() as i64;
    [2, 1, 0].map(|share| {
        // Three numbers a third apart, rounded down, add up to the whole.
        let steps = steps.saturating_add(share).div_euclid(3);
        Q5_10::from_bits(i16::try_from(steps).unwrap_or(if steps < 0 { i16::MIN } else { i16::MAX }))
    })
}

impl Touch {
    /// Returns true if the touch is active at a time.
    pub(super) fn is_active_at(&self, time: Micros) -> bool {
        self.at <= time && time.elapsed_since(self.at) < self.length
    }

    /// Returns the force in N at a time; `None` if the touch is not active.
    pub(super) fn force_at(&self, time: Micros) -> Option<f64> {
        if !self.is_active_at(time) {
            return None;
        }
        let since = time.elapsed_since(self.at);
        let part = seconds(since) / seconds(self.length);
        Some(match &self.profile {
            ForceProfile::Step => self.force_n,
            ForceProfile::Ramp => self.force_n * part,
            ForceProfile::HalfSine => self.force_n * (PI * part).sin(),
            ForceProfile::Points(points) => {
                interpolate(points, since.0, |Span(micros)| micros).unwrap_or(0.0)
            }
        })
    }
}
