//! The wire of a bench: carries frames from their sender to their receivers, with faults and latencies.

use protocol::can::Frame;
use protocol::packet::Packet;
use protocol::time::{Micros, Span};
use rand::RngExt;

use super::{Bench, Event};
use crate::fault::Party;
use crate::oracle::Truth;

/// The time between two frames on the wire, about that of vcan.
const FRAME_INTERVAL: Span = Span(5);
/// The minimum and the maximum latency from the wire to a receiver, without faults.
const LATENCY: (u64, u64) = (10, 60);

/// A frame that was on the wire.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct WireFrame {
    /// The time at which the frame was on the wire.
    pub at: Micros,
    /// The sender of the frame.
    pub from: Party,
    /// The frame before the faults of single receivers.
    pub frame: Frame,
}

/// A sent frame, with its sender, packet and damage.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sent {
    pub(super) frame: Frame,
    pub(super) truth: Truth,
}

/// A frame on its way to a receiver.
#[derive(Clone, Copy, Debug)]
pub(super) struct Delivery {
    to: Party,
    stood: Micros,
    sent: Sent,
    after_next: bool,
}

/// The delivery state of a receiver.
#[derive(Debug, Default)]
pub(super) struct Inlet {
    /// The arrival time of the receiver's newest frame, which a later one must not overtake.
    newest: Micros,
    /// A frame that is delivered after the next one.
    held: Option<Delivery>,
}

impl Bench {
    /// Schedules the next time at which the model of the real bus is advanced.
    pub(super) fn schedule_bus_advance(&mut self) {
        let Some(real) = &mut self.real else { return };
        if let Some(next) = real.next()
            && real.next_advance.is_none_or(|look| next < look)
        {
            real.next_advance = Some(next);
            self.agenda.enter(next, Event::Bus);
        }
    }

    pub(super) fn packets(&mut self, from: Party, life: u32, at: Micros, packets: &[Packet]) {
        for packet in packets {
            self.packets += 1;
            for (segment, frame) in packet.frames(self.format).enumerate() {
                let truth =
                    Truth { from, life, packet: Some(*packet), number: self.packets, segment, damage: None };
                self.agenda.enter(at, Event::Send(Sent { frame, truth }, true));
            }
        }
    }

    /// Sends a frame to the wire; `may_be_hit` allows faults on it.
    pub(super) fn send(&mut self, mut sent: Sent, may_be_hit: bool) {
        if may_be_hit {
            let effect = self.faults.effect(self.agenda.now, sent.truth.from, None, sent.frame);
            sent.frame = effect.frame;
            sent.truth = sent.truth.and(effect.damage);
            if effect.after_next && effect.times > 0 && self.held.is_none() {
                self.held = Some(sent);
                return;
            }
            for _ in 0..effect.times {
                self.agenda.enter_in(effect.delay, Event::Send(sent, false));
            }
            return;
        }
        self.put_on_wire(&sent);
        if let Some(held) = self.held.take() {
            self.put_on_wire(&held);
        }
    }

    /// Puts a frame on the wire, or into the queue of the real bus.
    fn put_on_wire(&mut self, sent: &Sent) {
        if let Some(real) = &mut self.real {
            real.request(self.agenda.now, &sent.frame, *sent);
            self.schedule_bus_advance();
            return;
        }
        let stood = self.agenda.now.max(self.free);
        self.free = stood + FRAME_INTERVAL;
        self.distribute(stood, sent);
    }

    /// Distributes a frame from the wire to its receivers.
    pub(super) fn distribute(&mut self, stood: Micros, sent: &Sent) {
        let from = sent.truth.from;
        self.wire.push(WireFrame { at: stood, from, frame: sent.frame });
        self.pass(Party::Gateway, stood, sent);
        let hearers = self.subscribers.get(&sent.frame.raw_id()).cloned().unwrap_or_default();
        for cell_slot in hearers {
            if from != Party::CellSlot(cell_slot) {
                self.pass(Party::CellSlot(cell_slot), stood, sent);
            }
        }
    }

    /// Passes a frame from the wire to one receiver.
    fn pass(&mut self, to: Party, stood: Micros, sent: &Sent) {
        let effect = self.faults.effect(self.agenda.now, sent.truth.from, Some(to), sent.frame);
        // On a real bus a frame arrives everywhere at once.
        let latency = match self.real {
            Some(_) => Span(0),
            None => Span(self.dice.random_range(LATENCY.0..=LATENCY.1)),
        };
        let mut at = stood + latency;
        if let Some(inlet) = self.inlet(to) {
            at = at.max(inlet.newest);
            if effect.delay == Span(0) {
                inlet.newest = at;
            }
        }
        let sent = Sent { frame: effect.frame, truth: sent.truth.and(effect.damage) };
        for _ in 0..effect.times {
            let delivery = Delivery { to, stood, sent, after_next: effect.after_next };
            self.agenda.enter(at + effect.delay, Event::Deliver(delivery));
        }
    }

    fn inlet(&mut self, party: Party) -> Option<&mut Inlet> {
        match party {
            Party::Gateway => Some(&mut self.gateway_inlet),
            Party::CellSlot(cell_slot) => self.inlets.get_mut(cell_slot),
            Party::UnknownNode => None,
        }
    }

    pub(super) fn deliver(&mut self, delivery: Delivery) {
        let Some(inlet) = self.inlet(delivery.to) else { return };
        if delivery.after_next && inlet.held.is_none() {
            inlet.held = Some(delivery);
            return;
        }
        let held = inlet.held.take();
        for delivery in core::iter::once(delivery).chain(held) {
            let Delivery { to, stood, sent: Sent { frame, truth }, .. } = delivery;
            match to {
                Party::Gateway => {
                    let own = truth.from == Party::Gateway;
                    self.gateway.receive(stood, own, &frame);
                    self.oracle.receive(stood, &truth, &frame);
                }
                Party::CellSlot(cell_slot) => {
                    let now = self.agenda.now;
                    let Some(there) = self.cell_slots.get_mut(cell_slot) else { return };
                    let packets = there.receive(now, stood, frame);
                    self.sends(cell_slot, &packets);
                }
                Party::UnknownNode => {}
            }
        }
    }
}
