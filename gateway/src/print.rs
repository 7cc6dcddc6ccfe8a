//! Output of values: words, rows, tables, JSON.

use std::borrow::Cow;
use std::fmt::Display;

use comfy_table::{Cell, CellAlignment, Color, ColumnConstraint, ContentArrangement, Table, Width, presets};
use model::quantiles::Quantiles;
use protocol::usage::{Failure, shown, shown_lines};
use serde::Serialize;

/// Colours of a terminal, and the end of them.
pub(crate) const RED: &str = "\x1b[31m";
pub(crate) const GREEN: &str = "\x1b[32m";
pub(crate) const YELLOW: &str = "\x1b[33m";
pub(crate) const PLAIN: &str = "\x1b[0m";

/// A space before a name that stays when the name takes two lines.
const INDENT: &str = "\u{a0}";
/// Columns of a table that is not on a narrower terminal.
const WIDTH: u16 = 110;
/// Letters of a row's name in one line, where there is room for more.
const NAME: u16 = 36;
/// Names in a line; of more, the first few and how many there are.
const NAMES: usize = 12;

/// A value as JSON in lines.
pub(crate) fn json(value: &impl Serialize) -> Result<String, Failure> {
    serde_json::to_string_pretty(value).map(|text| harmless(text) + "\n").map_err(Failure::run)
}

/// The same in one line.
pub(crate) fn json_line(value: &impl Serialize) -> Result<String, Failure> {
    serde_json::to_string(value).map(|text| harmless(text) + "\n").map_err(Failure::run)
}

/// JSON that says the same without characters that a terminal obeys: those that stand as they are in its strings are
/// written like `\u009b`.
pub(crate) fn harmless(json: String) -> String {
    // Its own are line feeds, and it has no tabs.
    if matches!(shown_lines(&json), Cow::Borrowed(_)) {
        return json;
    }
    let letter = |letter: char| match shown_lines(letter.encode_utf8(&mut [0; 4])) {
        Cow::Borrowed(same) => same.to_owned(),
        Cow::Owned(_) => format!("\\u{:04x}", u32::from(letter)),
    };
    json.chars().map(letter).collect()
}

/// What stands between commas.
pub(crate) fn list(items: impl IntoIterator<Item: Display>) -> String {
    joined(", ", items)
}

/// What stands between spaces.
pub(crate) fn words(items: impl IntoIterator<Item: Display>) -> String {
    joined(" ", items)
}

fn joined(between: &str, items: impl IntoIterator<Item: Display>) -> String {
    items.into_iter().map(|item| item.to_string()).collect::<Vec<_>>().join(between)
}

/// A few names, or the first of many.
pub(crate) fn some(names: &[String]) -> String {
    let few = names.get(..NAMES).filter(|_| names.len() > NAMES);
    few.map_or_else(|| list(names), |few| format!("{}, ... ({} in all)", list(few), names.len()))
}

/// So many of them.
pub(crate) fn count(count: impl TryInto<u64>, one: &str) -> String {
    let count = count.try_into().unwrap_or(u64::MAX);
    match one {
        _ if count == 1 => format!("1 {one}"),
        "bus" | "touch" => format!("{count} {one}es"),
        _ => format!("{count} {one}s"),
    }
}

/// A value, or what stands where there is none.
pub(crate) fn or(value: Option<impl Display>, none: &str) -> String {
    value.map_or_else(|| none.to_owned(), |value| value.to_string())
}

/// A number with so many decimals, or what stands where there is none.
pub(crate) fn decimals(value: Option<f64>, decimals: usize, none: &str) -> String {
    or(value.map(|value| format!("{value:.decimals$}")), none)
}

/// 50 %, 90 %, 99 % and the maximum.
pub(crate) fn quantiles(quantiles: &Quantiles) -> String {
    let Quantiles { p50, p90, p99, max, .. } = quantiles;
    format!("{p50:.0} / {p90:.0} / {p99:.0} / {max:.0}")
}

/// A table with a border, numbers to the right in the columns that are of numbers. A name in a row is [`shown`]; a head
/// may have lines.
pub(crate) fn table<H: Into<String>>(
    head: impl IntoIterator<Item = H>,
    rows: impl IntoIterator<Item = Vec<String>>,
    is_of_numbers: impl Fn(usize) -> bool,
) -> Table {
    let mut table = Table::new();
    table.load_style(presets::UTF8_BORDERS_ONLY).set_content_arrangement(ContentArrangement::Dynamic);
    table.set_header(head.into_iter().map(|head| shown_lines(&head.into()).into_owned()));
    table.add_rows(
        rows.into_iter().map(|row| row.iter().map(|text| shown(text).into_owned()).collect::<Vec<_>>()),
    );
    for (index, column) in table.column_iter_mut().enumerate() {
        if is_of_numbers(index) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table
}

/// The table as wide as the terminal, and not wider than is good to read.
pub(crate) fn readable(mut table: Table) -> Table {
    let width = table.width().map_or(WIDTH, |width| width.min(WIDTH));
    table.set_width(width);
    table
}

/// The columns in which there is something, and what stands there in each row; `nothing` where there is nothing.
pub(crate) fn filled<H, T, F: Fn(&T) -> Option<String>>(
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
                line.push(or(text, nothing));
            }
        }
    }
    (heads, lines)
}

/// What is printed: a name, a value, and what it is to be compared with.
pub(crate) struct Rows {
    table: Table,
    /// The letters of a name in one line.
    name_width: Option<usize>,
}

impl Rows {
    /// A [`readable`] table with this head and no rows.
    pub(crate) fn new(name: impl Display, value: impl Display, beside: impl Display) -> Self {
        Self::in_columns(None, name, value, beside)
    }

    /// The same on a terminal of so many columns; of unknown width, as wide as the terminal is.
    pub(crate) fn in_columns(
        columns: Option<u16>,
        name: impl Display,
        value: impl Display,
        beside: impl Display,
    ) -> Self {
        let mut table = table(line(name, value, beside), [], |_| false);
        if let Some(columns) = columns {
            table.set_width(columns);
        }
        let mut table = readable(table);
        let width = (table.width().unwrap_or(WIDTH) * 2 / 5).min(NAME);
        if let Some(names) = table.column_mut(0) {
            names.set_constraint(ColumnConstraint::ContentWidth);
        }
        Self { table, name_width: Some(usize::from(width)) }
    }

    /// The same where names are not broken, however narrow the terminal.
    pub(crate) fn names_in_one_line(mut self) -> Self {
        self.name_width = None;
        if let Some(names) = self.table.column_mut(0) {
            names.set_constraint(ColumnConstraint::ContentWidth);
        }
        self
    }

    /// The same with colours, or without any.
    pub(crate) fn coloured(mut self, is_coloured: bool) -> Self {
        self.table.force_no_tty();
        if is_coloured {
            self.table.enforce_styling();
        }
        self
    }

    /// The columns that it may take.
    pub(crate) fn columns(&self) -> usize {
        self.table.width().unwrap_or(WIDTH).into()
    }

    /// The same with names in lines of at most so many letters.
    pub(crate) const fn names_in(mut self, letters: usize) -> Self {
        self.name_width = Some(letters);
        self
    }

    /// The table as it is printed.
    pub(crate) fn text(&self) -> String {
        format!("{}\n", self.table).replace(INDENT, " ")
    }

    pub(crate) fn section(&mut self, name: impl Display, value: impl Display, beside: impl Display) {
        let [name, value, beside] = line(name, value, beside);
        self.table.add_row([folded(&name, self.name_width), value, beside]);
    }

    pub(crate) fn row(&mut self, name: impl Display, value: impl Display, beside: impl Display) {
        self.section(format!("  {name}"), value, beside);
    }

    /// Adds a row whose last text is in a colour, where colours are [`Rows::coloured`].
    pub(crate) fn row_in_colour(
        &mut self,
        name: impl Display,
        value: impl Display,
        beside: impl Display,
        colour: Color,
    ) {
        let [name, value, beside] = line(format!("  {name}"), value, beside);
        let name = Cell::new(folded(&name, self.name_width));
        self.table.add_row([name, Cell::new(value), Cell::new(beside).fg(colour)]);
    }

    /// The same, whose last text is not broken.
    pub(crate) fn row_in_one_line(&mut self, name: impl Display, value: impl Display, beside: &str) {
        self.row(name, value, beside);
        let width = u16::try_from(beside.chars().count() + 2).unwrap_or(WIDTH);
        if let Some(texts) = self.table.column_mut(2) {
            texts.set_constraint(ColumnConstraint::LowerBoundary(Width::Fixed(width)));
        }
    }

    /// A row of something that there is, or none.
    pub(crate) fn any(&mut self, name: impl Display, count: impl TryInto<u64>, beside: impl Display) {
        if let Some(count) = count.try_into().ok().filter(|&count| count > 0) {
            self.row(name, count, beside);
        }
    }
}

/// A row's texts, [`shown`].
fn line(name: impl Display, value: impl Display, beside: impl Display) -> [String; 3] {
    [name.to_string(), value.to_string(), beside.to_string()].map(|text| shown(&text).into_owned())
}

/// Breaks a text into lines of so many letters; all but the first, which begins with `begin`, are indented.
pub(crate) fn hanging(begin: &str, text: &str, columns: usize) -> String {
    let indent = begin.chars().count();
    let lines = folded(&format!("{}{text}", " ".repeat(indent)), Some(columns)).replace(INDENT, " ");
    format!("{begin}{}", lines.get(indent..).unwrap_or_default())
}

/// A name in lines of so many letters; all but the first are indented further. A longer word is broken.
fn folded(name: &str, width: Option<usize>) -> String {
    let words = name.trim_start_matches(' ');
    let indent = name.len() - words.len();
    let mut folded = INDENT.repeat(indent);
    let (mut taken, mut is_first) = (indent, true);
    let begin_line = |folded: &mut String| {
        folded.push('\n');
        folded.push_str(&INDENT.repeat(indent + 2));
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
    fn a_long_text_hangs_under_its_begin() {
        assert_eq!(hanging("look at: ", "a few words of it", 20), "look at: a few words\n           of it");
        assert_eq!(hanging("", "a few words", 80), "a few words");
    }

    #[test]
    fn a_long_name_is_folded_between_words_and_keeps_its_indent() {
        let of = |width| folded("  joints not yet taken at heartbeats, µs", width).replace(INDENT, ".");
        assert_eq!(of(None), "..joints not yet taken at heartbeats, µs");
        assert_eq!(of(Some(24)), "..joints not yet taken\n....at heartbeats, µs");
        assert_eq!(
            of(Some(4)),
            "..joints\n....not\n....yet\n....taken\n....at\n....heartb\n....eats,\n....µs"
        );
    }
}
