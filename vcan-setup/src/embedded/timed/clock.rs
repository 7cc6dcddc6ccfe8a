//! The clock of a timed bus.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// A clock that shows the wall clock at its start, and then advances steadily, whatever happens to the wall clock.
#[derive(Debug)]
pub(crate) struct BusClock {
    start: Instant,
    start_ns: u64,
}

impl BusClock {
    /// Starts the clock.
    pub(crate) fn start() -> Self {
        Self { start: Instant::now(), start_ns: wall_nanos() }
    }

    /// Returns the time in ns since 1970.
    pub(crate) fn now(&self) -> u64 {
        self.start_ns + u64::try_from(self.start.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }

    /// Returns the difference by which times of the wall clock are to be increased, in ns.
    pub(crate) fn wall_offset(&self) -> i64 {
        self.now().wrapping_sub(wall_nanos()).cast_signed()
    }
}

fn wall_nanos() -> u64 {
    let elapsed = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(elapsed.as_nanos()).unwrap_or(u64::MAX)
}
