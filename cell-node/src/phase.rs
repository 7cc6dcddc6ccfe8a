//! Phases for periodic sending: the cells of a bus send at different times within a period, and each keeps its phase.

use protocol::id::CellId;
use protocol::time::{Micros, Span};

/// Returns the time within a period at which the cell with this node id sends. The cells of a bus send one after the
/// other.
pub(crate) const fn send_offset_by_node_id(period: Span, cell: CellId) -> Span {
    Span(period.0 * cell.get() as u64 / 255)
}

/// Returns the time within a period at which the cell with this serial number sends, for cells whose node ids may be
/// equal.
pub(crate) const fn send_offset_by_serial(period: Span, serial: u32) -> Span {
    Span(serial as u64 * 1_000 % period.0)
}

/// Returns the next time to send after `due`. Periods that passed while the cell did not run are skipped, so that the
/// phase remains.
pub(crate) fn next_send_time(due: Micros, period: Span, now: Micros) -> Micros {
    let skipped = now.elapsed_since(due).0.checked_div(period.0).unwrap_or(0);
    due + Span((skipped + 1) * period.0)
}
