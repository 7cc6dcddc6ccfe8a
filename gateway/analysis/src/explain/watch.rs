//! Finds the requested joints in a capture, with the contact state and the answer of each cell.

use std::collections::VecDeque;

use model::tracker::{AddressClaim, ContactState, HeartbeatKind, MAX_LATE_EPOCHS, PerCell, is_stimulus_late};
use protocol::id::{CellId, Node};
use protocol::message::{
    Answer, Heartbeat, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, State, StimulusStart,
};
use protocol::packet::Epoch;
use protocol::parameters::Parameter;
use protocol::skin::Skin;
use protocol::time::Micros;
use trace::capture::seconds_since;

use super::not_found::JointsNotFound;
use super::observed::{ContactOrigin, ObservedCellState, ObservedJoints, RequestedJoints};

/// Number of joints that must follow the requested ones, so that late torques and the configurations of cells have
/// arrived.
const MAX_WAIT_EPOCHS: u32 = 32;
/// Maximum number of runs of epochs that an error lists.
const MAX_LISTED_RUNS: usize = 8;

/// Reads a capture up to the requested joints, and follows the state of each cell.
#[derive(Debug)]
pub struct JointsWatcher<'a> {
    skin: &'a Skin,
    requested: Option<RequestedJoints>,
    zero: Option<u64>,
    bus_watches: Vec<BusWatch>,
    /// Names of the buses in the capture that are not in the skin.
    others: Vec<String>,
    /// The joints that the torque in the last frame answers, if it is used.
    answered: Option<u64>,
}

#[derive(Debug, Default)]
struct BusWatch {
    /// True if the capture has frames of the bus.
    is_in_capture: bool,
    has_cells: bool,
    last: Option<Epoch>,
    halted: bool,
    occurrences: u32,
    /// Joints whose answers may still arrive, oldest first.
    open: VecDeque<AnswerableJoints>,
    /// Number of joints that were put into `open`.
    opened: u64,
    cells: PerCell<WatchedCell>,
    runs: Vec<EpochRun>,
    /// The number of values in a joints packet whose length does not fit the chain.
    other_joints: Option<usize>,
    /// Number of runs of epochs that are not kept.
    further_runs: u64,
}

/// Joints that cells may still answer.
#[derive(Debug)]
struct AnswerableJoints {
    epoch: Epoch,
    moment: ObservedJoints,
    since: u32,
    /// Number of joints on the bus before these.
    index: u64,
}

#[derive(Clone, Debug, Default)]
struct WatchedCell {
    claim: AddressClaim,
    contact: ContactState<ContactOrigin>,
    hash: Option<u16>,
}

/// A run of joints whose epochs follow each other.
#[derive(Clone, Copy, Debug)]
struct EpochRun {
    first: (Epoch, u64),
    last: (Epoch, u64),
    joints: u64,
}

impl<'a> JointsWatcher<'a> {
    /// Creates a watch that finds the requested joints.
    #[must_use]
    pub fn new(skin: &'a Skin, requested: RequestedJoints) -> Self {
        Self::with_request(skin, Some(requested))
    }

    /// Creates a watch that returns all joints, by [`JointsWatcher::pop_joints`].
    #[must_use]
    pub fn for_all_joints(skin: &'a Skin) -> Self {
        Self::with_request(skin, None)
    }

    fn with_request(skin: &'a Skin, requested: Option<RequestedJoints>) -> Self {
        let bus_watch =
            |bus| BusWatch { has_cells: skin.cells_on_bus(bus).next().is_some(), ..BusWatch::default() };
        let bus_watches = (0..skin.buses.len()).map(bus_watch).collect();
        Self { skin, requested, zero: None, bus_watches, others: Vec::new(), answered: None }
    }

    /// Sets the time that counts as 0 s, in ns since 1970; the default is the time of the first frame.
    pub const fn set_zero_time(&mut self, zero: u64) {
        self.zero = Some(zero);
    }

    /// Handles a packet from before the start of the capture, which still has an effect.
    pub fn receive_latched(&mut self, nanos: u64, bus: &str, message: &Message) {
        let at = self.skin.bus_index(bus);
        let joints = at.map_or(0, |at| self.skin.joints_on_bus(at).len());
        if let Some(bus_watch) = at.and_then(|at| self.bus_watches.get_mut(at)) {
            if let Message::Joints { epoch, joints: Joints { in_use, .. } } = *message {
                if usize::from(in_use) == joints && bus_watch.last != Some(epoch) {
                    bus_watch.latch_contacts(epoch);
                }
            } else {
                bus_watch.receive_message(nanos, 0, message, self.requested, joints);
            }
        }
    }

    /// Handles the next frame; `message` is the decoded message, if the frame completes one. Returns true if the
    /// requested joints and all answers to them are known.
    pub fn receive(&mut self, nanos: u64, bus: &str, message: Option<&Message>) -> bool {
        self.answered = None;
        let zero = *self.zero.get_or_insert(nanos);
        let at = self.skin.bus_index(bus);
        let Some(bus_watch) = at.and_then(|at| self.bus_watches.get_mut(at)) else {
            if self.others.len() < MAX_LISTED_RUNS && !self.others.iter().any(|other| other == bus) {
                self.others.push(bus.to_owned());
            }
            return false;
        };
        bus_watch.is_in_capture = true;
        if let Some(message) = message {
            self.answered = bus_watch.receive_message(
                nanos,
                nanos.saturating_sub(zero),
                message,
                self.requested,
                at.map_or(0, |at| self.skin.joints_on_bus(at).len()),
            );
        }
        self.is_complete()
    }

    /// Returns the joints that the last received torque answers, as their index among the bus' joints that
    /// [`JointsWatcher::pop_joints`] returns. Returns `None` if the last frame contained no torque, or one that is not
    /// used because it came too late, or because the cell had answered already.
    #[must_use]
    pub const fn answered_joints(&self) -> Option<u64> {
        self.answered
    }

    /// Removes and returns the oldest joints of a bus, if their answers are complete. At the end of the capture
    /// (`is_end`), all answers count as complete.
    pub fn pop_joints(&mut self, bus: usize, is_end: bool) -> Option<(Epoch, ObservedJoints)> {
        let moments = &mut self.bus_watches.get_mut(bus)?.open;
        moments.front().filter(|open| is_end || open.is_complete())?;
        moments.pop_front().map(|open| (open.epoch, open.moment))
    }

    /// Returns true if the requested joints and all answers to them are known on all buses.
    fn is_complete(&self) -> bool {
        self.bus_watches.iter().filter(|bus_watch| bus_watch.has_cells).all(BusWatch::is_complete)
    }

    /// Returns the requested joints on each of the skin's buses; `None` for a bus that does not have them. Call it at
    /// the end of the capture, or once [`JointsWatcher::receive`] has returned true.
    ///
    /// # Errors
    /// Returns [`JointsNotFound`] if no bus has these joints.
    pub fn into_joints(self) -> Result<Vec<Option<ObservedJoints>>, JointsNotFound> {
        let names = |there: bool| {
            let buses = self
                .skin
                .buses
                .iter()
                .zip(&self.bus_watches)
                .filter(|(_, bus_watch)| bus_watch.is_in_capture || !there);
            buses.map(|(bus, _)| bus.name.as_str()).collect::<Vec<_>>().join(", ")
        };
        if !self.bus_watches.iter().any(|bus_watch| bus_watch.is_in_capture) {
            let capture = if self.others.is_empty() { "none".to_owned() } else { self.others.join(", ") };
            return Err(JointsNotFound::Buses { capture, skin: names(false) });
        }
        if self.bus_watches.iter().all(|bus_watch| bus_watch.open.is_empty()) {
            let zero = self.zero.unwrap_or_default();
            let Some(bus_watch) = self.bus_watches.iter().find(|bus_watch| !bus_watch.runs.is_empty()) else {
                for (index, (bus, watch)) in self.skin.buses.iter().zip(&self.bus_watches).enumerate() {
                    if let Some(came) = watch.other_joints {
                        let chain = self.skin.joints_on_bus(index).len();
                        return Err(JointsNotFound::Robot { bus: bus.name.clone(), came, chain });
                    }
                }
                return Err(JointsNotFound::Joints { buses: names(true) });
            };
            let Some(RequestedJoints { epoch, from_ns, occurrence }) = self.requested else {
                return Err(JointsNotFound::Joints { buses: names(true) });
            };
            let mut requested = format!("of epoch {epoch}");
            if occurrence > 1 {
                requested += &format!(" (occurrence {occurrence})");
            }
            if from_ns > 0 {
                requested += &format!(" at {} s or later", format_seconds(from_ns));
            }
            let mut runs: Vec<_> = bus_watch.runs.iter().map(|run| run.describe_run(zero)).collect();
            if bus_watch.further_runs > 0 {
                runs.push(format!("{} further runs", bus_watch.further_runs));
            }
            return Err(JointsNotFound::Epoch { requested, runs: runs.join("; ") });
        }
        let moment = |bus_watch: BusWatch| bus_watch.open.into_iter().next().map(|open| open.moment);
        Ok(self.bus_watches.into_iter().map(moment).collect())
    }
}

#[expect(clippy::cast_precision_loss, reason = "for display")]
fn format_seconds(nanos: u64) -> String {
    format!("{:.3}", nanos as f64 / 1e9)
}

impl EpochRun {
    fn describe_run(&self, zero: u64) -> String {
        let Self { first, last, joints } = *self;
        let [from, to] = [first, last].map(|(_, at)| format!("{:.3}", seconds_since(zero, at)));
        let (first, last) = (first.0, last.0);
        if joints == 1 {
            return format!("one of epoch {first} at {from} s");
        }
        format!("{joints} in a row, from epoch {first} at {from} s to epoch {last} at {to} s")
    }
}

impl AnswerableJoints {
    fn is_complete(&self) -> bool {
        // A cell that answered has reported its configuration, and a cell in contact has answered.
        let settled = |cell: &ObservedCellState| match cell.answer {
            Some(_) => cell.hash.is_some(),
            None => {
                cell.too_late.is_some()
                    || cell.contact_state.is_none_or(|(skin, _)| skin == SkinSensors::default())
            }
        };
        self.since >= MAX_WAIT_EPOCHS || self.is_too_late() && self.moment.cells.iter().all(settled)
    }

    /// Returns true if so many joints have followed these that an answer is too late to be used.
    const fn is_too_late(&self) -> bool {
        self.since as usize > MAX_LATE_EPOCHS
    }
}

impl BusWatch {
    /// Returns true if all answers to these joints have arrived, with the configuration of each cell that matters.
    fn is_complete(&self) -> bool {
        self.open.front().is_some_and(AnswerableJoints::is_complete)
    }

    /// Handles a message. Returns the index of the joints that it answers, if it is a torque that is used.
    fn receive_message(
        &mut self,
        nanos: u64,
        after: u64,
        message: &Message,
        requested: Option<RequestedJoints>,
        robot: usize,
    ) -> Option<u64> {
        let last = self.last;
        let mut answered = None;
        match *message {
            Message::Halt => self.halted = true,
            Message::Resume => self.halted = false,
            // Joints of another length are those of another robot; cells drop joints of the last epoch.
            Message::Joints { epoch, joints } => {
                let came = usize::from(joints.in_use);
                if came != robot {
                    self.other_joints = Some(came);
                } else if last != Some(epoch) {
                    self.receive_joints(nanos, after, epoch, joints, requested);
                }
            }
            Message::Stimulus { to, from, page } => {
                let from_epoch = if let StimulusStart::Epoch(epoch) = from { Some(epoch.0) } else { None };
                let origin =
                    ContactOrigin::Stimulus { at_ns: nanos, from_epoch, late: is_stimulus_late(from, last) };
                self.cells
                    .addressed_mut(to)
                    .iter_mut()
                    .for_each(|cell| cell.contact.add_stimulus(from, page, origin, last));
            }
            Message::Configure { to, request: Request::Write { number, words }, .. } => {
                if Parameter::from_number(number) == Some(Parameter::Mode) {
                    let (obeys, origin) = (words.first() == Some(&1), ContactOrigin::Mode { at_ns: nanos });
                    self.cells.addressed_mut(to).iter_mut().for_each(|cell| cell.set_mode(obeys, origin));
                }
            }
            Message::Configured { from, answer: Answer::Value { number, written, words }, .. } => {
                let [commit, _, _, identity, ..] = words.map(i16::cast_unsigned);
                let hash = match Parameter::from_number(number) {
                    Some(Parameter::Commit) if written => commit,
                    Some(Parameter::Identity) => identity,
                    Some(_) | None => return None,
                };
                if let Some(cell) = self.cells.get_mut(from) {
                    cell.hash = Some(hash);
                }
                self.apply_hash(from, hash);
            }
            Message::Network { from: Node::Cell(from), page: NetworkPage::Heartbeat(heartbeat), .. } => {
                if self.cells.get_mut(from).is_some_and(|cell| cell.handle_heartbeat(nanos, &heartbeat)) {
                    self.apply_hash(from, heartbeat.configuration);
                }
            }
            Message::Network { from: Node::Cell(from), page: NetworkPage::Received(heard), .. } => {
                let cell =
                    self.cells.get_mut(from).filter(|cell| cell.contact.obeys_stimuli() != Some(false));
                cell.into_iter().for_each(|cell| {
                    cell.contact.compare_stimulus_count(heard.stimuli, ContactOrigin::Said { at_ns: nanos })
                });
            }
            Message::Sensors { from, epoch, page: page @ SensorPage::Skin(skin) } => {
                let origin = ContactOrigin::Said { at_ns: nanos };
                let cell =
                    self.cells.get_mut(from).filter(|cell| cell.contact.obeys_stimuli() != Some(false));
                if let Some(cell) = cell.filter(|_| last.is_none_or(|last| last == epoch)) {
                    cell.contact.apply_reported_page(page, origin);
                }
                // A measuring cell has read its sensors at these very joints.
                if let Some((cell, ..)) = self.answering_cell(from, epoch) {
                    cell.contact_state.get_or_insert((skin, origin));
                }
            }
            Message::Torque { from, epoch, torque } => {
                if let Some((cell, in_time, index)) = self.answering_cell(from, epoch) {
                    if cell.answer.is_some() {
                        cell.repeated += 1;
                    } else if in_time {
                        cell.answer = Some((nanos, torque));
                        answered = Some(index);
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
        answered
    }

    fn receive_joints(
        &mut self,
        nanos: u64,
        after: u64,
        epoch: Epoch,
        joints: Joints,
        requested: Option<RequestedJoints>,
    ) {
        self.record_epoch(nanos, epoch);
        self.latch_contacts(epoch);
        for open in &mut self.open {
            open.since += 1;
        }
        // The joints of a bus without cells are not collected, so they would be kept until the end.
        let opens = requested.map_or(self.has_cells, |requested| {
            let is_one = epoch == requested.epoch && after >= requested.from_ns && self.open.is_empty();
            self.occurrences += u32::from(is_one);
            is_one && self.occurrences == requested.occurrence
        });
        if opens {
            let cells =
                self.cells.iter().map(|(_, WatchedCell { claim, contact, hash })| ObservedCellState {
                    contact_state: contact.presumed_skin().copied(),
                    test_mode: contact.obeys_stimuli(),
                    state: claim.heartbeat().map(|heartbeat| heartbeat.state),
                    hash: *hash,
                    ..ObservedCellState::default()
                });
            let moment = ObservedJoints { at_ns: nanos, joints, halted: self.halted, cells: cells.collect() };
            self.open.push_back(AnswerableJoints { epoch, moment, since: 0, index: self.opened });
            self.opened += 1;
        }
    }

    fn latch_contacts(&mut self, epoch: Epoch) {
        self.last = Some(epoch);
        self.cells.iter_mut().for_each(|(_, cell)| cell.contact.latch_due_stimuli(epoch, |_| {}));
    }

    /// Adds the epoch of new joints to the list of runs.
    fn record_epoch(&mut self, nanos: u64, epoch: Epoch) {
        let follows = !self.runs.is_empty() && self.last.is_some_and(|last| last.next() == epoch);
        if !follows && self.runs.len() == MAX_LISTED_RUNS {
            self.further_runs += 1;
        } else if !follows {
            self.runs.push(EpochRun { first: (epoch, nanos), last: (epoch, nanos), joints: 1 });
        } else if let Some(run) = self.runs.last_mut().filter(|_| self.further_runs == 0) {
            run.last = (epoch, nanos);
            run.joints += 1;
        }
    }

    /// Returns the state of the cell at the newest joints of this epoch, true if an answer is still in time, and the
    /// index of these joints.
    fn answering_cell(&mut self, from: CellId, epoch: Epoch) -> Option<(&mut ObservedCellState, bool, u64)> {
        let open = self.open.iter_mut().rev().find(|open| open.epoch == epoch)?;
        let (in_time, index) = (!open.is_too_late(), open.index);
        Some((open.moment.cells.get_mut(from.index())?, in_time, index))
    }

    /// Sets the configuration hash of a cell at all joints that are still open: it was the same then, but is reported
    /// only now.
    fn apply_hash(&mut self, from: CellId, hash: u16) {
        for open in &mut self.open {
            if let Some(cell) = open.moment.cells.get_mut(from.index()) {
                cell.hash.get_or_insert(hash);
            }
        }
    }
}

impl WatchedCell {
    /// Handles a heartbeat with the node id of the cell. Returns true if the cell itself sent it.
    fn handle_heartbeat(&mut self, at_ns: u64, heartbeat: &Heartbeat) -> bool {
        let obeys = heartbeat.state.has(State::TEST_MODE);
        match self.claim.receive(Micros(at_ns / 1_000), heartbeat) {
            HeartbeatKind::Claimant | HeartbeatKind::Outsider | HeartbeatKind::Overtaken => return false,
            HeartbeatKind::Started { .. } => self.set_mode(obeys, ContactOrigin::Start { at_ns }),
            // The apparent start was none, and the contact state before it was not kept.
            HeartbeatKind::Shared => self.contact.reset(),
            HeartbeatKind::First | HeartbeatKind::Continued if !obeys => self.contact.reset(),
            HeartbeatKind::First | HeartbeatKind::Continued => {}
        }
        self.contact.set_obeys_stimuli(obeys);
        self.hash = Some(heartbeat.configuration);
        true
    }

    /// Sets the mode of the cell. In test mode it starts without contact; a cell that measures has a contact state that
    /// the bus does not show.
    fn set_mode(&mut self, obeys: bool, origin: ContactOrigin) {
        if obeys {
            self.contact.record_start(origin);
        } else {
            self.contact.reset();
        }
        self.contact.set_obeys_stimuli(obeys);
    }
}
