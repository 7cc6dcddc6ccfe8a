//! Stimuli that wait for their epochs, by the protocol's rule. It is written apart from the cells' code, so that each
//! is a witness of the other.

use protocol::message::From;
use protocol::packet::Epoch;

/// As many stimuli as a cell lets wait.
pub const PENDING: usize = 8;

/// What waits for one cell, in the order in which it was said.
#[derive(Clone, Debug)]
pub struct Waiting<T>(Vec<(From, T)>);

impl<T> Default for Waiting<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Waiting<T> {
    /// Takes a stimulus, unless too many wait; `last` is the epoch of the last joints.
    pub fn push(&mut self, from: From, what: T, last: Option<Epoch>) {
        if self.0.len() < PENDING {
            self.0.push((if is_late(from, last) { From::Next } else { from }, what));
        }
    }

    /// Those that hold from the joints of this epoch on, the newest last; they wait no longer.
    pub fn latch(&mut self, epoch: Epoch) -> impl Iterator<Item = T> {
        let is_due = move |(from, _): &mut (From, T)| match from {
            From::Next => true,
            From::Epoch(first) => epoch.since(*first) >= 0,
        };
        self.0.extract_if(.., is_due).map(|(_, what)| what)
    }

    /// Nothing waits any more.
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// What waits, in the order in which it was said.
    pub fn iter(&self) -> impl Iterator<Item = &(From, T)> {
        self.0.iter()
    }

    /// Whether nothing waits.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

/// Whether the joints from which it was to hold have been: then it holds from the next ones on.
pub fn is_late(from: From, last: Option<Epoch>) -> bool {
    matches!((from, last), (From::Epoch(first), Some(last)) if last.since(first) >= 0)
}
