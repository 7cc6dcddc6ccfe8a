//! Comparison of the buses with the capture: which cells are present, whether they have processed the last joints, and
//! whether their replies are those of the capture.
//!
//! ```text
//!   recorded joints, replies ─> expect_joints, expect_message ─┐                  ┌─> are_joints_processed ─> lockstep
//!          joints to be sent ─> announce_joints ───────────────┼─ [ Comparator ] ─┼─> present_cells, other_gateway_bus
//!        frames on the buses ─> observe_message ───────────────┘                  └─> tally, first_difference
//! ```
//!
//! A reply belongs to the joints that it answers: the latest joints of its epoch, in the capture and on the bus
//! separately. A round of joints is compared when 100 more have been sent, or at the end.

mod bus_comparator;
mod close;
mod states;
mod sums;
mod tally;

use std::collections::BTreeMap;

use protocol::id::{CellId, Node};
use protocol::message::{Answer, Message, NetworkPage, Request};
use protocol::packet::{Epoch, Words};
use protocol::parameters::{Parameter, Sensing};
use protocol::schema::BusUnits;
use protocol::skin::Skin;

pub use bus_comparator::PresentCell;
use bus_comparator::{AnnouncedJoints, BusComparator, RecordedAndNow, update_first_joints};
use states::first_joints::FirstJointsState;
use states::progress::CellProgress;
use states::{line, sending};
pub use sums::OwnContribution;
use sums::{CellSum, EpochSums};
pub use tally::{ReplyTally, StepHistogram, UncomparedReplies};

use super::difference::{Difference, DifferenceKind, RecordingPosition, ReplyKind, SentValue};
use super::survey::SurveyedCell as Surveyed;

/// Maximum number of joint broadcasts between the joints that a reply answers and the arrival of the reply. It is far
/// below the number of epochs, 256.
const REPLY_WINDOW_BROADCASTS: u64 = 100;

/// The first difference found.
#[derive(Debug)]
struct FirstDifference {
    /// Start of the capture in ns since 1970.
    nanos: u64,
    difference: Option<Difference>,
}

impl FirstDifference {
    /// Keeps the first difference, with the number, the epoch and the time of the joints that the reply answers.
    fn keep_first_difference(
        &mut self,
        how: DifferenceKind,
        (bus, units): (&str, BusUnits),
        cell: CellId,
        round: Option<(u64, Epoch, u64)>,
        [recorded, now]: [Option<SentValue>; 2],
    ) {
        if self.difference.is_some() {
            return;
        }
        let when = round.map(|(joints, epoch, nanos)| {
            let at_s = std::time::Duration::from_nanos(nanos.saturating_sub(self.nanos)).as_secs_f64();
            RecordingPosition { joints, epoch: epoch.0, at_s }
        });
        self.difference =
            Some(Difference::new(how, (bus, units), cell, when, recorded.as_ref(), now.as_ref()));
    }
}

/// Compares the replies on all buses with the capture.
#[derive(Debug)]
pub struct Comparator {
    buses: Vec<BusComparator>,
    /// Tolerance in steps between a torque's words and the recorded ones; `None` if replies are not compared.
    tolerance: Option<u16>,
    /// True while a state is restored: replies then differ from the capture's.
    is_muted: bool,
    tally: ReplyTally,
    first: FirstDifference,
    other_gateway: Option<usize>,
}

impl Comparator {
    /// Creates the comparison of buses, given by their names in this replay and their cells in the capture. Compares
    /// replies within `tolerance`, in steps of torques, once unmuted; with `None`, compares no replies.
    #[must_use]
    pub fn new(
        buses: impl IntoIterator<Item = (String, BTreeMap<CellId, Surveyed>)>,
        first_nanos: u64,
        tolerance: Option<u16>,
    ) -> Self {
        let bus_comparators =
            buses.into_iter().map(|(name, cells)| BusComparator::new(name, cells)).collect();
        Self {
            buses: bus_comparators,
            tolerance,
            is_muted: true,
            tally: ReplyTally::default(),
            first: FirstDifference { nanos: first_nanos, difference: None },
            other_gateway: None,
        }
    }

    /// Sets the units of the buses that the skin describes, by name.
    pub fn set_units(&mut self, skin: &Skin) {
        for bus in &mut self.buses {
            if let Some(index) = skin.bus_index(&bus.name) {
                bus.units = BusUnits::for_bus(skin, index);
            }
        }
    }

    /// Adds the next joints of the capture. If they will be sent, returns the number of their round on their bus.
    pub fn expect_joints(
        &mut self,
        bus_index: usize,
        nanos: u64,
        epoch: Epoch,
        is_sent: bool,
    ) -> Option<u64> {
        self.buses.get_mut(bus_index)?.record_joints(nanos, epoch, is_sent)
    }

    /// Adds any other message of the capture. `is_in_part` is true if the message is in the replayed part.
    pub fn expect_message(&mut self, bus_index: usize, message: &Message, is_in_part: bool) {
        let expects = self.tolerance.is_some();
        let (Some(bus_comparator), tally) =
            (self.buses.get_mut(bus_index).filter(|_| expects), &mut self.tally)
        else {
            return;
        };
        bus_comparator.record_state(message, is_in_part);
        if let Message::Configured { from, tag, answer } = *message {
            let is_lacking =
                is_in_part && is_compared(answer) && !bus_comparator.record_answer(from, tag, answer);
            tally.lacking.requested_earlier += u64::from(is_lacking);
        } else if let Message::Network { from: Node::Cell(cell), epoch, page } = *message {
            if let NetworkPage::Tree(tree) = page {
                bus_comparator.record_parent(cell, epoch, tree.parent);
            } else if matches!(page, NetworkPage::Heartbeat(_)) && bus_comparator.is_claiming(cell) {
                bus_comparator.record_parent(cell, epoch, None);
            }
        } else if let Message::Sum { from, epoch, torque, count } = *message {
            match bus_comparator.recorded_round(epoch) {
                Some(round) => round.sums.recorded.insert(from, CellSum { torque, count }),
                None if is_in_part => bus_comparator.count_replies_without_joints(epoch, &mut tally.lacking),
                None => {}
            }
        } else if let Message::Configure { request: Request::Write { number, words }, .. } = *message {
            let is_sensing = number == Parameter::Sensing.number();
            let sensing = Sensing::from_words(words).filter(|_| is_sensing);
            bus_comparator.sends_unrequested_sensors |=
                sensing.is_some_and(|sensing| sensing != Sensing::Off);
        }
        update_first_joints(&mut bus_comparator.first_joints.recorded, message);
        let Some((cell, epoch, what, words)) = decode_reply(message) else { return };
        let untaken = FirstJointsState::Awaited { epoch };
        if what != ReplyKind::Torque && bus_comparator.first_joints.recorded.get(cell) == Some(&untaken) {
            // The reply answers joints outside the replayed part, even if joints of its epoch were on the bus by then.
            return;
        }
        let measured = bus_comparator.known.get(&cell).is_some_and(|known_cell| known_cell.cell.measured);
        match bus_comparator.recorded_round(epoch) {
            Some(_) if measured => tally.lacking.measured += 1,
            Some(round) => round.replies.entry((cell, what)).or_default().recorded = Some(words),
            // Before the first joints, sensor frames belong to no joints.
            None if is_in_part && what == ReplyKind::Torque => {
                bus_comparator.count_replies_without_joints(epoch, &mut tally.lacking)
            }
            None => {}
        }
    }

    /// Starts another pass over the capture. Replies before the first joints of this pass do not answer joints of the
    /// pass before.
    pub fn expect_next_pass(&mut self) {
        self.buses.iter_mut().for_each(BusComparator::begin_pass);
    }

    /// Notes that the capture has no more joints.
    pub fn expect_end(&mut self) {
        for bus_comparator in &mut self.buses {
            bus_comparator.last_round =
                (bus_comparator.base + bus_comparator.rounds.len() as u64).checked_sub(1);
        }
    }

    /// Notes that joints are about to be sent. `round` is the number of their round, or `None` if they only restore a
    /// state.
    pub fn announce_joints(&mut self, bus_index: usize, round: Option<u64>, epoch: Epoch) {
        let Some(it) = self.buses.get_mut(bus_index) else { return };
        it.await_all_cells();
        let announced = AnnouncedJoints { announcement: it.announcements, round };
        if let Some(place) = it.announced.get_mut(usize::from(epoch.0)) {
            *place = Some(announced);
        }
        let Some(number) = round else { return };
        it.sent = it.sent.max(number + 1);
        it.update_send_state(number, sending::SendEvent::Sent { under: epoch });
        while self
            .buses
            .get(bus_index)
            .is_some_and(|bus_comparator| bus_comparator.base + REPLY_WINDOW_BROADCASTS < number)
        {
            self.close_round(bus_index);
        }
    }

    /// Notes a sync without joints, after which all cells must confirm all messages sent so far.
    pub fn announce_sync(&mut self, bus_index: usize) {
        let Some(it) = self.buses.get_mut(bus_index) else { return };
        it.await_all_cells();
        let (announcement, last) = (it.announcements, it.announcements - 1);
        if let Some(announced) =
            it.announced.iter_mut().flatten().find(|announced| announced.announcement == last)
        {
            announced.announcement = announcement;
        }
    }

    /// Notes that a bus refused the joints of a round.
    pub fn mark_unsent(&mut self, bus_index: usize, round: u64) {
        if let Some(bus_comparator) = self.buses.get_mut(bus_index) {
            bus_comparator.update_send_state(round, sending::SendEvent::Refused);
        }
    }

    /// Handles a message that another sender has sent on a bus.
    pub fn observe_message(&mut self, index: usize, message: &Message) {
        let Some(bus_comparator) = self.buses.get_mut(index) else { return };
        bus_comparator.handle_bus_event(line::BusConditionEvent::Message);
        update_first_joints(&mut bus_comparator.first_joints.now, message);
        if let Message::Network { from: Node::Cell(cell), epoch, page } = *message {
            bus_comparator.observe_network_page(cell, epoch, &page);
        } else if let Message::Joints { .. } | Message::Network { .. } = message {
            self.other_gateway.get_or_insert(index);
        }
        if self.tolerance.is_none() || self.is_muted {
            return;
        }
        if let Message::Configured { from, tag, answer } = *message
            && is_compared(answer)
        {
            bus_comparator.answers.entry(from).or_default().now.push_back((tag, answer));
        } else if let Message::Sum { from, epoch, torque, count } = *message
            && let Some((_, round)) =
                bus_comparator.announced_round(epoch).filter(|(_, round)| round.has_sums_of(epoch))
        {
            round.sums.now.insert(from, CellSum { torque, count });
        }
        let Some((cell, epoch, what, words)) = decode_reply(message) else { return };
        let untaken = FirstJointsState::Awaited { epoch };
        if what != ReplyKind::Torque && bus_comparator.first_joints.now.get(cell) == Some(&untaken) {
            return;
        }
        let Some((number, round)) = bus_comparator.announced_round(epoch) else { return };
        let pair = round.replies.entry((cell, what)).or_default();
        let (epoch, nanos) = (round.epoch, round.nanos);
        match pair.now {
            None => pair.now = Some(words),
            // Joints that are sent twice are answered twice.
            Some(before) if before == words => {}
            // The last reply counts, as in the capture.
            Some(_) if what != ReplyKind::Torque => pair.now = Some(words),
            Some(_) => {
                self.tally.extra += 1;
                let said = [None, Some(SentValue::Words(what, words))];
                self.first.keep_first_difference(
                    DifferenceKind::Extra,
                    bus_comparator.name_and_units(),
                    cell,
                    Some((number, epoch, nanos)),
                    said,
                );
            }
        }
    }

    /// Returns true if all awaited cells of a bus have processed the joints that were announced last.
    #[must_use]
    pub fn are_joints_processed(&self, bus_index: usize) -> bool {
        self.buses.get(bus_index).is_none_or(|bus_comparator| {
            bus_comparator.is_down() || bus_comparator.awaited_cells().next().is_none()
        })
    }

    /// Returns the number of cells that have processed the joints announced last, to show progress.
    #[must_use]
    pub fn processed_cell_count(&self, bus_index: usize) -> usize {
        self.buses.get(bus_index).map_or(0, |bus_comparator| {
            bus_comparator.present.values().filter(|present| present.progress == CellProgress::Done).count()
        })
    }

    /// Stops waiting for the cells of a bus, and returns those that have not answered.
    pub fn time_out_cells(&mut self, bus_index: usize) -> Vec<CellId> {
        self.buses.get_mut(bus_index).map_or_else(Vec::new, BusComparator::time_out_cells)
    }

    /// Returns the number of recorded torques and sums of a round that the cells on the bus have not sent in this
    /// replay yet.
    #[must_use]
    pub fn missing_reply_count(&self, bus_index: usize, number: u64) -> usize {
        let Some(bus_comparator) = self.buses.get(bus_index) else { return 0 };
        let Some(round) = number
            .checked_sub(bus_comparator.base)
            .and_then(|at| bus_comparator.rounds.get(usize::try_from(at).ok()?))
        else {
            return 0;
        };
        let is_there =
            |cell: &CellId| bus_comparator.present.get(cell).is_some_and(|present| !present.is_given_up());
        let replies = round.replies.iter().filter(|((_, what), _)| *what == ReplyKind::Torque);
        let unanswered = replies.filter(|(_, pair)| pair.recorded.is_some() && pair.now.is_none());
        let torques = unanswered.filter(|((cell, _), _)| is_there(cell)).count();
        let RecordedAndNow { recorded: then, now } = &round.sums;
        if then.is_empty() {
            return torques;
        }
        let then = EpochSums::new(then, &bus_comparator.trees.recorded, number);
        let misses = |cell: &CellId| is_there(cell) && !now.contains_cell(*cell) && then.is_in_contact(*cell);
        torques + round.sums.recorded.cells().filter(misses).count()
    }

    /// Marks a bus as down, so that its cells are not awaited until the next message arrives.
    pub fn mark_down(&mut self, bus_index: usize) {
        if let Some(bus_comparator) = self.buses.get_mut(bus_index) {
            bus_comparator.handle_bus_event(line::BusConditionEvent::Lost);
        }
    }

    /// Mutes or unmutes the comparison. While muted, it ignores replies. After unmuting, it compares replies to joints
    /// that are sent from then on.
    pub fn set_muted(&mut self, is_muted: bool) {
        self.is_muted = is_muted;
        for announced in
            self.buses.iter_mut().flat_map(|bus_comparator| bus_comparator.announced.iter_mut().flatten())
        {
            announced.round = None;
        }
    }

    /// Index of the bus on which another gateway has sent.
    #[must_use]
    pub const fn other_gateway_bus(&self) -> Option<usize> {
        self.other_gateway
    }

    /// Cells that are on a bus now.
    pub fn present_cells(&self, bus_index: usize) -> impl Iterator<Item = (CellId, &PresentCell)> {
        self.buses
            .get(bus_index)
            .into_iter()
            .flat_map(|bus_comparator| bus_comparator.present.iter().map(|(cell, it)| (*cell, it)))
    }

    /// Returns the cells on a bus that own their node id.
    pub fn settled_cells(&self, bus_index: usize) -> impl Iterator<Item = (CellId, &PresentCell)> {
        self.present_cells(bus_index).filter(|(_, present)| present.claim.is_settled())
    }

    /// Returns the cells that have no parent for their sums: they have reported none, or are unreachable.
    #[must_use]
    pub fn unreachable_cells(&self, bus_index: usize) -> Vec<CellId> {
        let settled = self.settled_cells(bus_index);
        let Some(bus_comparator) = self.buses.get(bus_index) else { return Vec::new() };
        settled.map(|(cell, _)| cell).filter(|cell| !bus_comparator.trees.now.is_reachable(*cell)).collect()
    }

    /// Compares all remaining rounds; call it once, at the end. `is_whole` is true if the whole capture was sent.
    pub fn finish(&mut self, is_whole: bool) {
        self.is_muted = true;
        for bus_comparator in self.buses.iter_mut().filter(|_| !is_whole) {
            bus_comparator.drop_unsent_replies();
        }
        for bus_comparator in 0..self.buses.len() {
            while self
                .buses
                .get(bus_comparator)
                .is_some_and(|bus_comparator| !bus_comparator.rounds.is_empty())
            {
                self.close_round(bus_comparator);
            }
        }
        for bus_comparator in &mut self.buses {
            bus_comparator.compare_answers(&mut self.tally, &mut self.first);
        }
    }

    /// Returns the counts so far.
    #[must_use]
    pub const fn tally(&self) -> &ReplyTally {
        &self.tally
    }

    /// Returns the first difference: a different, missing or extra reply.
    #[must_use]
    pub const fn first_difference(&self) -> Option<&Difference> {
        self.first.difference.as_ref()
    }
}

/// Returns false for the answer to `identify`, whose content depends on the cell's state at the time of the request.
fn is_compared(answer: Answer) -> bool {
    !matches!(answer, Answer::Value { number, .. } if number == Parameter::Identity.number())
}

/// Decodes a reply that carries the epoch of the joints that it answers or follows.
fn decode_reply(message: &Message) -> Option<(CellId, Epoch, ReplyKind, Words)> {
    let (from, epoch, what) = if let Message::Torque { from, epoch, .. } = *message {
        (from, epoch, ReplyKind::Torque)
    } else if let Message::Sensors { from, epoch, page } = *message {
        (from, epoch, ReplyKind::Sensors(page.number()))
    } else {
        return None;
    };
    Some((from, epoch, what, message.encode().words))
}

#[cfg(test)]
mod tests;
