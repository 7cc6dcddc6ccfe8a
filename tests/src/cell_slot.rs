//! The slot of one cell: the real [`Node`], with the behaviour of the process around it.

use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::node::Node;
use protocol::can::{Format, Frame};
use protocol::id::Kind;
use protocol::packet::{Packet, Words};
use protocol::time::{Micros, Span};

use crate::life::PowerState;

/// The number of frames that the shell reads from its socket at once, before it sends the results.
const BATCH: usize = 64;

/// A frame that waits in a socket, with its time on the wire.
pub(crate) type WaitingFrame = (Micros, Frame);

/// A cell, or an empty slot for one.
#[derive(Debug)]
pub struct CellSlot {
    /// The identity of the cell.
    pub identity: Identity,
    /// The content of the cell's flash.
    pub flash: FlashState,
    /// The time from receiving a frame to answering it.
    pub thinks: Span,
    /// The number of starts of the cell, which tells its packets before a restart from those after it.
    pub lives: u32,
    /// True while the cell is stuck: each torque has the words of the first one.
    pub is_stuck: bool,
    first: Option<Words>,
    format: Format,
    /// The power state of the cell; while it hangs, frames collect in its socket.
    life: PowerState<WaitingFrame>,
    /// The serial number of the cell to which this cell gave its node id.
    gave_up: Option<u32>,
    /// The time of the cell's next timer.
    pub(crate) wake: Option<Micros>,
}

impl CellSlot {
    /// Creates a cell that is not switched on yet.
    #[must_use]
    pub const fn new(identity: Identity, flash: FlashState, format: Format) -> Self {
        let thinks = Span(30);
        Self {
            identity,
            flash,
            thinks,
            lives: 0,
            is_stuck: false,
            first: None,
            format,
            life: PowerState::Off,
            gave_up: None,
            wake: None,
        }
    }

    /// Returns the cell, unless it is off or gave way.
    #[must_use]
    pub const fn node(&self) -> Option<&Node> {
        self.life.node()
    }

    /// Returns the serial number of the cell to which this cell gave its node id.
    #[must_use]
    pub const fn gave_up(&self) -> Option<u32> {
        self.gave_up
    }

    /// Returns true if the cell is on and does not hang.
    #[must_use]
    pub const fn runs(&self) -> bool {
        self.life.runs()
    }

    /// Returns the packet that the cell sends instead of this one: a stuck cell repeats the words of its first torque.
    pub(crate) fn sent(&mut self, packet: Packet) -> Packet {
        if !self.is_stuck || packet.id.kind != Kind::Torque {
            return packet;
        }
        Packet { words: *self.first.get_or_insert(packet.words), ..packet }
    }

    /// Switches the cell on. A simulated cell obeys stimuli from the start.
    pub(crate) fn start(&mut self, now: Micros) {
        self.lives += 1;
        self.life = PowerState::Runs(Box::new(Node::new(self.identity, self.format, &self.flash, true, now)));
        (self.gave_up, self.wake) = (None, None);
    }

    /// Switches the cell off. Only its flash keeps its content.
    pub(crate) fn kill(&mut self) {
        (self.life, self.gave_up) = (PowerState::Off, None);
    }

    pub(crate) fn hang(&mut self) {
        self.life.hang();
    }

    /// Continues after a hang in the order of the process: timers first, then the collected frames, batch by batch.
    /// Returns the packets to send.
    pub(crate) fn go_on(&mut self, now: Micros) -> Vec<Packet> {
        let Some(mut waiting) = self.life.go_on() else { return Vec::new() };
        let mut packets = self.handle_time(now);
        while !waiting.is_empty() {
            let batch: Vec<_> = waiting.drain(..waiting.len().min(BATCH)).collect();
            packets.extend(self.receive_batch(now, &batch));
        }
        packets
    }

    /// Advances the cell's time, and returns the packets to send.
    pub(crate) fn handle_time(&mut self, now: Micros) -> Vec<Packet> {
        if let PowerState::Runs(node) = &mut self.life {
            node.handle_timeout(now);
        }
        self.take_packets()
    }

    /// Receives a frame that was on the wire at `stood`, and returns the packets to send.
    pub(crate) fn receive(&mut self, now: Micros, stood: Micros, frame: Frame) -> Vec<Packet> {
        if let PowerState::Hangs(_, waiting) = &mut self.life {
            waiting.push_back((stood, frame));
        }
        self.receive_batch(now, &[(stood, frame)])
    }

    fn receive_batch(&mut self, now: Micros, batch: &[WaitingFrame]) -> Vec<Packet> {
        for &(stood, frame) in batch {
            let PowerState::Runs(node) = &mut self.life else { break };
            node.handle_frame(now, now.elapsed_since(stood), &frame);
            if let Some(serial) = node.other_owner() {
                (self.life, self.gave_up) = (PowerState::Off, Some(serial));
            }
        }
        self.take_packets()
    }

    fn take_packets(&mut self) -> Vec<Packet> {
        let PowerState::Runs(node) = &mut self.life else { return Vec::new() };
        if let Some(kept) = node.poll_store() {
            self.flash = kept.parameters.map_or(FlashState::Empty, FlashState::Valid);
            node.handle_stored(true);
        }
        core::iter::from_fn(|| node.poll_transmit().copied()).collect()
    }
}
