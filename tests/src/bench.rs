//! A bench in virtual time: cells, a gateway and a bus, whose events are processed in the order of one simulated clock.
//!
//! ```text
//!   Send ─> wire faults ─> a place in the order ─┬─> faults of receiver 1 ─> Deliver ─> Send ...
//!                                                └─> faults of receiver 2 ─> Deliver
//!   Wake (a cell's timer), Tick and Look (the gateway's), Act (an action of a test)
//! ```
//!
//! A receiver's frames arrive in the wire's order, however long each takes, unless a fault delays or reorders them.
//! Frames that pass no receiver's filters are not delivered.
//!
//! The wire takes no time unless [`Bench::on_a_bus`] sets bit rates. Then a frame waits for its place by arbitration,
//! takes the time of its bits, and arrives everywhere at its end.

mod wire;

use std::collections::HashMap;

use bus_model::Attempt;
use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use model::scenario::{Scenario, contact_words};
use protocol::can::{Format, Frame};
use protocol::fixed::Q5_10;
use protocol::message::{Message, SkinSensors, StimulusStart};
use protocol::packet::{Packet, WORDS};
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use protocol::wire_time::BitRates;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use crate::agenda::Agenda;
use crate::cell_slot::CellSlot;
use crate::fault::{Fault, Faults, Party};
use crate::gateway::Gateway;
use crate::oracle::{Oracle, Truth};
use crate::real_bus::{RealBus, Requested};
use wire::{Delivery, Inlet, Sent};

pub use wire::WireFrame;

/// The interval at which the gateway advances its time and sends the stimuli that its scenario schedules.
const POLL_INTERVAL: Span = Span::from_millis(4);

/// An action that a test schedules.
#[derive(Clone, Copy, Debug)]
pub enum Act {
    /// The cell in this slot loses its power.
    Kill(usize),
    /// The cell in this slot is switched on, or off and on.
    Start(usize),
    /// The cell in this slot hangs.
    Hang(usize),
    /// The hung cell in this slot continues.
    Continue(usize),
    /// The gateway sends this message.
    SendFromGateway(Message),
    /// Another client sends this message.
    Inject(Message),
    /// Another client sends this frame, which need not be a packet.
    InjectFrame(Frame),
}

#[derive(Debug)]
enum Event {
    Send(Sent, bool),
    Deliver(Delivery),
    Wake(usize),
    Tick,
    Look,
    /// The model of the real bus has to be advanced.
    Bus,
    Act(Box<Act>),
}

/// A complete bench: a gateway, cells and a bus, on one simulated clock.
#[derive(Debug)]
pub struct Bench {
    /// The skin of the bench.
    pub skin: Skin,
    /// The gateway.
    pub gateway: Gateway,
    /// The cells: first those of the skin, in its order, then those of [`Bench::add`].
    pub cell_slots: Vec<CellSlot>,
    /// The faults of the bus.
    pub faults: Faults,
    /// A second, simpler gateway with the same input, whose results must be equal.
    pub oracle: Oracle,
    /// All frames that were on the wire.
    pub wire: Vec<WireFrame>,
    agenda: Agenda<Event>,
    format: Format,
    packets: u64,
    free: Micros,
    held: Option<Sent>,
    /// The indices of the cell slots that receive each identifier.
    subscribers: HashMap<u32, Vec<usize>>,
    inlets: Vec<Inlet>,
    gateway_inlet: Inlet,
    dice: Pcg64Mcg,
    ticking: bool,
    real: Option<RealBus<Sent>>,
}

impl Bench {
    /// Creates a bench for a skin, without touches. Its cells are switched on at time 0.
    #[must_use]
    pub fn new(skin: &Skin, seed: u64) -> Self {
        Self::with(skin, &Scenario::idle(Span::from_millis(0)), seed, |_| Micros(0))
    }

    /// Creates a bench for a skin with a scenario; `start` returns the time at which each cell is switched on.
    ///
    /// # Panics
    /// Panics if the skin has no bus, or an external controller.
    #[must_use]
    pub fn with(skin: &Skin, scenario: &Scenario, seed: u64, start: impl Fn(usize) -> Micros) -> Self {
        let mut gateway = Gateway::new(skin, scenario);
        gateway.table.set_torque_comparison(true);
        let mut bench = Self {
            skin: skin.clone(),
            gateway,
            cell_slots: Vec::new(),
            faults: Faults::new(seed),
            oracle: Oracle::new(skin),
            wire: Vec::new(),
            agenda: Agenda::default(),
            format: skin.buses.first().expect("a skin has a bus").format,
            packets: 0,
            free: Micros(0),
            held: None,
            subscribers: HashMap::new(),
            inlets: Vec::new(),
            gateway_inlet: Inlet::default(),
            dice: Pcg64Mcg::seed_from_u64(seed ^ 0x5EED),
            ticking: false,
            real: None,
        };
        for (place, cell) in skin.cells.iter().enumerate() {
            let identity = Identity { cell: Some(cell.node), serial: cell.serial };
            let cell_slot = bench.add(identity, FlashState::Valid(skin.parameters(cell)));
            bench.at(start(place), Act::Start(cell_slot));
        }
        bench.agenda.enter(Micros(0), Event::Look);
        bench
    }

    /// Models a real bus with these bit rates, with arbitration and frame durations, from now on.
    #[must_use]
    pub fn on_a_bus(mut self, rates: BitRates) -> Self {
        self.real = Some(RealBus::new(rates));
        self
    }

    /// Returns the frames requested on the real bus, in order of time.
    #[must_use]
    pub fn requested(&self) -> &[Requested] {
        self.real.as_ref().map_or(&[], |real| &real.requested)
    }

    /// Returns the transmissions on the real bus, in order of time; a tag is an index into [`Bench::requested`].
    #[must_use]
    pub fn attempts(&self) -> &[Attempt] {
        self.real.as_ref().map_or(&[], |real| &real.attempts)
    }

    /// Adds a cell that is switched off, and returns the index of its slot.
    pub fn add(&mut self, identity: Identity, flash: FlashState) -> usize {
        let cell_slot = self.cell_slots.len();
        for id in identity.received_ids().into_iter().flatten() {
            self.subscribers.entry(u32::from(id.to_bits())).or_default().push(cell_slot);
        }
        self.cell_slots.push(CellSlot::new(identity, flash, self.format));
        self.inlets.push(Inlet::default());
        cell_slot
    }

    /// Returns the current time.
    #[must_use]
    pub const fn now(&self) -> Micros {
        self.agenda.now
    }

    /// Returns the interval between two broadcasts.
    #[must_use]
    pub fn epoch(&self) -> Span {
        Span(self.gateway.period().0 * u64::from(self.skin.timing.ticks_per_broadcast))
    }

    /// Adds a fault from now on.
    pub fn fault(&mut self, fault: Fault) {
        self.faults.add(fault);
    }

    /// Schedules an action.
    pub fn at(&mut self, at: Micros, act: Act) {
        self.agenda.enter(at, Event::Act(Box::new(act)));
    }

    /// Performs an action now.
    pub fn act(&mut self, act: Act) {
        self.at(self.agenda.now, act);
        self.run(Span(0));
    }

    /// Makes the gateway press a cell, given by its index in the skin, from the next joints on.
    ///
    /// # Panics
    /// Panics if the skin does not have the cell.
    pub fn press(&mut self, place: usize, newtons: f64) {
        self.press_from(place, newtons, StimulusStart::Next);
    }

    /// Makes the gateway press a cell from the joints `from` on.
    ///
    /// # Panics
    /// Panics if the skin does not have the cell.
    pub fn press_from(&mut self, place: usize, newtons: f64, from: StimulusStart) {
        let message = self.gateway.stimulus(place, from, touch(newtons)).expect("a cell of the skin");
        self.act(Act::SendFromGateway(message));
    }

    /// Runs until every running cell of the skin is expected to answer.
    ///
    /// # Panics
    /// Panics if that takes more than two seconds.
    pub fn settle(&mut self) {
        let give_up = self.agenda.now + Span::from_millis(2_000);
        while !self.is_settled() {
            assert!(self.agenda.now < give_up, "cells that never settle: {:?}", self.gateway.table.cells());
            self.run(POLL_INTERVAL);
        }
    }

    fn is_settled(&self) -> bool {
        let mut cells = self.cell_slots.iter().zip(self.gateway.table.cells());
        let started = self.cell_slots.iter().any(|cell_slot| cell_slot.lives > 0);
        started && cells.all(|(cell_slot, cell)| !cell_slot.runs() || cell.is_ready())
    }

    /// Starts the ticks of the control loop.
    pub fn begin(&mut self) {
        if !self.ticking {
            self.ticking = true;
            self.agenda.enter_in(Span(0), Event::Tick);
        }
    }

    /// Waits until the cells are expected to answer, starts the loop, and runs for one epoch.
    pub fn started(mut self) -> Self {
        self.settle();
        self.begin();
        self.run(self.epoch());
        self
    }

    /// Runs the bench for this number of epochs.
    pub fn run_epochs(&mut self, epochs: u64) {
        self.run(Span(self.epoch().0 * epochs));
    }

    /// Runs the bench for this time.
    pub fn run(&mut self, span: Span) {
        let until = self.agenda.now + span;
        while let Some(event) = self.agenda.take_until(until) {
            self.handle(event);
        }
        self.agenda.now = until;
    }

    /// Stops the loop as at the end of every run, and lets the cells send their last packets.
    pub fn finish(&mut self) {
        self.ticking = false;
        self.run(Span(2 * self.epoch().0));
        self.act(Act::SendFromGateway(Message::Report));
        self.run(Span::from_millis(100));
        self.act(Act::SendFromGateway(Message::Sync));
        self.run(Span::from_millis(150));
        self.gateway.table.handle_time(self.agenda.now);
        self.gateway.table.finish();
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Send(sent, may_be_hit) => self.send(sent, may_be_hit),
            Event::Deliver(delivery) => self.deliver(delivery),
            Event::Wake(cell_slot) => self.wake(cell_slot),
            Event::Tick if self.ticking => {
                let messages = self.gateway.run_tick(self.agenda.now);
                self.oracle.check_sum(self.agenda.now, &self.gateway.table.snapshot().sums);
                self.send_messages(&messages);
                self.agenda.enter_in(self.gateway.period(), Event::Tick);
            }
            Event::Tick => {}
            Event::Look => {
                let known = self.gateway.notices.len();
                let messages = self.gateway.poll(self.agenda.now);
                for (_, notice) in self.gateway.notices.iter().skip(known) {
                    self.oracle.notice(*notice);
                }
                self.send_messages(&messages);
                self.agenda.enter_in(POLL_INTERVAL, Event::Look);
            }
            Event::Bus => {
                let now = self.agenda.now;
                self.real.iter_mut().for_each(|real| real.next_advance = None);
                let ended = self.real.as_mut().map(|real| real.ended(now)).unwrap_or_default();
                for (stood, sent) in ended {
                    self.distribute(stood, &sent);
                }
                self.schedule_bus_advance();
            }
            Event::Act(act) => self.perform(*act),
        }
    }

    fn perform(&mut self, act: Act) {
        let of = |bench: &mut Self, cell_slot: usize, packets: Vec<Packet>| bench.sends(cell_slot, &packets);
        match act {
            Act::SendFromGateway(message) => self.send_messages(&[message]),
            Act::Inject(message) => self.packets(Party::UnknownNode, 0, self.agenda.now, &[message.encode()]),
            Act::InjectFrame(frame) => {
                let from = Party::UnknownNode;
                let truth = Truth { from, life: 0, packet: None, number: 0, segment: 0, damage: None };
                self.agenda.enter_in(Span(0), Event::Send(Sent { frame, truth }, true));
            }
            Act::Kill(cell_slot) => self.cell_slots.get_mut(cell_slot).into_iter().for_each(CellSlot::kill),
            Act::Hang(cell_slot) => self.cell_slots.get_mut(cell_slot).into_iter().for_each(CellSlot::hang),
            Act::Start(cell_slot) => {
                let now = self.agenda.now;
                self.cell_slots.get_mut(cell_slot).into_iter().for_each(|cell_slot| cell_slot.start(now));
                of(self, cell_slot, Vec::new());
            }
            Act::Continue(cell_slot) => {
                let now = self.agenda.now;
                let packets = self
                    .cell_slots
                    .get_mut(cell_slot)
                    .map(|cell_slot| cell_slot.go_on(now))
                    .unwrap_or_default();
                of(self, cell_slot, packets);
            }
        }
    }

    fn wake(&mut self, cell_slot: usize) {
        let now = self.agenda.now;
        let Some(there) = self.cell_slots.get_mut(cell_slot) else { return };
        // A timer that has moved since must not wake the cell: it would set the current timer a second time, and so on
        // for ever.
        if there.wake.take_if(|at| *at == now).is_none() {
            return;
        }
        let packets = there.handle_time(now);
        self.sends(cell_slot, &packets);
    }

    /// Sends the packets of a cell after the time that it takes to answer, and sets its next timer.
    fn sends(&mut self, cell_slot: usize, packets: &[Packet]) {
        let Some(there) = self.cell_slots.get_mut(cell_slot) else { return };
        let (life, at) = (there.lives, self.agenda.now + there.thinks);
        let packets: Vec<_> = packets.iter().map(|packet| there.sent(*packet)).collect();
        let timeout =
            there.node().filter(|_| there.runs()).map(|node| node.poll_timeout().max(self.agenda.now));
        if let Some(timeout) = timeout
            && there.wake != Some(timeout)
        {
            there.wake = Some(timeout);
            self.agenda.enter(timeout, Event::Wake(cell_slot));
        }
        self.packets(Party::CellSlot(cell_slot), life, at, &packets);
    }

    fn send_messages(&mut self, messages: &[Message]) {
        let packets: Vec<_> = messages.iter().map(Message::encode).collect();
        self.packets(Party::Gateway, 0, self.agenda.now, &packets);
    }

    /// Returns the complete run as text: two runs are equal if their transcripts are.
    #[must_use]
    pub fn transcript(&self) -> String {
        let lines = self.wire.iter().map(|it| format!("{} {:?} {:?}\n", it.at.0, it.from, it.frame));
        let end = format!("{:?}\n{:?}\n{:?}", self.gateway, self.cell_slots, self.agenda.now);
        lines.chain([end]).collect()
    }

    /// Returns the epoch and the words of each torque of a cell that arrived complete, in order.
    #[must_use]
    pub fn torques(&self, place: usize) -> Vec<(u8, [i16; WORDS])> {
        self.oracle.torques(place)
    }
}

/// Returns the sensor values of a cell that is pressed with a force.
#[must_use]
pub fn touch(newtons: f64) -> SkinSensors {
    let contact: [Q5_10; 3] = contact_words(newtons);
    SkinSensors { contact, ..SkinSensors::default() }
}
