//! Result of a commissioning as a table, as JSON, and in notes.

use std::collections::BTreeMap;

use bench::commission::CommissionedBus;
use model::commission::{CellReport, Outcome, Report, UnknownNode};
use protocol::id::CellId;
use protocol::usage::Failure;
use serde::Serialize;

use crate::print::{KeyValueTable, abbreviate_names, count_with_noun};

/// Maximum number of cells with other node ids that get a line each.
const MAX_CELL_LINES: usize = 8;

/// Result of a commissioning over all buses, as printed.
#[derive(Debug, Serialize)]
pub(super) struct CommissionResult<'a> {
    pub(super) skin: &'a str,
    #[serde(skip)]
    pub(super) file: &'a str,
    #[serde(rename = "duration_s")]
    pub(super) seconds: f64,
    pub(super) dry_run: bool,
    pub(super) interrupted: bool,
    pub(super) buses: Vec<DisplayedBus<'a>>,
}

/// Result of commissioning the cells of one bus, as printed.
#[derive(Debug, Serialize)]
pub(super) struct DisplayedBus<'a> {
    name: &'a str,
    kind: &'a str,
    written: usize,
    already_so: usize,
    verified: usize,
    would_write: usize,
    failed: usize,
    requests: u64,
    repeated: u64,
    frames_dropped: u32,
    failure: Option<&'a str>,
    cells: &'a [CellReport],
    unknown_nodes: &'a [UnknownNode],
}

impl<'a> DisplayedBus<'a> {
    pub(super) fn from_bus(
        CommissionedBus { name, kind, report, failure, dropped }: &'a CommissionedBus,
    ) -> Self {
        let Report { cells, unknown_nodes, requests, repeated, trouble: _ } = report;
        let count = |is: fn(&Outcome) -> bool| cells.iter().filter(|cell| is(&cell.outcome)).count();
        Self {
            name,
            kind,
            written: count(|it| *it == Outcome::Written),
            already_so: count(|it| *it == Outcome::AlreadySo),
            verified: count(|it| *it == Outcome::Verified),
            would_write: count(|it| *it == Outcome::WouldWrite),
            failed: count(|it| matches!(it, Outcome::Failed(_))),
            requests: *requests,
            repeated: *repeated,
            frames_dropped: *dropped,
            failure: failure.as_deref(),
            cells,
            unknown_nodes,
        }
    }

    /// Returns the cells whose node id differs from the description, with their present ids.
    fn renumbered_cells(&self) -> impl Iterator<Item = (CellId, &CellReport)> {
        self.cells.iter().filter_map(|it| Some((it.number.filter(|&node| node != it.described)?, it)))
    }

    fn add_rows(&self, rows: &mut KeyValueTable) {
        let cells = format!("{} in the skin", count_with_noun(self.cells.len(), "cell"));
        let others = match self.unknown_nodes.len() {
            0 => String::new(),
            1 => "1 cell not in the skin, left unchanged".to_owned(),
            count => format!("{count} cells not in the skin, left unchanged"),
        };
        rows.add_section(format!("{} ({})", self.name, self.kind), cells, others);
        let compared = "read back, and compared word by word";
        rows.add_row_unless_zero("written", self.written, compared);
        let by_hash = "judged by their hash; --verify reads them back";
        rows.add_row_unless_zero("already correct", self.already_so, by_hash);
        rows.add_row_unless_zero("already correct, verified", self.verified, compared);
        rows.add_row_unless_zero("would be written", self.would_write, "");
        rows.add_row_unless_zero("failed", self.failed, "");
        // One row for each reason, whatever the number of cells.
        let mut reasons = BTreeMap::<String, Vec<String>>::new();
        for cell in self.cells {
            if let Outcome::Failed(why) = cell.outcome {
                reasons.entry(why.to_string()).or_default().push(cell.described.to_string());
            }
        }
        for (why, cells) in reasons {
            rows.add_row(format!("  {}", abbreviate_names(&cells)), why, "");
        }
        if let Some(failure) = &self.failure {
            rows.add_row("stopped by an error", failure, "");
        }
        let moved = self.renumbered_cells().count();
        rows.add_row_unless_zero(
            "with a different node id",
            moved,
            "than in the skin; --node-ids writes a copy with the actual ids",
        );
        rows.add_row_unless_zero("requests", self.requests, format!("{} retries", self.repeated));
        let why = "this program did not read them in time";
        rows.add_row_unless_zero("frames lost", self.frames_dropped, why);
    }
}

impl CommissionResult<'_> {
    /// Returns the notes that are printed beside the table.
    pub(super) fn notes(&self, has_copy: bool) -> Vec<String> {
        let file = self.file;
        let mut notes = Vec::new();
        for bus in &self.buses {
            let name = bus.name;
            let [mut unknown_nodes, mut elsewhere] = [Vec::new(), Vec::new()];
            for UnknownNode { number: node, serial, belongs } in bus.unknown_nodes {
                match belongs {
                    None => unknown_nodes.push(format!("{node} (serial number {serial})")),
                    Some(other) => elsewhere.push(format!(
                        "cell {node} on {name} (serial number {serial}) belongs to {other} according to {file}; it \
                         was left unchanged"
                    )),
                }
            }
            if !unknown_nodes.is_empty() {
                let unknown_nodes = abbreviate_names(&unknown_nodes);
                notes.push(format!(
                    "cells on {name} that are not in {file} were left unchanged: {unknown_nodes}"
                ));
            }
            notes.extend(elsewhere);
            let moved = bus.renumbered_cells().count();
            if moved > MAX_CELL_LINES {
                let copy =
                    if has_copy { "" } else { "; --node-ids FILE writes a copy of the skin with their ids" };
                notes.push(format!("{moved} cells have different node ids on {name} than in {file}{copy}"));
            } else {
                notes.extend(bus.renumbered_cells().map(|(node, CellReport { serial, described, .. })| {
                    format!("the cell with serial number {serial} has node id {node} on {name}, but {described} in {file}")
                }));
            }
        }
        notes
    }

    /// Formats the result as a table.
    pub(super) fn table(&self) -> String {
        let cells = self.buses.iter().map(|bus| bus.cells.len()).sum::<usize>();
        let ended = match (self.interrupted, self.dry_run) {
            (true, _) => "interrupted",
            (false, true) => "dry run, nothing was written",
            (false, false) => "done",
        };
        let mut rows =
            KeyValueTable::new(self.skin, format!("{cells} cells, {:.1} s, {ended}", self.seconds), "");
        self.buses.iter().for_each(|bus| bus.add_rows(&mut rows));
        rows.to_text()
    }

    /// Returns the failure with which the program ends if a cell is not commissioned. Call it after all output.
    pub(super) fn outcome(&self) -> Result<(), Failure> {
        let sum = |part: fn(&DisplayedBus<'_>) -> usize| self.buses.iter().map(part).sum::<usize>();
        let (cells, failed) = (sum(|bus| bus.cells.len()), sum(|bus| bus.failed));
        let are = if failed == 1 { "is" } else { "are" };
        let what = format!("{failed} of {cells} cells {are} not commissioned");
        if let Some(failure) = self.buses.iter().find_map(|bus| bus.failure) {
            return Err(Failure::run_error(format!("{failure}; {what}")));
        }
        match (self.interrupted, failed) {
            (_, 0) => Ok(()),
            (true, _) => {
                Err(Failure::run_error(format!("interrupted: {what}; run the command again to continue")))
            }
            (false, _) => Err(Failure::run_error(format!(
                "{what}: see the table, fix the causes and run the command again"
            ))),
        }
    }
}
