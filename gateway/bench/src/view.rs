//! State of a bus's cells that its receiver publishes for the main thread and the recorder.

use protocol::id::CellId;
use protocol::message::State;
use protocol::packet::{Epoch, WORDS};

use model::network::check::ObservedCell;
use model::table::{CellState, SWITCHES, Responded, Status, Switch};

/// State of a bus's cells, updated every 20 ms.
#[derive(Clone, Debug, Default)]
pub struct View {
    /// Cells in the order of the bus.
    pub cells: Vec<CellView>,
    /// True if a cell has not confirmed a switch.
    pub lacking: bool,
    /// True if a cell may hold stimuli that this gateway did not receive.
    pub unclear: bool,
    /// Number of the gateway's commands that were read back from the bus, or were lost with it.
    pub commands: u64,
    /// Cells of the network, including undescribed ones; empty if cells answer with their own torques.
    pub network: Vec<ObservedCell>,
}

/// State of one cell.
#[derive(Clone, Copy, Debug)]
pub struct CellView {
    /// Node id of the cell.
    pub node: CellId,
    /// True if a heartbeat was received from it.
    pub seen: bool,
    /// True if it has fallen silent.
    pub dead: bool,
    /// True if it can be expected to answer, unless it is halted.
    pub ready: bool,
    /// True if it waits for a resume.
    pub halted: bool,
    /// True if it owns its node id and has no parameters to compute with.
    pub unconfigured: bool,
    /// True if it measures, so that stimuli do not touch it.
    pub measures: bool,
    /// True if its configuration is not the skin's.
    pub other: bool,
    /// Epoch of the last joints that it received.
    pub last_joints: Epoch,
    /// Reports that it has sent since it was queried.
    pub responded: Responded,
    /// Reply mode by its last report, as the words of the parameter.
    pub reply: Option<[i16; WORDS]>,
    /// Ports whose link it holds down, by its last report; one bit each.
    pub deaf: u8,
    /// Switches that it has not confirmed.
    pub lacks: [Option<Switch>; SWITCHES],
    /// True if it computes with stimuli that this gateway may not have received.
    pub unclear: bool,
}

impl View {
    /// Creates the view of a bus.
    #[must_use]
    pub fn new(cells: Vec<CellView>, commands: u64, network: Vec<ObservedCell>) -> Self {
        let lacking = cells.iter().any(CellView::is_lacking);
        let unclear = cells.iter().any(|cell| cell.unclear);
        Self { cells, lacking, unclear, commands, network }
    }
}

impl CellView {
    /// Returns true if the cell can receive and has not confirmed a switch.
    #[must_use]
    pub fn is_lacking(&self) -> bool {
        (self.ready || self.unconfigured) && self.lacks.iter().any(Option::is_some)
    }

    /// Creates the view of a cell from its table entry.
    #[must_use]
    pub fn new(cell: &CellState, status: Status) -> Self {
        let state = cell.heartbeat().map(|heartbeat| heartbeat.state);
        let alive = !matches!(status, Status::Dead | Status::Unknown);
        let settled = state.filter(|state| alive && !state.has(State::CLAIMING));
        let ready = settled.is_some_and(|state| state.has(State::CONFIGURED));
        Self {
            node: cell.node,
            seen: state.is_some(),
            dead: status == Status::Dead,
            ready,
            halted: ready && !cell.is_ready(),
            unconfigured: settled.is_some() && !ready,
            measures: ready && cell.measures() == Some(true),
            other: cell.heartbeat().is_some_and(|heartbeat| heartbeat.configuration != cell.configuration),
            last_joints: cell.last_joints,
            responded: cell.responded(),
            reply: cell.reply,
            deaf: cell.ports_down,
            lacks: cell.unconfirmed_switches(),
            unclear: ready && cell.has_unseen_stimuli(),
        }
    }
}
