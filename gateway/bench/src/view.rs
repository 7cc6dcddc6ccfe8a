//! The state of a bus' cells that its receiver shows to the main thread and to the recorder.

use protocol::id::CellId;
use protocol::message::State;
use protocol::packet::{Epoch, WORDS};

use model::network::check::Seen;
use model::table::{Cell, SWITCHES, Said, Status, Switch};

/// The state of a bus' cells, renewed every 20 ms.
#[derive(Clone, Debug, Default)]
pub struct View {
    /// Each cell, in the bus' order.
    pub cells: Vec<CellView>,
    /// Whether any of them is to be switched to something and has not confirmed it.
    pub lacking: bool,
    /// Whether any of them may have stimuli that did not come here.
    pub unclear: bool,
    /// Commands of our own that were read back from the bus, or were lost with it.
    pub commands: u64,
    /// What is known of the network's cells, those that are not described among them; none if cells
    /// answer with their own torques.
    pub network: Vec<Seen>,
}

/// The state of one cell.
#[derive(Clone, Copy, Debug)]
pub struct CellView {
    /// Its node id.
    pub node: CellId,
    /// Whether anything was received from it.
    pub heard: bool,
    /// Whether it has fallen silent.
    pub dead: bool,
    /// Whether it can be expected to answer, unless it is halted.
    pub ready: bool,
    /// Whether it waits for a resume.
    pub halted: bool,
    /// Whether it is settled and has no parameters to compute with.
    pub unconfigured: bool,
    /// Whether it measures, so that stimuli do not touch it.
    pub measures: bool,
    /// Whether its configuration is not the skin's.
    pub other: bool,
    /// The joints that it had taken last.
    pub last_joints: Epoch,
    /// What it has sent since it was queried.
    pub said: Said,
    /// What it answers joints with, by its last report.
    pub reply: Option<[i16; WORDS]>,
    /// Ports whose link it holds down, by its last report.
    pub deaf: u8,
    /// What it is to be switched to and has not confirmed.
    pub lacks: [Option<Switch>; SWITCHES],
    /// Whether it computes with stimuli of which some may not have come here.
    pub unclear: bool,
}

impl View {
    /// The cells of a bus, with what else is known of it.
    #[must_use]
    pub fn new(cells: Vec<CellView>, commands: u64, network: Vec<Seen>) -> Self {
        let lacking = cells.iter().any(CellView::is_lacking);
        let unclear = cells.iter().any(|cell| cell.unclear);
        Self { cells, lacking, unclear, commands, network }
    }
}

impl CellView {
    /// Whether it can receive, and is to be switched to something that it has not confirmed.
    #[must_use]
    pub fn is_lacking(&self) -> bool {
        (self.ready || self.unconfigured) && self.lacks.iter().any(Option::is_some)
    }

    /// What a table knows of a cell.
    #[must_use]
    pub fn of(cell: &Cell, status: Status) -> Self {
        let state = cell.heartbeat().map(|heartbeat| heartbeat.state);
        let alive = !matches!(status, Status::Dead | Status::Unknown);
        let settled = state.filter(|state| alive && !state.has(State::CLAIMING));
        let ready = settled.is_some_and(|state| state.has(State::CONFIGURED));
        Self {
            node: cell.node,
            heard: state.is_some(),
            dead: status == Status::Dead,
            ready,
            halted: ready && !cell.is_ready(),
            unconfigured: settled.is_some() && !ready,
            measures: ready && cell.measures() == Some(true),
            other: cell.heartbeat().is_some_and(|heartbeat| heartbeat.configuration != cell.configuration),
            last_joints: cell.last_joints,
            said: cell.said(),
            reply: cell.reply,
            deaf: cell.deaf,
            lacks: cell.lacks(),
            unclear: ready && cell.has_unseen_stimuli(),
        }
    }
}
