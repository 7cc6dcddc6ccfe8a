//! A gateway's state of one bus: the newest data of every cell, and the running sum of their torques.
//!
//! ```text
//!   frame, time, own ─> handle_frame ─┐              ┌─> Snapshot (for a tick; of constant size)
//!               time ─> handle_time ──┴─ [BusTable] ─┴─> counters, accounts, accuracy (for the table at the end)
//! ```
//!
//! The gateway's own frames are read back from the bus, so that joints open an epoch in order with the other frames and
//! with the kernel's time stamp. Every frame costs bounded work. A new epoch and a timeout cost work per cell, in the
//! receiving thread and not in the tick.

mod accuracy;
mod cell;
mod counters;
mod delays;
mod epoch;
mod errors;
mod hear;
mod held;
mod outsiders;
mod replies;
mod root_totals;
mod sensed;
mod sent;
mod status;
mod stuck;
mod switched;

use std::collections::VecDeque;

use protocol::fixed::TorqueFormat;
use protocol::id::{CellId, Id};
use protocol::message::{Heartbeat, SkinSensors};
use protocol::packet::Epoch;
use protocol::parameters::{Events, MAX_JOINTS, Sensing};
use protocol::skin::{SafetyLimits, Skin, SkinReply};
use protocol::time::Micros;

use crate::central::CentralComputation;
use crate::network::check::ObservedCell;
use protocol::packets::PacketReader;

use epoch::Broadcast;
use held::{TorqueSumChange, q3_12_to_nm};
use outsiders::UnknownSenders;
use root_totals::RootTotals;
use switched::SwitchStates;

pub use crate::tracker::UplinkCounts;
pub use accuracy::{RoundingErrors, TorqueAccuracy};
pub use cell::{CellState, ResponseFlags};
pub use counters::{Counters, FrameEvent};
pub use delays::Delays;
pub use epoch::PositionLookup;
pub use errors::TorqueErrors;
pub use replies::Replies;
pub use root_totals::{Contributions, SumCounts};
pub use sensed::SensorFrames;
pub use status::CellStatus;
pub use switched::{SWITCH_COUNT, SwitchTarget};

/// The totals of a bus that a tick of the control loop needs. Their size does not depend on the number of cells.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BusTotals {
    /// The sum of all held torques in Nm.
    pub torque: [f64; MAX_JOINTS],
    /// Number of cells in the sum.
    pub contributing: u32,
    /// Number of epochs for which the oldest torque in the sum has had no successor.
    pub age: u32,
    /// Number of cells in contact that did not answer the last epoch.
    pub stale: u32,
    /// Number of cells that count as dead because they are silent.
    pub dead: u32,
    /// The last broadcast of this gateway that was read back from the bus.
    pub read_back: Option<Epoch>,
    /// Halts on the bus that this gateway did not send.
    pub halts: u32,
    /// Resumes on the bus that this gateway did not send.
    pub resumes: u32,
    /// Joints from another gateway that sends continuously.
    pub other_gateways: u32,
}

/// The data that a tick takes from the receiver of a bus: the totals, and the input of a central computation.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// The totals for a tick.
    pub sums: BusTotals,
    /// The sensor words of each cell, in the order of the bus's cells; updated only while torques are compared.
    pub sensors: Vec<SkinSensors>,
}

impl Snapshot {
    /// Copies another snapshot without allocating; copies the sensors only if `sensors` is true.
    pub fn copy_from(&mut self, other: &Self, sensors: bool) {
        self.sums = other.sums;
        if sensors {
            self.sensors.clone_from(&other.sensors);
        }
    }
}

/// An event to be reported at once.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Notice {
    /// A cell is silent.
    Dead(CellId),
    /// A dead cell sends again.
    Revived(CellId),
    /// A cell restarted. It is not in contact until its stimuli are sent again.
    Restarted(CellId),
    /// A cell reports another cell with its node id.
    Duplicate(CellId),
    /// The first heartbeat of a cell after its bus was lost: it may have missed frames.
    Returned(CellId),
    /// Another gateway sends on this bus.
    OtherGateway,
}

/// The state of one bus.
#[derive(Clone, Debug)]
pub struct BusTable {
    carried: BusFormat,
    safety: SafetyLimits,
    events: Events,
    central: CentralComputation,
    unquantised: CentralComputation,
    is_comparing: bool,
    cells: Vec<CellState>,
    /// For each node id, the index of the cell in `cells`.
    places: [Option<usize>; CellId::COUNT],
    packets: PacketReader,
    broadcast: Option<Broadcast>,
    /// The sums along the tree, if the cells answer with sums.
    root_totals: Option<RootTotals>,
    outsiders: UnknownSenders,
    /// True if the bus was lost since the last broadcast.
    interrupted: bool,
    /// The running sum in integer steps, so that it never drifts.
    sum: [i64; MAX_JOINTS],
    snapshot: Snapshot,
    counters: Counters,
    accuracy: TorqueAccuracy,
    /// The difference of the last closed epoch, see [`BusTable::torque_difference`].
    difference: Option<[f64; MAX_JOINTS]>,
    delays: Delays,
    notices: VecDeque<Notice>,
}

/// The torque format and the chain length of a bus.
#[derive(Clone, Debug)]
struct BusFormat {
    torque_format: TorqueFormat,
    /// Number of joints of the chain.
    joints: usize,
}

impl BusTable {
    /// Creates the table of a bus of the skin, before any frame has arrived.
    #[must_use]
    pub fn new(skin: &Skin, bus: usize) -> Self {
        let part = skin.with_cells_of_bus(bus);
        let mut places = [None; CellId::COUNT];
        let mut cells = Vec::with_capacity(part.cells.len());
        let summed = skin.buses.get(bus).is_some_and(|bus| bus.reply != SkinReply::Torque);
        for described in &part.cells {
            if let Some(place) = places.get_mut(described.node.index()) {
                *place = Some(cells.len());
            }
            let sensing = skin.buses.get(bus).map_or(Sensing::Off, |bus| bus.sensing);
            let switched = SwitchStates::new(skin.events, sensing, described.baseline);
            cells.push(CellState::new(described, &part.parameters(described), summed, switched));
        }
        let snapshot =
            Snapshot { sums: BusTotals::default(), sensors: vec![SkinSensors::default(); cells.len()] };
        Self {
            carried: BusFormat {
                torque_format: skin.buses.get(bus).map(|bus| bus.torque_format).unwrap_or_default(),
                joints: skin.joints_on_bus(bus).len(),
            },
            safety: skin.safety,
            events: skin.events,
            central: CentralComputation::new(&part),
            unquantised: CentralComputation::without_quantisation(&part),
            is_comparing: false,
            cells,
            places,
            packets: PacketReader::for_bus(skin, bus),
            broadcast: None,
            root_totals: summed.then(RootTotals::default),
            outsiders: UnknownSenders::default(),
            interrupted: false,
            sum: [0; MAX_JOINTS],
            snapshot,
            counters: Counters::default(),
            accuracy: TorqueAccuracy::default(),
            difference: None,
            delays: Delays::default(),
            notices: VecDeque::new(),
        }
    }

    /// Declares that the gateway receives only the sums of roots. The sums that other cells send then cannot be
    /// counted.
    pub fn receive_root_sums_only(&mut self) {
        self.cells
            .iter_mut()
            .filter(|cell| !cell.root)
            .for_each(|cell| cell.tracked.account.exclude_unreceived_sums());
    }

    /// Declares that [`set_root_feeds_gateway`](Self::set_root_feeds_gateway) tells for each root whether it sends its
    /// sums to the gateway; until then none does. Without this, all roots do until a tree page of theirs names another
    /// parent.
    pub fn use_root_wires_not_tree_pages(&mut self) {
        self.root_totals.iter_mut().for_each(|totals| totals.follows_wires = true);
        self.cells
            .iter_mut()
            .filter_map(|cell| cell.sums.as_mut())
            .for_each(|sums| sums.is_for_gateway = false);
    }

    /// Sets whether a root sends its sums to the gateway. If it does not, the sum of another root contains them, and
    /// the held sum is released so that it does not count twice.
    pub fn set_root_feeds_gateway(&mut self, root: CellId, feeds: bool) {
        let Some(cell) = self.cell_mut(root) else { return };
        let Some(sums) = &mut cell.sums else { return };
        sums.is_for_gateway = feeds;
        if !feeds {
            let change = cell.release_torque();
            self.apply(change);
        }
    }

    /// Starts or stops the comparison of distributed torques with central ones, from the next epoch on.
    pub const fn set_torque_comparison(&mut self, comparing: bool) {
        self.is_comparing = comparing;
    }

    /// Returns the newest data for a tick.
    #[must_use]
    pub const fn snapshot(&self) -> &Snapshot {
        &self.snapshot
    }

    /// Returns the counts of packets that all cells sent and that arrived.
    #[must_use]
    pub fn uplink(&self) -> UplinkCounts {
        self.cells.iter().map(CellState::uplink).sum()
    }

    /// Returns the cells of the bus, in the skin's order.
    #[must_use]
    pub fn cells(&self) -> &[CellState] {
        &self.cells
    }

    /// Returns the index of a cell in [`cells`](Self::cells); `None` if the skin does not have it on this bus.
    #[must_use]
    pub fn index_of(&self, cell: CellId) -> Option<usize> {
        self.places.get(cell.index()).copied().flatten()
    }

    /// Returns the counts of frames and events.
    #[must_use]
    pub const fn counters(&self) -> &Counters {
        &self.counters
    }

    /// Returns the errors of distributed torques compared with central ones.
    #[must_use]
    pub fn accuracy(&self) -> TorqueAccuracy {
        let Some(root_totals) = &self.root_totals else { return self.accuracy };
        let error = &root_totals.error;
        TorqueAccuracy {
            sums: error.single,
            sums_averaged: error.averaged,
            saturated: error.saturated,
            ..self.accuracy
        }
    }

    /// Returns the counts of sums, and of the cells due in sums; `None` on a bus whose cells answer with torques.
    #[must_use]
    pub fn sum_counts(&self) -> Option<(SumCounts, Contributions)> {
        self.root_totals.as_ref().map(|root_totals| (root_totals.counts, root_totals.contributions))
    }

    /// Returns the counts of due and received replies of all cells; on a bus with sums, of the cells in sums.
    #[must_use]
    pub fn reply_counts(&self) -> Replies {
        let Some(root_totals) = &self.root_totals else {
            return Replies::total(self.cells.iter().map(|cell| cell.replies));
        };
        let Contributions { due, in_time, late, missing, .. } = root_totals.contributions;
        Replies { due, in_time, late, missing, ..Replies::default() }
    }

    /// Returns the number of times that cells changed their parent in the tree, by the cells' own counters.
    #[must_use]
    pub fn parent_change_count(&self) -> u64 {
        self.cells.iter().filter_map(|cell| cell.pages().ports).map(|ports| u64::from(ports.changes)).sum()
    }

    /// Returns the nodes that send but are not in the skin, each with its last heartbeat.
    pub fn unknown_nodes(&self) -> impl Iterator<Item = (CellId, &Heartbeat)> {
        self.outsiders.nodes.iter().map(|(node, heartbeat)| (*node, heartbeat))
    }

    /// Returns the delays of the cells.
    #[must_use]
    pub const fn delays(&self) -> &Delays {
        &self.delays
    }

    /// Removes and returns the notices, oldest first.
    pub fn drain_notices(&mut self) -> impl Iterator<Item = Notice> {
        self.notices.drain(..)
    }

    /// Returns the cell that sends frames with this identifier.
    fn sender_mut(&mut self, id: Id) -> Option<&mut CellState> {
        self.cell_mut(id.sender()?)
    }

    fn cell_mut(&mut self, cell: CellId) -> Option<&mut CellState> {
        let place = self.index_of(cell)?;
        self.cells.get_mut(place)
    }

    /// Starts counting: earlier frames have set the state, but do not count.
    pub fn reset_counts(&mut self) {
        self.cells.iter_mut().for_each(CellState::reset_counts);
        if let Some(broadcast) = &mut self.broadcast {
            broadcast.reset_counts();
        }
        if let Some(root_totals) = &mut self.root_totals {
            *root_totals = RootTotals::default();
        }
        (self.counters, self.accuracy) = (Counters::default(), TorqueAccuracy::default());
        self.delays.reset();
        self.notices.clear();
    }

    /// Handles timeouts: cells that have been silent for too long count as dead.
    pub fn handle_time(&mut self, now: Micros) {
        for place in 0..self.cells.len() {
            let Some(cell) = self.cells.get_mut(place) else { break };
            if cell.tracked.handle_timeout(now) {
                self.snapshot.sums.dead += 1;
                self.notices.push_back(Notice::Dead(cell.node));
                let change = cell.release_torque();
                self.apply(change);
            }
        }
    }

    /// Ends the run: closes the last epoch, and ends all counting.
    pub fn finish(&mut self) {
        self.close_epoch();
        self.broadcast = None;
        if let Some(root_totals) = &mut self.root_totals {
            root_totals.finish_epochs();
        }
        for cell in &mut self.cells {
            cell.finish_counts();
        }
    }

    fn change_all_cells(&mut self, change: impl Fn(&mut CellState) -> TorqueSumChange) {
        for place in 0..self.cells.len() {
            let Some(cell) = self.cells.get_mut(place) else { break };
            let change = change(cell);
            self.apply(change);
        }
    }

    /// Adds the change of a cell's contribution to the running sum.
    fn apply(&mut self, change: TorqueSumChange) {
        for ((sum, torque), difference) in
            self.sum.iter_mut().zip(&mut self.snapshot.sums.torque).zip(change.torque)
        {
            *sum += i64::from(difference);
            *torque = q3_12_to_nm(*sum);
        }
        self.snapshot.sums.contributing =
            self.snapshot.sums.contributing.saturating_add_signed(change.contributing);
    }

    /// Returns the cells of the network for a comparison with the description: the skin's cells in its order, then the
    /// cells that the skin does not have.
    pub fn observed_cells(&self, now: Micros) -> impl Iterator<Item = ObservedCell> {
        let described = self.statuses(now).map(|(cell, status)| ObservedCell {
            node: cell.node,
            serial: Some(cell.serial),
            configuration: cell.configuration,
            heartbeat: cell.heartbeat(),
            alive: !matches!(status, CellStatus::Dead | CellStatus::Unknown),
            tree: cell.pages().tree,
            ports: cell.pages().ports,
        });
        let unknown_nodes = self.unknown_nodes().map(|(node, heartbeat)| ObservedCell {
            node,
            serial: None,
            configuration: heartbeat.configuration,
            heartbeat: Some(*heartbeat),
            alive: true,
            tree: None,
            ports: None,
        });
        described.chain(unknown_nodes)
    }

    /// Returns the number, the epoch and the time of the newest joints, which the cells are answering.
    #[must_use]
    pub fn newest_joints(&self) -> Option<(u64, Epoch, Micros)> {
        self.broadcast.as_ref().map(Broadcast::number_epoch_and_time)
    }

    /// Returns for each cell its sensor words since the newest joints, from the stimuli and pages that arrived, and its
    /// status at `now`.
    ///
    /// These words are for display. For comparisons, use [`Snapshot::sensors`], which has only words that are certain.
    pub fn presumed_sensors(&self, now: Micros) -> impl Iterator<Item = (Option<SkinSensors>, CellStatus)> {
        self.statuses(now).map(|(cell, status)| (cell.presumed_sensors(), status))
    }

    /// Returns each cell with its status at `now`.
    pub fn statuses(&self, now: Micros) -> impl Iterator<Item = (&CellState, CellStatus)> {
        let newest = self.broadcast.map(|broadcast| broadcast.number);
        self.cells.iter().map(move |cell| (cell, cell.status(now, newest)))
    }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
#[expect(clippy::cast_possible_truncation, reason = "a few steps")]
mod tests_sums;
