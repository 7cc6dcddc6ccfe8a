//! The state of a skin and its cells, computed from the frames on the buses.

pub(crate) mod bus;
mod recent;
mod replies;
mod said;

use bench::record::feed::EpochContacts;
use bench::summary::TimedReport;
use model::table::CellStatus;
use protocol::can::Frame;
use protocol::id::CellId;
use protocol::skin::Skin;
use protocol::time::Micros;

use self::bus::LiveBus;
pub use self::recent::{DecodedFrame, RecentFrames, TorqueExplanation};
pub use self::said::{
    BusStatus, CellDetail, CellParentAndWires, DeadCell, GainsAndThresholds, SensorReading, StatusMessage,
    TimedBusStatus, TorqueReply, TransmitQueues,
};
use crate::pressed::{CellKey, TouchRegistry};
use protocol::message::{Message, SkinSensors};

/// The state of a skin and its cells, as the frames on the buses show it.
#[derive(Clone, Debug)]
pub struct LiveState {
    skin: Skin,
    buses: Vec<LiveBus>,
    /// For each cell of the skin: the index of its bus, and the index of the cell on that bus.
    places: Vec<(usize, usize)>,
    number: u32,
    /// The time of the first frame; `None` before it.
    began: Option<Micros>,
    /// The index of the bus whose joints count as epochs: the first bus on which joints were received.
    clock: Option<usize>,
    recent: RecentFrames,
}

/// The contact state of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CellContact {
    /// The index of the cell's bus.
    pub bus: usize,
    /// The node id of the cell.
    pub node: CellId,
    /// True if the cell is touched.
    pub is_touched: bool,
    /// True if the cell is dead.
    pub is_dead: bool,
    /// The force on the cell in N; `None` if it is unknown or the cell is dead.
    pub force_n: Option<f64>,
}

/// The bits that describe a cell in a snapshot.
mod flag {
    pub(super) const UNCONFIGURED_BIT: u8 = 1;
    pub(super) const OTHER_CONFIGURATION_BIT: u8 = 2;
    pub(super) const MEASURING_BIT: u8 = 4;
    pub(super) const HALTED_BIT: u8 = 8;
    pub(super) const PRESSED_BIT: u8 = 16;
    pub(super) const STUCK_BIT: u8 = 32;
}

/// Removes torques if any of them is NaN, which means that they are unknown.
pub(crate) fn clear_if_unknown(torques: &mut Vec<f64>) {
    if torques.iter().any(|torque| torque.is_nan()) {
        torques.clear();
    }
}

impl LiveState {
    /// Creates the state of a skin of which no frame has been received yet.
    #[must_use]
    pub fn new(skin: Skin) -> Self {
        let buses: Vec<_> = (0..skin.buses.len()).map(|bus| LiveBus::new(&skin, bus)).collect();
        let mut next = vec![0; buses.len()];
        let places = skin.cells.iter().map(|cell| {
            let place = next.get_mut(cell.bus).map_or(0, |next| std::mem::replace(next, *next + 1));
            (cell.bus, place)
        });
        let recent = RecentFrames::new(&skin);
        Self { places: places.collect(), skin, buses, number: 0, began: None, clock: None, recent }
    }

    /// Creates the state of a skin of which no frame has been received yet. Times count from `began`.
    #[must_use]
    pub fn with_start_time(skin: Skin, began: Micros) -> Self {
        Self { began: Some(began), ..Self::new(skin) }
    }

    /// Returns the skin.
    #[must_use]
    pub const fn skin(&self) -> &Skin {
        &self.skin
    }

    /// Applies frames that were latched when a recording began, each with the index of its bus. They are not counted.
    pub fn apply_latched_frames<'a>(
        &mut self,
        at: Micros,
        latched: impl Iterator<Item = (usize, &'a Frame)>,
    ) {
        for (index, frame) in latched {
            if let Some(bus) = self.buses.get_mut(index) {
                let _ = bus.apply_frame(at, frame);
                self.recent.push(at, index, frame);
            }
        }
        self.buses.iter_mut().for_each(LiveBus::restart_counters);
    }

    /// Applies a frame of the bus with this index. Returns true if the frame begins an epoch.
    pub fn apply_frame(&mut self, bus: usize, at: Micros, frame: &Frame) -> bool {
        self.began.get_or_insert(at);
        let Some(of) = self.buses.get_mut(bus) else { return false };
        let joints = matches!(of.apply_frame(at, frame), Some(Message::Joints { .. }));
        self.recent.push(at, bus, frame);
        if joints {
            self.clock = Some(self.clock.map_or(bus, |clock| clock.min(bus)));
        }
        joints && self.clock == Some(bus)
    }

    /// Drops the stored frames of the last seconds, which the page lists for a cell.
    pub fn forget_recent_frames(&mut self) {
        self.recent.clear();
    }

    /// Returns for each bus the number of all losses so far, and true if the bus is halted.
    pub fn losses_and_halted_by_bus(&self) -> impl Iterator<Item = (u64, bool)> {
        self.buses.iter().map(|bus| (bus.loss_count(), bus.halted))
    }

    /// Returns the contact state of each cell, bus by bus. A cell is touched if its sensors show it, or if its torque
    /// does while the sensor values are unknown.
    pub fn cell_contacts(&self, now: Micros) -> impl Iterator<Item = CellContact> {
        self.buses.iter().enumerate().flat_map(move |(index, bus)| {
            let cells = bus.table.cells().iter().zip(bus.table.presumed_sensors(now)).enumerate();
            cells.map(move |(place, (cell, (sensors, status)))| {
                let is_active = matches!(status, CellStatus::Active | CellStatus::Stale);
                let is_dead = status == CellStatus::Dead;
                let force_n = sensors.map(|sensors| bus.central.cell_force(place, &sensors));
                CellContact {
                    bus: index,
                    node: cell.node,
                    is_touched: force_n.map_or(is_active, |force_n| force_n > 0.0),
                    is_dead,
                    force_n: force_n.filter(|_| !is_dead),
                }
            })
        })
    }

    /// Returns the load of each bus; `None` before it was measured.
    pub fn bus_loads(&self) -> impl Iterator<Item = Option<f64>> {
        self.buses.iter().map(LiveBus::bus_load)
    }

    /// Returns for each bus the longest time in ms from joints to a reply to them, of the replies between the last two
    /// joints; `None` without a reply, and on a bus on which frames take no time.
    pub fn longest_reply_ms_by_bus(&self) -> impl Iterator<Item = Option<f64>> {
        self.buses.iter().map(|bus| bus.timed()?.replies.longest_of_epoch_ms())
    }

    /// Returns true if any bus is halted.
    #[must_use]
    pub fn is_halted(&self) -> bool {
        self.buses.iter().any(|bus| bus.halted)
    }

    /// Returns two torques for each joint of the robot in the last completed epoch, in Nm or N: the distributed and the
    /// central one. Both are NaN while no bus of the joint has completed an epoch, and the central one while a touched
    /// cell's sensor values are unknown.
    #[must_use]
    pub fn joint_torques(&self) -> Vec<[f64; 2]> {
        self.joint_positions_and_torques()
            .into_iter()
            .map(|[_, distributed, central]| [distributed, central])
            .collect()
    }

    /// Returns three values for each joint of the robot: position, distributed torque and central torque. A value is NaN
    /// while it is unknown. For torques, buses that have not completed an epoch do not count.
    pub(crate) fn joint_positions_and_torques(&self) -> Vec<[f64; 3]> {
        let mut rows = vec![[f64::NAN; 3]; self.skin.robot.joints.len()];
        for (index, bus) in self.buses.iter().enumerate() {
            for ((place, (joint, _)), torque) in
                self.skin.joints_on_bus(index).enumerate().zip(bus.joint_torques())
            {
                let Some([position, distributed, central]) = rows.get_mut(joint) else { continue };
                *position = bus.joint_position(place).unwrap_or(*position);
                if torque.0.is_nan() {
                    continue;
                }
                let others = if distributed.is_nan() { (0.0, 0.0) } else { (*distributed, *central) };
                (*distributed, *central) = (others.0 + torque.0, others.1 + torque.1);
            }
        }
        rows
    }

    /// Returns the number of the newest joints on a bus, and the contacts of its cells since then.
    pub(crate) fn newest_contacts(&self, bus: usize) -> Option<(u64, EpochContacts)> {
        let table = &self.buses.get(bus)?.table;
        let (number, epoch, at) = table.newest_joints()?;
        let cells = table.presumed_sensors(at).collect();
        Some((number, EpochContacts { at_nanos: at.0 * 1_000, epoch: epoch.0, cells }))
    }

    /// Returns true if the joints of a bus count as epochs.
    pub(crate) fn is_clock(&self, bus: usize) -> bool {
        self.clock == Some(bus)
    }

    /// Returns the number of cells with a force above zero.
    pub(crate) fn active_cell_count(&self) -> usize {
        let forces = self.buses.iter().flat_map(|bus| {
            let sensors = bus.table.cells().iter().enumerate();
            sensors.map(|(place, cell)| {
                bus.central.cell_force(place, &cell.presumed_sensors().unwrap_or_default())
            })
        });
        forces.filter(|force| *force > 0.0).count()
    }

    /// Returns three values of a bus: true if it works, the number of its cells, and the number of silent ones.
    pub(crate) fn bus_health(&self, bus: usize, now: Micros) -> (bool, usize, usize) {
        let Some(bus) = self.buses.get(bus) else { return (false, 0, 0) };
        let is_silent = |status| matches!(status, CellStatus::Unknown | CellStatus::Dead);
        let silent = bus.table.statuses(now).filter(|(_, status)| is_silent(*status)).count();
        (bus.is_up, bus.table.cells().len(), silent)
    }

    /// Sets the state of a bus: whether it is open and works, and the number of frames that this program did not
    /// receive.
    pub fn set_bus_state(&mut self, bus: usize, is_up: bool, dropped: u64) {
        if let Some(bus) = self.buses.get_mut(bus) {
            bus.set_state(is_up, dropped);
        }
    }

    /// Sets whether frames take time on a bus, so that their time stamps are their ends.
    pub fn set_bus_timed(&mut self, bus: usize, is_timed: bool) {
        if let Some(of) = self.buses.get_mut(bus) {
            of.set_timed(&self.skin, bus, is_timed);
        }
    }

    /// Sets the figures that the server of a timed bus reports.
    pub fn set_bus_figures(&mut self, bus: usize, figures: TimedReport) {
        if let Some(of) = self.buses.get_mut(bus) {
            of.set_figures(&self.skin, bus, figures);
        }
    }

    /// Sets the time, by which cells become silent and loads are measured.
    pub fn handle_time(&mut self, now: Micros) {
        self.buses.iter_mut().for_each(|bus| drop(bus.handle_time(now)));
    }

    /// Returns true if a cell may be pressed: it belongs to the skin and has reported test mode.
    #[must_use]
    pub fn is_pressable(&self, (bus, node): CellKey) -> bool {
        let cell = self.buses.get(bus).and_then(|bus| bus.cell(node));
        cell.is_some_and(|cell| cell.is_measuring() == Some(false))
    }

    /// Returns the sensor values of the stimulus that a cell has latched, as far as the frames on the bus show it.
    #[must_use]
    pub fn latched_sensors(&self, (bus, node): CellKey, now: Micros) -> Option<SkinSensors> {
        self.buses.get(bus)?.sensors(node, now)
    }

    /// Encodes the next snapshot: the time, the state of each joint, and the state of each cell.
    ///
    /// | bytes | content |
    /// |---|---|
    /// | 4 | its number, u32 |
    /// | 4 | joints J of the robot, u32 |
    /// | 4 | cells, u32 |
    /// | 4 | 0: a snapshot |
    /// | 8 | seconds of the run, or since the first frame, f64 |
    /// | 12 J | for each joint: position (rad or m), distributed and central torque (Nm or N), NaN while unknown, f32 |
    /// | 8 for each cell | status u8, flags u8, force mN u16, proximity 2^-15 u16, temperature 0.01 °C i16 |
    ///
    /// All values are little-endian. The torques are those of the last completed epoch. Status: 0 never heard, 1 quiet,
    /// 2 active, 3 stale, 4 dead. Flags: 1 without parameters, 2 with parameters other than the skin's, 4 measures,
    /// 8 halted, 16 pressed by a page, 32 stuck.
    pub fn snapshot(&mut self, now: Micros, pressed: &TouchRegistry) -> Vec<u8> {
        self.number = self.number.wrapping_add(1);
        let joints = self.skin.robot.joints.len();
        let count = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
        let mut bytes = Vec::with_capacity(24 + 12 * joints + 8 * self.places.len());
        for word in [self.number, count(joints), count(self.places.len()), 0] {
            bytes.extend(word.to_le_bytes());
        }
        bytes.extend(self.seconds_since_start(now).to_le_bytes());
        for value in self.joint_positions_and_torques().into_iter().flatten() {
            #[expect(clippy::cast_possible_truncation, reason = "to be drawn")]
            bytes.extend((value as f32).to_le_bytes());
        }
        let shown: Vec<Vec<_>> = self.buses.iter().map(|bus| bus.encode_cells(now)).collect();
        for (cell, &(bus, place)) in self.skin.cells.iter().zip(&self.places) {
            let Some(mut cell_bytes) = shown.get(bus).and_then(|bus| bus.get(place)).copied() else {
                continue;
            };
            if pressed.is_pressed((bus, cell.node)) {
                cell_bytes[1] |= flag::PRESSED_BIT;
            }
            bytes.extend(cell_bytes);
        }
        bytes
    }

    #[expect(clippy::cast_precision_loss, reason = "2^53 us are 285 years")]
    fn seconds_since_start(&self, at: Micros) -> f64 {
        let since = |began: Micros| at.0.saturating_sub(began.0) as f64 - began.0.saturating_sub(at.0) as f64;
        self.began.map_or(0.0, |began| since(began) * 1e-6)
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "words are exact")]
mod tests;
