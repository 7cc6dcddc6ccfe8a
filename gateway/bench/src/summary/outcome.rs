//! Outcome of a run, and the halts of the robot.

use model::listing::node_id_ranges;
use serde::Serialize;

/// Maximum number of cell errors given one by one.
const MAX_REASONS: usize = 4;

/// Outcome of a run. If several variants apply, the last of them is the outcome; but a halt takes precedence over a
/// lost bus.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The run lasted its whole duration.
    #[default]
    Done,
    /// A signal ended the run early.
    Interrupted,
    /// Processes of cells failed.
    CellError,
    /// The external controller that the skin requires did not answer during the run, or was absent at the end.
    NoController,
    /// The robot was halted when the run ended.
    Halted,
    /// The run ended early, a bus was lost at its end, or its recording is incomplete.
    Failed,
}

impl Outcome {
    /// All outcomes in ascending order of precedence.
    pub const ALL: [Self; 6] =
        [Self::Done, Self::Interrupted, Self::CellError, Self::NoController, Self::Halted, Self::Failed];

    /// Exit code of a run with this outcome; 2 is wrong use.
    #[must_use]
    pub const fn exit_code(self) -> u8 {
        match self {
            Self::Done | Self::Interrupted => 0,
            Self::Failed => 1,
            Self::Halted => 3,
            Self::NoController => 4,
            Self::CellError => 5,
        }
    }
}

impl core::fmt::Display for Outcome {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Done => "done",
            Self::Interrupted => "interrupted",
            Self::CellError => "cell error",
            Self::NoController => "no controller",
            Self::Halted => "halted",
            Self::Failed => "failed",
        })
    }
}

/// An error that ended processes of cells.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct CellError {
    /// Reason that the processes gave.
    pub reason: String,
    /// Cells of the processes, by bus.
    pub cells: Vec<ErrorCells>,
}

/// Cells of one bus that ended with an error.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct ErrorCells {
    /// Name of the bus.
    pub bus: String,
    /// Node ids of the cells, in ascending order.
    pub nodes: Vec<u8>,
}

impl CellError {
    /// Number of cells that ended with this error.
    #[must_use]
    pub fn count(&self) -> usize {
        self.cells.iter().map(|cells| cells.nodes.len()).sum()
    }

    /// Returns the cells as text: `1-6, 9 on vcan0; 1 on vcan1`.
    #[must_use]
    pub fn names(&self) -> String {
        let of_bus =
            |ErrorCells { bus, nodes }: &ErrorCells| format!("{} on {bus}", node_id_ranges(nodes).join(", "));
        self.cells.iter().map(of_bus).collect::<Vec<_>>().join("; ")
    }
}

/// Describes the cells that failed in one line, with the first few reasons if `with_reasons`. Returns `None` if no cell
/// failed.
#[must_use]
pub fn cells_in_error(errors: &[CellError], with_reasons: bool) -> Option<String> {
    let each = errors.iter().take(MAX_REASONS).map(|error| match with_reasons {
        true => format!("{} ({})", error.names(), error.reason),
        false => error.names(),
    });
    let each = each.collect::<Vec<_>>().join("; ");
    let above = if with_reasons { "" } else { " (see above)" };
    let more = match errors.len().saturating_sub(MAX_REASONS) {
        0 => String::new(),
        more => format!("; add --summary FILE to see the other {more} reasons"),
    };
    let all = match errors.iter().map(CellError::count).sum() {
        0_usize => return None,
        1 => format!("1 cell ended with an error{above}"),
        count => format!("{count} cells ended with errors{above}"),
    };
    Some(format!("{all}: {each}{more}"))
}

/// A halt of the robot.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HaltSummary {
    /// Time in s since the start of the loop.
    pub at_s: f64,
    /// Number of the tick.
    pub tick: u64,
    /// Epoch of the last joints before the halt.
    pub epoch: u8,
    /// Reason of the halt.
    pub reason: String,
    /// Time of the resumption in s since the start of the loop; `None` if the halt lasted to the end.
    pub until_s: Option<f64>,
}

/// Record of a tick before a halt.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TickSummary {
    /// Number of the tick.
    pub tick: u64,
    /// Time at which the tick was due, in s since the start of the loop.
    pub time_s: f64,
    /// Lateness of the tick in µs.
    pub late_us: f64,
    /// Duration of the tick in µs.
    pub took_us: f64,
    /// Number of ticks skipped just before this one.
    pub skipped: u64,
    /// Epoch of the last joints.
    pub epoch: u8,
    /// Joint positions in rad (prismatic joints: m).
    pub q_rad: Vec<f64>,
    /// Joint velocities in rad/s (prismatic joints: m/s).
    pub qdot_rad_s: Vec<f64>,
    /// Torque on each joint from all cells in Nm (prismatic joints: N).
    pub torque_nm: Vec<f64>,
    /// True if the torque was valid, so that the controller could use it.
    pub valid: bool,
    /// Number of cells that contribute to the torque.
    pub contributing: u32,
    /// Number of epochs missed by the contributing cell whose torque is the oldest.
    pub age: u32,
    /// Number of cells in contact that missed the last epoch.
    pub stale: u32,
    /// Number of dead cells.
    pub dead: u32,
    /// Names of the lost buses.
    pub lost_buses: Vec<String>,
    /// Reason of a bad cycle; `None` if the controller had an answer.
    pub bad_cycle: Option<String>,
    /// Commanded joint velocities in rad/s (prismatic joints: m/s).
    pub command_rad_s: Vec<f64>,
    /// True if the robot was halted.
    pub halted: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::summary::Summary;

    fn error(reason: &str, nodes: &[u8]) -> CellError {
        let cells = vec![ErrorCells { bus: "vcan0".to_owned(), nodes: nodes.to_vec() }];
        CellError { reason: reason.to_owned(), cells }
    }

    /// Creates a summary in which the flagged conditions hold: controller absent, errors of cells, a halt, an
    /// interruption.
    fn summary([absent, errors, halted, interrupted]: [bool; 4]) -> Summary {
        let halt =
            HaltSummary { at_s: 1.0, tick: 500, epoch: 62, reason: "no answer".to_owned(), until_s: None };
        Summary {
            no_controller: absent.then(|| "no hello".to_owned()),
            cell_errors: if errors { vec![error("no memory", &[1, 2, 3])] } else { Vec::new() },
            halted: halted.then(|| "no answer".to_owned()),
            halts: if halted { vec![halt] } else { Vec::new() },
            interrupted,
            ..Summary::default()
        }
    }

    #[test]
    fn new_outcomes_take_the_place_of_success_only_and_the_last_line_is_the_outcomes() {
        for bits in 0..16_u8 {
            let flags = [8, 4, 2, 1].map(|bit| bits & bit != 0);
            let [absent, errors, halted, _] = flags;
            let failed = summary(flags).with_verdict(Some("a bus is lost".to_owned()));
            assert_eq!((failed.outcome, failed.outcome.exit_code()), (Outcome::Failed, 1));
            assert_eq!(failed.end_messages(true).last().unwrap(), "a bus is lost");
            let rated = summary(flags).with_verdict(None);
            let lines = rated.end_messages(true);
            let last = lines.last().map_or("", String::as_str);
            let (code, words) = match rated.outcome {
                Outcome::Halted => (3, "the robot was halted at 1.000 s"),
                Outcome::NoController => (4, "no hello"),
                Outcome::CellError => (5, "3 cells ended with errors: 1-3 on vcan0 (no memory)"),
                Outcome::Done | Outcome::Interrupted => (0, ""),
                Outcome::Failed => panic!("{flags:?}"),
            };
            assert!(last.starts_with(words) && last.is_empty() == words.is_empty(), "{flags:?}: {lines:?}");
            assert_eq!(rated.outcome.exit_code(), code);
            assert_eq!(code == 3, halted, "{flags:?}");
            assert_eq!(code == 0, !absent && !errors && !halted, "{flags:?}");
            assert_eq!(lines.len(), [absent, errors, halted].into_iter().filter(|it| *it).count());
        }
    }

    #[test]
    fn every_outcome_is_rated_above_those_before_it() {
        let codes = Outcome::ALL.map(Outcome::exit_code);
        assert_eq!(codes, [0, 0, 5, 4, 3, 1], "2 is wrong use");
        let names = Outcome::ALL.map(|outcome| serde_json::to_string(&outcome).unwrap());
        let spoken = Outcome::ALL.map(|outcome| format!("{:?}", outcome.to_string().replace(' ', "_")));
        assert_eq!(names, spoken);
    }

    #[test]
    fn errors_of_cells_are_one_line_however_many_there_are() {
        assert_eq!(cells_in_error(&[], true), None);
        let one = [error("a", &[7])];
        assert_eq!(cells_in_error(&one, true).unwrap(), "1 cell ended with an error: 7 on vcan0 (a)");
        assert_eq!(
            cells_in_error(&one, false).unwrap(),
            "1 cell ended with an error (see above): 7 on vcan0"
        );
        let many: Vec<_> = (1..=252).map(|node| error(&format!("reason {node}"), &[node])).collect();
        let line = cells_in_error(&many, true).unwrap();
        assert!(line.starts_with("252 cells ended with errors: 1 on vcan0 (reason 1); "), "{line}");
        assert!(line.ends_with("; add --summary FILE to see the other 248 reasons"), "{line}");
        assert!(line.len() < 300, "{line}");
    }
}
