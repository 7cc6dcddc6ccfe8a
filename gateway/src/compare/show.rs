//! Result of a comparison as text and as JUnit.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use analysis::compare::{
    COMPARED_ASPECTS, CaptureFigures, CaptureSide, CompareReport, ComparedCellRow, FirstDifference,
    PerCapture, ReplyCounts,
};
use protocol::quantiles::Quantiles;
use protocol::usage::printable;

use crate::junit::{Outcome, TestCase, TestSuite};
use crate::print::{
    abbreviate_names, comma_separated, count_with_noun, format_decimals, limit_width_to, or_else_text, table,
};

/// Width of the tables in columns.
const TABLE_WIDTH: u16 = 80;
/// Maximum number of cells in the table.
const MAX_LISTED_CELLS: usize = 8;

/// Description of one of the compared captures: its name, its format and its files.
#[derive(Debug)]
pub(super) struct CaptureNames<'a> {
    pub(super) name: &'a str,
    pub(super) format: &'static str,
    pub(super) files: &'a [PathBuf],
}

/// Result of a comparison with its inputs, to be printed.
#[derive(Debug)]
pub(super) struct ComparisonText<'a> {
    pub(super) inputs: PerCapture<CaptureNames<'a>>,
    /// Path given by the option `--skin`.
    pub(super) skin: Option<&'a Path>,
    pub(super) report: &'a CompareReport,
}

impl ComparisonText<'_> {
    /// Formats the verdict, the tables and the first difference.
    pub(super) fn text(&self) -> String {
        let mut text = format!("{}\n", self.verdict());
        for (letter, about) in [("A", &self.inputs.a), ("B", &self.inputs.b)] {
            let _ = writeln!(text, "{letter}  {} ({})", printable(about.name), about.format);
        }
        text += &self.table();
        text += &self.differing_cells_text();
        if let Some(first) = &self.report.first {
            text += &self.first_difference_text(first);
        }
        text
    }

    fn verdict(&self) -> String {
        let CompareReport { epochs, torques, sums, first, .. } = self.report;
        if self.report.equal {
            let tolerated = torques.tolerated + sums.tolerated + self.report.joints.tolerated;
            let within = if tolerated > 0 { " within the tolerance" } else { "" };
            let mut all = vec![count_with_noun(epochs.compared, "epoch")];
            let replies = [(torques, "torque"), (sums, "sum")];
            all.extend(
                replies
                    .iter()
                    .map(|(it, name)| (it.equal + it.tolerated, name))
                    .filter(|(count, _)| *count > 0)
                    .map(|(number, name)| count_with_noun(number, name)),
            );
            return format!("equal{within}: {}", comma_separated(all));
        }
        if epochs.compared == 0 {
            return "different: the two runs have no epoch in common".to_owned();
        }
        let at = first.as_ref().map(|first| {
            let time = first.time_s.a.or(first.time_s.b);
            let time = time.map_or_else(String::new, |time| format!(" ({time:.3} s)"));
            format!("; first at epoch {}{time}", first.epoch)
        });
        format!("different: {}{}", comma_separated(&self.report.differs), or_else_text(at, ""))
    }

    fn table(&self) -> String {
        let CompareReport {
            captures: PerCapture { a, b },
            epochs,
            joints,
            halts,
            contacts,
            torques,
            sums,
            ..
        } = self.report;
        let mut rows = Vec::new();
        let mut row = |name: &str, a: String, b: String, both: String| {
            rows.push(vec![name.to_owned(), a, b, both]);
        };
        let none = String::new;
        row("epochs", a.epochs.to_string(), b.epochs.to_string(), format!("{} in both", epochs.compared));
        for (name, a, b, both) in [
            ("  missing", epochs.missing_in_a, epochs.missing_in_b, "present in the other run"),
            ("  before the other", epochs.before.only_a, epochs.before.only_b, "not compared"),
            ("  after the other", epochs.after.only_a, epochs.after.only_b, "not compared"),
            ("  halted", halts.only_a, halts.only_b, "only one of the two was halted"),
        ] {
            if a + b > 0 {
                row(name, a.to_string(), b.to_string(), both.to_owned());
            }
        }
        row("last epoch, s", format_decimals(a.last_s, 3, "-"), format_decimals(b.last_s, 3, "-"), none());
        let only_joints = ReplyCounts {
            equal: joints.equal,
            tolerated: joints.tolerated,
            different: joints.different,
            max_steps: joints.max_steps,
            ..ReplyCounts::default()
        };
        row("joints messages", none(), none(), replies_text(&only_joints));
        let touched = [contacts.only.only_a, contacts.only.only_b].map(|only| contacts.both + only);
        let [in_a, in_b] = touched.map(|touched| touched.to_string());
        row("touched cells, summed over epochs", in_a, in_b, format!("{} in both", contacts.both));
        for (name, replies, a, b) in
            [("torques", torques, a.torques, b.torques), ("sums", sums, a.sums, b.sums)]
        {
            if a + b == 0 {
                continue;
            }
            row(name, a.to_string(), b.to_string(), replies_text(replies));
            if replies.missing_count() > 0 {
                let [a, b] = [replies.missing_in_a, replies.missing_in_b].map(|it| it.to_string());
                row("  missing", a, b, "present in the other run".to_owned());
            }
        }
        let at = |of: fn(&Quantiles) -> f64, source: &CaptureFigures| {
            format_decimals(source.reply_us.as_ref().map(of), 0, "-")
        };
        let information = || "not compared".to_owned();
        row("reply time, 50 %, µs", at(|it| it.p50, a), at(|it| it.p50, b), information());
        row("reply time, 99 %, µs", at(|it| it.p99, a), at(|it| it.p99, b), information());
        for (name, of) in [
            ("late replies", (|it| it.late) as fn(&CaptureFigures) -> u64),
            ("lost packets", |it| it.lost),
            ("restarts of cells", |it| it.restarts),
            ("frames not recorded", |it| it.dropped),
            ("joints messages out of order", |it| it.out_of_order),
            ("epoch count restarted", |it| it.countings.saturating_sub(1).into()),
        ] {
            if of(a) + of(b) > 0 {
                row(name, of(a).to_string(), of(b).to_string(), information());
            }
        }
        let table = table(["", "A", "B", "compared"], rows, |column| column == 1 || column == 2);
        let table = limit_width_to(table, TABLE_WIDTH);
        format!("{table}\n")
    }

    /// Formats the table of cells that differ, and the names of cells that only one capture has.
    fn differing_cells_text(&self) -> String {
        let differs = |row: &&ComparedCellRow| row.replies.different + row.replies.missing_count() > 0;
        let mut cells: Vec<_> = self.report.cells.iter().filter(differs).collect();
        let total = cells.len();
        cells.sort_by_key(|row| std::cmp::Reverse(row.replies.different + row.replies.missing_count()));
        let mut text = String::new();
        if total > 0 {
            let rows = cells.iter().take(MAX_LISTED_CELLS).map(|row| {
                let ReplyCounts { different, missing_in_a, missing_in_b, max_steps, .. } = row.replies;
                let numbers = [different, u64::from(max_steps), missing_in_a, missing_in_b];
                let name = format!("{}:{}", row.bus, row.node);
                [name].into_iter().chain(numbers.map(|number| number.to_string())).collect::<Vec<_>>()
            });
            let head = ["cell", "different", "max steps", "missing in A", "missing in B"];
            let table = limit_width_to(table(head, rows, |column| column > 0), TABLE_WIDTH);
            let _ = writeln!(text, "{table}");
            if total > MAX_LISTED_CELLS {
                let _ = writeln!(
                    text,
                    "and {}; --json lists all",
                    count_with_noun(total - MAX_LISTED_CELLS, "further cell")
                );
            }
        }
        for (letter, only_in) in [("A", "a"), ("B", "b")] {
            let cells = self.report.extra_cells.iter().filter(|cell| cell.only_in == only_in);
            let names: Vec<_> = cells.map(|cell| format!("{}:{}", cell.bus, cell.node)).collect();
            if !names.is_empty() {
                let _ = writeln!(text, "cells only in {letter}: {}", printable(&abbreviate_names(&names)));
            }
        }
        text
    }

    /// Describes the first difference, and names commands that show more.
    fn first_difference_text(&self, first: &FirstDifference) -> String {
        let FirstDifference { what, bus, epoch, number, time_s, words, values, .. } = first;
        let cell = first.cell.map_or_else(String::new, |cell| format!(" of cell {cell}"));
        let joint = first.joint.map_or_else(String::new, |joint| format!(", joint {joint}"));
        let mut text = format!(
            "first difference: {what}{cell} on {}{joint}, epoch {epoch} (broadcast {number})\n",
            printable(bus)
        );
        for (letter, which) in [("A", CaptureSide::A), ("B", CaptureSide::B)] {
            let is_missing = first.how == format!("missing in {}", letter.to_lowercase());
            let unit = first.unit.unwrap_or_default();
            let has = match (words.get(which), values.get(which)) {
                (Some(word), Some(value)) => format!("word {word}, {value:.4} {unit}"),
                _ if is_missing => "nothing".to_owned(),
                _ => match *what {
                    "torque" | "sum" => "a reply".to_owned(),
                    "contact" => "touched".to_owned(),
                    "halt" => "halted".to_owned(),
                    _ => "a joints message".to_owned(),
                },
            };
            let time = time_s.get(which).map_or_else(String::new, |time| format!("{time:.3} s  "));
            let _ = writeln!(text, "  {letter}  {time}{has}");
        }
        if let Some(steps) = first.steps {
            let _ = writeln!(text, "  the difference is {}", count_with_noun(steps, "step"));
        }
        if first.cell.is_some() && *what != "contact" {
            let inputs = match (first.inputs.as_slice(), first.unknown_inputs.as_slice()) {
                ([], []) => "the inputs are the same: joints, halt, stimulus, configuration".to_owned(),
                ([], unknown) => {
                    format!(
                        "the known inputs are the same; not in the captures: {}",
                        comma_separated(unknown)
                    )
                }
                (inputs, []) => format!("different inputs: {}", comma_separated(inputs)),
                (inputs, unknown) => {
                    format!(
                        "different inputs: {}; not in the captures: {}",
                        comma_separated(inputs),
                        comma_separated(unknown)
                    )
                }
            };
            let _ = writeln!(text, "  {inputs}");
        }
        if let Some(hint) = self.tolerance_hint(first) {
            let _ = writeln!(text, "  {hint}");
        }
        for which in [CaptureSide::A, CaptureSide::B] {
            if let Some(line) = self.explain_command(first, which) {
                let _ = writeln!(text, "  {line}");
            }
        }
        text
    }

    /// Returns the options that would accept a difference like the first one, if any.
    fn tolerance_hint(&self, first: &FirstDifference) -> Option<&'static str> {
        match (first.what, first.steps) {
            ("joints", Some(_)) => Some(
                "the motion depends on the times of the control loop's ticks: use kind = \"hold\" in the \
                 scenario, or accept differences with --joints-tolerance and --tolerance",
            ),
            ("torque" | "sum" | "joints", None) if first.how.starts_with("missing") => Some(
                "on a busy machine, cells skip joints messages that they receive too late: --allow-missing N \
                 accepts N missing replies",
            ),
            _ => None,
        }
    }

    /// Returns the command that shows more about the joints of the first difference.
    fn explain_command(&self, first: &FirstDifference, which: CaptureSide) -> Option<String> {
        let occurrence = (*first.occurrence.get(which))?;
        let about = self.inputs.get(which);
        let names = about.files.iter().map(|file| printable(&file.display().to_string()).into_owned());
        let mut line =
            format!("skinbus explain {} --epoch {}", names.collect::<Vec<_>>().join(" "), first.epoch);
        if occurrence > 1 {
            let _ = write!(line, " --occurrence {occurrence}");
        }
        if let Some(cell) = first.cell {
            let _ = write!(line, " --cell {}:{cell}", printable(&first.bus));
        }
        match self.skin {
            Some(skin) => _ = write!(line, " --skin {}", printable(&skin.display().to_string())),
            None if about.format != "MCAP" => line += " --skin SKIN",
            None => {}
        }
        Some(line)
    }

    /// Returns a JUnit report with a test case for each aspect of the comparison.
    pub(super) fn junit(&self, took: Duration) -> TestSuite {
        let first =
            self.report.first.as_ref().map(|first| self.first_difference_text(first)).unwrap_or_default();
        let cases = COMPARED_ASPECTS.into_iter().map(|aspect| {
            let outcome = match self.report.differs.contains(&aspect) {
                false => Outcome::Passed,
                true => Outcome::Failed { message: self.failure_text(aspect), text: first.clone() },
            };
            TestCase { class: "skinbus.compare".to_owned(), name: aspect.to_owned(), outcome }
        });
        TestSuite {
            name: format!("{} and {}", self.inputs.a.name, self.inputs.b.name),
            seconds: took.as_secs_f64(),
            cases: cases.collect(),
        }
    }

    /// Describes the differences of one aspect in one line.
    fn failure_text(&self, aspect: &str) -> String {
        let CompareReport { epochs, joints, halts, contacts, torques, sums, extra_cells, .. } = self.report;
        let missing = |a, b| format!("{a} missing in A, {b} in B");
        match aspect {
            "epochs" if epochs.compared == 0 => "the two runs have no epoch in common".to_owned(),
            "epochs" => missing(epochs.missing_in_a, epochs.missing_in_b),
            "joints" => format!("{} different, at most {} steps", joints.different, joints.max_steps),
            "halts" => format!("{} only in A, {} only in B", halts.only_a, halts.only_b),
            "contacts" => format!("{} only in A, {} only in B", contacts.only.only_a, contacts.only.only_b),
            "cells" => count_with_noun(extra_cells.len(), "extra cell"),
            _ => {
                let replies = if aspect == "sums" { sums } else { torques };
                format!("{}, {}", replies_text(replies), missing(replies.missing_in_a, replies.missing_in_b))
            }
        }
    }
}

/// Formats the numbers of equal and different replies.
fn replies_text(replies: &ReplyCounts) -> String {
    let ReplyCounts { equal, tolerated, different, open, max_steps, .. } = *replies;
    let mut all = vec![format!("{equal} equal")];
    for (count, what) in [(tolerated, "tolerated"), (different, "different"), (open, "undecided")] {
        if count > 0 {
            all.push(format!("{count} {what}"));
        }
    }
    if max_steps > 0 {
        all.push(format!("max {max_steps} steps"));
    }
    comma_separated(all)
}
