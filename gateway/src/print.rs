//! Formatting of values for output: lists, rows, tables, JSON.

use std::borrow::Cow;
use std::fmt::Display;

use comfy_table::{Cell, CellAlignment, Color, ColumnConstraint, ContentArrangement, Table, Width, presets};
use protocol::quantiles::Quantiles;
use protocol::usage::{Failure, printable, printable_lines};
use serde::Serialize;

/// Colours of a terminal, and the code that ends them.
pub(crate) const RED: &str = "\x1b[31m";
pub(crate) const GREEN: &str = "\x1b[32m";
pub(crate) const YELLOW: &str = "\x1b[33m";
pub(crate) const RESET_COLOUR: &str = "\x1b[0m";

/// Indent of a name that is kept when the name takes two lines.
const NAME_INDENT: &str = "\u{a0}";
/// Bounds of the width of a table in columns.
const MIN_TABLE_WIDTH: u16 = 40;
const MAX_TABLE_WIDTH: u16 = 110;
/// Maximum width of a row's name in one line.
const MAX_NAME_WIDTH: u16 = 36;
/// Maximum number of names in a line. Of more names, the first few are shown with the total number.
const MAX_NAMES_IN_LINE: usize = 12;

/// Formats a value as JSON in several lines.
pub(crate) fn to_pretty_json(value: &impl Serialize) -> Result<String, Failure> {
    serde_json::to_string_pretty(value).map(|text| escape_controls(text) + "\n").map_err(Failure::run_error)
}

/// Formats a value as JSON in one line.
pub(crate) fn json_line(value: &impl Serialize) -> Result<String, Failure> {
    serde_json::to_string(value).map(|text| escape_controls(text) + "\n").map_err(Failure::run_error)
}

/// Replaces terminal control characters in the strings of a JSON text by JSON escapes such as `\u009b`.
pub(crate) fn escape_controls(json: String) -> String {
    // JSON text has line feeds of its own, but no tabs.
    if matches!(printable_lines(&json), Cow::Borrowed(_)) {
        return json;
    }
    let letter = |letter: char| match printable_lines(letter.encode_utf8(&mut [0; 4])) {
        Cow::Borrowed(same) => same.to_owned(),
        Cow::Owned(_) => format!("\\u{:04x}", u32::from(letter)),
    };
    json.chars().map(letter).collect()
}

/// Joins items with commas.
pub(crate) fn comma_separated(items: impl IntoIterator<Item: Display>) -> String {
    join_items(", ", items)
}

/// Joins items with spaces.
pub(crate) fn space_separated(items: impl IntoIterator<Item: Display>) -> String {
    join_items(" ", items)
}

fn join_items(between: &str, items: impl IntoIterator<Item: Display>) -> String {
    items.into_iter().map(|item| item.to_string()).collect::<Vec<_>>().join(between)
}

/// Joins all names, or the first few of many names with the total number.
pub(crate) fn abbreviate_names(names: &[String]) -> String {
    let few = names.get(..MAX_NAMES_IN_LINE).filter(|_| names.len() > MAX_NAMES_IN_LINE);
    few.map_or_else(
        || comma_separated(names),
        |few| format!("{}, ... ({} in all)", comma_separated(few), names.len()),
    )
}

/// Formats a count with its noun.
pub(crate) fn count_with_noun(count: impl TryInto<u64>, one: &str) -> String {
    let count = count.try_into().unwrap_or(u64::MAX);
    match one {
        _ if count == 1 => format!("1 {one}"),
        "bus" | "touch" => format!("{count} {one}es"),
        _ => format!("{count} {one}s"),
    }
}

/// Formats a value, or returns the text for an absent one.
pub(crate) fn or_else_text(value: Option<impl Display>, none: &str) -> String {
    value.map_or_else(|| none.to_owned(), |value| value.to_string())
}

/// Formats a number with this many decimals, or returns the text for an absent one.
pub(crate) fn format_decimals(value: Option<f64>, decimals: usize, none: &str) -> String {
    or_else_text(value.map(|value| format!("{value:.decimals$}")), none)
}

/// Formats the quantiles 50 %, 90 % and 99 %, and the maximum, or says that nothing was measured.
pub(crate) fn format_quantiles(quantiles: &Quantiles) -> String {
    let Quantiles { p50, p90, p99, max, count } = quantiles;
    if *count == 0 {
        return "none".to_owned();
    }
    format!("{p50:.0} / {p90:.0} / {p99:.0} / {max:.0}")
}

/// Table with a border and right-aligned numeric columns, as wide as the terminal at most. Texts in rows are [`shown`]; a header may have several lines.
pub(crate) fn table<H: Into<String>>(
    head: impl IntoIterator<Item = H>,
    rows: impl IntoIterator<Item = Vec<String>>,
    is_of_numbers: impl Fn(usize) -> bool,
) -> Table {
    let mut table = Table::new();
    table.load_style(presets::UTF8_BORDERS_ONLY).set_content_arrangement(ContentArrangement::Dynamic);
    match readable_width(table.width()) {
        Some(columns) => table.set_width(columns),
        None => table.force_no_tty(),
    };
    table.set_header(head.into_iter().map(|head| printable_lines(&head.into()).into_owned()));
    table.add_rows(
        rows.into_iter().map(|row| row.iter().map(|text| printable(text).into_owned()).collect::<Vec<_>>()),
    );
    for (index, column) in table.column_iter_mut().enumerate() {
        if is_of_numbers(index) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table
}

/// Returns the width of a terminal in which tables can be read; `None` if it is unknown, as of a terminal of 0 columns.
pub(crate) fn readable_width(terminal: Option<u16>) -> Option<u16> {
    terminal.filter(|columns| *columns > 0).map(|columns| columns.max(MIN_TABLE_WIDTH))
}

/// Limits a table to the width of the terminal, and to a readable width.
pub(crate) fn limit_width(table: Table) -> Table {
    limit_width_to(table, MAX_TABLE_WIDTH)
}

/// Limits a table to the width of the terminal, and to `max` columns.
pub(crate) fn limit_width_to(mut table: Table, max: u16) -> Table {
    let width = table.width().map_or(max, |width| width.min(max));
    table.set_width(width);
    table
}

/// Returns the columns in which any row has a value, and the texts of each row; `nothing` stands for a missing value.
pub(crate) fn drop_empty_columns<H, T, F: Fn(&T) -> Option<String>>(
    columns: impl IntoIterator<Item = (H, F)>,
    rows: &[T],
    nothing: &str,
) -> (Vec<H>, Vec<Vec<String>>) {
    let mut heads = Vec::new();
    let mut lines = vec![Vec::new(); rows.len()];
    for (head, text) in columns {
        let column: Vec<_> = rows.iter().map(text).collect();
        if column.iter().any(Option::is_some) {
            heads.push(head);
            for (line, text) in lines.iter_mut().zip(column) {
                line.push(or_else_text(text, nothing));
            }
        }
    }
    (heads, lines)
}

/// A table with three columns: names, values, and values for comparison.
pub(crate) struct KeyValueTable {
    table: Table,
    /// Width of a name in one line.
    name_width: Option<usize>,
}

impl KeyValueTable {
    /// Creates a table of [limited width](limit_width) with this header and no rows.
    pub(crate) fn new(name: impl Display, value: impl Display, beside: impl Display) -> Self {
        Self::with_terminal_width(None, name, value, beside)
    }

    /// Creates the table for a terminal of this width; `None` detects the width.
    pub(crate) fn with_terminal_width(
        columns: Option<u16>,
        name: impl Display,
        value: impl Display,
        beside: impl Display,
    ) -> Self {
        let mut table = table(printable_row(name, value, beside), [], |_| false);
        if let Some(columns) = columns {
            table.set_width(columns);
        }
        let mut table = limit_width(table);
        let width = (table.width().unwrap_or(MAX_TABLE_WIDTH) * 2 / 5).min(MAX_NAME_WIDTH);
        if let Some(names) = table.column_mut(0) {
            names.set_constraint(ColumnConstraint::ContentWidth);
        }
        Self { table, name_width: Some(usize::from(width)) }
    }

    /// Keeps names in one line, however narrow the terminal is.
    pub(crate) fn names_in_one_line(mut self) -> Self {
        self.name_width = None;
        if let Some(names) = self.table.column_mut(0) {
            names.set_constraint(ColumnConstraint::ContentWidth);
        }
        self
    }

    /// Enables or disables colours.
    pub(crate) fn with_colours(mut self, is_coloured: bool) -> Self {
        self.table.force_no_tty();
        if is_coloured {
            self.table.enforce_styling();
        }
        self
    }

    /// Width of the table in columns.
    pub(crate) fn width_in_columns(&self) -> usize {
        self.table.width().unwrap_or(MAX_TABLE_WIDTH).into()
    }

    /// Breaks names into lines of this width.
    pub(crate) const fn with_name_width(mut self, letters: usize) -> Self {
        self.name_width = Some(letters);
        self
    }

    /// Formats the table.
    pub(crate) fn to_text(&self) -> String {
        format!("{}\n", self.table).replace(NAME_INDENT, " ")
    }

    pub(crate) fn add_section(&mut self, name: impl Display, value: impl Display, beside: impl Display) {
        let [name, value, beside] = printable_row(name, value, beside);
        self.table.add_row([fold_name(&name, self.name_width), value, beside]);
    }

    pub(crate) fn add_row(&mut self, name: impl Display, value: impl Display, beside: impl Display) {
        self.add_section(format!("  {name}"), value, beside);
    }

    /// Adds a row whose last text is coloured if colours are enabled ([`with_colours`](KeyValueTable::with_colours)).
    pub(crate) fn add_coloured_row(
        &mut self,
        name: impl Display,
        value: impl Display,
        beside: impl Display,
        colour: Color,
    ) {
        let [name, value, beside] = printable_row(format!("  {name}"), value, beside);
        let name = Cell::new(fold_name(&name, self.name_width));
        self.table.add_row([name, Cell::new(value), Cell::new(beside).fg(colour)]);
    }

    /// Adds a row whose last text is kept in one line.
    pub(crate) fn add_row_in_one_line(&mut self, name: impl Display, value: impl Display, beside: &str) {
        self.add_row(name, value, beside);
        let width = u16::try_from(beside.chars().count() + 2).unwrap_or(MAX_TABLE_WIDTH);
        if let Some(texts) = self.table.column_mut(2) {
            texts.set_constraint(ColumnConstraint::LowerBoundary(Width::Fixed(width)));
        }
    }

    pub(crate) fn add_row_unless_zero(
        &mut self,
        name: impl Display,
        count: impl TryInto<u64>,
        beside: impl Display,
    ) {
        if let Some(count) = count.try_into().ok().filter(|&count| count > 0) {
            self.add_row(name, count, beside);
        }
    }
}

/// Returns the texts of a row, made safe for terminals by [`shown`].
fn printable_row(name: impl Display, value: impl Display, beside: impl Display) -> [String; 3] {
    [name.to_string(), value.to_string(), beside.to_string()].map(|text| printable(&text).into_owned())
}

/// Breaks a text into lines of `columns` columns. The first line begins with `begin`; the others are indented by its
/// width.
pub(crate) fn hanging_indent(begin: &str, text: &str, columns: usize) -> String {
    let indent = begin.chars().count();
    let lines = fold_name(&format!("{}{text}", " ".repeat(indent)), Some(columns)).replace(NAME_INDENT, " ");
    format!("{begin}{}", lines.get(indent..).unwrap_or_default())
}

/// Breaks a name into lines of this width; all lines but the first are indented further. Longer words are broken too.
fn fold_name(name: &str, width: Option<usize>) -> String {
    let words = name.trim_start_matches(' ');
    let indent = name.len() - words.len();
    let mut folded = NAME_INDENT.repeat(indent);
    let (mut taken, mut is_first) = (indent, true);
    let begin_line = |folded: &mut String| {
        folded.push('\n');
        folded.push_str(&NAME_INDENT.repeat(indent + 2));
        indent + 2
    };
    for word in words.split(' ') {
        let letters = word.chars().count();
        if !is_first && width.is_some_and(|width| taken + 1 + letters > width) {
            taken = begin_line(&mut folded);
        } else if !is_first {
            folded.push(' ');
            taken += 1;
        }
        for letter in word.chars() {
            if width.is_some_and(|width| taken >= width.max(indent + 8)) {
                taken = begin_line(&mut folded);
            }
            folded.push(letter);
            taken += 1;
        }
        is_first = false;
    }
    folded
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_terminal_without_columns_says_nothing_about_the_width() {
        let widths = [None, Some(0), Some(7), Some(60)].map(readable_width);
        assert_eq!(widths, [None, None, Some(40), Some(60)]);
    }

    #[test]
    fn a_long_text_hangs_under_its_begin() {
        assert_eq!(
            hanging_indent("problems: ", "a few words of it", 20),
            "problems: a few\n            words of\n            it"
        );
        assert_eq!(hanging_indent("", "a few words", 80), "a few words");
    }

    #[test]
    fn a_long_name_is_folded_between_words_and_keeps_its_indent() {
        let of =
            |width| fold_name("  joints not yet taken at heartbeats, µs", width).replace(NAME_INDENT, ".");
        assert_eq!(of(None), "..joints not yet taken at heartbeats, µs");
        assert_eq!(of(Some(24)), "..joints not yet taken\n....at heartbeats, µs");
        assert_eq!(
            of(Some(4)),
            "..joints\n....not\n....yet\n....taken\n....at\n....heartb\n....eats,\n....µs"
        );
    }
}
