//! What a run and a replay share until their cells are ready.

use std::time::{Duration, Instant};

use protocol::id::CellId;

/// A timeout that restarts with each progress.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Timeout {
    length: Duration,
    most: usize,
    since: Instant,
}

impl Timeout {
    /// So long without progress.
    pub(crate) fn new(length: Duration) -> Self {
        Self { length, most: 0, since: Instant::now() }
    }

    /// Takes in the progress; whether there was none for too long.
    pub(crate) fn is_over(&mut self, far: usize) -> bool {
        if far > self.most {
            (self.most, self.since) = (far, Instant::now());
        }
        self.since.elapsed() > self.length
    }
}

/// The node ids of some cells as text, and their bus: `1, 2, 5 on vcan0`.
pub(crate) fn names(cells: &[CellId], place: &str) -> String {
    let numbers: Vec<_> = cells.iter().map(ToString::to_string).collect();
    match numbers.len() {
        count @ 13.. => {
            format!("{count} cells{place} ({} ...)", numbers.get(..6).unwrap_or_default().join(", "))
        }
        _ => numbers.join(", ") + place,
    }
}
