//! The cell as a state machine: frames and times in, packets and times out.
//!
//! ```text
//!   frame, now, age ─> handle_frame ───┐          ┌─> poll_transmit ─> packet
//!              now ─> handle_timeout ──┼─ [Node] ─┼─> poll_timeout ──> when to call again
//!       ok or not ─> handle_stored ────┘          ├─> poll_store ────> parameters for flash
//!                                                 └─> other_owner ───> who owns this node id already
//! ```
//!
//! A node never blocks, allocates or panics, and reads no clock. Frames that it cannot use are counted by reason and
//! otherwise ignored.

mod claim;
mod configuration;
mod outbox;
mod parameters;
mod receiver;
mod rest;
mod sensing;
mod stimuli;
mod summing;
mod zero;

use protocol::can::{Format, Frame};
use protocol::fixed::{Q1_14, Q7_8};
use protocol::id::{CellId, Command, Id, Kind, Node as Address};
use protocol::message::{
    Message, NetworkPage, ReceivedCounts, SensorPage, State, StimulusStart, read_joints,
};
use protocol::packet::{self, Epoch, Length, Lengths, Packet};
use protocol::parameters::MAX_JOINTS;
use protocol::port::{PORTS, PortMessage};
use protocol::time::{Micros, Span};

use crate::baseline::Baseline;
use crate::contact::{Force, Torque};
use crate::flash::{FlashContent, FlashState};
use crate::identity::{CELL_RECEIVED_ID_COUNT, Identity};
use crate::kernel::Kernel;
use crate::sum::SumWords;
use claim::AddressClaim;
use configuration::{ActiveParameters, Configuration};
use outbox::Outbox;
use parameters::{PendingStore, VolatileParameters};
use receiver::Receiver;
use rest::RestState;
use sensing::{DuePages, SensorPageState};
use stimuli::{Stimuli, StimulusOutcome};
use summing::NetworkSums;
use zero::ReportedBaseline;

pub use claim::{HEARTBEAT_INTERVAL, MIN_CLAIM_TIME};
pub use stimuli::MAX_PENDING_STIMULI;

/// Maximum number of identifiers that a cell receives: those of its node id, and the sums of the cells at its ports.
pub const MAX_RECEIVED_IDS: usize = CELL_RECEIVED_ID_COUNT + PORTS;

/// The identifier of joints, which a cell receives most.
const JOINTS: Id = Id::command(Command::Joints);
/// The reassembly buffer of joints, of those of [`Identity::received_ids`].
const JOINTS_SLOT: usize = 1;
const _: () = {
    let [_, joints, ..] = Id::ids_received_by_cell(CellId::MAX);
    assert!(joints.to_bits() == JOINTS.to_bits(), "the buffer of joints is another one");
};

/// A cell: the state machine without input and output.
#[derive(Debug)]
pub struct Node {
    identity: Identity,
    claim: AddressClaim,
    configuration: Configuration,
    switches: VolatileParameters,
    stimuli: Stimuli,
    baseline: Baseline,
    reported: ReportedBaseline,
    sensing: SensorPageState,
    summing: NetworkSums,
    receiver: Receiver,
    received: ReceivedCounts,
    /// Stored flags of the state word, such as halted and duplicate. The other flags are added in each heartbeat.
    flags: State,
    /// Epoch of the last joints that the cell accepted.
    epoch: Option<Epoch>,
    active: bool,
    rest: RestState,
    storing: Option<PendingStore>,
    outbox: Outbox,
    /// Positions of the joints to answer, and J for them. They are here and not on the stack, so that they are written
    /// only once.
    positions: [Q1_14; MAX_JOINTS],
    jacobian: [Q1_14; MAX_JOINTS],
    sent: u16,
}

impl Node {
    /// Creates a cell that starts at `now`. The first heartbeat is the address claim. In `test_mode` the cell uses
    /// stimuli instead of sensors.
    #[must_use]
    pub fn new(identity: Identity, format: Format, flash: &FlashState, test_mode: bool, now: Micros) -> Self {
        let mut node = Self::unconfigured(identity, format, test_mode, now);
        node.restore(flash);
        node
    }

    /// Creates a cell without the contents of flash. The caller must call [`Node::restore`] next.
    #[must_use]
    // Not inlined, so that it is constructed in place instead of on the stack; the same holds for its large
    // parts.
    #[inline(never)]
    pub fn unconfigured(identity: Identity, format: Format, test_mode: bool, now: Micros) -> Self {
        Self {
            identity,
            claim: AddressClaim::new(identity, now),
            configuration: Configuration::new(),
            switches: VolatileParameters::default(),
            stimuli: Stimuli::default(),
            baseline: Baseline::default(),
            reported: ReportedBaseline::default(),
            sensing: SensorPageState::default(),
            summing: NetworkSums::new(now),
            receiver: Receiver::new(format),
            received: ReceivedCounts::default(),
            flags: State::default().with_flags(State::TEST_MODE, test_mode),
            epoch: None,
            active: false,
            rest: RestState::default(),
            storing: None,
            outbox: Outbox::new(),
            positions: [Q1_14::ZERO; MAX_JOINTS],
            jacobian: [Q1_14::ZERO; MAX_JOINTS],
            sent: 0,
        }
    }

    /// Loads the contents of flash, which contain the parameters.
    pub fn restore(&mut self, flash: &FlashState) {
        self.flags = self.flags.with_flags(State::FLASH_DAMAGED, *flash == FlashState::Damaged);
        if let FlashState::Valid(parameters) = flash {
            self.configuration.restore_parameters(parameters);
        }
    }

    /// Makes the cell compute with the sine of another build, for replays.
    #[cfg(feature = "earlier-sine")]
    #[must_use]
    pub fn with_sine(mut self, sine: protocol::sine::SineMethod) -> Self {
        self.configuration.set_sine(sine);
        self
    }

    /// Connects the ports of the cell to wires: bit p is set if port p has a wire, and bit 4 if the cell has a wire to
    /// the gateway's side.
    #[must_use]
    pub fn with_ports(mut self, wired: u8) -> Self {
        self.set_wired_ports(wired);
        self
    }

    /// Like [`Node::with_ports`], without moving the node, which takes more than half of a small microcontroller's
    /// memory. It must be called before any other method.
    pub fn set_wired_ports(&mut self, wired: u8) {
        let Identity { cell, serial } = self.identity;
        self.summing.network.set_wired_ports(wired, cell, serial);
    }

    /// Returns the next message for a port, and the port. Such messages must be sent before the packets that
    /// [`Node::poll_transmit`] returns.
    pub fn poll_port_transmit(&mut self) -> Option<(usize, PortMessage)> {
        self.summing.network.poll_transmit()
    }

    /// Returns true if the identifiers that the cell receives, or those that must wake it, have changed since the last
    /// call.
    pub fn poll_received_ids(&mut self) -> bool {
        let rest = self.rest.poll_rest_changed();
        self.summing.poll_received_ids() || rest
    }

    /// Returns the identity of the cell.
    #[must_use]
    pub const fn identity(&self) -> Identity {
        self.identity
    }

    /// Returns the serial number of another cell that owns this node id, if there is one. This cell must then stop
    /// sending.
    #[must_use]
    pub const fn other_owner(&self) -> Option<u32> {
        self.claim.other_owner
    }

    /// Returns the next packet to send, where it lies.
    pub fn poll_transmit(&mut self) -> Option<&Packet> {
        let packet = self.outbox.pop()?;
        increment(&mut self.sent);
        Some(packet)
    }

    /// Corrects the counter of sent packets for a packet that the caller collected but could not send. Packets that
    /// were collected after it must not have been sent either.
    pub const fn handle_unsent_packet(&mut self) {
        self.sent = self.sent.wrapping_sub(1);
    }

    /// Returns the time at which [`Node::handle_timeout`] must be called next. An earlier call does no harm.
    #[must_use]
    pub fn poll_timeout(&self) -> Micros {
        let next = self.claim.next_heartbeat.min(self.summing.poll_timeout());
        self.next_sensor_page_time().map_or(next, |due| next.min(due))
    }

    /// Returns the contents to write to flash, if any. The caller reports the result with [`Node::handle_stored`].
    #[must_use]
    pub fn poll_store(&self) -> Option<FlashContent> {
        let parameters = match self.storing.as_ref()? {
            PendingStore::Parameters(parameters, _) => Some(*parameters),
            PendingStore::NodeId => self.configuration.active_parameters().map(|in_use| in_use.parameters),
        };
        Some(FlashContent { number: self.identity.cell, parameters })
    }

    /// Returns the identifiers that this cell receives in its present state. The caller reads them again whenever
    /// [`Node::poll_received_ids`] returns true.
    pub fn received_ids(&self) -> impl Iterator<Item = Id> + use<'_> {
        self.received_id_slots().flatten()
    }

    /// Returns true if frames with an identifier need not wake the cell (deferred receive), provided that the cell gets
    /// them before any later frame. This holds for the parent's sums, which only show that the parent is alive. It also
    /// holds for joints, while the cell must wait for its children's sums after them anyway, or while it is not
    /// touched.
    #[must_use]
    pub fn may_receive_deferred(&self, id: Id) -> bool {
        if id == Id::command(Command::Joints) {
            return self.summing.waits_for_children || self.rest.is_deferring_joints();
        }
        self.summing
            .parent_with_received_sums()
            .is_some_and(|parent| id == Id::new(Kind::Sum, Address::Cell(parent)))
    }

    /// Returns the packet length of joints, torques and sums; `None` if the cell is not configured.
    fn packet_length(&self) -> Option<Length> {
        self.configuration.active_parameters().map(ActiveParameters::packet_length)
    }

    /// Returns the identifier for each of the [`MAX_RECEIVED_IDS`] reassembly buffers.
    fn received_id_slots(&self) -> impl Iterator<Item = Option<Id>> + use<'_> {
        let sums = self.summing.received.iter().map(|cell| Some(Id::new(Kind::Sum, Address::Cell((*cell)?))));
        self.identity.received_ids().into_iter().chain(sums)
    }

    /// Handles timers that are due at `now`. Does nothing if called early.
    pub fn handle_timeout(&mut self, now: Micros) {
        self.summing.handle_timeout(now);
        self.apply_network_changes(now);
        self.handle_sums(now);
        self.send_due_pages(now);
        self.send_due_heartbeat(now);
    }

    /// Handles a frame that arrived `age` before `now`. Frames with identifiers that this cell does not receive are
    /// ignored.
    pub fn handle_frame(&mut self, now: Micros, age: Span, frame: &Frame) {
        let Ok(id) = packet::data_frame_id(frame) else {
            increment(&mut self.receiver.refused.foreign);
            return;
        };
        let lengths = Lengths::from_chain_length(self.packet_length());
        if id == JOINTS {
            return self.handle_joints_frame(now, age, lengths, frame);
        }
        let Some(slot) = self.received_id_slots().position(|heard| heard == Some(id)) else { return };
        let packet = self.receiver.receive_frame(now - age, id, slot, lengths, frame);
        let Some(packet) = packet.map(|packet| packet.to_packet()) else { return };
        match Message::decode(&packet) {
            Ok(message) => self.handle_message(now, age, message),
            Err(_) => increment(&mut self.receiver.refused.meaning),
        }
    }

    /// Handles a frame of joints. The packet is read where it lies: the answer waits for it.
    fn handle_joints_frame(&mut self, now: Micros, age: Span, lengths: Lengths, frame: &Frame) {
        if self.identity.cell.is_none() {
            return;
        }
        let packet = self.receiver.receive_frame(now - age, JOINTS, JOINTS_SLOT, lengths, frame);
        let Some(packet) = packet else { return };
        let epoch = packet.epoch();
        let Ok(count) = read_joints(&packet, &mut self.positions) else {
            return increment(&mut self.receiver.refused.meaning);
        };
        let accepted = self.received.joints;
        self.handle_joints(now, age, epoch, count);
        // Stimuli latched at joints that were too old are sent with the next ones.
        if self.received.joints != accepted {
            self.send_changed_pages(now);
            self.report_zero_if_changed();
        }
        self.send_pages_before_next_joints(now);
        self.send_due_before_next_joints(now);
    }

    fn handle_message(&mut self, now: Micros, age: Span, message: Message) {
        if !matches!(message, Message::Sync | Message::Report) {
            self.rest.end_rest();
        }
        match message {
            Message::Halt => {
                self.flags = self.flags.with_flags(State::HALTED, true);
                self.active = false;
            }
            Message::Resume => self.flags = self.flags.with_flags(State::HALTED, false),
            Message::Stimulus { from, page, .. } => self.handle_stimulus(from, page),
            Message::Network { page, .. } => self.handle_own_node_id(now, &page),
            // A cell does not answer until it owns its node id.
            Message::Sync | Message::Report | Message::Configure { .. } if !self.claim.owns_node_id() => {}
            Message::Sync if self.summing.sum.are_all_sums_sent(now) => self.push_heartbeat(),
            Message::Sync => {
                self.claim.sync_waits = true;
                self.summing.sum.schedule_missing_check();
            }
            Message::Report => {
                self.push_network_page(NetworkPage::Received(self.received));
                self.push_network_page(NetworkPage::Rejected(self.receiver.refused));
                self.push_sensor_pages(DuePages::ALL);
                self.push_zero_page();
                if self.summing.network.has_wires() {
                    self.push_tree_page(now);
                    self.push_ports_page(now);
                }
            }
            Message::Configure { tag, request, .. } => {
                self.handle_request(now, tag, request);
                // A new mode starts from the present state, and a cell that leaves test mode has no contact.
                self.send_changed_pages(now);
                self.report_zero_if_changed();
            }
            Message::Sum { torque, .. }
                if self.packet_length().is_some_and(|length| torque.length() != length) =>
            {
                increment(&mut self.receiver.refused.meaning);
            }
            Message::Sum { from, epoch, torque, count } => {
                let torque = torque.padded().map(Q7_8::from_bits);
                if self.summing.handle_sum(now, age, from, epoch, SumWords { torque, count }) {
                    self.handle_sums(now);
                }
            }
            // Joints are handled before they become a message; the others are never received.
            Message::Joints { .. }
            | Message::Torque { .. }
            | Message::Sensors { .. }
            | Message::Configured { .. } => {}
        }
    }

    /// Computes the torques for the new joint positions by the paper's Eq. 8 and Algorithm 1, and replies with them.
    /// `count` is the number of joints in use.
    fn handle_joints(&mut self, now: Micros, age: Span, epoch: Epoch, count: u8) {
        if self.epoch == Some(epoch) {
            increment(&mut self.received.joints_repeated);
            return;
        }
        // All frames before these joints have been received.
        self.check_missing_sums(now);
        let in_use = self.configuration.active_parameters();
        if in_use.is_some_and(|in_use| in_use.parameters.joints != count) {
            increment(&mut self.receiver.refused.meaning);
            return;
        }
        // Old joints are not answered, but their stimuli are latched. Otherwise a cell that hung would keep
        // its previous contact state.
        self.epoch = Some(epoch);
        self.stimuli.apply_stimuli_until(epoch);
        if let Some(in_use) = in_use {
            self.baseline.process_joints(&self.stimuli.sensed.skin, in_use.parameters.period_us);
        }
        if in_use.is_some_and(|in_use| age > in_use.broadcast_period()) {
            increment(&mut self.received.joints_late);
            self.rest.end_rest();
            return self.summing.sum.skip_epoch();
        }
        increment(&mut self.received.joints);
        let answers = self.claim.owns_node_id() && !self.flags.has(State::HALTED);
        let Some(in_use) = in_use.filter(|_| answers) else { return self.summing.sum.skip_epoch() };
        let sensed = &self.stimuli.sensed.skin;
        let contact = self.baseline.net_contact(sensed);
        let force = Force::fuse(contact, sensed.proximity, &in_use.parameters.contact);
        if force.is_active() {
            in_use.kernel.write_jacobian(&self.positions, &mut self.jacobian);
        }
        if self.summing.sum.is_enabled() {
            self.active = force.is_active();
            let moved = self.jacobian.get(..in_use.parameters.joint.into()).unwrap_or_default();
            let torque = force.is_active().then(|| Torque::new(moved, force));
            self.summing.begin_epoch(now, age, (epoch, in_use.broadcast_period()), torque);
            return self.handle_sums(now);
        }
        self.answer_joints(epoch, force);
    }

    /// Replies with the cell's own torque, for the J that has been computed. A single reply of zero marks the end of a
    /// contact.
    fn answer_joints(&mut self, epoch: Epoch, force: Force) {
        let (Some(from), Some(in_use)) = (self.identity.cell, self.configuration.active_parameters()) else {
            return;
        };
        if force.is_active() {
            self.active = true;
        } else if core::mem::take(&mut self.active) {
            // The zero that ends the contact.
        } else if self.stimuli.has_pending() || self.baseline.is_on() {
            // A pending stimulus, or a zero that follows the sensor, may change the contact state at any joints.
            return;
        } else if self.summing.network.has_wires() {
            // A cell of a network stays awake for its neighbours.
            return;
        } else {
            return self.rest.count_quiet_joints();
        }
        let Some(packet) = self.outbox.push() else { return };
        (packet.id, packet.epoch, packet.count) = (Id::new(Kind::Torque, Address::Cell(from)), epoch, 1);
        packet.words = packet::Words::zeros(in_use.packet_length());
        if force.is_active() {
            let moved = self.jacobian.get(..in_use.parameters.joint.into()).unwrap_or_default();
            Torque::new(moved, force).write_words(in_use.kernel.rounding(), packet.words.as_mut_slice());
        }
        let is_saturated = packet.words.is_saturated();
        self.mark_saturated(is_saturated);
        increment(&mut self.received.torques);
    }

    /// Sends hellos and a heartbeat now if they are due before the next joints, so that the cell need not wake up
    /// again.
    fn send_due_before_next_joints(&mut self, now: Micros) {
        let Some(in_use) = self.configuration.active_parameters() else { return };
        let next_joints = now + in_use.broadcast_period();
        self.summing.network.send_hellos_due_by(now, next_joints);
        self.report_tree(now);
        if self.claim.owns_node_id() && next_joints > self.claim.next_heartbeat {
            self.send_regular_heartbeat(now);
        }
    }

    fn handle_stimulus(&mut self, from: StimulusStart, page: SensorPage) {
        let obeys = self.flags.has(State::TEST_MODE);
        let arrival =
            if obeys { self.stimuli.push_stimulus(from, page, self.epoch) } else { StimulusOutcome::Refused };
        match arrival {
            StimulusOutcome::InTime => increment(&mut self.received.stimuli),
            StimulusOutcome::Late => {
                increment(&mut self.received.stimuli);
                increment(&mut self.received.stimuli_late);
            }
            StimulusOutcome::Refused => increment(&mut self.receiver.refused.stimuli),
        }
    }

    /// Sets the *saturated* flag of the next heartbeat if a word that was sent is saturated.
    fn mark_saturated(&mut self, saturated: bool) {
        self.flags = self.flags.with_flags(State::SATURATED, saturated || self.flags.has(State::SATURATED));
    }

    fn push_network_page(&mut self, page: NetworkPage) {
        let Some(cell) = self.identity.cell else { return };
        let from = Address::Cell(cell);
        self.queue_message(Message::Network { from, epoch: self.epoch.unwrap_or_default(), page });
    }

    /// Queues a message. There is always room, because one frame causes at most four packets and the caller collects
    /// them after each frame.
    // Not inlined: joints, which a cell receives most often, are not handled here.
    #[inline(never)]
    fn queue_message(&mut self, message: Message) {
        let slot = self.outbox.push();
        debug_assert!(slot.is_some(), "a shell takes what is to be sent after each call");
        if let Some(packet) = slot {
            *packet = message.encode();
        }
    }
}

const fn increment(counter: &mut u16) {
    *counter = counter.wrapping_add(1);
}

#[cfg(test)]
mod tests;
