//! Receives frames, and applies their messages to the table of a bus.

use protocol::can::Frame;
use protocol::id::{CellId, Command, Id, Kind, Node};
use protocol::message::{Heartbeat, Message, NetworkPage, Request, SensorPage, State, StimulusStart};
use protocol::packet::{Epoch, Words};
use protocol::parameters::Parameter;
use protocol::time::Micros;

use super::cell::CellState;
use super::held::TorqueSumChange;
use super::replies::ReplyExpectation;
use super::root_totals::{RootSum, RootSumUse, RootTotals};
use super::{BusTable, FrameEvent, Notice, PositionLookup};
use crate::tracker::{CellUpdate, HeartbeatKind};
use protocol::packets::{FrameWithPacket, NoPacketReason, PendingSegments};

/// Parameters whose write changes at once how a cell answers.
const REPLY_PARAMETERS: [Parameter; 3] = [Parameter::Mode, Parameter::Reply, Parameter::Commit];

impl BusTable {
    /// Reassembles and decodes a frame of this bus, for [`handle_read_frame`](Self::handle_read_frame) and other consumers.
    pub fn read_frame<'f>(&mut self, at: Micros, frame: &'f Frame) -> FrameWithPacket<'f> {
        self.packets.read(at, frame)
    }

    /// Handles a frame that was on the bus at `at`; `own` is true if this gateway sent it. For a broadcast of this
    /// gateway, `positions` returns the positions in rad or m from which its words were rounded, if they are known.
    pub fn handle_frame(&mut self, at: Micros, own: bool, frame: &Frame, positions: &mut PositionLookup<'_>) {
        let (packet, pending) = self.packets.read_packet(at, frame);
        match packet {
            Ok(packet) => {
                let message = self.packets.decode(&packet);
                self.receive_packet(at, own, packet.id, message.as_ref().ok(), positions);
            }
            Err(no_packet) => self.count_frame_without_packet(own, frame, no_packet, pending),
        }
    }

    /// Does [`handle_frame`](Self::handle_frame) for a frame that has been [`read`](Self::read_frame).
    pub fn handle_read_frame(
        &mut self,
        at: Micros,
        own: bool,
        received: &FrameWithPacket<'_>,
        positions: &mut PositionLookup<'_>,
    ) {
        match &received.packet {
            Ok((packet, message)) => {
                self.receive_packet(at, own, packet.id, message.as_ref().ok(), positions);
            }
            Err(no_packet) => {
                self.count_frame_without_packet(own, received.frame, *no_packet, received.pending)
            }
        }
    }

    #[inline(always)]
    fn receive_packet(
        &mut self,
        at: Micros,
        own: bool,
        id: Id,
        message: Option<&Message>,
        positions: &mut PositionLookup<'_>,
    ) {
        self.counters.count_frame(id.kind, own);
        match message {
            Some(message) if own => self.handle_own_message(at, message, positions),
            Some(message) => self.handle_foreign_message(at, id, message),
            None => self.count_unusable_frame(id, own, FrameEvent::Meaning),
        }
    }

    /// Counts a frame that neither is nor completes a packet.
    fn count_frame_without_packet(
        &mut self,
        own: bool,
        frame: &Frame,
        no_packet: NoPacketReason,
        pending: PendingSegments,
    ) {
        let (id, event) = match no_packet {
            NoPacketReason::NotData => {
                let is_error = frame.is_error();
                return self.counters.count_event(if is_error {
                    FrameEvent::ErrorFrame
                } else {
                    FrameEvent::Foreign
                });
            }
            NoPacketReason::Segment(id) if pending.before == 0 || self.is_sender_in_skin(id) => return,
            // Each foreign frame counts as such, not as an incomplete packet.
            NoPacketReason::Segment(id) => (id, FrameEvent::Foreign),
            NoPacketReason::AfterLost(id) => (id, FrameEvent::Incomplete),
            NoPacketReason::Damaged(id, error) => (id, FrameEvent::from(error)),
        };
        if !own && !self.is_sender_in_skin(id) {
            return self.counters.count_event(FrameEvent::Foreign);
        }
        self.counters.count_frame(id.kind, own);
        self.count_unusable_frame(id, own, event);
    }

    /// Returns true if the skin describes a sender with this identifier on this bus.
    fn is_sender_in_skin(&self, id: Id) -> bool {
        let is_cell = |cell: CellId| self.index_of(cell).is_some();
        match (id.kind, Node::from_byte(id.node)) {
            (Kind::Command, _) => Command::from_byte(id.node).is_some(),
            (Kind::Network, Node::Gateway) | (Kind::Configure | Kind::Stimulus, Node::Everyone) => true,
            (_, Node::Cell(cell)) => is_cell(cell),
            (_, Node::Gateway | Node::Everyone) => false,
        }
    }

    /// Counts an unusable frame, for the bus and for the cell with its identifier.
    fn count_unusable_frame(&mut self, id: Id, own: bool, event: FrameEvent) {
        self.counters.count_event(event);
        if let (false, Some(cell)) = (own, self.sender_mut(id)) {
            cell.tracked.account.count_rejected();
        }
    }

    /// Handles a frame of this gateway, read back from the bus.
    pub(super) fn handle_own_message(
        &mut self,
        at: Micros,
        message: &Message,
        positions: &mut PositionLookup<'_>,
    ) {
        if let Message::Joints { epoch, joints } = *message {
            self.open_epoch(at, epoch, &joints, positions(epoch));
        } else if let Message::Stimulus { to, from, page } = *message {
            self.record_stimulus(to, from, page);
        } else if let Message::Configure { to, request: Request::Write { number, .. }, .. } = *message {
            if number == Parameter::Mode.number() {
                self.record_parameter_write(to, number);
            }
        } else if *message == Message::Halt {
            self.change_all_cells(CellState::halt);
        } else if *message == Message::Sync {
            self.cells.iter_mut().for_each(|cell| cell.said.heartbeat = false);
        } else if *message == Message::Report {
            self.cells.iter_mut().for_each(|cell| cell.said.counters = false);
        }
    }

    /// Handles a frame of another sender.
    pub(super) fn handle_foreign_message(&mut self, at: Micros, id: Id, message: &Message) {
        // A command-line tool may also send a gateway's messages.
        match *message {
            Message::Joints { .. } => {
                self.counters.count_event(FrameEvent::OtherGateway);
                // A gateway sends joints continuously; a single frame may come from any sender.
                if self.outsiders.record_joints(at) {
                    self.snapshot.sums.other_gateways += 1;
                    self.notices.push_back(Notice::OtherGateway);
                }
            }
            Message::Network { from: Node::Gateway, .. } => {
                self.counters.count_event(FrameEvent::OtherGateway)
            }
            Message::Halt => {
                self.snapshot.sums.halts += 1;
                self.change_all_cells(CellState::halt);
            }
            Message::Resume => {
                self.snapshot.sums.resumes += 1;
                self.cells.iter_mut().for_each(CellState::resume);
            }
            Message::Stimulus { to, from, page } => self.record_stimulus(to, from, page),
            Message::Configure { to, request: Request::Write { number, .. }, .. }
                if REPLY_PARAMETERS.iter().any(|parameter| parameter.number() == number) =>
            {
                self.counters.count_event(FrameEvent::OtherWriter);
                self.record_parameter_write(to, number);
            }
            Message::Sync | Message::Report | Message::Configure { .. } => {}
            Message::Sum { .. }
            | Message::Torque { .. }
            | Message::Sensors { .. }
            | Message::Network { .. }
            | Message::Configured { .. } => self.receive_from_cell(at, id, message),
        }
    }

    fn record_stimulus(&mut self, to: Node, from: StimulusStart, page: SensorPage) {
        let last = self.broadcast.map(|broadcast| broadcast.epoch);
        for cell in self.cells.iter_mut().filter(|cell| to.addresses_cell(cell.node)) {
            cell.stimulate(from, page, last);
        }
    }

    fn record_parameter_write(&mut self, to: Node, number: u8) {
        self.cells
            .iter_mut()
            .filter(|cell| to.addresses_cell(cell.node))
            .for_each(|cell| cell.record_parameter_write(number));
    }

    fn receive_from_cell(&mut self, at: Micros, id: Id, message: &Message) {
        let Some(place) = self.places.get(usize::from(id.node).wrapping_sub(1)).copied().flatten() else {
            self.counters.count_event(FrameEvent::UnknownNode);
            if let Message::Network {
                from: Node::Cell(node), page: NetworkPage::Heartbeat(heartbeat), ..
            } = *message
            {
                self.outsiders.nodes.insert(node, heartbeat);
            }
            return;
        };
        let Some(cell) = self.cells.get_mut(place) else { return };
        let update =
            cell.tracked.record_packet(at, message, self.broadcast.map(|broadcast| broadcast.number));
        if update.revived {
            self.snapshot.sums.dead -= 1;
            self.notices.push_back(Notice::Revived(cell.node));
        }
        let is_answer = if let Message::Network { page, .. } = message {
            page.is_sent_only_on_request()
        } else {
            matches!(message, Message::Sensors { .. })
        };
        if !is_answer {
            cell.sensed.end_report();
        }
        if let Message::Network { epoch, page, .. } = *message {
            if let NetworkPage::Heartbeat(heartbeat) = page {
                self.receive_heartbeat(at, place, &update, &heartbeat, epoch);
            } else if let NetworkPage::Received(_) = page {
                cell.sensed.begin_report();
                cell.record_receive_counters(
                    self.broadcast.as_ref().map_or(0, |newest| newest.broadcasts_since(epoch)),
                );
            } else if let NetworkPage::Rejected(_) = page {
                cell.said.counters = true;
            } else if let NetworkPage::Tree(tree) = page
                && cell.root
                && self.root_totals.as_ref().is_some_and(|totals| !totals.follows_wires)
            {
                let root = cell.node;
                self.set_root_feeds_gateway(root, tree.parent == Some(0));
            }
        } else if let Message::Sensors { epoch, page, .. } = *message {
            let is_newest = self.broadcast.as_ref().is_none_or(|broadcast| broadcast.epoch == epoch);
            cell.record_sensors(at, &page, is_newest, &self.events);
        } else if let Message::Configured { answer, .. } = *message {
            cell.receive_answer(&answer);
        } else if let Message::Torque { epoch, torque, .. } = *message {
            self.receive_torque(at, place, epoch, &torque);
        } else if let Message::Sum { epoch, count, torque, .. } = *message {
            self.receive_sum(at, place, epoch, RootSum { count, words: torque.padded().map(i32::from) });
        }
    }

    fn receive_heartbeat(
        &mut self,
        at: Micros,
        place: usize,
        update: &CellUpdate,
        heartbeat: &Heartbeat,
        epoch: Epoch,
    ) {
        let Some(cell) = self.cells.get_mut(place) else { return };
        let takes_joints = update.word == Some(HeartbeatKind::Continued)
            && !heartbeat.state.has(State::CLAIMING_NODE_ID)
            && !heartbeat.state.has(State::HALTED);
        if takes_joints && let Some(broadcast) = &self.broadcast {
            self.delays.record_pending_joints_age(broadcast.pending_joints_age(epoch, at));
        }
        if heartbeat.state.has(State::DUPLICATE) {
            self.counters.count_event(FrameEvent::Duplicate);
            self.notices.push_back(Notice::Duplicate(cell.node));
        }
        if matches!(update.word, Some(HeartbeatKind::Started { again: true } | HeartbeatKind::Shared)) {
            self.notices.push_back(Notice::Restarted(cell.node));
        }
        if update.returned {
            self.notices.push_back(Notice::Returned(cell.node));
        }
        let change = cell.apply_heartbeat(update, heartbeat, epoch);
        self.apply(change);
    }

    fn receive_torque(&mut self, at: Micros, place: usize, epoch: Epoch, torque: &Words) {
        if self.root_totals.is_some() {
            return self.counters.count_event(FrameEvent::UnknownNode);
        }
        let Some(broadcast) = &mut self.broadcast else {
            return self.counters.count_event(FrameEvent::StaleTorque);
        };
        let Some(cell) = self.cells.get_mut(place) else { return };
        let Some(lag) = broadcast.lag_in_broadcasts(epoch) else {
            cell.replies.too_late += 1;
            return self.counters.count_event(FrameEvent::StaleTorque);
        };
        let number = broadcast.number - lag as u64;
        if cell.answered.is_some_and(|last| number <= last) {
            if cell.answered == Some(number) {
                return self.counters.count_event(FrameEvent::RepeatedTorque);
            }
            cell.replies.too_late += 1;
            return self.counters.count_event(FrameEvent::StaleTorque);
        }
        if torque.is_saturated() {
            self.counters.count_event(FrameEvent::Saturated);
        }
        let format = self.carried.torque_format;
        let is_zero = torque.as_slice().iter().all(|&word| word == 0);
        let asked = cell.record_reply(number, lag, is_zero);
        self.delays.record_reply_delay(at.elapsed_since(broadcast.broadcast_time(lag)));
        if lag == 0 {
            broadcast.last_reply = Some(at);
            broadcast.in_time += u32::from(asked == ReplyExpectation::Due);
            broadcast.is_whole &=
                asked == ReplyExpectation::Due || is_zero && asked == ReplyExpectation::NotDue;
        }
        if let (ReplyExpectation::Due, Some(expected)) = (asked, cell.outstanding.expected_torques(number)) {
            let error = self.accuracy.compare_cell_torque(
                cell.joint,
                format,
                torque,
                &expected,
                &mut cell.outstanding.errors,
            );
            cell.outstanding.stuck.compare_torque(
                torque.padded(),
                expected.quantised.map(|torque| format.nearest_word(torque)),
            );
            if lag == 0 {
                for (sum, error) in broadcast.error.iter_mut().zip(error) {
                    *sum += error;
                }
            }
        }
        let change = cell.hold_torque(torque.padded().map(|word| format.to_finest_steps(word)));
        self.apply(change);
    }

    fn receive_sum(&mut self, at: Micros, place: usize, epoch: Epoch, sum: RootSum) {
        let (Some(root_totals), Some(cell)) = (&mut self.root_totals, self.cells.get_mut(place)) else {
            return self.counters.count_event(FrameEvent::UnknownNode);
        };
        root_totals.counts.received += 1;
        let Some(sums) = cell.sums.as_mut().filter(|sums| sums.is_for_gateway) else {
            root_totals.counts.overheard += 1;
            return;
        };
        let found = self.broadcast.as_mut().and_then(|broadcast| {
            let lag = broadcast.lag_in_broadcasts(epoch)?;
            Some((lag, sums.epochs.get_mut(lag)?, broadcast))
        });
        let Some((lag, best, broadcast)) = found else {
            root_totals.counts.stale += 1;
            return;
        };
        if root_totals.record_sum(lag, best, sum) == RootSumUse::Resent {
            return;
        }
        if lag == 0 {
            broadcast.last_reply = Some(at);
        }
        let number = broadcast.number - lag as u64;
        if sum.is_saturated() {
            self.counters.count_event(FrameEvent::Saturated);
        }
        // In the steps of the running sum.
        let change = cell.hold_sum(number, sum.count, sum.words_in_q3_12());
        self.apply(change);
        self.release_duplicate_sums(number);
    }

    /// Releases the held sum of a silent root once the sum of another root contains its cells.
    fn release_duplicate_sums(&mut self, number: u64) {
        let Some(due) = self.root_totals.as_ref().and_then(RootTotals::due_cell_count) else { return };
        if self.snapshot.sums.contributing > due {
            self.change_all_cells(|cell| {
                if cell.is_torque_outdated(number) {
                    cell.release_torque()
                } else {
                    TorqueSumChange::default()
                }
            });
        }
    }
}
