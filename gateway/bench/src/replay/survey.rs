//! Survey of a capture from a first reading: the buses, the cells, the losses by the cells' own counters, and the state
//! where the replayed part begins.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use model::tracker::{CellTracker, DEAD_AFTER, HeartbeatKind, MAX_LATE_EPOCHS};
use protocol::can::Format;
use protocol::candump::Record;
use protocol::id::{CellId, Command, Id, Node};
use protocol::message::{Answer, Joints, Message, NetworkPage, Request, State as Flags};
use protocol::packet::{Epoch, data_frame_id};
use protocol::parameters::Parameter;
use protocol::time::Micros;

use model::decode::{Decoded, Decoder};
use model::latched::LatchedState;
use trace::capture::{BusNote, CaptureNote, LatchedFrame};

mod cell;

pub use self::cell::SurveyedCell;

/// Silence in ns after which a cell counts as absent.
const ABSENCE_TIMEOUT_NS: u64 = DEAD_AFTER.0 * 1_000;

/// Maximum time in ns from the first joints after a cell's start to the cell's first heartbeat.
const MAX_CELL_START_NS: u64 = 100_000_000;

/// Time in ns after which a heartbeat has the configuration of a commit whose answer is not in the capture.
const COMMIT_TIMEOUT_NS: u64 = 3_000_000_000;

/// Maximum number of joint broadcasts between the sending and the recording of a page of counters.
const MAX_COUNTER_DELAY_BROADCASTS: usize = 64;

/// A part of a capture. Bounds are in ns since the start of the run or, if the capture has no run, since its first
/// frame.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct TimeRange {
    /// Start; `None` for the beginning.
    pub from: Option<u64>,
    /// End, exclusive; `None` for the end of the capture.
    pub to: Option<u64>,
}

/// Survey of a whole capture.
#[derive(Debug)]
pub struct Survey {
    part: TimeRange,
    /// Start of the run in ns since 1970, if known.
    pub run_began: Option<u64>,
    /// Time of the first frame in ns since 1970.
    pub first: Option<u64>,
    /// Latest time in ns since 1970.
    pub last: u64,
    /// Number of frames.
    pub frames: u64,
    /// Number of frames that the recorder reported as lost.
    pub dropped: u64,
    /// Buses in the order of their first frames.
    pub buses: Vec<SurveyedBus>,
    decoder: Decoder,
}

/// Survey of one bus.
#[derive(Debug, Default)]
pub struct SurveyedBus {
    /// Name in the capture.
    pub name: String,
    /// Number of frames.
    pub frames: u64,
    /// True if any frame is CAN FD.
    pub has_fd: bool,
    /// Format of the first packet.
    pub format: Option<Format>,
    /// Number of joint broadcasts.
    pub joints: u64,
    /// Latest joint broadcasts, oldest first.
    recent_joints: VecDeque<JointsBroadcast>,
    /// True if a cell reported its counters, or a message was latched at the start of the capture. A part of a
    /// recording, or a truncated one, may lack messages that the counters account for.
    is_accounted: bool,
    /// Messages from before the capture. The capture holds them as latched at its start.
    pub latched: Vec<Message>,
    /// State where the replayed part begins.
    pub state: LatchedState,
    /// First joints in the replayed part.
    pub first_joints: Option<(Epoch, Joints)>,
    /// Number of sums that cells sent.
    pub sums: u64,
    /// Cells of the bus.
    pub cells: BTreeMap<CellId, SurveyedCell>,
    /// State of cells according to messages from before the capture.
    before: BTreeMap<CellId, CellBeforeCapture>,
    /// Cells that were told to commit before the replayed part, and whose answer has not come, with the time of the commit
    /// in ns since 1970. The part begins with the new configuration, which their next heartbeats may lack.
    committing: BTreeMap<CellId, u64>,
}

/// A broadcast of joints.
#[derive(Clone, Copy, Debug)]
struct JointsBroadcast {
    epoch: Epoch,
    /// Number of joint broadcasts up to and including this one.
    number: u64,
    /// Time in ns since 1970.
    nanos: u64,
}

/// State of a cell from before the capture.
#[derive(Clone, Debug, Default)]
struct CellBeforeCapture {
    tracked: CellTracker,
    /// Time of the cell's last message in ns since 1970.
    last_seen: u64,
    hash: InitialValue<u16>,
    measures: bool,
}

/// Position of a frame relative to the replayed part.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum ReplayPartPosition {
    /// Before the part.
    Before,
    In,
    After,
}

/// Circumstances in which a cell sent a message.
#[derive(Clone, Copy, Debug)]
struct MessageContext<'a> {
    /// Time in ns since 1970.
    nanos: u64,
    place: ReplayPartPosition,
    /// True if the cell's answer to a commit from before the replayed part has not come.
    is_committing: bool,
    /// Latest joint broadcasts, oldest first.
    joints: &'a VecDeque<JointsBroadcast>,
}

/// A value at the start of the replayed part. It is known if a cell reports it later, before the value changes.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum InitialValue<T> {
    /// The value has not been reported.
    #[default]
    No,
    /// The value had changed before a cell reported it.
    TooLate,
    /// The value.
    Value(T),
}

impl Survey {
    /// Creates an empty survey of a part of a capture.
    #[must_use]
    pub const fn new(part: TimeRange) -> Self {
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

    /// Adds the frames that are latched at the start of the capture; call it before the first frame.
    pub fn add_latched_frames(&mut self, latched: &[LatchedFrame]) {
        let mut decoder = Decoder::new(None);
        for LatchedFrame { bus, frame, nanos, .. } in latched {
            if let Decoded::Message(message) = decoder.decode(Micros(nanos / 1_000), bus, frame) {
                let bus = self.bus(bus);
                bus.is_accounted = true;
                bus.state.apply_message(&message);
                bus.add_latched_message(&message, *nanos);
                bus.latched.push(message);
            }
        }
    }

    /// Adds the next frame or note.
    pub fn add_frame(&mut self, record: &Record<'_>) {
        let nanos = record.time.nanos;
        self.first.get_or_insert(nanos);
        self.last = self.last.max(nanos);
        self.frames += 1;
        let (begins, ends) = self.part_bounds_ns();
        let decoded = self.decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
        let bus = self.bus(record.interface);
        bus.frames += 1;
        bus.has_fd |= record.frame.format() == Format::Fd;
        let from = data_frame_id(&record.frame).ok().and_then(Id::sender);
        if let (Some(cell), Decoded::Message(_) | Decoded::Meaningless { .. }) = (from, &decoded) {
            bus.mark_seen(cell, nanos);
        }
        if let Decoded::Message(message) = decoded {
            bus.format.get_or_insert_with(|| record.frame.format());
            let place = if nanos < begins {
                ReplayPartPosition::Before
            } else if nanos < ends {
                ReplayPartPosition::In
            } else {
                ReplayPartPosition::After
            };
            bus.add_message(&message, from, nanos, place);
        }
    }

    /// Ends the survey after the last frame.
    pub fn finish(&mut self) {
        let last = self.last;
        // Counters on one bus suffice, because they show that the cells of the recorded bench have counters. A part of
        // the capture may lack those of the other buses.
        let is_accounted = self.buses.iter().any(|bus| bus.is_accounted);
        for cell in self.buses.iter_mut().flat_map(|bus| bus.cells.values_mut()) {
            cell.finish(last);
            cell.is_accounted = is_accounted;
        }
    }

    /// Handles a note: the cells of a lost bus are away until they send again. Their last answers may have been lost
    /// with the bus.
    pub fn add_note(&mut self, note: &CaptureNote<'_>) {
        let Some((name, BusNote::Lost)) = BusNote::parse(note) else { return };
        let Some(bus) = self.bus_named(name).and_then(|at| self.buses.get_mut(at)) else { return };
        // These joints may still be answered.
        let recent = bus.recent_joints.iter().rev().take(MAX_LATE_EPOCHS + 1);
        let since = recent.map(|joints| joints.nanos).min().unwrap_or(note.nanos);
        for cell in bus.cells.values_mut() {
            cell.away.get_or_insert(since);
        }
    }

    /// Returns the time in ns since 1970 from which seconds count: the start of the run, or the first frame.
    #[must_use]
    pub fn time_origin_ns(&self) -> u64 {
        self.run_began.or(self.first).unwrap_or(0)
    }

    /// Returns the bounds of the replayed part in ns since 1970, end exclusive. If the part has no start, it includes
    /// frames older than the first one.
    #[must_use]
    pub fn part_bounds_ns(&self) -> (u64, u64) {
        let end = self.part.to.map_or(u64::MAX, |to| self.time_origin_ns().saturating_add(to));
        (self.part.from.map_or(0, |from| self.time_origin_ns().saturating_add(from)), end)
    }

    /// Returns the index of a bus, by its name in the capture.
    #[must_use]
    pub fn bus_named(&self, name: &str) -> Option<usize> {
        self.buses.iter().position(|bus| bus.name == name)
    }

    /// Returns the names of the buses, joined for display.
    #[must_use]
    pub fn bus_names(&self) -> String {
        self.buses.iter().map(|bus| bus.name.as_str()).collect::<Vec<_>>().join(", ")
    }

    fn bus(&mut self, name: &str) -> &mut SurveyedBus {
        let at = self.bus_named(name).unwrap_or_else(|| {
            self.buses.push(SurveyedBus { name: name.to_owned(), ..SurveyedBus::default() });
            self.buses.len() - 1
        });
        self.buses.get_mut(at).expect("found, or just made")
    }
}

impl SurveyedBus {
    /// Handles a message from before the capture that is latched at its start.
    fn add_latched_message(&mut self, message: &Message, nanos: u64) {
        if let Message::Network { from: Node::Cell(from), page: NetworkPage::Heartbeat(heartbeat), .. } =
            *message
        {
            let is_settled = !heartbeat.state.has(Flags::CLAIMING_NODE_ID);
            let before = self.before.entry(from).or_default();
            if before.tracked.record_packet(Micros(nanos / 1_000), message, None).word
                != Some(HeartbeatKind::Claimant)
            {
                before.last_seen = nanos;
                before.measures = is_settled && !heartbeat.state.has(Flags::TEST_MODE);
                let commit_ns = self.committing.get(&from);
                if commit_ns.is_some_and(|at| nanos > at.saturating_add(COMMIT_TIMEOUT_NS)) {
                    self.committing.remove(&from);
                }
                let is_known = is_settled && !self.committing.contains_key(&from);
                before.hash =
                    if is_known { InitialValue::Value(heartbeat.configuration) } else { InitialValue::No };
            }
        } else if let Message::Configure { to, request: Request::Write { number, words }, .. } = *message {
            for (_, before) in self.before.iter_mut().filter(|(cell, _)| to.addresses_cell(**cell)) {
                if number == Parameter::Mode.number() {
                    before.measures = words.first() != Some(&1);
                } else if number == Parameter::Commit.number() {
                    before.hash = InitialValue::No;
                }
            }
            self.follow_commit(message, nanos, ReplayPartPosition::Before);
        }
    }

    fn mark_seen(&mut self, cell: CellId, nanos: u64) {
        let before = self.before.get(&cell);
        self.cells.entry(cell).or_insert_with(|| SurveyedCell::new(nanos, before)).mark_seen(nanos);
    }

    fn add_message(
        &mut self,
        message: &Message,
        from: Option<CellId>,
        nanos: u64,
        place: ReplayPartPosition,
    ) {
        if place == ReplayPartPosition::Before {
            self.state.apply_message(message);
        }
        self.is_accounted |= matches!(message, Message::Network { page: NetworkPage::Received(_), .. });
        self.sums += u64::from(matches!(message, Message::Sum { .. }));
        let is_committing = from.is_some_and(|from| self.committing.contains_key(&from));
        self.follow_commit(message, nanos, place);
        if let Some(cell) = from.and_then(|from| self.cells.get_mut(&from)) {
            let context = MessageContext { nanos, place, is_committing, joints: &self.recent_joints };
            cell.add_message(message, &context);
        } else if let Message::Joints { epoch, joints } = *message {
            self.joints += 1;
            self.recent_joints.push_back(JointsBroadcast { epoch, number: self.joints, nanos });
            if self.recent_joints.len() > MAX_COUNTER_DELAY_BROADCASTS {
                self.recent_joints.pop_front();
            }
            if place == ReplayPartPosition::In {
                self.first_joints.get_or_insert((epoch, joints));
            }
        }
    }

    /// Follows commits of the cells' parameters, and their answers.
    fn follow_commit(&mut self, message: &Message, nanos: u64, place: ReplayPartPosition) {
        let commit = Parameter::Commit.number();
        if let Message::Configure { to, request: Request::Write { number, .. }, .. } = *message
            && number == commit
        {
            let all = self.cells.keys().chain(self.before.keys()).copied();
            let told: BTreeSet<_> = match to {
                Node::Cell(cell) => BTreeSet::from([cell]),
                Node::Gateway | Node::Everyone => all.filter(|cell| to.addresses_cell(*cell)).collect(),
            };
            for cell in told {
                let is_committing = self.committing.remove(&cell).is_some();
                let surveyed = self.cells.get_mut(&cell);
                if place == ReplayPartPosition::Before {
                    self.committing.insert(cell, nanos);
                    surveyed.into_iter().for_each(SurveyedCell::forget_hash);
                } else if is_committing {
                    surveyed.into_iter().for_each(SurveyedCell::accept_unconfirmed_hash);
                }
            }
        } else if let Message::Configured { from, answer, .. } = *message
            && let Answer::Value { number, written: true, .. } | Answer::Refused { number, .. } = answer
            && number == commit
        {
            self.committing.remove(&from);
        }
    }

    /// Returns the cells that send between two times, in ns since 1970.
    pub fn cells_active_in(&self, (from, to): (u64, u64)) -> impl Iterator<Item = (CellId, &SurveyedCell)> {
        let speaks = move |cell: &SurveyedCell| cell.active.1 >= from && cell.active.0 < to;
        self.cells.iter().map(|(cell, it)| (*cell, it)).filter(move |(_, cell)| speaks(cell))
    }
}

/// Returns true for frames from the gateway's side: a command, configuration or a stimulus.
#[must_use]
pub const fn is_from_gateway_side(id: Id) -> bool {
    !id.kind.is_from_cells()
}

/// Returns true for a broadcast of joints or a segment of one.
#[must_use]
pub fn is_joints(id: Id) -> bool {
    id == Id::command(Command::Joints)
}

#[cfg(test)]
mod tests;
