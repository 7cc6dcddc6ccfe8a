//! Future events in the order of time, on a simulated clock.

use std::collections::BTreeMap;

use protocol::time::{Micros, Span};

/// A queue of future events, with the current time of the simulated clock.
#[derive(Debug)]
pub(crate) struct Agenda<E> {
    pub(crate) now: Micros,
    /// The events by time, then by the order in which they were entered; boxed, because a tree moves its values.
    events: BTreeMap<(Micros, u64), Box<E>>,
    entered: u64,
}

impl<E> Default for Agenda<E> {
    fn default() -> Self {
        Self { now: Micros(0), events: BTreeMap::new(), entered: 0 }
    }
}

impl<E> Agenda<E> {
    /// Enters an event at a time, or at the current time if that has passed.
    pub(crate) fn enter(&mut self, at: Micros, event: E) {
        self.entered += 1;
        self.events.insert((at.max(self.now), self.entered), Box::new(event));
    }

    /// Enters an event after a delay.
    pub(crate) fn enter_in(&mut self, span: Span, event: E) {
        self.enter(self.now + span, event);
    }

    /// Returns the time of the next event.
    pub(crate) fn next(&self) -> Option<Micros> {
        self.events.keys().next().map(|(at, _)| *at)
    }

    /// Removes and returns the next event if its time is at most `until`, and advances the clock to that event.
    pub(crate) fn take_until(&mut self, until: Micros) -> Option<E> {
        let entry = self.events.first_entry().filter(|entry| entry.key().0 <= until)?;
        let ((at, _), event) = entry.remove_entry();
        self.now = self.now.max(at);
        Some(*event)
    }
}
