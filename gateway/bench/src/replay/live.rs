//! The player's stage in a real replay, with the machine's clock and open buses.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use protocol::bus::{BusError, SendError};
use protocol::can::Frame;
use protocol::message::{Message, State as Flags};
use protocol::packet::Epoch;

use super::player::{PlayerBackend, ReplaySpeed};
use super::replay_plan::AwaitedJoints;
use super::report::LockstepResult;
use super::shared_state::SharedState;
use super::start::{ReplayBus, mode_message};
use super::{ReplayError, ReplayOptions};
use crate::bus::realtime;
use crate::setup::format_as_subject;

/// Interval in ns between checks of the stop flag.
const STOP_POLL_INTERVAL_NS: u64 = 100_000_000;
/// Pause while the queue of steps is empty.
const EMPTY_QUEUE_PAUSE: Duration = Duration::from_micros(100);
const BUS_DOWN_PAUSE: Duration = Duration::from_millis(50);
/// Time without any answer after which cells are queried again, because a frame may have been lost. After
/// [`ANSWER_TIMEOUT`] they are given up.
const RESYNC_INTERVAL: Duration = Duration::from_millis(500);
const ANSWER_TIMEOUT: Duration = Duration::from_secs(3);
/// Maximum number of times that joints are resent when cells processed them too late to answer.
const MAX_RESENDS: u32 = 16;
/// Maximum number of times that joints are resent on a bus on which resending did not help the last time. The cells are
/// then probably not late but absent.
const MAX_RESENDS_AFTER_FAILURE: u32 = 2;
/// Time to wait for answers to resent joints, before cells must also send a heartbeat.
const FIRST_ANSWER_WAIT: Duration = Duration::from_millis(100);
/// Maximum factor by which the wait for answers is extended from try to try.
const MAX_ANSWER_WAIT_FACTOR: u32 = 4;

/// The player's stage in a real replay.
#[derive(Debug)]
pub(super) struct LiveBackend {
    pub(super) bus_links: Arc<Vec<ReplayBus>>,
    pub(super) shared_state: Arc<SharedState>,
    /// Messages for the user.
    pub(super) log_sender: Sender<String>,
    /// Counts of cells that did not answer, and of joints that were resent.
    pub(super) lockstep: LockstepResult,
    /// Buses on which resending did not help the last time.
    pub(super) resend_failed: BTreeSet<usize>,
    pub(super) down: BTreeSet<usize>,
}

impl PlayerBackend for LiveBackend {
    fn now_ns(&self) -> u64 {
        realtime::monotonic_ns()
    }

    fn wait_until(&mut self, at: u64) {
        let asleep = at.saturating_sub(
            u64::try_from(self.shared_state.checks.options.spin.as_nanos()).unwrap_or(u64::MAX),
        );
        while !self.shared_state.is_over() {
            let now = realtime::monotonic_ns();
            if now >= asleep {
                break;
            }
            realtime::sleep_until(asleep.min(now + STOP_POLL_INTERVAL_NS));
        }
        while realtime::monotonic_ns() < at && !self.shared_state.is_over() {
            core::hint::spin_loop();
        }
    }

    fn pause(&mut self) {
        std::thread::sleep(EMPTY_QUEUE_PAUSE);
    }

    fn is_over(&self) -> bool {
        self.shared_state.is_over()
    }

    fn announce_joints(&mut self, bus_index: usize, round: Option<u64>, epoch: Epoch) {
        self.shared_state.comparator().announce_joints(bus_index, round, epoch);
    }

    fn send(&mut self, index: usize, frames: &[Frame]) -> Result<(), SendError> {
        let Some(bus_link) = self.bus_links.get(index) else { return Ok(()) };
        let sent = bus_link.bus.send(frames);
        let taken = sent.as_ref().map_or_else(|error| error.sent, |()| frames.len());
        self.shared_state.sent.fetch_add(taken as u64, Ordering::Relaxed);
        if taken > 0 && self.down.remove(&index) {
            self.notify(format!("{} works again", bus_link.bus.name()));
        }
        if let Err(SendError { cause: error @ BusError::Down(_), .. }) = &sent {
            if self.down.insert(index) {
                self.shared_state.comparator().mark_down(index);
                self.notify(format!(
                    "{error}; until the bus works again, its frames are not sent, only counted as lost"
                ));
            }
            // At a timed pace, waiting for answers would delay the next frames.
            let ReplayOptions { pace, lockstep, .. } = self.shared_state.checks.options;
            if pace == ReplaySpeed::Max || lockstep {
                std::thread::sleep(BUS_DOWN_PAUSE);
            }
        }
        sent
    }

    fn mark_round_unsent(&mut self, bus_index: usize, round: u64) {
        self.shared_state.comparator().mark_unsent(bus_index, round);
    }

    fn wait_for_answers(&mut self, bus_index: usize, open: &AwaitedJoints) {
        self.wait_until_processed(bus_index);
        let Some(round) = open.round.filter(|_| self.shared_state.checks.options.expect.is_some()) else {
            return;
        };
        // On a slow machine, a cell skips joints that it processes more than one period late, and does not answer them.
        // Such joints are resent under the epoch before, and then under their own epoch. The sync follows later,
        // because on such a machine the heartbeats of some cells delay others.
        let tries =
            if self.resend_failed.contains(&bus_index) { MAX_RESENDS_AFTER_FAILURE } else { MAX_RESENDS };
        for again in 0.. {
            if self.shared_state.is_over() {
                return;
            }
            if self.shared_state.comparator().missing_reply_count(bus_index, round) == 0 {
                if again > 0 {
                    self.resend_failed.remove(&bus_index);
                }
                return;
            }
            if again == tries {
                self.resend_failed.insert(bus_index);
                return;
            }
            let epoch = if again % 2 == 0 { open.epoch.advanced_by(u8::MAX) } else { open.epoch };
            self.lockstep.retried += 1;
            self.shared_state.comparator().announce_joints(bus_index, Some(round), epoch);
            let joints = Message::Joints { epoch, joints: open.joints };
            if self.send_messages(bus_index, &[joints]).is_err() {
                return;
            }
            let give_up = Instant::now() + FIRST_ANSWER_WAIT * (again + 1).min(MAX_ANSWER_WAIT_FACTOR);
            let mut comparator = self.shared_state.comparator();
            while comparator.missing_reply_count(bus_index, round) > 0
                && Instant::now() < give_up
                && !self.shared_state.is_over()
            {
                comparator = self.shared_state.wait_for_message(comparator, Duration::from_millis(5));
            }
            drop(comparator);
            if self.send_messages(bus_index, &[Message::Sync]).is_err() {
                return;
            }
            self.wait_until_processed(bus_index);
        }
    }

    fn restore_latched_state(&mut self, states: &[(usize, Vec<Message>)]) -> Result<(), ReplayError> {
        for (bus_link, messages) in states {
            self.send_and_wait(*bus_link, &[Message::Sync])?;
            self.shared_state.comparator().set_muted(true);
            let mut all = self.contact_reset_messages(*bus_link);
            all.extend_from_slice(messages);
            for message in &all {
                if let Message::Joints { epoch, .. } = *message {
                    self.shared_state.comparator().announce_joints(*bus_link, None, epoch);
                }
                self.send_messages(*bus_link, core::slice::from_ref(message))?;
            }
            self.send_and_wait(*bus_link, &[Message::Sync])?;
            self.shared_state.comparator().set_muted(false);
        }
        // A cell without processor time may answer the sync with a heartbeat from before its commit.
        let give_up = Instant::now() + ANSWER_TIMEOUT;
        loop {
            let checked = self.shared_state.checks.check_hashes(&self.shared_state.comparator());
            let Err(mismatch) = checked else { return Ok(()) };
            if states.is_empty() || Instant::now() > give_up || self.shared_state.is_over() {
                return Err(mismatch.into());
            }
            for (bus_link, _) in states {
                self.send_and_wait(*bus_link, &[Message::Sync])?;
            }
        }
    }

    fn show_position(&mut self, at: u64) {
        self.shared_state.at.store(at, Ordering::Relaxed);
    }
}

impl LiveBackend {
    /// Returns the messages that reset the contact state of those cells on a bus that are in test mode.
    fn contact_reset_messages(&self, bus_index: usize) -> Vec<Message> {
        let comparator = self.shared_state.comparator();
        let obeying =
            comparator.settled_cells(bus_index).filter(|(_, cell)| cell.claim.has_state(Flags::TEST_MODE));
        obeying.map(|(cell, _)| mode_message(cell, true)).collect()
    }

    fn send_messages(&self, bus_index: usize, messages: &[Message]) -> Result<(), BusError> {
        self.bus_links.get(bus_index).map_or(Ok(()), |bus_link| bus_link.send(messages))
    }

    /// Sends a message for the user; at the end of the replay the receiver is gone.
    fn notify(&self, text: String) {
        let _ = self.log_sender.send(text);
    }

    /// Sends `last` on a bus, and waits until its cells have processed all messages sent so far.
    fn send_and_wait(&mut self, bus_index: usize, last: &[Message]) -> Result<(), BusError> {
        self.shared_state.comparator().announce_sync(bus_index);
        self.send_messages(bus_index, last)?;
        self.wait_until_processed(bus_index);
        Ok(())
    }

    /// Requests the counters of the cells on a bus, and waits for them.
    pub(super) fn request_counters(&mut self, bus_index: usize) -> Result<(), BusError> {
        self.send_and_wait(bus_index, &[Message::Report, Message::Sync])
    }

    fn wait_until_processed(&mut self, bus_index: usize) {
        let (mut done, mut progress, mut reminded) = (0, Instant::now(), Instant::now());
        let mut comparator = self.shared_state.comparator();
        while !comparator.are_joints_processed(bus_index) && !self.shared_state.is_over() {
            let now = comparator.processed_cell_count(bus_index);
            if now != done {
                (done, progress, reminded) = (now, Instant::now(), Instant::now());
            }
            if reminded.elapsed() > RESYNC_INTERVAL {
                reminded = Instant::now();
                // If the bus refuses messages, the next frame reports it.
                let _ = self.send_messages(bus_index, &[Message::Sync]);
            }
            if progress.elapsed() > ANSWER_TIMEOUT {
                let late = comparator.time_out_cells(bus_index);
                let name = self.shared_state.checks.bus_name(bus_index);
                self.lockstep.silent_cells.extend(late.iter().map(|cell| format!("{cell} on {name}")));
                let verb = if late.len() == 1 { "does" } else { "do" };
                self.notify(format!(
                    "{} {verb} not answer within {} s: the replay continues",
                    format_as_subject(&late, &format!(" on {name}")),
                    ANSWER_TIMEOUT.as_secs()
                ));
                return;
            }
            comparator = self.shared_state.wait_for_message(comparator, Duration::from_millis(20));
        }
    }
}
