//! Requests that are repeated until they are confirmed: when each is due again, and when it is given up.
//!
//! Whoever asks knows what is still open, and looks here for what of it is to be said now. Nothing here has a clock.

use std::collections::BTreeMap;

use protocol::time::{Micros, Span};

/// How often something is said, and how long an answer may take.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Limits {
    /// After the first time.
    pub first: Span,
    /// At most, when it doubles after each time.
    pub longest: Span,
    /// How often it is said before it is given up.
    pub tries: u8,
}

/// A request whose answer is awaited.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Attempt {
    limits: Limits,
    tries: u8,
    due: Micros,
}

/// What time asks for.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Turn {
    /// Nothing yet.
    Wait,
    /// It is to be said again.
    Again,
    /// It was said often enough.
    GiveUp,
}

impl Attempt {
    /// It is said for the first time now.
    #[must_use]
    pub fn new(now: Micros, limits: Limits) -> Self {
        Self { limits, tries: 1, due: now + limits.first }
    }

    /// How often it was said.
    #[must_use]
    pub const fn tries(&self) -> u8 {
        self.tries
    }

    /// When [`Attempt::turn`] asks for something.
    #[must_use]
    pub const fn due(&self) -> Micros {
        self.due
    }

    /// Takes in that time has passed; what is to be said again is taken for said. Harmless when called early.
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

    /// Others may take as long from now on, for somebody has answered.
    pub fn extend(&mut self, now: Micros) {
        let doubled = self.limits.first.0.saturating_mul(1 << (self.tries - 1).min(32));
        self.due = now + Span(doubled.min(self.limits.longest.0));
    }
}

/// Requests to many that are repeated without end, each at most so often.
#[derive(Clone, Debug)]
pub struct Repeats<K> {
    every: Span,
    /// When each was said last, and when all were at once.
    said: BTreeMap<K, Micros>,
    all: Option<Micros>,
}

impl<K: Copy + Ord> Repeats<K> {
    /// None was said yet.
    #[must_use]
    pub const fn new(every: Span) -> Self {
        Self { every, said: BTreeMap::new(), all: None }
    }

    /// Of those that are not confirmed, what is to be said now; it is taken for said.
    pub fn due(&mut self, now: Micros, open: impl IntoIterator<Item = K>) -> Vec<K> {
        let last = |key: &K| self.said.get(key).copied().max(self.all);
        let is_due = |key: &K| last(key).is_none_or(|at| now.since(at) >= self.every);
        let due: Vec<_> = open.into_iter().filter(is_due).collect();
        self.said.extend(due.iter().map(|key| (*key, now)));
        due
    }

    /// All were said at once, to everyone.
    pub const fn said_to_all(&mut self, now: Micros) {
        self.all = Some(now);
    }

    /// One is another than it was: it is due at once.
    pub fn renew(&mut self, key: K) {
        self.said.remove(&key);
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
    fn who_has_not_confirmed_is_due_at_first_and_then_at_most_so_often() {
        let mut repeats = Repeats::<u8>::new(Span(100));
        assert_eq!(repeats.due(Micros(0), [1, 2]), [1, 2]);
        assert_eq!(repeats.due(Micros(99), [1, 2, 3]), [3]);
        assert_eq!(repeats.due(Micros(100), [2, 3]), [2]);
        repeats.said_to_all(Micros(200));
        assert!(repeats.due(Micros(299), [1, 2, 3, 4]).is_empty());
        assert_eq!(repeats.due(Micros(300), [1, 4]), [1, 4]);
        repeats.renew(4);
        assert_eq!(repeats.due(Micros(301), [1, 4]), [4], "it is another now");
    }
}
