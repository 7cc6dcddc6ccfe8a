//! What became of a commissioning, as a table, as JSON, and in lines for people.

use std::collections::BTreeMap;

use bench::commission::Done;
use model::commission::{CellReport, Outcome, Stranger};
use protocol::usage::Failure;
use serde::Serialize;

use crate::print::{Rows, some};

/// Cells with other numbers that get a line each.
const LINES: usize = 8;

/// All of it.
#[derive(Debug, Serialize)]
pub(super) struct Whole {
    pub(super) skin: String,
    #[serde(skip)]
    pub(super) file: String,
    #[serde(rename = "duration_s")]
    pub(super) seconds: f64,
    pub(super) dry_run: bool,
    pub(super) interrupted: bool,
    pub(super) buses: Vec<BusShown>,
}

/// One bus.
#[derive(Debug, Serialize)]
pub(super) struct BusShown {
    name: String,
    kind: String,
    written: usize,
    already_so: usize,
    verified: usize,
    would_write: usize,
    failed: usize,
    requests: u64,
    repeated: u64,
    frames_dropped: u32,
    failure: Option<String>,
    cells: Vec<CellShown>,
    strangers: Vec<StrangerShown>,
}

/// One cell.
#[derive(Debug, Serialize)]
struct CellShown {
    /// In the description.
    described: u8,
    /// On the bus.
    node: Option<u8>,
    serial: u32,
    outcome: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    why: Option<String>,
}

/// A cell that the description does not have there.
#[derive(Debug, Serialize)]
struct StrangerShown {
    node: u8,
    serial: u32,
    /// The bus on which the description has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    belongs_to: Option<String>,
}

impl CellShown {
    fn of(cell: &CellReport) -> Self {
        let (outcome, why) = match cell.outcome {
            Outcome::Written => ("written", None),
            Outcome::AlreadySo => ("already so", None),
            Outcome::Verified => ("verified", None),
            Outcome::WouldWrite => ("would be written", None),
            Outcome::Failed(reason) => ("failed", Some(reason.to_string())),
        };
        let node = cell.number.map(|number| number.get());
        Self { described: cell.described.get(), node, serial: cell.serial, outcome, why }
    }
}

impl BusShown {
    pub(super) fn of(done: &Done) -> Self {
        let Done { name, kind, report, failure, dropped } = done;
        let count = |is: fn(&Outcome) -> bool| report.cells.iter().filter(|cell| is(&cell.outcome)).count();
        let stranger = |Stranger { number, serial, belongs }: &Stranger| StrangerShown {
            node: number.get(),
            serial: *serial,
            belongs_to: belongs.clone(),
        };
        Self {
            name: name.clone(),
            kind: kind.clone(),
            written: count(|it| *it == Outcome::Written),
            already_so: count(|it| *it == Outcome::AlreadySo),
            verified: count(|it| *it == Outcome::Verified),
            would_write: count(|it| *it == Outcome::WouldWrite),
            failed: count(|it| matches!(it, Outcome::Failed(_))),
            requests: report.requests,
            repeated: report.repeated,
            frames_dropped: *dropped,
            failure: failure.clone(),
            cells: report.cells.iter().map(CellShown::of).collect(),
            strangers: report.strangers.iter().map(stranger).collect(),
        }
    }

    /// Cells under another number than the description's.
    fn moved(&self) -> impl Iterator<Item = (u8, &CellShown)> {
        self.cells.iter().filter_map(|cell| Some((cell.node.filter(|&node| node != cell.described)?, cell)))
    }

    fn rows(&self, rows: &mut Rows) {
        let cells = format!("{} cells described", self.cells.len());
        let others = match self.strangers.len() {
            0 => String::new(),
            1 => "1 other, left alone".to_owned(),
            count => format!("{count} others, left alone"),
        };
        rows.section(format!("{} ({})", self.name, self.kind), cells, others);
        let compared = "read back, and compared word by word";
        rows.any("written", self.written, compared);
        rows.any("already so", self.already_so, "by their hash; --verify reads them back");
        rows.any("already so, verified", self.verified, compared);
        rows.any("would be written", self.would_write, "");
        rows.any("failed", self.failed, "");
        // One row for each reason, whatever the number of cells.
        let mut reasons = BTreeMap::<&str, Vec<String>>::new();
        for cell in &self.cells {
            if let Some(why) = &cell.why {
                reasons.entry(why).or_default().push(cell.described.to_string());
            }
        }
        for (why, cells) in reasons {
            rows.row(format!("  {}", some(&cells)), why, "");
        }
        if let Some(failure) = &self.failure {
            rows.row("ended", failure, "");
        }
        let moved = self.moved().count();
        rows.any("under another number", moved, "than in the description; --numbers writes a copy");
        rows.any("requests", self.requests, format!("{} said again", self.repeated));
        rows.any("frames lost", self.frames_dropped, "they came faster than they were read");
    }
}

impl Whole {
    /// What people should know beside the table.
    pub(super) fn notes(&self, has_copy: bool) -> Vec<String> {
        let file = &self.file;
        let mut notes = Vec::new();
        for bus in &self.buses {
            let name = &bus.name;
            let [mut strangers, mut elsewhere] = [Vec::new(), Vec::new()];
            for StrangerShown { node, serial, belongs_to } in &bus.strangers {
                match belongs_to {
                    None => strangers.push(format!("{node} (serial number {serial})")),
                    Some(other) => elsewhere.push(format!(
                        "cell {node} on {name} (serial number {serial}) belongs to {other} by {file}; left alone"
                    )),
                }
            }
            if !strangers.is_empty() {
                let strangers = some(&strangers);
                notes.push(format!("cells on {name} that {file} does not have, left alone: {strangers}"));
            }
            notes.extend(elsewhere);
            let moved = bus.moved().count();
            if moved > LINES {
                let copy = if has_copy { "" } else { "; --numbers FILE writes a copy with theirs" };
                notes.push(format!("{moved} cells have other numbers on {name} than in {file}{copy}"));
            } else {
                notes.extend(bus.moved().map(|(node, CellShown { serial, described, .. })| {
                    format!("the cell with serial number {serial} is {node} on {name}, {described} in {file}")
                }));
            }
        }
        notes
    }

    /// A table for people.
    pub(super) fn table(&self) -> String {
        let cells = self.buses.iter().map(|bus| bus.cells.len()).sum::<usize>();
        let ended = match (self.interrupted, self.dry_run) {
            (true, _) => "interrupted",
            (false, true) => "dry run, nothing was written",
            (false, false) => "done",
        };
        let mut rows = Rows::new(&self.skin, format!("{cells} cells, {:.1} s, {ended}", self.seconds), "");
        self.buses.iter().for_each(|bus| bus.rows(&mut rows));
        rows.text()
    }

    /// How it ends, when all has been shown.
    pub(super) fn end(&self) -> Result<(), Failure> {
        let sum = |part: fn(&BusShown) -> usize| self.buses.iter().map(part).sum::<usize>();
        let (cells, failed) = (sum(|bus| bus.cells.len()), sum(|bus| bus.failed));
        let are = if failed == 1 { "is" } else { "are" };
        let what = format!("{failed} of {cells} cells {are} not commissioned");
        if let Some(failure) = self.buses.iter().find_map(|bus| bus.failure.as_deref()) {
            return Err(Failure::run(format!("{failure}; {what}")));
        }
        match (self.interrupted, failed) {
            (_, 0) => Ok(()),
            (true, _) => Err(Failure::run(format!("interrupted: {what}; run it again to go on"))),
            (false, _) => {
                Err(Failure::run(format!("{what}, see the table; run it again when that is mended")))
            }
        }
    }
}
