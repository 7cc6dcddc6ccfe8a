//! The clock of the cells, and its offset to the wall clock, which time stamps of frames use.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use protocol::time::{Micros, Span};

/// Interval between measurements of the offset to the wall clock.
const OFFSET_MEASURE_INTERVAL: Span = Span::from_millis(250);

/// A monotonic clock with a known offset to the wall clock.
#[derive(Debug)]
pub(super) struct Clock {
    start: Instant,
    /// Wall clock time of this clock's origin, in µs since 1970. It is measured again at intervals, because the wall
    /// clock may be set.
    wall: u64,
    /// The time of the last measurement of the offset.
    measured: Micros,
}

impl Clock {
    pub(super) fn new() -> Self {
        let mut clock = Self { start: Instant::now(), wall: 0, measured: Micros(0) };
        clock.measure_offset(Micros(0));
        clock
    }

    pub(super) fn now(&self) -> Micros {
        Micros::from_elapsed(self.start.elapsed())
    }

    /// Measures the offset to the wall clock again if the interval between measurements has passed.
    pub(super) fn measure_offset_if_due(&mut self, now: Micros) {
        if now.elapsed_since(self.measured) >= OFFSET_MEASURE_INTERVAL {
            self.measure_offset(now);
        }
    }

    fn measure_offset(&mut self, now: Micros) {
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_micros();
        self.wall = u64::try_from(wall).unwrap_or(0).saturating_sub(self.now().0);
        self.measured = now;
    }

    /// Converts a time of this clock to wall clock time in ns since 1970.
    pub(super) const fn wall_clock_nanos(&self, at: Micros) -> u64 {
        (self.wall + at.0).saturating_mul(1_000)
    }

    /// Returns the time from a wall clock time in ns until `now`.
    pub(super) const fn age(&self, now: Micros, at_nanos: u64) -> Span {
        Span((self.wall + now.0).saturating_sub(at_nanos / 1_000))
    }
}
