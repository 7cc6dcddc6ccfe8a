//! How long answers took.

use std::collections::BTreeMap;

use protocol::time::Span;

/// A bench that was late by more than this does not blame the cell for what was late meanwhile.
const LATE: Span = Span::from_millis(1);

/// What is limited by TIME-2, and by how many ms.
pub(crate) const LIMITS: [(&str, u64); 6] = [
    ("torque", 4),
    ("heartbeat to sync", 10),
    ("heartbeat to a claimant", 20),
    ("configured", 50),
    ("commit", 300),
    ("report", 100),
];

/// Answers to one thing.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Times {
    pub(crate) in_time: usize,
    pub(crate) late: usize,
    /// Late, and so was the bench.
    pub(crate) blameless: usize,
    pub(crate) longest: Span,
}

/// Times of answers by what they answer.
#[derive(Clone, Debug, Default)]
pub(crate) struct Timings(pub(crate) BTreeMap<&'static str, Times>);

impl Timings {
    /// An answer took so long, while the bench was so late itself.
    pub(crate) fn note(&mut self, what: &'static str, took: Span, bench: Span) {
        let times = self.0.entry(what).or_default();
        let limit = LIMITS.iter().find(|(name, _)| *name == what);
        let is_late = limit.is_some_and(|(_, limit)| took > Span::from_millis(*limit));
        match (is_late, bench > LATE) {
            (false, _) => times.in_time += 1,
            (true, true) => times.blameless += 1,
            (true, false) => times.late += 1,
        }
        if bench <= LATE {
            times.longest = times.longest.max(took);
        }
    }
}

impl Times {
    /// Of many answers one in 50 may be late.
    pub(crate) const fn are_right(self) -> bool {
        self.late * 50 <= self.in_time + self.late || self.late == 1 && self.in_time > 0
    }
}
