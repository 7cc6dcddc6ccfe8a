//! The part of a bus' torque that counts in a tick.
//!
//! The torque of a silent cell decays with the broadcasts that its bus carries. On a bus that carries none it would never
//! decay, so the loop itself does it, by the same rule: held for some epochs, then decaying to zero.

use protocol::packet::Epoch;
use protocol::skin::Safety;

use model::table::Sums;

/// One bus, as input of a tick.
#[derive(Clone, Copy, Debug)]
pub struct Heard<'a> {
    /// The state of its table.
    pub sums: &'a Sums,
    /// Whether it works, as its receiver sees it.
    pub works: bool,
}

/// The bit that stands for a bus in a mask of buses.
#[must_use]
pub fn bit(bus: usize) -> u32 {
    1 << bus.min(31)
}

/// How many of the broadcasts a bus has carried.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Carried {
    /// The last one that was read back.
    last: Option<Epoch>,
    /// Its number, from 1.
    number: u64,
}

impl Carried {
    /// Broadcasts that should have been read back and were not, when `last` is the last one that was, and `epoch` the
    /// newest of `broadcasts`. The newest one may still be on its way.
    pub(super) fn unanswered(&mut self, last: Option<Epoch>, epoch: Epoch, broadcasts: u64) -> u64 {
        // Epochs wrap around, so they are compared once, when they are new.
        if let Some(read) = last.filter(|_| last != self.last) {
            self.number = broadcasts.saturating_sub(u64::try_from(epoch.since(read)).unwrap_or(0));
            self.last = last;
        }
        broadcasts.saturating_sub(self.number + 1)
    }
}

/// The part of the last torque that still counts.
pub(super) fn part(unanswered: u64, safety: &Safety) -> f64 {
    let hold = u64::from(safety.hold_epochs);
    if unanswered <= hold {
        return 1.0;
    }
    let over = u32::try_from(unanswered - hold).unwrap_or(u32::MAX);
    let left = safety.decay_epochs.saturating_sub(over);
    if left == 0 { 0.0 } else { f64::from(left) / f64::from(safety.decay_epochs) }
}

/// Whether a bus that has missed so many broadcasts carries nothing any more.
pub(super) fn is_lost(unanswered: u64, safety: &Safety) -> bool {
    unanswered > u64::from(safety.hold_epochs) + u64::from(safety.decay_epochs)
}
