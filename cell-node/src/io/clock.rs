//! The clock of the cells, and its relation to the wall clock.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use protocol::time::{Micros, Span};

/// Interval between comparisons with the wall clock.
const MEASURE_INTERVAL: Span = Span::from_millis(250);

/// A monotonic clock with a known offset to the wall clock.
#[derive(Debug)]
pub(super) struct Clock {
    start: Instant,
    /// The wall clock at the start, in µs since 1970. It is measured again from time to time, because the
    /// wall clock may be set.
    wall: u64,
    /// The time of the last measurement.
    measured: Micros,
}

impl Clock {
    pub(super) fn new() -> Self {
        let mut clock = Self { start: Instant::now(), wall: 0, measured: Micros(0) };
        clock.set(Micros(0));
        clock
    }

    pub(super) fn now(&self) -> Micros {
        Micros::since_start(self.start.elapsed())
    }

    /// Measures the offset to the wall clock if the interval has elapsed.
    pub(super) fn remeasure(&mut self, now: Micros) {
        if now.elapsed_since(self.measured) >= MEASURE_INTERVAL {
            self.set(now);
        }
    }

    fn set(&mut self, now: Micros) {
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_micros();
        self.wall = u64::try_from(wall).unwrap_or(0).saturating_sub(self.now().0);
        self.measured = now;
    }

    /// Converts a time of this clock to the wall clock, in ns.
    pub(super) const fn wall_nanos(&self, at: Micros) -> u64 {
        (self.wall + at.0).saturating_mul(1_000)
    }

    /// Returns the age at `now` of a wall clock time in ns.
    pub(super) const fn age(&self, now: Micros, at_nanos: u64) -> Span {
        Span((self.wall + now.0).saturating_sub(at_nanos / 1_000))
    }
}
