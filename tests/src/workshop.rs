//! A workshop that commissions cells in virtual time. It has real [`Node`]s, and a bus that loses, repeats and damages
//! frames at random from a seed. A test controls the power of cells and the end of the commissioning.

use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::node::Node;
use model::commission::{Commission, CommissionOptions, Report};
use model::decode::{Decoded, Decoder};
use protocol::can::{Format, Frame};
use protocol::id::CellId;
use protocol::message::Message;
use protocol::packet::Packet;
use protocol::parameters::Parameters;
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::agenda::Agenda;

/// The minimum and the maximum latency from the wire to a receiver.
const LATENCY: (u64, u64) = (40, 300);
/// The time limit of a commissioning.
const TIMEOUT: Span = Span::from_millis(60_000);

/// A cell in the workshop.
#[derive(Debug)]
pub struct WorkshopCell {
    /// The identity of the cell.
    pub identity: Identity,
    /// The content of the cell's flash.
    pub flash: FlashState,
    /// All contents that the cell's flash has had, oldest first.
    pub history: Vec<FlashState>,
    /// True if the cell's flash cannot be written.
    pub worn: bool,
    node: Option<Node>,
    /// The arrival time of the newest frame, which a later frame must not overtake.
    newest: Micros,
}

impl WorkshopCell {
    /// Returns the cell, while it is on.
    #[must_use]
    pub const fn node(&self) -> Option<&Node> {
        self.node.as_ref()
    }
}

/// A future event of the workshop.
#[derive(Clone, Copy, Debug)]
enum Event {
    ToCell(usize, Frame),
    ToGateway(Frame),
    Off(usize),
    On(usize),
}

/// A function that replaces packets on their way: for cells that send wrong values, and for damage that no CRC detects.
pub type Forger = fn(Packet) -> Packet;

/// A workshop with its cells, bus and clock.
#[derive(Debug)]
pub struct Workshop {
    /// The cells.
    pub pieces: Vec<WorkshopCell>,
    /// The probability that a frame is lost.
    pub loss: f64,
    /// The probability that a frame arrives twice.
    pub duplication: f64,
    /// The probability that a bit of a frame is flipped.
    pub damage: f64,
    /// The functions that replace packets to cells, and packets from cells.
    pub forgers: Option<(Forger, Forger)>,
    /// The number of messages that cells and the gateway's side have sent.
    pub messages_sent: u64,
    agenda: Agenda<Event>,
    format: Format,
    gateway_newest: Micros,
    dice: Pcg64Mcg,
}

impl Workshop {
    /// Creates an empty workshop.
    #[must_use]
    pub fn new(format: Format, seed: u64) -> Self {
        Self {
            pieces: Vec::new(),
            loss: 0.0,
            duplication: 0.0,
            damage: 0.0,
            forgers: None,
            messages_sent: 0,
            agenda: Agenda::default(),
            format,
            gateway_newest: Micros(0),
            dice: Pcg64Mcg::seed_from_u64(seed),
        }
    }

    /// Creates a workshop with a skin's cells, switched on now, with the content of flash that `flash` returns.
    #[must_use]
    pub fn with_cells(skin: &Skin, seed: u64, flash: impl Fn(usize) -> FlashState) -> Self {
        let mut workshop = Self::new(skin.buses.first().map_or(Format::Fd, |bus| bus.format), seed);
        for (place, cell) in skin.cells.iter().enumerate() {
            workshop.add(Identity { cell: Some(cell.node), serial: cell.serial }, flash(place));
        }
        workshop
    }

    /// Adds a cell, switched on now, and returns its index.
    pub fn add(&mut self, identity: Identity, flash: FlashState) -> usize {
        let place = self.pieces.len();
        let (history, newest) = (vec![flash], Micros(0));
        self.pieces.push(WorkshopCell { identity, flash, history, worn: false, node: None, newest });
        self.switch_on(place);
        place
    }

    /// Returns the current time.
    #[must_use]
    pub const fn now(&self) -> Micros {
        self.agenda.now
    }

    /// Returns a random number below `bound`.
    pub fn chance(&mut self, bound: u64) -> u64 {
        self.dice.random_range(0..bound)
    }

    /// Switches a cell off after a delay.
    pub fn switch_off_in(&mut self, span: Span, place: usize) {
        self.agenda.enter_in(span, Event::Off(place));
    }

    /// Switches a cell on after a delay, and off before that if it is on.
    pub fn switch_on_in(&mut self, span: Span, place: usize) {
        self.agenda.enter_in(span, Event::On(place));
    }

    fn switch_on(&mut self, place: usize) {
        let (now, format) = (self.agenda.now, self.format);
        if let Some(piece) = self.pieces.get_mut(place) {
            piece.node = Some(Node::new(piece.identity, format, &piece.flash, true, now));
        }
    }

    /// Runs the cells for a time without a commissioning.
    pub fn rest(&mut self, span: Span) {
        let until = self.agenda.now + span;
        while let Some(at) = self.next().filter(|&at| at <= until) {
            self.step(at, &mut |_, _| {});
        }
        self.agenda.now = until;
    }

    /// Commissions a skin until the end, or until it is killed after a time, and returns the report.
    ///
    /// # Panics
    /// Panics if the commissioning does not end within a time limit.
    pub fn commission(&mut self, skin: &Skin, wish: CommissionOptions, killed_after: Option<Span>) -> Report {
        let mut commission = Commission::new(skin, 0, wish, 1_000, self.agenda.now);
        let mut decoder = Decoder::new(Some(self.format));
        let (began, end) = (self.agenda.now, killed_after.map(|span| self.agenda.now + span));
        loop {
            commission.handle_time(self.agenda.now);
            while let Some(message) = commission.poll_transmit() {
                self.send(&message);
            }
            let Some(timeout) = commission.poll_timeout() else { return commission.report() };
            let at = timeout.min(self.next().unwrap_or(timeout)).max(self.agenda.now);
            if let Some(end) = end.filter(|&end| end <= at) {
                self.agenda.now = end;
                return commission.report();
            }
            assert!(at.elapsed_since(began) < TIMEOUT, "it does not end: {commission:#?}");
            self.step(at, &mut |now, frame| {
                if let Decoded::Message(message) = decoder.decode(now, "bus", &frame) {
                    commission.handle_message(now, &message);
                }
            });
        }
    }

    /// Returns the time of the next event.
    fn next(&self) -> Option<Micros> {
        let timers = self.pieces.iter().filter_map(|piece| Some(piece.node.as_ref()?.poll_timeout()));
        timers.chain(self.agenda.next()).min()
    }

    fn step(&mut self, at: Micros, gateway: &mut impl FnMut(Micros, Frame)) {
        self.agenda.now = at.max(self.agenda.now);
        let now = self.agenda.now;
        while let Some(event) = self.agenda.take_until(now) {
            match event {
                Event::ToGateway(frame) => gateway(now, frame),
                Event::ToCell(place, frame) => {
                    let node = self.pieces.get_mut(place).and_then(|piece| piece.node.as_mut());
                    if let Some(node) = node {
                        node.handle_frame(now, Span(0), &frame);
                        self.collect(place);
                    }
                }
                Event::Off(place) => {
                    self.pieces.get_mut(place).into_iter().for_each(|piece| piece.node = None)
                }
                Event::On(place) => self.switch_on(place),
            }
        }
        for place in 0..self.pieces.len() {
            let node = self.pieces.get_mut(place).and_then(|piece| piece.node.as_mut());
            if let Some(node) = node.filter(|node| node.poll_timeout() <= now) {
                node.handle_timeout(now);
                self.collect(place);
            }
        }
    }

    /// Writes the flash of a cell if it asks for that, and collects its packets.
    fn collect(&mut self, place: usize) {
        let Some(piece) = self.pieces.get_mut(place) else { return };
        let Some(node) = piece.node.as_mut() else { return };
        if let Some(kept) = node.poll_store() {
            if !piece.worn {
                piece.flash = kept.parameters.map_or(FlashState::Empty, FlashState::Valid);
                piece.history.push(piece.flash);
            }
            node.handle_stored(!piece.worn);
        }
        let packets: Vec<_> = core::iter::from_fn(|| node.poll_transmit().copied()).collect();
        if node.other_owner().is_some() {
            piece.node = None;
        }
        let forge = self.forgers.map(|(_, from)| from);
        for packet in packets {
            let packet = forge.map_or(packet, |forge| forge(packet));
            for frame in packet.frames(self.format) {
                self.pass(frame, Some(place));
            }
        }
    }

    /// Sends a message from the gateway's side to the cells.
    pub fn send(&mut self, message: &Message) {
        let packet = message.encode();
        let packet = self.forgers.map_or(packet, |(to, _)| to(packet));
        for frame in packet.frames(self.format) {
            self.pass(frame, None);
        }
    }

    /// Sends a message of another client, which the gateway's side receives too.
    pub fn send_from_other(&mut self, message: &Message) {
        for frame in message.encode().frames(self.format) {
            self.pass(frame, Some(usize::MAX));
        }
    }

    /// Passes a frame from a cell, or from the gateway's side, to all receivers, each with its own chances of faults.
    fn pass(&mut self, frame: Frame, from: Option<usize>) {
        self.messages_sent += 1;
        let id = frame.id();
        let hears = |piece: &WorkshopCell| {
            let node = piece.node.as_ref();
            node.is_some_and(|node| node.received_ids().any(|heard| u32::from(heard.to_bits()) == id))
        };
        let all = self.pieces.iter().enumerate();
        let hearers: Vec<_> = all.filter(|(_, piece)| hears(piece)).map(|(place, _)| place).collect();
        for place in hearers.into_iter().filter(|place| from != Some(*place)) {
            for frame in self.arriving(frame) {
                let at = self.arrival(self.pieces.get(place).map(|piece| piece.newest));
                self.pieces.get_mut(place).into_iter().for_each(|piece| piece.newest = at);
                self.agenda.enter(at, Event::ToCell(place, frame));
            }
        }
        if from.is_some() {
            for frame in self.arriving(frame) {
                self.gateway_newest = self.arrival(Some(self.gateway_newest));
                self.agenda.enter(self.gateway_newest, Event::ToGateway(frame));
            }
        }
    }

    fn arrival(&mut self, newest: Option<Micros>) -> Micros {
        let at = self.agenda.now + Span(self.dice.random_range(LATENCY.0..=LATENCY.1));
        newest.map_or(at, |newest| at.max(newest))
    }

    /// Returns the copies of a frame that arrive at one receiver.
    fn arriving(&mut self, frame: Frame) -> Vec<Frame> {
        if self.dice.random_bool(self.loss) {
            return Vec::new();
        }
        let mut frames = vec![frame; if self.dice.random_bool(self.duplication) { 2 } else { 1 }];
        for frame in &mut frames {
            if self.dice.random_bool(self.damage) {
                *frame = damaged(*frame, self.dice.random_range(0..64));
            }
        }
        frames
    }

    /// Returns the number of cells whose flash holds exactly the expected parameters.
    #[must_use]
    pub fn holding(&self, expected: impl Fn(usize) -> Parameters) -> usize {
        let holds =
            |(place, piece): &(usize, &WorkshopCell)| piece.flash == FlashState::Valid(expected(*place));
        self.pieces.iter().enumerate().filter(holds).count()
    }
}

/// Returns the frame with a bit of its data flipped.
fn damaged(frame: Frame, bit: usize) -> Frame {
    let mut data = frame.data().to_vec();
    if let Some(byte) = data.get_mut(bit / 8) {
        *byte ^= 1 << (bit % 8);
    }
    Frame::with_data(frame.raw_id(), frame.format(), frame.flags(), &data).unwrap_or(frame)
}

/// Converts a number to a node id.
///
/// # Panics
/// Panics if it is not a valid node id.
#[must_use]
pub fn cell(node: u8) -> CellId {
    CellId::new(node.into()).expect("a node id")
}
