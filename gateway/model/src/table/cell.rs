//! The gateway's state of one cell of a bus.

use protocol::id::CellId;
use protocol::message::{Answer, Heartbeat, NetworkPages, SensorPage, SkinSensors, State, StimulusStart};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::{Events, LinksDown, MAX_JOINTS, Parameter, Parameters};
use protocol::skin::{self, SafetyLimits};
use protocol::time::Micros;

use super::errors::TorqueErrors;
use super::held::{HeldTorque, TorqueSumChange};
use super::replies::{OutstandingReplies, Replies, ReplyExpectation};
use super::root_totals::RootSums;
use super::sensed::SensorFrames;
use super::sent::SentJointCounts;
use super::status::CellStatus;
use super::switched::{SWITCH_COUNT, SwitchStates, SwitchTarget};
use crate::tracker::{CellTracker, CellUpdate, ContactState, HeartbeatKind, UplinkCounts};

/// The packets that a cell has sent since they were requested.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct ResponseFlags {
    /// True if the cell sent a heartbeat since the last sync.
    pub heartbeat: bool,
    /// True if the cell sent its counters since the last report command.
    pub counters: bool,
}

/// The halt state of a cell.
#[derive(Clone, Copy, Debug, Default)]
struct HaltState {
    halted: bool,
    /// True if the bus carried a halt or a resume since the cell's last heartbeat.
    commanded: bool,
}

/// The gateway's state of one cell: its identity, contact, replies and held torque.
#[derive(Clone, Debug)]
pub struct CellState {
    /// Node id of the cell.
    pub node: CellId,
    /// Described serial number of the cell.
    pub serial: u32,
    /// True if the cell is wired to the gateway.
    pub root: bool,
    pub(super) joint: usize,
    /// Expected hash of the cell's configuration.
    pub configuration: u16,
    /// The epoch of the last joints that the cell had received when it sent its last heartbeat.
    pub last_joints: Epoch,
    /// The reply parameter that the cell has confirmed since it started.
    pub reply: Option<[i16; WORDS]>,
    /// Ports that the parameter `links_down` takes down, one bit each.
    pub ports_down: u8,
    /// Counts of the replies that were due from the cell, and of those received.
    pub replies: Replies,
    /// Sensors frames of the cell.
    pub sensed: SensorFrames,
    pub(super) tracked: CellTracker,
    pub(super) said: ResponseFlags,
    contact: ContactState<()>,
    switched: SwitchStates,
    halt: HaltState,
    sent: SentJointCounts,
    pub(super) outstanding: OutstandingReplies,
    pub(super) answered: Option<u64>,
    held_torque: HeldTorque,
    pub(super) sums: Option<RootSums>,
}

impl CellState {
    pub(super) fn new(
        described: &skin::Cell,
        parameters: &Parameters,
        summed: bool,
        switched: SwitchStates,
    ) -> Self {
        Self {
            node: described.node,
            serial: described.serial,
            root: described.root,
            joint: described.joint.into(),
            configuration: parameters.hash(),
            last_joints: Epoch(0),
            reply: None,
            ports_down: 0,
            replies: Replies::default(),
            sensed: SensorFrames::default(),
            tracked: CellTracker::default(),
            said: ResponseFlags::default(),
            contact: ContactState::default(),
            switched,
            halt: HaltState::default(),
            sent: SentJointCounts::default(),
            outstanding: OutstandingReplies::default(),
            answered: None,
            held_torque: HeldTorque::default(),
            sums: summed.then(|| RootSums::new(described.root)),
        }
    }

    /// Returns the last heartbeat of the cell.
    #[must_use]
    pub fn heartbeat(&self) -> Option<Heartbeat> {
        self.tracked.claim().heartbeat()
    }

    /// Returns the last page of each kind since the cell started.
    #[must_use]
    pub const fn pages(&self) -> &NetworkPages {
        self.tracked.pages()
    }

    /// Returns the errors of the cell's torques against the central ones, on the joints that move the cell.
    #[must_use]
    pub const fn errors(&self) -> TorqueErrors {
        self.outstanding.errors
    }

    /// Returns the kinds of words (`torque`, `skin`, `acceleration`) that stayed constant while the expected words
    /// changed, each with the longest run in words.
    pub fn stuck_word_runs(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.outstanding.stuck.longest_stuck_runs()
    }

    /// Returns true if the cell now sends constant words although the expected words change.
    #[must_use]
    pub fn is_stuck(&self) -> bool {
        self.outstanding.stuck.is_stuck()
    }

    /// Returns true if the cell measures, so that stimuli have no effect on it; `None` before its first heartbeat.
    #[must_use]
    pub fn is_measuring(&self) -> Option<bool> {
        self.heartbeat().map(|heartbeat| !heartbeat.state.has(State::TEST_MODE))
    }

    /// Returns the counts of packets that the cell sent and that arrived.
    #[must_use]
    pub const fn uplink(&self) -> UplinkCounts {
        self.tracked.account.uplink()
    }

    /// Starts counting again: earlier packets do not count.
    pub(super) fn reset_counts(&mut self) {
        self.tracked.account = Default::default();
        (self.replies, self.sensed) = Default::default();
        self.outstanding.reset_counts();
        self.sent.reset_count();
    }

    /// Records the cell's receive counters. `passed` is the number of joints that were sent while the page was on its
    /// way. Later pages are compared with the first one since a start.
    pub(super) fn record_receive_counters(&mut self, passed: u64) {
        let heard = self.pages().received;
        self.sent.record_counters_page(heard, passed);
        heard.iter().for_each(|heard| self.contact.compare_stimulus_count(heard.stimuli, ()));
    }

    /// Applies a heartbeat of the cell. Returns the change of the running sum.
    pub(super) fn apply_heartbeat(
        &mut self,
        update: &CellUpdate,
        heartbeat: &Heartbeat,
        epoch: Epoch,
    ) -> TorqueSumChange {
        // Ignores heartbeats of a cell that does not own the node id.
        let of_owner =
            |word: &HeartbeatKind| !matches!(word, HeartbeatKind::Claimant | HeartbeatKind::Outsider);
        let Some(word) = update.word.filter(of_owner) else { return TorqueSumChange::default() };
        let started = matches!(word, HeartbeatKind::Started { .. } | HeartbeatKind::Shared);
        (self.said.heartbeat, self.last_joints) = (true, epoch);
        if word != HeartbeatKind::Overtaken {
            // The first heartbeat after a halt or a resume may have been sent before it.
            let old = core::mem::take(&mut self.halt.commanded) && !started;
            if !old {
                self.halt.halted = heartbeat.state.has(State::HALTED);
            }
        }
        if update.returned {
            self.contact.reset();
        }
        if word == HeartbeatKind::First && self.tracked.claim().previous().is_some() {
            // An earlier claimant had counters of its own.
            self.sent = SentJointCounts::default();
        }
        if started {
            if word == HeartbeatKind::Shared {
                self.contact.reset();
            } else {
                self.contact.record_start(());
            }
            self.sensed.record_restart();
            self.switched.reset_to_start_values();
            self.record_restart(word, update.taken_back, heartbeat.sent);
            (self.reply, self.ports_down) = (None, 0);
        } else if !self.tracked.account.is_start_in_doubt() {
            self.sent.confirm_start();
        }
        // A heartbeat does not release a sum, which may hold torques of other cells.
        if self.sums.is_some() || !started && heartbeat.state.has(State::ACTIVE) {
            return TorqueSumChange::default();
        }
        self.release_torque()
    }

    /// Returns the requested packets that the cell has sent.
    #[must_use]
    pub const fn response_flags(&self) -> ResponseFlags {
        self.said
    }

    /// Returns true if the cell can be expected to answer joints: it is configured, awake, and not halted.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        let claim = self.tracked.claim();
        !self.tracked.is_dead()
            && !self.halt.halted
            && claim.is_settled()
            && claim.has_state(State::CONFIGURED)
    }

    /// Returns the newest sensors pages by the stimuli and pages received.
    pub fn latched_pages(&self) -> impl Iterator<Item = SensorPage> {
        self.contact.latched_pages().map(|(page, ())| page)
    }

    /// Records a stimulus on the bus; `last` is the epoch of the last joints.
    pub(super) fn stimulate(&mut self, from: StimulusStart, page: SensorPage, last: Option<Epoch>) {
        self.contact.add_stimulus(from, page, (), last);
    }

    /// Records a sensors frame of the cell. `is_newest` is true if the cell had the newest joints when it sent the
    /// frame.
    pub(super) fn record_sensors(&mut self, at: Micros, page: &SensorPage, is_newest: bool, events: &Events) {
        self.sensed.record_frame(at, page, events);
        self.switched.subtracts_baseline |= matches!(page, SensorPage::Baseline(_));
        if self.sensors().is_some() {
            self.contact
                .latched_pages()
                .for_each(|(right, _)| self.outstanding.stuck.compare_page(page, &right));
        }
        if is_newest {
            self.contact.apply_reported_page(*page, ());
        }
    }

    /// Records the cell's answer to a request.
    pub(super) fn receive_answer(&mut self, answer: &Answer) {
        self.switched.record_answer(answer);
        let Answer::Value { number, written: true, words } = *answer else { return };
        if number == Parameter::Mode.number() && words.first() == Some(&1) {
            self.contact.confirm_mode(());
        } else if number == Parameter::Reply.number() {
            self.reply = Some(words);
        } else if number == Parameter::LinksDown.number() {
            self.ports_down = LinksDown::from_words(words).ports;
        }
    }

    /// Returns the switches that the cell should have but has not confirmed.
    #[must_use]
    pub fn unconfirmed_switches(&self) -> [Option<SwitchTarget>; SWITCH_COUNT] {
        self.switched.unconfirmed()
    }

    /// Returns the sensor words with which the cell computes. Returns `None` if they are unknown: the cell measures,
    /// subtracts its own zero, may be off the bus, or may have received stimuli that did not arrive here.
    pub(super) fn sensors(&self) -> Option<SkinSensors> {
        self.contact.certain_skin().filter(|_| self.torque_follows_stimuli()).map(|(skin, ())| *skin)
    }

    /// Returns the sensor words of the cell for display, from the stimuli and pages that arrived. Older stimuli that
    /// did not arrive may have changed them.
    #[must_use]
    pub fn presumed_sensors(&self) -> Option<SkinSensors> {
        self.contact.presumed_skin().filter(|_| self.torque_follows_stimuli()).map(|(skin, ())| *skin)
    }

    /// Returns true if the cell's torques follow from stimuli alone: it neither measures nor subtracts a zero.
    fn torque_follows_stimuli(&self) -> bool {
        self.tracked.claim().has_state(State::TEST_MODE)
            && !self.switched.subtracts_baseline
            && !self.tracked.account.is_interrupted()
    }

    /// Returns true if the cell's torques follow from stimuli alone, but some stimuli may not have arrived here. A
    /// write of the cell's mode clears such stimuli.
    #[must_use]
    pub fn has_unseen_stimuli(&self) -> bool {
        self.is_ready() && self.torque_follows_stimuli() && self.contact.certain_skin().is_none()
    }

    /// Returns the sensor words of the cell from the joints of this epoch on; `None` if unknown.
    pub(super) fn latch(&mut self, epoch: Epoch) -> Option<SkinSensors> {
        self.contact.latch_due_stimuli(epoch, |()| {});
        self.sensors()
    }

    /// Starts a broadcast for the cell: a reply that did not arrive within three epochs counts as missing, and the held
    /// torque decays. Returns the change of the running sum, and the number of epochs without a new torque.
    pub(super) fn open_epoch(
        &mut self,
        number: u64,
        in_contact: bool,
        safety: &SafetyLimits,
    ) -> (TorqueSumChange, u32) {
        self.sent.count_broadcast();
        let due = in_contact && self.is_ready();
        let is_known = self.sensors().is_some();
        if let Some(sums) = &mut self.sums {
            self.outstanding.restart_with(due, is_known);
            sums.open_epoch();
        } else {
            if self.outstanding.open_broadcast(due, is_known) {
                self.replies.count_missing(1, self.tracked.is_dead());
            }
            self.replies.due += u64::from(due);
        }
        if !self.held_torque.has_torque() {
            return (TorqueSumChange::default(), 0);
        }
        let answered = self.answered.unwrap_or(number);
        let unanswered = u32::try_from(number.saturating_sub(answered + 1)).unwrap_or(u32::MAX);
        (self.held_torque.decay_torque(unanswered, safety, self.sums.is_some()), unanswered)
    }

    /// Records a repeated broadcast, which the cell receives and drops; no reply is due.
    pub(super) const fn count_repeated_joints(&mut self) {
        self.sent.count_broadcast();
    }

    /// Returns true if the running sum contains a torque of the cell.
    pub(super) const fn contributes_to_sum(&self) -> bool {
        self.held_torque.contributes_to_sum()
    }

    /// Returns true if the cell is in contact. If its sensors are unknown, its own report decides.
    fn is_in_contact(&self) -> bool {
        self.outstanding.is_reply_due()
            || self.sensors().is_none() && self.tracked.claim().has_state(State::ACTIVE)
    }

    /// Records a torque that answers the broadcast `number`, which is `lag` broadcasts before the newest. `is_zero` is
    /// true for a zero torque, which only ends a contact. Returns whether the torque was due.
    pub(super) fn record_reply(&mut self, number: u64, lag: usize, is_zero: bool) -> ReplyExpectation {
        self.answered = Some(number);
        let asked = self.outstanding.record_answer(lag);
        let replies = &mut self.replies;
        match (asked, lag) {
            (ReplyExpectation::Due, 0) => replies.in_time += 1,
            (ReplyExpectation::Due, _) => replies.late += 1,
            (ReplyExpectation::Unknown | ReplyExpectation::NotDue, _) => replies.unasked += 1,
        }
        replies.contact_unknown += u64::from(asked == ReplyExpectation::Unknown);
        replies.unexpected += u64::from(asked == ReplyExpectation::NotDue && !is_zero);
        asked
    }

    /// Holds a root's sum for the broadcast `number`, in steps of Q3.12, until the next sum. A sum for an older
    /// broadcast than that of the held sum changes nothing. Returns the change of the running sum.
    pub(super) fn hold_sum(&mut self, number: u64, count: u8, words: [i32; MAX_JOINTS]) -> TorqueSumChange {
        if self.answered.is_some_and(|last| number < last) {
            return TorqueSumChange::default();
        }
        self.answered = Some(number);
        self.held_torque.hold_sum(words, count)
    }

    /// Returns true if the held torque is older than the broadcast before `number`.
    pub(super) fn is_torque_outdated(&self, number: u64) -> bool {
        self.held_torque.has_torque() && self.answered.is_some_and(|last| last + 1 < number)
    }

    /// Returns the number of cells in the held torque.
    pub(super) fn held_cells(&self) -> u32 {
        self.held_torque.held_cell_count()
    }

    /// Holds a torque in steps of Q3.12 until the next one; zeros end a contact. Returns the change of the running sum.
    pub(super) fn hold_torque(&mut self, words: [i32; MAX_JOINTS]) -> TorqueSumChange {
        self.held_torque.hold_torque(words)
    }

    /// Releases the held torque. Returns the change of the running sum.
    pub(super) fn release_torque(&mut self) -> TorqueSumChange {
        self.held_torque.release_torque()
    }

    /// Records a halt on the bus: the cell stops answering. Returns the change of the running sum.
    pub(super) fn halt(&mut self) -> TorqueSumChange {
        self.halt = HaltState { halted: true, commanded: true };
        self.release_torque()
    }

    /// Records a resume on the bus: the cell answers the next broadcast.
    pub(super) const fn resume(&mut self) {
        self.halt = HaltState { halted: false, commanded: true };
    }

    /// Returns two counts of unanswered joints: those that the cell reports as skipped because they were old, and those
    /// sent to the cell that it does not report as received. Returns `None` before the cell's first report.
    #[must_use]
    pub fn unanswered_joint_counts(&self) -> Option<(u64, u64)> {
        self.sent.unanswered_joint_counts(self.pages().received)
    }

    /// Records that the bus was lost: replies that were due may have been sent and lost.
    pub(super) fn handle_connection_loss(&mut self) {
        self.forget_contact();
        self.tracked.account.handle_connection_loss();
    }

    /// Forgets the contact state of the cell: the replies now due are in doubt.
    fn forget_contact(&mut self) {
        self.mark_replies_in_doubt();
        self.contact.reset();
    }

    /// Records a write of a parameter that changes how the cell answers from now on.
    pub(super) fn record_parameter_write(&mut self, number: u8) {
        self.mark_replies_in_doubt();
        if number == Parameter::Mode.number() {
            self.contact.record_mode_write();
        } else {
            self.contact.mark_state_unknown();
        }
    }

    fn mark_replies_in_doubt(&mut self) {
        let due = self.outstanding.clear_outstanding();
        // On a bus with sums, the sum counts a missing contribution.
        self.replies.count_missing(if self.sums.is_some() { 0 } else { due }, true);
    }

    /// Ends the counting: replies still outstanding count as missing.
    pub(super) fn finish_counts(&mut self) {
        self.tracked.account.finish();
        if self.sums.is_none() {
            let due = self.outstanding.clear_outstanding();
            self.replies.count_missing(due, self.tracked.is_dead());
        }
    }

    /// Records a restart: outstanding replies will never arrive, and the counters of the cell can no longer explain
    /// missing ones. If `taken_back`, the cell had not started: its counters continue, and explain all but the
    /// outstanding replies.
    fn record_restart(&mut self, word: HeartbeatKind, taken_back: bool, sent: u16) {
        let due = self.outstanding.clear_outstanding();
        let outstanding = if self.sums.is_some() { 0 } else { due };
        let in_doubt = self.sent.record_restart(word, taken_back, sent, (outstanding, self.replies.in_doubt));
        if self.sums.is_some() {
            // Its contribution is missing in a sum, and its own held sum decays.
            return;
        }
        self.replies.count_missing(due, false);
        let unexplained = self.replies.missing.saturating_sub(self.replies.too_late);
        self.replies.in_doubt = in_doubt.unwrap_or(unexplained);
        self.answered = None;
    }

    pub(super) fn status(&self, now: Micros, newest: Option<u64>) -> CellStatus {
        if self.tracked.last_packet().is_none() {
            return CellStatus::Unknown;
        }
        if self.tracked.is_dead() || self.tracked.is_silent(now) {
            return CellStatus::Dead;
        }
        match (self.answered, newest) {
            _ if !self.held_torque.has_torque() && self.sums.is_some() && self.is_in_contact() => {
                CellStatus::Active
            }
            _ if !self.held_torque.has_torque() => CellStatus::Quiet,
            (Some(answered), Some(newest)) if answered + 1 < newest => CellStatus::Stale,
            _ => CellStatus::Active,
        }
    }
}

#[cfg(test)]
mod tests;
