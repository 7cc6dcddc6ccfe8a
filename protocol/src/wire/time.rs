//! Points in time and durations in whole microseconds.
//!
//! The core modules never read a clock. The caller passes the current time, which can also come from a test, a
//! simulation or a microcontroller.

use core::ops::{Add, Sub};
use core::time::Duration;

/// A point in time, in microseconds since an origin that the caller chooses.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct Micros(pub u64);

/// A duration in microseconds.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct Span(pub u64);

impl Span {
    /// Creates a duration from milliseconds.
    #[must_use]
    pub const fn from_millis(millis: u64) -> Self {
        Self(millis * 1_000)
    }

    /// Returns the duration in seconds.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "lengths far below 2^53 us")]
    pub const fn seconds(self) -> f64 {
        self.0 as f64 / 1e6
    }
}

impl Micros {
    /// Returns the point in time `start` after the origin. Saturates at the maximum of 64 bits.
    #[must_use]
    pub fn from_elapsed(start: Duration) -> Self {
        Self(u64::try_from(start.as_micros()).unwrap_or(u64::MAX))
    }

    /// Returns the time since `earlier`; zero if `earlier` is in the future.
    #[must_use]
    pub const fn elapsed_since(self, earlier: Self) -> Span {
        Span(self.0.saturating_sub(earlier.0))
    }
}

impl Add<Span> for Micros {
    type Output = Self;

    fn add(self, span: Span) -> Self {
        Self(self.0.saturating_add(span.0))
    }
}

impl Sub<Span> for Micros {
    type Output = Self;

    fn sub(self, span: Span) -> Self {
        Self(self.0.saturating_sub(span.0))
    }
}
