//! The last torque of a cell, or the last sum of a root. It is held until the next one arrives, decays if none does,
//! and is part of the running sum.

use protocol::parameters::MAX_JOINTS;
use protocol::skin::SafetyLimits;

/// A change of the running sum: steps by joint, and cells.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(super) struct TorqueSumChange {
    pub(super) torque: [i32; MAX_JOINTS],
    pub(super) contributing: i32,
}

/// The held torque of a cell, or the held sum of a root.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct HeldTorque {
    /// The last torque in steps of Q3.12, and the number of cells in it: 1, or for a root those in its sum.
    torque: Option<([i32; MAX_JOINTS], u8)>,
    /// The part of the running sum that comes from this torque, in steps of Q3.12.
    contribution: [i32; MAX_JOINTS],
    /// Number of cells of this torque that the running sum counts.
    contributing: u8,
}

impl HeldTorque {
    /// Holds a torque, in steps of Q3.12, until the next one; zeros end a contact. Returns the change of the running
    /// sum.
    pub(super) fn hold_torque(&mut self, words: [i32; MAX_JOINTS]) -> TorqueSumChange {
        self.torque = (words != [0; MAX_JOINTS]).then_some((words, 1));
        self.set_contribution(words, u8::from(self.torque.is_some()))
    }

    /// Holds a sum of `count` cells; a sum of zero cells ends all contacts. Returns the change of the running sum.
    pub(super) fn hold_sum(&mut self, words: [i32; MAX_JOINTS], count: u8) -> TorqueSumChange {
        // Even with cells in contact, all words may round to 0.
        self.torque = (count > 0).then_some((words, count));
        self.set_contribution(words, count)
    }

    /// Releases the torque. Returns the change of the running sum.
    pub(super) fn release_torque(&mut self) -> TorqueSumChange {
        self.torque = None;
        self.set_contribution([0; MAX_JOINTS], 0)
    }

    /// Keeps the torque or lets it decay, after this number of unanswered epochs. Returns the change of the running
    /// sum.
    pub(super) fn decay_torque(
        &mut self,
        unanswered: u32,
        safety: &SafetyLimits,
        is_sum: bool,
    ) -> TorqueSumChange {
        let Some((held, cells)) = self.torque else { return TorqueSumChange::default() };
        let left = (safety.hold_epochs + safety.decay_epochs).saturating_sub(unanswered);
        if left == 0 && unanswered > 0 {
            // The contribution has decayed to zero, although the cell has not reported the end of its contact.
            return self.set_contribution([0; MAX_JOINTS], 0);
        }
        let decay = safety.decay_epochs.max(1);
        let keep = i32::try_from(left.min(decay)).unwrap_or(i32::MAX);
        let whole = i32::try_from(decay).unwrap_or(i32::MAX);
        let rest = held.map(|word| word * keep / whole);
        let counts = is_sum || rest != [0; MAX_JOINTS];
        self.set_contribution(rest, if counts { cells } else { 0 })
    }

    fn set_contribution(&mut self, words: [i32; MAX_JOINTS], cells: u8) -> TorqueSumChange {
        let counted = core::mem::replace(&mut self.contributing, cells);
        let before = core::mem::replace(&mut self.contribution, words);
        let mut torque = words;
        for (torque, before) in torque.iter_mut().zip(before) {
            *torque -= before;
        }
        TorqueSumChange { torque, contributing: i32::from(cells) - i32::from(counted) }
    }

    /// Returns the number of cells in the held torque; 0 if nothing is held.
    pub(super) fn held_cell_count(&self) -> u32 {
        self.torque.map_or(0, |(_, cells)| cells.into())
    }

    /// Returns true if a torque is held.
    pub(super) const fn has_torque(&self) -> bool {
        self.torque.is_some()
    }

    /// Returns true if the torque is part of the running sum.
    pub(super) const fn contributes_to_sum(&self) -> bool {
        self.contributing > 0
    }
}

/// Converts a sum of Q3.12 words to Nm.
#[expect(clippy::cast_precision_loss, reason = "sums of 254 words of 16 bits are exact")]
pub(super) fn q3_12_to_nm(steps: i64) -> f64 {
    steps as f64 / 4_096.0
}
