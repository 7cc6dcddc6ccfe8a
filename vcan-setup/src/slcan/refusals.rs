//! Decides when an adapter that refuses lines is closed and opened again.

use std::time::Duration;

use super::incoming::AdapterReplies;
use super::options::OpeningStage;

/// The minimum time between two reopenings of an adapter. Each takes the adapter off its bus for a moment.
const MIN_REOPEN_PAUSE: Duration = Duration::from_secs(1);
/// The maximum time between two reopenings if they have no effect.
const MAX_REOPEN_PAUSE: Duration = Duration::from_secs(30);
/// The number of consecutive refusals after which an adapter that accepted lines before is reopened. Fewer are ignored,
/// because the queue of the adapter may be full for a moment.
const REFUSAL_THRESHOLD: u64 = 8;

/// The reaction to lines that an adapter refused.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum RefusalAction {
    /// Do nothing: no lines were refused, or the refusals are expected.
    Nothing,
    /// Report that the adapter refused a setup command.
    ReportSettings,
    /// Count this number of lines that an open adapter refused.
    Count(u64),
    /// Count this number of lines, and reopen the adapter, which was closed or reset.
    Reopen(u64),
}

/// The history of an adapter's refusals. It is updated with counts and times, and does no input or output.
#[derive(Debug)]
pub struct RefusalHistory {
    seen: u64,
    next: Duration,
    pause: Duration,
    reopened: u64,
}

impl RefusalHistory {
    /// Creates an empty history.
    #[must_use]
    pub const fn new() -> Self {
        Self { seen: 0, next: Duration::ZERO, pause: MIN_REOPEN_PAUSE, reopened: 0 }
    }

    /// Returns the number of times that the adapter was reopened.
    #[must_use]
    pub const fn reopen_count(&self) -> u64 {
        self.reopened
    }

    /// Evaluates the refusals so far. `bells` is their number since the start; `replies` are those since the adapter
    /// was opened.
    pub fn evaluate_refusals(
        &mut self,
        now: Duration,
        stage: OpeningStage,
        bells: u64,
        replies: AdapterReplies,
    ) -> RefusalAction {
        let more = bells - std::mem::replace(&mut self.seen, bells);
        if replies.accepted && replies.refusals == 0 {
            self.pause = MIN_REOPEN_PAUSE;
        }
        match stage {
            _ if more == 0 => RefusalAction::Nothing,
            // These refusals are answers to frames before the adapter was reopened, to an incomplete line, or to
            // closing an adapter that was closed already.
            OpeningStage::Away | OpeningStage::Closed => RefusalAction::Count(more),
            OpeningStage::Setting => RefusalAction::ReportSettings,
            OpeningStage::Open
                if now < self.next || (replies.accepted && replies.refusals < REFUSAL_THRESHOLD) =>
            {
                RefusalAction::Count(more)
            }
            OpeningStage::Open => {
                self.next = now + self.pause;
                self.pause = MAX_REOPEN_PAUSE.min(2 * self.pause);
                self.reopened += 1;
                RefusalAction::Reopen(more)
            }
        }
    }
}

impl Default for RefusalHistory {
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
        let mut refusals = RefusalHistory::new();
        let replies = |refusals| AdapterReplies { accepted: false, refusals };
        let mut times = Vec::new();
        for number in 1..=100_000 {
            if let RefusalAction::Reopen(1) =
                refusals.evaluate_refusals(at(number), OpeningStage::Open, number, replies(number))
            {
                times.push(number);
            }
        }
        assert_eq!(times, [1, 1_001, 3_001, 7_001, 15_001, 31_001, 61_001, 91_001]);
        assert_eq!(refusals.reopen_count(), 8);
        // Once the adapter has accepted a line, earlier refusals no longer count.
        refusals.evaluate_refusals(
            at(200_000),
            OpeningStage::Open,
            100_000,
            AdapterReplies { accepted: true, refusals: 0 },
        );
        for (now, expected) in [(200_001, true), (200_900, false), (201_001, true)] {
            let action = refusals.evaluate_refusals(at(now), OpeningStage::Open, 100_000 + now, replies(1));
            assert_eq!(matches!(action, RefusalAction::Reopen(_)), expected, "{now}");
        }
    }

    #[test]
    fn an_adapter_that_accepts_lines_is_not_opened_for_a_few_refusals() {
        let mut refusals = RefusalHistory::new();
        for refused in 1..=REFUSAL_THRESHOLD {
            let replies = AdapterReplies { accepted: true, refusals: refused };
            let expected =
                if refused < REFUSAL_THRESHOLD { RefusalAction::Count(1) } else { RefusalAction::Reopen(1) };
            assert_eq!(
                refusals.evaluate_refusals(at(refused), OpeningStage::Open, refused, replies),
                expected
            );
        }
        let accepted = AdapterReplies { accepted: true, refusals: 0 };
        assert_eq!(
            refusals.evaluate_refusals(at(9), OpeningStage::Open, REFUSAL_THRESHOLD, accepted),
            RefusalAction::Nothing
        );
    }

    #[test]
    fn refusals_while_it_is_opened_are_no_reason_to_open_it() {
        let mut refusals = RefusalHistory::new();
        let replies = AdapterReplies { accepted: false, refusals: 1 };
        assert_eq!(
            refusals.evaluate_refusals(at(1), OpeningStage::Away, 1, replies),
            RefusalAction::Count(1)
        );
        assert_eq!(
            refusals.evaluate_refusals(at(2), OpeningStage::Closed, 2, replies),
            RefusalAction::Count(1)
        );
        assert_eq!(
            refusals.evaluate_refusals(at(3), OpeningStage::Setting, 3, replies),
            RefusalAction::ReportSettings
        );
        assert_eq!(
            refusals.evaluate_refusals(at(4), OpeningStage::Setting, 3, replies),
            RefusalAction::Nothing
        );
        assert_eq!(refusals.reopen_count(), 0);
    }
}
