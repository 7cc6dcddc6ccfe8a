//! The path from a cell's sensor words to joint torques: the paper's Algorithm 1 and `tau = J F_z`.
//!
//! The code uses integers only. It is exact except for three roundings: [`Force`] (16 fraction bits),
//! [`Torque::torque_words`] (the torque format), and the rounding of a sum of [`Torque::exact_torques`]. It never
//! panics, and its work is bounded.

use protocol::fixed::{Accumulator, Q1_14, Q5_10, TorqueFormat};
use protocol::parameters::{Contact, MAX_JOINTS};

/// A contact force along the cell's normal, in the range [0, 32 768) N in steps of 2^-16 N. A push on the cell is
/// positive.
#[derive(Clone, Copy, Debug, Default, Eq, Ord, PartialEq, PartialOrd)]
pub struct Force(i32);

impl Force {
    /// The force without a contact.
    pub const ZERO: Self = Self(0);

    /// Computes F_z of Algorithm 1 from the three contact words in N and the proximity.
    ///
    /// The contact force F_c is the exact sum of the three words. Contact and proximity below their thresholds count as
    /// zero, and so does a fused force below its own threshold. Comparisons are exact, and a value equal to its
    /// threshold counts. The fused force `alpha_c F_c + alpha_p F_p` is exact with 24 fraction bits; after the
    /// comparison it is rounded to 16, ties up. A contact cannot pull, so a negative fused force is zero whatever the
    /// threshold.
    #[must_use]
    pub fn fuse(contact: [Q5_10; 3], proximity: Q1_14, rule: &Contact) -> Self {
        let touch = contact
            .into_iter()
            .fold(Accumulator::<10>::ZERO, |sum, word| sum.saturating_add(word.to_accumulator()));
        let touch = if touch < rule.contact_threshold.to_accumulator() { Accumulator::ZERO } else { touch };
        let near = if proximity < rule.proximity_threshold { Q1_14::ZERO } else { proximity };

        // At most 2^18 * 2^15 * 2^2 + 2^30 steps.
        let weighed = Accumulator::<22>::from_steps(touch.steps() * rule.alpha_c.to_accumulator().steps());
        let fused = weighed.with_fraction_bits::<24>().saturating_add(rule.alpha_p.mul_wide::<14, 24>(near));
        if fused < rule.force_threshold.to_accumulator().with_fraction_bits() {
            return Self::ZERO;
        }
        Self::from_steps((fused.steps() + (1 << 7)) >> 8)
    }

    /// Creates a force from steps of 2^-16 N, clamped to the range of a force.
    #[must_use]
    pub fn from_steps(steps: i64) -> Self {
        Self(i32::try_from(steps.max(0)).unwrap_or(i32::MAX))
    }

    /// Returns the number of steps of 2^-16 N; never negative.
    #[must_use]
    pub const fn steps(self) -> i32 {
        self.0
    }

    /// Returns true if the force is not zero, so that the cell is active. Forces below 2^-17 N round to zero.
    #[must_use]
    pub const fn is_active(self) -> bool {
        self.0 > 0
    }
}

/// The torques that the contact force on one cell causes in the joints.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Torque<'a> {
    jacobian: &'a [Q1_14],
    force: Force,
}

impl<'a> Torque<'a> {
    /// Creates the torques `tau_l = J_l F_z` (Eq. 8), which are exact. J is in m in Q1.14, as a
    /// [`Kernel`](crate::kernel::Kernel) returns it; trailing zeros may be omitted.
    #[must_use]
    pub const fn new(jacobian: &'a [Q1_14], force: Force) -> Self {
        Self { jacobian, force }
    }

    /// Returns the exact torques in Nm, to be added to the sums of other cells.
    #[must_use]
    pub fn exact_torques(&self) -> [Accumulator<30>; MAX_JOINTS] {
        let mut exact = [Accumulator::ZERO; MAX_JOINTS];
        for (exact, row) in exact.iter_mut().zip(self.jacobian) {
            // At most 2^15 * 2^31 steps.
            *exact = Accumulator::from_steps(row.to_accumulator().steps() * i64::from(self.force.0));
        }
        exact
    }

    /// Returns the torques as words for the bus, rounded once, ties up. Torques outside the range become the largest or
    /// smallest word, which mean *saturated*. The error of all others is at most half a step, for Q3.12 1.3e-4 Nm.
    #[must_use]
    pub fn torque_words(&self, format: TorqueFormat) -> [i16; MAX_JOINTS] {
        self.rounded_words(&TorqueRounding::new(format, MAX_JACOBIAN_STEPS))
    }

    /// Like [`Torque::torque_words`], with a rounding computed once per configuration. J must not exceed the bound for
    /// which the rounding was created.
    #[must_use]
    #[inline]
    pub fn rounded_words(&self, rounding: &TorqueRounding) -> [i16; MAX_JOINTS] {
        let mut words = [0; MAX_JOINTS];
        self.write_words(rounding, &mut words);
        words
    }

    /// Like [`Torque::rounded_words`], but writes to a slice. Words beyond the length of J do not change.
    #[inline]
    pub fn write_words(&self, rounding: &TorqueRounding, words: &mut [i16]) {
        if self.force.0 > rounding.max_unsaturated_force {
            return self.write_saturating_words(rounding.format, words);
        }
        match rounding.format {
            TorqueFormat::Q3_12 => self.write_each_word(words, |row| low_16_bits(self.torque_steps(row, 12))),
            TorqueFormat::Q5_10 => self.write_each_word(words, |row| low_16_bits(self.torque_steps(row, 10))),
            TorqueFormat::Q7_8 => self.write_each_word(words, |row| low_16_bits(self.torque_steps(row, 8))),
        }
    }

    /// Writes the words with saturation, for forces at which a torque may be out of range.
    #[cold]
    #[inline(never)]
    fn write_saturating_words(&self, format: TorqueFormat, words: &mut [i16]) {
        self.write_each_word(words, |row| {
            let steps = self.torque_steps(row, format.fraction_bits());
            i16::try_from(steps).unwrap_or(if steps < 0 { i16::MIN } else { i16::MAX })
        });
    }

    /// Writes the word of each element of J, last joint first. `black_box` prevents loop unrolling, for which a
    /// Cortex-M0 has too few registers.
    #[inline(always)]
    fn write_each_word(&self, words: &mut [i16], word_of: impl Fn(Q1_14) -> i16) {
        for index in (0..self.jacobian.len().min(words.len())).rev() {
            core::hint::black_box(());
            if let (Some(word), Some(row)) = (words.get_mut(index), self.jacobian.get(index)) {
                *word = word_of(*row);
            }
        }
    }

    /// Returns the torque for one element of J, rounded to steps of 2^-`fraction`.
    #[inline(always)]
    fn torque_steps(&self, row: Q1_14, fraction: u32) -> i32 {
        // A 16 by 32 bit product in 32 bits: (J high + (J low >> 16)) 2^16 is less than 2^16 below J F, which
        // does not change the rounded result.
        let (high, low) = (self.force.0 >> 16, self.force.0 & 0xFFFF);
        let shift = 14 - fraction; // of 2^-14 Nm
        let half = (1 << shift) >> 1;
        let row = i32::from(row.to_bits());
        (row.wrapping_mul(high) + (row.wrapping_mul(low) >> 16) + half) >> shift
    }
}

/// Largest possible |J| in steps of 2^-14.
pub const MAX_JACOBIAN_STEPS: u16 = 1 << 15;

/// The conversion of torques to words, computed once per configuration.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct TorqueRounding {
    format: TorqueFormat,
    /// The largest force, in steps of 2^-16 N, at which no torque saturates.
    max_unsaturated_force: i32,
}

impl TorqueRounding {
    /// Creates the conversion for |J| up to `bound`, in steps of 2^-14. `bound` is [`MAX_JACOBIAN_STEPS`] if no lower
    /// bound is known.
    #[must_use]
    pub fn new(format: TorqueFormat, bound: u16) -> Self {
        // J F is at most the largest word, so rounding cannot exceed it.
        let largest = i64::from(i16::MAX) << (14 + 16 - format.fraction_bits());
        Self {
            format,
            max_unsaturated_force: i32::try_from(largest / i64::from(bound.max(1))).unwrap_or(i32::MAX),
        }
    }
}

/// Converts steps to a word, without a check of the range.
#[inline]
pub(crate) fn low_16_bits(steps: i32) -> i16 {
    debug_assert!(i16::try_from(steps).is_ok(), "{steps} is no word");
    let [low, high, ..] = steps.to_le_bytes();
    i16::from_le_bytes([low, high])
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "words are exact in f64")]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use protocol::fixed::Q3_12;

    impl Force {
        /// Converts the force to N, exactly.
        fn to_f64(self) -> f64 {
            f64::from(self.0) / 65_536.0
        }
    }

    fn rule() -> Contact {
        Contact {
            alpha_c: Q3_12::nearest(1.0),
            alpha_p: Q5_10::nearest(0.5),
            contact_threshold: Q5_10::nearest(0.25),
            proximity_threshold: Q1_14::nearest(0.125),
            force_threshold: Q5_10::nearest(0.25),
        }
    }

    fn newtons(values: [f64; 3]) -> [Q5_10; 3] {
        values.map(Q5_10::nearest)
    }

    #[test]
    fn a_touch_is_the_sum_of_the_three_words() {
        assert_eq!(Force::fuse(newtons([1.0, 0.5, 0.25]), Q1_14::ZERO, &rule()).to_f64(), 1.75);
        let most = Force::fuse([Q5_10::MAX; 3], Q1_14::ZERO, &rule());
        assert_eq!(most.to_f64(), 3.0 * Q5_10::MAX.to_f64(), "beyond one word's range");
    }

    #[test]
    fn what_equals_a_threshold_counts_and_what_is_one_step_below_does_not() {
        let touch =
            |bits| Force::fuse([Q5_10::from_bits(bits), Q5_10::ZERO, Q5_10::ZERO], Q1_14::ZERO, &rule());
        assert_eq!((touch(256).to_f64(), touch(255)), (0.25, Force::ZERO));

        let low = Contact { force_threshold: Q5_10::ZERO, ..rule() };
        let near = |bits| Force::fuse([Q5_10::ZERO; 3], Q1_14::from_bits(bits), &low);
        assert_eq!((near(2_048).to_f64(), near(2_047)), (0.0625, Force::ZERO));

        // 0.5 N of proximity at 0.5 is 0.25 N: the fused threshold, exactly.
        let near = |bits| Force::fuse([Q5_10::ZERO; 3], Q1_14::from_bits(bits), &rule());
        assert_eq!((near(8_192).to_f64(), near(8_191)), (0.25, Force::ZERO));
    }

    #[test]
    fn nothing_and_a_pull_are_no_contact() {
        let open = Contact {
            alpha_c: Q3_12::nearest(1.0),
            contact_threshold: Q5_10::MIN,
            force_threshold: Q5_10::MIN,
            ..rule()
        };
        assert!(!Force::fuse([Q5_10::ZERO; 3], Q1_14::ZERO, &open).is_active());
        assert!(!Force::fuse([Q5_10::MIN; 3], Q1_14::ZERO, &open).is_active());
        assert!(!Force::fuse([Q5_10::ZERO; 3], Q1_14::ZERO, &Contact::default()).is_active());
    }

    #[test]
    fn a_torque_beyond_8_nm_saturates_and_stays_exact_inside() {
        let arm = Q1_14::nearest(0.85);
        let mut jacobian = [Q1_14::ZERO; MAX_JOINTS];
        jacobian[0] = arm;
        jacobian[1] = arm.saturating_neg();
        let torque = Torque::new(&jacobian, Force::from_steps(10 << 16));
        assert_eq!(torque.torque_words(TorqueFormat::Q3_12)[..3], [i16::MAX, i16::MIN, 0]);
        let wider = torque.torque_words(TorqueFormat::Q5_10);
        assert_eq!(wider[..3], [Q5_10::nearest(10.0 * arm.to_f64()).to_bits(), -wider[0], 0]);
        assert_eq!(torque.exact_torques()[1].to_f64(), -10.0 * arm.to_f64());

        let less = Torque::new(&jacobian, Force::from_steps(9 << 16));
        assert_eq!(less.torque_words(TorqueFormat::Q3_12)[0], Q3_12::nearest(9.0 * arm.to_f64()).to_bits());
    }

    #[test]
    fn the_largest_force_that_surely_fits_is_not_held_and_fits() {
        for (format, bound) in TorqueFormat::ALL.into_iter().flat_map(|format| {
            [0, 1, 3, 777, MAX_JACOBIAN_STEPS - 1, MAX_JACOBIAN_STEPS].map(|it| (format, it))
        }) {
            let rounding = TorqueRounding::new(format, bound);
            let most = Q1_14::from_bits(bound.wrapping_neg().cast_signed()); // -2 m is the longest
            for steps in [rounding.max_unsaturated_force, rounding.max_unsaturated_force.saturating_add(1)] {
                let torque = Torque { jacobian: &[most], force: Force(steps) };
                let mut words = [0; MAX_JOINTS];
                torque.write_words(&rounding, &mut words);
                assert_eq!(words[0], format.round(torque.exact_torques()[0]), "{format:?}, {bound}, {steps}");
            }
        }
    }

    proptest! {
        #[test]
        fn the_force_is_algorithm_1_in_real_numbers(
            contact: [i16; 3], proximity: i16, alpha_c in 0..=i16::MAX, alpha_p in 0..=i16::MAX,
            thresholds in any::<[u8; 3]>(),
        ) {
            let [c, p, z] = thresholds.map(i16::from);
            let rule = Contact {
                alpha_c: Q3_12::from_bits(alpha_c),
                alpha_p: Q5_10::from_bits(alpha_p),
                contact_threshold: Q5_10::from_bits(c),
                proximity_threshold: Q1_14::from_bits(p),
                force_threshold: Q5_10::from_bits(z),
            };
            let (contact, proximity) = (contact.map(Q5_10::from_bits), Q1_14::from_bits(proximity));

            let none_below = |value: f64, threshold: f64| if value < threshold { 0.0 } else { value };
            let touch = none_below(contact.map(Q5_10::to_f64).iter().sum(), rule.contact_threshold.to_f64());
            let near = none_below(proximity.to_f64(), rule.proximity_threshold.to_f64());
            let fused = rule.alpha_c.to_f64() * touch + rule.alpha_p.to_f64() * near; // exact in f64
            let target = none_below(fused, rule.force_threshold.to_f64());

            let force = Force::fuse(contact, proximity, &rule);
            prop_assert!((force.to_f64() - target).abs() <= 1.0 / 131_072.0);
            prop_assert!(force.is_active() == (target >= 1.0 / 131_072.0));
        }

        #[test]
        fn no_words_panic_and_no_torque_wraps(
            contact: [i16; 3], proximity: i16, words: [i16; 5], jacobian: [i16; MAX_JOINTS], steps: i64,
        ) {
            let [alpha_c, alpha_p, c, p, z] = words;
            let rule = Contact {
                alpha_c: Q3_12::from_bits(alpha_c),
                alpha_p: Q5_10::from_bits(alpha_p),
                contact_threshold: Q5_10::from_bits(c),
                proximity_threshold: Q1_14::from_bits(p),
                force_threshold: Q5_10::from_bits(z),
            };
            let sensed = Force::fuse(contact.map(Q5_10::from_bits), Q1_14::from_bits(proximity), &rule);
            let jacobian = jacobian.map(Q1_14::from_bits);
            for force in [sensed, Force::from_steps(steps)] {
                prop_assert!(force.steps() >= 0);
                let torque = Torque::new(&jacobian, force);
                for ((row, exact), word) in jacobian.iter().zip(torque.exact_torques()).zip(torque.torque_words(TorqueFormat::Q3_12)) {
                    let real = row.to_f64() * force.to_f64();
                    prop_assert_eq!(exact.to_f64(), real);
                    let held = real.clamp(Q3_12::MIN.to_f64(), Q3_12::MAX.to_f64());
                    prop_assert!((Q3_12::from_bits(word).to_f64() - held).abs() <= 0.5 / 4_096.0);
                }
                for format in TorqueFormat::ALL {
                    let rounded = torque.exact_torques().map(|exact| format.round(exact));
                    prop_assert_eq!(torque.torque_words(format), rounded);
                    let bound = jacobian.iter().map(|row| row.to_bits().unsigned_abs()).max().unwrap_or(0);
                    let mut words = [0; MAX_JOINTS];
                    torque.write_words(&TorqueRounding::new(format, bound), &mut words);
                    prop_assert_eq!(words, rounded);
                }
            }
        }
    }
}
