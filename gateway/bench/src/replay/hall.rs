//! Where those who send and those who hear meet.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use protocol::bus::Inbox;
use protocol::time::Micros;

use super::checks::Checks;
use super::judge::Judge;
use super::start::Lane;
use crate::run::realtime;
use crate::run::roots::Roots;
use model::decode::{Decoded, Decoder};

/// How often it is looked whether to go on.
const LOOK: Duration = Duration::from_millis(50);
/// The pause while an interface is down.
const DOWN: Duration = Duration::from_millis(20);

/// What all threads of a replay look at.
#[derive(Debug)]
pub(super) struct Hall {
    pub(super) checks: Checks,
    judge: Mutex<Judge>,
    heard: Condvar,
    /// Set once: sending ends.
    pub(super) over: AtomicBool,
    /// Set when the queue of steps is full for the first time, or all has been read.
    pub(super) ready: AtomicBool,
    /// Set once, at the end: hearing ends.
    pub(super) deaf: AtomicBool,
    /// Frames sent, for people.
    pub(super) sent: AtomicU64,
    /// Where the replay is, in ns after its first frame.
    pub(super) at: AtomicU64,
}

impl Hall {
    pub(super) fn new(checks: Checks) -> Self {
        let judged = checks.lanes().map(|(name, bus)| (name.to_owned(), bus.cells.clone()));
        let judge = Judge::new(judged, checks.survey.first.unwrap_or(0), checks.options.expect);
        Self {
            checks,
            judge: Mutex::new(judge),
            heard: Condvar::new(),
            over: AtomicBool::new(false),
            ready: AtomicBool::new(false),
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

    /// Takes in that a bus is down.
    pub(super) fn is_down(&self, lane: usize) {
        self.judge().is_down(lane);
        self.has_heard();
    }

    /// Hears a bus until it is over, and is the gateway's side of its roots' wires; returns how many frames came faster
    /// than they were heard.
    pub(super) fn hear(&self, index: usize, lane: &Lane, mut roots: Option<Roots>) -> u64 {
        realtime::prepare_receiver();
        let (bus, mut inbox, mut decoder) = (&lane.bus, Inbox::new(), Decoder::new(Some(lane.format)));
        // Its cells may be there already, and organise themselves as they come.
        roots.iter_mut().for_each(Roots::explore);
        while !self.deaf.load(Ordering::Relaxed) {
            if let Some(roots) = &mut roots {
                roots.speak(bus);
            }
            let patience = roots.as_ref().map_or(LOOK, |roots| LOOK.min(roots.patience()));
            match bus
                .wait(Some(patience))
                .and_then(|ready| if ready { bus.receive(&mut inbox) } else { Ok(0) })
            {
                Ok(0) => continue,
                Ok(_) => {}
                Err(error) => {
                    self.is_down(index);
                    if !error.may_pass() {
                        // Whoever sends next hears it too, and says so.
                        break;
                    }
                    thread::sleep(DOWN);
                    continue;
                }
            }
            let mut judge = self.judge();
            for received in inbox.frames().filter(|received| !received.own) {
                if roots.as_mut().is_some_and(|roots| roots.take(&received.frame)) {
                    continue;
                }
                let at = Micros(received.at_nanos / 1_000);
                if let Decoded::Message(message) = decoder.decode(at, bus.name(), &received.frame) {
                    judge.hear(index, &message);
                }
            }
            drop(judge);
            self.has_heard();
        }
        inbox.dropped().into()
    }
}
