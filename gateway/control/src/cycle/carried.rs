//! The fraction of a bus's torque that counts in a tick, by the broadcasts that the bus has carried.
//!
//! The torque of a silent cell decays with the broadcasts that its bus carries. On a bus that carries no broadcasts it
//! would never decay. The loop therefore applies the same rule to the whole bus: its torque is held for some epochs and
//! then decays to zero.

use protocol::packet::Epoch;
use protocol::skin::SafetyLimits;

use model::table::BusTotals;

/// The state of one bus, as input of a tick.
#[derive(Clone, Copy, Debug)]
pub struct BusInput<'a> {
    /// The totals over the cells of the bus.
    pub sums: &'a BusTotals,
    /// True if the receiver of the bus reports that it works.
    pub works: bool,
}

/// Returns the bit of a bus in a mask of buses.
#[must_use]
pub fn bus_bit(bus: usize) -> u32 {
    1 << bus.min(31)
}

/// The broadcasts of joints that a bus has carried.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct CarriedBroadcasts {
    /// Epoch of the last broadcast that was read back from the bus.
    last: Option<Epoch>,
    /// Number of that broadcast, counted from 1.
    number: u64,
}

impl CarriedBroadcasts {
    /// Returns the number of broadcasts that should have been read back from the bus and were not. `last` is the epoch
    /// of the last one read back. `epoch` is the epoch of the latest of `broadcasts` broadcasts, which may not have
    /// been read back yet.
    pub(super) fn unanswered_broadcasts(
        &mut self,
        last: Option<Epoch>,
        epoch: Epoch,
        broadcasts: u64,
    ) -> u64 {
        // Epochs wrap around, so compare each once, when it is new.
        if let Some(read) = last.filter(|_| last != self.last) {
            self.number = broadcasts.saturating_sub(u64::try_from(epoch.epochs_since(read)).unwrap_or(0));
            self.last = last;
        }
        broadcasts.saturating_sub(self.number + 1)
    }
}

/// Returns the fraction of the last torque, 0 to 1, that counts after this many broadcasts were not read back.
pub(super) fn remaining_torque_fraction(unanswered: u64, safety: &SafetyLimits) -> f64 {
    let hold = u64::from(safety.hold_epochs);
    if unanswered <= hold {
        return 1.0;
    }
    let over = u32::try_from(unanswered - hold).unwrap_or(u32::MAX);
    let left = safety.decay_epochs.saturating_sub(over);
    if left == 0 { 0.0 } else { f64::from(left) / f64::from(safety.decay_epochs) }
}

/// Returns true if a bus that has missed this many broadcasts contributes no torque any more.
pub(super) fn is_bus_lost(unanswered: u64, safety: &SafetyLimits) -> bool {
    unanswered > u64::from(safety.hold_epochs) + u64::from(safety.decay_epochs)
}
