//! CSV files with a header and one line per row. Errors name the file, the line, the column and the value.

use csv::{StringRecord, StringRecordsIntoIter, Trim};
use protocol::usage::Failure;

use super::print::{comma_separated, count_with_noun};

/// Maximum number of characters of a first line that an error quotes.
const MAX_REPEATED_CHARS: usize = 60;

/// Columns of a file, in any order.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Columns {
    pub(crate) needed: &'static [&'static str],
    pub(crate) optional: &'static [&'static str],
}

impl Columns {
    /// Returns true for a valid header, which has each needed column once and no unknown column.
    fn match_header(self, names: &StringRecord) -> bool {
        let is_known = |name: &str| self.needed.contains(&name) || self.optional.contains(&name);
        let once = |name: &str| names.iter().filter(|other| *other == name).count() == 1;
        self.needed.iter().all(|name| once(name)) && names.iter().all(|name| is_known(name) && once(name))
    }
}

/// A CSV file that is read row by row. Empty lines and lines that begin with `#` are skipped.
pub(crate) struct CsvTable<'a> {
    file: String,
    names: StringRecord,
    rows: StringRecordsIntoIter<&'a [u8]>,
    lines: LineCounter<'a>,
}

/// A row of a file.
pub(crate) struct CsvRow<'a> {
    file: &'a str,
    names: &'a StringRecord,
    values: StringRecord,
    /// Line number in the file, from 1.
    pub(crate) line: usize,
}

impl<'a> CsvTable<'a> {
    /// Reads the header.
    pub(crate) fn new(file: &str, text: &'a str, columns: Columns) -> Result<Self, Failure> {
        let mut reader = csv::ReaderBuilder::new()
            .trim(Trim::All)
            .comment(Some(b'#'))
            .flexible(true)
            .from_reader(text.as_bytes());
        let mut lines = LineCounter { text, at: 0, line: 1 };
        let names =
            reader.headers().map_err(|error| Failure::usage_error(format!("{file}: {error}")))?.clone();
        if !columns.match_header(&names) {
            let line = lines.line_at(0);
            let header = columns.needed.join(",");
            let optional = if columns.optional.is_empty() {
                String::new()
            } else {
                format!(", optionally with {}", columns.optional.join(","))
            };
            let is_row = !names.iter().any(|name| columns.needed.contains(&name));
            let hint = if is_row { "write the header above it" } else { "correct it" };
            let got: String =
                names.iter().collect::<Vec<_>>().join(",").chars().take(MAX_REPEATED_CHARS).collect();
            return Err(Failure::usage_error(format!(
                "{file}: line {line}: the first line must be the header {header}{optional}, not {got:?}: {hint}"
            )));
        }
        Ok(Self { file: file.to_owned(), names, rows: reader.into_records(), lines })
    }

    pub(crate) fn next_row(&mut self) -> Result<Option<CsvRow<'_>>, Failure> {
        let Some(values) = self.rows.next() else { return Ok(None) };
        let file = self.file.as_str();
        let values = values.map_err(|error| Failure::usage_error(format!("{file}: {error}")))?;
        let byte = values.position().map_or(0, csv::Position::byte);
        let line = self.lines.line_at(usize::try_from(byte).unwrap_or_default());
        if values.len() != self.names.len() {
            let (got, names) = (count_with_noun(values.len(), "value"), comma_separated(&self.names));
            return Err(Failure::usage_error(format!(
                "{file}: line {line} has {got}: write one value for each of the columns {names}"
            )));
        }
        Ok(Some(CsvRow { file, names: &self.names, values, line }))
    }
}

impl CsvRow<'_> {
    /// Returns the text in a column, or an empty text if the file does not have the column.
    pub(crate) fn text(&self, column: &str) -> &str {
        let place = self.names.iter().position(|name| name == column);
        place.and_then(|place| self.values.get(place)).unwrap_or_default()
    }

    /// Returns the number in a column.
    pub(crate) fn number(&self, column: &str) -> Result<f64, Failure> {
        let number = self.text(column).parse().ok().filter(|number: &f64| number.is_finite());
        number.ok_or_else(|| self.value_error(column, "use a finite number"))
    }

    /// Returns the error for a wrong value in a column; `needed` names the allowed values.
    pub(crate) fn value_error(&self, column: &str, needed: &str) -> Failure {
        let (file, line, value) = (self.file, self.line, self.text(column));
        Failure::usage_error(format!("{file}: line {line}: {column} = {value:?}: {needed}"))
    }
}

/// Counts the lines of a text up to increasing positions.
struct LineCounter<'a> {
    text: &'a str,
    at: usize,
    line: usize,
}

impl LineCounter<'_> {
    /// Returns the line number of the row that begins at this byte, or after the empty lines and comments there.
    fn line_at(&mut self, byte: usize) -> usize {
        self.line += self.text.get(self.at..byte).unwrap_or_default().matches('\n').count();
        self.at = byte;
        let rest = self.text.get(byte..).unwrap_or_default().split_inclusive('\n');
        let is_no_row = |line: &&str| line.starts_with('#') || line.trim_end_matches(['\r', '\n']).is_empty();
        self.line + rest.take_while(is_no_row).count()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may stop")]
mod tests {
    use super::{Columns, CsvTable};

    const COLUMNS: Columns = Columns { needed: &["a", "b"], optional: &["c"] };

    fn refused(text: &str) -> String {
        CsvTable::new("t.csv", text, COLUMNS).err().unwrap().to_string()
    }

    #[test]
    fn rows_know_their_line() {
        for end in ["\n", "\r\n"] {
            let text = "# first\n\nb,a\n1,2\n\n# two\n# three\n\"4\", 3\n5,6".replace('\n', end);
            let mut table = CsvTable::new("t.csv", &text, COLUMNS).unwrap();
            for (line, a, b) in [(4, "2", 1.0), (8, "3", 4.0), (9, "6", 5.0)] {
                let row = table.next_row().unwrap().unwrap();
                assert_eq!((row.line, row.text("a"), row.text("c")), (line, a, ""));
                assert_eq!(row.number("b").unwrap().to_bits(), f64::to_bits(b));
            }
            assert!(table.next_row().unwrap().is_none());
        }
    }

    #[test]
    fn a_header_has_each_column_once() {
        let must = "t.csv: line 1: the first line must be the header a,b, optionally with c, not";
        assert_eq!(refused("1,2\n"), format!("{must} \"1,2\": write the header above it"));
        assert_eq!(refused(""), format!("{must} \"\": write the header above it"));
        for wrong in ["a", "a,b,b", "a,b,d", "a,c"] {
            assert_eq!(refused(wrong), format!("{must} {wrong:?}: correct it"));
        }
        assert!(refused("# x\n\n1,2").starts_with("t.csv: line 3: "));
        assert!(refused(&"x".repeat(99)).contains(&format!("\"{}\"", "x".repeat(60))));
        assert!(CsvTable::new("t.csv", "\u{feff}c,b,a", COLUMNS).is_ok());
    }

    #[test]
    fn values_are_named_with_their_line() {
        let mut table = CsvTable::new("t.csv", "a,b\n1\n# x\n2,inf\n", COLUMNS).unwrap();
        let short = table.next_row().err().unwrap().to_string();
        assert_eq!(short, "t.csv: line 2 has 1 value: write one value for each of the columns a, b");
        let row = table.next_row().unwrap().unwrap();
        let infinite = row.number("b").unwrap_err().to_string();
        assert_eq!(infinite, "t.csv: line 4: b = \"inf\": use a finite number");
    }
}
