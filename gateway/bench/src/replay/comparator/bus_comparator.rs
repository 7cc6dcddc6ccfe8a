//! Comparison state of one bus: its cells, the joints sent to them, and their replies.
//!
//! The state machines are in [`super::states`], with a table of each. This module turns messages into their inputs, and
//! holds the queues between the capture and the bus.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use model::tracker::{AddressClaim, HeartbeatKind, PerCell};
use protocol::id::CellId;
use protocol::message::{Answer, Joints, Message, NetworkPage, ReceivedCounts};
use protocol::packet::{Epoch, Words};
use protocol::schema::BusUnits;
use protocol::time::Micros;

use super::REPLY_WINDOW_BROADCASTS;
use super::states::contact::{RecordedContact, ReplayedContactEnd};
use super::states::first_joints::{self, FirstJointsState};
use super::states::line::{self, BusCondition};
use super::states::pass::{self, CapturePass};
use super::states::progress::{self, CellProgress};
use super::states::sending::{self, SendState};
use super::sums::{ParentHistory, SumsByCell};
use super::tally::UncomparedReplies;
use crate::replay::difference::ReplyKind;
use crate::replay::survey::SurveyedCell as Surveyed;
use model::latched::KnownContacts;
use model::latched::LatchedState;

/// Maximum number of remembered unanswered requests per cell.
const MAX_PENDING_REQUESTS: usize = 256;
/// Number of the last joint broadcasts of the recording within which a request may lack its answer because the
/// recording ended.
const FINAL_JOINT_BROADCASTS: u64 = 8;

/// A cell on the bus now.
#[derive(Clone, Copy, Debug, Default)]
pub struct PresentCell {
    /// The cell's claim of its node id, with its last heartbeat.
    pub claim: AddressClaim,
    /// First and last counters that the cell reported.
    pub counters: Option<(ReceivedCounts, ReceivedCounts)>,
    /// Progress with the joints announced last.
    pub(super) progress: CellProgress,
}

impl PresentCell {
    /// Returns true if the next joints wait for this cell.
    pub(super) fn is_awaited(&self) -> bool {
        self.claim.is_settled() && matches!(self.progress, CellProgress::Awaited { .. })
    }

    pub(super) const fn is_given_up(&self) -> bool {
        matches!(self.progress, CellProgress::GivenUp { .. })
    }
}

/// A value from the recording, and its counterpart from this replay.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RecordedAndNow<T> {
    pub(super) recorded: T,
    pub(super) now: T,
}

/// Joints that are about to be sent, or were sent.
#[derive(Clone, Copy, Debug)]
pub(super) struct AnnouncedJoints {
    pub(super) announcement: u64,
    /// Number of their round, or `None` for joints that only restore a state.
    pub(super) round: Option<u64>,
}

/// A round: recorded joints, with the recorded replies and the replies in this replay.
#[derive(Debug, Default)]
pub(super) struct JointsRound {
    pub(super) epoch: Epoch,
    /// Recording time in ns since 1970.
    pub(super) nanos: u64,
    /// State of resending the joints.
    pub(super) sending: SendState,
    /// Words of each reply, in the recording and in this replay.
    pub(super) replies: BTreeMap<(CellId, ReplyKind), RecordedAndNow<Option<Words>>>,
    /// Sums, in the recording and in this replay.
    pub(super) sums: RecordedAndNow<SumsByCell>,
    /// Cells that the recorded stimuli touch at the previous joints, and at these joints.
    pub(super) touched: [KnownContacts; 2],
    /// True if a pass over the capture begins with these joints.
    pub(super) is_first: bool,
}

impl JointsRound {
    /// Returns true if sums of this epoch answer the last sending of these joints, not an earlier one.
    pub(super) fn has_sums_of(&self, epoch: Epoch) -> bool {
        self.sending.sent_epoch().unwrap_or(self.epoch) == epoch
    }

    /// Returns true if a stimulus touches the cell at these joints, or `None` if unknown.
    pub(super) fn is_touched(&self, cell: CellId) -> Option<bool> {
        self.touched.last().and_then(|touched| touched.in_contact(cell))
    }

    /// Returns true if a cell that receives these joints replies: with a torque, or with the end of its contact.
    pub(super) fn may_answer(&self, cell: CellId) -> bool {
        self.touched.iter().any(|touched| touched.in_contact(cell) == Some(true))
    }
}

/// A cell of the capture.
#[derive(Debug)]
pub(super) struct KnownCell {
    pub(super) cell: Surveyed,
    /// State of the cell's contact in the recording.
    pub(super) contact: RecordedContact,
    /// End of the cell's contact in this replay, compared with the recording.
    pub(super) end: ReplayedContactEnd,
}

impl KnownCell {
    pub(super) fn new(cell: Surveyed) -> Self {
        Self { cell, contact: RecordedContact::default(), end: ReplayedContactEnd::default() }
    }
}

/// Answers to `configure` that have not been compared: those of the recording and those of this replay.
#[derive(Debug, Default)]
pub(super) struct PendingAnswers {
    /// Number of rounds before each answer, the tag of the answer, and the answer.
    pub(super) recorded: VecDeque<(u64, u8, Answer)>,
    /// Recorded requests for which no answer has been read yet.
    announced: VecDeque<PendingRequest>,
    pub(super) now: VecDeque<(u8, Answer)>,
}

/// A recorded `configure` request.
#[derive(Clone, Copy, Debug)]
struct PendingRequest {
    tag: u8,
    /// Number of rounds before the request, and the time of the last of them.
    round: u64,
    nanos: u64,
}

/// State of a pass over the capture, up to the message that was read last.
#[derive(Debug, Default)]
struct PassState {
    pass: CapturePass,
    /// State at the last recorded joints, and the cells touched at them.
    state: LatchedState,
    touched: KnownContacts,
    /// Number of the first round of the pass.
    first_round: u64,
}

impl PassState {
    /// Handles the next item of the capture. Returns true if it is the first joints of the pass.
    const fn next(&mut self, input: pass::ReadEvent) -> bool {
        let (next, is_first) = self.pass.next(input);
        self.pass = next;
        is_first
    }
}

/// Comparison state of one bus.
#[derive(Debug, Default)]
pub(super) struct BusComparator {
    pub(super) name: String,
    /// Units of the bus's torques, as far as a skin gives them.
    pub(super) units: BusUnits,
    pub(super) present: BTreeMap<CellId, PresentCell>,
    pub(super) known: BTreeMap<CellId, KnownCell>,
    pub(super) announcements: u64,
    /// Latest announced joints of each epoch.
    pub(super) announced: Vec<Option<AnnouncedJoints>>,
    /// Round of the latest recorded joints of each epoch.
    pub(super) recorded_rounds: Vec<Option<u64>>,
    /// Number of the first element of `rounds`.
    pub(super) base: u64,
    pub(super) rounds: VecDeque<JointsRound>,
    /// Trees of the cells, recorded and now.
    pub(super) trees: RecordedAndNow<ParentHistory>,
    pub(super) answers: BTreeMap<CellId, PendingAnswers>,
    /// Cells whose last recorded sum did not end a contact. Each must send another sum, or the end of the contact.
    pub(super) contributing: BTreeSet<CellId>,
    /// True if cells were configured to send sensor frames without request, which arrive at times of their own.
    pub(super) sends_unrequested_sensors: bool,
    /// State of each cell's first joints since its start, in the recording and in this replay.
    pub(super) first_joints: RecordedAndNow<PerCell<FirstJointsState>>,
    reading: PassState,
    /// Number of announced rounds.
    pub(super) sent: u64,
    /// Last round with joints in the capture, once known.
    pub(super) last_round: Option<u64>,
    line: BusCondition,
}

impl BusComparator {
    /// Returns the name of the bus and the units of its torques.
    pub(super) fn name_and_units(&self) -> (&str, BusUnits) {
        (&self.name, self.units)
    }

    pub(super) fn new(name: String, cells: BTreeMap<CellId, Surveyed>) -> Self {
        let known_cell = |(node, cell)| (node, KnownCell::new(cell));
        Self {
            name,
            known: cells.into_iter().map(known_cell).collect(),
            announced: vec![None; 256],
            recorded_rounds: vec![None; 256],
            ..Self::default()
        }
    }

    /// Returns true if messages came before the first round of this pass.
    pub(super) const fn has_earlier_messages(&self) -> bool {
        self.reading.pass.has_earlier_messages()
    }

    pub(super) const fn is_down(&self) -> bool {
        matches!(self.line, BusCondition::Down)
    }

    /// Handles an event of the bus.
    pub(super) const fn handle_bus_event(&mut self, input: line::BusConditionEvent) {
        self.line = self.line.next(input);
    }

    pub(super) fn round(&mut self, number: u64) -> Option<&mut JointsRound> {
        let at = number.checked_sub(self.base)?;
        self.rounds.get_mut(usize::try_from(at).ok()?)
    }

    /// Returns the round of the latest recorded joints of an epoch.
    pub(super) fn recorded_round(&mut self, epoch: Epoch) -> Option<&mut JointsRound> {
        let number = self.recorded_rounds.get(usize::from(epoch.0)).copied().flatten()?;
        self.round(number)
    }

    /// Returns the latest announced joints of an epoch.
    fn announced_joints(&self, epoch: Epoch) -> Option<AnnouncedJoints> {
        self.announced.get(usize::from(epoch.0)).copied().flatten()
    }

    /// Returns the number and the state of the round whose joints were sent last under an epoch.
    pub(super) fn announced_round(&mut self, epoch: Epoch) -> Option<(u64, &mut JointsRound)> {
        let number = self.announced_joints(epoch)?.round?;
        Some((number, self.round(number)?))
    }

    /// Counts a torque or sum in the replayed part whose joints are not in that part, by the reason.
    pub(super) fn count_replies_without_joints(&self, epoch: Epoch, lacking: &mut UncomparedReplies) {
        if self.is_before_replayed_part(epoch) {
            lacking.joints_earlier += 1;
        } else if !self.rounds.is_empty() {
            lacking.joints_unrecorded += 1;
        }
    }

    /// Requires from each cell another heartbeat, which confirms all messages announced so far.
    pub(super) fn await_all_cells(&mut self) {
        self.announcements += 1;
        let announced = |progress: CellProgress| progress.next(progress::CellEvent::Announced);
        self.present.values_mut().for_each(|present| present.progress = announced(present.progress));
    }

    /// Stops waiting. Returns the cells that have not answered in time.
    pub(super) fn time_out_cells(&mut self) -> Vec<CellId> {
        let mut late = Vec::new();
        for (cell, present) in self.present.iter_mut().filter(|(_, present)| present.is_awaited()) {
            present.progress = present.progress.next(progress::CellEvent::TimesOut);
            late.push(*cell);
        }
        late
    }

    /// Handles an event of sending a round's joints, if the round is remembered.
    pub(super) fn update_send_state(&mut self, number: u64, input: sending::SendEvent) {
        let Some(round) = self.round(number) else { return };
        round.sending = round.sending.next(input);
        if matches!(input, sending::SendEvent::Sent { .. }) {
            // After repeated joints, all cells send their sums again.
            round.sums.now.clear();
        }
    }

    /// Drops recorded replies to messages that were not sent. Replies to messages after the last joints are not
    /// expected either, because it is unknown whether those messages were sent.
    pub(super) fn drop_unsent_replies(&mut self) {
        let sent = self.sent;
        for answers in self.answers.values_mut() {
            answers.recorded.retain(|(rounds, ..)| *rounds < sent);
        }
        if let Some(last) = sent.checked_sub(1).and_then(|last| self.round(last)) {
            last.replies.retain(|(_, what), pair| *what == ReplyKind::Torque || pair.now.is_some());
        }
    }

    /// Starts another pass over the capture.
    pub(super) fn begin_pass(&mut self) {
        self.recorded_rounds.fill(None);
        let mut reading = PassState { first_round: self.round_count(), ..PassState::default() };
        reading.next(pass::ReadEvent::Begins);
        self.reading = reading;
    }

    fn round_count(&self) -> u64 {
        self.base + self.rounds.len() as u64
    }

    /// Adds joints of the capture. Returns the number of their round if they will be sent.
    pub(super) fn record_joints(&mut self, nanos: u64, epoch: Epoch, is_sent: bool) -> Option<u64> {
        let number = self.round_count();
        let last = self.reading.state.last_epoch();
        let input = if is_sent { pass::ReadEvent::Joints { last } } else { pass::ReadEvent::NotSent };
        let is_first = self.reading.next(input);
        let before = self.apply_joints(epoch);
        if is_sent {
            let touched = [before, self.reading.touched];
            self.rounds.push_back(JointsRound { epoch, nanos, touched, is_first, ..JointsRound::default() });
        }
        let round = is_sent.then_some(number);
        *self.recorded_rounds.get_mut(usize::from(epoch.0))? = round;
        round
    }

    fn apply_joints(&mut self, epoch: Epoch) -> KnownContacts {
        self.reading.state.apply_message(&Message::Joints { epoch, joints: Joints::default() });
        std::mem::replace(&mut self.reading.touched, self.reading.state.cells_in_contact())
    }

    /// Adds any other message of the capture. `is_in_part` is true if the message is in the replayed part.
    pub(super) fn record_state(&mut self, message: &Message, is_in_part: bool) {
        if !is_in_part {
            self.reading.next(pass::ReadEvent::NotSent);
        }
        if let Message::Joints { epoch, .. } = *message {
            self.apply_joints(epoch);
        } else {
            self.reading.state.apply_message(message);
        }
        if let (Message::Configure { to, tag, .. }, true) = (*message, is_in_part) {
            let round = self.round_count();
            let nanos = self.rounds.back().map_or(0, |round| round.nanos);
            for cell in self.known.keys().filter(|cell| to.addresses_cell(**cell)) {
                let announced = &mut self.answers.entry(*cell).or_default().announced;
                if announced.len() == MAX_PENDING_REQUESTS {
                    announced.pop_front();
                }
                announced.push_back(PendingRequest { tag, round, nanos });
            }
        }
    }

    /// Returns true if the recorded cell with this node id claims the id and does not own it yet.
    pub(super) fn is_claiming(&self, cell: CellId) -> bool {
        self.reading.state.node_id_claim(cell).is_some_and(|claim| !claim.is_settled())
    }

    /// Returns true if a reply of this epoch answers joints from before the replayed part. Call it only if no joints in
    /// the part have had this epoch yet.
    fn is_before_replayed_part(&self, epoch: Epoch) -> bool {
        let PassState { pass, state, first_round, .. } = &self.reading;
        let last = pass.earlier_epoch(state.last_epoch());
        self.round_count() - first_round < REPLY_WINDOW_BROADCASTS
            && last.is_some_and(|last| (0..100).contains(&last.epochs_since(epoch)))
    }

    /// Adds a recorded answer to `configure`. Returns true if its request is in the replayed part.
    pub(super) fn record_answer(&mut self, from: CellId, tag: u8, answer: Answer) -> bool {
        let rounds = self.round_count();
        let answers = self.answers.entry(from).or_default();
        match answers.announced.iter().position(|announced| announced.tag == tag) {
            Some(at) => drop(answers.announced.remove(at)),
            None if self.reading.pass.has_earlier_messages() => return false,
            None => {}
        }
        answers.recorded.push_back((rounds, tag, answer));
        true
    }

    /// Adds the parent that a cell reported in the capture. `epoch` is that of the last joints that the cell received;
    /// its sums go to that parent from the next joints on.
    pub(super) fn record_parent(&mut self, cell: CellId, epoch: Epoch, parent: Option<u8>) {
        let next = self.base + self.rounds.len() as u64;
        let last = self.recorded_rounds.get(usize::from(epoch.0)).copied().flatten();
        self.trees.recorded.set_parent(cell, parent, last.map_or(next, |last| last + 1));
    }

    /// Adds the parent that a cell reports in this replay.
    fn observe_parent(&mut self, cell: CellId, epoch: Epoch, parent: Option<u8>) {
        let last = self.announced_joints(epoch).and_then(|announced| announced.round);
        self.trees.now.set_parent(cell, parent, last.map_or(self.sent, |last| last + 1));
    }

    pub(super) fn observe_network_page(&mut self, cell: CellId, epoch: Epoch, page: &NetworkPage) {
        let reported = self.announced_joints(epoch).map(|announced| announced.announcement);
        let has_announced = self.announcements > 0;
        let found =
            || PresentCell { progress: CellProgress::initial_state(has_announced), ..PresentCell::default() };
        let present = self.present.entry(cell).or_insert_with(found);
        if let NetworkPage::Heartbeat(heartbeat) = page {
            if matches!(
                present.claim.receive(Micros(0), heartbeat),
                HeartbeatKind::Claimant | HeartbeatKind::Outsider
            ) {
                return;
            }
            present.progress = present.progress.next(if reported == Some(self.announcements) {
                progress::CellEvent::ReportsLast
            } else {
                progress::CellEvent::ReportsOther
            });
            if !present.claim.is_settled() {
                self.observe_parent(cell, epoch, None);
            }
        } else if let NetworkPage::Received(counts) = *page {
            let first = present.counters.map_or(counts, |(first, _)| first);
            present.counters = Some((first, counts));
        } else if let NetworkPage::Tree(tree) = page {
            self.observe_parent(cell, epoch, tree.parent);
        }
    }

    /// Returns the cells for which the next joints wait.
    pub(super) fn awaited_cells(&self) -> impl Iterator<Item = CellId> {
        self.present.iter().filter(|(_, present)| present.is_awaited()).map(|(cell, _)| *cell)
    }
}

impl PendingAnswers {
    /// Returns true if the recording explains why it lacks the answer of this tag, and counts the reason. `rounds` is
    /// the total number of rounds.
    pub(super) fn explain_extra_answer(
        &mut self,
        lacking: &mut UncomparedReplies,
        known_cell: Option<&mut KnownCell>,
        tag: u8,
        rounds: u64,
    ) -> bool {
        let Some(KnownCell { cell, .. }) = known_cell else {
            // The recording lacks this cell altogether.
            lacking.silent += 1;
            return true;
        };
        let Some(at) = self.announced.iter().position(|announced| announced.tag == tag) else { return false };
        let Some(PendingRequest { round, nanos, .. }) = self.announced.remove(at) else { return false };
        if cell.is_silent_at(nanos) {
            lacking.silent += 1;
        } else if round + FINAL_JOINT_BROADCASTS >= rounds {
            lacking.ended += 1;
        } else if !cell.is_covered_by_counters(nanos) {
            lacking.uncounted += 1;
        } else if cell.unrecorded > 0 {
            cell.unrecorded -= 1;
            lacking.unrecorded += 1;
        } else {
            return false;
        }
        true
    }
}

/// Updates the state of the message's sender: whether it has received joints since its start.
pub(super) fn update_first_joints(cells: &mut PerCell<FirstJointsState>, message: &Message) {
    let Some((cell, input)) = first_joints::JointsEvidence::from_message(message) else { return };
    if let Some(place) = cells.get_mut(cell) {
        *place = place.next(input);
    }
}
