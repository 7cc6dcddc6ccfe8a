//! An explanation as tables.

use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use gateway::explain::{CellExplained, Explanation, Force, Origin, Row, Total, Verdict};

/// Which part is wanted.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum What {
    /// One line a cell; a single cell in every step.
    All,
    /// These cells in every step.
    Cells,
    /// One joint, cell by cell.
    Joint,
}

/// All of it; `first` is the time of the capture's first frame.
pub(super) fn text(name: &str, epoch: u8, first: u64, explanation: &Explanation, what: What) -> String {
    let mut text = String::new();
    for bus in &explanation.buses {
        let at = seconds(bus.at_ns.saturating_sub(first));
        let halted = if bus.halted { ", halted" } else { "" };
        text += &format!(
            "{name}: joints of epoch {epoch} on {}, {at} s after the first frame{halted}\n",
            bus.bus
        );
        let mut table = table();
        let joints = (1..=bus.position_words.len()).map(|joint| format!("joint {joint}"));
        table.set_header(std::iter::once(String::new()).chain(joints));
        table
            .add_row(std::iter::once("word".to_owned()).chain(bus.position_words.iter().map(i16::to_string)));
        table.add_row(
            std::iter::once("rad".to_owned()).chain(bus.position_rad.iter().map(|rad| format!("{rad:.4}"))),
        );
        text += &right(table);
    }
    let cells = &explanation.cells;
    match (what, cells.as_slice()) {
        (What::All | What::Cells, []) => text += "\nno cell was in contact, and none answered\n",
        (What::Joint, _) => text += &joint(cells),
        (What::Cells, _) | (What::All, [_]) => {
            for cell in cells {
                text += &every_step(cell, first);
            }
        }
        (What::All, _) => text += &one_line_each(cells),
    }
    if what != What::Cells && !cells.is_empty() {
        text += &totals(&explanation.total);
    }
    if !explanation.missing.is_empty() {
        text += "\nnot known:\n";
        for line in &explanation.missing {
            text += &format!("  {line}\n");
        }
    }
    text
}

fn table() -> Table {
    let mut table = Table::new();
    table.load_style(presets::UTF8_BORDERS_ONLY).set_content_arrangement(ContentArrangement::Dynamic);
    table
}

/// The table with all columns but the first to the right.
fn right(mut table: Table) -> String {
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    format!("{table}\n")
}

#[expect(clippy::cast_precision_loss, reason = "to be read")]
fn seconds(nanos: u64) -> String {
    format!("{:.6}", nanos as f64 / 1e9)
}

#[expect(clippy::cast_precision_loss, reason = "to be read")]
fn millis(nanos: u64) -> String {
    format!("{:.3} ms", nanos as f64 / 1e6)
}

fn one_line_each(cells: &[CellExplained]) -> String {
    let mut table = table();
    let joints = cells.first().map_or(0, |cell| cell.rows.len());
    let head = ["cell", "felt N", "F_z N"].map(str::to_owned).into_iter();
    let head = head.chain((1..=joints).map(|joint| format!("Nm {joint}")));
    table.set_header(head.chain(["steps off".to_owned(), "which is".to_owned()]));
    for cell in cells {
        let newtons = |of: fn(&Force) -> f64| {
            cell.force.as_ref().map_or_else(|| "?".to_owned(), |it| format!("{:.3}", of(it)))
        };
        let head = [name(cell), newtons(|force| force.touch_n), newtons(|force| force.force_n)];
        let words = cell
            .rows
            .iter()
            .map(|row| row.word_nm.map_or_else(|| "-".to_owned(), |word| format!("{word:.4}")));
        table.add_row(head.into_iter().chain(words).chain([steps_off(&cell.rows), worst(&cell.rows)]));
    }
    format!("\nthe words of cells in contact; --cell shows one in every step\n{}", right(table))
}

fn name(cell: &CellExplained) -> String {
    format!("{} {}", cell.bus, cell.node)
}

/// The differences of a cell's words from the nearest steps.
fn steps_off(rows: &[Row]) -> String {
    let mut off: Vec<_> = rows.iter().filter_map(|row| row.difference_steps).collect();
    if off.is_empty() {
        return "?".to_owned();
    }
    off.sort_unstable_by_key(|steps| steps.abs());
    off.last().map(|steps| sign(*steps)).unwrap_or_default()
}

fn sign(steps: i32) -> String {
    if steps == 0 { "0".to_owned() } else { format!("{steps:+}") }
}

/// The verdict that asks most of the reader.
fn worst(rows: &[Row]) -> String {
    let rank = |row: &&Row| match row.verdict {
        Verdict::Unexplained => 4,
        Verdict::Open => 3,
        Verdict::Saturated => 2,
        Verdict::Rounded { .. } => 1,
        Verdict::Nearest => 0,
    };
    rows.iter().max_by_key(rank).map(|row| short(&row.verdict).to_owned()).unwrap_or_default()
}

const fn short(verdict: &Verdict) -> &'static str {
    match verdict {
        Verdict::Nearest => "exact",
        Verdict::Rounded { .. } => "16 bits",
        Verdict::Saturated => "saturated",
        Verdict::Unexplained => "NOT EXPLAINED",
        Verdict::Open => "open",
    }
}

fn long(verdict: &Verdict) -> String {
    match verdict {
        Verdict::Nearest => "the nearest step".to_owned(),
        Verdict::Rounded { jacobian_m, jacobian_steps } => {
            format!("16 bits: J = {jacobian_m:.5} m, {jacobian_steps:+.2} steps")
        }
        Verdict::Saturated => "saturated: beyond 8 Nm".to_owned(),
        Verdict::Unexplained => "NOT EXPLAINED by any J near".to_owned(),
        Verdict::Open => "not known".to_owned(),
    }
}

fn every_step(cell: &CellExplained, first: u64) -> String {
    let mut text = format!("\n{}, on the link that joint {} moves\n", name(cell), cell.joint);
    match &cell.force {
        Some(force) => text += &force_steps(force, first),
        None => text += "  felt       not known\n",
    }
    match cell.answered_after_ns {
        Some(nanos) => text += &format!("  answered   {} after the joints\n", millis(nanos)),
        None => text += "  answered   nothing\n",
    }
    text + &rows(std::slice::from_ref(cell), false)
}

fn force_steps(force: &Force, first: u64) -> String {
    let Force { contact_n: [a, b, c], proximity, touch_n, contact_threshold_n, proximity_threshold, .. } =
        *force;
    let Force { alpha_c, alpha_p_n, fused_n, force_threshold_n, force_steps, force_n, .. } = *force;
    let counts = |counts: bool| if counts { "counts" } else { "none" };
    let against = |value: f64, threshold: f64| if value < threshold { "below" } else { "not below" };
    let touch = against(touch_n, contact_threshold_n);
    let near = against(proximity, proximity_threshold);
    let fused = against(fused_n, force_threshold_n);
    let origin = origin(&force.origin, first);
    let [touch_counts, near_counts] =
        [touch_n >= contact_threshold_n, proximity >= proximity_threshold].map(counts);
    format!(
        "  felt       {a:.4} + {b:.4} + {c:.4} N, proximity {proximity:.4}: {origin}\n  \
         F_c        {touch_n:.4} N, {touch} {contact_threshold_n:.4} N: {touch_counts}\n  \
         F_p        {proximity:.4}, {near} {proximity_threshold:.4}: {near_counts}\n  \
         F_z        {alpha_c:.4} F_c + {alpha_p_n:.4} F_p = {fused_n:.6} N, {fused} {force_threshold_n:.4} N: \
         {force_n:.6} N ({force_steps} steps of 2^-16)\n"
    )
}

fn origin(origin: &Origin, first: u64) -> String {
    let at = |nanos: u64| seconds(nanos.saturating_sub(first));
    match *origin {
        Origin::Start { at_ns } => format!("it started at {} s", at(at_ns)),
        Origin::Mode { at_ns } => format!("its mode was written at {} s", at(at_ns)),
        Origin::Said { at_ns } => format!("it said so itself at {} s", at(at_ns)),
        Origin::Stimulus { at_ns, from_epoch: None, .. } => {
            format!("stimulus of {} s, from the next joints on", at(at_ns))
        }
        Origin::Stimulus { at_ns, from_epoch: Some(epoch), late } => {
            let late = if late { ", late" } else { "" };
            format!("stimulus of {} s, from epoch {epoch} on{late}", at(at_ns))
        }
    }
}

fn joint(cells: &[CellExplained]) -> String {
    if cells.is_empty() {
        return "\nno cell was in contact, and none answered\n".to_owned();
    }
    format!("\n{}", rows(cells, true))
}

/// Joints of cells, each in a line.
fn rows(cells: &[CellExplained], by_cell: bool) -> String {
    let mut table = table();
    let first = if by_cell { "cell" } else { "joint" };
    let head = [first, "J m", "J F_z Nm", "nearest", "word", "Nm", "off", "which is"];
    let force = by_cell.then_some("F_z N");
    table.set_header(head.into_iter().take(1).chain(force).chain(head.into_iter().skip(1)));
    let number = |value: Option<f64>, decimals: usize| {
        value.map_or_else(|| "?".to_owned(), |value| format!("{value:.decimals$}"))
    };
    for cell in cells {
        for row in &cell.rows {
            let first = if by_cell { name(cell) } else { row.joint.to_string() };
            let force = by_cell.then(|| number(cell.force.as_ref().map(|force| force.force_n), 3));
            let word = |word: Option<i16>| word.map_or_else(|| "-".to_owned(), |word| word.to_string());
            let rest = [
                number(row.jacobian_m, 6),
                number(row.product_nm, 6),
                word(row.nearest_word),
                word(row.word),
                row.word_nm.map_or_else(|| "-".to_owned(), |word| format!("{word:.6}")),
                row.difference_steps.map_or_else(|| "?".to_owned(), sign),
                long(&row.verdict),
            ];
            table.add_row(std::iter::once(first).chain(force).chain(rest));
        }
    }
    if let Some(column) = table.column_iter_mut().last() {
        column.set_cell_alignment(CellAlignment::Left);
    }
    let last = table.column_count().saturating_sub(1);
    for column in table.column_iter_mut().take(last).skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    format!("{table}\n")
}

fn totals(total: &[Total]) -> String {
    let mut table = table();
    table.set_header([
        "joint",
        "words",
        "words Nm",
        "products Nm",
        "central Nm",
        "words - central",
        "unrounded Nm",
    ]);
    for Total {
        joint,
        word_steps,
        words_nm,
        products_nm,
        central_nm,
        unrounded_nm,
        difference_nm,
        saturated,
        open,
    } in total
    {
        let difference = match (open, saturated) {
            (0, 0) => format!("{difference_nm:+.6}"),
            (0, saturated) => format!("{saturated} saturated"),
            (open, _) => format!("{open} not known"),
        };
        table.add_row([
            joint.to_string(),
            word_steps.to_string(),
            format!("{words_nm:.6}"),
            format!("{products_nm:.6}"),
            format!("{central_nm:.6}"),
            difference,
            format!("{unrounded_nm:.6}"),
        ]);
    }
    format!("\nthe whole skin: the frames' words added up, beside the central computation\n{}", right(table))
}
