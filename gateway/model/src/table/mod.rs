//! What a gateway knows of one bus: the latest of every cell, and the running sum of their torques.
//!
//! ```text
//!   frame, time, own ─> handle_frame ─┐           ┌─> Snapshot (what a tick needs, whatever the cells' number)
//!               time ─> handle_time ──┴─ [Table] ─┴─> counters, ledgers, accuracy (what the end's table needs)
//! ```
//!
//! Own frames are read back from the bus: the joints that open an epoch do so where they stand among the
//! others' frames, with the kernel's time stamp. Every frame costs bounded work; a new epoch and the
//! passing of time cost work for each cell, but in the thread that receives, not in the tick.

mod accuracy;
mod cell;
mod counters;
mod felt;
mod ledger;
mod sensed;
mod switched;
mod trunk;

use std::collections::{BTreeMap, VecDeque};

use hdrhistogram::Histogram;
use protocol::can::{Format, Frame};
use protocol::fixed::{Q, Q1_14};
use protocol::id::{CellId, Command, Id, Kind, Node};
use protocol::message::{Answer, Heartbeat, Joints, Message, NetworkPage, SensorPage, SkinSensors, State};
use protocol::packet::{self, Epoch, Half, Packet, PacketError, Paired, WORDS};
use protocol::parameters::{Cuts, Events, Parameter, Sensing};
use protocol::skin::{Reply, Safety, Skin};
use protocol::time::{Micros, Span};

use crate::central::Central;
use crate::network::check::Seen;
use crate::quantiles::histogram;
use cell::Speaker;
use switched::Switched;
use trunk::{Expected, Sum, Taken, Trunk};

pub use accuracy::{Accuracy, Errors};
pub use cell::{Cell, Said, Status};
pub use counters::{Counters, Event};
pub use ledger::{Replies, Uplink};
pub use sensed::Sensed;
pub use switched::{SWITCHES, Switch};
pub use trunk::{Contributions, SumCounts};

/// A cell that has said nothing for so long is dead: two heartbeats, and the jitter of a busy machine,
/// so that one lost frame kills nobody.
pub const DEAD_AFTER: Span = Span::from_millis(600);

/// What a tick needs to know of a bus: the same few words whatever the cells' number.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sums {
    /// The sum of all held torques in Nm.
    pub torque: [f64; WORDS],
    /// Cells in it.
    pub contributing: u32,
    /// Epochs that the oldest of them has missed.
    pub age: u32,
    /// Cells in contact that missed the last epoch.
    pub stale: u32,
    /// Cells that have fallen silent.
    pub dead: u32,
    /// The last broadcast of this gateway that was read back from the bus.
    pub read_back: Option<Epoch>,
    /// Halts heard that this gateway did not send.
    pub halts: u32,
    /// Resumes heard that this gateway did not send.
    pub resumes: u32,
    /// Frames of another gateway.
    pub rivals: u32,
}

/// What a receiver leaves for the loop: the sums, and what a central computation beside them needs.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// What a tick needs.
    pub sums: Sums,
    /// What each cell feels, in the order of the bus' cells; only kept up to date while comparing.
    pub felt: Vec<SkinSensors>,
}

impl Snapshot {
    /// Takes over another one without allocating; what cells feel only if `felt`.
    pub fn take(&mut self, other: &Self, felt: bool) {
        self.sums = other.sums;
        if felt {
            self.felt.clone_from(&other.felt);
        }
    }
}

/// Something that people should know at once.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Notice {
    /// A cell has fallen silent.
    Dead(CellId),
    /// A cell that was thought dead speaks again.
    Back(CellId),
    /// A cell started anew: nothing touches it until it is told so again.
    Restarted(CellId),
    /// A cell heard another one under its number.
    Duplicate(CellId),
    /// A cell is heard for the first time since its bus was lost: nobody knows what it has not heard.
    Returned(CellId),
    /// Another gateway speaks on this bus.
    Rival,
}

/// The positions in rad that the words of a broadcast were rounded from.
pub type Positions<'a> = dyn FnMut(Epoch) -> Option<[f64; WORDS]> + 'a;

/// The broadcast that cells are answering.
#[derive(Clone, Copy, Debug)]
struct Broadcast {
    epoch: Epoch,
    /// The epochs that may still be answered, in the order in which the bus carried them, newest first.
    recent: [Option<Epoch>; cell::LATEST + 1],
    /// Broadcasts before this one.
    number: u64,
    at: Micros,
    due: u32,
    in_time: u32,
    last_reply: Option<Micros>,
    error: [f64; WORDS],
}

impl Broadcast {
    /// Broadcasts after those of which a cell had heard when it wrote a page; more than a few are not looked for.
    fn since(&self, heard: Epoch) -> u64 {
        let recent = || self.recent.iter().flatten();
        let of_which_it_heard = recent().position(|epoch| *epoch == heard);
        // It has heard of none, where none but these has been.
        let all = || usize::try_from(self.number + 1).ok().filter(|&all| all == recent().count());
        of_which_it_heard.or_else(all).map_or(0, |passed| passed as u64)
    }
}

/// All that is known of one bus.
#[derive(Debug)]
pub struct Table {
    format: Format,
    safety: Safety,
    events: Events,
    central: Central,
    unquantised: Central,
    comparing: bool,
    cells: Vec<Cell>,
    /// Where a node stands in `cells`.
    places: [Option<usize>; CellId::COUNT],
    halves: Vec<Half>,
    broadcast: Option<Broadcast>,
    /// Sums along the tree, where cells answer with them.
    trunk: Option<Trunk>,
    /// Nodes that the skin does not have, each with its last heartbeat.
    strangers: BTreeMap<CellId, Heartbeat>,
    /// The bus was lost since the last broadcast.
    interrupted: bool,
    /// Twice, four times ... a torque is a whole number of these, so that the sum never drifts.
    sum: [i64; WORDS],
    snapshot: Snapshot,
    counters: Counters,
    accuracy: Accuracy,
    last_reply: Histogram<u64>,
    notices: VecDeque<Notice>,
}

impl Table {
    /// Nothing heard yet on one of a skin's buses.
    #[must_use]
    pub fn new(skin: &Skin, bus: usize) -> Self {
        let part = skin.part_on(bus);
        let mut places = [None; CellId::COUNT];
        let mut cells = Vec::with_capacity(part.cells.len());
        let summed = skin.buses.get(bus).is_some_and(|bus| bus.reply != Reply::Torque);
        for described in &part.cells {
            if let Some(place) = places.get_mut(described.node.index()) {
                *place = Some(cells.len());
            }
            let sensing = skin.buses.get(bus).map_or(Sensing::Off, |bus| bus.sensing);
            let switched = Switched::new(skin.events, sensing);
            cells.push(Cell::new(described, &part.parameters(described), summed, switched));
        }
        let snapshot = Snapshot { sums: Sums::default(), felt: vec![SkinSensors::default(); cells.len()] };
        Self {
            format: skin.buses.get(bus).map_or(Format::Fd, |bus| bus.format),
            safety: skin.safety,
            events: skin.events,
            central: Central::new(&part),
            unquantised: Central::unquantised(&part),
            comparing: false,
            cells,
            places,
            halves: vec![Half::NONE; 1 << 11],
            broadcast: None,
            trunk: summed.then(Trunk::default),
            strangers: BTreeMap::new(),
            interrupted: false,
            sum: [0; WORDS],
            snapshot,
            counters: Counters::default(),
            accuracy: Accuracy::default(),
            last_reply: histogram(),
            notices: VecDeque::new(),
        }
    }

    /// Only the sums of roots are taken from the bus: others' packets then cannot be counted one by one.
    pub fn hear_sums_of_roots_only(&mut self) {
        self.cells.iter_mut().filter(|cell| !cell.root).for_each(|cell| cell.uplink.without_sums());
    }

    /// Whether the sums of a root are for the gateway. When they are not any more they come in another one's: what was
    /// held of it would count twice.
    pub fn set_feeds(&mut self, root: CellId, feeds: bool) {
        let Some(cell) = self.cell_mut(root) else { return };
        cell.feeds = feeds;
        if !feeds && cell.summed {
            let change = cell.let_go();
            self.apply(change);
        }
    }

    /// Whether distributed torques are compared with central ones from the next epoch on.
    pub const fn set_comparing(&mut self, comparing: bool) {
        self.comparing = comparing;
    }

    /// What a tick needs.
    #[must_use]
    pub const fn snapshot(&self) -> &Snapshot {
        &self.snapshot
    }

    /// The bus' cells, in the skin's order.
    #[must_use]
    pub fn cells(&self) -> &[Cell] {
        &self.cells
    }

    /// Frames by kind and what became of them.
    #[must_use]
    pub const fn counters(&self) -> &Counters {
        &self.counters
    }

    /// Distributed against central torques.
    #[must_use]
    pub fn accuracy(&self) -> Accuracy {
        let Some(trunk) = &self.trunk else { return self.accuracy };
        let error = &trunk.error;
        Accuracy {
            sums: error.each,
            sums_averaged: error.averaged,
            saturated: error.saturated,
            ..self.accuracy
        }
    }

    /// What became of sums, and of the cells that were to be in them; `None` where cells answer themselves.
    #[must_use]
    pub fn sums(&self) -> Option<(SumCounts, Contributions)> {
        self.trunk.as_ref().map(|trunk| (trunk.counts, trunk.contributions))
    }

    /// How often parents of cells changed, by the cells' own count.
    #[must_use]
    pub fn parent_changes(&self) -> u64 {
        self.cells.iter().filter_map(|cell| cell.ports).map(|ports| u64::from(ports.changes)).sum()
    }

    /// Nodes that speak and that the skin does not have, each with its last heartbeat.
    pub fn strangers(&self) -> impl Iterator<Item = (CellId, &Heartbeat)> {
        self.strangers.iter().map(|(node, heartbeat)| (*node, heartbeat))
    }

    /// From a broadcast to its last reply in time, in µs, for each epoch with a reply.
    #[must_use]
    pub const fn last_reply(&self) -> &Histogram<u64> {
        &self.last_reply
    }

    /// What people should know, oldest first, each once.
    pub fn notices(&mut self) -> impl Iterator<Item = Notice> {
        self.notices.drain(..)
    }

    /// Takes a frame that stood on the bus at `at`; `own` if this gateway sent it. `positions` is asked for
    /// the positions in rad that an own broadcast's words were rounded from, if they are known.
    pub fn handle_frame(&mut self, at: Micros, own: bool, frame: &Frame, positions: &mut Positions<'_>) {
        let Ok(id) = packet::data_id(frame) else {
            self.counters.count(if frame.is_error() { Event::ErrorFrame } else { Event::Foreign });
            return;
        };
        let packet = match self.packet(at, id, frame) {
            Ok(Some(packet)) => packet,
            Ok(None) => return,
            Err(_) if !own && !self.is_used(id) => return self.counters.count(Event::Foreign),
            Err(event) => {
                self.counters.frame(id.kind, own);
                return self.reject(id, own, event);
            }
        };
        self.counters.frame(id.kind, own);
        match Message::decode(&packet) {
            Err(_) => self.reject(id, own, Event::Meaning),
            Ok(message) if own => self.hear_own(at, &message, positions),
            Ok(message) => self.hear(at, id, &message),
        }
    }

    /// The packet that a frame is or completes; `None` for half of one.
    fn packet(&mut self, at: Micros, id: Id, frame: &Frame) -> Result<Option<Packet>, Event> {
        let event = |error| match error {
            PacketError::Length { .. } => Event::Length,
            PacketError::Crc { .. } => Event::Crc,
            PacketError::Incomplete => Event::Incomplete,
            PacketError::Foreign => Event::Foreign,
        };
        if self.format == Format::Fd {
            return Packet::from_fd(frame).map(Some).map_err(event);
        }
        if frame.format() != Format::Classic {
            return Err(Event::Length);
        }
        let is_used = self.is_used(id);
        let half = self.halves.get_mut(usize::from(id.to_bits())).ok_or(Event::Foreign)?;
        let waited = half.is_waiting();
        match half.push(at, id, frame.data()).map_err(event)? {
            Paired::Whole(packet) => Ok(Some(packet)),
            // Foreign frames are counted each, and not as packets that have lost a half.
            Paired::Waiting | Paired::Incomplete if waited && !is_used => Err(Event::Foreign),
            Paired::Waiting => Ok(None),
            Paired::Incomplete => Err(Event::Incomplete),
        }
    }

    /// Whether somebody on this bus uses an identifier, as the skin describes the bus: what is no packet under another
    /// one is foreign.
    fn is_used(&self, id: Id) -> bool {
        let is_cell = |cell: CellId| self.places.get(cell.index()).copied().flatten().is_some();
        match (id.kind, Node::from_byte(id.node)) {
            (Kind::Command, _) => Command::from_byte(id.node).is_some(),
            (Kind::Network, Node::Gateway) | (Kind::Configure | Kind::Stimulus, Node::Everyone) => true,
            (_, Node::Cell(cell)) => is_cell(cell),
            (_, Node::Gateway | Node::Everyone) => false,
        }
    }

    /// Counts a frame that cannot be used, also with the cell whose identifier it bears.
    fn reject(&mut self, id: Id, own: bool, event: Event) {
        self.counters.count(event);
        if let (false, Some(cell)) = (own, self.sender(id)) {
            cell.uplink.reject();
        }
    }

    /// The cell that frames of this identifier come from.
    fn sender(&mut self, id: Id) -> Option<&mut Cell> {
        self.cell_mut(id.sender()?)
    }

    fn cell_mut(&mut self, cell: CellId) -> Option<&mut Cell> {
        let place = (*self.places.get(cell.index())?)?;
        self.cells.get_mut(place)
    }

    /// A frame of this gateway's, as it stood on the bus.
    fn hear_own(&mut self, at: Micros, message: &Message, positions: &mut Positions<'_>) {
        match *message {
            Message::Joints { epoch, joints } => self.open_epoch(at, epoch, &joints, positions(epoch)),
            Message::Stimulus { to, from, page } => self.expect_feeling(to, from, page),
            Message::Halt => self.each_cell(Cell::halt),
            Message::Sync => self.cells.iter_mut().for_each(|cell| cell.said.heartbeat = false),
            Message::Report => self.cells.iter_mut().for_each(|cell| cell.said.counters = false),
            Message::Resume
            | Message::Sum { .. }
            | Message::Torque { .. }
            | Message::Sensors { .. }
            | Message::Network { .. }
            | Message::Configure { .. }
            | Message::Configured { .. } => {}
        }
    }

    /// A frame of somebody else's.
    fn hear(&mut self, at: Micros, id: Id, message: &Message) {
        // What the gateway's side sends may also come from somebody at a shell.
        match *message {
            Message::Joints { .. } | Message::Network { from: Node::Gateway, .. } => {
                self.counters.count(Event::Rival);
                self.snapshot.sums.rivals += 1;
                self.notices.push_back(Notice::Rival);
                return;
            }
            Message::Halt => {
                self.snapshot.sums.halts += 1;
                self.each_cell(Cell::halt);
                return;
            }
            Message::Resume => {
                self.snapshot.sums.resumes += 1;
                self.cells.iter_mut().for_each(Cell::resume);
                return;
            }
            Message::Stimulus { to, from, page } => return self.expect_feeling(to, from, page),
            Message::Sync | Message::Report | Message::Configure { .. } => return,
            Message::Sum { .. }
            | Message::Torque { .. }
            | Message::Sensors { .. }
            | Message::Network { .. }
            | Message::Configured { .. } => {}
        }
        let Some(place) = self.places.get(usize::from(id.node).wrapping_sub(1)).copied().flatten() else {
            self.counters.count(Event::Stranger);
            if let Message::Network {
                from: Node::Cell(node), page: NetworkPage::Heartbeat(heartbeat), ..
            } = *message
            {
                self.strangers.insert(node, heartbeat);
            }
            return;
        };
        let joints = self.broadcast.map(|broadcast| broadcast.number);
        let Some(cell) = self.cells.get_mut(place) else { return };
        if cell.hear(at) {
            self.snapshot.sums.dead -= 1;
            self.notices.push_back(Notice::Back(cell.node));
        }
        cell.uplink.arrive();
        match *message {
            Message::Network { epoch, page: NetworkPage::Heartbeat(heartbeat), .. } => {
                cell.last_joints = epoch;
                self.take_heartbeat(place, &heartbeat, joints)
            }
            Message::Network { epoch, page: NetworkPage::Heard(heard), .. } => {
                let passed = self.broadcast.as_ref().map_or(0, |newest| newest.since(epoch));
                cell.report(heard, passed);
            }
            Message::Network { page: NetworkPage::Refused(refused), .. } => cell.refuses(refused),
            Message::Network { page: NetworkPage::Tree(tree), .. } => {
                cell.tree = Some(tree);
                cell.uplink.sums_sent(tree.sent, joints);
            }
            Message::Network { page: NetworkPage::Ports(ports), .. } => cell.ports = Some(ports),
            Message::Sensors { page, .. } => cell.tells(at, &page, &self.events),
            Message::Configured { answer, .. } => {
                cell.switched.answered(&answer);
                if let Answer::Value { number, written: true, words } = answer {
                    if number == Parameter::Reply.number() {
                        cell.reply = Some(words);
                    } else if number == Parameter::Cuts.number() {
                        cell.deaf = Cuts::from_words(words).deaf;
                    }
                }
            }
            Message::Torque { .. } if self.trunk.is_some() => self.counters.count(Event::Stranger),
            Message::Torque { epoch, torque, .. } => self.take_torque(at, place, epoch, torque.map(i32_of)),
            Message::Sum { epoch, count, torque, .. } => {
                self.take_sum(at, place, epoch, Sum { count, words: torque.map(i32_of) })
            }
            Message::Halt
            | Message::Joints { .. }
            | Message::Sync
            | Message::Resume
            | Message::Report
            | Message::Configure { .. }
            | Message::Stimulus { .. } => {}
        }
    }

    fn take_heartbeat(&mut self, place: usize, heartbeat: &Heartbeat, joints: Option<u64>) {
        let Some(cell) = self.cells.get_mut(place) else { return };
        if heartbeat.state.has(State::DUPLICATE) {
            self.counters.count(Event::Duplicate);
            self.notices.push_back(Notice::Duplicate(cell.node));
        }
        let speaker = cell.speaker(heartbeat);
        if speaker == Speaker::Anew {
            self.notices.push_back(Notice::Restarted(cell.node));
        }
        let away = cell.uplink.is_interrupted();
        let released = cell.take_heartbeat(speaker, heartbeat);
        if away && !cell.uplink.is_interrupted() && speaker == Speaker::Known {
            cell.felt.forget();
            self.notices.push_back(Notice::Returned(cell.node));
        }
        cell.uplink.heartbeat_at(joints);
        self.apply(released);
    }

    fn take_torque(&mut self, at: Micros, place: usize, epoch: Epoch, words: [i32; WORDS]) {
        let Some(broadcast) = &mut self.broadcast else {
            return self.counters.count(Event::StaleTorque);
        };
        let Some(cell) = self.cells.get_mut(place) else { return };
        // Not by the epochs' difference: broadcasts may be lost on the way back, or change places.
        let Some(lag) = broadcast.recent.iter().position(|&recent| recent == Some(epoch)) else {
            cell.replies.too_late += 1;
            return self.counters.count(Event::StaleTorque);
        };
        let number = broadcast.number - lag as u64;
        if cell.answered.is_some_and(|last| number <= last) {
            if cell.answered == Some(number) {
                return self.counters.count(Event::RepeatedTorque);
            }
            cell.replies.too_late += 1;
            return self.counters.count(Event::StaleTorque);
        }
        if words.iter().any(|&word| word == i32::from(i16::MAX) || word == i32::from(i16::MIN)) {
            self.counters.count(Event::Saturated);
        }
        let was_due = cell.answer(number, lag);
        if lag == 0 {
            broadcast.last_reply = Some(at);
            broadcast.in_time += u32::from(was_due);
        }
        if let Some(expected) = cell.expected_at(number) {
            let error = self.accuracy.compare(cell.joint, &words, expected);
            if lag == 0 {
                for (sum, error) in broadcast.error.iter_mut().zip(error) {
                    *sum += error;
                }
            }
        }
        let change = cell.hold(words);
        self.apply(change);
    }

    fn take_sum(&mut self, at: Micros, place: usize, epoch: Epoch, sum: Sum) {
        let (Some(trunk), Some(cell)) = (&mut self.trunk, self.cells.get_mut(place)) else {
            return self.counters.count(Event::Stranger);
        };
        trunk.counts.received += 1;
        if !cell.feeds {
            trunk.counts.overheard += 1;
            return;
        }
        let found = self.broadcast.as_mut().and_then(|broadcast| {
            let lag = broadcast.recent.iter().position(|&recent| recent == Some(epoch))?;
            Some((lag, cell.sums.get_mut(lag)?, broadcast))
        });
        let Some((lag, said, broadcast)) = found else {
            trunk.counts.stale += 1;
            return;
        };
        if trunk.take(lag, said, sum) == Taken::Resent {
            return;
        }
        if lag == 0 {
            broadcast.last_reply = Some(at);
        }
        let number = broadcast.number - lag as u64;
        if sum.is_saturated() {
            self.counters.count(Event::Saturated);
        }
        // Q7.8 in steps of Q3.12, of which the running sum is made.
        let change = cell.hold_sum(number, sum.count, sum.words.map(|word| word << 4));
        self.apply(change);
        self.let_go_of_what_moved(number);
    }

    /// Cells whose root fell silent find another one: then they are in its sum and not in what was held.
    fn let_go_of_what_moved(&mut self, number: u64) {
        let Some(due) = self.trunk.as_ref().and_then(Trunk::due) else { return };
        if self.snapshot.sums.contributing > due {
            self.each_cell(
                |cell| if cell.is_behind(number) { cell.let_go() } else { cell::Change::default() },
            );
        }
    }

    /// New joints stand on the bus: closes the epoch before, and works out who has to answer this one.
    fn open_epoch(&mut self, at: Micros, epoch: Epoch, joints: &Joints, q: Option<[f64; WORDS]>) {
        if self.broadcast.is_some_and(|newest| newest.epoch == epoch) {
            // Repeated on the way: cells drop it.
            return self.cells.iter_mut().for_each(Cell::hear_again);
        }
        let number = self.broadcast.map_or(0, |before| before.number + 1);
        let mut recent = self.broadcast.map_or([None; cell::LATEST + 1], |before| before.recent);
        recent.rotate_right(1);
        if let Some(newest) = recent.first_mut() {
            *newest = Some(epoch);
        }
        self.close_epoch();
        self.let_go_of_what_is_over(epoch);
        let frames = self.comparing.then(|| self.central.frames(&joints.positions));
        let exact = frames.map(|_| {
            self.unquantised.frames_at(&q.unwrap_or_else(|| joints.positions.map(Q1_14::to_radians)))
        });
        let (mut due, mut stale, mut age, mut known) = (0, 0, 0, true);
        let mut whole = frames.as_ref().map(|_| Expected { constant: true, ..Expected::default() });
        for place in 0..self.cells.len() {
            let Some(cell) = self.cells.get_mut(place) else { break };
            let f_z = cell.latch(epoch).map(|skin| (self.central.force(place, &skin), skin));
            let in_contact = f_z.is_some_and(|(force, _)| force > 0.0);
            if self.trunk.is_some() {
                known &= f_z.is_some() || !cell.is_ready();
                let (change, missed) = cell.open_epoch_of_sums(number, in_contact, &self.safety);
                due += u32::from(cell.is_due());
                if missed > 0 {
                    stale += cell.held_cells();
                    age = age.max(if cell.contributes() { missed } else { 0 });
                }
                if let (Some(whole), Some(frames), Some((f_z, skin))) = (&mut whole, &frames, f_z) {
                    if cell.is_due() {
                        whole.add(self.central.torque(place, frames, f_z), cell.joint);
                    }
                    if let Some(felt) = self.snapshot.felt.get_mut(place) {
                        whole.constant &= core::mem::replace(felt, skin) == skin;
                    }
                }
                self.apply(change);
                continue;
            }
            let (change, missed) = cell.open_epoch(number, in_contact, &self.safety);
            due += u32::from(cell.is_due());
            stale += u32::from(missed > 0);
            if let (Some(frames), Some(exact), Some((f_z, skin))) = (&frames, &exact, f_z) {
                let plain = self.unquantised.force(place, &skin);
                let expected = self.central.torque(place, frames, f_z);
                cell.expect(number, expected, self.unquantised.torque(place, exact, plain));
                if let Some(felt) = self.snapshot.felt.get_mut(place) {
                    *felt = skin;
                }
            }
            if cell.contributes() {
                age = age.max(missed);
            }
            self.apply(change);
        }
        if let Some(trunk) = &mut self.trunk {
            trunk.open(due, known, whole);
        }
        let sums = &mut self.snapshot.sums;
        (sums.stale, sums.age, sums.read_back) = (stale, age, Some(epoch));
        let error = [0.0; WORDS];
        self.broadcast =
            Some(Broadcast { epoch, recent, number, at, due, in_time: 0, last_reply: None, error });
    }

    fn close_epoch(&mut self) {
        let Some(before) = self.broadcast else { return };
        if let Some(last) = before.last_reply {
            // The histogram grows by itself; it cannot refuse.
            let _ = self.last_reply.record(last.since(before.at).0);
        }
        if let Some(trunk) = &mut self.trunk {
            let (due, complete) = trunk.close();
            return self.counters.epoch(due, complete);
        }
        self.counters.epoch(before.due > 0, before.in_time == before.due);
        if self.comparing && before.due > 0 && before.in_time == before.due {
            self.accuracy.whole_skin(&before.error);
        }
    }

    /// What was taken so far is from before: it says what holds, and counts for nothing.
    pub fn begin_accounts(&mut self) {
        self.cells.iter_mut().for_each(Cell::begin_accounts);
        if let Some(broadcast) = &mut self.broadcast {
            (broadcast.due, broadcast.in_time, broadcast.last_reply) = (0, 0, None);
        }
        if let Some(trunk) = &mut self.trunk {
            *trunk = Trunk::default();
        }
        (self.counters, self.accuracy) = (Counters::default(), Accuracy::default());
        self.last_reply.reset();
        self.notices.clear();
    }

    /// The bus is lost: what was on its way is in doubt. The torques stay as they are, and the loop lets them go.
    pub fn interrupt(&mut self) {
        self.interrupted = true;
        self.cells.iter_mut().for_each(Cell::interrupt);
    }

    /// What the loop has let go while the bus carried no joints does not come back with the next ones that it carries.
    fn let_go_of_what_is_over(&mut self, epoch: Epoch) {
        // Broadcasts may change places on the way back: the newest is not always the last that came.
        let recent = self.broadcast.iter().flat_map(|broadcast| broadcast.recent.into_iter().flatten());
        let gap = recent.map(|before| epoch.since(before)).min().unwrap_or(0);
        let over = i64::from(gap) > i64::from(self.safety.hold_epochs + self.safety.decay_epochs) + 1;
        if core::mem::take(&mut self.interrupted) || over {
            self.each_cell(Cell::let_go);
        }
    }

    /// Lets time pass: who has been silent for too long is dead.
    pub fn handle_time(&mut self, now: Micros) {
        for place in 0..self.cells.len() {
            let Some(cell) = self.cells.get_mut(place) else { break };
            if cell.falls_silent(now) {
                self.snapshot.sums.dead += 1;
                self.notices.push_back(Notice::Dead(cell.node));
                let change = cell.let_go();
                self.apply(change);
            }
        }
    }

    /// No more broadcasts follow: closes the last epoch and settles who never answered.
    pub fn finish(&mut self) {
        self.close_epoch();
        self.broadcast = None;
        if let Some(trunk) = &mut self.trunk {
            trunk.finish();
        }
        for cell in &mut self.cells {
            cell.settle();
        }
    }

    fn expect_feeling(&mut self, to: Node, from: protocol::message::From, page: SensorPage) {
        let SensorPage::Skin(skin) = page else { return };
        let last = self.broadcast.map(|broadcast| broadcast.epoch);
        for cell in self.cells.iter_mut().filter(|cell| to.names(cell.node)) {
            cell.felt.push(from, skin, last);
        }
    }

    fn each_cell(&mut self, change: impl Fn(&mut Cell) -> cell::Change) {
        for place in 0..self.cells.len() {
            let Some(cell) = self.cells.get_mut(place) else { break };
            let change = change(cell);
            self.apply(change);
        }
    }

    /// Adds what a cell's contribution changed by to the running sum.
    fn apply(&mut self, change: cell::Change) {
        for ((sum, torque), difference) in
            self.sum.iter_mut().zip(&mut self.snapshot.sums.torque).zip(change.torque)
        {
            *sum += i64::from(difference);
            *torque = cell::to_nm(*sum);
        }
        self.snapshot.sums.contributing =
            self.snapshot.sums.contributing.saturating_add_signed(change.contributing);
    }

    /// What is known of the network's cells, in the skin's order, and of those that it does not describe.
    pub fn network(&self, now: Micros) -> impl Iterator<Item = Seen> {
        let described = self.statuses(now).map(|(cell, status)| Seen {
            node: cell.node,
            serial: Some(cell.serial),
            configuration: cell.configuration,
            heartbeat: cell.heartbeat,
            alive: !matches!(status, Status::Dead | Status::Unknown),
            tree: cell.tree,
            ports: cell.ports,
        });
        let strangers = self.strangers().map(|(node, heartbeat)| Seen {
            node,
            serial: None,
            configuration: heartbeat.configuration,
            heartbeat: Some(*heartbeat),
            alive: true,
            tree: None,
            ports: None,
        });
        described.chain(strangers)
    }

    /// The joints that cells are answering: their number, their epoch, and when they stood on the bus.
    #[must_use]
    pub fn newest(&self) -> Option<(u64, Epoch, Micros)> {
        self.broadcast.map(|Broadcast { number, epoch, at, .. }| (number, epoch, at))
    }

    /// What each cell has felt since those joints, as far as anybody knows, and its status now.
    pub fn felt(&self, now: Micros) -> impl Iterator<Item = (Option<SkinSensors>, Status)> {
        self.statuses(now).map(|(cell, status)| (cell.feeling(), status))
    }

    /// The cells' statuses now.
    pub fn statuses(&self, now: Micros) -> impl Iterator<Item = (&Cell, Status)> {
        let newest = self.broadcast.map(|broadcast| broadcast.number);
        self.cells.iter().map(move |cell| (cell, cell.status(now, newest)))
    }
}

/// A word as a whole number of steps.
fn i32_of<const F: u32>(word: Q<F>) -> i32 {
    i32::from(word.to_bits())
}

#[cfg(test)]
#[expect(clippy::cast_possible_truncation, reason = "a few steps")]
mod tests_sums;

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Q3_12;
    use protocol::id::CellId;
    use protocol::message::Heard;
    use protocol::packet::Packet;

    /// A table that heard these, in the frames of the bus, the gateway's own or a cell's.
    fn table(heard: &[(bool, Message)]) -> Table {
        let mut table = Table::new(&crate::testing::skin(), 0);
        for (own, message) in heard {
            let packet: Packet = message.encode();
            for frame in packet.frames(Format::Fd) {
                table.handle_frame(Micros(0), *own, &frame, &mut |_| None);
            }
        }
        table
    }

    #[test]
    fn what_is_no_packet_is_rejected_under_a_cells_identifier_and_foreign_under_one_that_nobody_uses() {
        let mut skin = crate::testing::skin();
        for format in [Format::Fd, Format::Classic] {
            skin.buses[0].format = format;
            let mut table = Table::new(&skin, 0);
            let mut hear = |id, byte, at| {
                let data = [byte; 16];
                let (length, flags) = if format == Format::Fd { (16, 1) } else { (8, 0) };
                let frame = Frame::with_data(id, format, flags, &data[..length]).unwrap();
                table.handle_frame(Micros(at), false, &frame, &mut |_| None);
            };
            // Of the only cell; of one that is not there; a command that does not exist; joints.
            for at in 0..9_u8 {
                for id in [0x201, 0x263, 0x077, 0x001] {
                    hear(id, at, 1_000 * u64::from(at));
                }
            }
            let of = |event| table.counters().events(event);
            let events = [Event::Foreign, Event::Crc, Event::Incomplete].map(of);
            // Halves: eight of nine were dropped under each; a packet that has lost one is counted once.
            assert_eq!(events, if format == Format::Fd { [18, 18, 0] } else { [16, 0, 8] }, "{format:?}");
        }
    }

    #[test]
    fn a_torque_from_before_an_outage_does_not_come_back_with_the_bus() {
        let cell = CellId::new(1).unwrap();
        let joints = |epoch| Message::Joints {
            epoch: Epoch(epoch),
            joints: Joints { positions: [Q1_14::ZERO; WORDS], in_use: 6 },
        };
        let torque = |epoch| Message::Torque { from: cell, epoch: Epoch(epoch), torque: [Q3_12::MAX; WORDS] };
        let hear = |table: &mut Table, own, message: Message| {
            for frame in message.encode().frames(Format::Fd) {
                table.handle_frame(Micros(0), own, &frame, &mut |_| None);
            }
            table.snapshot().sums.contributing
        };
        for (interrupted, next, contributing) in [(false, 2, 1), (true, 2, 0), (false, 8, 1), (false, 9, 0)] {
            let mut table = table(&[(true, joints(1)), (false, torque(1))]);
            assert_eq!(table.snapshot().sums.contributing, 1);
            if interrupted {
                table.interrupt();
                assert_eq!(table.snapshot().sums.contributing, 1, "the loop lets it go");
            }
            let after = hear(&mut table, true, joints(next));
            assert_eq!(after, contributing, "{interrupted}, joints {next} after joints 1");
            assert_eq!(hear(&mut table, false, torque(next)), 1, "new ones count again");
        }
    }

    #[test]
    fn a_cell_that_was_away_owes_nothing_before_it_is_heard_and_told_what_it_feels() {
        let cell = CellId::new(1).unwrap();
        let positions = [Q1_14::ZERO; WORDS];
        let joints =
            |epoch| (true, Message::Joints { epoch: Epoch(epoch), joints: Joints { positions, in_use: 6 } });
        let heartbeat = |sent| {
            let state = State::CONFIGURED.with(State::TEST_MODE, true);
            let page = NetworkPage::Heartbeat(Heartbeat { sent, state, ..Heartbeat::default() });
            (false, Message::Network { from: Node::Cell(cell), epoch: Epoch(0), page })
        };
        let contact = [protocol::fixed::Q5_10::nearest(2.0); 3];
        let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
        let press =
            (true, Message::Stimulus { to: Node::Cell(cell), from: protocol::message::From::Next, page });
        let hear = |table: &mut Table, heard: &[(bool, Message)]| {
            for (own, message) in heard {
                for frame in message.encode().frames(Format::Fd) {
                    table.handle_frame(Micros(0), *own, &frame, &mut |_| None);
                }
            }
            let replies = table.cells().first().unwrap().replies;
            (replies.due, replies.missing, replies.in_doubt)
        };
        let mut table = table(&[]);
        assert_eq!(hear(&mut table, &[heartbeat(1), press, joints(1), joints(2)]), (2, 0, 0));
        table.interrupt();
        // It may not be back when the bus is, and so may not have heard this.
        assert_eq!(hear(&mut table, &[joints(3), press, joints(4)]), (2, 2, 2));
        assert_eq!(table.notices().count(), 0);
        assert_eq!(hear(&mut table, &[heartbeat(9), joints(5)]), (2, 2, 2), "nobody knows what it feels");
        assert_eq!(table.notices().collect::<Vec<_>>(), [Notice::Returned(cell)]);
        assert_eq!(hear(&mut table, &[press, joints(6), heartbeat(10), joints(7)]), (4, 2, 2));
        assert_eq!(table.notices().count(), 0, "said once");
        let uplink = table.cells().first().unwrap().uplink;
        assert_eq!((uplink.lost, uplink.outage), (7, 7));
    }

    #[test]
    fn joints_that_passed_a_report_on_its_way_count_as_not_heard_when_they_were_not() {
        let joints = |epoch| {
            (
                true,
                Message::Joints {
                    epoch: Epoch(epoch),
                    joints: Joints { positions: [Q1_14::ZERO; WORDS], in_use: 6 },
                },
            )
        };
        let report = |epoch, joints| {
            let page = NetworkPage::Heard(Heard { joints, ..Heard::default() });
            (false, Message::Network { from: Node::Cell(CellId::new(1).unwrap()), epoch: Epoch(epoch), page })
        };
        let unanswered = |heard: &[_]| table(heard).cells().first().unwrap().unanswered();
        // It has not heard the first; nor, when it began, one that came before its report.
        assert_eq!(unanswered(&[report(0, 0), joints(1), joints(2), report(2, 1)]), Some((0, 1)));
        assert_eq!(unanswered(&[joints(1), report(0, 0), joints(2), report(2, 1)]), Some((0, 1)));
        assert_eq!(unanswered(&[joints(1), report(0, 0), joints(2), report(2, 2)]), Some((0, 0)));
        assert_eq!(unanswered(&[joints(1), report(1, 1), joints(2), report(2, 2)]), Some((0, 0)));
        // Who was long there, and before this gateway, has counted on.
        assert_eq!(
            unanswered(&[joints(8), joints(9), report(8, 70), joints(10), report(10, 72)]),
            Some((0, 0))
        );
    }
}
