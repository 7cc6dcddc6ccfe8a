//! Finds the requested joints, and the contact state and answer of each cell at them.

use std::collections::VecDeque;

use model::tracker::{Claim, Contact, LATEST, PerCell, Word, is_late};
use protocol::id::{CellId, Node};
use protocol::message::{
    Answer, From, Heartbeat, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, State,
};
use protocol::packet::{Epoch, Words};
use protocol::parameters::Parameter;
use protocol::skin::Skin;
use protocol::time::Micros;
use serde::Serialize;
use trace::capture::seconds_since;

use super::not_found::NotFound;

/// Joints after them, within which late torques and the configurations of cells are waited for.
const TIMEOUT: u32 = 32;
/// Runs of epochs that an error names.
const RUNS: usize = 8;

/// Where the contact state of a cell is known from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "by")]
pub enum Origin {
    /// It had just started: nothing touched it.
    Start {
        /// When it reported that.
        at_ns: u64,
    },
    /// Its mode was written, which clears its contact state.
    Mode {
        /// When.
        at_ns: u64,
    },
    /// A stimulus.
    Stimulus {
        /// When it was sent.
        at_ns: u64,
        /// The epoch from which on it holds; none for the next joints.
        from_epoch: Option<u8>,
        /// Whether it came after the joints of that epoch.
        late: bool,
    },
    /// The cell reported its own contact state.
    Said {
        /// When.
        at_ns: u64,
    },
}

/// Which joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Requested {
    /// Their epoch.
    pub epoch: Epoch,
    /// Only from so many ns after the time on that seconds count from.
    pub from_ns: u64,
    /// Which of them, from 1.
    pub occurrence: u32,
}

/// What was sent to the cells of one bus, and their answers.
#[derive(Clone, Debug)]
pub struct Moment {
    /// When the joints came.
    pub at_ns: u64,
    /// The joints.
    pub joints: Joints,
    /// Whether the bus was halted.
    pub halted: bool,
    /// By the cell's place.
    pub cells: Vec<CellMoment>,
}

/// One cell at that moment.
#[derive(Clone, Debug, Default)]
pub struct CellMoment {
    /// Its contact state and where that is known from.
    pub contact_state: Option<(SkinSensors, Origin)>,
    /// Whether it obeys stimuli; `None` when not reported.
    pub test_mode: Option<bool>,
    /// Its state in its last heartbeat.
    pub state: Option<State>,
    /// Hash of its configuration; `None` when not reported.
    pub hash: Option<u16>,
    /// The torque that it answered, and when.
    pub answer: Option<(u64, Words)>,
    /// When its torque came, if that was too late to be used.
    pub too_late: Option<u64>,
    /// Further torques of this epoch, which are not used.
    pub repeated: u32,
}

/// Reads a capture up to a moment.
#[derive(Debug)]
pub struct Watch<'a> {
    skin: &'a Skin,
    /// All joints, if none are requested.
    requested: Option<Requested>,
    /// The time that seconds count from; else they count from the first frame.
    zero: Option<u64>,
    /// By the skin's bus.
    bus_watches: Vec<LinkId>,
    /// Buses that are not the skin's.
    others: Vec<String>,
}

#[derive(Debug, Default)]
struct LinkId {
    /// Whether the capture has it.
    there: bool,
    /// Whether the skin has cells on it.
    cells_here: bool,
    last: Option<Epoch>,
    halted: bool,
    /// How many of the requested joints there were.
    occurrences: u32,
    /// Moments that are not complete, oldest first.
    open: VecDeque<Open>,
    cells: PerCell<Cell>,
    runs: Vec<Run>,
    /// The number of joints, where that is not the chain's.
    other_joints: Option<usize>,
    /// Runs beyond those that are kept.
    further_runs: u64,
}

/// A moment whose answers may still come.
#[derive(Debug)]
struct Open {
    epoch: Epoch,
    moment: Moment,
    /// Joints since the moment.
    since: u32,
}

#[derive(Clone, Debug, Default)]
struct Cell {
    claim: Claim,
    contact: Contact<Origin>,
    hash: Option<u16>,
}

/// Joints whose epochs follow each other.
#[derive(Clone, Copy, Debug)]
struct Run {
    first: (Epoch, u64),
    last: (Epoch, u64),
    joints: u64,
}

impl<'a> Watch<'a> {
    /// Begins before the first frame.
    #[must_use]
    pub fn new(skin: &'a Skin, requested: Requested) -> Self {
        Self::of(skin, Some(requested))
    }

    /// The same for all joints; moments are taken with [`Watch::pop`].
    #[must_use]
    pub fn all(skin: &'a Skin) -> Self {
        Self::of(skin, None)
    }

    fn of(skin: &'a Skin, requested: Option<Requested>) -> Self {
        let bus_watch = |bus| LinkId { cells_here: skin.cells_of(bus).next().is_some(), ..LinkId::default() };
        let bus_watches = (0..skin.buses.len()).map(bus_watch).collect();
        Self { skin, requested, zero: None, bus_watches, others: Vec::new() }
    }

    /// Counts seconds from this time on, in ns since 1970; else they count from the first frame.
    pub const fn count_from(&mut self, zero: u64) {
        self.zero = Some(zero);
    }

    /// Takes in a frame from before the capture that is latched when it begins.
    pub fn begin(&mut self, nanos: u64, bus: &str, message: &Message) {
        let at = self.skin.bus_named(bus);
        let joints = at.map_or(0, |at| self.skin.joints_of(at).len());
        if let Some(bus_watch) = at.and_then(|at| self.bus_watches.get_mut(at)) {
            if let Message::Joints { epoch, joints: Joints { in_use, .. } } = *message {
                if usize::from(in_use) == joints && bus_watch.last != Some(epoch) {
                    bus_watch.latch(epoch);
                }
            } else {
                bus_watch.take(nanos, 0, message, self.requested, joints);
            }
        }
    }

    /// Takes in the next frame; `message` is its meaning, if it has one. Whether all is known now.
    pub fn take(&mut self, nanos: u64, bus: &str, message: Option<&Message>) -> bool {
        let zero = *self.zero.get_or_insert(nanos);
        let at = self.skin.bus_named(bus);
        let Some(bus_watch) = at.and_then(|at| self.bus_watches.get_mut(at)) else {
            if self.others.len() < RUNS && !self.others.iter().any(|other| other == bus) {
                self.others.push(bus.to_owned());
            }
            return false;
        };
        bus_watch.there = true;
        if let Some(message) = message {
            bus_watch.take(
                nanos,
                nanos.saturating_sub(zero),
                message,
                self.requested,
                at.map_or(0, |at| self.skin.joints_of(at).len()),
            );
        }
        self.is_complete()
    }

    /// The oldest moment of a bus, if all is known of it, or at the end of the capture; each once.
    pub fn pop(&mut self, bus: usize, is_end: bool) -> Option<(Epoch, Moment)> {
        let moments = &mut self.bus_watches.get_mut(bus)?.open;
        moments.front().filter(|open| is_end || open.is_complete())?;
        moments.pop_front().map(|open| (open.epoch, open.moment))
    }

    /// Whether nothing more is waited for.
    fn is_complete(&self) -> bool {
        self.bus_watches.iter().filter(|bus_watch| bus_watch.cells_here).all(LinkId::is_complete)
    }

    /// What was found, by the skin's bus; a bus that has no such joints has none. The capture is at its end, or
    /// all is known.
    ///
    /// # Errors
    /// When no bus has them.
    pub fn moments(self) -> Result<Vec<Option<Moment>>, NotFound> {
        let names = |there: bool| {
            let buses = self
                .skin
                .buses
                .iter()
                .zip(&self.bus_watches)
                .filter(|(_, bus_watch)| bus_watch.there || !there);
            buses.map(|(bus, _)| bus.name.as_str()).collect::<Vec<_>>().join(", ")
        };
        if !self.bus_watches.iter().any(|bus_watch| bus_watch.there) {
            let capture = if self.others.is_empty() { "none".to_owned() } else { self.others.join(", ") };
            return Err(NotFound::Buses { capture, skin: names(false) });
        }
        if self.bus_watches.iter().all(|bus_watch| bus_watch.open.is_empty()) {
            let zero = self.zero.unwrap_or_default();
            let Some(bus_watch) = self.bus_watches.iter().find(|bus_watch| !bus_watch.runs.is_empty()) else {
                for (index, (bus, watch)) in self.skin.buses.iter().zip(&self.bus_watches).enumerate() {
                    if let Some(came) = watch.other_joints {
                        let chain = self.skin.joints_of(index).len();
                        return Err(NotFound::Robot { bus: bus.name.clone(), came, chain });
                    }
                }
                return Err(NotFound::Joints { buses: names(true) });
            };
            let Some(Requested { epoch, from_ns, occurrence }) = self.requested else {
                return Err(NotFound::Joints { buses: names(true) });
            };
            let mut requested = format!("of epoch {epoch}");
            if occurrence > 1 {
                requested += &format!(" for the {occurrence}. time");
            }
            if from_ns > 0 {
                requested += &format!(" at {} s or later", seconds(from_ns));
            }
            let mut runs: Vec<_> = bus_watch.runs.iter().map(|run| run.text(zero)).collect();
            if bus_watch.further_runs > 0 {
                runs.push(format!("{} further rows", bus_watch.further_runs));
            }
            return Err(NotFound::Epoch { requested, runs: runs.join("; ") });
        }
        let moment = |bus_watch: LinkId| bus_watch.open.into_iter().next().map(|open| open.moment);
        Ok(self.bus_watches.into_iter().map(moment).collect())
    }
}

#[expect(clippy::cast_precision_loss, reason = "to be read")]
fn seconds(nanos: u64) -> String {
    format!("{:.3}", nanos as f64 / 1e9)
}

impl Run {
    fn text(&self, zero: u64) -> String {
        let Self { first, last, joints } = *self;
        let [from, to] = [first, last].map(|(_, at)| format!("{:.3}", seconds_since(zero, at)));
        let (first, last) = (first.0, last.0);
        if joints == 1 {
            return format!("those of epoch {first} at {from} s");
        }
        format!("{joints} joints in a row, from epoch {first} at {from} s to epoch {last} at {to} s")
    }
}

impl Open {
    fn is_complete(&self) -> bool {
        // A cell that answered has reported its configuration, and a cell that was touched has answered.
        let settled = |cell: &CellMoment| match cell.answer {
            Some(_) => cell.hash.is_some(),
            None => {
                cell.too_late.is_some()
                    || cell.contact_state.is_none_or(|(skin, _)| skin == SkinSensors::default())
            }
        };
        self.since >= TIMEOUT || self.is_too_late() && self.moment.cells.iter().all(settled)
    }

    /// Whether so many joints have followed that answers are too late to be used.
    const fn is_too_late(&self) -> bool {
        self.since as usize > LATEST
    }
}

impl LinkId {
    /// Whether all is known of the requested moment.
    fn is_complete(&self) -> bool {
        self.open.front().is_some_and(Open::is_complete)
    }

    fn take(
        &mut self,
        nanos: u64,
        after: u64,
        message: &Message,
        requested: Option<Requested>,
        robot: usize,
    ) {
        let last = self.last;
        match *message {
            Message::Halt => self.halted = true,
            Message::Resume => self.halted = false,
            // Other counts are not this robot's, and a cell drops joints of the last epoch.
            Message::Joints { epoch, joints } => {
                let came = usize::from(joints.in_use);
                if came != robot {
                    self.other_joints = Some(came);
                } else if last != Some(epoch) {
                    self.joints(nanos, after, epoch, joints, requested);
                }
            }
            Message::Stimulus { to, from, page } => {
                let from_epoch = if let From::Epoch(epoch) = from { Some(epoch.0) } else { None };
                let origin = Origin::Stimulus { at_ns: nanos, from_epoch, late: is_late(from, last) };
                self.cells.named(to).iter_mut().for_each(|cell| cell.contact.push(from, page, origin, last));
            }
            Message::Configure { to, request: Request::Write { number, words }, .. } => {
                if Parameter::from_number(number) == Some(Parameter::Mode) {
                    let (obeys, origin) = (words.first() == Some(&1), Origin::Mode { at_ns: nanos });
                    self.cells.named(to).iter_mut().for_each(|cell| cell.mode(obeys, origin));
                }
            }
            Message::Configured { from, answer: Answer::Value { number, written, words }, .. } => {
                let [commit, _, _, identity, ..] = words.map(i16::cast_unsigned);
                let hash = match Parameter::from_number(number) {
                    Some(Parameter::Commit) if written => commit,
                    Some(Parameter::Identity) => identity,
                    Some(_) | None => return,
                };
                if let Some(cell) = self.cells.get_mut(from) {
                    cell.hash = Some(hash);
                }
                self.learn(from, hash);
            }
            Message::Network { from: Node::Cell(from), page: NetworkPage::Heartbeat(heartbeat), .. } => {
                if self.cells.get_mut(from).is_some_and(|cell| cell.heartbeat(nanos, &heartbeat)) {
                    self.learn(from, heartbeat.configuration);
                }
            }
            Message::Network { from: Node::Cell(from), page: NetworkPage::Heard(heard), .. } => {
                let cell = self.cells.get_mut(from).filter(|cell| cell.contact.obeys() != Some(false));
                cell.into_iter()
                    .for_each(|cell| cell.contact.count(heard.stimuli, Origin::Said { at_ns: nanos }));
            }
            Message::Sensors { from, epoch, page: page @ SensorPage::Skin(skin) } => {
                let origin = Origin::Said { at_ns: nanos };
                let cell = self.cells.get_mut(from).filter(|cell| cell.contact.obeys() != Some(false));
                if let Some(cell) = cell.filter(|_| last.is_none_or(|last| last == epoch)) {
                    cell.contact.learn(page, origin);
                }
                // A cell that measures has read its sensors at these very joints.
                if let Some((cell, _)) = self.answering(from, epoch) {
                    cell.contact_state.get_or_insert((skin, origin));
                }
            }
            Message::Torque { from, epoch, torque } => {
                if let Some((cell, in_time)) = self.answering(from, epoch) {
                    if cell.answer.is_some() {
                        cell.repeated += 1;
                    } else if in_time {
                        cell.answer = Some((nanos, torque));
                    } else {
                        cell.too_late.get_or_insert(nanos);
                    }
                }
            }
            Message::Sync
            | Message::Report
            | Message::Sum { .. }
            | Message::Sensors { .. }
            | Message::Network { .. }
            | Message::Configure { .. }
            | Message::Configured { .. } => {}
        }
    }

    fn joints(&mut self, nanos: u64, after: u64, epoch: Epoch, joints: Joints, requested: Option<Requested>) {
        self.run(nanos, epoch);
        self.latch(epoch);
        for open in &mut self.open {
            open.since += 1;
        }
        let opens = requested.is_none_or(|requested| {
            let is_one = epoch == requested.epoch && after >= requested.from_ns && self.open.is_empty();
            self.occurrences += u32::from(is_one);
            is_one && self.occurrences == requested.occurrence
        });
        if opens {
            let cells = self.cells.iter().map(|(_, Cell { claim, contact, hash })| CellMoment {
                contact_state: contact.skin().copied(),
                test_mode: contact.obeys(),
                state: claim.heartbeat().map(|heartbeat| heartbeat.state),
                hash: *hash,
                ..CellMoment::default()
            });
            let moment = Moment { at_ns: nanos, joints, halted: self.halted, cells: cells.collect() };
            self.open.push_back(Open { epoch, moment, since: 0 });
        }
    }

    fn latch(&mut self, epoch: Epoch) {
        self.last = Some(epoch);
        self.cells.iter_mut().for_each(|(_, cell)| cell.contact.latch(epoch, |_| {}));
    }

    /// Notes which epochs there are.
    fn run(&mut self, nanos: u64, epoch: Epoch) {
        let follows = !self.runs.is_empty() && self.last.is_some_and(|last| last.next() == epoch);
        if !follows && self.runs.len() == RUNS {
            self.further_runs += 1;
        } else if !follows {
            self.runs.push(Run { first: (epoch, nanos), last: (epoch, nanos), joints: 1 });
        } else if let Some(run) = self.runs.last_mut().filter(|_| self.further_runs == 0) {
            run.last = (epoch, nanos);
            run.joints += 1;
        }
    }

    /// The cell at the newest moment of this epoch; and whether that is in time.
    fn answering(&mut self, from: CellId, epoch: Epoch) -> Option<(&mut CellMoment, bool)> {
        let open = self.open.iter_mut().rev().find(|open| open.epoch == epoch)?;
        let in_time = !open.is_too_late();
        Some((open.moment.cells.get_mut(from.index())?, in_time))
    }

    /// What a cell computes with became known only after the moment; it was the same then.
    fn learn(&mut self, from: CellId, hash: u16) {
        for open in &mut self.open {
            if let Some(cell) = open.moment.cells.get_mut(from.index()) {
                cell.hash.get_or_insert(hash);
            }
        }
    }
}

impl Cell {
    /// Takes a heartbeat under the cell's node id; whether it is the cell's.
    fn heartbeat(&mut self, at_ns: u64, heartbeat: &Heartbeat) -> bool {
        let obeys = heartbeat.state.has(State::TEST_MODE);
        match self.claim.hear(Micros(at_ns / 1_000), heartbeat) {
            Word::Claimant | Word::Outsider | Word::Overtaken => return false,
            Word::Started { .. } => self.mode(obeys, Origin::Start { at_ns }),
            // What seemed a start was none, and its contact state before that is not kept.
            Word::Shared => self.contact.reset(),
            Word::First | Word::Known if !obeys => self.contact.reset(),
            Word::First | Word::Known => {}
        }
        self.contact.set_obeys(obeys);
        self.hash = Some(heartbeat.configuration);
        true
    }

    /// It begins to obey stimuli, and nothing touches it; or to measure, and its contact state is not on the bus.
    fn mode(&mut self, obeys: bool, origin: Origin) {
        if obeys {
            self.contact.start(origin);
        } else {
            self.contact.reset();
        }
        self.contact.set_obeys(obeys);
    }
}
