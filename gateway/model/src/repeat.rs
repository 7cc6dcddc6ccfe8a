//! Requests that are repeated until they are confirmed: when each is due again, and when it fails.
//!
//! The caller knows which requests are open, and asks here which of them to send now. Nothing here has a clock.

use std::collections::BTreeMap;

use protocol::time::{Micros, Span};

/// The retry limit and the timeouts of a request.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Limits {
    /// Timeout after the first time.
    pub first: Span,
    /// The longest timeout; it doubles after each time.
    pub longest: Span,
    /// How often it is sent before it fails.
    pub tries: u8,
}

/// A request without an answer yet.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Attempt {
    limits: Limits,
    tries: u8,
    due: Micros,
}

/// What to do with a request now.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Turn {
    /// Nothing yet.
    Wait,
    /// Send it again.
    Again,
    /// The retry limit is reached.
    GiveUp,
}

impl Attempt {
    /// It is sent for the first time now.
    #[must_use]
    pub fn new(now: Micros, limits: Limits) -> Self {
        Self { limits, tries: 1, due: now + limits.first }
    }

    /// How often it was sent.
    #[must_use]
    pub const fn tries(&self) -> u8 {
        self.tries
    }

    /// When [`Attempt::turn`] is due.
    #[must_use]
    pub const fn due(&self) -> Micros {
        self.due
    }

    /// Handles the timeout; after [`Turn::Again`] it counts as sent again. Harmless when called early.
    pub fn turn(&mut self, now: Micros) -> Turn {
        if now < self.due {
            return Turn::Wait;
        }
        if self.tries >= self.limits.tries {
            return Turn::GiveUp;
        }
        self.tries += 1;
        self.extend(now);
        Turn::Again
    }

    /// Restarts the timeout: a cell has answered, so others may still do.
    pub fn extend(&mut self, now: Micros) {
        let doubled = self.limits.first.0.saturating_mul(1 << (self.tries - 1).min(32));
        self.due = now + Span(doubled.min(self.limits.longest.0));
    }
}

/// Requests to many that are repeated without end, each at most so often.
#[derive(Clone, Debug)]
pub struct Repeats<K> {
    every: Span,
    /// When each was sent last, and when all were at once.
    sent: BTreeMap<K, Micros>,
    all: Option<Micros>,
}

impl<K: Copy + Ord> Repeats<K> {
    /// None was sent yet.
    #[must_use]
    pub const fn new(every: Span) -> Self {
        Self { every, sent: BTreeMap::new(), all: None }
    }

    /// Of the `open` requests, those to send now; they count as sent.
    pub fn due(&mut self, now: Micros, open: impl IntoIterator<Item = K>) -> Vec<K> {
        let last = |key: &K| self.sent.get(key).copied().max(self.all);
        let is_due = |key: &K| last(key).is_none_or(|at| now.since(at) >= self.every);
        let due: Vec<_> = open.into_iter().filter(is_due).collect();
        self.sent.extend(due.iter().map(|key| (*key, now)));
        due
    }

    /// All were sent at once, to everyone.
    pub const fn said_to_all(&mut self, now: Micros) {
        self.all = Some(now);
    }

    /// The request has changed: it is due at once.
    pub fn renew(&mut self, key: K) {
        self.sent.remove(&key);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits { first: Span(100), longest: Span(300), tries: 4 };

    #[test]
    fn an_attempt_waits_twice_as_long_each_time_up_to_a_limit_and_then_gives_up() {
        let mut attempt = Attempt::new(Micros(0), LIMITS);
        for due in [100, 300, 600] {
            assert_eq!((attempt.due(), attempt.turn(Micros(due - 1))), (Micros(due), Turn::Wait));
            assert_eq!(attempt.turn(Micros(due)), Turn::Again);
        }
        assert_eq!((attempt.tries(), attempt.due()), (4, Micros(900)));
        attempt.extend(Micros(800));
        assert_eq!((attempt.turn(Micros(1_099)), attempt.turn(Micros(1_100))), (Turn::Wait, Turn::GiveUp));
    }

    #[test]
    fn an_open_request_is_due_at_once_and_then_once_per_interval() {
        let mut repeats = Repeats::<u8>::new(Span(100));
        assert_eq!(repeats.due(Micros(0), [1, 2]), [1, 2]);
        assert_eq!(repeats.due(Micros(99), [1, 2, 3]), [3]);
        assert_eq!(repeats.due(Micros(100), [2, 3]), [2]);
        repeats.said_to_all(Micros(200));
        assert!(repeats.due(Micros(299), [1, 2, 3, 4]).is_empty());
        assert_eq!(repeats.due(Micros(300), [1, 4]), [1, 4]);
        repeats.renew(4);
        assert_eq!(repeats.due(Micros(301), [1, 4]), [4], "it has changed");
    }
}
