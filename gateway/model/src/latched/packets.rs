//! The packets with which a recording must begin, if it begins in the middle of a run.
//!
//! ```text
//!   frames of a bus ──> take ──> [ Latched ] ──> frames with a lasting effect, in the bus' order
//! ```
//!
//! For every cell these packets are its last heartbeat with the hash of its configuration, its last start, its place in
//! the tree, its switches and the parameters written at run time, and its stimuli, latched or pending. For the bus they
//! are the last joints, and the last halt or resume. Epochs count modulo 256, so a stimulus alone does not show whether
//! it is still pending. Therefore each stimulus is kept with the joints before it and the joints that latch it. A
//! receiver that applies these packets in order, by the rules of the protocol, reaches the same state as one that
//! received all packets.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::can::{Format, Frame};
use protocol::id::{Id, Kind};
use protocol::message::{Answer, Heartbeat, Message, NetworkPage, Request, SensorPage, State};
use protocol::packet::{self, Epoch, PacketError, Reassembler};
use protocol::parameters::Parameter;
use protocol::time::Micros;

use crate::tracker::{AddressClaim, ContactState, HeartbeatKind, PerCell};
use protocol::packets::{ByIdentifier, NoPacketReason, PacketReader};

/// A frame that was received from the bus.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LatchedFrame {
    /// Arrival time in ns since 1970.
    pub at_nanos: u64,
    /// True if the gateway sent the frame.
    pub from_gateway: bool,
    /// The frame.
    pub frame: Frame,
}

/// The frames of one packet, and the packet's position in the order of the bus.
#[derive(Debug)]
struct PlacedPacket {
    place: u64,
    frames: Vec<LatchedFrame>,
}

type SharedPacket = Option<Arc<PlacedPacket>>;

/// A sensors page that a cell has latched. It is kept with the joints before it and the joints at which it was latched.
#[derive(Clone, Debug)]
struct LatchedSensorPage {
    placed_packet: Arc<PlacedPacket>,
    before: SharedPacket,
    since: SharedPacket,
}

/// The packets of one cell that still have an effect.
#[derive(Clone, Debug, Default)]
struct LatchedCell {
    claim: AddressClaim,
    /// The last heartbeat.
    heartbeat: SharedPacket,
    /// The first and the last heartbeat since the cell's last start.
    starts: [SharedPacket; 2],
    /// The last report of the cell's parent in the tree.
    tree: SharedPacket,
    /// The last write of each volatile parameter.
    switches: BTreeMap<u8, Arc<PlacedPacket>>,
    /// The last write of each parameter that a commit activated, and that commit.
    committed: BTreeMap<u8, Arc<PlacedPacket>>,
    commit: SharedPacket,
    /// The last write of each parameter since the last commit, and a commit that has not been answered yet.
    staged: BTreeMap<u8, Arc<PlacedPacket>>,
    requested: SharedPacket,
    contact: ContactState<LatchedSensorPage>,
    /// The packet with which the cell proved that all its stimuli are on the bus: its counters, or its answer to a
    /// write of its mode.
    shown: SharedPacket,
}

/// The packets of one bus that still have an effect, as they were on the bus.
#[derive(Clone, Debug)]
pub struct LatchedPackets {
    /// Number of packets so far; gives each packet its position in the order of the bus.
    packet_count: u64,
    cells: PerCell<LatchedCell>,
    joints: Option<(Epoch, Arc<PlacedPacket>)>,
    /// The last halt or resume.
    halt: SharedPacket,
    packets: PacketReader,
    /// Segments of incomplete packets, by identifier.
    waiting: ByIdentifier<Vec<LatchedFrame>>,
    /// Identifiers of the gateway's packets with pending segments, each with the time of its newest segment in ns since
    /// 1970.
    open: BTreeMap<u16, u64>,
}

impl Default for LatchedPackets {
    fn default() -> Self {
        Self {
            packet_count: 0,
            cells: PerCell::default(),
            joints: None,
            halt: None,
            packets: PacketReader::new(None),
            waiting: ByIdentifier::default(),
            open: BTreeMap::new(),
        }
    }
}

impl LatchedCell {
    /// Resets the contact state to no contact, after a start or a write of the mode. `obeys` is true for a cell in test
    /// mode.
    fn reset_contact(&mut self, obeys: bool) {
        self.contact.record_mode_write();
        self.contact.set_obeys_stimuli(obeys);
        self.shown = None;
    }

    /// Passes to the contact state a page that may prove that all stimuli were received here. Keeps the packet if the
    /// page proves it.
    fn apply_stimulus_proof(
        &mut self,
        contact_page: LatchedSensorPage,
        show: impl FnOnce(&mut ContactState<LatchedSensorPage>, LatchedSensorPage),
    ) {
        let placed_packet = Arc::clone(&contact_page.placed_packet);
        let before = self.contact.certain_skin().is_some();
        show(&mut self.contact, contact_page);
        if !before && self.contact.certain_skin().is_some() {
            self.shown = Some(placed_packet);
        }
    }

    fn apply_heartbeat(&mut self, heartbeat: &Heartbeat, placed_packet: &Arc<PlacedPacket>) {
        let at = placed_packet.frames.last().map_or(Micros(0), |seen| Micros(seen.at_nanos / 1_000));
        let word = self.claim.receive(at, heartbeat);
        if matches!(word, HeartbeatKind::Claimant | HeartbeatKind::Outsider) {
            return;
        }
        if let HeartbeatKind::Started { .. } = word {
            self.reset_contact(true);
            self.switches.clear();
            self.staged.clear();
            self.requested = None;
        }
        if heartbeat.state.has(State::CLAIMING_NODE_ID) {
            let [first, last] = &mut self.starts;
            if heartbeat.sent == 0 {
                *first = Some(Arc::clone(placed_packet));
            }
            *last = Some(Arc::clone(placed_packet));
        }
        self.heartbeat = Some(Arc::clone(placed_packet));
    }

    fn apply_write(&mut self, number: u8, placed_packet: &Arc<PlacedPacket>, obeys: bool) {
        let parameter = Parameter::from_number(number);
        if parameter == Some(Parameter::Commit) {
            self.requested = Some(Arc::clone(placed_packet));
        } else if parameter.is_some_and(Parameter::is_volatile) {
            self.switches.insert(number, Arc::clone(placed_packet));
        } else if parameter.is_some() {
            self.staged.insert(number, Arc::clone(placed_packet));
        }
        if parameter == Some(Parameter::Mode) {
            self.reset_contact(obeys);
        }
    }

    /// Marks as active the parameters that were written before the last requested commit.
    fn activate_committed(&mut self) {
        let Some(requested) = self.requested.take() else { return };
        let staged = std::mem::take(&mut self.staged).into_iter();
        let (mut taken, later): (BTreeMap<_, _>, _) =
            staged.partition(|(_, placed_packet)| placed_packet.place < requested.place);
        self.committed.append(&mut taken);
        (self.staged, self.commit) = (later, Some(requested));
    }

    /// Applies the cell's own report of its sensors, which counts only if the contact state is not known otherwise.
    fn apply_sensor_report(&mut self, page: SensorPage, contact_page: LatchedSensorPage) {
        let joints = contact_page.before.as_ref().map_or(0, |joints| joints.place);
        if !self
            .contact
            .pending_stimuli()
            .iter()
            .any(|(_, _, contact_page)| contact_page.placed_packet.place < joints)
        {
            self.contact.apply_reported_page(page, contact_page);
        }
    }

    fn packets(&self) -> impl Iterator<Item = &Arc<PlacedPacket>> {
        let placed_packet = [&self.heartbeat, &self.tree, &self.commit, &self.requested, &self.shown]
            .into_iter()
            .chain(&self.starts);
        let written = self.switches.values().chain(self.committed.values()).chain(self.staged.values());
        let waiting = self.contact.pending_stimuli().iter().map(|(_, _, contact_page)| contact_page);
        let contact_page = self.contact.latched_pages().map(|(_, contact_page)| contact_page).chain(waiting);
        let contact_page = contact_page.flat_map(|LatchedSensorPage { placed_packet, before, since }| {
            core::iter::once(placed_packet).chain(before).chain(since)
        });
        placed_packet.flatten().chain(written).chain(contact_page)
    }
}

impl LatchedPackets {
    /// Applies a frame from the bus; ignores frames that are not packets. Bounded work.
    pub fn receive(&mut self, seen: LatchedFrame) {
        let Ok(id) = packet::data_frame_id(&seen.frame) else { return };
        match id.kind {
            Kind::Command | Kind::Network | Kind::Stimulus | Kind::Configure => {}
            Kind::Sensors | Kind::Configured => {}
            Kind::Sum | Kind::Torque => return,
        }
        let (packet, pending) = self.packets.read_packet(Micros(seen.at_nanos / 1_000), &seen.frame);
        let packet = match packet {
            Ok(packet) => packet,
            Err(
                NoPacketReason::Segment(_)
                | NoPacketReason::AfterLost(_)
                | NoPacketReason::Damaged(_, PacketError::Ambiguous),
            ) => {
                let waiting = self.waiting.entry(id);
                waiting.push(seen);
                waiting.drain(..waiting.len().saturating_sub(pending.after));
                if !id.kind.is_from_cells() {
                    self.open.insert(id.to_bits(), seen.at_nanos);
                }
                return;
            }
            Err(NoPacketReason::NotData | NoPacketReason::Damaged(..)) => return,
        };
        // Exactly as much memory as the packet needs: many packets are kept.
        let frames = if seen.frame.format() == Format::Fd {
            vec![seen]
        } else {
            self.open.remove(&id.to_bits());
            let waiting = self.waiting.entry(id);
            waiting.push(seen);
            let first = waiting.len().saturating_sub(packet.words.length().segments());
            let frames = waiting.drain(first..).collect();
            waiting.clear();
            frames
        };
        let Ok(message) = self.packets.decode(&packet) else { return };
        self.packet_count += 1;
        self.apply_message(&message, &Arc::new(PlacedPacket { place: self.packet_count, frames }));
    }

    /// Returns true if segments of a gateway packet are pending. A new part of the recording must not begin between
    /// these segments.
    #[must_use]
    pub fn is_within_a_packet(&self, now_nanos: u64) -> bool {
        let within = |bits: u16| Reassembler::max_gap(Id::from_bits(bits)).0 * 1_000;
        self.open.iter().any(|(bits, at)| now_nanos < at.saturating_add(within(*bits)))
    }

    fn apply_message(&mut self, message: &Message, placed_packet: &Arc<PlacedPacket>) {
        let last = self.joints.as_ref().map(|(epoch, _)| *epoch);
        let contact_page = || LatchedSensorPage {
            placed_packet: Arc::clone(placed_packet),
            before: self.joints.as_ref().map(|(_, joints)| Arc::clone(joints)),
            since: None,
        };
        if let Message::Joints { epoch, .. } = *message {
            // Cells drop joints of the last epoch.
            if last != Some(epoch) {
                for (_, cell) in self.cells.iter_mut() {
                    cell.contact.latch_due_stimuli(epoch, |contact_page| {
                        contact_page.since = Some(Arc::clone(placed_packet))
                    });
                }
            }
            self.joints = Some((epoch, Arc::clone(placed_packet)));
        } else if let Message::Halt | Message::Resume = message {
            self.halt = Some(Arc::clone(placed_packet));
        } else if let Message::Network { from, page, .. } = *message {
            let Some(cell) = self.cells.addressed_mut(from).first_mut() else { return };
            if let NetworkPage::Heartbeat(heartbeat) = page {
                cell.apply_heartbeat(&heartbeat, placed_packet);
            } else if let NetworkPage::Tree(_) = page {
                cell.tree = Some(Arc::clone(placed_packet));
            } else if let NetworkPage::Received(heard) = page {
                cell.apply_stimulus_proof(contact_page(), |contact, tag| {
                    contact.compare_stimulus_count(heard.stimuli, tag)
                });
            }
        } else if let Message::Configure { to, request: Request::Write { number, words }, .. } = *message {
            let obeys = words.first() == Some(&1);
            self.cells
                .addressed_mut(to)
                .iter_mut()
                .for_each(|cell| cell.apply_write(number, placed_packet, obeys));
        } else if let Message::Configured {
            from,
            answer: Answer::Value { number, written: true, words },
            ..
        } = *message
        {
            let Some(cell) = self.cells.get_mut(from) else { return };
            if number == Parameter::Commit.number() {
                cell.activate_committed();
            } else if number == Parameter::Mode.number() && words.first() == Some(&1) {
                cell.apply_stimulus_proof(contact_page(), ContactState::confirm_mode);
            }
        } else if let Message::Stimulus { to, from, page } = *message {
            let contact_page = contact_page();
            self.cells
                .addressed_mut(to)
                .iter_mut()
                .for_each(|cell| cell.contact.add_stimulus(from, page, contact_page.clone(), last));
        } else if let Message::Sensors { from, epoch, page } = *message {
            let contact_page = contact_page();
            if let Some(cell) = self.cells.get_mut(from).filter(|_| last.is_none_or(|last| last == epoch)) {
                cell.apply_sensor_report(page, contact_page);
            }
        }
    }

    /// Returns all frames that still have an effect, in the order of the bus.
    #[must_use]
    pub fn frames(&self) -> Vec<LatchedFrame> {
        let joints = self.joints.iter().map(|(_, joints)| joints);
        let packets = self.cells.iter().flat_map(|(_, cell)| cell.packets()).chain(joints).chain(&self.halt);
        let ordered: BTreeMap<_, _> =
            packets.map(|placed_packet| (placed_packet.place, placed_packet)).collect();
        ordered.values().flat_map(|placed_packet| placed_packet.frames.iter().copied()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Q5_10;
    use protocol::id::{CellId, Node};
    use protocol::message::{Joints, SkinSensors, StimulusStart, TreePage};
    use protocol::packet::WORDS;

    fn say(force: &mut LatchedPackets, at_nanos: u64, format: Format, message: &Message) -> Vec<Frame> {
        let frames: Vec<_> = message.encode().frames(format).collect();
        frames.iter().for_each(|&frame| force.receive(LatchedFrame { at_nanos, from_gateway: true, frame }));
        frames
    }

    fn stimulus(node: u8, newtons: f64, epoch: u8) -> Message {
        let skin = SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() };
        Message::Stimulus {
            to: Node::from_byte(node),
            from: StimulusStart::Epoch(Epoch(epoch)),
            page: SensorPage::Skin(skin),
        }
    }

    fn heartbeat(node: u8, sent: u16) -> Message {
        let page = NetworkPage::Heartbeat(Heartbeat { sent, configuration: 77, ..Heartbeat::default() });
        Message::Network { from: Node::from_byte(node), epoch: Epoch(0), page }
    }

    fn joints(epoch: u8) -> Message {
        let joints = Joints { in_use: 6, ..Joints::default() };
        Message::Joints { epoch: Epoch(epoch), joints }
    }

    #[test]
    fn the_last_of_everything_is_kept_in_both_formats() {
        for format in [Format::Fd, Format::Classic] {
            let mut force = LatchedPackets::default();
            let cell = CellId::new(3).unwrap();
            say(&mut force, 1, format, &heartbeat(3, 1));
            let write = |number, word| Message::Configure {
                to: Node::Everyone,
                tag: 0,
                request: Request::Write { number, words: [word, 0, 0, 0, 0, 0] },
            };
            let tree = |parent| Message::Network {
                from: Node::Cell(cell),
                epoch: Epoch(0),
                page: NetworkPage::Tree(TreePage { parent: Some(parent), ..TreePage::default() }),
            };
            say(&mut force, 1, format, &write(7, 1));
            say(&mut force, 1, format, &write(1, 1));
            say(&mut force, 1, format, &tree(4));
            say(&mut force, 2, format, &Message::Halt);
            let mut expected = vec![];
            expected.extend(say(&mut force, 2, format, &write(1, 2)));
            expected.extend(say(&mut force, 2, format, &tree(5)));
            expected.extend(say(&mut force, 2, format, &write(7, 2)));
            expected.extend(say(&mut force, 2, format, &write(9, 2)));
            expected.extend(say(&mut force, 3, format, &heartbeat(3, 2)));
            // The order is that of the bus, not of the times.
            expected.extend(say(&mut force, 4, format, &joints(1)));
            expected.extend(say(&mut force, 1, format, &stimulus(3, 1.0, 7)));
            expected.extend(say(&mut force, 6, format, &stimulus(255, 2.0, 8)));
            expected.extend(say(&mut force, 7, format, &joints(2)));
            expected.extend(say(&mut force, 8, format, &Message::Resume));
            let torque = Message::Torque { from: cell, epoch: Epoch(2), torque: Default::default() };
            say(&mut force, 9, format, &torque);
            let frames: Vec<_> = force.frames().iter().map(|seen| seen.frame).collect();
            assert_eq!(frames, expected, "{format:?}");
        }
    }

    #[test]
    fn latched_and_waiting_stimuli_are_kept_with_the_joints_that_tell_which() {
        let mut force = LatchedPackets::default();
        let mut kept = vec![];
        let mut now = 0;
        let mut say = |message: &Message, keep: bool| {
            now += 1;
            say(&mut force, now, Format::Fd, message);
            kept.extend(keep.then_some(now));
        };
        say(&joints(1), false);
        say(&stimulus(9, 1.0, 2), false);
        say(&joints(2), true);
        say(&stimulus(9, 2.0, 3), true);
        say(&joints(3), true);
        // It is still latched after more than half of all epochs.
        (4..=199).for_each(|epoch| say(&joints(epoch), false));
        say(&joints(200), true);
        (0..12).for_each(|at| say(&stimulus(8, 1.0, 210), at < 8));
        let frames: Vec<_> = force.frames().iter().map(|seen| seen.at_nanos).collect();
        assert_eq!(frames, kept);
    }

    #[test]
    fn a_restarted_cell_has_nothing_latched_but_what_was_committed() {
        let mut force = LatchedPackets::default();
        let to = Node::Cell(CellId::new(3).unwrap());
        let write = |number, word| {
            let request = Request::Write { number, words: [word, 0, 0, 0, 0, 0] };
            Message::Configure { to, tag: 0, request }
        };
        let taken = Answer::Value { number: Parameter::Commit.number(), written: true, words: [0; WORDS] };
        let taken = Message::Configured { from: CellId::new(3).unwrap(), tag: 0, answer: taken };
        let claims = |sent| {
            let beat = Heartbeat { state: State::CLAIMING_NODE_ID, sent, ..Heartbeat::default() };
            Message::Network { from: to, epoch: Epoch(0), page: NetworkPage::Heartbeat(beat) }
        };
        let placed_packet = [write(1, 1), write(127, 9), taken, write(2, 1), write(1, 2), write(7, 1)];
        let placed_packet = [&placed_packet[..], &[stimulus(3, 1.0, 0), joints(0)]].concat();
        let kept =
            |force: &LatchedPackets| force.frames().iter().map(|seen| seen.at_nanos).collect::<Vec<_>>();
        (0..).zip(&placed_packet).for_each(|(at, message)| drop(say(&mut force, at, Format::Fd, message)));
        assert_eq!(kept(&force), [0, 1, 3, 4, 5, 6, 7]);
        say(&mut force, 8, Format::Fd, &claims(0));
        say(&mut force, 9, Format::Fd, &claims(1));
        assert_eq!(kept(&force), [0, 1, 7, 8, 9]);
    }

    #[test]
    fn no_file_begins_between_the_segments_of_a_gateway_packet() {
        let mut force = LatchedPackets::default();
        let segments = |message: &Message| message.encode().frames(Format::Classic).collect::<Vec<_>>();
        let (ours, theirs) = (segments(&joints(1)), segments(&heartbeat(3, 1)));
        let mut take = |at_nanos, frame| {
            force.receive(LatchedFrame { at_nanos, from_gateway: true, frame });
            [0, 14_000_000, 16_000_000].map(|later| force.is_within_a_packet(at_nanos + later))
        };
        assert_eq!(take(5, theirs[0]), [false; 3]);
        assert_eq!(take(6, ours[0]), [true, true, false]);
        assert_eq!(take(7, ours[1]), [false; 3]);
    }

    #[test]
    fn a_claim_of_a_taken_node_id_releases_nothing() {
        let to = Node::Cell(CellId::new(3).unwrap());
        let beat = |serial, sent, state| {
            let beat = Heartbeat { serial, sent, state, ..Heartbeat::default() };
            Message::Network { from: to, epoch: Epoch(0), page: NetworkPage::Heartbeat(beat) }
        };
        let write =
            |number| Message::Configure { to, tag: 0, request: Request::Write { number, words: [1; 6] } };
        let placed_packet =
            [beat(7, 40, State::CONFIGURED), write(7), write(1), joints(1), stimulus(3, 1.0, 2), joints(2)];
        let mut force = LatchedPackets::default();
        (0..).zip(&placed_packet).for_each(|(at, message)| drop(say(&mut force, at, Format::Fd, message)));
        let before = force.frames();
        say(&mut force, 9, Format::Fd, &beat(9, 0, State::CLAIMING_NODE_ID));
        assert_eq!(force.frames(), before);
    }
}
