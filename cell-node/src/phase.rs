//! The phase in a period at which a cell sends: cells are spread over the period and keep their phase.

use protocol::id::CellId;
use protocol::time::{Micros, Span};

/// Returns the phase for a node id: the cells of a bus send one after the other.
pub(crate) const fn by_number(period: Span, cell: CellId) -> Span {
    Span(period.0 * cell.get() as u64 / 255)
}

/// Returns the phase for a serial number, for cells whose node ids may be equal.
pub(crate) const fn by_serial(period: Span, serial: u32) -> Span {
    Span(serial as u64 * 1_000 % period.0)
}

/// Returns the next time after `due`. Periods that passed during a hang are skipped, and the phase is kept.
pub(crate) fn next(due: Micros, period: Span, now: Micros) -> Micros {
    let skipped = now.elapsed_since(due).0.checked_div(period.0).unwrap_or(0);
    due + Span((skipped + 1) * period.0)
}
