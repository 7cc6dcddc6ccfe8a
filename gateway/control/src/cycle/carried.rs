//! The part of a bus's torque that counts in a tick.
//!
//! The torque of a silent cell decays with the broadcasts that its bus carries. On a bus that carries none it would
//! never decay, so the loop applies the same rule: hold for some epochs, then decay to zero.

use protocol::packet::Epoch;
use protocol::skin::Safety;

use model::table::BusTotals;

/// State of one bus as input of a tick.
#[derive(Clone, Copy, Debug)]
pub struct BusInput<'a> {
    /// Totals of its table.
    pub sums: &'a BusTotals,
    /// True if the bus works, by its receiver.
    pub works: bool,
}

/// The bit of a bus in a mask of buses.
#[must_use]
pub fn bit(bus: usize) -> u32 {
    1 << bus.min(31)
}

/// Number of broadcasts that a bus has carried.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Carried {
    /// Epoch of the last broadcast that was read back.
    last: Option<Epoch>,
    /// Number of that broadcast, from 1.
    number: u64,
}

impl Carried {
    /// Number of broadcasts that should have been read back and were not. `last` is the epoch of the last one read
    /// back; `epoch` is that of the latest of `broadcasts`, which may still be under way.
    pub(super) fn unanswered(&mut self, last: Option<Epoch>, epoch: Epoch, broadcasts: u64) -> u64 {
        // Epochs wrap around, so compare each once, when it is new.
        if let Some(read) = last.filter(|_| last != self.last) {
            self.number = broadcasts.saturating_sub(u64::try_from(epoch.epochs_since(read)).unwrap_or(0));
            self.last = last;
        }
        broadcasts.saturating_sub(self.number + 1)
    }
}

/// Fraction of the last torque that still counts.
pub(super) fn part(unanswered: u64, safety: &Safety) -> f64 {
    let hold = u64::from(safety.hold_epochs);
    if unanswered <= hold {
        return 1.0;
    }
    let over = u32::try_from(unanswered - hold).unwrap_or(u32::MAX);
    let left = safety.decay_epochs.saturating_sub(over);
    if left == 0 { 0.0 } else { f64::from(left) / f64::from(safety.decay_epochs) }
}

/// Returns true if a bus that has missed this many broadcasts no longer contributes.
pub(super) fn is_lost(unanswered: u64, safety: &Safety) -> bool {
    unanswered > u64::from(safety.hold_epochs) + u64::from(safety.decay_epochs)
}
