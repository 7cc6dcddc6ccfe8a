//! The cell as a state machine: frames and times go in, packets and times come out.
//!
//! ```text
//!   frame, now, age ─> handle_frame ───┐          ┌─> poll_transmit ─> packet
//!              now ─> handle_timeout ──┼─ [Node] ─┼─> poll_timeout ──> when to call again
//!       ok or not ─> handle_stored ────┘          ├─> poll_store ────> parameters for flash
//!                                                 └─> taken ─────────> who has this number already
//! ```
//!
//! It never blocks, allocates or panics, and reads no clock. A frame that it cannot use is counted by
//! its reason, and nothing else.

mod configuration;
mod sensing;
mod stimuli;
mod summing;
mod switches;

use heapless::Deque;
use protocol::can::{Format, Frame};
use protocol::fixed::Q3_12;
use protocol::id::{CellId, Command, Id, Kind, Node as Address};
use protocol::message::{
    Answer, From, Heard, Heartbeat, Joints, Message, NetworkPage, Refused, Request, SensorPage, State,
    VERSION,
};
use protocol::packet::{self, Epoch, Half, Packet, PacketError, Paired, WORDS};
use protocol::parameters::{Parameter, Parameters, Reply};
use protocol::time::{Micros, Span};
use protocol::wire::{PORTS, PortMessage};

use crate::contact::Torque;
use crate::flash::Kept;
use crate::kernel::Kernel;
use crate::network::Network;
use crate::sum::{Sum, Words};
use configuration::{Configuration, Written};
use sensing::Sensing;
use stimuli::{Arrival, Stimuli};
use summing::STEADY;
use switches::Switches;

pub use configuration::Flash;
pub use stimuli::PENDING;

/// From one heartbeat to the next.
pub const HEARTBEAT: Span = Span::from_millis(250);
/// How long a new cell listens at least for another one under its number.
pub const CLAIM: Span = Span::from_millis(250);
/// First words are spread over this time by serial number: two cells under one number that are switched
/// on together would else send different data under one identifier in the same bit time.
const FIRST_WORD: Span = Span::from_millis(64);
/// The shortest time between two words about its place in the tree.
const TREE: Span = Span::from_millis(50);
/// The shortest time between two answers to another cell under our number.
const DEFEND: Span = Span::from_millis(10);

/// Identifiers that every cell with a number hears.
pub const OWN: usize = 10;
/// Identifiers that a cell can hear: these, and the sums of the cells at its ports.
pub const HEARD: usize = OWN + PORTS;
/// Packets that wait to be sent; a shell takes them after every call.
const OUTBOX: usize = 16;

/// Who a cell is, from the factory on.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Identity {
    /// Its number on the bus; none until the network gives it one.
    pub cell: Option<CellId>,
    /// Its serial number.
    pub serial: u32,
}

impl Identity {
    /// The identifiers that this cell hears whatever the network is like: halt, joints, sync, resume, report;
    /// its own heartbeats' (to notice another cell under its number); what configures and presses it, alone
    /// or with everyone. A cell without a number hears nothing but its ports.
    #[must_use]
    pub fn hears(&self) -> [Option<Id>; OWN] {
        let all = |cell| {
            let cell = Address::Cell(cell);
            [
                Id::command(Command::Halt),
                Id::command(Command::Joints),
                Id::command(Command::Sync),
                Id::command(Command::Resume),
                Id::command(Command::Report),
                Id::new(Kind::Network, cell),
                Id::new(Kind::Configure, cell),
                Id::new(Kind::Configure, Address::Everyone),
                Id::new(Kind::Stimulus, cell),
                Id::new(Kind::Stimulus, Address::Everyone),
            ]
            .map(Some)
        };
        self.cell.map_or([None; OWN], all)
    }
}

/// What is being written into flash.
#[derive(Clone, Copy, Debug)]
enum Storing {
    /// Parameters that somebody committed, with the request's tag.
    Parameters(Parameters, u8),
    /// The number that the network gave.
    Number,
}

/// How far a cell is with claiming its number.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Claim {
    /// It has not said anything yet.
    Unsaid,
    /// It has claimed the number and listens whether somebody else has it.
    Said,
    /// The number is its own.
    Settled,
}

/// One cell.
#[derive(Debug)]
pub struct Node {
    identity: Identity,
    format: Format,
    configuration: Configuration,
    stimuli: Stimuli,
    /// Halted, duplicate and so on; what can be derived is added when a heartbeat is made.
    flags: State,
    /// The last joints taken.
    epoch: Option<Epoch>,
    active: bool,
    heard: Heard,
    refused: Refused,
    sent: u16,
    halves: [Half; HEARD],
    outbox: Deque<Message, OUTBOX>,
    storing: Option<Storing>,
    switches: Switches,
    network: Network,
    sums: Sum,
    /// By port, whose sums are heard.
    heard_sums: [Option<CellId>; PORTS],
    sensing: Sensing,
    hears_changed: bool,
    /// Epochs in a row in which a child was waited for and nothing was amiss.
    steady: u8,
    /// Joints are heard aside: what wakes this cell is its children.
    waits_for_children: bool,
    /// The parent that this epoch's sum is for, and its port.
    parent: Option<(usize, Option<CellId>)>,
    /// Whether a sum of the parent was heard in this epoch.
    heard_parent: bool,
    /// Whether a sum was said in the epoch before the present one.
    said_before: bool,
    /// The parent may not have taken a sum: it is asked whether it hears this cell, until it answers.
    asks_parent: bool,
    /// Epochs in a row in which it did not.
    unanswered: u16,
    /// How many of them are borne, in sixteenths: who lost parents that were there all the time is on a machine that is
    /// late, and would only lose the next one too.
    patience: u16,
    /// The port of a parent that was lost and may have been there all the time.
    suspected: Option<usize>,
    changes: u16,
    /// A sync that waits for the present epoch's end.
    asked: bool,
    tell_tree: bool,
    /// Not before this its place in the tree is told again.
    next_tree: Micros,
    /// The round that was told last.
    told_round: u8,
    claim: Claim,
    next_heartbeat: Micros,
    defended: Option<Micros>,
    taken: Option<u32>,
}

impl Node {
    /// A cell that starts now: it will claim its number with a first heartbeat, and obeys stimuli if
    /// `test_mode` says so.
    #[must_use]
    pub fn new(identity: Identity, format: Format, flash: &Flash, test_mode: bool, now: Micros) -> Self {
        Self {
            identity,
            format,
            configuration: Configuration::new(flash),
            stimuli: Stimuli::default(),
            flags: State::default()
                .with(State::FLASH_DAMAGED, *flash == Flash::Damaged)
                .with(State::TEST_MODE, test_mode),
            epoch: None,
            active: false,
            heard: Heard::default(),
            refused: Refused::default(),
            sent: 0,
            halves: [Half::NONE; HEARD],
            outbox: Deque::new(),
            storing: None,
            switches: Switches::default(),
            network: Network::new(now),
            sums: Sum::default(),
            heard_sums: [None; PORTS],
            sensing: Sensing::default(),
            hears_changed: false,
            steady: 0,
            waits_for_children: false,
            parent: None,
            heard_parent: false,
            said_before: false,
            asks_parent: false,
            unanswered: 0,
            patience: 0,
            suspected: None,
            changes: 0,
            asked: false,
            tell_tree: true,
            next_tree: now,
            told_round: 0,
            claim: Claim::Unsaid,
            next_heartbeat: first_word(identity, now),
            defended: None,
            taken: None,
        }
    }

    /// The same cell in a network: bit p says that port p leads somewhere, bit 4 that it is wired to the
    /// gateway's side.
    #[must_use]
    pub fn with_ports(mut self, wired: u8) -> Self {
        let number = self.identity.cell.map_or(0, CellId::get);
        let phase = Span(u64::from(self.identity.serial) * 1_000 % HEARTBEAT.0);
        self.network = self.network.wired(wired, number, phase);
        self
    }

    /// The next message for a port: to be sent before the packets of the same call.
    pub fn poll_port_transmit(&mut self) -> Option<(usize, PortMessage)> {
        self.network.poll_transmit()
    }

    /// Whether the identifiers that it hears have changed since the last call.
    pub fn poll_hears(&mut self) -> bool {
        let waits = self.steady == STEADY && !self.asks_parent && self.sums.awaits_children();
        let changed = core::mem::replace(&mut self.waits_for_children, waits) != waits;
        core::mem::replace(&mut self.hears_changed, false) | changed
    }

    /// Who it is.
    #[must_use]
    pub const fn identity(&self) -> Identity {
        self.identity
    }

    /// The serial number of the cell that has this number already; then this one must fall silent.
    #[must_use]
    pub const fn taken(&self) -> Option<u32> {
        self.taken
    }

    /// The next packet to send.
    pub fn poll_transmit(&mut self) -> Option<Packet> {
        let mut message = self.outbox.pop_front()?;
        // The counter says what went out before, so it is filled in when the heartbeat itself goes out.
        if let Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } = &mut message {
            heartbeat.sent = self.sent;
        }
        self.sent = self.sent.wrapping_add(1);
        Some(message.encode())
    }

    /// When [`Node::handle_timeout`] has something to do; calling it earlier does no harm.
    #[must_use]
    pub fn poll_timeout(&self) -> Micros {
        let sums = self.sums.poll_timeout().unwrap_or(Micros(u64::MAX));
        let sensing = self.sensing_due().unwrap_or(Micros(u64::MAX));
        let look = if self.waits_for_children { self.sums.late_at_next() } else { Micros(u64::MAX) };
        self.next_heartbeat.min(self.network.poll_timeout()).min(sums).min(sensing).min(look)
    }

    /// What has to go into flash; then comes [`Node::handle_stored`].
    #[must_use]
    pub fn poll_store(&self) -> Option<Kept> {
        let parameters = match self.storing? {
            Storing::Parameters(parameters, _) => Some(parameters),
            Storing::Number => self.configuration.in_use().map(|in_use| in_use.parameters),
        };
        Some(Kept { number: self.identity.cell, parameters })
    }

    /// Flash was written, or could not be.
    pub fn handle_stored(&mut self, written: bool) {
        // A number that could not be kept is given anew after the next start.
        let Some(Storing::Parameters(parameters, tag)) = self.storing.take() else { return };
        let answer = self.configuration.stored(parameters, written);
        self.flags = self.flags.with(State::FLASH_DAMAGED, self.flags.has(State::FLASH_DAMAGED) && !written);
        if let Some(from) = self.identity.cell {
            self.push(Message::Configured { from, tag, answer });
        }
    }

    /// The identifiers that this cell hears now; a shell asks again after [`Node::poll_hears`].
    pub fn hears(&self) -> impl Iterator<Item = Id> + use<'_> {
        self.slots().into_iter().flatten()
    }

    /// Whether it need not be woken for one of them, as long as it hears it before whatever comes next: the
    /// parent's sum, which only tells that the parent is there; and joints while it would only wait for its children's
    /// sums, which come after them.
    #[must_use]
    pub fn hears_aside(&self, id: Id) -> bool {
        if id == Id::command(Command::Joints) {
            return self.waits_for_children;
        }
        let parent = self.network.up().and_then(|up| self.heard_sums.get(up).copied().flatten());
        parent.is_some_and(|parent| id == Id::new(Kind::Sum, Address::Cell(parent)))
    }

    /// By slot of a pair's waiting half.
    fn slots(&self) -> [Option<Id>; HEARD] {
        let mut slots = [None; HEARD];
        let sums = self.heard_sums.map(|cell| Some(Id::new(Kind::Sum, Address::Cell(cell?))));
        for (slot, id) in slots.iter_mut().zip(self.identity.hears().into_iter().chain(sums)) {
            *slot = id;
        }
        slots
    }

    /// Takes in that time has passed. Harmless when called early.
    pub fn handle_timeout(&mut self, now: Micros) {
        if self.waits_for_children && now >= self.sums.late_at_next() {
            // No joints came: from now on they wake it again.
            self.steady = 0;
        }
        self.network.handle_time(now);
        self.after_network(now);
        self.handle_sums(now);
        self.sense_in_time(now);
        if now < self.next_heartbeat || self.identity.cell.is_none() {
            return;
        }
        if self.claim == Claim::Unsaid {
            self.claim = Claim::Said;
            self.next_heartbeat = now + CLAIM + self.identity.cell.map_or(Span(0), phase);
            return self.push_heartbeat();
        }
        self.claim = Claim::Settled;
        self.regular_heartbeat(now);
    }

    fn regular_heartbeat(&mut self, now: Micros) {
        self.push_heartbeat();
        if self.network.exists() {
            // Another round alone is no news for anybody else.
            self.tell_tree |= self.told_round != self.network.round();
            self.tell_tree(now);
            if self.network.ports_changed(now) {
                self.push_ports(now);
            }
        }
        self.sense_with_heartbeat(now);
        // After a hang the missed ones are skipped, and the phase is kept.
        let missed = now.since(self.next_heartbeat).0 / HEARTBEAT.0;
        self.next_heartbeat = self.next_heartbeat + Span((missed + 1) * HEARTBEAT.0);
    }

    /// Takes a frame that came `age` ago. What this cell does not hear is ignored.
    pub fn handle_frame(&mut self, now: Micros, age: Span, frame: &Frame) {
        let Ok(id) = packet::data_id(frame) else {
            count(&mut self.refused.foreign);
            return;
        };
        let Some(slot) = self.slots().iter().position(|&heard| heard == Some(id)) else { return };
        let packet = match self.format {
            Format::Fd => Packet::from_fd(frame),
            Format::Classic => match self.pair(now - age, id, slot, frame) {
                Some(result) => result,
                None => return,
            },
        };
        match packet {
            Ok(packet) => self.handle_packet(now, age, &packet),
            Err(PacketError::Length { .. }) => count(&mut self.refused.length),
            Err(PacketError::Crc { .. }) => count(&mut self.refused.crc),
            Err(_) => count(&mut self.refused.foreign),
        }
    }

    /// Two classic frames make a packet; `None` while there is none.
    fn pair(
        &mut self,
        arrived: Micros,
        id: Id,
        slot: usize,
        frame: &Frame,
    ) -> Option<Result<Packet, PacketError>> {
        let half = self.halves.get_mut(slot)?;
        if frame.format() != Format::Classic {
            return Some(Err(PacketError::Length { expected: 8, got: frame.data().len() }));
        }
        match half.push(arrived, id, frame.data()) {
            Ok(Paired::Waiting) => None,
            Ok(Paired::Incomplete) => {
                count(&mut self.refused.incomplete);
                None
            }
            Ok(Paired::Whole(packet)) => Some(Ok(packet)),
            Err(error) => Some(Err(error)),
        }
    }

    fn handle_packet(&mut self, now: Micros, age: Span, packet: &Packet) {
        let Ok(message) = Message::decode(packet) else {
            count(&mut self.refused.meaning);
            return;
        };
        match message {
            Message::Joints { epoch, joints } => {
                let taken = self.heard.joints;
                self.take_joints(now, age, epoch, &joints);
                // What was latched at joints that were too old is told with the next.
                if self.heard.joints != taken {
                    self.sense(now);
                }
                self.sense_before_the_next_joints(now);
                self.speak_before_the_next_joints(now);
            }
            Message::Halt => {
                self.flags = self.flags.with(State::HALTED, true);
                self.active = false;
            }
            Message::Resume => self.flags = self.flags.with(State::HALTED, false),
            Message::Stimulus { from, page, .. } => self.take_stimulus(from, page),
            Message::Network { page, .. } => self.hear_own_number(now, &page),
            // Whose number is in doubt answers nothing.
            Message::Sync | Message::Report | Message::Configure { .. } if self.claim != Claim::Settled => {}
            Message::Sync if self.sums.is_on() && !self.sums.is_settled(now) => {
                self.asked = true;
                self.sums.watch();
            }
            Message::Sync => self.push_heartbeat(),
            Message::Report => {
                self.push_network(NetworkPage::Heard(self.heard));
                self.push_network(NetworkPage::Refused(self.refused));
                self.push_sensors(SensorPage::Skin(*self.stimuli.skin()));
                self.push_sensors(SensorPage::Acceleration(self.stimuli.acceleration()));
                if self.network.exists() {
                    self.push_tree(now);
                    self.push_ports(now);
                }
            }
            Message::Configure { tag, request, .. } => {
                self.configure(now, tag, request);
                // Another mode is another beginning, and who leaves test mode feels nothing any more.
                self.sense(now);
            }
            Message::Sum { from, epoch, torque, count } => {
                self.take_sum(now, age, from, (epoch, Words { torque, count }));
            }
            // None of these is heard, see `Identity::hears`.
            Message::Torque { .. } | Message::Sensors { .. } | Message::Configured { .. } => {}
        }
    }

    /// Computes and answers; the paper's Eq. 8 and Algorithm 1.
    fn take_joints(&mut self, now: Micros, age: Span, epoch: Epoch, joints: &Joints) {
        if self.epoch == Some(epoch) {
            count(&mut self.heard.joints_repeated);
            return;
        }
        // All that came before these joints has been heard.
        self.judge(now);
        let in_use = self.configuration.in_use();
        if in_use.is_some_and(|in_use| in_use.parameters.joints != joints.in_use) {
            count(&mut self.refused.meaning);
            return;
        }
        // Old joints are not answered, but what holds from them on holds: a cell that hung would else keep
        // feeling what was there before.
        self.epoch = Some(epoch);
        self.stimuli.latch(epoch);
        if in_use.is_some_and(|in_use| age.0 > u64::from(in_use.parameters.period_us)) {
            count(&mut self.heard.joints_late);
            return self.sums.skip();
        }
        count(&mut self.heard.joints);
        if self.claim != Claim::Settled || self.flags.has(State::HALTED) {
            return self.sums.skip();
        }
        let Some(in_use) = in_use else { return self.sums.skip() };
        let force = in_use.force(self.stimuli.skin());
        if self.sums.is_on() {
            let torque =
                force.is_active().then(|| Torque::new(&in_use.kernel.jacobian(&joints.positions), force));
            let period = Span(in_use.parameters.period_us.into());
            self.active = force.is_active();
            return self.begin_sum(now, age, (epoch, period), torque);
        }
        if !force.is_active() {
            self.end_contact();
            return;
        }
        let torque = Torque::new(&in_use.kernel.jacobian(&joints.positions), force);
        let saturated = self.flags.has(State::SATURATED) || torque.is_saturated();
        self.flags = self.flags.with(State::SATURATED, saturated);
        self.active = true;
        self.push_torque(epoch, torque.words());
    }

    /// What is due before the next joints is said now, while the cell is awake: hellos and a heartbeat.
    fn speak_before_the_next_joints(&mut self, now: Micros) {
        let Some(in_use) = self.configuration.in_use() else { return };
        let next_joints = now + Span(in_use.parameters.period_us.into());
        self.network.hello_by(now, next_joints);
        self.tell_tree(now);
        if self.claim == Claim::Settled && next_joints > self.next_heartbeat {
            self.regular_heartbeat(now);
        }
    }

    /// One zero torque says that a contact has ended.
    fn end_contact(&mut self) {
        if let (true, Some(epoch)) = (self.active, self.epoch) {
            self.active = false;
            self.push_torque(epoch, [Q3_12::ZERO; WORDS]);
        }
    }

    fn push_torque(&mut self, epoch: Epoch, torque: [Q3_12; WORDS]) {
        let Some(from) = self.identity.cell else { return };
        count(&mut self.heard.torques);
        self.push(Message::Torque { from, epoch, torque });
    }

    fn push_sensors(&mut self, page: SensorPage) {
        let Some(from) = self.identity.cell else { return };
        self.sensing.sends(&page);
        self.push(Message::Sensors { from, epoch: self.epoch.unwrap_or_default(), page });
    }

    fn take_stimulus(&mut self, from: From, page: SensorPage) {
        if !self.flags.has(State::TEST_MODE) {
            count(&mut self.refused.stimuli);
            return;
        }
        match self.stimuli.push(from, page, self.epoch) {
            Arrival::InTime => count(&mut self.heard.stimuli),
            Arrival::Late => {
                count(&mut self.heard.stimuli);
                count(&mut self.heard.stimuli_late);
            }
            Arrival::Refused => count(&mut self.refused.stimuli),
        }
    }

    fn configure(&mut self, now: Micros, tag: u8, request: Request) {
        let Some(from) = self.identity.cell else { return };
        let number = match request {
            Request::Read { number } | Request::Write { number, .. } => number,
        };
        let refuse = |reason| Answer::Refused { number, reason };
        let value = |written, words| Answer::Value { number, written, words };
        let answer = match (Parameter::from_number(number), request) {
            (None, _) => refuse(Answer::UNKNOWN),
            (Some(Parameter::Identity), Request::Read { .. }) => value(false, self.identity_words()),
            (Some(Parameter::Mode), Request::Read { .. }) => {
                value(false, [i16::from(self.flags.has(State::TEST_MODE)), 0, 0, 0, 0, 0])
            }
            (Some(Parameter::Mode), Request::Write { words, .. }) => {
                self.flags = self.flags.with(State::TEST_MODE, words.first() == Some(&1));
                self.stimuli.clear();
                value(true, words)
            }
            (Some(parameter), Request::Read { .. }) => {
                let switched = self.switches.read(parameter);
                value(false, switched.unwrap_or_else(|| self.configuration.read(parameter)))
            }
            (Some(parameter), Request::Write { words, .. }) => {
                let test_mode = self.flags.has(State::TEST_MODE);
                if let Some(answer) = self.switches.write(parameter, words, test_mode) {
                    self.switch(now);
                    return self.push(Message::Configured { from, tag, answer });
                }
                match self.configuration.write(parameter, words) {
                    Written::Answer(answer) => answer,
                    Written::Store(parameters) => {
                        self.storing = Some(Storing::Parameters(parameters, tag));
                        return;
                    }
                }
            }
        };
        self.push(Message::Configured { from, tag, answer });
    }

    /// Switches were set.
    fn switch(&mut self, now: Micros) {
        self.network.set_deaf(self.switches.cuts.deaf);
        self.sums.set_slots(match self.switches.reply {
            Reply::Torque => None,
            Reply::Sum(slots) => Some(slots),
        });
        self.after_network(now);
    }

    fn identity_words(&self) -> [i16; WORDS] {
        let [a, b, c, d] = self.identity.serial.to_le_bytes();
        [
            i16::from_le_bytes([a, b]),
            i16::from_le_bytes([c, d]),
            i16::from(VERSION),
            self.configuration.hash().cast_signed(),
            self.state().0.cast_signed(),
            0,
        ]
    }

    /// Somebody else spoke under our number. While we claim it we give way, unless the other claims it
    /// too and has the greater serial number; once it is ours we tell those who claim it, and only those:
    /// two settled cells would go on telling each other for ever.
    fn hear_own_number(&mut self, now: Micros, page: &NetworkPage) {
        self.flags = self.flags.with(State::DUPLICATE, true);
        let other = match page {
            NetworkPage::Heartbeat(other) => Some(other),
            NetworkPage::Heard(_)
            | NetworkPage::Refused(_)
            | NetworkPage::Tree(_)
            | NetworkPage::Ports(_) => None,
        };
        let claims = other.is_some_and(|other| other.state.has(State::CLAIMING));
        let stays = claims && other.is_some_and(|other| other.serial > self.identity.serial);
        if self.claim != Claim::Settled && !stays {
            self.taken = Some(other.map_or(0, |other| other.serial));
        } else if claims && self.defended.is_none_or(|at| now.since(at) >= DEFEND) {
            self.defended = Some(now);
            self.push_heartbeat();
        }
    }

    fn state(&self) -> State {
        let joint = self.configuration.in_use().map_or(0, |in_use| in_use.parameters.joint);
        self.flags
            .with(State::CONFIGURED, self.configuration.in_use().is_some())
            .with(State::ACTIVE, self.active)
            .with(State::CLAIMING, self.claim != Claim::Settled)
            .with_joint(joint)
    }

    fn push_heartbeat(&mut self) {
        let Refused { length, crc, foreign, meaning, incomplete, stimuli } = self.refused;
        let rejected =
            [length, crc, foreign, meaning, incomplete, stimuli].into_iter().fold(0, u16::wrapping_add);
        let heartbeat = Heartbeat {
            serial: self.identity.serial,
            configuration: self.configuration.hash(),
            sent: 0, // filled in when it goes out
            rejected,
            state: self.state(),
        };
        self.flags = self.flags.with(State::SATURATED, false).with(State::DUPLICATE, false);
        self.push_network(NetworkPage::Heartbeat(heartbeat));
    }

    fn push_network(&mut self, page: NetworkPage) {
        let Some(cell) = self.identity.cell else { return };
        let from = Address::Cell(cell);
        self.push(Message::Network { from, epoch: self.epoch.unwrap_or_default(), page });
    }

    /// One frame leads to four packets at most, and a shell takes them after each, so that there is room.
    fn push(&mut self, message: Message) {
        let fits = self.outbox.push_back(message).is_ok();
        debug_assert!(fits, "a shell takes what is to be sent after each call");
    }
}

/// When a cell claims its number; never while it has none.
const fn first_word(identity: Identity, now: Micros) -> Micros {
    match identity.cell {
        Some(_) => Micros(now.0 + identity.serial as u64 * 1_000 % FIRST_WORD.0),
        None => Micros(u64::MAX),
    }
}

/// Heartbeats of a bus are spread over the period by node number.
const fn phase(cell: CellId) -> Span {
    spread(HEARTBEAT, cell)
}

/// When in a period a cell speaks.
const fn spread(period: Span, cell: CellId) -> Span {
    Span(period.0 * cell.get() as u64 / 255)
}

const fn count(counter: &mut u16) {
    *counter = counter.wrapping_add(1);
}

#[cfg(test)]
mod tests;
