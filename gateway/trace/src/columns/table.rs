//! Tables: rows that are split into columns.

use std::io;

use super::folder::ColumnFolder;
use super::npy::{Element, NpyFile};

/// Name and type of a column.
#[derive(Clone, Copy, Debug)]
pub struct ColumnSpec {
    /// The name of the column.
    pub name: &'static str,
    /// The type of its elements.
    pub element: Element,
    /// Number of elements of a row; `None` for a column of one dimension.
    pub width: Option<usize>,
}

impl ColumnSpec {
    /// Creates a column with one element in each row.
    #[must_use]
    pub const fn single(name: &'static str, element: Element) -> Self {
        Self { name, element, width: None }
    }

    /// Creates a column with `width` elements in each row.
    #[must_use]
    pub const fn wide(name: &'static str, element: Element, width: usize) -> Self {
        Self { name, element, width: Some(width) }
    }

    const fn row_bytes(&self) -> usize {
        let count = match self.width {
            Some(width) => width,
            None => 1,
        };
        self.element.size() * count
    }
}

/// The elements of one row, in the order of the table's columns.
#[derive(Clone, Debug, Default)]
pub struct Row {
    bytes: Vec<u8>,
}

impl Row {
    /// Removes all elements.
    pub fn clear(&mut self) -> &mut Self {
        self.bytes.clear();
        self
    }

    /// Appends a truth value.
    pub fn bool(&mut self, value: bool) -> &mut Self {
        self.u8(u8::from(value))
    }

    /// Appends an unsigned integer of 8 bits.
    pub fn u8(&mut self, value: u8) -> &mut Self {
        self.bytes.push(value);
        self
    }

    /// Appends an unsigned integer of 32 bits.
    pub fn u32(&mut self, value: u32) -> &mut Self {
        self.bytes.extend_from_slice(&value.to_le_bytes());
        self
    }

    /// Appends a signed integer of 16 bits.
    pub fn i16(&mut self, value: i16) -> &mut Self {
        self.bytes.extend_from_slice(&value.to_le_bytes());
        self
    }

    /// Appends a signed integer of 64 bits.
    pub fn i64(&mut self, value: i64) -> &mut Self {
        self.bytes.extend_from_slice(&value.to_le_bytes());
        self
    }

    /// Appends a count or a time, limited to the range of the signed integer.
    pub fn count(&mut self, value: u64) -> &mut Self {
        self.i64(i64::try_from(value).unwrap_or(i64::MAX))
    }

    /// Appends a number of double precision.
    pub fn f64(&mut self, value: f64) -> &mut Self {
        self.bytes.extend_from_slice(&value.to_le_bytes());
        self
    }

    /// Appends `width` words: those of `words`, then zeros.
    pub fn words(&mut self, words: &[i16], width: usize) -> &mut Self {
        for at in 0..width {
            self.i16(words.get(at).copied().unwrap_or_default());
        }
        self
    }

    /// Appends `width` numbers: those of `values`, then NaN.
    pub fn numbers(&mut self, values: impl IntoIterator<Item = f64>, width: usize) -> &mut Self {
        values.into_iter().chain(std::iter::repeat(f64::NAN)).take(width).for_each(|value| {
            self.f64(value);
        });
        self
    }

    /// Returns the bytes of the elements.
    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes
    }
}

/// A table whose rows are written in the order of their arrival.
#[derive(Debug)]
pub struct Table {
    columns: Vec<(usize, NpyFile)>,
    row_bytes: usize,
    rows: u64,
}

impl Table {
    /// Creates the files of a table.
    ///
    /// # Errors
    /// Returns an error if a file cannot be created.
    pub fn create(folder: &ColumnFolder, name: &str, columns: &[ColumnSpec]) -> io::Result<Self> {
        let files = columns.iter().map(|column| {
            let file = folder.create_column(name, column.name, column.element, column.width)?;
            Ok((column.row_bytes(), file))
        });
        Ok(Self { columns: files.collect::<io::Result<_>>()?, row_bytes: row_bytes(columns), rows: 0 })
    }

    /// Appends a row.
    ///
    /// # Errors
    /// Returns an error if a file cannot be written, or if the row does not have the elements of all columns.
    pub fn push(&mut self, row: &Row) -> io::Result<()> {
        self.append_rows(row.bytes())
    }

    /// Appends rows, given by their bytes one after the other.
    pub(super) fn append_rows(&mut self, bytes: &[u8]) -> io::Result<()> {
        let mut rows = bytes.chunks_exact(self.row_bytes);
        for row in &mut rows {
            let mut rest = row;
            for (size, file) in &mut self.columns {
                let (element, others) = rest.split_at_checked(*size).unwrap_or((rest, &[]));
                file.append(element)?;
                rest = others;
            }
            self.rows += 1;
        }
        if rows.remainder().is_empty() {
            return Ok(());
        }
        let (came, whole) = (rows.remainder().len(), self.row_bytes);
        Err(io::Error::other(format!("a row of {came} bytes does not fit the columns, which take {whole}")))
    }

    /// Returns the number of rows so far.
    #[must_use]
    pub const fn rows(&self) -> u64 {
        self.rows
    }

    /// Finishes the files. Returns the number of rows.
    ///
    /// # Errors
    /// Returns an error if a file cannot be written.
    pub fn finish(self) -> io::Result<u64> {
        for (_, file) in self.columns {
            file.finish()?;
        }
        Ok(self.rows)
    }
}

/// Returns the size in bytes of a row with these columns.
pub(super) fn row_bytes(columns: &[ColumnSpec]) -> usize {
    columns.iter().map(ColumnSpec::row_bytes).sum()
}
