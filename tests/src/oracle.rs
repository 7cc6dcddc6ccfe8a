//! A second, simpler gateway that is told the truth about every frame: it knows which were damaged, by
//! whom they were sent and when each cell was switched on. What the real one makes of the same frames
//! must agree with it, whatever was broken.

use model::table::{Notice, Sums};
use protocol::can::{Format, Frame};
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, State};
use protocol::packet::{Epoch, Packet, Segment, WORDS};
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{Safety, Skin};
use protocol::time::Micros;

use crate::fault::{Harm, Party};

/// A torque may answer the newest broadcast or one of the three before it.
const LATEST: usize = 4;

/// What is true of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Truth {
    /// Who sent it.
    pub from: Party,
    /// Which life of a cell it comes from.
    pub life: u32,
    /// The packet that it carries, or is a half of; none in what somebody babbles.
    pub packet: Option<Packet>,
    /// That packet's number on this bench; 0 for what is no packet.
    pub number: u64,
    /// Which half of it; 0 for a whole one.
    pub segment: usize,
    /// What was done to it.
    pub damage: Option<Harm>,
}

impl Truth {
    /// The same after more damage; what is cut is cut, whatever else was done to it.
    #[must_use]
    pub(crate) fn and(self, damage: Option<Harm>) -> Self {
        let link_down = [self.damage, damage].contains(&Some(Harm::Truncate));
        Self { damage: if link_down { Some(Harm::Truncate) } else { self.damage.or(damage) }, ..self }
    }

    /// The same, knowing what came: bits that were turned twice are right again.
    fn on_arrival(self, frame: &Frame) -> Self {
        let meant = self.packet.and_then(|packet| packet.frames(frame.format()).nth(self.segment));
        if meant.is_some_and(|meant| meant == *frame) { Self { damage: None, ..self } } else { self }
    }
}

/// What was delivered to the gateway, by what ought to become of it.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Tally {
    /// Frames.
    pub frames: u64,
    /// Whole packets of others.
    pub packets: u64,
    /// Of these, torques that count.
    pub used: u64,
    /// Torques for an epoch that was answered already, by the same cell.
    pub repeated: u64,
    /// Torques of an epoch that is over, or not begun.
    pub stale: u64,
    /// Frames with turned bits.
    pub flipped: u64,
    /// Truncated frames.
    pub truncated: u64,
    /// Frames that somebody babbled.
    pub babbled: u64,
    /// Own broadcasts.
    pub broadcasts: u64,
}

/// The oracle's state of a cell.
#[derive(Clone, Debug, Default)]
struct Mirror {
    /// The broadcast that its newest torque answered.
    answered: Option<usize>,
    held: Option<[i32; MAX_JOINTS]>,
    /// What of it is in the sum.
    value: [i32; MAX_JOINTS],
    torques: Vec<(u8, [i16; WORDS])>,
    arrived: u64,
    /// The owner of the node id, by the last heartbeat that was no claim.
    holder: Option<Party>,
}

/// The oracle of one bus.
#[derive(Debug)]
pub struct Oracle {
    /// What came.
    pub tally: Tally,
    /// Whether the sum is compared; several cells with one node id are not supported.
    pub compares: bool,
    format: Format,
    safety: Safety,
    mirrors: Vec<Mirror>,
    /// Where a node stands.
    places: [Option<usize>; 256],
    broadcasts: Vec<Epoch>,
    /// The last frame of each identifier, and when it stood.
    segments: Vec<Option<(Frame, Micros)>>,
}

impl Oracle {
    /// Nothing seen yet.
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
            mirrors: vec![Mirror::default(); skin.cells.len()],
            places,
            broadcasts: Vec::new(),
            segments: vec![None; 1 << 11],
        }
    }

    /// The torques that came whole from a cell.
    #[must_use]
    pub fn torques(&self, place: usize) -> Vec<(u8, [i16; WORDS])> {
        self.mirrors.get(place).map(|mirror| mirror.torques.clone()).unwrap_or_default()
    }

    /// Whole packets that came from a cell.
    #[must_use]
    pub fn arrived(&self, place: usize) -> u64 {
        self.mirrors.get(place).map_or(0, |mirror| mirror.arrived)
    }

    /// A frame was handed to the gateway.
    pub(crate) fn hear(&mut self, stood: Micros, truth: &Truth, frame: &Frame) {
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
            return self.hear_own(&message);
        }
        self.tally.packets += 1;
        if message == Message::Halt {
            self.mirrors.iter_mut().for_each(Mirror::release);
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
                mirror.torques.push((epoch.0, torque.six()));
                let words = torque.padded();
                // The newest broadcast of this epoch, if it is not too old.
                let recent = self.broadcasts.iter().enumerate().rev().take(LATEST);
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
                let claims = heartbeat.state.has(State::CLAIMING);
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

    fn hear_own(&mut self, message: &Message) {
        match *message {
            // Repeated on the way: cells drop it, and it is no epoch.
            Message::Joints { epoch, .. } if self.broadcasts.last() == Some(&epoch) => {}
            Message::Joints { epoch, .. } => {
                self.tally.broadcasts += 1;
                // After so many broadcasts that were not on the bus, all torques have decayed in the loop.
                let recent = self.broadcasts.iter().rev().take(LATEST);
                let passed = recent.map(|&before| epoch.since(before)).min().unwrap_or(1);
                if i64::from(passed) > i64::from(self.safety.hold_epochs + self.safety.decay_epochs) + 1 {
                    self.mirrors.iter_mut().for_each(Mirror::release);
                }
                self.broadcasts.push(epoch);
                let newest = self.broadcasts.len() - 1;
                for mirror in &mut self.mirrors {
                    mirror.decay(newest, &self.safety);
                }
            }
            Message::Halt => self.mirrors.iter_mut().for_each(Mirror::release),
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

    /// Whether this frame is a packet, or completes one.
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
        // An equal first segment is as good as the packet's own.
        let first = truth.packet.and_then(|packet| packet.frames(self.format).next());
        let in_time =
            |since| truth.packet.is_some_and(|packet| stood.since(since) <= Segment::within(packet.id));
        let whole =
            truth.segment == 1 && last.is_some_and(|(waits, since)| Some(waits) == first && in_time(since));
        *last = if whole { None } else { Some((*frame, stood)) };
        whole
    }

    /// Takes a notice: nothing is held of a silent cell.
    pub(crate) fn notice(&mut self, notice: Notice) {
        let (Notice::Dead(cell) | Notice::Restarted(cell)) = notice else { return };
        let place = self.places.get(usize::from(cell.get())).copied().flatten();
        if let Some(mirror) = place.and_then(|place| self.mirrors.get_mut(place)) {
            mirror.release();
        }
    }

    /// The sum that a tick takes must be this one's, to the last bit.
    pub(crate) fn check_sum(&self, now: Micros, snapshot: &Sums) {
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

impl Mirror {
    fn release(&mut self) {
        self.held = None;
        self.value = [0; MAX_JOINTS];
    }

    /// Held, then decays to zero in equal steps.
    fn decay(&mut self, newest: usize, safety: &Safety) {
        let (Some(held), Some(answered)) = (self.held, self.answered) else { return };
        let (hold, decay) = (safety.hold_epochs as usize, safety.decay_epochs as usize);
        // The newest broadcast has had no time to be answered.
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
