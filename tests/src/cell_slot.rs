//! The place of one cell: the real [`Node`] with what a process around it does.

use cell_node::flash::Flash;
use cell_node::identity::Identity;
use cell_node::node::Node;
use protocol::can::{Format, Frame};
use protocol::id::Kind;
use protocol::packet::{Packet, Words};
use protocol::time::{Micros, Span};

use crate::life::Life;

/// Frames that a shell takes from its socket at once, before it sends what they lead to.
const BATCH: usize = 64;

/// A frame that waits in a socket, and when it stood on the wire.
pub(crate) type Waiting = (Micros, Frame);

/// A cell, or the place for one.
#[derive(Debug)]
pub struct CellSlot {
    /// Its identity.
    pub identity: Identity,
    /// What its flash holds.
    pub flash: Flash,
    /// From receiving something to answering it.
    pub thinks: Span,
    /// How often it was switched on: packets of an earlier life are not this one's.
    pub lives: u32,
    /// Each of its torques has the words of the first one, as long as this is set.
    pub is_stuck: bool,
    first: Option<Words>,
    format: Format,
    /// While it hangs, frames gather in its socket.
    life: Life<Waiting>,
    /// The serial number of another cell with its node id.
    gave_up: Option<u32>,
    /// When it wants to be woken.
    pub(crate) wake: Option<Micros>,
}

impl CellSlot {
    /// A cell that is not switched on yet.
    #[must_use]
    pub const fn new(identity: Identity, flash: Flash, format: Format) -> Self {
        let thinks = Span(30);
        Self {
            identity,
            flash,
            thinks,
            lives: 0,
            is_stuck: false,
            first: None,
            format,
            life: Life::Off,
            gave_up: None,
            wake: None,
        }
    }

    /// The cell, unless it is off or gave up.
    #[must_use]
    pub const fn node(&self) -> Option<&Node> {
        self.life.node()
    }

    /// The serial number of the cell that it gave way to.
    #[must_use]
    pub const fn gave_up(&self) -> Option<u32> {
        self.gave_up
    }

    /// Whether it works.
    #[must_use]
    pub const fn runs(&self) -> bool {
        self.life.runs()
    }

    /// A packet as it sends it.
    pub(crate) fn sent(&mut self, packet: Packet) -> Packet {
        if !self.is_stuck || packet.id.kind != Kind::Torque {
            return packet;
        }
        Packet { words: *self.first.get_or_insert(packet.words), ..packet }
    }

    /// Switches it on; a simulated cell obeys stimuli from the start.
    pub(crate) fn start(&mut self, now: Micros) {
        self.lives += 1;
        self.life = Life::Runs(Box::new(Node::new(self.identity, self.format, &self.flash, true, now)));
        (self.gave_up, self.wake) = (None, None);
    }

    /// Switches it off: what it knew is gone, but for its flash.
    pub(crate) fn kill(&mut self) {
        (self.life, self.gave_up) = (Life::Off, None);
    }

    pub(crate) fn hang(&mut self) {
        self.life.hang();
    }

    /// It goes on after a hang, as the shell does: timers first, then what has gathered, a batch at a time.
    pub(crate) fn go_on(&mut self, now: Micros) -> Vec<Packet> {
        let Some(mut waiting) = self.life.go_on() else { return Vec::new() };
        let mut packets = self.time(now);
        while !waiting.is_empty() {
            let batch: Vec<_> = waiting.drain(..waiting.len().min(BATCH)).collect();
            packets.extend(self.take(now, &batch));
        }
        packets
    }

    /// Lets time pass; returns what it sends.
    pub(crate) fn time(&mut self, now: Micros) -> Vec<Packet> {
        if let Life::Runs(node) = &mut self.life {
            node.handle_timeout(now);
        }
        self.sends()
    }

    /// Takes a frame that stood on the wire at `stood`; returns what it sends.
    pub(crate) fn hear(&mut self, now: Micros, stood: Micros, frame: Frame) -> Vec<Packet> {
        if let Life::Hangs(_, waiting) = &mut self.life {
            waiting.push_back((stood, frame));
        }
        self.take(now, &[(stood, frame)])
    }

    fn take(&mut self, now: Micros, batch: &[Waiting]) -> Vec<Packet> {
        for &(stood, frame) in batch {
            let Life::Runs(node) = &mut self.life else { break };
            node.handle_frame(now, now.since(stood), &frame);
            if let Some(serial) = node.taken() {
                (self.life, self.gave_up) = (Life::Off, Some(serial));
            }
        }
        self.sends()
    }

    fn sends(&mut self) -> Vec<Packet> {
        let Life::Runs(node) = &mut self.life else { return Vec::new() };
        if let Some(kept) = node.poll_store() {
            self.flash = kept.parameters.map_or(Flash::Empty, Flash::Sound);
            node.handle_stored(true);
        }
        core::iter::from_fn(|| node.poll_transmit()).collect()
    }
}
