//! Smoothing: computes speeds and accelerations from positions of joints at regular times.
//!
//! Joints are broadcast in steps of 96 µrad, 62.5 times a second, and second differences of such words are mostly
//! rounding. A polynomial is therefore fitted to the words around each broadcast (Savitzky and Golay). Its derivatives
//! are evaluated slightly earlier than the broadcast, because sensors are read later than they measure.

use nalgebra::{SMatrix, SVector};
use protocol::parameters::MAX_JOINTS;

use model::accelerometer::kinematics::JointState;

/// The number of broadcasts in a window on each side of the middle one.
pub(crate) const HALF_WINDOW: usize = 10;
const WINDOW_LENGTH: usize = 2 * HALF_WINDOW + 1;
/// The number of coefficients of the polynomial.
const POLYNOMIAL_TERMS: usize = 7;

/// The resolution of a broadcast position, in rad.
pub(crate) const POSITION_STEP_RAD: f64 = core::f64::consts::TAU / 65_536.0;
/// The resolution of a broadcast position, in m.
pub(crate) const POSITION_STEP_M: f64 = 1.0 / 16_384.0;

/// The positions of the joints of a chain at one broadcast.
pub(crate) type JointPositions = [f64; MAX_JOINTS];

/// A least-squares fit of polynomials to windows of consecutive positions.
#[derive(Clone, Debug)]
pub(crate) struct Smoother {
    /// The matrix that maps the positions in a window to the polynomial's coefficients, with time in units of
    /// [`HALF_WINDOW`] periods.
    fit: SMatrix<f64, POLYNOMIAL_TERMS, WINDOW_LENGTH>,
    /// The matrix that maps the positions in a window to the residuals of the polynomial.
    left: SMatrix<f64, WINDOW_LENGTH, WINDOW_LENGTH>,
    /// The duration of half a window, in s.
    half_s: f64,
}

impl Smoother {
    /// Creates the fit for positions at intervals of `period_s`.
    #[must_use]
    pub(crate) fn new(period_s: f64) -> Self {
        let powers = SMatrix::<f64, WINDOW_LENGTH, POLYNOMIAL_TERMS>::from_fn(|at, power| {
            let x = (as_f64(at) - as_f64(HALF_WINDOW)) / as_f64(HALF_WINDOW);
            x.powi(i32::try_from(power).unwrap_or_default())
        });
        let normal = powers.tr_mul(&powers);
        // The inverse exists: the times differ, and there are fewer terms than times.
        let fit = normal.try_inverse().map_or_else(SMatrix::zeros, |inverse| inverse * powers.transpose());
        let left = SMatrix::identity() - powers * fit;
        Self { fit, left, half_s: period_s * as_f64(HALF_WINDOW) }
    }

    /// Returns the root mean square distance of each of the first `joints` in a window from a smooth motion, or `None`
    /// if the window is incomplete.
    #[must_use]
    pub(crate) fn roughness(
        &self,
        window: &[Option<JointPositions>],
        joints: usize,
    ) -> Option<JointPositions> {
        let middle = window.get(HALF_WINDOW)?.as_ref().filter(|_| window.len() == WINDOW_LENGTH)?;
        let mut roughness = [0.0; MAX_JOINTS];
        for (joint, (rough, middle)) in roughness.iter_mut().zip(middle).take(joints).enumerate() {
            let mut series = SVector::<f64, WINDOW_LENGTH>::zeros();
            for (value, positions) in series.iter_mut().zip(window) {
                *value = positions.as_ref()?.get(joint)? - middle;
            }
            if series.amax() > 0.0 {
                *rough = (self.left * series).norm() / as_f64(WINDOW_LENGTH).sqrt();
            }
        }
        Some(roughness)
    }

    /// Returns the motion of the first `joints` at `earlier_s` before the middle of a window of positions, or `None` if
    /// the window is incomplete.
    #[must_use]
    pub(crate) fn joint_state(
        &self,
        window: &[Option<JointPositions>],
        joints: usize,
        earlier_s: f64,
    ) -> Option<JointState> {
        if window.len() != WINDOW_LENGTH {
            return None;
        }
        let x = -earlier_s / self.half_s;
        let mut weights = [SVector::<f64, WINDOW_LENGTH>::zeros(); 3];
        let powers = |order: usize| {
            SVector::<f64, POLYNOMIAL_TERMS>::from_fn(|power, _| {
                let factor: f64 = (0..order).map(|less| as_f64(power) - as_f64(less)).product();
                let left = power.checked_sub(order).and_then(|left| i32::try_from(left).ok());
                left.map_or(0.0, |left| factor * x.powi(left))
                    / self.half_s.powi(i32::try_from(order).unwrap_or(0))
            })
        };
        for (order, weights) in weights.iter_mut().enumerate() {
            *weights = self.fit.tr_mul(&powers(order));
        }
        let mut state = JointState::default();
        let [value, first, second] = &weights;
        for (at, positions) in window.iter().enumerate() {
            let positions = positions.as_ref()?;
            let [value, first, second] =
                [value, first, second].map(|weights| weights.get(at).copied().unwrap_or_default());
            let to = state.position.iter_mut().zip(&mut state.speed).zip(&mut state.acceleration);
            for (((position, speed), acceleration), from) in to.zip(positions).take(joints) {
                *position += value * from;
                *speed += first * from;
                *acceleration += second * from;
            }
        }
        Some(state)
    }
}

#[expect(clippy::cast_precision_loss, reason = "small counts")]
const fn as_f64(count: usize) -> f64 {
    count as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::TAU;

    /// Fits a swing as words, and returns the errors of position, speed and acceleration.
    fn off(rate_hz: f64, amplitude: f64, step: f64, earlier: f64) -> [f64; 3] {
        let (period, rate) = (0.016, TAU * rate_hz);
        let smoother = Smoother::new(period);
        let position = |at: f64| amplitude * (rate * at).sin();
        let words: Vec<_> = (0..500)
            .map(|at| {
                let exact = position(f64::from(at) * period);
                Some([if step > 0.0 { (exact / step).round() * step } else { exact }; MAX_JOINTS])
            })
            .collect();
        let mut worst = [0.0_f64; 3];
        for middle in HALF_WINDOW..words.len() - HALF_WINDOW {
            let state = smoother
                .joint_state(&words[middle - HALF_WINDOW..=middle + HALF_WINDOW], 1, earlier)
                .unwrap();
            let at = middle as f64 * period - earlier;
            let speed = amplitude * rate * (rate * at).cos();
            let acceleration = -rate * rate * position(at);
            let off = [state.position[0] - position(at), state.speed[0] - speed];
            worst = [
                worst[0].max(off[0].abs()),
                worst[1].max(off[1].abs()),
                worst[2].max((state.acceleration[0] - acceleration).abs()),
            ];
        }
        worst
    }

    #[test]
    fn a_swing_keeps_its_acceleration() {
        for earlier in [0.0, 0.01] {
            // 0.1 % of 0.2 rad, 1.9 rad/s and 17.8 rad/s2.
            let [position, speed, acceleration] = off(1.5, 0.2, 0.0, earlier);
            assert!(
                position < 2e-4 && speed < 1.9e-3 && acceleration < 1.8e-2,
                "{position} {speed} {acceleration}"
            );
            // With rounding, single errors.
            let [position, speed, acceleration] = off(1.0, 0.2, 95.9e-6, earlier);
            assert!(
                position < 1e-4 && speed < 5e-3 && acceleration < 0.2,
                "{position} {speed} {acceleration}"
            );
        }
    }

    #[test]
    fn a_window_with_a_gap_has_no_state() {
        let mut window = vec![Some([0.5; MAX_JOINTS]); WINDOW_LENGTH];
        let smoother = Smoother::new(0.016);
        let state = smoother.joint_state(&window, 2, 0.0).unwrap();
        assert!((state.position[1] - 0.5).abs() < 1e-9 && state.speed[1].abs() < 1e-9);
        assert!(state.position[2].abs() < 1e-12, "not in use");
        window[3] = None;
        assert!(smoother.joint_state(&window, 2, 0.0).is_none());
        assert!(smoother.joint_state(&window[1..], 2, 0.0).is_none());
        assert!(smoother.roughness(&window, 2).is_none());
    }

    #[test]
    fn one_position_that_lags_is_rough_and_rounding_is_not() {
        let (smoother, step) = (Smoother::new(0.016), POSITION_STEP_RAD);
        let position = |at: usize| 0.12 * (TAU * 0.016 * at as f64).sin();
        let words: Vec<_> =
            (0..400).map(|at| Some([(position(at) / step).round() * step; MAX_JOINTS])).collect();
        for window in words.windows(WINDOW_LENGTH) {
            assert!(smoother.roughness(window, 1).unwrap()[0] < step / 2.0);
        }
        let mut late = words[100..100 + WINDOW_LENGTH].to_vec();
        // Polynomials with this number of terms follow the first and the last position.
        for place in 1..WINDOW_LENGTH - 1 {
            let before = late[place];
            late[place].as_mut().unwrap()[0] -= 10.0 * step;
            assert!(smoother.roughness(&late, 1).unwrap()[0] > 1.2 * step, "{place}");
            late[place] = before;
        }
    }
}
