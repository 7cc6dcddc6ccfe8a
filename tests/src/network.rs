//! A skin of cells that are wired at random, in virtual time: the cells must form a tree, keep it, and never count a
//! cell twice in a sum.
//!
//! Every cell has a random torque, so that a sum shows which cells are in it: the sum that a cell sends must consist of
//! its own torque and of sums that its neighbours sent in that epoch, and only one choice of these fits.

#![expect(
    clippy::indexing_slicing,
    clippy::missing_panics_doc,
    clippy::panic,
    clippy::wildcard_enum_match_arm,
    reason = "a harness may stop when it is asked for what is not there; of messages it wants three"
)]

mod place;
mod sums;
mod survey;

use std::collections::HashMap;

use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::node::Node;
use cell_node::sum::SumWords;
use model::network::Uplinks;
use protocol::can::Format;
use protocol::fixed::{Q1_14, Q5_10, Q7_8};
use protocol::message::{Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::{self, Epoch, WORDS};
use protocol::parameters::{LinksDown, Parameter, ReplyKind, SumSchedule};
use protocol::port::{PORTS, PortMessage, UPLINK};
use protocol::time::{Micros, Span};
use rand::seq::{IndexedRandom, SliceRandom};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::agenda::Agenda;
use crate::life::PowerState;
use place::Inlet;
use protocol::packet::pad_with_defaults;

pub use place::WiredCell;

/// The interval between two broadcasts.
pub const PERIOD: Span = Span(16_000);
/// The minimum and the maximum time from sending a message to receiving it, in us.
const LATENCY: (u64, u64) = (10, 60);
/// The time that a cell takes from receiving a message to answering it.
const THINKING_TIME: Span = Span(30);
/// Returns the joint positions in quarter turns, the same in every epoch.
fn positions() -> [Q1_14; WORDS] {
    let positions = [0.1, -0.7, 0.6, -0.4, 0.3, 0.2].map(Q1_14::nearest);
    std::array::from_fn(|joint| positions.get(joint).copied().unwrap_or_default())
}

/// The far end of the wire at a cell's port.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum PortEnd {
    /// The port of a cell: the index of the cell, and that of the port.
    Cell(usize, usize),
    /// The gateway's side, with the index of the root.
    Gateway(usize),
}

#[derive(Debug)]
enum Event {
    Wake(usize),
    Deliver(usize, Inlet),
    ToGateway(usize, PortMessage),
    GatewayWake,
    Joints,
}

/// The sums of one epoch that the gateway received.
#[derive(Clone, Copy, Debug, Default)]
pub struct EpochSums {
    /// The cells in the sums: bit i is set for cell i.
    pub cells: u128,
    /// The number of sums that were received.
    pub frames: u32,
}

/// A skin of wired cells.
#[derive(Debug)]
pub struct Wiring {
    /// The cells.
    pub cells: Vec<WiredCell>,
    /// The cells that are wired to the gateway's side.
    pub roots: Vec<usize>,
    /// The sums that the gateway received in the epoch of each broadcast.
    pub took: Vec<EpochSums>,
    /// The probability that a message over a wire is lost.
    pub loss: f64,
    /// The maximum depth in the tree for which cells have a slot to send sums.
    pub deepest: u8,
    uplinks: Uplinks,
    root_sums: HashMap<usize, (SumWords, u128)>,
    agenda: Agenda<Event>,
    gateway_newest: Micros,
    epoch: Option<Epoch>,
    ticking: bool,
    dice: Pcg64Mcg,
}

impl Wiring {
    /// Creates cells without wires; [`Wiring::start`] switches each one on.
    #[must_use]
    pub fn new(cells: usize, seed: u64) -> Self {
        let mut dice = Pcg64Mcg::seed_from_u64(seed);
        let cells = (0..cells).map(|index| WiredCell::new(index, &mut dice)).collect();
        let mut wiring = Self {
            cells,
            roots: Vec::new(),
            took: Vec::new(),
            loss: 0.0,
            deepest: 0,
            uplinks: Uplinks::new(0, 0, Micros(0)),
            root_sums: HashMap::new(),
            agenda: Agenda::default(),
            gateway_newest: Micros(0),
            epoch: None,
            ticking: false,
            dice,
        };
        wiring.agenda.enter(Micros(0), Event::GatewayWake);
        wiring
    }

    /// Creates cells wired at random: mostly connected, with more wires than a tree needs.
    #[must_use]
    pub fn random(seed: u64) -> Self {
        let mut dice = Pcg64Mcg::seed_from_u64(seed ^ 0xA11);
        let count = dice.random_range(2..=20);
        let mut wiring = Self::new(count, seed);
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(&mut dice);
        for (at, &cell) in order.iter().enumerate().skip(1) {
            // Occasionally a cell stays unconnected.
            if dice.random_bool(0.95) {
                let other = order[dice.random_range(0..at)];
                wiring.wire_some(cell, other, &mut dice);
            }
        }
        for _ in 0..dice.random_range(0..=count) {
            let (a, b) = (dice.random_range(0..count), dice.random_range(0..count));
            if a != b {
                wiring.wire_some(a, b, &mut dice);
            }
        }
        for _ in 0..dice.random_range(1..=2) {
            let root = *order.choose(&mut dice).expect("there are cells");
            if !wiring.roots.contains(&root) {
                wiring.add_root(root);
            }
        }
        wiring
    }

    fn wire_some(&mut self, a: usize, b: usize, dice: &mut Pcg64Mcg) {
        let mut free = |cell: &WiredCell| {
            let free: Vec<usize> = (0..PORTS).filter(|&port| cell.wires[port].is_none()).collect();
            free.choose(dice).copied()
        };
        if let (Some(p), Some(q)) = (free(&self.cells[a]), free(&self.cells[b])) {
            self.wire(a, p, b, q);
        }
    }

    /// Adds a wire between port `p` of cell `a` and port `q` of cell `b`.
    pub fn wire(&mut self, a: usize, p: usize, b: usize, q: usize) {
        self.cells[a].wires[p] = Some(PortEnd::Cell(b, q));
        self.cells[b].wires[q] = Some(PortEnd::Cell(a, p));
    }

    /// Makes a cell a root: adds a wire from it to the gateway's side.
    pub fn add_root(&mut self, cell: usize) {
        self.cells[cell].wires[UPLINK] = Some(PortEnd::Gateway(self.roots.len()));
        self.roots.push(cell);
        self.uplinks = Uplinks::new(self.roots.len(), 0, self.agenda.now);
    }

    /// Takes one direction of a wire down, or brings it up: messages of `cell` through `port` do not arrive.
    pub fn set_link_down(&mut self, cell: usize, port: usize, is_down: bool) {
        if let Some(PortEnd::Cell(other, at)) = self.cells[cell].wires[port] {
            self.cells[other].deaf[at] = is_down;
            self.send_links_down(other);
        }
    }

    /// Sends a cell the list of its links that are down, as the gateway does.
    pub fn send_links_down(&mut self, cell: usize) {
        let place = &self.cells[cell];
        let Some(node_id) = place.node_id else { return };
        let deaf = place.deaf.iter().enumerate().map(|(port, deaf)| u8::from(*deaf) << port).sum();
        let request = Request::Write {
            number: Parameter::LinksDown.number(),
            words: LinksDown { ports: deaf }.words(),
        };
        let message = Message::Configure { to: protocol::id::Node::Cell(node_id), tag: 0, request };
        let frame = message.encode().frames(Format::Fd).next().expect("one frame");
        self.deliver(cell, Inlet::Frame(frame));
    }

    /// Returns the current time.
    #[must_use]
    pub const fn now(&self) -> Micros {
        self.agenda.now
    }

    /// Switches a cell on, or off and on.
    pub fn start(&mut self, cell: usize) {
        let (now, place) = (self.agenda.now, &mut self.cells[cell]);
        let identity = Identity { cell: place.node_id, serial: place.serial };
        let wired = place.wires.iter().enumerate().filter(|(_, wire)| wire.is_some());
        let wired = wired.map(|(port, _)| 1 << port).sum();
        let node = Node::new(identity, Format::Fd, &FlashState::Valid(place.parameters), true, now);
        place.life = PowerState::Runs(Box::new(node.with_ports(wired)));
        place.wake = None;
        place.deferred.clear();
        (place.tree, place.ports) = (None, None);
        self.after(cell);
    }

    /// Switches a cell off.
    pub fn kill(&mut self, cell: usize) {
        self.cells[cell].life = PowerState::Off;
        self.cells[cell].wake = None;
    }

    /// Hangs a cell.
    pub fn hang(&mut self, cell: usize) {
        self.cells[cell].life.hang();
    }

    /// Makes a hung cell continue with its collected input.
    pub fn go_on(&mut self, cell: usize) {
        let Some(waiting) = self.cells[cell].life.go_on() else { return };
        self.pass(cell);
        for (stood, inlet) in waiting {
            self.hand(cell, stood, inlet);
        }
    }

    /// Runs the cells for this time.
    pub fn run(&mut self, span: Span) {
        let until = self.agenda.now + span;
        while let Some(event) = self.agenda.take_until(until) {
            self.happen(event);
        }
        self.agenda.now = until;
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Wake(cell) => {
                if self.cells[cell].wake == Some(self.agenda.now) {
                    self.cells[cell].wake = None;
                    self.pass(cell);
                }
            }
            Event::Deliver(cell, inlet) => self.deliver(cell, inlet),
            Event::ToGateway(root, message) => {
                self.uplinks.handle_message(self.agenda.now, root, message);
                self.gateway_sends();
            }
            Event::GatewayWake => {
                self.uplinks.handle_time(self.agenda.now);
                self.gateway_sends();
                let next = self.uplinks.poll_timeout().max(self.agenda.now + Span(500));
                self.agenda.enter(next, Event::GatewayWake);
            }
            Event::Joints if self.ticking => self.broadcast(),
            Event::Joints => {}
        }
    }

    /// Delivers input to a cell, or collects it while the cell hangs.
    fn deliver(&mut self, cell: usize, inlet: Inlet) {
        let now = self.agenda.now;
        if let PowerState::Hangs(_, waiting) = &mut self.cells[cell].life {
            waiting.push_back((now, inlet));
        } else {
            self.hand(cell, now, inlet);
        }
    }

    fn pass(&mut self, cell: usize) {
        self.receive_deferred(cell);
        let now = self.agenda.now;
        if let PowerState::Runs(node) = &mut self.cells[cell].life {
            node.handle_timeout(now);
        }
        self.after(cell);
    }

    /// Delivers the deferred frames of a cell, which it reads before the input that wakes it.
    fn receive_deferred(&mut self, cell: usize) {
        let now = self.agenda.now;
        loop {
            let place = &mut self.cells[cell];
            let PowerState::Runs(node) = &mut place.life else { return };
            let Some((stood, frame)) = place.deferred.pop_front() else { return };
            node.handle_frame(now, now.elapsed_since(stood), &frame);
            self.after(cell);
        }
    }

    fn hand(&mut self, cell: usize, stood: Micros, inlet: Inlet) {
        let now = self.agenda.now;
        let place = &mut self.cells[cell];
        if let (PowerState::Runs(node), Inlet::Frame(frame)) = (&place.life, inlet)
            && packet::data_frame_id(&frame).is_ok_and(|id| node.may_receive_deferred(id))
        {
            place.deferred.push_back((stood, frame));
            return;
        }
        self.receive_deferred(cell);
        let place = &mut self.cells[cell];
        if let PowerState::Runs(node) = &mut place.life {
            match inlet {
                Inlet::Frame(frame) => node.handle_frame(now, now.elapsed_since(stood), &frame),
                Inlet::Port(port, _) if place.deaf[port] => {}
                Inlet::Port(port, message) => node.handle_port(now, Span(0), port, message),
            }
        }
        self.after(cell);
    }

    /// Sends the messages of a cell after an input, and schedules its next timeout.
    fn after(&mut self, cell: usize) {
        let place = &mut self.cells[cell];
        let PowerState::Runs(node) = &mut place.life else { return };
        if let Some(kept) = node.poll_store() {
            place.node_id = kept.number;
            node.handle_stored(true);
        }
        assert_eq!(node.other_owner(), None, "cell {cell} gave up its node id {:?}", place.node_id);
        // Its subscriptions are checked for each frame that arrives.
        let _ = node.poll_received_ids();
        let mut messages = Vec::new();
        while let Some(message) = node.poll_port_transmit() {
            messages.push(message);
        }
        let mut packets = Vec::new();
        while let Some(packet) = node.poll_transmit().copied() {
            packets.push(packet);
        }
        let timeout = node.poll_timeout().max(self.agenda.now + Span(1));
        if place.wake != Some(timeout) {
            place.wake = Some(timeout);
            self.agenda.enter(timeout, Event::Wake(cell));
        }
        for (port, message) in messages {
            let end = self.cells[cell].wires[port].expect("a wired port");
            if self.loss > 0.0 && self.dice.random_bool(self.loss) {
                continue;
            }
            match end {
                PortEnd::Cell(other, at) => {
                    let at_time = self.arrival(Some(other));
                    self.agenda.enter(at_time, Event::Deliver(other, Inlet::Port(at, message)));
                }
                PortEnd::Gateway(root) => {
                    let at = self.arrival(None);
                    self.agenda.enter(at, Event::ToGateway(root, message));
                }
            }
        }
        for packet in packets {
            let message = Message::decode(&packet).expect("cells say what has a meaning");
            match message {
                Message::Sum { from, epoch, torque, count } => {
                    let torque = torque.padded().map(Q7_8::from_bits);
                    self.handle_sum(cell, from, epoch, SumWords { torque, count });
                }
                Message::Network { page: NetworkPage::Tree(tree), .. } => self.cells[cell].tree = Some(tree),
                Message::Network { page: NetworkPage::Ports(ports), .. } => {
                    self.cells[cell].ports = Some(ports);
                }
                Message::Network { page: NetworkPage::Heartbeat(_), .. } => {
                    self.uplinks.mark_node_id_used(
                        self.cells[cell].node_id.expect("a cell that sends has a node id"),
                    );
                }
                _ => {}
            }
        }
    }

    /// Returns the arrival time of a message that is sent now, so that messages keep their order.
    fn arrival(&mut self, at: Option<usize>) -> Micros {
        let arrives = self.agenda.now + THINKING_TIME + Span(self.dice.random_range(LATENCY.0..=LATENCY.1));
        let newest = at.map_or(&mut self.gateway_newest, |cell| &mut self.cells[cell].newest);
        *newest = arrives.max(*newest);
        *newest
    }

    fn gateway_sends(&mut self) {
        while let Some((root, message)) = self.uplinks.poll_transmit() {
            if self.loss > 0.0 && self.dice.random_bool(self.loss) {
                continue;
            }
            let cell = self.roots[root];
            let at = self.arrival(Some(cell));
            self.agenda.enter(at, Event::Deliver(cell, Inlet::Port(UPLINK, message)));
        }
    }

    /// Sends a message from the gateway to every cell that receives it.
    pub fn send(&mut self, message: &Message) {
        let frame = message.encode().frames(Format::Fd).next().expect("one frame");
        for cell in 0..self.cells.len() {
            let at = self.arrival(Some(cell));
            self.agenda.enter(at, Event::Deliver(cell, Inlet::Frame(frame)));
        }
    }

    fn broadcast(&mut self) {
        let epoch = self.epoch.map_or(Epoch(0), Epoch::next);
        self.epoch = Some(epoch);
        self.root_sums.clear();
        self.took.push(EpochSums::default());
        let joints = Joints { positions: pad_with_defaults(&positions()), in_use: 6 };
        self.send(&Message::Joints { epoch, joints });
        self.agenda.enter_in(PERIOD, Event::Joints);
    }

    /// Starts the broadcasts of joints.
    pub fn begin(&mut self) {
        self.ticking = true;
        self.agenda.enter_in(Span(0), Event::Joints);
    }

    /// Stops the broadcasts of joints.
    pub const fn stop(&mut self) {
        self.ticking = false;
    }

    /// Makes every cell answer with sums, for trees of at most this depth.
    pub fn switch(&mut self, deepest: u8, carry: bool) {
        self.deepest = deepest;
        let slot_us = u16::try_from(12_000 / (u32::from(deepest) + 1)).expect("a slot");
        let reply = ReplyKind::Sum(SumSchedule { slot_us, deepest, carry });
        let request = Request::Write { number: Parameter::Reply.number(), words: reply.words() };
        self.send(&Message::Configure { to: protocol::id::Node::Everyone, tag: 0, request });
    }

    /// Presses or releases a cell from the next joints on.
    pub fn press(&mut self, cell: usize, pressed: bool) {
        let Some(node_id) = self.cells[cell].node_id else { return };
        let word = Q5_10::from_bits(i16::try_from(self.cells[cell].force.steps() >> 6).expect("a word"));
        let contact = if pressed { [word, Q5_10::ZERO, Q5_10::ZERO] } else { [Q5_10::ZERO; 3] };
        let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
        self.send(&Message::Stimulus {
            to: protocol::id::Node::Cell(node_id),
            from: StimulusStart::Next,
            page,
        });
    }
}
