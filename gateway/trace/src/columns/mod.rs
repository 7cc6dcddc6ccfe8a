//! Folders of columns: tables of which each column is one NumPy file (`.npy`, little-endian), beside a description in
//! JSON. Programs map the files into memory and read only the rows that they need.
//!
//! ```text
//!   row ──> Table ─────────────────────────> TABLE.COLUMN.npy, rows in the order of their arrival
//!   row ──> GroupedTable ──> blocks of rows ──> TABLE.COLUMN.npy, rows by group, then by arrival
//! ```
//!
//! All files are written in bounded memory, into a [`ColumnFolder`] that gets its name when it is complete.

mod folder;
mod grouped;
mod npy;
mod table;

pub use folder::{ColumnFolder, DESCRIPTION_FILE, FORMAT_KEY, FORMAT_VERSION, check_columns_writable};
pub use grouped::{GroupRange, GroupedTable};
pub use npy::{Element, NpyFile};
pub use table::{ColumnSpec, Row, Table};
