//! What one cell felt at each joints, by the protocol's rules, and how that is known.

use protocol::message::{From, SensorPage, SkinSensors};
use protocol::packet::Epoch;
use serde::Serialize;

use model::stimuli::{Waiting, is_late};

/// How it is known what a cell felt.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case", tag = "by")]
pub enum Origin {
    /// It had just started: nothing touched it.
    Start {
        /// When it said so.
        at_ns: u64,
    },
    /// Its mode was written, which forgets what it felt.
    Mode {
        /// When.
        at_ns: u64,
    },
    /// A stimulus.
    Stimulus {
        /// When it was sent.
        at_ns: u64,
        /// The epoch from which on it was to hold; none for the next joints.
        from_epoch: Option<u8>,
        /// Whether it came after the joints of that epoch.
        late: bool,
    },
    /// The cell said itself what it felt.
    Said {
        /// When.
        at_ns: u64,
    },
}

/// One cell's sensors in test mode.
#[derive(Clone, Debug, Default)]
pub(super) struct Felt {
    waiting: Waiting<(SensorPage, Origin)>,
    now: Option<(SkinSensors, Origin)>,
}

impl Felt {
    /// What it feels, once something is known of it.
    pub(super) const fn now(&self) -> Option<(SkinSensors, Origin)> {
        self.now
    }

    /// A stimulus was sent; `last` is the epoch of the last joints.
    pub(super) fn push(&mut self, at_ns: u64, from: From, page: SensorPage, last: Option<Epoch>) {
        let from_epoch = if let From::Epoch(epoch) = from { Some(epoch.0) } else { None };
        let origin = Origin::Stimulus { at_ns, from_epoch, late: is_late(from, last) };
        self.waiting.push(from, (page, origin), last);
    }

    /// Joints were taken.
    pub(super) fn latch(&mut self, epoch: Epoch) {
        for (page, origin) in self.waiting.latch(epoch) {
            if let SensorPage::Skin(skin) = page {
                self.now = Some((skin, origin));
            }
        }
    }

    /// The cell said what it feels: news only while nothing else is known.
    pub(super) fn said(&mut self, at_ns: u64, skin: SkinSensors) {
        self.now.get_or_insert((skin, Origin::Said { at_ns }));
    }

    /// Nothing touches it and nothing waits.
    pub(super) fn clear(&mut self, origin: Origin) {
        self.waiting.clear();
        self.now = Some((SkinSensors::default(), origin));
    }

    /// It measures: what it feels does not come by the bus.
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use model::stimuli::PENDING;
    use protocol::fixed::{Q3_12, Q5_10};

    fn press(newtons: f64) -> SensorPage {
        SensorPage::Skin(SkinSensors { contact: [Q5_10::nearest(newtons); 3], ..SkinSensors::default() })
    }

    fn contact(felt: &Felt) -> Option<f64> {
        felt.now().map(|(skin, _)| skin.contact[0].to_f64())
    }

    #[test]
    fn stimuli_wait_for_their_epoch_and_late_ones_for_the_next() {
        let mut felt = Felt::default();
        felt.latch(Epoch(253));
        assert_eq!(contact(&felt), None, "nobody knows");
        felt.push(5, From::Epoch(Epoch(1)), press(2.0), Some(Epoch(253)));
        felt.push(6, From::Epoch(Epoch(253)), press(1.0), Some(Epoch(253)));
        felt.latch(Epoch(254));
        assert_eq!(contact(&felt), Some(1.0));
        let origin = Origin::Stimulus { at_ns: 6, from_epoch: Some(253), late: true };
        assert_eq!(felt.now().unwrap().1, origin);
        felt.latch(Epoch(0));
        assert_eq!(contact(&felt), Some(1.0));
        felt.latch(Epoch(1));
        assert_eq!(contact(&felt), Some(2.0));
        felt.clear(Origin::Mode { at_ns: 7 });
        assert_eq!(contact(&felt), Some(0.0));
    }

    #[test]
    fn the_ninth_that_waits_is_refused_whatever_its_page() {
        let mut felt = Felt::default();
        for _ in 0..PENDING {
            felt.push(0, From::Next, SensorPage::Acceleration([Q3_12::ZERO; 3]), None);
        }
        felt.push(0, From::Next, press(1.0), None);
        felt.latch(Epoch(0));
        assert_eq!(contact(&felt), None);
    }

    #[test]
    fn what_a_cell_says_counts_only_while_nothing_else_is_known() {
        let SensorPage::Skin(skin) = press(3.0) else { unreachable!() };
        let mut felt = Felt::default();
        felt.said(1, skin);
        assert_eq!(contact(&felt), Some(3.0));
        felt.push(2, From::Next, press(1.0), None);
        felt.latch(Epoch(0));
        felt.said(3, skin);
        assert_eq!(contact(&felt), Some(1.0));
    }
}
