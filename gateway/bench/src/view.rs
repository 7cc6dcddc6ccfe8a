//! State of a bus's cells that its receiver publishes for the main thread and the recorder.

use protocol::id::CellId;
use protocol::message::State;
use protocol::packet::{Epoch, WORDS};

use model::network::check::ObservedCell;
use model::table::{CellState, CellStatus, ResponseFlags, SWITCH_COUNT, SwitchTarget};

/// State of a bus's cells, updated every 20 ms.
#[derive(Clone, Debug, Default)]
pub struct BusView {
    /// Cells in the order of the bus.
    pub cells: Vec<CellView>,
    /// True if some cell has not confirmed a switch.
    pub has_unconfirmed: bool,
    /// True if some cell may hold stimuli that this gateway did not receive.
    pub unclear: bool,
    /// Number of the gateway's commands that were read back from the bus, or were lost when the bus failed.
    pub commands: u64,
    /// Cells of the network, including those that the skin does not describe. Empty if cells answer with their own
    /// torques.
    pub network: Vec<ObservedCell>,
}

/// State of one cell.
#[derive(Clone, Copy, Debug)]
pub struct CellView {
    /// Node id of the cell.
    pub node: CellId,
    /// True if a heartbeat was received from the cell.
    pub seen: bool,
    /// True if the cell has sent nothing for so long that it counts as dead.
    pub dead: bool,
    /// True if the cell answers joints, unless it is halted.
    pub ready: bool,
    /// True if the cell is halted and waits for a resume.
    pub halted: bool,
    /// True if the cell owns its node id but has no parameters to compute with.
    pub unconfigured: bool,
    /// True if the cell measures, so that stimuli do not touch it.
    pub measures: bool,
    /// True if the cell's configuration differs from the skin's.
    pub other_configuration: bool,
    /// Epoch of the last joints that the cell received.
    pub last_joints: Epoch,
    /// Reports that the cell has sent since the last request for them.
    pub responded: ResponseFlags,
    /// Reply mode of the cell by its last report, as the words of the parameter.
    pub reply: Option<[i16; WORDS]>,
    /// Ports whose links the cell holds down, by its last report; one bit per port.
    pub ports_down: u8,
    /// Switches that the cell has not confirmed.
    pub unconfirmed_switches: [Option<SwitchTarget>; SWITCH_COUNT],
    /// True if the cell computes with stimuli that this gateway may not have received.
    pub unclear: bool,
}

impl BusView {
    /// Creates the view of a bus.
    #[must_use]
    pub fn new(cells: Vec<CellView>, commands: u64, network: Vec<ObservedCell>) -> Self {
        let lacking = cells.iter().any(CellView::has_unconfirmed_switch);
        let unclear = cells.iter().any(|cell| cell.unclear);
        Self { cells, has_unconfirmed: lacking, unclear, commands, network }
    }
}

impl CellView {
    /// Returns true if the cell can receive and has not confirmed a switch.
    #[must_use]
    pub fn has_unconfirmed_switch(&self) -> bool {
        (self.ready || self.unconfigured) && self.unconfirmed_switches.iter().any(Option::is_some)
    }

    /// Creates the view of a cell from its table entry.
    #[must_use]
    pub fn new(cell: &CellState, status: CellStatus) -> Self {
        let state = cell.heartbeat().map(|heartbeat| heartbeat.state);
        let alive = !matches!(status, CellStatus::Dead | CellStatus::Unknown);
        let settled = state.filter(|state| alive && !state.has(State::CLAIMING_NODE_ID));
        let ready = settled.is_some_and(|state| state.has(State::CONFIGURED));
        Self {
            node: cell.node,
            seen: state.is_some(),
            dead: status == CellStatus::Dead,
            ready,
            halted: ready && !cell.is_ready(),
            unconfigured: settled.is_some() && !ready,
            measures: ready && cell.is_measuring() == Some(true),
            other_configuration: cell
                .heartbeat()
                .is_some_and(|heartbeat| heartbeat.configuration != cell.configuration),
            last_joints: cell.last_joints,
            responded: cell.response_flags(),
            reply: cell.reply,
            ports_down: cell.ports_down,
            unconfirmed_switches: cell.unconfirmed_switches(),
            unclear: ready && cell.has_unseen_stimuli(),
        }
    }
}
