//! Timeouts and retry limits of requests that are repeated until they are confirmed.
//!
//! The caller keeps the pending requests, and asks this module which of them to send now. The module has no clock.

use std::collections::BTreeMap;

use protocol::time::{Micros, Span};

/// The retry limit and the timeouts of a request.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct RetryLimits {
    /// Timeout after the first transmission.
    pub first_timeout: Span,
    /// The longest timeout. The timeout doubles after each transmission.
    pub max_timeout: Span,
    /// Number of transmissions before the request fails.
    pub max_transmissions: u8,
}

/// The retry state of one request that has not been answered yet.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct RetryState {
    limits: RetryLimits,
    transmissions: u8,
    due: Micros,
}

/// The next action for a pending request.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum RetryAction {
    /// Wait: the timeout has not expired.
    Wait,
    /// Send the request again.
    Resend,
    /// Fail the request: the retry limit is reached.
    GiveUp,
}

impl RetryState {
    /// Starts the timeout of a request whose first transmission is at `now`.
    #[must_use]
    pub fn new(now: Micros, limits: RetryLimits) -> Self {
        Self { limits, transmissions: 1, due: now + limits.first_timeout }
    }

    /// Returns the number of transmissions so far.
    #[must_use]
    pub const fn transmissions(&self) -> u8 {
        self.transmissions
    }

    /// Returns the time at which the timeout expires and [`RetryState::handle_timeout`] must be called.
    #[must_use]
    pub const fn next_timeout(&self) -> Micros {
        self.due
    }

    /// Handles the timeout and returns the next action; [`RetryAction::Resend`] counts as a transmission. A call before
    /// the timeout has no effect.
    pub fn handle_timeout(&mut self, now: Micros) -> RetryAction {
        if now < self.due {
            return RetryAction::Wait;
        }
        if self.transmissions >= self.limits.max_transmissions {
            return RetryAction::GiveUp;
        }
        self.transmissions += 1;
        self.extend_timeout(now);
        RetryAction::Resend
    }

    /// Restarts the timeout, because one cell has answered and others may still answer.
    pub fn extend_timeout(&mut self, now: Micros) {
        let doubled = self.limits.first_timeout.0.saturating_mul(1 << (self.transmissions - 1).min(32));
        self.due = now + Span(doubled.min(self.limits.max_timeout.0));
    }
}

/// Requests to many cells that are repeated without a limit. Each is sent at most once per interval.
#[derive(Clone, Debug)]
pub struct RepeatedRequests<K> {
    interval: Span,
    /// Time of the last transmission of each request, and of the last message to all cells.
    sent: BTreeMap<K, Micros>,
    all_sent: Option<Micros>,
}

impl<K: Copy + Ord> RepeatedRequests<K> {
    /// Creates an empty set of requests with this repeat interval.
    #[must_use]
    pub const fn new(every: Span) -> Self {
        Self { interval: every, sent: BTreeMap::new(), all_sent: None }
    }

    /// Returns the requests among `open` whose interval has passed, and records them as sent.
    pub fn due_requests(&mut self, now: Micros, open: impl IntoIterator<Item = K>) -> Vec<K> {
        let last = |key: &K| self.sent.get(key).copied().max(self.all_sent);
        let is_due = |key: &K| last(key).is_none_or(|at| now.elapsed_since(at) >= self.interval);
        let due: Vec<_> = open.into_iter().filter(is_due).collect();
        self.sent.extend(due.iter().map(|key| (*key, now)));
        due
    }

    /// Records that one message to all cells contained all requests.
    pub const fn mark_all_sent(&mut self, now: Micros) {
        self.all_sent = Some(now);
    }

    /// Lets a changed request be sent without waiting for its interval.
    pub fn make_request_due(&mut self, key: K) {
        self.sent.remove(&key);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: RetryLimits =
        RetryLimits { first_timeout: Span(100), max_timeout: Span(300), max_transmissions: 4 };

    #[test]
    fn an_attempt_waits_twice_as_long_each_time_up_to_a_limit_and_then_gives_up() {
        let mut attempt = RetryState::new(Micros(0), LIMITS);
        for due in [100, 300, 600] {
            assert_eq!(
                (attempt.next_timeout(), attempt.handle_timeout(Micros(due - 1))),
                (Micros(due), RetryAction::Wait)
            );
            assert_eq!(attempt.handle_timeout(Micros(due)), RetryAction::Resend);
        }
        assert_eq!((attempt.transmissions(), attempt.next_timeout()), (4, Micros(900)));
        attempt.extend_timeout(Micros(800));
        assert_eq!(
            (attempt.handle_timeout(Micros(1_099)), attempt.handle_timeout(Micros(1_100))),
            (RetryAction::Wait, RetryAction::GiveUp)
        );
    }

    #[test]
    fn an_open_request_is_due_at_once_and_then_once_per_interval() {
        let mut repeats = RepeatedRequests::<u8>::new(Span(100));
        assert_eq!(repeats.due_requests(Micros(0), [1, 2]), [1, 2]);
        assert_eq!(repeats.due_requests(Micros(99), [1, 2, 3]), [3]);
        assert_eq!(repeats.due_requests(Micros(100), [2, 3]), [2]);
        repeats.mark_all_sent(Micros(200));
        assert!(repeats.due_requests(Micros(299), [1, 2, 3, 4]).is_empty());
        assert_eq!(repeats.due_requests(Micros(300), [1, 4]), [1, 4]);
        repeats.make_request_due(4);
        assert_eq!(repeats.due_requests(Micros(301), [1, 4]), [4], "it has changed");
    }
}
