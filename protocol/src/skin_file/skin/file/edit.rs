//! The editor of existing skin files, which changes single values in the text.

use core::ops::Range;

use thiserror::Error;
use toml_edit::{Document, Item, Key, Table, TableLike};

use super::Value;
use crate::skin::Skin;

/// The error for a text that is not that of the given skin.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EditError {
    /// The text is not TOML.
    #[error(transparent)]
    Toml(#[from] toml_edit::TomlError),
    /// The text has no cells.
    #[error("write its cells as [[cell]] tables")]
    NoCells,
    /// The numbers of cells in the text and in the skin differ.
    #[error("it has {found} cells, not {expected}")]
    Count {
        /// Number of cells in the text.
        found: usize,
        /// Number of cells in the skin.
        expected: usize,
    },
}

/// The text of a skin file in which values of cells are changed.
///
/// All bytes outside the changed values are kept: comments, order, spelling, spaces, line endings and a byte
/// order mark. Without changes the text is the original.
#[derive(Debug)]
pub struct SkinEdit<'a> {
    text: &'a str,
    document: Document<&'a str>,
    /// Replacements of byte ranges, in any order and without overlap.
    changes: Vec<(Range<usize>, String)>,
}

impl<'a> SkinEdit<'a> {
    /// Parses a skin's text.
    ///
    /// # Errors
    /// Returns an error if the text is not TOML, or its number of cells differs from that of the skin.
    pub fn new(skin: &Skin, text: &'a str) -> Result<Self, EditError> {
        let edit = Self { text, document: Document::parse(text)?, changes: Vec::new() };
        let (found, expected) = (edit.cell_count().ok_or(EditError::NoCells)?, skin.cells.len());
        if found != expected {
            return Err(EditError::Count { found, expected });
        }
        Ok(edit)
    }

    /// Counts the cells in the text: `[[cell]]` tables, or inline tables in an array.
    fn cell_count(&self) -> Option<usize> {
        let cells = self.document.get("cell")?;
        if let Item::ArrayOfTables(cells) = cells { Some(cells.len()) } else { Some(cells.as_array()?.len()) }
    }

    fn cell_table(&self, index: usize) -> Option<&dyn TableLike> {
        let cells = self.document.get("cell")?;
        if let Item::ArrayOfTables(cells) = cells {
            return cells.get(index).map(|table: &Table| table as &dyn TableLike);
        }
        cells.as_array()?.get(index)?.as_inline_table().map(|table| table as &dyn TableLike)
    }

    /// Returns the byte ranges of a key of a cell and of its value.
    fn key_and_value_ranges(&self, cell: usize, key: &str) -> Option<(Range<usize>, Range<usize>)> {
        let (key, item) = self.cell_table(cell)?.get_key_value(key)?;
        Some((Key::span(key)?, item.span()?))
    }

    /// Returns true if a cell has the key.
    #[must_use]
    pub fn has_key(&self, cell: usize, key: &str) -> bool {
        self.key_and_value_ranges(cell, key).is_some()
    }

    /// Replaces the value of a key, if the cell has it.
    pub fn set(&mut self, cell: usize, key: &str, value: Value<'_>) {
        if let Some((_, place)) = self.key_and_value_ranges(cell, key) {
            self.changes.push((place, value.to_string()));
        }
    }

    /// Replaces one element of an array of a cell, if the element exists.
    pub fn set_element(&mut self, cell: usize, key: &str, index: usize, value: Value<'_>) {
        let array = self.cell_table(cell).and_then(|cell| cell.get(key)?.as_array());
        if let Some(place) = array.and_then(|array| array.get(index)?.span()) {
            self.changes.push((place, value.to_string()));
        }
    }

    /// Replaces a key of a cell and its value by the key `other` and another value, if the cell has the key.
    pub fn replace_key(&mut self, cell: usize, key: &str, other: &str, value: Value<'_>) {
        if let Some((name, place)) = self.key_and_value_ranges(cell, key) {
            self.changes.push((name, other.to_owned()));
            self.changes.push((place, value.to_string()));
        }
    }

    /// Adds a key to a cell after the key `after`: on a new line in a table, or behind the value in an inline table.
    pub fn insert_key_after(&mut self, cell: usize, key: &str, value: Value<'_>, after: &str) {
        let Some((name, place)) = self.key_and_value_ranges(cell, after) else { return };
        let rest = self.text.get(place.end..).unwrap_or_default();
        let is_inline = self.document.get("cell").is_some_and(Item::is_value);
        let (offset, text) = if is_inline {
            (0, format!(", {key} = {value}"))
        } else {
            // The new line has the indentation and line ending of the one above it.
            let before = self.text.get(..name.start).unwrap_or_default();
            let indent = before.rsplit('\n').next().unwrap_or_default();
            let line = rest.find('\n').unwrap_or(rest.len());
            let end = if rest.get(..line).is_some_and(|line| line.ends_with('\r')) { "\r\n" } else { "\n" };
            match rest.len() == line {
                true => (line, format!("{end}{indent}{key} = {value}")),
                false => (line + 1, format!("{indent}{key} = {value}{end}")),
            }
        };
        let at = place.end + offset;
        self.changes.push((at..at, text));
    }

    /// Returns the text with all changes applied.
    #[must_use]
    pub fn edited_text(mut self) -> String {
        // The sort is stable: insertions at one position keep the order of the calls.
        self.changes.sort_by_key(|(place, _)| (place.start, place.end));
        let mut out = String::with_capacity(self.text.len());
        let mut at = 0;
        for (place, new) in &self.changes {
            out.push_str(self.text.get(at..place.start).unwrap_or_default());
            out.push_str(new);
            at = place.end;
        }
        out.push_str(self.text.get(at..).unwrap_or_default());
        out
    }
}
