//! Counts and series of one bus, from its frames: replies, losses and errors as the gateway counted them in the run.

use protocol::can::Frame;
use protocol::candump::{Direction, Record};
use protocol::id::{Command, Kind};
use protocol::message::{Message, SensorPage};
use protocol::packet::data_frame_id;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{Skin, SkinReply};
use protocol::time::Micros;
use protocol::wire_time::FrameBits;

use super::moments::BusProblems;
use super::touched::TouchHistory;
use crate::fit::rates::ChosenRates;
use crate::report::thin::{BinnedSums, ThinnedLine};
use model::central::CentralComputation;
use model::table::{BusTable, BusTotals, CellState, Replies};
use trace::capture::LatchedFrame;

/// Interval in µs at which timeouts of cells are checked, as in the gateway's receiver.
const TIMEOUT_INTERVAL_US: u64 = 20_000;
/// The reply times of a cell, in µs.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Latency {
    pub(super) max: u64,
    pub(super) sum: u64,
    pub(super) count: u64,
}

/// The epoch that cells are answering.
#[derive(Clone, Copy, Debug, Default)]
struct OpenEpoch {
    number: u64,
    at: f64,
    /// Number of replies due in the epoch.
    due: u64,
    /// The counts of replies when the epoch began.
    before: Replies,
    /// Number and sum of errors when the epoch began.
    errors: (u64, f64),
    /// Number of lost packets of cells when the epoch began.
    lost: u64,
    /// The slowest reply in the epoch, in µs.
    slowest: Option<u64>,
}

/// Series over time with one point for each epoch.
#[derive(Debug, Default)]
pub(super) struct EpochSeries {
    pub(super) due: ThinnedLine,
    pub(super) in_time: ThinnedLine,
    pub(super) late: ThinnedLine,
    pub(super) missing: ThinnedLine,
    /// The slowest reply of each epoch, in ms.
    pub(super) slowest: ThinnedLine,
    /// Mean absolute error of the bus's torque in each epoch that all cells answered, in Nm.
    pub(super) error: ThinnedLine,
    /// For each joint of the chain, the distributed minus the central torque in each epoch that all cells answered, in
    /// Nm or N.
    pub(super) difference: Vec<ThinnedLine>,
}

/// The effect of a frame on the series of a capture that has frames only, without the loop's topics.
#[derive(Clone, Copy, Debug)]
pub(super) enum FrameEffect {
    /// New joint positions of the chain, in rad or m.
    Joints([f64; MAX_JOINTS]),
    /// True for a halt of the cells, false for a resume.
    Halted(bool),
}

/// Returns true for a frame that cells receive and that the gateway's table records. The capture does not contain the
/// sender of a frame, but the identifier shows the receiver.
fn is_for_cells(frame: &Frame) -> bool {
    let Ok(id) = data_frame_id(frame) else { return false };
    // A table counts a resume only in frames of others: the gateway knows its own.
    let is_resume = id.kind == Kind::Command && Command::from_byte(id.node) == Some(Command::Resume);
    id.sender().is_none() && !is_resume
}

/// The table of a bus as far as its frames have been read.
#[derive(Debug)]
pub(super) struct FrameState {
    last_timeout_check: Micros,
    /// True for a capture without the direction of frames, in which the gateway's own frames are recognised by their
    /// identifiers.
    is_of_frames_only: bool,
    /// The totals of the table when the newest joints arrived.
    pub(super) before: BusTotals,
    /// Number of cells in contact since the newest joints; `None` if unknown for some cell.
    pub(super) in_contact: Option<u32>,
}

/// The figures of one bus.
#[derive(Debug)]
pub(super) struct BusFigures {
    pub(super) name: String,
    pub(super) table: BusTable,
    /// The central computation for the cells of the bus.
    central: CentralComputation,
    /// The last reported force in N of each cell that measures, by its index on the bus.
    measured: Vec<Option<f64>>,
    pub(super) touched: TouchHistory,
    pub(super) moments: BusProblems,
    /// Time in s and size in Nm of the largest error of the bus's torque.
    pub(super) largest_error: Option<(f64, f64)>,
    /// True if cells answer with sums.
    pub(super) sums: bool,
    pub(super) received: FrameState,
    open: Option<OpenEpoch>,
    pub(super) lines: EpochSeries,
    /// Reply times of each cell, by its index on the bus.
    pub(super) latency: Vec<Latency>,
    pub(super) frames: u64,
    /// Times of the first and the last joints on the bus, in s, and the number of joints.
    pub(super) joints: Option<(f64, f64, u64)>,
    /// Bit rates of the real bus for which the load is computed.
    pub(super) rates: ChosenRates,
    /// Source of the rates; `None` for defaults.
    pub(super) rates_from: Option<&'static str>,
    /// Time in s that the frames take on the real bus, by time of the run.
    pub(super) load: BinnedSums,
    /// Time in s as in `load`, with the frames that only a bench sends included.
    pub(super) load_of_all: BinnedSums,
    /// Number of frames that the recorder lost, by its own notes.
    pub(super) dropped: u64,
}

impl BusFigures {
    pub(super) fn new(
        skin: &Skin,
        bus: usize,
        (rates, rates_from): (ChosenRates, Option<&'static str>),
        is_of_frames_only: bool,
    ) -> Self {
        let mut table = BusTable::new(skin, bus);
        table.set_torque_comparison(true);
        let described = skin.buses.get(bus);
        Self {
            name: described.map(|bus| bus.name.clone()).unwrap_or_default(),
            latency: vec![Latency::default(); table.cells().len()],
            measured: vec![None; table.cells().len()],
            central: CentralComputation::new(&skin.with_cells_of_bus(bus)),
            touched: TouchHistory::new(skin, bus),
            moments: BusProblems::default(),
            largest_error: None,
            table,
            sums: described.is_some_and(|bus| bus.reply != SkinReply::Torque),
            received: FrameState {
                last_timeout_check: Micros(0),
                is_of_frames_only,
                before: BusTotals::default(),
                in_contact: None,
            },
            open: None,
            lines: EpochSeries {
                difference: vec![ThinnedLine::default(); skin.joints_on_bus(bus).len()],
                ..EpochSeries::default()
            },
            frames: 0,
            joints: None,
            rates,
            rates_from,
            load: BinnedSums::default(),
            load_of_all: BinnedSums::default(),
            dropped: 0,
        }
    }

    /// Handles a packet from before the start of the recording, which still has an effect.
    pub(super) fn receive_latched(&mut self, before: &LatchedFrame) {
        self.table.handle_frame(Micros(before.nanos / 1_000), before.own, &before.frame, &mut |_| None);
    }

    /// Starts counting, after the packets from before the start.
    pub(super) fn begin_counting(&mut self) {
        self.table.reset_counts();
        self.open =
            self.table.newest_joints().map(|(number, _, _)| OpenEpoch { number, ..OpenEpoch::default() });
    }

    /// Handles the next frame, `at` seconds after the start of the recording.
    pub(super) fn receive_frame(&mut self, at: f64, record: &Record<'_>) -> Option<FrameEffect> {
        let now = Micros(record.time.nanos / 1_000);
        self.frames += 1;
        if now.0 >= self.received.last_timeout_check.0 + TIMEOUT_INTERVAL_US {
            self.received.last_timeout_check = now;
            self.table.handle_time(now);
            for notice in self.table.drain_notices() {
                self.moments.record_notice(at, notice);
            }
        }
        let own = match self.received.is_of_frames_only {
            true => is_for_cells(&record.frame),
            false => record.direction == Some(Direction::Sent),
        };
        let read = self.table.read_frame(now, &record.frame);
        let message = read.message();
        if let Some(message) = message {
            self.record_reply_time(now, message);
            self.record_measured_force(message);
        }
        let seconds = FrameBits::from_frame(&record.frame).map_or(0.0, |bits| bits.seconds(self.rates.rates));
        self.load_of_all.add(at, seconds);
        let before = self.table.snapshot().sums;
        self.table.handle_read_frame(now, own, &read, &mut |_| None);
        let newest = self.table.newest_joints().map(|(number, _, _)| number);
        let is_next = newest.is_some() && newest != self.open.map(|open| open.number);
        if is_next {
            self.open_epoch(newest.unwrap_or(0), at);
            self.received.before = before;
        }
        match message {
            Some(Message::Joints { joints, .. }) if is_next => {
                Some(FrameEffect::Joints(self.central.joint_positions(&joints.positions)))
            }
            Some(Message::Halt) => Some(FrameEffect::Halted(true)),
            Some(Message::Resume) => Some(FrameEffect::Halted(false)),
            Some(_) | None => None,
        }
    }

    /// Adds the time that a frame takes on a real bus; zero for a frame that only a bench sends.
    pub(super) fn add_real_load(&mut self, at: f64, bits: Option<FrameBits>) {
        self.load.add(at, bits.map_or(0.0, |bits| bits.seconds(self.rates.rates)));
    }

    /// Records the reply time of a cell, if the message is its answer to the newest joints.
    fn record_reply_time(&mut self, now: Micros, message: &Message) {
        let (Message::Torque { from, epoch, .. } | Message::Sum { from, epoch, .. }) = message else {
            return;
        };
        let Some((_, newest, opened)) = self.table.newest_joints() else { return };
        let cell = self.table.cells().iter().position(|cell| cell.node == *from);
        let Some(latency) = cell.filter(|_| newest == *epoch).and_then(|cell| self.latency.get_mut(cell))
        else {
            return;
        };
        let took = now.elapsed_since(opened).0;
        latency.max = latency.max.max(took);
        latency.sum = latency.sum.saturating_add(took);
        latency.count += 1;
        if let Some(open) = &mut self.open {
            open.slowest = open.slowest.max(Some(took));
        }
    }

    /// Records the force that a cell measures, if the message is its sensors page.
    fn record_measured_force(&mut self, message: &Message) {
        let Message::Sensors { from, page: SensorPage::Skin(skin), .. } = message else { return };
        let Some(place) = self.table.cells().iter().position(|cell| cell.node == *from) else { return };
        if let Some(measured) = self.measured.get_mut(place) {
            *measured = Some(self.central.cell_force(place, skin));
        }
    }

    /// Updates the force on each cell for the newest joints, from the cell's stimuli or its own measurement.
    fn update_forces(&mut self, at: f64) {
        let (table, central, measured) = (&self.table, &self.central, &self.measured);
        let sensors = table
            .presumed_sensors(self.received.last_timeout_check)
            .zip(table.cells())
            .zip(measured)
            .enumerate();
        let mut in_contact = Some(0);
        let forces = sensors.map(|(place, (((sensors, _), cell), measured))| {
            let stimulated = sensors.map(|sensors| central.cell_force(place, &sensors));
            let force = stimulated.or_else(|| measured.filter(|_| cell.is_measuring() == Some(true)));
            let is_known = !cell.is_ready() || force.is_some() && !cell.has_unseen_stimuli();
            let is_pressed = force.is_some_and(|force| force > 0.0);
            in_contact = in_contact.filter(|_| is_known).map(|count| count + u32::from(is_pressed));
            force
        });
        self.touched.record_joints(at, forces);
        self.received.in_contact = in_contact;
    }

    /// Returns the counts of due and received replies over all epochs.
    pub(super) fn reply_counts(&self) -> Replies {
        self.table.reply_counts()
    }

    /// Returns the number of missing replies that neither arrived too late nor were skipped by late cells.
    pub(super) fn lost_reply_count(&self) -> u64 {
        if self.sums {
            return self.reply_counts().missing;
        }
        let lost = |cell: &CellState| {
            let (skipped, _) = cell.unanswered_joint_counts().unwrap_or_default();
            let Replies { missing, in_doubt, too_late, .. } = cell.replies;
            missing - missing.saturating_sub(in_doubt).min(too_late + skipped)
        };
        self.table.cells().iter().map(lost).sum()
    }

    /// Returns the number and the sum in Nm of the torque errors so far.
    fn torque_errors(&self) -> (u64, f64) {
        let accuracy = self.table.accuracy();
        let errors = if self.sums { accuracy.sums } else { accuracy.whole };
        (errors.count(), errors.mean().unwrap_or(0.0) * errors.count() as f64)
    }

    /// Handles new joints on the bus: ends the epoch, and begins the next one.
    fn open_epoch(&mut self, number: u64, at: f64) {
        let (first, _, count) = self.joints.unwrap_or((at, at, 0));
        self.joints = Some((first, at, count + 1));
        let (due, before, errors) = self.close_epoch();
        let lost = self.table.uplink().lost;
        self.open = Some(OpenEpoch { number, at, due, before, errors, lost, slowest: None });
        self.update_forces(at);
    }

    /// Ends the epoch. Returns the number of replies that were due in it, and the counts of replies and errors after
    /// it.
    fn close_epoch(&mut self) -> (u64, Replies, (u64, f64)) {
        let (account, errors) = (self.reply_counts(), self.torque_errors());
        let Some(OpenEpoch { at, due, before, errors: errors_before, lost, slowest, .. }) = self.open.take()
        else {
            return (account.due, account, errors);
        };
        let packets = self.table.uplink().lost.saturating_sub(lost);
        self.moments.record_epoch(at, &before, &account, packets);
        let compared = errors.0.saturating_sub(errors_before.0);
        let error = (errors.1 - errors_before.1).max(0.0) / compared as f64;
        let lines = &mut self.lines;
        lines.due.push(at, due as f64);
        lines.in_time.push(at, account.in_time.saturating_sub(before.in_time) as f64);
        lines.late.push(at, account.late.saturating_sub(before.late) as f64);
        lines.missing.push(at, account.missing.saturating_sub(before.missing) as f64);
        lines.slowest.push(at, slowest.map_or(f64::NAN, |took| took as f64 * 1e-3));
        lines.error.push(at, if compared > 0 { error } else { f64::NAN });
        let difference = self.table.torque_difference();
        for error in difference.iter().flatten().map(|error| error.abs()) {
            if error > self.largest_error.map_or(0.0, |(_, farthest)| farthest) {
                self.largest_error = Some((at, error));
            }
        }
        for (joint, line) in lines.difference.iter_mut().enumerate() {
            let of_joint = difference.as_ref().and_then(|difference| difference.get(joint));
            line.push(at, of_joint.copied().unwrap_or(f64::NAN));
        }
        (account.due.saturating_sub(before.due), account, errors)
    }

    /// Ends the series after the last frame.
    pub(super) fn finish(&mut self) {
        self.table.finish();
        self.close_epoch();
        self.touched.finish();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::can::Format;
    use protocol::id::{CellId, Node};
    use protocol::message::{Heartbeat, Joints, Message, NetworkPage};
    use protocol::packet::{Epoch, Packet};

    fn frames(message: &Message) -> Vec<Frame> {
        let packet: Packet = message.encode();
        packet.frames(Format::Classic).collect()
    }

    #[test]
    fn frames_for_cells_are_told_from_those_of_cells_by_their_identifiers() {
        let page = NetworkPage::Heartbeat(Heartbeat::default());
        let network = |from| Message::Network { from, epoch: Epoch(0), page };
        let cell = Node::Cell(CellId::new(3).unwrap());
        for (message, is) in [
            (Message::Joints { epoch: Epoch(1), joints: Joints::default() }, true),
            (Message::Sync, true),
            (Message::Report, true),
            (Message::Halt, true),
            (Message::Resume, false),
            (network(Node::Gateway), true),
            (network(cell), false),
        ] {
            let frames = frames(&message);
            assert!(
                !frames.is_empty() && frames.iter().all(|frame| is_for_cells(frame) == is),
                "{message:?}"
            );
        }
    }
}
