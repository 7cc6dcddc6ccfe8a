//! The player, which sends each step when it is due.
//!
//! ```text
//!   steps ──> [ Player ] ──> frames due together, bus by bus ──> stage
//! ```
//!
//! The stage provides the clock and the buses; tests use variables for both.

use hdrhistogram::Histogram;
use protocol::bus::batch::MAX_BATCH_DATAGRAMS;
use protocol::bus::{BusError, SendError};
use protocol::can::Frame;
use protocol::message::Message;
use protocol::packet::Epoch;
use serde::Serialize;

use super::ReplayError;
use super::replay_plan::{AwaitedJoints, DueFrame, FrameRole, PlayerStep};
use protocol::quantiles::histogram;

/// Time in ns from the decision to start to the first frame.
const START_DELAY_NS: u64 = 1_000_000;

/// Interface of a player to its clock, its buses and its output.
pub trait PlayerBackend {
    /// Monotonic clock in ns.
    fn now_ns(&self) -> u64;
    /// Waits until the clock reads `at`, or the replay is stopped.
    fn wait_until(&mut self, at: u64);
    /// Pauses briefly, because the queue of steps is empty and more steps will come.
    fn pause(&mut self);
    /// Returns true if the replay was stopped.
    fn is_over(&self) -> bool;
    /// Tells the comparison that joints are about to be sent.
    fn announce_joints(&mut self, bus_index: usize, round: Option<u64>, epoch: Epoch);
    /// Sends frames; waits for room up to the timeout.
    ///
    /// # Errors
    /// Returns [`SendError`] if the bus stays full, is down or has ended.
    fn send(&mut self, bus_index: usize, frames: &[Frame]) -> Result<(), SendError>;
    /// Tells the comparison that a bus refused the joints of a round.
    fn mark_round_unsent(&mut self, bus_index: usize, round: u64);
    /// Waits until the cells of a bus have answered.
    fn wait_for_answers(&mut self, bus_link: usize, open: &AwaitedJoints);
    /// Restores a latched state on each bus.
    ///
    /// # Errors
    /// Returns [`ReplayError`] if the cells then differ from the recording, or a bus has ended.
    fn restore_latched_state(&mut self, states: &[(usize, Vec<Message>)]) -> Result<(), ReplayError>;
    /// Shows the position of the replay, in ns after its first frame.
    fn show_position(&mut self, at: u64);
}

/// Speed at which a capture is replayed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ReplaySpeed {
    /// The capture's own times divided by this factor.
    Timed(f64),
    /// As fast as the bus accepts frames.
    Max,
}

/// Counts of the frames that were to be sent on one bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct BusTally {
    /// Frames that the bus accepted.
    pub sent: u64,
    /// Frames refused because the bus stayed full.
    pub refused: u64,
    /// Frames refused because the bus was down.
    pub lost: u64,
    /// Number of times that the bus went down.
    pub outages: u64,
}

/// Result of playing a capture.
#[derive(Debug)]
pub struct PlayerResult {
    /// Counts of each bus.
    pub bus_links: Vec<BusTally>,
    /// Lateness of the frames in ns. Frames that were to be sent at once are not included.
    pub late: Histogram<u64>,
    /// True if the replay was stopped before its end.
    pub was_stopped: bool,
    /// Error that ended the replay, if any.
    pub failure: Option<ReplayError>,
}

/// Sends the steps of a replay.
#[derive(Debug)]
pub struct Player {
    pace: ReplaySpeed,
    /// Frames of a sync message for each bus; `None` unless the replay is in lockstep.
    syncs: Option<Vec<Vec<Frame>>>,
    /// Joints of each bus whose answers are awaited.
    open: Vec<Option<AwaitedJoints>>,
    down: Vec<bool>,
    /// A time of the clock and the time of the capture that corresponds to it, both in ns.
    origin: Option<(u64, u64)>,
    played: PlayerResult,
    batch: Vec<Frame>,
    /// Position in the batch and round of each joint packet in the batch.
    rounds: Vec<(usize, u64)>,
}

impl Player {
    /// Creates a player for `bus_links` buses. `syncs` holds the frames of a sync on each bus if joints must wait for
    /// all answers.
    #[must_use]
    pub fn new(bus_links: usize, pace: ReplaySpeed, syncs: Option<Vec<Vec<Frame>>>) -> Self {
        Self {
            pace,
            syncs,
            open: vec![None; bus_links],
            down: vec![false; bus_links],
            origin: None,
            played: PlayerResult {
                bus_links: vec![BusTally::default(); bus_links],
                late: histogram(),
                was_stopped: false,
                failure: None,
            },
            batch: Vec::with_capacity(MAX_BATCH_DATAGRAMS),
            rounds: Vec::with_capacity(MAX_BATCH_DATAGRAMS),
        }
    }

    /// Sends all steps until the end, a stop, or the end of a bus.
    pub fn play(
        mut self,
        steps: &mut rtrb::Consumer<PlayerStep>,
        stage: &mut impl PlayerBackend,
    ) -> PlayerResult {
        while self.played.failure.is_none() {
            if stage.is_over() {
                self.played.was_stopped = true;
                break;
            }
            // Read before the queue: a step pushed between the two reads would be lost.
            let is_last = steps.is_abandoned();
            match steps.peek() {
                Err(_) if is_last => break,
                Err(_) => stage.pause(),
                Ok(PlayerStep::Restore(_)) => {
                    self.wait_for_all(stage);
                    if let Ok(PlayerStep::Restore(states)) = steps.pop() {
                        self.played.failure = stage.restore_latched_state(&states).err();
                        self.origin = None;
                    }
                }
                Ok(&PlayerStep::Frame(due)) => self.send_frames_from(&due, steps, stage),
            }
        }
        if self.played.failure.is_none() && !self.played.was_stopped {
            self.wait_for_all(stage);
        }
        self.played
    }

    fn wait_for_all(&mut self, stage: &mut impl PlayerBackend) {
        for bus_link in 0..self.open.len() {
            self.wait_for_answers(bus_link, stage);
        }
    }

    fn wait_for_answers(&mut self, bus_link: usize, stage: &mut impl PlayerBackend) {
        if let Some(open) = self.open.get_mut(bus_link).and_then(Option::take) {
            stage.wait_for_answers(bus_link, &open);
        }
    }

    /// Returns the clock's time in ns at which a frame is due, or `None` to send it at once.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        clippy::cast_precision_loss,
        reason = "times far below 2^53 ns"
    )]
    fn send_time_ns(&mut self, due: &DueFrame, now: u64) -> Option<u64> {
        let ReplaySpeed::Timed(speed) = self.pace else { return None };
        if due.is_late {
            return None;
        }
        let (clock, at) = *self.origin.get_or_insert((now + START_DELAY_NS, due.at));
        Some(clock + (due.at.saturating_sub(at) as f64 / speed) as u64)
    }

    /// Sends a frame when it is due, in one batch with the following frames of the same bus that are due by then.
    fn send_frames_from(
        &mut self,
        first: &DueFrame,
        steps: &mut rtrb::Consumer<PlayerStep>,
        stage: &mut impl PlayerBackend,
    ) {
        let bus_link = first.bus_index;
        if self.syncs.is_some() && is_joints_frame(first) {
            self.wait_for_answers(bus_link, stage);
        }
        self.batch.clear();
        self.rounds.clear();
        let deadline = self.send_time_ns(first, stage.now_ns());
        // Announce the joints before they are sent, because the answers may arrive before the send call returns.
        let mut open = self.add_to_batch(first, stage);
        let _ = steps.pop();
        if let Some(deadline) = deadline {
            stage.wait_until(deadline);
        }
        let now = stage.now_ns();
        self.record_lateness(deadline, now);
        stage.show_position(first.at);
        // In lockstep, joints end a batch: the next frame must wait, or belongs to the next joints.
        while self.batch.len() < MAX_BATCH_DATAGRAMS && !(self.syncs.is_some() && open.is_some()) {
            let Ok(&PlayerStep::Frame(next)) = steps.peek() else { break };
            let waits = self.syncs.is_some()
                && is_joints_frame(&next)
                && self.open.get(bus_link).is_some_and(Option::is_some);
            let deadline = self.send_time_ns(&next, now);
            if next.bus_index != bus_link || waits || deadline.is_some_and(|deadline| deadline > now) {
                break;
            }
            self.record_lateness(deadline, now);
            open = self.add_to_batch(&next, stage).or(open);
            let _ = steps.pop();
        }
        let frames = self.batch.len();
        let sync = self.syncs.as_ref().and_then(|syncs| syncs.get(bus_link)).filter(|_| open.is_some());
        self.batch.extend(sync.into_iter().flatten());
        let sent = stage.send(bus_link, &self.batch);
        self.count_sent_frames(bus_link, frames, sent, stage);
        let is_down = self.down.get(bus_link).copied().unwrap_or(false);
        if let Some(place) = self.open.get_mut(bus_link).filter(|_| self.syncs.is_some() && !is_down) {
            *place = open.or(*place);
        }
    }

    fn add_to_batch(&mut self, due: &DueFrame, stage: &mut impl PlayerBackend) -> Option<AwaitedJoints> {
        self.batch.push(due.frame);
        let FrameRole::Joints(open) = due.role else { return None };
        stage.announce_joints(due.bus_index, open.round, open.epoch);
        self.rounds.extend(open.round.map(|round| (self.batch.len(), round)));
        Some(open)
    }

    fn record_lateness(&mut self, deadline: Option<u64>, now: u64) {
        if let Some(deadline) = deadline {
            // The histogram resizes itself, so recording cannot fail.
            let _ = self.played.late.record(now.saturating_sub(deadline));
        }
    }

    fn count_sent_frames(
        &mut self,
        bus_index: usize,
        frames: usize,
        sent: Result<(), SendError>,
        stage: &mut impl PlayerBackend,
    ) {
        let (Some(tally), Some(down)) =
            (self.played.bus_links.get_mut(bus_index), self.down.get_mut(bus_index))
        else {
            return;
        };
        // The last frame may be a sync, which does not count.
        let taken = sent.as_ref().map_or_else(|error| error.sent.min(frames), |()| frames);
        let rest = (frames - taken) as u64;
        tally.sent += taken as u64;
        let cause = sent.err().map(|error| error.cause);
        let is_down = cause.as_ref().is_some_and(|cause| !matches!(cause, BusError::Full { .. }));
        if is_down {
            tally.lost += rest;
            tally.outages += u64::from(!*down);
        } else {
            tally.refused += rest;
        }
        *down = is_down;
        for (behind, round) in &self.rounds {
            if *behind > taken {
                stage.mark_round_unsent(bus_index, *round);
            }
        }
        self.played.failure = cause.filter(|cause| !cause.is_temporary()).map(ReplayError::from);
    }
}

const fn is_joints_frame(due: &DueFrame) -> bool {
    matches!(due.role, FrameRole::Joints(_) | FrameRole::SegmentOfJoints)
}

#[cfg(test)]
mod tests;
