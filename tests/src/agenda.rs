//! What is to happen, in the order of time, on one clock that only moves when told to.

use std::collections::BTreeMap;

use protocol::time::{Micros, Span};

/// Events that are to come, and what time it is.
#[derive(Debug)]
pub(crate) struct Agenda<E> {
    pub(crate) now: Micros,
    /// By time, and of one time in the order in which they were entered; boxed, since a tree moves what it holds.
    events: BTreeMap<(Micros, u64), Box<E>>,
    entered: u64,
}

impl<E> Default for Agenda<E> {
    fn default() -> Self {
        Self { now: Micros(0), events: BTreeMap::new(), entered: 0 }
    }
}

impl<E> Agenda<E> {
    /// Something happens at a time; now, where that has passed.
    pub(crate) fn enter(&mut self, at: Micros, event: E) {
        self.entered += 1;
        self.events.insert((at.max(self.now), self.entered), Box::new(event));
    }

    /// Something happens in a while.
    pub(crate) fn enter_in(&mut self, span: Span, event: E) {
        self.enter(self.now + span, event);
    }

    /// When something happens next.
    pub(crate) fn next(&self) -> Option<Micros> {
        self.events.keys().next().map(|(at, _)| *at)
    }

    /// The next event up to a time, which it then is.
    pub(crate) fn take_until(&mut self, until: Micros) -> Option<E> {
        let entry = self.events.first_entry().filter(|entry| entry.key().0 <= until)?;
        let ((at, _), event) = entry.remove_entry();
        self.now = self.now.max(at);
        Some(*event)
    }
}
