//! Tables of an explained torque.

use std::collections::BTreeSet;

use analysis::explain::{
    BusExplanation, CellExplanation, ContactOrigin, ForceSteps, JointTorqueTotal, MAX_JACOBIAN_ERROR_STEPS,
    TorqueExplanation, TorqueRow, WordVerdict,
};
use protocol::fixed::TorqueFormat;
use protocol::usage::printable;
use trace::capture::seconds_since;

use crate::print::{self, format_decimals, or_else_text};

/// Selection of the parts of an explanation that are shown.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum ExplainDetail {
    /// One line per cell, or all steps if there is only one cell.
    All,
    /// All steps of the selected cells.
    Cells,
    /// One joint, cell by cell.
    Joint,
}

/// Formats the explanation. Seconds count from `zero`, in ns since 1970: the start of the run or the first frame.
pub(super) fn format_explanation(
    name: &str,
    epoch: u8,
    (zero, is_of_run): (u64, bool),
    explanation: &TorqueExplanation,
    what: ExplainDetail,
) -> String {
    let mut text = String::new();
    let name = printable(name);
    for bus in &explanation.buses {
        let at = seconds_since(zero, bus.at_ns);
        let at = if is_of_run { format!("at {at:.6} s") } else { format!("{at:.6} s after the first frame") };
        let halted = if bus.halted { ", halted" } else { "" };
        text += &format!("{name}: joints message of epoch {epoch} on {}, {at}{halted}\n", bus.bus);
        text += &positions(bus);
    }
    let cells = &explanation.cells;
    let finest = TorqueFormat::default().name();
    let is_finest = explanation.buses.iter().all(|bus| bus.torque_format == finest);
    match (what, cells.as_slice()) {
        (ExplainDetail::All | ExplainDetail::Cells, []) => {
            text += "\nno cell was in contact, and no cell answered\n"
        }
        (ExplainDetail::Joint, _) => text += &format_joint(cells),
        (ExplainDetail::Cells, _) | (ExplainDetail::All, [_]) => {
            for cell in cells {
                text += &format_cell_steps(cell, zero);
            }
        }
        (ExplainDetail::All, _) => text += &format_one_line_per_cell(cells, is_finest),
    }
    if what != ExplainDetail::Cells && !cells.is_empty() {
        text += &format_joint_totals(&explanation.total, is_finest);
    }
    if !explanation.missing.is_empty() {
        text += "\nmissing information:\n";
        for line in &explanation.missing {
            text += &format!("  {line}\n");
        }
    }
    text
}

/// Maximum number of joints side by side in a table.
const JOINTS_PER_TABLE: usize = 6;

/// Formats the joint positions that the cells of a bus received.
fn positions(bus: &BusExplanation) -> String {
    let unit = if bus.units.contains(&"m") { "rad, m" } else { "rad" };
    // Put seven joints side by side, because the last would otherwise stand alone.
    let beside =
        if bus.joints.len() == JOINTS_PER_TABLE + 1 { JOINTS_PER_TABLE + 1 } else { JOINTS_PER_TABLE };
    let words = bus.position_words.chunks(beside).zip(bus.position_rad.chunks(beside));
    let tables = bus.joints.chunks(beside).zip(words).map(|(joints, (words, positions))| {
        let line =
            |name: &str, values: Vec<String>| [name.to_owned()].into_iter().chain(values).collect::<Vec<_>>();
        let head = line("", joints.iter().map(|joint| format!("joint {joint}")).collect());
        let words = line("word", words.iter().map(i16::to_string).collect());
        let positions = positions.iter().map(|position| format!("{position:.4}")).collect();
        table(head, [words, line(unit, positions)], false)
    });
    tables.collect()
}

/// Formats a table with right-aligned columns, except for the first column and, if it holds text, the last. The columns
/// are close together, so that the table fits on 80 columns.
fn table(head: Vec<String>, rows: impl IntoIterator<Item = Vec<String>>, words_at_the_end: bool) -> String {
    format_spaced_table(head, rows, words_at_the_end, 1)
}

/// Formats such a table with at least `spaces` spaces before each number.
fn format_spaced_table(
    head: Vec<String>,
    rows: impl IntoIterator<Item = Vec<String>>,
    words_at_the_end: bool,
    spaces: u16,
) -> String {
    let count = head.len();
    let numbers = |index| index > 0 && index < count.saturating_sub(usize::from(words_at_the_end));
    let mut table = print::table(head, rows, numbers);
    for (index, column) in table.column_iter_mut().enumerate() {
        let before = if numbers(index) { spaces } else { 1 };
        column.set_padding((before, u16::from(!numbers(index) || index + 1 == count)));
    }
    format!("{table}\n")
}

#[expect(clippy::cast_precision_loss, reason = "to be read")]
fn format_millis(nanos: u64) -> String {
    format!("{:.3} ms", nanos as f64 / 1e6)
}

/// Formats tables with one line per cell, chain by chain. A chain with many joints gets several tables.
fn format_one_line_per_cell(cells: &[CellExplanation], is_finest: bool) -> String {
    let turns = cells.iter().flat_map(|cell| &cell.rows).all(|row| row.unit == "Nm");
    let (unit, steps) =
        (if turns { " in Nm" } else { "" }, if is_finest { "2^-12" } else { "their bus's format" });
    let joints = |cell: &CellExplanation| cell.rows.iter().map(|row| row.joint).collect::<Vec<_>>();
    let tables = cells.chunk_by(|one, other| joints(one) == joints(other)).map(format_torques);
    format!(
        "\ntorque of each cell about each joint{unit}; 'steps': largest difference from the recomputed torque, in steps of {steps}. Use --cell to see a cell's whole computation\n{}{}",
        tables.collect::<String>(),
        verdict_legend(cells)
    )
}

/// Formats the torques of the cells of one chain.
fn format_torques(cells: &[CellExplanation]) -> String {
    // If all is well, the joints after those that move any of the cells have only zeros.
    let says = |cell: &CellExplanation| {
        let moved = cell.rows.iter().position(|row| row.joint == cell.joint);
        let rows = cell.rows.iter().enumerate();
        let used = rows.filter(|(at, row)| {
            moved.is_some_and(|moved| *at <= moved) || row.word.is_some_and(|word| word != 0)
        });
        used.map(|(at, _)| at + 1).max().unwrap_or_default()
    };
    let used = cells.iter().map(says).max().unwrap_or_default();
    let joints = cells.first().map_or(&[][..], |cell| cell.rows.get(..used).unwrap_or_default());
    let names = CellNames::for_cells(cells);
    let tables = joints.chunks(JOINTS_PER_TABLE).enumerate().map(|(part, joints)| {
        let is_last = (part + 1) * JOINTS_PER_TABLE >= used;
        let mut head = vec![names.column_heading()];
        head.extend((part == 0).then(|| "F_z N".to_owned()));
        head.extend(joints.iter().map(|row| format!("{} {}", row.unit, row.joint)));
        head.extend(["steps", "verdict"].iter().filter(|_| is_last).map(|&name| name.to_owned()));
        let lines = cells.iter().map(|cell| {
            let mut line = vec![names.name_of_cell(cell)];
            line.extend((part == 0).then(|| format_decimals(force_n(cell), 3, "?")));
            let rows = cell.rows.iter().skip(part * JOINTS_PER_TABLE).take(joints.len());
            line.extend(rows.map(|row| format_decimals(row.word_nm, 4, "-")));
            line.extend(
                is_last
                    .then(|| [format_largest_difference(&cell.rows), worst_verdict(&cell.rows)])
                    .into_iter()
                    .flatten(),
            );
            line
        });
        format_spaced_table(head, lines, is_last, u16::from(joints.len() < JOINTS_PER_TABLE))
    });
    tables.collect()
}

fn force_n(cell: &CellExplanation) -> Option<f64> {
    cell.force.as_ref().map(|force| force.force_n)
}

/// Names of cells in tables: the node id, with the bus's name if there are several buses.
struct CellNames(Option<String>);

impl CellNames {
    fn for_cells(cells: &[CellExplanation]) -> Self {
        let bus = cells.first().map(|cell| &cell.bus);
        Self(bus.filter(|bus| cells.iter().all(|cell| cell.bus == **bus)).cloned())
    }

    fn column_heading(&self) -> String {
        self.0.clone().unwrap_or_else(|| "cell".to_owned())
    }

    fn name_of_cell(&self, cell: &CellExplanation) -> String {
        if self.0.is_some() { cell.node.to_string() } else { name(cell) }
    }
}

fn name(cell: &CellExplanation) -> String {
    format!("{} {}", cell.bus, cell.node)
}

/// Formats the largest difference between the words of a cell and the nearest steps.
fn format_largest_difference(rows: &[TorqueRow]) -> String {
    // Take the last one of equally large differences.
    let most = rows.iter().filter_map(|row| row.difference_steps).max_by_key(|steps| steps.abs());
    or_else_text(most.map(format_signed_steps), "?")
}

fn format_signed_steps(steps: i32) -> String {
    if steps == 0 { "0".to_owned() } else { format!("{steps:+}") }
}

/// Returns the rank of a verdict by importance, its name, and an explanation if it needs one.
fn verdict_info(verdict: &WordVerdict) -> (u8, &'static str, Option<String>) {
    match verdict {
        WordVerdict::Nearest => (0, "nearest", Some("the word is the step nearest to J F_z".to_owned())),
        WordVerdict::Rounded { .. } => {
            let means = "a Jacobian J that is off by 16-bit rounding gives the word; J with a number: by these \
                         steps of 2^-14 m";
            (1, "16 bits", Some(means.to_owned()))
        }
        WordVerdict::Saturated => {
            let means = "J F_z is beyond the range of the torque format, so the word is at its limit";
            (2, "saturated", Some(means.to_owned()))
        }
        WordVerdict::Open => (3, "unknown", None),
        WordVerdict::Unexplained => {
            let means = format!(
                "no Jacobian J within the allowed error gives this word ({MAX_JACOBIAN_ERROR_STEPS} steps, \
                 and one more for each row after the sixth)"
            );
            (4, "NOT EXPLAINED", Some(means))
        }
    }
}

/// Returns the name of the most important verdict among these rows.
fn worst_verdict(rows: &[TorqueRow]) -> String {
    or_else_text(rows.iter().map(|row| verdict_info(&row.verdict)).max().map(|(_, short, _)| short), "")
}

/// Returns the name of a verdict, with the Jacobian J that gives the word if the verdict is about rounding.
fn verdict_with_jacobian(verdict: &WordVerdict) -> String {
    let (_, short, _) = verdict_info(verdict);
    match verdict {
        WordVerdict::Rounded { jacobian_steps, .. } => format!("{short}: J {jacobian_steps:+.2}"),
        WordVerdict::Nearest | WordVerdict::Saturated | WordVerdict::Unexplained | WordVerdict::Open => {
            short.to_owned()
        }
    }
}

/// Explains the verdicts that occur in the last column.
fn verdict_legend(cells: &[CellExplanation]) -> String {
    let said = cells.iter().flat_map(|cell| &cell.rows).map(|row| verdict_info(&row.verdict));
    let said: BTreeSet<_> = said.collect();
    said.iter().filter_map(|(_, short, means)| Some(format!("  {short}: {}\n", means.as_ref()?))).collect()
}

fn format_cell_steps(cell: &CellExplanation, zero: u64) -> String {
    let mut text = format!("\n{}, on the link that joint {} moves\n", name(cell), cell.joint);
    match &cell.force {
        Some(force) => text += &format_force_steps(force, zero),
        None => text += "  sensors    not known\n",
    }
    match cell.answered_after_ns {
        Some(nanos) => text += &format!("  answered   {} after the joints message\n", format_millis(nanos)),
        None => text += "  answered   not at all\n",
    }
    text + &format_joint_rows(std::slice::from_ref(cell), false)
}

fn format_force_steps(force: &ForceSteps, zero: u64) -> String {
    let ForceSteps {
        contact_n: [a, b, c], proximity, touch_n, contact_threshold_n, proximity_threshold, ..
    } = *force;
    let ForceSteps { alpha_c, alpha_p_n, fused_n, force_threshold_n, force_steps, force_n, .. } = *force;
    let counts = |counts: bool| if counts { "counts" } else { "does not count" };
    let against = |value: f64, threshold: f64| if value < threshold { "below" } else { "at least" };
    let touch = against(touch_n, contact_threshold_n);
    let near = against(proximity, proximity_threshold);
    let fused = against(fused_n, force_threshold_n);
    let origin = format_force_origin(&force.origin, zero);
    let [touch_counts, near_counts] =
        [touch_n >= contact_threshold_n, proximity >= proximity_threshold].map(counts);
    format!(
        "  sensors    contact {a:.4} + {b:.4} + {c:.4} N, proximity {proximity:.4}\n  \
         set by     {origin}\n  \
         contact    F_c = {touch_n:.4} N, {touch} its threshold of {contact_threshold_n:.4} N: {touch_counts}\n  \
         proximity  F_p = {proximity:.4}, {near} its threshold of {proximity_threshold:.4}: {near_counts}\n  \
         force      F_z = {alpha_c:.4} F_c + {alpha_p_n:.4} F_p = {fused_n:.6} N, {fused} its threshold of \
         {force_threshold_n:.4} N\n  \
         in steps   {force_steps} of 2^-16 N = {force_n:.6} N\n"
    )
}

fn format_force_origin(origin: &ContactOrigin, zero: u64) -> String {
    let at = |nanos: u64| format!("{:.6}", seconds_since(zero, nanos));
    match *origin {
        ContactOrigin::Start { at_ns } => format!("its start at {} s", at(at_ns)),
        ContactOrigin::Mode { at_ns } => format!("the write of its mode at {} s", at(at_ns)),
        ContactOrigin::Said { at_ns } => format!("its own report at {} s", at(at_ns)),
        ContactOrigin::Stimulus { at_ns, from_epoch: None, .. } => {
            format!("the stimulus at {} s, in effect from the next joints message on", at(at_ns))
        }
        ContactOrigin::Stimulus { at_ns, from_epoch: Some(epoch), late } => {
            let late = if late { ", late" } else { "" };
            format!("the stimulus at {} s, in effect from epoch {epoch} on{late}", at(at_ns))
        }
    }
}

fn format_joint(cells: &[CellExplanation]) -> String {
    if cells.is_empty() {
        return "\nno cell was in contact, and no cell answered\n".to_owned();
    }
    format!("\n{}", format_joint_rows(cells, true))
}

/// Formats a table with one line per joint of each cell.
fn format_joint_rows(cells: &[CellExplanation], by_cell: bool) -> String {
    let names = CellNames::for_cells(cells);
    let first = if by_cell { names.column_heading() } else { "joint".to_owned() };
    let mut head = vec![first];
    head.extend(by_cell.then(|| "F_z,\nN".to_owned()));
    head.extend(
        ["J", "J F_z,\nNm", "nearest\nword", "word\nsent", "sent,\nNm", "steps\noff", "verdict"]
            .map(str::to_owned),
    );
    let line = |cell: &CellExplanation, row: &TorqueRow| {
        let mut line = vec![if by_cell { names.name_of_cell(cell) } else { joint_name(row.joint, row.unit) }];
        line.extend(by_cell.then(|| format_decimals(force_n(cell), 2, "?")));
        line.extend([
            format_decimals(row.jacobian_m, 6, "?"),
            format_decimals(row.product_nm, 6, "?"),
            or_else_text(row.nearest_word, "-"),
            or_else_text(row.word, "-"),
            format_decimals(row.word_nm, 6, "-"),
            or_else_text(row.difference_steps.map(format_signed_steps), "?"),
            verdict_with_jacobian(&row.verdict),
        ]);
        line
    };
    let lines = cells.iter().flat_map(|cell| cell.rows.iter().map(move |row| (cell, row)));
    table(head, lines.map(|(cell, row)| line(cell, row)), true) + &verdict_legend(cells)
}

/// Returns the number of a joint, with its unit if the joint is prismatic: the column's head names the unit of the
/// others.
fn joint_name(joint: u8, unit: &str) -> String {
    if unit == "Nm" { joint.to_string() } else { format!("{joint} ({unit})") }
}

fn format_joint_totals(total: &[JointTorqueTotal], is_finest: bool) -> String {
    // Words of a coarser format are added in steps of the finest one.
    let words = if is_finest { "words" } else { "x 2^-12" };
    let head = ["joint", words, "Nm", "products Nm", "central Nm", "difference", "unrounded Nm"];
    let lines = total.iter().map(|it| {
        let difference = match (it.open, it.saturated) {
            (0, 0) => format!("{:+.6}", it.difference_nm),
            (0, saturated) => format!("{saturated} saturated"),
            (open, _) => format!("{open} not known"),
        };
        let [words, products] = [it.words_nm, it.products_nm].map(|nm| format!("{nm:.6}"));
        let [central, unrounded] = [it.central_nm, it.unrounded_nm].map(|nm| format!("{nm:.6}"));
        vec![
            joint_name(it.joint, it.unit),
            it.word_steps.to_string(),
            words,
            products,
            central,
            difference,
            unrounded,
        ]
    });
    format!(
        "\ntorques of the whole skin: sum of the words in the frames, and central computation\n{}",
        table(head.map(str::to_owned).to_vec(), lines, false)
    )
}
