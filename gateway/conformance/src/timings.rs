//! Records of answer times.

use std::collections::BTreeMap;

use protocol::time::Span;

/// The lateness of the bench above which late answers do not count against the cell.
const MAX_BENCH_LATENESS: Span = Span::from_millis(1);

/// The kinds of answers that TIME-2 limits, each with its limit in ms.
pub(crate) const ANSWER_LIMITS_MS: [(&str, u64); 6] = [
    ("torque", 4),
    ("heartbeat to sync", 10),
    ("heartbeat to a claimant", 20),
    ("configured", 50),
    ("commit", 300),
    ("report", 100),
];

/// The numbers of timely and late answers of one kind.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct AnswerTimeCounts {
    pub(crate) in_time: usize,
    pub(crate) late: usize,
    /// The number of late answers while the bench was late too.
    pub(crate) blameless: usize,
    pub(crate) longest: Span,
}

/// The times of answers, by kind.
#[derive(Clone, Debug, Default)]
pub(crate) struct Timings(pub(crate) BTreeMap<&'static str, AnswerTimeCounts>);

impl Timings {
    /// Records the time of an answer, with the lateness of the bench meanwhile.
    pub(crate) fn record_answer(&mut self, what: &'static str, took: Span, bench: Span) {
        let times = self.0.entry(what).or_default();
        let limit = ANSWER_LIMITS_MS.iter().find(|(name, _)| *name == what);
        let is_late = limit.is_some_and(|(_, limit)| took > Span::from_millis(*limit));
        match (is_late, bench > MAX_BENCH_LATENESS) {
            (false, _) => times.in_time += 1,
            (true, true) => times.blameless += 1,
            (true, false) => times.late += 1,
        }
        if bench <= MAX_BENCH_LATENESS {
            times.longest = times.longest.max(took);
        }
    }
}

impl AnswerTimeCounts {
    /// Returns true if at most one in 50 answers was late.
    pub(crate) const fn are_in_time(self) -> bool {
        self.late * 50 <= self.in_time + self.late || self.late == 1 && self.in_time > 0
    }
}
