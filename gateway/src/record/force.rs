//! What is in force on a bus: the frames that somebody needs who begins in the middle.
//!
//! The last heartbeat of every cell, with the hash of its configuration, and its place in the tree; what was switched
//! at run time; the stimuli that it feels and that wait for their epochs; the last joints, and whether cells were
//! halted.

use std::collections::VecDeque;

use protocol::can::{Format, Frame};
use protocol::id::Kind;
use protocol::packet::{self, Half, Paired};
use protocol::time::Micros;

use crate::stimuli::PENDING;

/// As many stimuli as a cell lets wait, and the one that it feels.
const STIMULI: usize = PENDING + 1;

/// A frame that somebody saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// When, in ns since 1970.
    pub at_nanos: u64,
    /// Whether the gateway sent it.
    pub own: bool,
    /// What.
    pub frame: Frame,
}

/// Frames that together are one packet.
type Packet = [Option<Seen>; 2];

/// The frames of one bus that are in force.
#[derive(Debug)]
pub struct InForce {
    /// By node: the last heartbeat.
    heartbeats: Vec<Packet>,
    /// By node: the last word on where its sums go.
    trees: Vec<Packet>,
    /// By node, everyone being the last, and parameter: the last write.
    switches: Vec<[Packet; SWITCHES.len()]>,
    /// By node, everyone being the last: the last stimuli.
    stimuli: Vec<VecDeque<Packet>>,
    joints: Packet,
    /// The last halt or resume.
    halt: Packet,
    /// By identifier: a classic first half whose second one is to come.
    halves: Vec<(Half, Option<Seen>)>,
}

/// Parameters that are in force as soon as they are written, and are not stored: mode, reply, sensing, events, cuts.
const SWITCHES: [u8; 5] = [5, 6, 7, 8, 9];
/// Set in the count of a write.
const WRITE: u8 = 0x80;
/// The network page that tells where a cell's sums go.
const TREE: u8 = 3;

impl Default for InForce {
    fn default() -> Self {
        Self {
            heartbeats: vec![[None; 2]; 256],
            trees: vec![[None; 2]; 256],
            switches: vec![[[None; 2]; SWITCHES.len()]; 256],
            stimuli: vec![VecDeque::new(); 256],
            joints: [None; 2],
            halt: [None; 2],
            halves: vec![(Half::NONE, None); 1 << 11],
        }
    }
}

impl InForce {
    /// Takes a frame that stood on the bus, if it is a packet or completes one. Bounded work.
    pub fn take(&mut self, seen: Seen) {
        let Ok(id) = packet::data_id(&seen.frame) else { return };
        let wanted = match id.kind {
            Kind::Command | Kind::Network | Kind::Stimulus | Kind::Configure => true,
            Kind::Sum | Kind::Torque | Kind::Sensors | Kind::Configured => false,
        };
        if !wanted {
            return;
        }
        let (packet, count) = match seen.frame.format() {
            Format::Fd => match packet::Packet::from_fd(&seen.frame) {
                Ok(packet) => ([Some(seen), None], packet.count),
                Err(_) => return,
            },
            Format::Classic => {
                let Some((half, first)) = self.halves.get_mut(usize::from(id.to_bits())) else { return };
                match half.push(Micros(seen.at_nanos / 1_000), id, seen.frame.data()) {
                    Ok(Paired::Whole(packet)) => ([first.take(), Some(seen)], packet.count),
                    Ok(Paired::Waiting | Paired::Incomplete) => return *first = Some(seen),
                    Err(_) => return,
                }
            }
        };
        let node = usize::from(id.node);
        match (id.kind, count) {
            (Kind::Command, _) => match id.node {
                1 => self.joints = packet,
                0 | 3 => self.halt = packet,
                _ => {}
            },
            (Kind::Network, 0) => {
                if let Some(last) = self.heartbeats.get_mut(node) {
                    *last = packet;
                }
            }
            (Kind::Network, TREE) => {
                if let Some(last) = self.trees.get_mut(node) {
                    *last = packet;
                }
            }
            (Kind::Configure, count) => {
                let switch = SWITCHES.iter().position(|number| number | WRITE == count);
                if let Some(last) = switch.and_then(|at| self.switches.get_mut(node)?.get_mut(at)) {
                    *last = packet;
                }
            }
            // Only what touches the skin; its page may bear a flag.
            (Kind::Stimulus, count) if count & 0x7F == 0 => {
                let Some(last) = self.stimuli.get_mut(node) else { return };
                if last.len() == STIMULI {
                    last.pop_front();
                }
                last.push_back(packet);
            }
            _ => {}
        }
    }

    /// All of them, oldest first.
    pub fn frames(&self) -> Vec<Seen> {
        let cells = self.heartbeats.iter().chain(&self.trees).chain(self.switches.iter().flatten());
        let packets = cells.chain(self.stimuli.iter().flatten()).chain([&self.joints, &self.halt]);
        let mut frames: Vec<_> = packets.flatten().flatten().copied().collect();
        // Halves of a packet may bear one time: they stay in order.
        frames.sort_by_key(|seen| seen.at_nanos);
        frames
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::{Q1_14, Q5_10};
    use protocol::id::{CellId, Node};
    use protocol::message::{
        From, Heartbeat, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, Tree,
    };
    use protocol::packet::{Epoch, WORDS};
    use protocol::parameters::Parameter;

    fn say(force: &mut InForce, at_nanos: u64, format: Format, message: &Message) -> Vec<Frame> {
        let frames: Vec<_> = message.encode().frames(format).collect();
        frames.iter().for_each(|&frame| force.take(Seen { at_nanos, own: true, frame }));
        frames
    }

    fn stimulus(node: u8, newtons: f64, epoch: u8) -> Message {
        let skin = SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() };
        Message::Stimulus {
            to: Node::from_byte(node),
            from: From::Epoch(Epoch(epoch)),
            page: SensorPage::Skin(skin),
        }
    }

    fn heartbeat(node: u8, sent: u16) -> Message {
        let page = NetworkPage::Heartbeat(Heartbeat { sent, configuration: 77, ..Heartbeat::default() });
        Message::Network { from: Node::from_byte(node), epoch: Epoch(0), page }
    }

    #[test]
    fn the_last_of_everything_is_kept_in_both_formats() {
        for format in [Format::Fd, Format::Classic] {
            let mut force = InForce::default();
            let joints = Joints { positions: [Q1_14::ZERO; WORDS], in_use: 6 };
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
                page: NetworkPage::Tree(Tree { parent: Some(parent), ..Tree::default() }),
            };
            say(&mut force, 1, format, &write(7, 1));
            say(&mut force, 1, format, &write(1, 1));
            say(&mut force, 1, format, &tree(4));
            say(&mut force, 2, format, &Message::Halt);
            let mut expected = vec![];
            expected.extend(say(&mut force, 2, format, &tree(5)));
            expected.extend(say(&mut force, 2, format, &write(7, 2)));
            expected.extend(say(&mut force, 2, format, &write(9, 2)));
            expected.extend(say(&mut force, 3, format, &heartbeat(3, 2)));
            say(&mut force, 4, format, &Message::Joints { epoch: Epoch(1), joints });
            expected.extend(say(&mut force, 5, format, &stimulus(3, 1.0, 7)));
            expected.extend(say(&mut force, 6, format, &stimulus(255, 2.0, 8)));
            expected.extend(say(&mut force, 7, format, &Message::Joints { epoch: Epoch(2), joints }));
            expected.extend(say(&mut force, 8, format, &Message::Resume));
            say(
                &mut force,
                9,
                format,
                &Message::Torque { from: cell, epoch: Epoch(2), torque: Default::default() },
            );
            let frames: Vec<_> = force.frames().iter().map(|seen| seen.frame).collect();
            assert_eq!(frames, expected, "{format:?}");
        }
    }

    #[test]
    fn what_is_switched_is_what_is_not_stored() {
        let volatile = |&number: &u8| Parameter::from_number(number).is_some_and(Parameter::is_volatile);
        assert!((0..=u8::MAX).filter(volatile).eq(SWITCHES));
    }

    #[test]
    fn as_many_stimuli_are_kept_as_may_wait_and_the_one_that_is_felt() {
        let mut force = InForce::default();
        for epoch in 0..20 {
            say(&mut force, epoch.into(), Format::Fd, &stimulus(9, 1.0, epoch));
        }
        let kept: Vec<_> = force.frames().iter().map(|seen| seen.at_nanos).collect();
        assert_eq!(kept, (11..20).collect::<Vec<_>>());
    }
}
