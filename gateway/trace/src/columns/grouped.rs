//! Tables whose rows are sorted by group, for example by cell.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

use super::folder::ColumnFolder;
use super::table::{ColumnSpec, Row, Table, row_bytes};

/// Number of rows of a group that are kept in memory before they are written to the temporary file.
const BLOCK_ROWS: usize = 128;

/// Rows of one group in a finished table.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct GroupRange {
    /// Number of the group.
    pub group: u32,
    /// Index of its first row.
    pub begin: u64,
    /// Index of the row after its last one.
    pub end: u64,
}

/// A table whose rows are sorted by group, and within a group by arrival. Until the end they are in a temporary file
/// without a name, in blocks of one group each.
#[derive(Debug)]
pub struct GroupedTable {
    table: Table,
    row_bytes: usize,
    groups: BTreeMap<u32, Group>,
    blocks: File,
    written: u64,
}

#[derive(Debug, Default)]
struct Group {
    /// Rows that are not in the file yet.
    pending: Vec<u8>,
    /// Place and length of each block in the file.
    blocks: Vec<(u64, u32)>,
}

impl GroupedTable {
    /// Creates the files of a table.
    ///
    /// # Errors
    /// Returns an error if a file cannot be created.
    pub fn create(folder: &ColumnFolder, name: &str, columns: &[ColumnSpec]) -> io::Result<Self> {
        Ok(Self {
            table: Table::create(folder, name, columns)?,
            row_bytes: row_bytes(columns),
            groups: BTreeMap::new(),
            blocks: folder.create_temporary_file()?,
            written: 0,
        })
    }

    /// Appends a row to a group.
    ///
    /// # Errors
    /// Returns an error if the temporary file cannot be written.
    pub fn push(&mut self, group: u32, row: &Row) -> io::Result<()> {
        let group = self.groups.entry(group).or_default();
        group.pending.extend_from_slice(row.bytes());
        if group.pending.len() >= BLOCK_ROWS * self.row_bytes {
            let length = u32::try_from(group.pending.len()).map_err(io::Error::other)?;
            self.blocks.write_all_at(&group.pending, self.written)?;
            group.blocks.push((self.written, length));
            self.written += u64::from(length);
            group.pending.clear();
        }
        Ok(())
    }

    /// Sorts the rows and finishes the files. Returns the rows of each group, in the order of the groups' numbers.
    ///
    /// # Errors
    /// Returns an error if a file cannot be written.
    pub fn finish(mut self) -> io::Result<Vec<GroupRange>> {
        let mut ranges = Vec::new();
        let mut block = Vec::new();
        for (group, Group { pending, blocks }) in self.groups {
            let begin = self.table.rows();
            for (place, length) in blocks {
                block.resize(length as usize, 0);
                self.blocks.read_exact_at(&mut block, place)?;
                self.table.append_rows(&block)?;
            }
            self.table.append_rows(&pending)?;
            ranges.push(GroupRange { group, begin, end: self.table.rows() });
        }
        self.table.finish()?;
        Ok(ranges)
    }
}
