//! Start-up helpers that runs and replays share.

use std::time::{Duration, Instant};

use protocol::id::CellId;

/// A timeout that restarts with each progress of what is waited for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Timeout {
    length: Duration,
    best: usize,
    since: Instant,
}

impl Timeout {
    /// Creates a timeout that is over after `length` without progress.
    pub(crate) fn new(length: Duration) -> Self {
        Self { length, best: 0, since: Instant::now() }
    }

    /// Takes the progress so far, as a number that grows. Returns true if it has not grown for the length of the
    /// timeout.
    pub(crate) fn has_stalled(&mut self, far: usize) -> bool {
        if far > self.best {
            (self.best, self.since) = (far, Instant::now());
        }
        self.since.elapsed() > self.length
    }
}

/// Formats node ids and their place: `1, 2, 5 on vcan0`.
pub(crate) fn format_cells(cells: &[CellId], place: &str) -> String {
    let numbers: Vec<_> = cells.iter().map(ToString::to_string).collect();
    match numbers.len() {
        count @ 13.. => {
            format!("{count} cells{place} ({} ...)", numbers.get(..6).unwrap_or_default().join(", "))
        }
        _ => numbers.join(", ") + place,
    }
}

/// Formats cells as the subject of a sentence: `cell 1`, `cells 1, 2, 5`, `100 cells (1, 2, 3, 4, 5, 6 ...)`.
pub(crate) fn format_as_subject(cells: &[CellId], place: &str) -> String {
    let cells_there = format_cells(cells, place);
    match cells.len() {
        1 => format!("cell {cells_there}"),
        13.. => cells_there,
        _ => format!("cells {cells_there}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_the_subject_of_a_sentence() {
        let text = |count| {
            let cells: Vec<_> = (1..=count).map(|node| CellId::new(node).unwrap()).collect();
            format_as_subject(&cells, " on vcan0")
        };
        assert_eq!(text(1), "cell 1 on vcan0");
        assert_eq!(text(2), "cells 1, 2 on vcan0");
        assert_eq!(text(12), "cells 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12 on vcan0");
        assert_eq!(text(13), "13 cells on vcan0 (1, 2, 3, 4, 5, 6 ...)");
    }
}
