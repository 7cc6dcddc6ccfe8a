//! The joints that a capture is searched for, and what is known of the cells at them.

use protocol::message::{Joints, SkinSensors, State};
use protocol::packet::{Epoch, Words};
use serde::Serialize;

/// The packet from which a cell's contact state is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "by")]
pub enum ContactOrigin {
    /// A start of the cell, which ends its contact.
    Start {
        /// Time of the report of the start.
        at_ns: u64,
    },
    /// A write of the cell's mode, which ends its contact.
    Mode {
        /// Time of the write in ns since 1970.
        at_ns: u64,
    },
    /// A stimulus that set the cell's sensors.
    Stimulus {
        /// Time of the stimulus.
        at_ns: u64,
        /// The epoch from which the stimulus applies; `None` for the next joints.
        from_epoch: Option<u8>,
        /// True if the stimulus came after the joints of that epoch.
        late: bool,
    },
    /// A sensors page that the cell sent.
    Said {
        /// Time of the page in ns since 1970.
        at_ns: u64,
    },
}

/// A request for the joints of one epoch.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct RequestedJoints {
    /// The epoch of the joints.
    pub epoch: Epoch,
    /// Earliest time of the joints, in ns after the time that counts as 0 s.
    pub from_ns: u64,
    /// The number of the occurrence at or after that time, from 1.
    pub occurrence: u32,
}

/// A joints packet on one bus, and the state and the answer of each cell.
#[derive(Clone, Debug)]
pub struct ObservedJoints {
    /// Time of the joints in ns since 1970.
    pub at_ns: u64,
    /// The joints.
    pub joints: Joints,
    /// True if the bus was halted at these joints.
    pub halted: bool,
    /// The cells, by their index on the bus.
    pub cells: Vec<ObservedCellState>,
}

/// The state of one cell at a joints packet.
#[derive(Clone, Debug, Default)]
pub struct ObservedCellState {
    /// The contact state of the cell, and the packet from which it is known; `None` if unknown.
    pub contact_state: Option<(SkinSensors, ContactOrigin)>,
    /// True if the cell is in test mode and obeys stimuli; `None` if it has not reported its mode.
    pub test_mode: Option<bool>,
    /// The state flags in the cell's last heartbeat.
    pub state: Option<State>,
    /// Hash of the cell's configuration; `None` if the cell has not reported it.
    pub hash: Option<u16>,
    /// The torque with which the cell answered, with its time in ns since 1970.
    pub answer: Option<(u64, Words)>,
    /// Time of the cell's torque in ns since 1970, if it arrived too late to be used.
    pub too_late: Option<u64>,
    /// Number of further torques of the cell for this epoch, which are not used.
    pub repeated: u32,
}
