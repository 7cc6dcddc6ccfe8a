//! What a cell feels, as far as the bus tells.

use protocol::message::{From, SkinSensors};
use protocol::packet::Epoch;

use crate::stimuli::Waiting;

/// What one cell feels.
#[derive(Debug, Default)]
pub(super) struct Felt {
    waiting: Waiting<SkinSensors>,
    now: Option<SkinSensors>,
}

impl Felt {
    /// A stimulus was sent; `last` is the epoch of the last joints.
    pub(super) fn push(&mut self, from: From, skin: SkinSensors, last: Option<Epoch>) {
        self.waiting.push(from, skin, last);
    }

    /// The cell said what it feels. That is news only while nobody knows: its word may be older than the
    /// joints at which it took the next stimulus.
    pub(super) fn said(&mut self, skin: SkinSensors) {
        self.now.get_or_insert(skin);
    }

    /// The cell started anew: nothing touches it.
    pub(super) fn restart(&mut self) {
        self.waiting.clear();
        self.now = Some(SkinSensors::default());
    }

    /// Nobody knows what it has heard, and so what it feels.
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    /// What it feels since the last joints.
    pub(super) const fn now(&self) -> Option<SkinSensors> {
        self.now
    }

    /// What the cell feels from the joints of this epoch on; `None` while nobody knows.
    pub(super) fn latch(&mut self, epoch: Epoch) -> Option<SkinSensors> {
        self.now = self.waiting.latch(epoch).last().or(self.now);
        self.now
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::fixed::Q5_10;

    #[test]
    fn what_is_felt_follows_the_epochs() {
        let press = |newtons| SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() };
        let mut felt = Felt::default();
        assert_eq!(felt.latch(Epoch(254)), None, "nobody knows");
        felt.push(From::Epoch(Epoch(0)), press(1.0), Some(Epoch(254)));
        felt.push(From::Epoch(Epoch(254)), press(2.0), Some(Epoch(254)));
        assert_eq!(felt.latch(Epoch(255)), Some(press(2.0)), "late, so from the next on");
        assert_eq!(felt.latch(Epoch(0)), Some(press(1.0)));
        assert_eq!(felt.latch(Epoch(1)), Some(press(1.0)));
        felt.said(press(3.0));
        assert_eq!(felt.latch(Epoch(2)), Some(press(1.0)), "an old word");
        felt.restart();
        assert_eq!(felt.latch(Epoch(4)), Some(SkinSensors::default()));
    }
}
