//! The state of one bus: the state of its cells, and the torques of the last epoch.

use analysis::fit;
use analysis::fit::rates::RequestedRates;
use bench::summary::TimedReport;
use bench::view::CellView;
use model::central::CentralComputation;
use model::table::{BusTable, CellState, CellStatus, Notice};
use protocol::can::Frame;
use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::id::CellId;
use protocol::message::{Message, SkinSensors};
use protocol::packet::{Epoch, Words};
use protocol::parameters::MAX_JOINTS;
use protocol::port::wire_message;
use protocol::skin::{Skin, SkinReply};
use protocol::time::Micros;
use protocol::wire_time::{BitRates, FrameBits};

use super::flag;
use super::replies::ReplyTimes;

/// The time over which the load of the bus is averaged, in µs.
const LOAD_WINDOW_US: u64 = 1_000_000;

/// An epoch, and the joint positions that were broadcast in it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BroadcastJoints {
    pub(crate) epoch: Epoch,
    pub(crate) positions: [Q1_14; MAX_JOINTS],
}

/// The share of time for which frames occupy the real bus.
#[derive(Clone, Copy, Debug, Default)]
struct BusLoad {
    since: Option<Micros>,
    busy_s: f64,
    /// The load in the last complete window; 1 is the bus's capacity.
    share: Option<f64>,
}

/// The reply times, bound and figures of a bus on which frames take time.
#[derive(Clone, Debug)]
pub(crate) struct TimedBus {
    pub(crate) replies: ReplyTimes,
    /// The upper bound of the time in µs from joints to their last reply; `None` without one.
    pub(super) last_reply_bound_us: Option<f64>,
    /// The last figures of the bus's server; `None` in a recording.
    pub(super) figures: Option<TimedReport>,
}

#[derive(Clone, Debug)]
pub(crate) struct LiveBus {
    pub(crate) name: String,
    pub(crate) table: BusTable,
    pub(crate) central: CentralComputation,
    pub(crate) torque_format: TorqueFormat,
    pub(crate) sums: bool,
    /// The joint positions of the current epoch; `before` has those of the previous one.
    pub(crate) current: Option<BroadcastJoints>,
    pub(crate) previous: Option<BroadcastJoints>,
    /// The distributed and the central torque of each joint of the chain in the last completed epoch: NaN before the
    /// first one, and the central ones while they are unknown.
    torques: [(f64, f64); MAX_JOINTS],
    joints: usize,
    /// The last torque of each cell with its time, by the cell's index on the bus.
    pub(crate) last: Vec<Option<(Micros, Epoch, Words)>>,
    /// For each cell, the time since which it is dead; `None` for a live cell.
    pub(crate) dead_since: Vec<Option<Micros>>,
    rates: Option<BitRates>,
    load: BusLoad,
    /// `None` on a bus on which frames take no time.
    timed: Option<Box<TimedBus>>,
    pub(crate) halted: bool,
    pub(crate) is_up: bool,
    pub(crate) dropped: u64,
}

impl LiveBus {
    pub(crate) fn new(skin: &Skin, bus: usize) -> Self {
        let mut table = BusTable::new(skin, bus);
        table.set_torque_comparison(true);
        let described = skin.buses.get(bus);
        let cells = table.cells().len();
        Self {
            name: described.map(|bus| bus.name.clone()).unwrap_or_default(),
            central: CentralComputation::new(&skin.with_cells_of_bus(bus)),
            torque_format: described.map(|bus| bus.torque_format).unwrap_or_default(),
            sums: described.is_some_and(|bus| bus.reply != SkinReply::Torque),
            current: None,
            previous: None,
            torques: [(f64::NAN, f64::NAN); MAX_JOINTS],
            joints: skin.joints_on_bus(bus).len(),
            last: vec![None; cells],
            dead_since: vec![None; cells],
            rates: described.and_then(|bus| Some(RequestedRates::default().for_bus(bus).ok()?.rates)),
            load: BusLoad::default(),
            timed: None,
            halted: false,
            is_up: false,
            dropped: 0,
            table,
        }
    }

    /// Applies a frame. Returns the message that it completes, if any; joints begin an epoch.
    pub(crate) fn apply_frame(&mut self, at: Micros, frame: &Frame) -> Option<Message> {
        let received = self.table.read_frame(at, frame);
        let message = received.message().copied();
        if wire_message(frame).is_none() && !matches!(message, Some(Message::Stimulus { .. })) {
            // On a bench, wire states and stimuli are frames of the same bus, but a real bus would not carry them.
            let busy =
                self.rates.zip(FrameBits::from_frame(frame)).map_or(0.0, |(rates, bits)| bits.seconds(rates));
            self.load.busy_s += busy;
        }
        let mut joints = false;
        match message {
            Some(Message::Joints { epoch, joints: said }) => {
                joints = true;
                self.close_epoch(at);
                let heard = BroadcastJoints { epoch, positions: said.positions };
                self.previous = self.current.replace(heard);
                self.timed.iter_mut().for_each(|timed| timed.replies.handle_joints(at, epoch));
            }
            Some(Message::Torque { from, epoch, torque }) => {
                let place = self.table.index_of(from);
                if let Some(last) = place.and_then(|place| self.last.get_mut(place)) {
                    *last = Some((at, epoch, torque));
                }
                self.timed.iter_mut().for_each(|timed| timed.replies.handle_reply(at, epoch));
            }
            Some(Message::Sum { epoch, .. }) => {
                self.timed.iter_mut().for_each(|timed| timed.replies.handle_reply(at, epoch));
            }
            Some(Message::Halt) => self.halted = true,
            Some(Message::Resume) => self.halted = false,
            Some(_) | None => {}
        }
        // Joints begin an epoch, whichever node sent them.
        self.table.handle_read_frame(at, joints, &received, &mut |_| None);
        message
    }

    pub(crate) fn restart_counters(&mut self) {
        self.table.reset_counts();
    }

    /// Returns the number of all losses so far, of any kind.
    pub(crate) fn loss_count(&self) -> u64 {
        let (replies, uplink) = (self.table.reply_counts(), self.table.uplink());
        replies.late + replies.missing + uplink.lost + uplink.rejected + self.dropped
    }

    /// Completes the epoch before new joints: stores the sum of the torques received, and the torque computed
    /// centrally, which is unknown while a cell is touched whose sensor values are unknown.
    fn close_epoch(&mut self, at: Micros) {
        let Some(heard) = self.current else { return };
        let frames = self.central.link_frames(&heard.positions);
        let cells = self.table.presumed_sensors(at).map(|(sensors, status)| {
            let is_touched = matches!(status, CellStatus::Active | CellStatus::Stale);
            sensors.or_else(|| (!is_touched).then(SkinSensors::default))
        });
        let sensors: Option<Vec<_>> = cells.collect();
        let central = sensors
            .map_or([f64::NAN; MAX_JOINTS], |sensors| self.central.total_torque(&frames, &sensors).torque);
        let distributed = self.table.snapshot().sums.torque;
        for ((torque, distributed), central) in self.torques.iter_mut().zip(distributed).zip(central) {
            *torque = (distributed, central);
        }
    }

    /// Sets the time, by which cells become silent and the load is measured. Returns the notices since the last call.
    pub(crate) fn handle_time(&mut self, now: Micros) -> Vec<Notice> {
        self.table.handle_time(now);
        self.timed.iter_mut().for_each(|timed| timed.replies.handle_time(now));
        let notices = self.table.drain_notices().collect();
        for ((_, status), since) in self.table.statuses(now).zip(&mut self.dead_since) {
            match status {
                CellStatus::Dead => _ = since.get_or_insert(now),
                CellStatus::Unknown | CellStatus::Quiet | CellStatus::Active | CellStatus::Stale => {
                    *since = None
                }
            }
        }
        let since = *self.load.since.get_or_insert(now);
        let passed = now.0.saturating_sub(since.0);
        if passed >= LOAD_WINDOW_US {
            #[expect(clippy::cast_precision_loss, reason = "a few seconds")]
            let share = self.load.busy_s / (passed as f64 * 1e-6);
            self.load = BusLoad { since: Some(now), busy_s: 0.0, share: Some(share) };
        }
        notices
    }

    pub(crate) const fn set_state(&mut self, is_up: bool, dropped: u64) {
        (self.is_up, self.dropped) = (is_up, dropped);
    }

    /// Sets whether frames take time on the bus, so that their time stamps are their ends. `bus` is its index in the skin.
    pub(crate) fn set_timed(&mut self, skin: &Skin, bus: usize, is_timed: bool) {
        if is_timed != self.timed.is_some() {
            self.timed = is_timed.then(|| {
                let bound = self.rates.and_then(|rates| fit::last_reply_bound_us(skin, bus, rates));
                Box::new(TimedBus {
                    replies: ReplyTimes::default(),
                    last_reply_bound_us: bound,
                    figures: None,
                })
            });
        }
    }

    /// Sets the figures of the server of a timed bus. Load and upper bound follow its bit rates.
    pub(crate) fn set_figures(&mut self, skin: &Skin, bus: usize, figures: TimedReport) {
        let Some(timed) = &mut self.timed else { return };
        if let Ok(rates) = figures.rates.parse()
            && self.rates != Some(rates)
        {
            self.rates = Some(rates);
            timed.last_reply_bound_us = fit::last_reply_bound_us(skin, bus, rates);
        }
        timed.figures = Some(figures);
    }

    /// Returns what only a timed bus has; `None` on a bus on which frames take no time.
    pub(crate) fn timed(&self) -> Option<&TimedBus> {
        self.timed.as_deref()
    }

    pub(super) const fn rates(&self) -> Option<BitRates> {
        self.rates
    }

    pub(crate) const fn bus_load(&self) -> Option<f64> {
        self.load.share
    }

    pub(crate) fn cell(&self, node: CellId) -> Option<&CellState> {
        self.table.cells().get(self.table.index_of(node)?)
    }

    pub(crate) fn sensors(&self, node: CellId, now: Micros) -> Option<SkinSensors> {
        self.table.presumed_sensors(now).nth(self.table.index_of(node)?)?.0
    }

    /// Returns the distributed and the central torque of each joint of the chain, NaN while they are unknown.
    pub(crate) fn joint_torques(&self) -> impl Iterator<Item = (f64, f64)> {
        self.torques.into_iter().take(self.joints)
    }

    /// Returns the position of a joint of the chain in rad or m; `None` before the first joints.
    pub(crate) fn joint_position(&self, joint: usize) -> Option<f64> {
        self.central.joint_positions(&self.current?.positions).get(joint).copied()
    }

    /// Returns the joint positions that were broadcast in one of the last two epochs; `None` for another epoch.
    pub(crate) fn joint_positions_in(&self, epoch: Epoch) -> Option<[Q1_14; MAX_JOINTS]> {
        let both = [self.current, self.previous];
        both.into_iter().flatten().find(|heard| heard.epoch == epoch).map(|heard| heard.positions)
    }

    /// Encodes the state of each cell as a snapshot contains it.
    pub(crate) fn encode_cells(&self, now: Micros) -> Vec<[u8; 8]> {
        let cells = self.table.cells().iter().zip(self.table.presumed_sensors(now)).enumerate();
        let bytes = cells.map(|(place, (cell, (sensors, status)))| {
            let view = CellView::new(cell, status);
            let flags = [
                (view.unconfigured, flag::UNCONFIGURED_BIT),
                (view.seen && view.other_configuration, flag::OTHER_CONFIGURATION_BIT),
                (view.measures, flag::MEASURING_BIT),
                (view.halted, flag::HALTED_BIT),
                (cell.is_stuck(), flag::STUCK_BIT),
            ];
            let flags = flags.iter().filter(|(is, _)| *is).fold(0, |all, (_, bit)| all | bit);
            let sensors = sensors.unwrap_or_default();
            let force =
                clamped_integer(self.central.cell_force(place, &sensors) * 1e3, 0.0, f64::from(u16::MAX));
            let proximity = clamped_integer(sensors.proximity.to_f64() * 32_768.0, 0.0, f64::from(u16::MAX));
            let [warmth, _] =
                sensors.temperature.map(|word| clamped_integer(word.to_f64() * 100.0, -32_768.0, 32_767.0));
            let [f0, f1, ..] = force.to_le_bytes();
            let [p0, p1, ..] = proximity.to_le_bytes();
            let [t0, t1, ..] = warmth.to_le_bytes();
            [status.number(), flags, f0, f1, p0, p1, t0, t1]
        });
        bytes.collect()
    }
}

/// Rounds to the nearest integer between `min` and `max`.
#[expect(clippy::cast_possible_truncation, reason = "within 17 bits")]
fn clamped_integer(value: f64, min: f64, max: f64) -> i32 {
    value.round().clamp(min, max) as i32
}
