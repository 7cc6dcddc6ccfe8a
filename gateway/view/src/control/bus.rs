//! One bus of a controlled run: its cells, its epochs, and the presses on it.

use model::table::{CellState, CellStatus, Notice};
use protocol::can::Frame;
use protocol::id::{CellId, Node};
use protocol::message::{Message, NetworkPage, SkinSensors, State};
use protocol::packet::{Epoch, Words, data_frame_id};
use protocol::parameters::Baseline;
use protocol::skin::Skin;
use protocol::time::Micros;

use super::event::{
    CellChange, ControlEvent, JointTorques, ReportedBus, ReportedCell, RequestId, UnconfirmedReason,
};
use super::presses::{PendingPresses, Press, Unconfirmed};
use crate::live::bus::{BroadcastJoints, LiveBus};
use crate::live::clear_if_unknown;

/// The maximum error of a cell's J in steps of 2^-14, for a chain of six rows (requirement J-3).
const MAX_J_ERROR_STEPS: f64 = 8.0;
/// The number of rows from which on each row allows one step more.
const ROWS_OF_MAX_J_ERROR: u8 = 6;

/// One bus of a controlled run.
#[derive(Debug)]
pub(super) struct ControlBus {
    live: LiveBus,
    cells: Vec<ControlledCell>,
    /// The number of the present epoch: its byte, continued beyond 255.
    number: u64,
    presses: PendingPresses,
    /// The time since which the bus is lost without an event. The buses of a run are also lost at its end.
    lost_since: Option<Micros>,
}

/// The time after which the loss of a bus is reported, in µs.
const LOSS_REPORT_DELAY_US: u64 = 100_000;

/// A cell of a controlled run.
#[derive(Clone, Copy, Debug)]
struct ControlledCell {
    node: CellId,
    /// The maximum error of the cell's J.
    j_error: f64,
    subtracts_baseline: bool,
    is_touched: bool,
    /// True if the cell answers joints, as far as was seen.
    is_ready: bool,
    last_packet: Micros,
}

impl ControlBus {
    pub(super) fn new(skin: &Skin, bus: usize) -> Self {
        let cells = skin.cells.iter().filter(|cell| cell.bus == bus).map(|cell| {
            let further_rows = cell.row.saturating_sub(ROWS_OF_MAX_J_ERROR);
            ControlledCell {
                node: cell.node,
                j_error: (MAX_J_ERROR_STEPS + f64::from(further_rows)) / 16_384.0,
                subtracts_baseline: cell.baseline != Baseline::Off,
                is_touched: false,
                is_ready: false,
                last_packet: Micros(0),
            }
        });
        Self {
            live: LiveBus::new(skin, bus),
            cells: cells.collect(),
            number: 0,
            presses: PendingPresses::default(),
            lost_since: None,
        }
    }

    pub(super) fn name(&self) -> &str {
        &self.live.name
    }

    /// Returns true if the cells answer with sums.
    pub(super) const fn sums(&self) -> bool {
        self.live.sums
    }

    /// Returns true if joints have come since the start or the last loss of the bus.
    pub(super) const fn has_joints(&self) -> bool {
        self.live.current.is_some()
    }

    /// Returns true if joints and a heartbeat of each cell were received.
    pub(super) fn is_complete(&self) -> bool {
        self.has_joints() && self.live.table.cells().iter().all(|cell| cell.heartbeat().is_some())
    }

    /// Returns true if an epoch is complete, so that its torques are known.
    pub(super) const fn has_complete_epoch(&self) -> bool {
        self.live.previous.is_some()
    }

    /// Returns position, distributed torque and central torque of each joint of the chain. A torque is NaN while it is
    /// unknown.
    pub(super) fn joint_values(&self) -> Vec<[f64; 3]> {
        let torques = self.live.joint_torques().enumerate();
        torques
            .map(|(joint, (distributed, central))| {
                [self.live.joint_position(joint).unwrap_or_default(), distributed, central]
            })
            .collect()
    }

    /// Handles a frame, and adds the events that it causes. Returns the held presses that are to be sent now.
    pub(super) fn handle_frame(
        &mut self,
        at_ns: u64,
        frame: &Frame,
        every: u64,
        events: &mut Vec<ControlEvent>,
    ) -> Vec<Press> {
        let at = Micros(at_ns / 1_000);
        let message = self.live.apply_frame(at, frame);
        if let Some(place) = data_frame_id(frame).ok().and_then(|id| self.live.table.index_of(id.sender()?))
            && let Some(cell) = self.cells.get_mut(place)
        {
            cell.last_packet = at;
        }
        self.handle_notices(at, events);
        match message {
            Some(Message::Joints { epoch, .. }) => {
                // Joints that did not arrive have epochs, too. Cells ignore joints that repeat an epoch.
                let passed = self.live.previous.map(|previous| epoch.0.wrapping_sub(previous.epoch.0));
                if passed == Some(0) {
                    return Vec::new();
                }
                let ended = self.live.previous.filter(|_| every > 0 && self.number.is_multiple_of(every));
                events.extend(ended.map(|ended| self.epoch_event(&ended, at_ns)));
                self.number = match passed {
                    Some(passed) => self.number + u64::from(passed),
                    None => first_number(self.number, epoch),
                };
                return self.presses.begin_epoch(self.number, at);
            }
            Some(Message::Torque { from, epoch, torque }) => {
                self.handle_torque(from, epoch, &torque, at_ns, events)
            }
            Some(Message::Network { from, epoch, page: NetworkPage::Heartbeat(beat) }) => {
                if let Node::Cell(cell) = from
                    && let Some(place) = self.live.table.index_of(cell)
                {
                    // The torque that ended a contact may be lost; torques begin contacts, except on buses with sums.
                    let is_active = beat.state.has(State::ACTIVE);
                    if self.live.sums || !is_active {
                        self.set_touched(place, is_active, epoch, at_ns, events);
                    }
                }
            }
            Some(_) | None => {}
        }
        Vec::new()
    }

    /// Returns the event of the epoch that the last joints have ended.
    fn epoch_event(&self, ended: &BroadcastJoints, at_ns: u64) -> ControlEvent {
        let positions = self.live.central.joint_positions(&ended.positions);
        let mut joints = JointTorques::default();
        for (position, (distributed, central)) in positions.into_iter().zip(self.live.joint_torques()) {
            joints.positions.push(position);
            joints.distributed.push(distributed);
            joints.central.push(central);
        }
        clear_if_unknown(&mut joints.central);
        let (bus, epoch) = (self.name().to_owned(), ended.epoch.0);
        ControlEvent::Epoch { bus, epoch, number: self.number, at_ns, joints }
    }

    fn handle_torque(
        &mut self,
        from: CellId,
        epoch: Epoch,
        words: &Words,
        at_ns: u64,
        events: &mut Vec<ControlEvent>,
    ) {
        let Some(place) = self.live.table.index_of(from) else { return };
        let is_zero = words.as_slice().iter().all(|&word| word == 0);
        self.set_touched(place, !is_zero, epoch, at_ns, events);
        let Some(present) = self.live.current else { return };
        let since = epoch.epochs_since(present.epoch);
        let Some(number) = self.number.checked_add_signed(since.into()) else { return };
        let Some(press) = self.presses.pending_in(from, number).cloned() else { return };
        if press.hidden.is_some() {
            return;
        }
        let Some(positions) = self.live.joint_positions_in(epoch) else { return };
        let Some(cell) = self.cells.get(place) else { return };
        let format = self.live.torque_format;
        let central = &self.live.central;
        let f_z = central.cell_force(place, &press.sensors);
        let expected = central.cell_torque(place, &central.link_frames(&positions), f_z);
        let tolerance = cell.j_error * f_z + format.step_size();
        let is_near = |(&word, &expected): (&i16, &f64)| {
            let is_saturated = word == i16::MAX || word == i16::MIN;
            let limit = format.to_real(word);
            // The true value of a saturated word lies beyond it.
            (limit - expected).abs() <= tolerance || is_saturated && expected.abs() >= limit.abs() - tolerance
        };
        if !words.as_slice().iter().zip(&expected).all(is_near) {
            return self.presses.note(from, press.first, UnconfirmedReason::OtherTorque);
        }
        if is_zero != (f_z <= 0.0) {
            let reason = if is_zero { UnconfirmedReason::NoTorque } else { UnconfirmedReason::OtherTorque };
            return self.presses.note(from, press.first, reason);
        }
        self.presses.remove(from, press.first);
        events.push(ControlEvent::Confirmed {
            id: press.id,
            cell: self.cell_text(from),
            force_n: press.force_n,
            epoch: epoch.0,
            at_ns,
            torque: self.real_torque(words),
        });
    }

    /// Returns a torque in Nm or N, by joint of the chain.
    fn real_torque(&self, words: &Words) -> Vec<f64> {
        let joints = self.live.joint_torques().zip(words.as_slice());
        joints.map(|(_, &word)| self.live.torque_format.to_real(word)).collect()
    }

    fn set_touched(
        &mut self,
        place: usize,
        touched: bool,
        epoch: Epoch,
        at_ns: u64,
        events: &mut Vec<ControlEvent>,
    ) {
        let Some(cell) = self.cells.get_mut(place) else { return };
        if std::mem::replace(&mut cell.is_touched, touched) != touched {
            let cell = cell.node;
            events.push(ControlEvent::Contact { cell: self.cell_text(cell), touched, epoch: epoch.0, at_ns });
        }
    }

    fn handle_notices(&mut self, at: Micros, events: &mut Vec<ControlEvent>) {
        let notices: Vec<_> = self.live.table.drain_notices().collect();
        self.apply_notices(notices, at, events);
    }

    fn apply_notices(&mut self, notices: Vec<Notice>, at: Micros, events: &mut Vec<ControlEvent>) {
        for notice in notices {
            let (cell, state) = match notice {
                Notice::Dead(cell) => (cell, CellChange::Dead),
                Notice::Revived(cell) => (cell, CellChange::Alive),
                Notice::Restarted(cell) => {
                    self.presses.note_restart(cell, at);
                    (cell, CellChange::Restarted)
                }
                Notice::Duplicate(_) | Notice::Returned(_) | Notice::OtherGateway => continue,
            };
            if state != CellChange::Alive
                && let Some(cell) = self.live.table.index_of(cell).and_then(|place| self.cells.get_mut(place))
            {
                cell.is_touched = false;
            }
            events.push(ControlEvent::Cell { cell: self.cell_text(cell), state });
        }
    }

    /// Handles the time: cells become silent, and presses expire.
    pub(super) fn handle_time(&mut self, now: Micros, events: &mut Vec<ControlEvent>) {
        if self.lost_since.is_some_and(|since| now.elapsed_since(since).0 > LOSS_REPORT_DELAY_US) {
            self.lost_since = None;
            events.push(self.bus_event(false));
        }
        let notices = self.live.handle_time(now);
        self.apply_notices(notices, now, events);
        let Self { live, cells, presses, .. } = self;
        let statuses: Vec<_> = live.table.statuses(now).map(|(_, status)| status).collect();
        for (cell, state) in cells.iter_mut().zip(live.table.cells()) {
            let was_ready = std::mem::replace(&mut cell.is_ready, state.is_ready());
            if cell.is_ready && !was_ready {
                let name = format!("{}:{}", live.name, cell.node);
                events.push(ControlEvent::Cell { cell: name, state: CellChange::Ready });
            }
        }
        let expired = presses.take_expired(now, |node| {
            let place = live.table.index_of(node);
            let cell = place.and_then(|place| live.table.cells().get(place));
            let status = place.and_then(|place| statuses.get(place)).copied();
            let is_ready = cell.is_some_and(CellState::is_ready);
            let beat = cell.and_then(CellState::heartbeat);
            // A heartbeat may be older than a resume: the table knows.
            let is_halted = !is_ready && beat.is_some_and(|beat| beat.state.has(State::HALTED));
            let reason = if matches!(status, Some(CellStatus::Dead | CellStatus::Unknown) | None) {
                Some(UnconfirmedReason::Dead)
            } else if live.halted || is_halted {
                Some(UnconfirmedReason::Halted)
            } else if !is_ready {
                Some(UnconfirmedReason::NotReady)
            } else if cell.and_then(CellState::is_measuring) == Some(true) {
                Some(UnconfirmedReason::Measuring)
            } else {
                None
            };
            let last_packet = place.and_then(|place| cells.get(place)).map(|cell| cell.last_packet);
            (reason, last_packet.unwrap_or_default())
        });
        expired.into_iter().for_each(|unconfirmed| events.push(self.unconfirmed_event(unconfirmed)));
    }

    /// Creates a press of a cell that asks for the next possible epoch.
    pub(super) fn new_press(
        &self,
        id: Option<RequestId>,
        cell: CellId,
        (is_press, force_n, sensors): (bool, f64, SkinSensors),
        at: Micros,
    ) -> Press {
        let place = self.live.table.index_of(cell);
        let hidden = if self.live.sums {
            Some(UnconfirmedReason::Sums)
        } else if place.is_some_and(|place| self.is_measuring(place)) {
            Some(UnconfirmedReason::Measuring)
        } else {
            let force = place.map_or(0.0, |place| self.live.central.cell_force(place, &sensors));
            (is_press && force <= 0.0).then_some(UnconfirmedReason::BelowThreshold)
        };
        let is_touched = place.and_then(|place| self.cells.get(place)).is_some_and(|cell| cell.is_touched);
        let must_answer = is_press || self.presses.pending_touch(cell).unwrap_or(is_touched);
        let first = self.presses.first_epoch(cell, self.number);
        Press { id, cell, force_n, sensors, first, at, hidden, must_answer }
    }

    /// Adds a press. Returns it if its stimulus is to be sent now.
    pub(super) fn add_press(&mut self, press: Press, events: &mut Vec<ControlEvent>) -> Option<Press> {
        let mut replaced = None;
        let sent = self.presses.add(press, self.number, |former| replaced = Some(former));
        events.extend(replaced.map(|former| self.unconfirmed_event(former)));
        sent
    }

    /// Removes all presses at the end of the run.
    pub(super) fn end_presses(&mut self, events: &mut Vec<ControlEvent>) {
        for unconfirmed in self.presses.take_all() {
            events.push(self.unconfirmed_event(unconfirmed));
        }
    }

    fn unconfirmed_event(&self, (press, reason): Unconfirmed) -> ControlEvent {
        ControlEvent::Unconfirmed {
            id: press.id,
            cell: self.cell_text(press.cell),
            force_n: press.force_n,
            reason,
            text: reason.text(),
        }
    }

    fn is_measuring(&self, place: usize) -> bool {
        let measures = self.live.table.cells().get(place).and_then(|cell| cell.is_measuring()) == Some(true);
        measures || self.cells.get(place).is_some_and(|cell| cell.subtracts_baseline)
    }

    /// Returns the sensor words that a cell has latched, as far as the bus shows them.
    pub(super) fn latched_sensors(&self, node: CellId, now: Micros) -> Option<SkinSensors> {
        self.live.sensors(node, now)
    }

    /// Handles the state of the bus: whether it works, and the number of frames that were not received. Reports a bus
    /// that works again, with a loss that was not reported yet.
    pub(super) fn handle_state(
        &mut self,
        now: Micros,
        is_up: bool,
        dropped: u64,
        events: &mut Vec<ControlEvent>,
    ) {
        let was_up = self.live.is_up;
        self.live.set_state(is_up, dropped);
        if is_up && !was_up {
            let loss = self.lost_since.take().map(|_| false);
            events.extend(loss.into_iter().chain([true]).map(|up| self.bus_event(up)));
        } else if was_up && !is_up {
            self.lost_since = Some(now);
            // Epochs pass meanwhile: no stimulus can name one before the next joints.
            (self.live.current, self.live.previous) = (None, None);
        }
    }

    fn bus_event(&self, up: bool) -> ControlEvent {
        ControlEvent::Bus { bus: self.name().to_owned(), up }
    }

    pub(super) fn report(&self) -> ReportedBus {
        ReportedBus {
            bus: self.name().to_owned(),
            up: self.live.is_up,
            halted: self.live.halted,
            epoch: self.live.current.map(|current| current.epoch.0),
            number: self.number,
            dropped_frames: self.live.dropped,
        }
    }

    /// Returns the cells with a torque, or in a state that a user may not expect.
    pub(super) fn reported_cells(&self, now: Micros) -> Vec<ReportedCell> {
        let cells = self.live.table.statuses(now).zip(&self.live.last);
        let cells = cells.filter(|((_, status), last)| *status != CellStatus::Quiet || last.is_some());
        cells
            .map(|((cell, status), last)| ReportedCell {
                cell: self.cell_text(cell.node),
                status: status.name(),
                epoch: last.map(|(_, epoch, _)| epoch.0),
                torque: last.map(|(_, _, words)| self.real_torque(&words)),
            })
            .collect()
    }

    fn cell_text(&self, node: CellId) -> String {
        format!("{}:{node}", self.live.name)
    }
}

/// Returns the number of the first epoch on a bus, or after a loss of it: the epoch's byte, continued from `former`. How
/// many epochs have passed is unknown then: too many for the presses before it.
fn first_number(former: u64, epoch: Epoch) -> u64 {
    if former == 0 {
        return epoch.0.into();
    }
    let least = former + 256;
    least + u64::from(epoch.0.wrapping_sub(least.to_le_bytes()[0]))
}
