//! The bench: events in the order of time, on one clock.
//!
//! ```text
//!   Send ─> wire faults ─> a place in the order ─┬─> faults of receiver 1 ─> Deliver ─> Send ...
//!                                                └─> faults of receiver 2 ─> Deliver
//!   Wake (a cell's timer), Tick and Look (the gateway's), Act (what a test does at a time)
//! ```
//!
//! A receiver's frames come in the wire's order, however long each takes, unless a fault delays or
//! reorders them. Frames that nobody's filters let through are not delivered.
//!
//! The wire takes no time unless [`Bench::on_a_bus`] gives it bit rates: then a frame waits for its place by arbitration, takes
//! the time of its bits, and is everywhere at its end.

mod wire;

use std::collections::HashMap;

use bus_model::Attempt;
use cell_node::flash::Flash;
use cell_node::identity::Identity;
use model::scenario::{Scenario, contact_words};
use protocol::can::{Format, Frame};
use protocol::fixed::Q5_10;
use protocol::message::{From, Message, SkinSensors};
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

pub use wire::OnTheWire;

/// How often the gateway lets time pass, and its script is looked at.
const LOOK: Span = Span::from_millis(4);

/// What a test does at a time.
#[derive(Clone, Copy, Debug)]
pub enum Act {
    /// A cell loses its power.
    Kill(usize),
    /// A cell is switched on, or off and on.
    Start(usize),
    /// A cell hangs.
    Hang(usize),
    /// A cell that hung goes on.
    GoOn(usize),
    /// The gateway sends this.
    Say(Message),
    /// Somebody at a shell sends this.
    Inject(Message),
    /// Somebody sends this frame, whatever it is.
    Babble(Frame),
}

#[derive(Debug)]
enum Event {
    Send(Sent, bool),
    Deliver(Delivery),
    Wake(usize),
    Tick,
    Look,
    /// The real bus has got on.
    Bus,
    Act(Box<Act>),
}

/// A whole bench.
#[derive(Debug)]
pub struct Bench {
    /// The skin's description.
    pub skin: Skin,
    /// The gateway.
    pub gateway: Gateway,
    /// The cells: first the skin's, in its order, then those of [`Bench::add`].
    pub cell_slots: Vec<CellSlot>,
    /// The faults.
    pub faults: Faults,
    /// A second, simpler gateway with the same input.
    pub oracle: Oracle,
    /// All that stood on the wire.
    pub wire: Vec<OnTheWire>,
    agenda: Agenda<Event>,
    format: Format,
    packets: u64,
    free: Micros,
    held: Option<Sent>,
    /// The cell slots that receive an identifier.
    hearers: HashMap<u32, Vec<usize>>,
    inlets: Vec<Inlet>,
    gateway_inlet: Inlet,
    dice: Pcg64Mcg,
    ticking: bool,
    real: Option<RealBus<Sent>>,
}

impl Bench {
    /// A skin that nobody touches; its cells are switched on at time 0.
    #[must_use]
    pub fn new(skin: &Skin, seed: u64) -> Self {
        Self::with(skin, &Scenario::idle(Span::from_millis(0)), seed, |_| Micros(0))
    }

    /// A skin, what happens to it, and when each cell is switched on.
    ///
    /// # Panics
    /// When the skin has no bus, or an external controller.
    #[must_use]
    pub fn with(skin: &Skin, scenario: &Scenario, seed: u64, start: impl Fn(usize) -> Micros) -> Self {
        let mut gateway = Gateway::new(skin, scenario);
        gateway.table.set_comparing(true);
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
            hearers: HashMap::new(),
            inlets: Vec::new(),
            gateway_inlet: Inlet::default(),
            dice: Pcg64Mcg::seed_from_u64(seed ^ 0x5EED),
            ticking: false,
            real: None,
        };
        for (place, cell) in skin.cells.iter().enumerate() {
            let identity = Identity { cell: Some(cell.node), serial: cell.serial };
            let cell_slot = bench.add(identity, Flash::Sound(skin.parameters(cell)));
            bench.at(start(place), Act::Start(cell_slot));
        }
        bench.agenda.enter(Micros(0), Event::Look);
        bench
    }

    /// The same on a real bus with these bit rates, from now on.
    #[must_use]
    pub fn on_a_bus(mut self, rates: BitRates) -> Self {
        self.real = Some(RealBus::new(rates));
        self
    }

    /// What was asked of the real bus, in order of time.
    #[must_use]
    pub fn requested(&self) -> &[Requested] {
        self.real.as_ref().map_or(&[], |real| &real.requested)
    }

    /// What has been on the real bus, in order of time; a tag is a place in [`Bench::requested`].
    #[must_use]
    pub fn attempts(&self) -> &[Attempt] {
        self.real.as_ref().map_or(&[], |real| &real.attempts)
    }

    /// One more cell, switched off; returns its slot.
    pub fn add(&mut self, identity: Identity, flash: Flash) -> usize {
        let cell_slot = self.cell_slots.len();
        for id in identity.hears().into_iter().flatten() {
            self.hearers.entry(u32::from(id.to_bits())).or_default().push(cell_slot);
        }
        self.cell_slots.push(CellSlot::new(identity, flash, self.format));
        self.inlets.push(Inlet::default());
        cell_slot
    }

    /// What time it is.
    #[must_use]
    pub const fn now(&self) -> Micros {
        self.agenda.now
    }

    /// From one broadcast to the next.
    #[must_use]
    pub fn epoch(&self) -> Span {
        Span(self.gateway.period().0 * u64::from(self.skin.timing.ticks_per_broadcast))
    }

    /// From now on this goes wrong.
    pub fn fault(&mut self, fault: Fault) {
        self.faults.add(fault);
    }

    /// Something is done at a time.
    pub fn at(&mut self, at: Micros, act: Act) {
        self.agenda.enter(at, Event::Act(Box::new(act)));
    }

    /// Something is done now.
    pub fn act(&mut self, act: Act) {
        self.at(self.agenda.now, act);
        self.run(Span(0));
    }

    /// The gateway presses a cell, by its place in the skin, from the next joints on.
    ///
    /// # Panics
    /// When the skin has no such cell.
    pub fn press(&mut self, place: usize, newtons: f64) {
        self.press_from(place, newtons, From::Next);
    }

    /// The gateway presses a cell from some joints on.
    ///
    /// # Panics
    /// When the skin has no such cell.
    pub fn press_from(&mut self, place: usize, newtons: f64, from: From) {
        let message = self.gateway.stimulus(place, from, touch(newtons)).expect("a cell of the skin");
        self.act(Act::Say(message));
    }

    /// Runs until every running cell of the skin can be expected to answer.
    ///
    /// # Panics
    /// When that takes more than two seconds.
    pub fn settle(&mut self) {
        let give_up = self.agenda.now + Span::from_millis(2_000);
        while !self.is_settled() {
            assert!(self.agenda.now < give_up, "cells that never settle: {:?}", self.gateway.table.cells());
            self.run(LOOK);
        }
    }

    fn is_settled(&self) -> bool {
        let mut cells = self.cell_slots.iter().zip(self.gateway.table.cells());
        let started = self.cell_slots.iter().any(|cell_slot| cell_slot.lives > 0);
        started && cells.all(|(cell_slot, cell)| !cell_slot.runs() || cell.is_ready())
    }

    /// The loop begins to tick now.
    pub fn begin(&mut self) {
        if !self.ticking {
            self.ticking = true;
            self.agenda.enter_in(Span(0), Event::Tick);
        }
    }

    /// Settles, begins, and runs for one epoch.
    pub fn started(mut self) -> Self {
        self.settle();
        self.begin();
        self.run(self.epoch());
        self
    }

    /// Runs for so many epochs.
    pub fn run_epochs(&mut self, epochs: u64) {
        self.run(Span(self.epoch().0 * epochs));
    }

    /// Runs for some time.
    pub fn run(&mut self, span: Span) {
        let until = self.agenda.now + span;
        while let Some(event) = self.agenda.take_until(until) {
            self.handle(event);
        }
        self.agenda.now = until;
    }

    /// The loop ends; the cells say their last words, as at the end of every run.
    pub fn finish(&mut self) {
        self.ticking = false;
        self.run(Span(2 * self.epoch().0));
        self.act(Act::Say(Message::Report));
        self.run(Span::from_millis(100));
        self.act(Act::Say(Message::Sync));
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
                let messages = self.gateway.turn(self.agenda.now);
                self.oracle.check_sum(self.agenda.now, &self.gateway.table.snapshot().sums);
                self.say(&messages);
                self.agenda.enter_in(self.gateway.period(), Event::Tick);
            }
            Event::Tick => {}
            Event::Look => {
                let known = self.gateway.notices.len();
                let messages = self.gateway.look(self.agenda.now);
                for (_, notice) in self.gateway.notices.iter().skip(known) {
                    self.oracle.notice(*notice);
                }
                self.say(&messages);
                self.agenda.enter_in(LOOK, Event::Look);
            }
            Event::Bus => {
                let now = self.agenda.now;
                self.real.iter_mut().for_each(|real| real.look = None);
                let ended = self.real.as_mut().map(|real| real.ended(now)).unwrap_or_default();
                for (stood, sent) in ended {
                    self.reach(stood, &sent);
                }
                self.look_at_the_bus();
            }
            Event::Act(act) => self.perform(*act),
        }
    }

    fn perform(&mut self, act: Act) {
        let of = |bench: &mut Self, cell_slot: usize, packets: Vec<Packet>| bench.sends(cell_slot, &packets);
        match act {
            Act::Say(message) => self.say(&[message]),
            Act::Inject(message) => self.packets(Party::UnknownNode, 0, self.agenda.now, &[message.encode()]),
            Act::Babble(frame) => {
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
            Act::GoOn(cell_slot) => {
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
        // A timer that has moved since wakes nobody: it would set the current one a second time, and so for ever.
        if there.wake.take_if(|at| *at == now).is_none() {
            return;
        }
        let packets = there.time(now);
        self.sends(cell_slot, &packets);
    }

    /// A cell's packets go out when it has thought, and its next timer is set.
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

    fn say(&mut self, messages: &[Message]) {
        let packets: Vec<_> = messages.iter().map(Message::encode).collect();
        self.packets(Party::Gateway, 0, self.agenda.now, &packets);
    }

    /// Everything that this run was, as text: two runs are the same if these are.
    #[must_use]
    pub fn transcript(&self) -> String {
        let lines = self.wire.iter().map(|it| format!("{} {:?} {:?}\n", it.at.0, it.from, it.frame));
        let end = format!("{:?}\n{:?}\n{:?}", self.gateway, self.cell_slots, self.agenda.now);
        lines.chain([end]).collect()
    }

    /// The complete torques of one cell on the wire: epoch and words, in their order.
    #[must_use]
    pub fn torques(&self, place: usize) -> Vec<(u8, [i16; WORDS])> {
        self.oracle.torques(place)
    }
}

/// What a cell feels when it is pressed with so many newtons.
#[must_use]
pub fn touch(newtons: f64) -> SkinSensors {
    let contact: [Q5_10; 3] = contact_words(newtons);
    SkinSensors { contact, ..SkinSensors::default() }
}
