//! The motion of the robot while accelerations are recorded: holds, moves from pose to pose, and swings about a pose.

use core::f64::consts::TAU;

use model::accelerometer::RobotState;
use serde::Serialize;

/// The time in which a swing grows to its amplitude, and in which it dies down at its end, in s.
const SWING_RAMP_S: f64 = 0.6;

/// A step of a motion.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "do", rename_all = "lowercase")]
pub enum MotionStep {
    /// The robot stands still.
    Hold {
        /// The pose: the position of each joint, in rad or m.
        at: Vec<f64>,
    },
    /// The robot moves from one pose to another; speed, acceleration and jerk are zero at both ends.
    Move {
        /// The pose at the start, in rad or m.
        from: Vec<f64>,
        /// The pose at the end, in rad or m.
        to: Vec<f64>,
    },
    /// Joints swing about a pose.
    Swing {
        /// The pose in the middle of the swing, in rad or m.
        about: Vec<f64>,
        /// The amplitude of each joint, in rad or m; 0 for joints that stand still.
        amplitude: Vec<f64>,
        /// The frequency of each joint, in Hz.
        rate_hz: Vec<f64>,
    },
}

/// A step of a motion with its start time and its duration.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TimedStep {
    /// The start time in s.
    pub at_s: f64,
    /// The duration in s.
    pub for_s: f64,
    /// The step.
    #[serde(flatten)]
    pub step: MotionStep,
}

/// A sequence of steps.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct MotionPlan {
    /// The steps, in order.
    pub steps: Vec<TimedStep>,
}

impl MotionPlan {
    /// Appends a step that lasts `for_s` seconds.
    pub fn push_step(&mut self, for_s: f64, step: MotionStep) {
        self.steps.push(TimedStep { at_s: self.length_s(), for_s, step });
    }

    /// Returns the total duration in s.
    #[must_use]
    pub fn length_s(&self) -> f64 {
        self.steps.last().map_or(0.0, |last| last.at_s + last.for_s)
    }

    /// Returns the positions, speeds and accelerations of the joints at a time in s; before the first step and after
    /// the last one the robot stands still.
    #[must_use]
    pub fn state_at(&self, time: f64) -> RobotState {
        let index = self.steps.partition_point(|step| step.at_s <= time).saturating_sub(1);
        let Some(TimedStep { at_s, for_s, step }) = self.steps.get(index) else {
            return RobotState::default();
        };
        let time = (time - at_s).clamp(0.0, *for_s);
        let mut state = RobotState::default();
        let joints = state.position.iter_mut().zip(&mut state.speed).zip(&mut state.acceleration);
        let joints = joints.map(|((position, speed), acceleration)| [position, speed, acceleration]);
        match step {
            MotionStep::Hold { at } => joints.zip(at).for_each(|([position, ..], at)| *position = *at),
            MotionStep::Move { from, to } => {
                let [share, rate, change] = rising_curve(time, *for_s);
                for ([position, speed, acceleration], (from, to)) in joints.zip(from.iter().zip(to)) {
                    *position = (to - from).mul_add(share, *from);
                    *speed = (to - from) * rate;
                    *acceleration = (to - from) * change;
                }
            }
            MotionStep::Swing { about, amplitude, rate_hz } => {
                let envelope = swing_envelope(time, *for_s);
                let each = about.iter().zip(amplitude).zip(rate_hz);
                for ([position, speed, acceleration], ((about, amplitude), rate)) in joints.zip(each) {
                    let [value, first, second] = enveloped_sine(envelope, TAU * rate, time);
                    *position = amplitude.mul_add(value, *about);
                    *speed = amplitude * first;
                    *acceleration = amplitude * second;
                }
            }
        }
        state
    }
}

/// Returns a curve that rises from 0 to 1 within `length`, with speed, acceleration and jerk zero at both ends: its
/// value and its first two derivatives at `time`.
fn rising_curve(time: f64, length: f64) -> [f64; 3] {
    if length <= 0.0 {
        return [1.0, 0.0, 0.0];
    }
    let x = (time / length).clamp(0.0, 1.0);
    let x3 = x * x * x;
    [
        x3 * x * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x))),
        140.0 * x3 * (1.0 - x).powi(3) / length,
        420.0 * x * x * (1.0 - x).powi(2) * (1.0 - 2.0 * x) / (length * length),
    ]
}

/// The maximum speed and acceleration of [`rising_curve`] for a length of 1 s.
pub(crate) const RISING_CURVE_PEAKS: [f64; 2] = [2.187_5, 7.513_2];

/// Returns a curve that rises from 0 to 1 and falls to 0 within `length`: its value and its first two derivatives at
/// `time`.
fn swing_envelope(time: f64, length: f64) -> [f64; 3] {
    let ramp = SWING_RAMP_S.min(length / 2.0);
    if time < length / 2.0 {
        rising_curve(time, ramp)
    } else {
        let [value, first, second] = rising_curve(length - time, ramp);
        [value, -first, second]
    }
}

/// Returns a sine that is multiplied by an envelope: its value and its first two derivatives at `time`.
fn enveloped_sine([value, first, second]: [f64; 3], rate: f64, time: f64) -> [f64; 3] {
    let (sin, cos) = (rate * time).sin_cos();
    [
        value * sin,
        first * sin + value * rate * cos,
        second * sin + 2.0 * first * rate * cos - value * rate * rate * sin,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speeds_and_accelerations_are_the_differences_of_positions() {
        let mut motion = MotionPlan::default();
        motion.push_step(0.5, MotionStep::Hold { at: vec![0.1, -0.2] });
        motion.push_step(1.0, MotionStep::Move { from: vec![0.1, -0.2], to: vec![0.7, 0.4] });
        let swing =
            MotionStep::Swing { about: vec![0.7, 0.4], amplitude: vec![0.2, 0.1], rate_hz: vec![1.0, 1.3] };
        motion.push_step(3.0, swing);
        let step = 1e-4;
        for at in 1..4_499 {
            let time = f64::from(at) * 1e-3;
            let [before, now, after] = [time - step, time, time + step].map(|time| motion.state_at(time));
            for joint in 0..2 {
                let position = |state: &RobotState| state.position[joint];
                let speed = (position(&after) - position(&before)) / (2.0 * step);
                let acceleration =
                    (position(&after) - 2.0 * position(&now) + position(&before)) / (step * step);
                assert!((speed - now.speed[joint]).abs() < 1e-4, "{time}");
                assert!((acceleration - now.acceleration[joint]).abs() < 2e-2, "{time}: {acceleration}");
            }
        }
    }

    #[test]
    fn a_move_is_as_quick_as_its_peaks_say() {
        let samples = || (0..=10_000).map(|at| rising_curve(f64::from(at) * 1e-4, 1.0));
        let peak = |index: usize| samples().map(|it| it[index].abs()).fold(0.0, f64::max);
        assert!(
            (peak(1) - RISING_CURVE_PEAKS[0]).abs() < 1e-4 && (peak(2) - RISING_CURVE_PEAKS[1]).abs() < 1e-3,
            "{}",
            peak(2)
        );
    }
}
