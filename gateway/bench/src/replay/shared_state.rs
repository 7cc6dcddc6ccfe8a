//! State shared by the sending thread and the receivers.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use protocol::time::Micros;

use super::checks::CellChecks;
use super::comparator::Comparator;
use super::start::ReplayBus;
use crate::bus::follow::{FollowStep, FollowedItem, Follower, NeverReopenedBus};
use crate::bus::realtime;
use crate::bus::roots::RootWires;
use model::decode::{Decoded, Decoder};

/// Interval between readings of the stop flag.
const POLL_INTERVAL: Duration = Duration::from_millis(50);
/// State shared by all threads of a replay.
#[derive(Debug)]
pub(super) struct SharedState {
    pub(super) checks: CellChecks,
    comparator: Mutex<Comparator>,
    message_arrived: Condvar,
    /// Set once, to stop sending.
    pub(super) stop_sending: AtomicBool,
    /// Set when the queue of steps is full for the first time, or when the whole capture has been read.
    pub(super) ready: AtomicBool,
    /// Set once at the end, to stop receiving.
    pub(super) stop_receiving: AtomicBool,
    /// Number of frames sent, for the progress line.
    pub(super) sent: AtomicU64,
    /// Position of the replay in ns after its first frame.
    pub(super) at: AtomicU64,
}

impl SharedState {
    pub(super) fn new(checks: CellChecks) -> Self {
        let named_cells = checks.named_buses().map(|(name, bus)| (name.to_owned(), bus.cells.clone()));
        let comparator =
            Comparator::new(named_cells, checks.survey.first.unwrap_or(0), checks.options.expect);
        Self {
            checks,
            comparator: Mutex::new(comparator),
            message_arrived: Condvar::new(),
            stop_sending: AtomicBool::new(false),
            ready: AtomicBool::new(false),
            stop_receiving: AtomicBool::new(false),
            sent: AtomicU64::new(0),
            at: AtomicU64::new(0),
        }
    }

    pub(super) fn comparator(&self) -> MutexGuard<'_, Comparator> {
        // A panic in another thread ends the replay anyway.
        self.comparator.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Wakes the threads that wait for an answer.
    pub(super) fn notify_waiting(&self) {
        self.message_arrived.notify_all();
    }

    /// Waits until a message arrives, at most for `time`.
    pub(super) fn wait_for_message<'a>(
        &self,
        comparator: MutexGuard<'a, Comparator>,
        time: Duration,
    ) -> MutexGuard<'a, Comparator> {
        let waited = self.message_arrived.wait_timeout(comparator, time);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }

    pub(super) fn is_over(&self) -> bool {
        self.stop_sending.load(Ordering::Relaxed)
    }

    /// Marks a bus as down and wakes waiting threads.
    pub(super) fn mark_down(&self, bus_index: usize) {
        self.comparator().mark_down(bus_index);
        self.notify_waiting();
    }

    /// Receives on a bus until the end of the replay, and acts as the gateway's side of the wires to the roots. Returns
    /// the number of frames lost because they arrived faster than they were read.
    pub(super) fn receive_until_end(
        &self,
        index: usize,
        bus_link: &ReplayBus,
        mut roots: Option<RootWires>,
    ) -> u64 {
        realtime::prepare_receiver();
        let mut decoder = Decoder::new(Some(bus_link.format));
        // Start the wires at once: the cells may be present already, and cells that start build their tree at once.
        roots.iter_mut().for_each(RootWires::start_sending);
        let (mut follower, mut end) = (Follower::new(roots, Duration::ZERO), NeverReopenedBus(&bus_link.bus));
        while !self.stop_receiving.load(Ordering::Relaxed) {
            match follower.step(&mut end, POLL_INTERVAL) {
                FollowStep::Nothing | FollowStep::Drained | FollowStep::Refused(_) => continue,
                FollowStep::Frames(_) | FollowStep::Leftover(_) => {}
                FollowStep::Down(_) => {
                    self.mark_down(index);
                    continue;
                }
                FollowStep::Gone(_) => {
                    self.mark_down(index);
                    // The next thread that sends on this bus gets the same error, and reports it.
                    break;
                }
            }
            let mut comparator = self.comparator();
            follower.for_each_item(|part| {
                let FollowedItem::Frame(received) = part else { return };
                let at = Micros(received.at_nanos / 1_000);
                if !received.own
                    && let Decoded::Message(message) =
                        decoder.decode(at, bus_link.bus.name(), &received.frame)
                {
                    comparator.observe_message(index, &message);
                }
            });
            drop(comparator);
            self.notify_waiting();
        }
        follower.dropped_frames()
    }
}
