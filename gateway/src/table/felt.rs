//! What a cell feels, as far as the bus tells: the gateway's own view of the rule by which cells latch
//! stimuli. It is written apart from the cells' code, so that each is a witness of the other.

use std::collections::VecDeque;

use protocol::message::{From, SkinSensors};
use protocol::packet::Epoch;

/// As many stimuli as a cell lets wait.
const PENDING: usize = 8;

/// What one cell feels.
#[derive(Debug, Default)]
pub(super) struct Felt {
    waiting: VecDeque<(From, SkinSensors)>,
    now: Option<SkinSensors>,
}

impl Felt {
    /// A stimulus was sent; `last` is the epoch of the last joints.
    pub(super) fn push(&mut self, from: From, skin: SkinSensors, last: Option<Epoch>) {
        if self.waiting.len() == PENDING {
            return;
        }
        let late = matches!((from, last), (From::Epoch(first), Some(last)) if last.since(first) >= 0);
        self.waiting.push_back((if late { From::Next } else { from }, skin));
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

    /// What it feels since the last joints.
    pub(super) const fn now(&self) -> Option<SkinSensors> {
        self.now
    }

    /// What the cell feels from the joints of this epoch on; `None` while nobody knows.
    pub(super) fn latch(&mut self, epoch: Epoch) -> Option<SkinSensors> {
        let due = |from: &From| match from {
            From::Next => true,
            From::Epoch(first) => epoch.since(*first) >= 0,
        };
        let newest = self.waiting.iter().rev().find(|(from, _)| due(from));
        if let Some((_, skin)) = newest {
            self.now = Some(*skin);
            self.waiting.retain(|(from, _)| !due(from));
        }
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
