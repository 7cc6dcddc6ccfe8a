//! A second, simpler gateway that knows the truth about every frame: its damage, its sender, and the starts of each
//! cell. The real gateway's results for the same frames must agree with it, whatever was damaged.

use model::table::{BusTotals, Notice};
use protocol::can::{Format, Frame};
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, State};
use protocol::packet::{Epoch, Packet, Reassembler, WORDS};
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{SafetyLimits, Skin};
use protocol::time::Micros;

use crate::fault::{Harm, Party};

/// The number of newest broadcasts that a torque may answer.
const ANSWERABLE_BROADCASTS: usize = 4;

/// The true origin, content and damage of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Truth {
    /// The sender of the frame.
    pub from: Party,
    /// The number of starts of the sending cell when it sent the frame.
    pub life: u32,
    /// The packet that the frame carries completely or partly; `None` for a babbled frame.
    pub packet: Option<Packet>,
    /// The number of the packet on this bench; 0 for frames that are not packets.
    pub number: u64,
    /// The index of the frame among the segments of the packet; 0 for a packet in one frame.
    pub segment: usize,
    /// The damage that was done to the frame.
    pub damage: Option<Harm>,
}

impl Truth {
    /// Adds further damage; truncation takes precedence over other damage.
    #[must_use]
    pub(crate) fn and(self, damage: Option<Harm>) -> Self {
        let link_down = [self.damage, damage].contains(&Some(Harm::Truncate));
        Self { damage: if link_down { Some(Harm::Truncate) } else { self.damage.or(damage) }, ..self }
    }

    /// Returns the truth with the damage corrected by the frame that arrived: bits that were flipped twice are right
    /// again.
    fn on_arrival(self, frame: &Frame) -> Self {
        let meant = self.packet.and_then(|packet| packet.frames(frame.format()).nth(self.segment));
        if meant.is_some_and(|meant| meant == *frame) { Self { damage: None, ..self } } else { self }
    }
}

/// The numbers of frames that were delivered to the gateway, by the treatment that is expected of it.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Tally {
    /// All frames that were delivered.
    pub frames: u64,
    /// Whole packets of other senders.
    pub packets: u64,
    /// Whole torques that must enter the sum.
    pub used: u64,
    /// Torques of an epoch that the same cell had answered already.
    pub repeated: u64,
    /// Torques of an epoch that is over, or has not begun.
    pub stale: u64,
    /// Frames with flipped bits.
    pub flipped: u64,
    /// Truncated frames.
    pub truncated: u64,
    /// Babbled frames.
    pub babbled: u64,
    /// The gateway's own broadcasts.
    pub broadcasts: u64,
}

/// The oracle's state of a cell.
#[derive(Clone, Debug, Default)]
struct OracleCell {
    /// The index of the broadcast that the cell's newest torque answered.
    answered: Option<usize>,
    held: Option<[i32; MAX_JOINTS]>,
    /// The torque of the cell in the sum: the held torque, or what remains of it while it decays.
    value: [i32; MAX_JOINTS],
    torques: Vec<(u8, [i16; WORDS])>,
    arrived: u64,
    /// The owner of the node id, by the last heartbeat that was not a claim.
    holder: Option<Party>,
}

/// A simpler gateway for one bus, which knows the truth about frames.
#[derive(Debug)]
pub struct Oracle {
    /// The counts of frames.
    pub tally: Tally,
    /// True if the sum of torques is compared, which is not possible while several cells have one node id.
    pub compares: bool,
    format: Format,
    safety: SafetyLimits,
    mirrors: Vec<OracleCell>,
    /// The index of the cell with each node id.
    places: [Option<usize>; 256],
    broadcasts: Vec<Epoch>,
    /// The last frame of each identifier, and its time on the wire.
    segments: Vec<Option<(Frame, Micros)>>,
}

impl Oracle {
    /// Creates an oracle that has not seen a frame.
    #[must_use]
    pub fn new(skin: &Skin) -> Self {
        let mut places = [None; 256];
        for (place, cell) in skin.cells.iter().enumerate() {
            if let Some(it) = places.get_mut(usize::from(cell.node.get())) {
                *it = Some(place);
            }
        }
        Self {
            tally: Tally::default(),
            compares: true,
            format: skin.buses.first().map_or(Format::Fd, |bus| bus.format),
            safety: skin.safety,
            mirrors: vec![OracleCell::default(); skin.cells.len()],
            places,
            broadcasts: Vec::new(),
            segments: vec![None; 1 << 11],
        }
    }

    /// Returns the torques of a cell that arrived complete.
    #[must_use]
    pub fn torques(&self, place: usize) -> Vec<(u8, [i16; WORDS])> {
        self.mirrors.get(place).map(|mirror| mirror.torques.clone()).unwrap_or_default()
    }

    /// Returns the number of whole packets that arrived from a cell.
    #[must_use]
    pub fn arrived(&self, place: usize) -> u64 {
        self.mirrors.get(place).map_or(0, |mirror| mirror.arrived)
    }

    /// Receives a frame that is delivered to the gateway.
    pub(crate) fn receive(&mut self, stood: Micros, truth: &Truth, frame: &Frame) {
        let truth = &truth.on_arrival(frame);
        self.tally.frames += 1;
        match truth.damage {
            Some(Harm::Truncate) => self.tally.truncated += 1,
            Some(_) => self.tally.flipped += 1,
            None => self.tally.babbled += u64::from(truth.packet.is_none()),
        }
        let Some(packet) = truth.packet.filter(|_| self.is_whole(stood, truth, frame)) else { return };
        let Ok(message) = Message::decode(&packet) else { return };
        if truth.from == Party::Gateway {
            return self.receive_own(&message);
        }
        self.tally.packets += 1;
        if message == Message::Halt {
            self.mirrors.iter_mut().for_each(OracleCell::release);
        }
        let node = match Node::from_byte(packet.id.node) {
            Node::Cell(cell) => cell.get(),
            Node::Gateway | Node::Everyone => return,
        };
        let place = self.places.get(usize::from(node)).copied().flatten();
        let Some(mirror) = place.and_then(|place| self.mirrors.get_mut(place)) else { return };
        match message {
            Message::Torque { epoch, torque, .. } => {
                mirror.arrived += 1;
                mirror.torques.push((epoch.0, torque.first_six()));
                let words = torque.padded();
                // The newest broadcast of this epoch, if it is not too old.
                let recent = self.broadcasts.iter().enumerate().rev().take(ANSWERABLE_BROADCASTS);
                let answers = recent.into_iter().find(|(_, of)| **of == epoch).map(|(number, _)| number);
                match answers {
                    Some(number) if mirror.answered.is_none_or(|last| last < number) => {
                        self.tally.used += 1;
                        mirror.answered = Some(number);
                        mirror.value = words.map(i32::from);
                        mirror.held = words.iter().any(|&word| word != 0).then_some(mirror.value);
                    }
                    Some(number) if mirror.answered == Some(number) => self.tally.repeated += 1,
                    Some(_) | None => self.tally.stale += 1,
                }
            }
            Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } => {
                mirror.arrived += 1;
                // An address claim does not change the owner's state.
                let claims = heartbeat.state.has(State::CLAIMING_NODE_ID);
                let challenges = claims && mirror.holder.is_some_and(|holder| holder != truth.from);
                if !heartbeat.state.has(State::ACTIVE) && !challenges {
                    mirror.release();
                }
                if !claims {
                    mirror.holder = Some(truth.from);
                }
            }
            Message::Network { .. }
            | Message::Sensors { .. }
            | Message::Configured { .. }
            | Message::Sum { .. } => mirror.arrived += 1,
            Message::Halt
            | Message::Joints { .. }
            | Message::Sync
            | Message::Resume
            | Message::Report
            | Message::Configure { .. }
            | Message::Stimulus { .. } => {}
        }
    }

    fn receive_own(&mut self, message: &Message) {
        match *message {
            // A frame repeated on the way: cells drop it, and it is not an epoch.
            Message::Joints { epoch, .. } if self.broadcasts.last() == Some(&epoch) => {}
            Message::Joints { epoch, .. } => {
                self.tally.broadcasts += 1;
                // After that many broadcasts that were not on the bus, all torques have decayed in the loop.
                let recent = self.broadcasts.iter().rev().take(ANSWERABLE_BROADCASTS);
                let passed = recent.map(|&before| epoch.epochs_since(before)).min().unwrap_or(1);
                if i64::from(passed) > i64::from(self.safety.hold_epochs + self.safety.decay_epochs) + 1 {
                    self.mirrors.iter_mut().for_each(OracleCell::release);
                }
                self.broadcasts.push(epoch);
                let newest = self.broadcasts.len() - 1;
                for mirror in &mut self.mirrors {
                    mirror.decay(newest, &self.safety);
                }
            }
            Message::Halt => self.mirrors.iter_mut().for_each(OracleCell::release),
            Message::Sync
            | Message::Resume
            | Message::Report
            | Message::Sum { .. }
            | Message::Torque { .. }
            | Message::Sensors { .. }
            | Message::Network { .. }
            | Message::Configure { .. }
            | Message::Configured { .. }
            | Message::Stimulus { .. } => {}
        }
    }

    /// Returns true if this frame is a packet, or completes one.
    fn is_whole(&mut self, stood: Micros, truth: &Truth, frame: &Frame) -> bool {
        if self.format == Format::Fd {
            return truth.damage.is_none();
        }
        if truth.damage == Some(Harm::Truncate) {
            return false;
        }
        let Some(last) = self.segments.get_mut(usize::try_from(frame.id()).unwrap_or(usize::MAX)) else {
            return false;
        };
        if truth.damage.is_some() {
            *last = None;
            return false;
        }
        // An equal first segment counts like the packet's own.
        let first = truth.packet.and_then(|packet| packet.frames(self.format).next());
        let in_time = |since| {
            truth.packet.is_some_and(|packet| stood.elapsed_since(since) <= Reassembler::max_gap(packet.id))
        };
        let whole =
            truth.segment == 1 && last.is_some_and(|(waits, since)| Some(waits) == first && in_time(since));
        *last = if whole { None } else { Some((*frame, stood)) };
        whole
    }

    /// Handles a notice of the gateway: removes the torque of a dead or restarted cell.
    pub(crate) fn notice(&mut self, notice: Notice) {
        let (Notice::Dead(cell) | Notice::Restarted(cell)) = notice else { return };
        let place = self.places.get(usize::from(cell.get())).copied().flatten();
        if let Some(mirror) = place.and_then(|place| self.mirrors.get_mut(place)) {
            mirror.release();
        }
    }

    /// Checks that the gateway's sum of a tick equals the sum of the oracle, to the last bit.
    pub(crate) fn check_sum(&self, now: Micros, snapshot: &BusTotals) {
        if !self.compares {
            return;
        }
        let mut sum = [0_i32; MAX_JOINTS];
        let mut contributing = 0;
        for mirror in &self.mirrors {
            for (sum, value) in sum.iter_mut().zip(mirror.value) {
                *sum += value;
            }
            contributing += u32::from(mirror.value != [0; MAX_JOINTS]);
        }
        let sum = sum.map(|steps| f64::from(steps) / 4_096.0);
        assert!(
            sum.map(f64::to_bits) == snapshot.torque.map(f64::to_bits)
                && contributing == snapshot.contributing,
            "at {} us the sum is {:?} of {} cells, and should be {sum:?} of {contributing}",
            now.0,
            snapshot.torque,
            snapshot.contributing
        );
    }
}

impl OracleCell {
    fn release(&mut self) {
        self.held = None;
        self.value = [0; MAX_JOINTS];
    }

    /// Updates the cell's torque in the sum: it is held for some epochs without an answer, then decays to zero in equal
    /// steps.
    fn decay(&mut self, newest: usize, safety: &SafetyLimits) {
        let (Some(held), Some(answered)) = (self.held, self.answered) else { return };
        let (hold, decay) = (safety.hold_epochs as usize, safety.decay_epochs as usize);
        // There was no time to answer the newest broadcast.
        let unanswered = (newest - answered).saturating_sub(1);
        let remaining = (hold + decay).saturating_sub(unanswered);
        self.value = match unanswered {
            _ if unanswered <= hold => held,
            _ if remaining == 0 => [0; MAX_JOINTS],
            _ => held.map(|word| word * as_i32(remaining) / as_i32(decay)),
        };
    }
}

fn as_i32(epochs: usize) -> i32 {
    i32::try_from(epochs).unwrap_or(i32::MAX)
}
