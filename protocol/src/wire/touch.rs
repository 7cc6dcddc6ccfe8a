//! Touch detection with hysteresis: a threshold for touch and a lower one for release, so that noise near a threshold
//! does not cause a stream of events.
//!
//! ```text
//!   value   ──────── threshold ───────────────── touched from here on
//!                    threshold * (1 - hysteresis) ── released below this
//!           ──────── 0 ───────────────────────── free
//! ```
//!
//! A cell in event mode and the programs that receive its measurements apply the same rule. The cell reports every
//! change of the state, so that both have the same state.

use crate::fixed::Q1_14;
use crate::message::SkinSensors;

/// The state of a value relative to its threshold.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum TouchState {
    /// The value has never reached its threshold, or has returned to zero after a release.
    #[default]
    Free,
    /// The value has reached the threshold and has not fallen far enough below it since.
    Touched,
    /// The value was released but has not returned to zero yet.
    Fading,
}

impl TouchState {
    /// Returns the state after a new value. Value and threshold are in the same steps; the value may be a sum of
    /// several words. A threshold of 0 counts as one step.
    #[must_use]
    pub fn next(self, value: i32, threshold: i16, hysteresis: Q1_14) -> Self {
        let threshold = i32::from(threshold).max(1);
        let kept = (1 << 14) - i64::from(hysteresis.to_bits());
        // Below threshold * (1 - hysteresis), compared exactly with 14 more fraction bits on both sides.
        let is_released = value <= 0 || i64::from(value) << 14 < i64::from(threshold) * kept;
        match self {
            _ if value >= threshold => Self::Touched,
            Self::Touched if !is_released => Self::Touched,
            Self::Touched | Self::Fading if value != 0 => Self::Fading,
            Self::Touched | Self::Fading | Self::Free => Self::Free,
        }
    }
}

/// Returns the contact force of a cell in steps of Q5.10: the sum of its three contact words.
#[must_use]
pub fn contact_force(skin: &SkinSensors) -> i32 {
    skin.contact.iter().map(|word| i32::from(word.to_bits())).sum()
}

#[cfg(test)]
mod tests {
    use super::TouchState::{Fading, Free, Touched};
    use super::*;

    fn course(hysteresis: f64, values: &[i32]) -> Vec<TouchState> {
        let mut touch = TouchState::default();
        let follow = |&value| {
            touch = touch.next(value, 100, Q1_14::nearest(hysteresis));
            touch
        };
        values.iter().map(follow).collect()
    }

    #[test]
    fn a_touch_begins_at_the_threshold_and_ends_below_what_hysteresis_leaves_of_it() {
        assert_eq!(
            course(0.5, &[99, 100, 99, 50, 49, 99, 100, 0]),
            [Free, Touched, Touched, Touched, Fading, Fading, Touched, Free]
        );
        assert_eq!(course(0.0, &[100, 99, 100, -5]), [Touched, Fading, Touched, Fading]);
        assert_eq!(
            course(1.0, &[100, 1, 0, 99]),
            [Touched, Touched, Free, Free],
            "only nothing is a release"
        );
    }

    #[test]
    fn zero_after_a_release_is_another_turn_and_zero_after_noise_is_none() {
        assert_eq!(course(0.5, &[100, 20, 10, 0, 10, 0]), [Touched, Fading, Fading, Free, Free, Free]);
    }

    #[test]
    fn without_a_threshold_everything_is_a_touch() {
        let next = |touch: TouchState, value| touch.next(value, 0, Q1_14::ZERO);
        assert_eq!((next(Free, 1), next(Touched, 0), next(Free, 0)), (Touched, Free, Free));
    }
}
