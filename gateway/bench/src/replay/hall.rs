//! Where those who send and those who hear meet.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::judge::Judge;

/// What all threads of a replay look at.
#[derive(Debug)]
pub(super) struct Hall {
    judge: Mutex<Judge>,
    heard: Condvar,
    /// Set once: sending ends.
    pub(super) over: AtomicBool,
    /// Set once, at the end: hearing ends.
    pub(super) deaf: AtomicBool,
    /// Frames sent, for people.
    pub(super) sent: AtomicU64,
    /// Where the replay is, in ns after its first frame.
    pub(super) at: AtomicU64,
}

impl Hall {
    pub(super) const fn new(judge: Judge) -> Self {
        Self {
            judge: Mutex::new(judge),
            heard: Condvar::new(),
            over: AtomicBool::new(false),
            deaf: AtomicBool::new(false),
            sent: AtomicU64::new(0),
            at: AtomicU64::new(0),
        }
    }

    pub(super) fn judge(&self) -> MutexGuard<'_, Judge> {
        // Who panics here ends the replay anyway.
        self.judge.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets those look who wait for an answer.
    pub(super) fn has_heard(&self) {
        self.heard.notify_all();
    }

    /// Waits until somebody has been heard, or a moment.
    pub(super) fn wait<'a>(&self, judge: MutexGuard<'a, Judge>, time: Duration) -> MutexGuard<'a, Judge> {
        let waited = self.heard.wait_timeout(judge, time);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }

    pub(super) fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }
}

/// What threads have to say to people.
#[derive(Clone, Debug)]
pub(super) struct Voice(pub(super) Sender<String>);

impl Voice {
    pub(super) fn say(&self, text: String) {
        // Nobody listens any more at the end.
        let _ = self.0.send(text);
    }
}
