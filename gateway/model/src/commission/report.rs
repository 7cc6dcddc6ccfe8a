//! Progress and result of the commissioning of a bus.

use protocol::id::CellId;
use serde::Serialize;

use super::task::{Stage, Task};
use super::{AbortReason, Commission, FailureReason, Outcome, Phase, is_failed};

/// The progress of a commissioning, for display.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Progress {
    /// The current activity: listening, looking for cells, writing, reading back, waiting for heartbeats.
    pub activity: &'static str,
    /// Number of described cells on this bus.
    pub cells: usize,
    /// Number of described cells that were found on the bus.
    pub found: usize,
    /// Number of described cells that are done.
    pub done: usize,
    /// Number of described cells that failed.
    pub failed: usize,
}

/// The result of one cell.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CellReport {
    /// Node id of the cell in the description.
    pub described: CellId,
    /// Node id of the cell on the bus, if it was found.
    #[serde(rename = "node")]
    pub number: Option<CellId>,
    /// Serial number of the cell.
    pub serial: u32,
    /// The result of commissioning the cell.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// A cell on this bus that the description does not have on this bus.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct UnknownNode {
    /// Node id of the cell on the bus.
    #[serde(rename = "node")]
    pub number: CellId,
    /// Serial number of the cell.
    pub serial: u32,
    /// Name of the bus on which the description has this cell, if it has it at all.
    #[serde(rename = "belongs_to", skip_serializing_if = "Option::is_none")]
    pub belongs: Option<String>,
}

/// The result of commissioning one bus.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// The described cells, in the file's order.
    pub cells: Vec<CellReport>,
    /// Cells on the bus that are not in the description, by node id; they were not written to.
    pub unknown_nodes: Vec<UnknownNode>,
    /// Number of requests, to single cells or broadcast.
    pub requests: u64,
    /// Number of repeated requests, included in `requests`.
    pub repeated: u64,
    /// The reason why the commissioning stopped early; `None` if it did not.
    pub trouble: Option<AbortReason>,
}

impl Commission {
    /// Returns the progress so far.
    #[must_use]
    pub fn progress(&self) -> Progress {
        let count = |is: &dyn Fn(&Task) -> bool| self.tasks.iter().filter(|task| is(task)).count();
        let failed = count(&|task| is_failed(task.stage));
        let doing = match self.phase {
            Phase::Listen(_) => "listening",
            Phase::Discover(_) => "looking for cells",
            Phase::Write => "writing",
            Phase::Read => "reading back",
            Phase::AwaitHeartbeats(_) => "waiting for heartbeats",
            Phase::Over => "done",
        };
        Progress {
            activity: doing,
            cells: self.tasks.len(),
            found: count(&|task| task.number.is_some()),
            done: count(&|task| task.is_done()) - failed,
            failed,
        }
    }

    /// Returns the results so far; unfinished cells are reported as stopped.
    #[must_use]
    pub fn report(&self) -> Report {
        let cell = |task: &Task| CellReport {
            described: task.described,
            serial: task.serial,
            number: task.number,
            outcome: match task.stage {
                Stage::Done(outcome) => outcome,
                Stage::Missing
                | Stage::QueryAbilities
                | Stage::Write
                | Stage::Read
                | Stage::AwaitHeartbeat(_) => Outcome::Failed(FailureReason::Stopped),
            },
        };
        let unknown_node = |(number, serial): (CellId, u32)| UnknownNode {
            number,
            serial,
            belongs: self.elsewhere.get(&serial).cloned(),
        };
        let unknown = self.address_table.owners().filter(|(_, serial)| !self.by_serial.contains_key(serial));
        Report {
            cells: self.tasks.iter().map(cell).collect(),
            unknown_nodes: unknown.map(unknown_node).collect(),
            requests: self.requests,
            repeated: self.repeated,
            trouble: self.trouble,
        }
    }
}
