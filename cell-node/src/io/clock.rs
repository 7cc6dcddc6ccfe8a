//! The time that cells go by, and the wall's beside it.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use protocol::time::{Micros, Span};

/// From one comparison with the wall's clock to the next.
const MEASURE: Span = Span::from_millis(250);

/// A monotonic clock, and how the wall's time is had from it without asking twice.
#[derive(Debug)]
pub(super) struct Clock {
    start: Instant,
    /// The wall's time at the start, in µs since 1970; measured again now and then, because it may be set
    /// the wall's clock.
    wall: u64,
    /// When it was measured.
    measured: Micros,
}

impl Clock {
    pub(super) fn new() -> Self {
        let mut clock = Self { start: Instant::now(), wall: 0, measured: Micros(0) };
        clock.set(Micros(0));
        clock
    }

    pub(super) fn now(&self) -> Micros {
        Micros::after(self.start.elapsed())
    }

    /// Compares itself with the wall's clock, when it is time to.
    pub(super) fn keep(&mut self, now: Micros) {
        if now.since(self.measured) >= MEASURE {
            self.set(now);
        }
    }

    fn set(&mut self, now: Micros) {
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_micros();
        self.wall = u64::try_from(wall).unwrap_or(0).saturating_sub(self.now().0);
        self.measured = now;
    }

    /// The wall's time in ns at a time of this clock.
    pub(super) const fn wall_nanos(&self, at: Micros) -> u64 {
        (self.wall + at.0).saturating_mul(1_000)
    }

    /// How long before `now` a wall's time in ns was.
    pub(super) const fn age(&self, now: Micros, at_nanos: u64) -> Span {
        Span((self.wall + now.0).saturating_sub(at_nanos / 1_000))
    }
}
