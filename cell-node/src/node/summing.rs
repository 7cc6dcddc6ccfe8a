//! Summing in a network: which neighbour receives each sum, and when it is sent.

use protocol::fixed::Q7_8;
use protocol::id::CellId;
use protocol::message::{Message, NetworkPage, PortsPage, TreePage};
use protocol::packet::{self, Epoch};
use protocol::port::{PORTS, PortMessage, UPLINK};
use protocol::time::{Micros, Span};

use super::{AddressClaim, Node, PendingStore};
use crate::contact::Torque;
use crate::network::{Network, ParentLossReason};
use crate::sum::{EpochStart, SubtreeSum, SumWords};

/// Increase of the tolerance, in sixteenths of an epoch. It is applied each time a parent that was lost for lack of
/// answers acknowledges the leave, and so was alive all the time.
const PARENT_TOLERANCE_STEP: u16 = 2 * EPOCHS_PER_TOLERANCE_DECREASE;
/// Maximum of the tolerance, in sixteenths of an epoch.
const MAX_PARENT_TOLERANCE: u16 = 12 * EPOCHS_PER_TOLERANCE_DECREASE;
/// Number of epochs with a sum of the parent after which the tolerance has decreased by one epoch.
const EPOCHS_PER_TOLERANCE_DECREASE: u16 = 16;
/// Number of consecutive complete epochs after which joints do not wake the cell any more, but the children's sums do.
const COMPLETE_EPOCHS_BEFORE_REST: u8 = 8;
/// Maximum lateness of a check for missing sums. A check that is later than this is skipped, because the sums may still
/// be unread in the socket.
const MAX_SUM_CHECK_LATENESS: Span = Span::from_millis(1);
/// Minimum interval between two reports of the place in the tree (network page 3).
const TREE_REPORT_INTERVAL: Span = Span::from_millis(50);

/// The neighbour that receives the sum of an epoch.
#[derive(Clone, Copy, Debug, Default)]
enum SumReceiver {
    /// There is no parent.
    #[default]
    None,
    /// The parent is the gateway's side, which sends no sums.
    Gateway,
    /// The parent is the cell at a port, with its node id if known. `heard` is true if a sum of it arrived in this
    /// epoch.
    Cell { port: usize, number: Option<CellId>, heard: bool },
}

/// The state of the reports of the place in the tree.
#[derive(Debug, Default)]
pub(super) struct TreeReportState {
    /// True if the place in the tree has changed since the last report.
    pub(super) due: bool,
    /// The earliest time at which the next report may be sent.
    next: Micros,
    /// The round in the last report.
    pub(super) round: u8,
}

/// A cell's network part, its sums, and the state that connects the two.
#[derive(Debug, Default)]
pub(super) struct NetworkSums {
    pub(super) network: Network,
    pub(super) sum: SubtreeSum,
    /// For each port, the cell whose sums are received there.
    pub(super) received: [Option<CellId>; PORTS],
    received_changed: bool,
    parent: SumReceiver,
    /// True if the cell sent a sum in the previous epoch.
    sent_before: bool,
    /// Number of consecutive epochs without an answer of the parent. It is set while the parent may have missed a sum
    /// and is probed until it answers.
    unanswered: Option<u16>,
    /// Tolerated number of epochs without an answer, in sixteenths. It grows if this cell loses parents that are alive:
    /// then the machine is slow, and the cell would also lose the next parent.
    tolerance: u16,
    /// The port of a parent that was lost for lack of answers, although it may have been alive.
    suspected: Option<usize>,
    /// Number of consecutive epochs in which the cell waited for a child and the sum was complete.
    steady: u8,
    /// True if joints do not wake this cell, because the children's sums do.
    pub(super) waits_for_children: bool,
    /// Number of parent changes that the network had counted at the last read.
    changes: u16,
    pub(super) report: TreeReportState,
}

impl NetworkSums {
    /// Creates the state of a cell without wires.
    #[inline(never)]
    pub(super) fn new(now: Micros) -> Self {
        let report = TreeReportState { due: true, next: now, round: 0 };
        Self { network: Network::new(now), report, ..Self::default() }
    }

    pub(super) fn parent_with_received_sums(&self) -> Option<CellId> {
        self.received.get(self.network.parent_port()?).copied().flatten()
    }

    /// Returns true if the identifiers that the cell receives, or those that must wake it, have changed since the last
    /// call.
    pub(super) fn poll_received_ids(&mut self) -> bool {
        let waits = self.steady == COMPLETE_EPOCHS_BEFORE_REST
            && self.unanswered.is_none()
            && self.sum.awaits_children();
        self.received_changed |= core::mem::replace(&mut self.waits_for_children, waits) != waits;
        core::mem::take(&mut self.received_changed)
    }

    pub(super) fn poll_timeout(&self) -> Micros {
        let look = self.waits_for_children.then(|| self.sum.next_late_send_time());
        [self.sum.poll_timeout(), look].into_iter().flatten().fold(self.network.poll_timeout(), Micros::min)
    }

    pub(super) fn handle_timeout(&mut self, now: Micros) {
        if self.waits_for_children && now >= self.sum.next_late_send_time() {
            // No joints arrived: from now on they wake the cell again.
            self.steady = 0;
        }
        self.network.handle_timeout(now);
    }

    /// Handles a message from a port whose messages are not ignored.
    fn handle_port_message(&mut self, now: Micros, age: Span, port: usize, message: PortMessage) {
        let is_parent = self.network.parent_port() == Some(port);
        self.sum.note_frame_delay(age);
        self.network.busy = self.sum.is_sending_sums();
        if let PortMessage::State(epoch) = message {
            if self.network.is_child(port) {
                self.sum.handle_state_message(now, port, epoch);
            }
            return;
        }
        if let PortMessage::Nack(epoch) = message {
            if is_parent {
                self.handle_nack(epoch);
            }
            return;
        }
        if is_parent && matches!(message, PortMessage::Hello(_)) {
            self.unanswered = None;
            self.sum.held = false;
        }
        if message == PortMessage::LeaveAck
            && self.suspected.take_if(|suspected| *suspected == port).is_some()
        {
            self.tolerance = (self.tolerance + PARENT_TOLERANCE_STEP).min(MAX_PARENT_TOLERANCE);
        }
        self.network.handle_message(now, port, message);
    }

    /// Applies changes of parent and children to the sums.
    fn update_parent_and_children(&mut self) {
        for port in (0..PORTS).filter(|&port| !self.network.is_child(port)) {
            self.sum.remove_child(port);
        }
        if core::mem::replace(&mut self.changes, self.network.changes) != self.network.changes {
            self.unanswered = None;
            self.sum.restate = true;
            // The previous parent may have accepted what was sent in this epoch.
            self.sum.stop_sending();
        }
        if self.network.parent_port().is_none() {
            self.sum.stop_sending();
        }
        self.report.due |= core::mem::take(&mut self.network.tree_changed);
        // The sums of the parent and of the children.
        let heard = core::array::from_fn(|port| {
            let is_ours = self.network.is_child(port) || self.network.parent_port() == Some(port);
            self.network.node_id_at(port).filter(|_| is_ours && self.sum.is_enabled())
        });
        self.received_changed |= core::mem::replace(&mut self.received, heard) != heard;
    }

    /// Starts an epoch with joints that were on the bus `age` before `now`. The sums of the epoch use the tree as it is
    /// at this time.
    pub(super) fn begin_epoch(
        &mut self,
        now: Micros,
        age: Span,
        (epoch, period): (Epoch, Span),
        own: Option<Torque<'_>>,
    ) {
        let (at, up) = (now - age, self.network.parent_port());
        self.sent_before = self.sum.was_sent_in(epoch.previous());
        // A former parent accepts no sum from a cell that sent none for an epoch.
        if !self.sent_before {
            self.network.forget_former_parent(at);
        }
        self.parent = match up {
            None => SumReceiver::None,
            Some(UPLINK) => SumReceiver::Gateway,
            Some(port) => SumReceiver::Cell { port, number: self.network.node_id_at(port), heard: false },
        };
        let begin = EpochStart {
            epoch,
            at,
            period,
            depth: self.network.depth(),
            may_send: up.is_some() && self.network.is_former_parent_released(),
            children: self.network.child_mask(),
        };
        self.sum.begin_epoch(&begin, own.map(|torque| torque.exact_torques()).as_ref());
        // The age of deferred frames does not indicate a slow machine.
        if !self.waits_for_children {
            self.sum.note_frame_delay(age);
        }
        if let Some(unanswered) = self.unanswered {
            // Without an answer the parent is lost in this epoch, and a sum not sent yet may go to another
            // parent.
            if unanswered >= self.parent_tolerance() {
                self.sum.held = true;
            }
            self.probe_parent();
        }
    }

    /// Handles the sum of a neighbour. Returns true if the neighbour is a child.
    pub(super) fn handle_sum(
        &mut self,
        now: Micros,
        age: Span,
        from: CellId,
        epoch: Epoch,
        words: SumWords,
    ) -> bool {
        if let SumReceiver::Cell { port, number, heard } = &mut self.parent
            && *number == Some(from)
        {
            // A late sum of an earlier epoch also shows that the parent is alive.
            *heard |= self.network.is_receiving_port(*port);
            return false;
        }
        let Some(port) =
            self.network.child_port_of(from).filter(|&port| self.network.is_receiving_port(port))
        else {
            return false;
        };
        // Unlike a parent's sum, a child's is not deferred.
        self.sum.note_frame_delay(age);
        self.sum.receive_sum(now, port, epoch, words);
        true
    }

    /// Sends a NACK to each child whose sum of this epoch is missing, once per epoch. Returns true if the parent counts
    /// as lost.
    fn nack_missing_sums(&mut self, now: Micros) -> bool {
        let Some((epoch, nack)) = self.sum.take_missing_children() else { return false };
        for port in (0..PORTS).filter(|port| nack >> port & 1 == 1) {
            self.network.send(port, PortMessage::Nack(epoch));
        }
        let said = self.sum.was_sent_in(epoch);
        let tolerated = self.parent_tolerance();
        let mut lost = None;
        match (&mut self.unanswered, self.parent) {
            (Some(unanswered), _) => {
                *unanswered += 1;
                // A cell that sent nothing in this epoch has no lease any more.
                lost = (*unanswered > tolerated).then_some(if said {
                    ParentLossReason::Unsure
                } else {
                    ParentLossReason::Done
                });
            }
            (None, SumReceiver::Cell { heard: true, .. }) => {
                self.tolerance = self.tolerance.saturating_sub(1)
            }
            (None, SumReceiver::Cell { heard: false, .. }) => self.unanswered = said.then_some(0),
            (None, SumReceiver::Gateway | SumReceiver::None) => {}
        }
        if let Some(how) = lost {
            // The parent did not answer.
            self.unanswered = None;
            self.suspected = self.network.parent_port();
            self.sum.stop_sending();
            self.network.handle_parent_loss(now, how);
            self.update_parent_and_children();
        }
        let well = said && nack == 0 && self.unanswered.is_none() && self.sum.awaits_children();
        self.steady = if well { (self.steady + 1).min(COMPLETE_EPOCHS_BEFORE_REST) } else { 0 };
        lost.is_some()
    }

    /// Handles a NACK of the parent: resends the state message, and probes whether the parent receives this cell at
    /// all.
    fn handle_nack(&mut self, epoch: Epoch) {
        self.sum.restate = true;
        let before = self.sum.epoch.is_some_and(|present| epoch.next() == present);
        if (self.sum.epoch == Some(epoch) && self.sum.was_sent_in(epoch)) || (before && self.sent_before) {
            // The sum was assumed to be accepted.
            self.unanswered = self.unanswered.or(Some(0));
            self.probe_parent();
        }
    }

    /// Returns the tolerated number of consecutive epochs without an answer of the parent.
    const fn parent_tolerance(&self) -> u16 {
        self.tolerance.div_ceil(EPOCHS_PER_TOLERANCE_DECREASE)
    }

    /// Sends a probe to the parent. Its answer is checked before the next joints.
    fn probe_parent(&mut self) {
        if let Some(up) = self.network.parent_port() {
            self.network.send(up, PortMessage::Probe);
        }
        self.sum.schedule_missing_check();
    }
}

impl Node {
    /// Handles a message that arrived at a port `age` before `now`.
    pub fn handle_port(&mut self, now: Micros, age: Span, port: usize, message: PortMessage) {
        if self.summing.network.is_receiving_port(port) {
            self.summing.handle_port_message(now, age, port, message);
            self.apply_network_changes(now);
        }
    }

    /// Applies changes of the network to sums and node id, and reports them.
    pub(super) fn apply_network_changes(&mut self, now: Micros) {
        if !self.summing.network.has_wires() {
            return;
        }
        if let Some(cell) = self.summing.network.take_assigned_id() {
            self.identity.cell = Some(cell);
            self.claim = AddressClaim::new(self.identity, now);
            self.storing = Some(PendingStore::NodeId);
            self.summing.received_changed = true;
        }
        self.summing.update_parent_and_children();
        self.report_tree(now);
    }

    /// Sends the cell's sum if it is due, and checks for missing sums of children.
    pub(super) fn handle_sums(&mut self, now: Micros) {
        let Some(from) = self.identity.cell else { return };
        let summing = &mut self.summing;
        if let Some((epoch, SumWords { torque, count }, restarted)) = summing.sum.poll_sum(now) {
            if restarted {
                summing.network.announce_sums_to_parent(epoch);
            }
            self.mark_saturated(torque.iter().any(|word| word.is_saturated()));
            let length = self.packet_length().unwrap_or_default();
            let torque = packet::Words::new(length, torque.map(Q7_8::to_bits));
            self.queue_message(Message::Sum { from, epoch, torque, count });
        }
        let Some(late) = self.summing.sum.poll_check_lateness(now) else { return };
        // A late check is left to the next joints, when all frames before them have been received.
        if late <= MAX_SUM_CHECK_LATENESS {
            self.check_missing_sums(now);
            if self.summing.unanswered.is_some() {
                self.summing.probe_parent();
            }
        }
        if core::mem::take(&mut self.claim.sync_waits) {
            self.push_heartbeat();
        }
    }

    /// Checks for missing sums of children in this epoch, once per epoch.
    pub(super) fn check_missing_sums(&mut self, now: Micros) {
        if self.summing.sum.is_enabled() && self.summing.nack_missing_sums(now) {
            self.apply_network_changes(now);
        }
    }

    /// Reports the place in the tree if it has changed, at most every 50 ms.
    pub(super) fn report_tree(&mut self, now: Micros) {
        let report = &mut self.summing.report;
        let may = self.summing.network.has_wires() && self.claim.owns_node_id();
        if may && report.due && now >= report.next {
            (report.due, report.next) = (false, now + TREE_REPORT_INTERVAL);
            self.push_tree_page(now);
        }
    }

    /// Reports changes of the place in the tree and of the ports, with a regular heartbeat.
    pub(super) fn report_tree_with_heartbeat(&mut self, now: Micros) {
        let NetworkSums { network, report, .. } = &mut self.summing;
        if network.has_wires() {
            // A new round alone waits for the heartbeat.
            report.due |= report.round != network.rank_round();
            self.report_tree(now);
            if self.summing.network.poll_ports_changed(now) {
                self.push_ports_page(now);
            }
        }
    }

    pub(super) fn push_tree_page(&mut self, now: Micros) {
        let NetworkSums { network, sum, report, .. } = &mut self.summing;
        report.round = network.rank_round();
        let tree = TreePage {
            parent: network.parent_node_id(),
            parent_port: network.parent_port().map_or(0, |up| up.to_le_bytes()[0]),
            depth: network.depth().unwrap_or(0),
            round: report.round,
            children: network.child_mask(),
            working_ports: network.working_port_mask(now),
            sent: sum.sent,
            accepted: sum.taken,
            dropped: sum.dropped,
        };
        self.push_network_page(NetworkPage::Tree(tree));
    }

    pub(super) fn push_ports_page(&mut self, now: Micros) {
        let NetworkSums { network, .. } = &self.summing;
        let ports = PortsPage { ports: network.port_states(now), changes: network.changes };
        self.push_network_page(NetworkPage::Ports(ports));
    }
}
