//! Decides when an adapter that refuses lines is reopened.

use std::time::Duration;

use super::incoming::Replies;
use super::options::OpeningStage;

/// The minimum time between two reopenings, which take the adapter off its bus for a moment.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// The maximum time between two reopenings that do not help.
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// The number of refusals in a row after which an adapter that accepted lines before is reopened: its queue may be full
/// for a moment.
const REFUSAL_THRESHOLD: u64 = 8;

/// The reaction to refused lines.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum RefusalAction {
    /// Ignore them: there are none, or they are expected.
    Nothing,
    /// Report that the adapter does not support a setting.
    ReportSettings,
    /// Count these refused lines of an open adapter.
    Count(u64),
    /// Count them, and reopen the adapter, which is closed or was reset.
    Reopen(u64),
}

/// The history of an adapter's refusals. It processes counts and times without input or output.
#[derive(Debug)]
pub struct Refusals {
    seen: u64,
    next: Duration,
    pause: Duration,
    reopened: u64,
}

impl Refusals {
    /// Creates an empty history.
    #[must_use]
    pub const fn new() -> Self {
        Self { seen: 0, next: Duration::ZERO, pause: FIRST_PAUSE, reopened: 0 }
    }

    /// Returns the number of reopenings.
    #[must_use]
    pub const fn reopened(&self) -> u64 {
        self.reopened
    }

    /// Evaluates the refusals so far, for an adapter in this stage with these replies since it was opened.
    pub fn evaluate(&mut self, now: Duration, stage: OpeningStage, bells: u64, replies: Replies) -> RefusalAction {
        let more = bells - std::mem::replace(&mut self.seen, bells);
        if replies.accepted && replies.refusals == 0 {
            self.pause = FIRST_PAUSE;
        }
        match stage {
            _ if more == 0 => RefusalAction::Nothing,
            // These refusals are of frames before a reopening, or of an incomplete line or of closing a closed adapter.
            OpeningStage::Away | OpeningStage::Closed => RefusalAction::Count(more),
            OpeningStage::Setting => RefusalAction::ReportSettings,
            OpeningStage::Open if now < self.next || (replies.accepted && replies.refusals < REFUSAL_THRESHOLD) => {
                RefusalAction::Count(more)
            }
            OpeningStage::Open => {
                self.next = now + self.pause;
                self.pause = LONGEST_PAUSE.min(2 * self.pause);
                self.reopened += 1;
                RefusalAction::Reopen(more)
            }
        }
    }
}

impl Default for Refusals {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn at(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    #[test]
    fn a_closed_adapter_is_opened_at_its_first_refusal_and_then_ever_less_often() {
        let mut refusals = Refusals::new();
        let replies = |refusals| Replies { accepted: false, refusals };
        let mut times = Vec::new();
        for number in 1..=100_000 {
            if let RefusalAction::Reopen(1) = refusals.evaluate(at(number), OpeningStage::Open, number, replies(number)) {
                times.push(number);
            }
        }
        assert_eq!(times, [1, 1_001, 3_001, 7_001, 15_001, 31_001, 61_001, 91_001]);
        assert_eq!(refusals.reopened(), 8);
        // Once the adapter has accepted a line, the history starts anew.
        refusals.evaluate(at(200_000), OpeningStage::Open, 100_000, Replies { accepted: true, refusals: 0 });
        for (now, expected) in [(200_001, true), (200_900, false), (201_001, true)] {
            let action = refusals.evaluate(at(now), OpeningStage::Open, 100_000 + now, replies(1));
            assert_eq!(matches!(action, RefusalAction::Reopen(_)), expected, "{now}");
        }
    }

    #[test]
    fn an_adapter_that_accepts_lines_is_not_opened_for_a_few_refusals() {
        let mut refusals = Refusals::new();
        for refused in 1..=REFUSAL_THRESHOLD {
            let replies = Replies { accepted: true, refusals: refused };
            let expected = if refused < REFUSAL_THRESHOLD { RefusalAction::Count(1) } else { RefusalAction::Reopen(1) };
            assert_eq!(refusals.evaluate(at(refused), OpeningStage::Open, refused, replies), expected);
        }
        let accepted = Replies { accepted: true, refusals: 0 };
        assert_eq!(refusals.evaluate(at(9), OpeningStage::Open, REFUSAL_THRESHOLD, accepted), RefusalAction::Nothing);
    }

    #[test]
    fn refusals_while_it_is_opened_are_no_reason_to_open_it() {
        let mut refusals = Refusals::new();
        let replies = Replies { accepted: false, refusals: 1 };
        assert_eq!(refusals.evaluate(at(1), OpeningStage::Away, 1, replies), RefusalAction::Count(1));
        assert_eq!(refusals.evaluate(at(2), OpeningStage::Closed, 2, replies), RefusalAction::Count(1));
        assert_eq!(refusals.evaluate(at(3), OpeningStage::Setting, 3, replies), RefusalAction::ReportSettings);
        assert_eq!(refusals.evaluate(at(4), OpeningStage::Setting, 3, replies), RefusalAction::Nothing);
        assert_eq!(refusals.reopened(), 0);
    }
}
