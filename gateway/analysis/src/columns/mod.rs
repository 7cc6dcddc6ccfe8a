//! A capture as columns: every frame, and what `skinbus explain` derives from them, in NumPy files.
//!
//! ```text
//!   Reader ──> observe_epochs ──┬── frames, notes                      in the order of the capture
//!                               ├── torques, sums                      by cell
//!                               └── epochs ──> joints by bus, contacts by cell, sums of the skin
//! ```
//!
//! | table | sorted by | columns |
//! |---|---|---|
//! | `frames` | capture | `at_ns`, `bus`, `id`, `flags`, `direction`, `length`, `raw_dlc`; `data` from `data_offsets` |
//! | `notes` | capture | `at_ns`, `bus` (-1: none), `kind`, `frames`, `line`; `text` from `text_offsets` |
//! | `joints` | bus | `at_ns`, `epoch_row`, `epoch`, `halted`, `words`, `positions` |
//! | `torques` | cell | `at_ns`, `joints_row` (-1: not used), `epoch`, `words` |
//! | `sums` | cell | `at_ns`, `epoch`, `count`, `words` |
//! | `epochs` | time | `at_ns`, `number`, `epoch`, `open_cells`, `saturated_cells`, `positions`, `distributed`, `central`, `error` |
//! | `contacts` | cell | `begin_ns`, `end_ns`, `ended`, `peak_force` |

mod accounts;
mod contacts;
mod description;
mod entries;
mod observer;

pub use accounts::{BusAccount, CaptureAccount, CellAccount};
pub use description::{ColumnOrigin, SourceFile};
pub use observer::{ColumnError, WrittenColumns, write_columns};

use protocol::id::CellId;

/// Returns the number of the group of a cell's rows.
fn cell_group(bus: usize, node: CellId) -> u32 {
    u32::try_from(bus).unwrap_or(u32::MAX >> 8) << 8 | u32::from(node.get())
}

/// Returns the bus and the node id of a group.
const fn bus_and_node(group: u32) -> (u32, u8) {
    (group >> 8, group.to_le_bytes()[0])
}

#[cfg(test)]
mod tests;
