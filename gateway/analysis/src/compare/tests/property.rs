//! Property test: for any loss, change or cut of a run, the comparison counts exactly the damaged epochs.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

/// The damage that is done to the second capture.
#[derive(Clone, Debug)]
struct Harm {
    /// Number of the first joints that the damaged capture has, and the number after its last ones.
    first: u64,
    end: u64,
    /// Consecutive lost joints: first number and count.
    gap: (u64, u64),
    lost_joints: BTreeSet<u64>,
    lost_torques: BTreeSet<u64>,
    changed_torques: BTreeSet<u64>,
}

fn harm() -> impl Strategy<Value = Harm> {
    let some = || prop::collection::btree_set(0_u64..1_500, 0..20);
    let gap = (200_u64..1_200, prop_oneof![Just(0_u64), 1_u64..250, 260_u64..500]);
    (0_u64..256, 900_u64..1_500, gap, some(), some(), some()).prop_map(
        |(first, end, gap, lost_joints, lost_torques, changed_torques)| Harm {
            first,
            end,
            gap,
            lost_joints,
            lost_torques,
            changed_torques,
        },
    )
}

impl Harm {
    fn has_joints(&self, number: u64) -> bool {
        let (begin, long) = self.gap;
        (self.first..self.end).contains(&number)
            && !(begin..begin + long).contains(&number)
            && !self.lost_joints.contains(&number)
    }

    fn has_torque(&self, number: u64) -> bool {
        !self.lost_torques.contains(&number)
    }

    fn word(&self, number: u64) -> i16 {
        if self.changed_torques.contains(&number) { 42 } else { 40 }
    }

    fn frames(&self) -> Frames {
        let mut frames = Frames::new();
        for number in self.first..self.end {
            if self.has_joints(number) {
                frames.push((at(number), "vcan0", joints(number)));
            }
            // The torque of an epoch that was lost with 255 others would be taken for that of the epoch before them.
            let (begin, long) = self.gap;
            if self.has_torque(number) && !(begin..begin + long).contains(&number) {
                frames.push((at(number) + 900_000, "vcan0", torque(1, number, self.word(number))));
            }
        }
        frames
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn counts_are_those_of_the_numbers(harm in harm(), swaps in any::<bool>()) {
        let skin = skin();
        let none = BTreeSet::new;
        let whole = Harm {
            first: 0,
            end: 1_500,
            gap: (0, 0),
            lost_joints: none(),
            lost_torques: none(),
            changed_torques: none(),
        };
        let there: Vec<_> = (0..1_500).filter(|number| harm.has_joints(*number)).collect();
        // The epochs identify the start, and the length of a silence unless it is a multiple of 256 epochs.
        prop_assume!(there.first().is_some_and(|first| *first < 256));
        prop_assume!(there.windows(2).all(|pair| pair[1] - pair[0] != 256));
        let (first, last) = (there[0], *there.last().unwrap());
        let (a, b) = (whole.frames(), harm.frames());
        let options = CompareOptions { tolerance: 1, ..CompareOptions::default() };
        let report = match swaps {
            false => compared(&skin, options, &a, &b),
            true => compared(&skin, options, &b, &a),
        };
        let only = |count| match swaps {
            false => UnpairedCounts { only_a: count, only_b: 0 },
            true => UnpairedCounts { only_a: 0, only_b: count },
        };
        let missing = last - first + 1 - there.len() as u64;
        prop_assert_eq!(report.epochs.compared, there.len() as u64);
        prop_assert_eq!(report.epochs.before, only(first));
        prop_assert_eq!(report.epochs.after, only(1_499 - last));
        prop_assert_eq!(report.epochs.missing_in_a + report.epochs.missing_in_b, missing);
        prop_assert_eq!(if swaps { report.epochs.missing_in_b } else { report.epochs.missing_in_a }, 0);
        prop_assert_eq!(report.joints.equal, there.len() as u64);
        let settled = there.len().saturating_sub(4);
        let lost = |numbers: &[u64]| numbers.iter().filter(|number| !harm.has_torque(**number)).count() as u64;
        let changed = there.iter().filter(|it| harm.has_torque(**it) && harm.word(**it) != 40).count() as u64;
        prop_assert_eq!(report.torques.missing_count(), lost(&there[..settled]));
        prop_assert_eq!(report.torques.open, lost(&there[settled..]));
        prop_assert_eq!(report.torques.different, changed);
        prop_assert_eq!(report.torques.equal, there.len() as u64 - changed - lost(&there));
        let is_equal = missing + report.torques.missing_count() + changed == 0;
        prop_assert_eq!(report.equal, is_equal);
    }
}
