//! Numbers of joints that do not wrap.
//!
//! An epoch is a number modulo 256, so the step between two received epochs is known only modulo 256. The elapsed time
//! gives the number of complete laps in between. A step that does not fit the time is a pause of the gateway, or a
//! restart of the numbering, which begins a new run.

use protocol::packet::Epoch;

/// The position of a joints packet in a capture: a run of epochs, and a number in that run.
#[derive(Clone, Copy, Debug, Default, Eq, Ord, PartialEq, PartialOrd)]
pub(super) struct JointsKey {
    /// Number of earlier restarts of the numbering.
    pub(super) run: u32,
    /// The number of the joints since the start of the run.
    pub(super) number: u64,
}

/// Maximum number of epochs by which one bus may lag another.
const MAX_BUS_LAG_EPOCHS: u64 = 16;
/// Maximum deviation of the elapsed time from the number of epochs, in epochs.
const ELAPSED_TOLERANCE_EPOCHS: u64 = 4;

/// Numbers the joints of all buses of a capture, which share one counter.
#[derive(Debug)]
pub(super) struct JointsNumbering {
    /// Period of epochs in ns, at least 1.
    period_ns: u64,
    /// The number of the first joints in the capture, if known.
    start: Option<u64>,
    newest: Option<NewestJoints>,
}

#[derive(Clone, Copy, Debug)]
struct NewestJoints {
    key: JointsKey,
    epoch: Epoch,
    nanos: u64,
}

impl JointsNumbering {
    /// Creates a numbering for joints that are `period_ns` apart. The first joints get the number `start`, or else the
    /// number of their epoch.
    pub(super) const fn new(period_ns: u64, start: Option<u64>) -> Self {
        Self { period_ns: if period_ns == 0 { 1 } else { period_ns }, start, newest: None }
    }

    /// Returns the key of the newest joints.
    pub(super) fn newest(&self) -> Option<JointsKey> {
        self.newest.map(|newest| newest.key)
    }

    /// Returns the key of joints that arrive after those with the key `last` on their bus; `None` if they are repeated
    /// or out of order.
    pub(super) fn number_joints(
        &mut self,
        nanos: u64,
        epoch: Epoch,
        last: Option<JointsKey>,
    ) -> Option<JointsKey> {
        let Some(newest) = self.newest else {
            let key = JointsKey { run: 0, number: self.start.unwrap_or_else(|| epoch.0.into()) };
            self.newest = Some(NewestJoints { key, epoch, nanos });
            return Some(key);
        };
        let elapsed = nanos.saturating_sub(newest.nanos) / self.period_ns;
        // The joints of another bus, or out of order.
        let back = u64::from(newest.epoch.0.wrapping_sub(epoch.0));
        if back <= MAX_BUS_LAG_EPOCHS && elapsed <= MAX_BUS_LAG_EPOCHS {
            let number = newest.key.number.checked_sub(back)?;
            let key = JointsKey { number, ..newest.key };
            return last.is_none_or(|last| last < key).then_some(key);
        }
        let key = match self.epochs_since_newest(newest, epoch, elapsed) {
            Some(steps) => JointsKey { number: newest.key.number + steps, ..newest.key },
            None => JointsKey { run: newest.key.run + 1, number: epoch.0.into() },
        };
        self.newest = Some(NewestJoints { key, epoch, nanos });
        last.is_none_or(|last| last < key).then_some(key)
    }

    /// Returns the number of epochs from the newest joints to those of `epoch`, which arrive `elapsed` periods later;
    /// `None` if the numbering restarted.
    fn epochs_since_newest(&self, newest: NewestJoints, epoch: Epoch, elapsed: u64) -> Option<u64> {
        let modulo = u64::from(epoch.0.wrapping_sub(newest.epoch.0));
        let laps = (elapsed + 128).saturating_sub(modulo) / 256;
        let steps = modulo + 256 * laps;
        let fits = steps.abs_diff(elapsed) <= ELAPSED_TOLERANCE_EPOCHS + elapsed / 1_000;
        match modulo {
            // A step of one after a pause is common, 257 lost joints in a row are rare.
            1 if elapsed < 252 => Some(1),
            _ if fits => Some(steps),
            1 => Some(1),
            _ if epoch.0 == 0 && modulo > 0 || modulo >= 128 => None,
            // The gateway was late: the epochs are in order, but the times are not.
            _ => Some(modulo),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PERIOD: u64 = 16_000_000;

    fn key(number: u64) -> Option<JointsKey> {
        Some(JointsKey { run: 0, number })
    }

    /// Numbers the joints of one bus, each given as its number in the test and its time in periods.
    fn numbers(joints: &[(u64, u64)]) -> Vec<Option<JointsKey>> {
        let (mut numbering, mut last) = (JointsNumbering::new(PERIOD, None), None);
        let each = joints.iter().map(|&(number, period)| {
            let epoch = Epoch(u8::try_from(number % 256).unwrap());
            let key = numbering.number_joints(1_000 + period * PERIOD, epoch, last);
            last = key.or(last);
            key
        });
        each.collect()
    }

    #[test]
    fn numbers_go_on_where_epochs_wrap() {
        assert_eq!(numbers(&[(254, 0), (255, 1), (256, 2), (257, 3)]), [254, 255, 256, 257].map(key));
    }

    #[test]
    fn lost_joints_are_counted_by_the_time_that_passed() {
        for lost in [1, 100, 127, 128, 200, 254, 255, 256, 257, 300, 511, 512, 1_000, 70_000] {
            let found = numbers(&[(3, 0), (4, 1), (4 + lost, 1 + lost)]);
            assert_eq!(found[2], key(4 + lost), "{lost} steps");
        }
    }

    #[test]
    fn a_pause_is_no_loss_and_a_new_count_is_a_new_run() {
        assert_eq!(numbers(&[(7, 0), (8, 400)])[1], key(8), "the next ones after 6.4 s");
        assert_eq!(numbers(&[(7, 0), (8, 100)])[1], key(8));
        assert_eq!(numbers(&[(7, 0), (20, 90)])[1], key(20), "late by 77 periods");
        let restarted = Some(JointsKey { run: 1, number: 0 });
        assert_eq!(numbers(&[(200, 0), (256, 150)])[1], restarted);
        assert_eq!(numbers(&[(100, 0), (256, 30)])[1], restarted);
    }

    #[test]
    fn buses_share_the_count_and_repeated_joints_are_none() {
        let mut numbering = JointsNumbering::new(PERIOD, Some(1_000));
        let mut take = |nanos, epoch, last| numbering.number_joints(nanos, Epoch(epoch), last);
        let (first, next) = (key(1_000), key(1_001));
        assert_eq!(take(5, 232, None), first);
        assert_eq!(take(6, 232, None), first, "on another bus");
        assert_eq!(take(PERIOD, 233, first), next);
        assert_eq!(take(PERIOD + 1, 233, next), None, "again");
        assert_eq!(take(PERIOD + 2, 232, next), None, "out of order");
        assert_eq!(take(PERIOD + 3, 233, first), next);
    }

    proptest! {
        #[test]
        fn any_losses_and_a_clock_that_is_not_exact_give_the_numbers(
            first in 0_u64..256,
            gaps in prop::collection::vec(prop_oneof![5 => Just(1_u64), 1 => 2_u64..3_000], 1..60),
            late in prop::collection::vec(0_u64..PERIOD * 2, 60),
        ) {
            let (mut numbering, mut number) = (JointsNumbering::new(PERIOD, None), first);
            let mut last = numbering.number_joints(0, Epoch(u8::try_from(first).unwrap()), None);
            for (gap, late) in gaps.iter().zip(&late) {
                number += gap;
                let nanos = (number - first) * PERIOD + late;
                last = numbering.number_joints(nanos, Epoch(u8::try_from(number % 256).unwrap()), last);
                prop_assert_eq!(last, key(number));
            }
        }
    }
}
