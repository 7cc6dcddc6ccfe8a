//! The verdict on a bus: whether it can carry its traffic, in the wording that all commands share.

use std::fmt::{self, Display, Formatter};

use serde::{Serialize, Serializer};

use super::AssessedBus;
use super::limits::{ByLimit, Limit, MAX_NODES_PER_BUS};

/// The verdict on a bus: it fits, or the limit that it exceeds.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum FitVerdict {
    /// Bandwidth, deadline and number of nodes fit.
    Fits,
    /// Bandwidth and deadline fit, but the bus has this number of nodes, more than transceivers can drive.
    Nodes(u32),
    /// The load exceeds what the bus can carry.
    Bandwidth,
    /// An answer ends after the next joints.
    Deadline,
}

impl FitVerdict {
    /// Returns the verdict for a bus with this number of cells that exceeds these limits, see [`ByLimit::exceeded`].
    #[must_use]
    pub fn from_limits(exceeded: &[Limit], cells: u32) -> Self {
        match exceeded.first() {
            Some(Limit::Bandwidth) => Self::Bandwidth,
            Some(Limit::Deadline) => Self::Deadline,
            Some(Limit::Nodes) => Self::Nodes(cells.saturating_add(1)),
            None => Self::Fits,
        }
    }

    /// Returns true if the bus keeps all limits.
    #[must_use]
    pub const fn fits(self) -> bool {
        matches!(self, Self::Fits)
    }
}

impl Display for FitVerdict {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Fits => f.pad("fits"),
            Self::Nodes(nodes) => f.pad(&format!("in time, but {nodes} nodes")),
            Self::Bandwidth => f.pad("does not fit: bandwidth"),
            Self::Deadline => f.pad("does not fit: deadline"),
        }
    }
}

impl Serialize for FitVerdict {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// The cells whose answers a verdict includes.
#[derive(Clone, Copy, Debug, Eq, PartialEq, Serialize)]
#[serde(tag = "answering", rename_all = "lowercase")]
pub enum AnsweringCells {
    /// All cells of the bus.
    All {
        /// Number of cells.
        cells: u32,
    },
    /// The cells that answered in a run.
    Some {
        /// Largest number of answers in one epoch.
        most: u32,
        /// Number of cells on the bus.
        cells: u32,
        /// True if `cells` is from the skin, false if it was observed.
        described: bool,
    },
    /// The bus carries another protocol, without cells.
    Foreign,
}

impl AnsweringCells {
    /// Returns the number of cells on the bus.
    #[must_use]
    pub const fn cells_on_bus(self) -> u32 {
        match self {
            Self::All { cells } | Self::Some { cells, .. } => cells,
            Self::Foreign => 0,
        }
    }
}

impl Display for AnsweringCells {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match *self {
            Self::All { cells: 1 } => f.write_str("1 cell answers"),
            Self::All { cells } => write!(f, "all {cells} cells answer"),
            Self::Some { most, cells, described: true } => {
                write!(f, "at most {most} of {cells} cells answered")
            }
            Self::Some { most, cells, described: false } => {
                write!(f, "at most {most} of {cells} observed cells answered")
            }
            Self::Foreign => f.write_str("frames of another protocol"),
        }
    }
}

/// The load and the verdict of a bus, in the worst case or in a run.
///
/// ```
/// # use analysis::fit::verdict::{AnsweringCells, FitSummary, FitVerdict};
/// let rates = "1M/5M".to_owned();
/// let verdict = FitVerdict::Bandwidth;
/// let summary = FitSummary { load: 1.1889, rates, cells: AnsweringCells::All { cells: 253 }, verdict };
/// assert_eq!(
///     summary.to_string(),
///     "worst case: 118.9 % of 1M/5M: does not fit: bandwidth (all 253 cells answer)"
/// );
/// ```
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FitSummary {
    /// The load of the bus; for a run, in the second with the highest load.
    pub load: f64,
    /// The format and the bit rates of the bus, as text.
    pub rates: String,
    /// The cells whose answers the load includes.
    pub cells: AnsweringCells,
    /// The verdict on the bus.
    pub verdict: FitVerdict,
}

impl FitSummary {
    /// Returns the load and the verdict of a bus if all cells answer.
    #[must_use]
    pub fn worst_case(rated: &AssessedBus) -> Self {
        Self {
            load: rated.load.total(),
            rates: super::rates_name(rated.case.format, rated.case.rates),
            cells: AnsweringCells::All { cells: rated.case.answers.cells() },
            verdict: rated.verdict(),
        }
    }

    /// Returns the load and the verdict of a run. `load` is that of its busiest second, and `late` is the number of
    /// answers that ended after the next joints.
    #[must_use]
    pub fn for_run(load: f64, late: u64, rates: String, cells: AnsweringCells) -> Self {
        let on_the_bus = cells.cells_on_bus();
        let holds =
            ByLimit { bandwidth: load <= 1.0, deadline: late == 0, nodes: on_the_bus < MAX_NODES_PER_BUS };
        Self { load, rates, cells, verdict: FitVerdict::from_limits(&holds.exceeded(), on_the_bus) }
    }

    /// Returns the name of the case: the worst case, or this run.
    #[must_use]
    pub const fn case_name(&self) -> &'static str {
        match self.cells {
            AnsweringCells::All { .. } => "worst case",
            AnsweringCells::Some { .. } => "this run",
            AnsweringCells::Foreign => "this capture",
        }
    }

    /// Formats load and verdict for a row of a table.
    #[must_use]
    pub fn table_value(&self) -> String {
        format!("{}: {}", format_percent(self.load), self.verdict)
    }
}

impl Display for FitSummary {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let (load, rates) = (format_percent(self.load), &self.rates);
        write!(f, "{}: {load} of {rates}: {} ({})", self.case_name(), self.verdict, self.cells)
    }
}

/// Formats a share in %, with one decimal.
#[must_use]
pub fn format_percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn this_run(load: f64, late: u64, cells: u32) -> String {
        let cells = AnsweringCells::Some { most: 120, cells, described: true };
        FitSummary::for_run(load, late, "1M/5M".to_owned(), cells).to_string()
    }

    #[test]
    fn a_run_is_rated_by_load_then_by_late_answers_then_by_nodes() {
        let run = "this run: 55.3 % of 1M/5M";
        for (late, cells, verdict) in [
            (0, 109, "fits"),
            (0, 110, "in time, but 111 nodes"),
            (1, 109, "does not fit: deadline"),
            (1, 253, "does not fit: deadline"),
        ] {
            let expected = format!("{run}: {verdict} (at most 120 of {cells} cells answered)");
            assert_eq!(this_run(0.553, late, cells), expected);
        }
        assert!(this_run(1.001, 0, 9).contains("100.1 % of 1M/5M: does not fit: bandwidth"));
        assert!(this_run(1.0, 0, 9).contains(": fits ("));
    }
}
