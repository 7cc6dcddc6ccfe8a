//! What a capture holds, found in a first reading: its buses and their cells, what it lacks by the cells' own
//! counters, and the state where the replay begins.

use std::collections::{BTreeMap, VecDeque};

use model::tracker::{Account, DEAD_AFTER, LATEST, Tracked, Word};
use protocol::can::Format;
use protocol::candump::Record;
use protocol::id::{CellId, Command, Id, Node};
use protocol::message::{Answer, Heard, Heartbeat, Joints, Message, NetworkPage, Request, State as Flags};
use protocol::packet::{Epoch, data_id};
use protocol::parameters::Parameter;
use protocol::time::Micros;

use model::decode::{Decoded, Decoder};
use model::latched::State;
use trace::capture::{BusNote, Latched, Note};

/// A cell that sends nothing for so long is absent, in ns.
const SILENT_NS: u64 = DEAD_AFTER.0 * 1_000;

/// A cell that starts hears joints for so long at most before its first heartbeat, in ns.
const STARTS_NS: u64 = 100_000_000;

/// A page of counters is on its way for so many joints at most.
const PASSED: usize = 64;

/// A part of a capture, in ns of its run, or after its first frame where there is no run.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Part {
    /// From here on; else from the beginning.
    pub from: Option<u64>,
    /// Up to, and without, here.
    pub to: Option<u64>,
}

/// A whole capture.
#[derive(Debug)]
pub struct Survey {
    part: Part,
    /// When the run began, in ns since 1970, if that is known.
    pub run_began: Option<u64>,
    /// When the first frame came, in ns since 1970.
    pub first: Option<u64>,
    /// The latest time.
    pub last: u64,
    /// Frames.
    pub frames: u64,
    /// Frames that the recorder reported as lost.
    pub dropped: u64,
    /// Each bus, in the order of their first frames.
    pub buses: Vec<Bus>,
    decoder: Decoder,
}

/// One bus.
#[derive(Debug, Default)]
pub struct Bus {
    /// Its name in the capture.
    pub name: String,
    /// Frames on it.
    pub frames: u64,
    /// Whether any of them is CAN FD.
    pub has_fd: bool,
    /// What packets travel in, by the first one.
    pub format: Option<Format>,
    /// Joint broadcasts on it.
    pub joints: u64,
    /// The newest of them, newest last.
    recent_joints: VecDeque<Broadcast>,
    /// Whether a cell reported its counters, or something was latched when the capture began: then a part of a
    /// recording, or a truncated one, may lack what its counters would account for.
    is_accounted: bool,
    /// The messages from before the capture that are latched at its beginning, as it has them.
    pub latched: Vec<Message>,
    /// The state where the part begins.
    pub state: State,
    /// The first joints in the part.
    pub first_joints: Option<(Epoch, Joints)>,
    /// Sums that cells sent.
    pub sums: u64,
    /// Its cells.
    pub cells: BTreeMap<CellId, Cell>,
    /// What is known of cells from before the capture.
    before: BTreeMap<CellId, Before>,
}

/// A broadcast of joints.
#[derive(Clone, Copy, Debug)]
struct Broadcast {
    epoch: Epoch,
    /// The joints until then, it among them.
    number: u64,
    /// When, in ns since 1970.
    nanos: u64,
}

/// What is known of a cell from before the capture.
#[derive(Clone, Debug, Default)]
struct Before {
    tracked: Tracked,
    /// When it sent last, in ns since 1970.
    heard: u64,
    hash: Known<u16>,
    measures: bool,
}

/// One cell.
#[derive(Clone, Debug)]
pub struct Cell {
    /// The hash of its configuration where the part begins, if that can be known.
    pub hash: Known<u16>,
    /// Whether it measured in the part: then its torques cannot come back.
    pub measured: bool,
    /// When it sent, in ns since 1970: first and last.
    pub heard: (u64, u64),
    /// From when to when it sent nothing, when that was long.
    pub silences: Vec<(u64, u64)>,
    /// Packets that it sent and that are not in the capture.
    pub unrecorded: u64,
    /// Joints that it did not take or processed too late.
    pub untaken: u64,
    /// Between which joints its counters account for that: from after one time up to another, in ns since 1970.
    accounted: Vec<(u64, u64)>,
    /// Whether counters account for anything in the capture; else everything missing is a difference.
    is_accounted: bool,
    tracked: Tracked,
    /// Since when it claims its node id, which it does after each start.
    claims: Option<u64>,
    /// Since when its bus is lost.
    away: Option<u64>,
    /// Its counters at the last report, the joints until then, and the time of the last of them.
    report: Option<(Heard, u64, u64)>,
}

/// Where a frame stands.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Place {
    /// Before the part that is replayed.
    Before,
    In,
    After,
}

/// Something that may become known too late.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Known<T> {
    /// Nothing was reported of it.
    #[default]
    No,
    /// It has changed before anything was reported of it.
    TooLate,
    /// This.
    Yes(T),
}

impl Survey {
    /// Of a part of a capture that has not been read.
    #[must_use]
    pub const fn new(part: Part) -> Self {
        let decoder = Decoder::new(None);
        Self {
            part,
            run_began: None,
            first: None,
            last: 0,
            frames: 0,
            dropped: 0,
            buses: Vec::new(),
            decoder,
        }
    }

    /// Takes what was latched when the capture began, before its first frame.
    pub fn begin(&mut self, latched: &[Latched]) {
        let mut decoder = Decoder::new(None);
        for Latched { bus, frame, nanos, .. } in latched {
            if let Decoded::Message(message) = decoder.decode(Micros(nanos / 1_000), bus, frame) {
                let bus = self.bus(bus);
                bus.is_accounted = true;
                bus.state.take(&message);
                bus.take_before(&message, *nanos);
                bus.latched.push(message);
            }
        }
    }

    /// Takes the next frame.
    pub fn take(&mut self, record: &Record<'_>) {
        let nanos = record.time.nanos;
        self.first.get_or_insert(nanos);
        self.last = self.last.max(nanos);
        self.frames += 1;
        let (begins, ends) = self.bounds();
        let decoded = self.decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
        let bus = self.bus(record.interface);
        bus.frames += 1;
        bus.has_fd |= record.frame.format() == Format::Fd;
        let from = data_id(&record.frame).ok().and_then(Id::sender);
        if let (Some(cell), Decoded::Message(_) | Decoded::Meaningless { .. }) = (from, &decoded) {
            bus.heard(cell, nanos);
        }
        if let Decoded::Message(message) = decoded {
            bus.format.get_or_insert_with(|| record.frame.format());
            let place = if nanos < begins {
                Place::Before
            } else if nanos < ends {
                Place::In
            } else {
                Place::After
            };
            bus.take(&message, from, nanos, place);
        }
    }

    /// Takes in that the capture is at its end.
    pub fn finish(&mut self) {
        let last = self.last;
        // Of one bus: then a bench recorded it that has counters, and in a part those of another may be missing.
        let is_accounted = self.buses.iter().any(|bus| bus.is_accounted);
        for cell in self.buses.iter_mut().flat_map(|bus| bus.cells.values_mut()) {
            cell.end(last);
            cell.is_accounted = is_accounted;
        }
    }

    /// Takes a note: cells of a bus that was lost are away until they send again. Their last answers may have been lost
    /// with it.
    pub fn note(&mut self, note: &Note<'_>) {
        let Some((name, BusNote::Lost)) = BusNote::of(note) else { return };
        let Some(bus) = self.bus_named(name).and_then(|at| self.buses.get_mut(at)) else { return };
        // Those that may still be answered.
        let recent = bus.recent_joints.iter().rev().take(LATEST + 1);
        let since = recent.map(|joints| joints.nanos).min().unwrap_or(note.nanos);
        for cell in bus.cells.values_mut() {
            cell.away.get_or_insert(since);
        }
    }

    /// The time that seconds count from, in ns since 1970.
    #[must_use]
    pub fn zero(&self) -> u64 {
        self.run_began.or(self.first).unwrap_or(0)
    }

    /// The part, in ns since 1970: from, and up to and without. From the beginning on means all, also what is older
    /// than the first frame.
    #[must_use]
    pub fn bounds(&self) -> (u64, u64) {
        let end = self.part.to.map_or(u64::MAX, |to| self.zero().saturating_add(to));
        (self.part.from.map_or(0, |from| self.zero().saturating_add(from)), end)
    }

    /// Where a bus stands, by its name in the capture.
    #[must_use]
    pub fn bus_named(&self, name: &str) -> Option<usize> {
        self.buses.iter().position(|bus| bus.name == name)
    }

    /// The names of the buses, for people.
    #[must_use]
    pub fn names(&self) -> String {
        self.buses.iter().map(|bus| bus.name.as_str()).collect::<Vec<_>>().join(", ")
    }

    fn bus(&mut self, name: &str) -> &mut Bus {
        let at = self.bus_named(name).unwrap_or_else(|| {
            self.buses.push(Bus { name: name.to_owned(), ..Bus::default() });
            self.buses.len() - 1
        });
        self.buses.get_mut(at).expect("found, or just made")
    }
}

impl Bus {
    /// Takes in messages from before the capture that are latched at its beginning.
    fn take_before(&mut self, message: &Message, nanos: u64) {
        if let Message::Network { from: Node::Cell(from), page: NetworkPage::Heartbeat(heartbeat), .. } =
            *message
        {
            let is_settled = !heartbeat.state.has(Flags::CLAIMING);
            let before = self.before.entry(from).or_default();
            if before.tracked.hear(Micros(nanos / 1_000), message, None).word != Some(Word::Claimant) {
                before.heard = nanos;
                before.measures = is_settled && !heartbeat.state.has(Flags::TEST_MODE);
                before.hash = if is_settled { Known::Yes(heartbeat.configuration) } else { Known::No };
            }
        } else if let Message::Configure { to, request: Request::Write { number, words }, .. } = *message {
            for (_, before) in self.before.iter_mut().filter(|(cell, _)| to.names(**cell)) {
                if number == Parameter::Mode.number() {
                    before.measures = words.first() != Some(&1);
                } else if number == Parameter::Commit.number() {
                    before.hash = Known::No;
                }
            }
        }
    }

    fn heard(&mut self, cell: CellId, nanos: u64) {
        let before = self.before.get(&cell);
        self.cells.entry(cell).or_insert_with(|| Cell::new(nanos, before)).hear(nanos);
    }

    fn take(&mut self, message: &Message, from: Option<CellId>, nanos: u64, place: Place) {
        if place == Place::Before {
            self.state.take(message);
        }
        self.is_accounted |= matches!(message, Message::Network { page: NetworkPage::Heard(_), .. });
        self.sums += u64::from(matches!(message, Message::Sum { .. }));
        if let Some(cell) = from.and_then(|from| self.cells.get_mut(&from)) {
            cell.take(message, nanos, place, &self.recent_joints);
        } else if let Message::Joints { epoch, joints } = *message {
            self.joints += 1;
            self.recent_joints.push_back(Broadcast { epoch, number: self.joints, nanos });
            if self.recent_joints.len() > PASSED {
                self.recent_joints.pop_front();
            }
            if place == Place::In {
                self.first_joints.get_or_insert((epoch, joints));
            }
        }
    }

    /// The cells that send in a part of the capture.
    pub fn cells_in(&self, (from, to): (u64, u64)) -> impl Iterator<Item = (CellId, &Cell)> {
        let speaks = move |cell: &Cell| cell.heard.1 >= from && cell.heard.0 < to;
        self.cells.iter().map(|(cell, it)| (*cell, it)).filter(move |(_, cell)| speaks(cell))
    }
}

impl Cell {
    fn new(nanos: u64, before: Option<&Before>) -> Self {
        // A cell that sent just before the capture was there when it began.
        let first =
            before.map(|before| before.heard).filter(|heard| nanos <= heard.saturating_add(SILENT_NS));
        let mut tracked = before.map(|before| before.tracked.clone()).unwrap_or_default();
        // What it sent between the two is not known to be lost.
        tracked.account = Account::default();
        Self {
            hash: before.map_or(Known::No, |before| before.hash),
            measured: before.is_some_and(|before| before.measures),
            heard: (first.map_or(nanos, |heard| heard.min(nanos)), nanos),
            silences: Vec::new(),
            unrecorded: 0,
            untaken: 0,
            accounted: Vec::new(),
            is_accounted: false,
            tracked,
            claims: None,
            report: None,
            away: None,
        }
    }

    fn hear(&mut self, nanos: u64) {
        let last = self.heard.1;
        if nanos > last.saturating_add(SILENT_NS) {
            self.silences.push((last, nanos));
        }
        self.heard.1 = last.max(nanos);
        if let Some(away) = self.away.take() {
            self.silences.push((away, nanos));
        }
    }

    /// The capture is at its end.
    fn end(&mut self, nanos: u64) {
        self.unrecorded = self.tracked.account.uplink().lost;
        if let Some(away) = self.away {
            self.silences.push((away, u64::MAX));
        }
        let from = self.claims.unwrap_or(self.heard.1);
        if nanos > from.saturating_add(SILENT_NS) || self.claims.is_some() {
            self.silences.push((from, u64::MAX));
        }
    }

    /// Takes in a message of it, after some joints.
    fn take(&mut self, message: &Message, nanos: u64, place: Place, joints: &VecDeque<Broadcast>) {
        let word = self.tracked.hear(Micros(nanos / 1_000), message, None).word;
        if let Message::Network { page: NetworkPage::Heartbeat(heartbeat), .. } = message {
            match word {
                Some(Word::Claimant | Word::Outsider | Word::Overtaken) | None => return,
                // After a start its counters begin again, with joints that it took before this heartbeat.
                Some(Word::Started { .. }) => {
                    let last = joints.back().map(|last| (last.number, last.nanos)).unwrap_or_default();
                    let may_count = |joints: &&Broadcast| nanos <= joints.nanos.saturating_add(STARTS_NS);
                    let early = joints.iter().rev().take_while(may_count).count() as u64;
                    self.report = Some((Heard::default(), last.0.saturating_sub(early), last.1));
                }
                Some(Word::First | Word::Known | Word::Shared) => {}
            }
            self.heartbeat(heartbeat, nanos, place);
        } else if let Message::Network { page: NetworkPage::Heard(heard), epoch, .. } = *message {
            // The page has the epoch of the last joints that its counters have.
            let at = joints.iter().rev().find(|joints| joints.epoch == epoch);
            self.report(heard, at.map(|joints| (joints.number, joints.nanos)));
        } else if let Message::Configured { answer: Answer::Value { number, written: true, .. }, .. } =
            *message
            && number == Parameter::Commit.number()
        {
            // Configured again before its first heartbeat: its former configuration is unknown.
            self.hash = match self.hash {
                _ if place == Place::Before => Known::No,
                Known::No => Known::TooLate,
                known @ (Known::TooLate | Known::Yes(_)) => known,
            };
        }
    }

    fn heartbeat(&mut self, heartbeat: &Heartbeat, nanos: u64, place: Place) {
        // While it claims its node id it answers nothing.
        if heartbeat.state.has(Flags::CLAIMING) {
            self.claims.get_or_insert(nanos);
            return;
        }
        if let Some(since) = self.claims.take() {
            self.silences.push((since, nanos));
        }
        if place == Place::Before || self.hash == Known::No {
            self.hash = Known::Yes(heartbeat.configuration);
        }
        self.measured |= place == Place::In && !heartbeat.state.has(Flags::TEST_MODE);
    }

    /// Counters up to some joints. If these were before the capture, it is unknown which joints they account for.
    fn report(&mut self, heard: Heard, at: Option<(u64, u64)>) {
        let Some((joints, last)) = at else { return };
        if let Some((before, joints_before, from)) = self.report {
            let taken = heard.joints.wrapping_sub(before.joints);
            let repeated = heard.joints_repeated.wrapping_sub(before.joints_repeated);
            let known = u64::from(taken) + u64::from(repeated);
            let between = joints.saturating_sub(joints_before);
            // More than there were are not of one life: what seemed a start was none.
            if known <= between + PASSED as u64 {
                self.untaken += between.saturating_sub(known);
                match self.accounted.last_mut() {
                    Some((_, until)) if *until == from => *until = last,
                    _ => self.accounted.push((from, last)),
                }
            }
        }
        self.report = Some((heard, joints, last));
    }

    /// Whether counters that it reported before and after account for joints of this time, in ns since 1970; if none in
    /// the capture do, they explain no deviation.
    #[must_use]
    pub fn is_counted_at(&self, nanos: u64) -> bool {
        !self.is_accounted || self.accounted.iter().any(|&(from, until)| from < nanos && nanos <= until)
    }

    /// Whether it sent nothing for long around a time, in ns since 1970.
    #[must_use]
    pub fn is_silent_at(&self, nanos: u64) -> bool {
        nanos < self.heard.0 || self.silences.iter().any(|&(from, to)| (from..to).contains(&nanos))
    }
}

/// Whether a frame is of the gateway's side: a command, configuration, a stimulus.
#[must_use]
pub const fn is_input(id: Id) -> bool {
    !id.kind.is_from_cells()
}

/// Whether a frame is of a broadcast of joints, or of a segment of one.
#[must_use]
pub fn is_joints(id: Id) -> bool {
    id == Id::command(Command::Joints)
}

#[cfg(test)]
mod tests;
