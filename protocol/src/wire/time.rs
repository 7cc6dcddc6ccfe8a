//! Points in time and lengths of time in whole microseconds, passed in by the caller.
//!
//! The cores never read a clock: a test, a simulation and a microcontroller each bring their own.

use core::ops::{Add, Sub};
use core::time::Duration;

/// A point in time: microseconds since a start that the caller chose.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct Micros(pub u64);

/// A length of time in microseconds.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct Span(pub u64);

impl Span {
    /// A length given in milliseconds.
    #[must_use]
    pub const fn from_millis(millis: u64) -> Self {
        Self(millis * 1_000)
    }

    /// The same in seconds.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "lengths far below 2^53 us")]
    pub const fn seconds(self) -> f64 {
        self.0 as f64 / 1e6
    }
}

impl Micros {
    /// Returns the point in time so long after the start, or the last one that there is.
    #[must_use]
    pub fn after(start: Duration) -> Self {
        Self(u64::try_from(start.as_micros()).unwrap_or(u64::MAX))
    }

    /// How long ago `earlier` was; nothing when it lies ahead.
    #[must_use]
    pub const fn since(self, earlier: Self) -> Span {
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
