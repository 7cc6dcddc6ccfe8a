//! Accelerations that simulated cells measure as the robot is commanded to move.
//!
//! If the motion is known in advance, the stimuli are sent ahead of their epochs, like those of touches. Otherwise, and
//! while the robot is halted, they hold the motion of the last tick, and cells latch them with the next joints: one
//! broadcast late.

use model::accelerometer::kinematics::UPRIGHT_GRAVITY;
use model::accelerometer::{Accelerometers, RobotState};
use protocol::fixed::Q3_12;
use protocol::id::Node;
use protocol::message::{Message, SensorPage, StimulusStart};
use protocol::packet::Epoch;
use protocol::skin::Cell;

use super::RunOptions;

/// Motion of the robot in a tick.
#[derive(Clone, Copy, Debug)]
pub(super) struct TickMotion {
    /// Start of the tick in s since the start of the loop.
    pub(super) at_s: f64,
    pub(super) state: RobotState,
    pub(super) is_halted: bool,
}

impl TickMotion {
    /// Returns the state of the robot `seconds` before the tick (at most 0.1 s), at constant acceleration.
    fn state_before(&self, seconds: f64) -> RobotState {
        let mut state = self.state;
        let dt = (seconds - self.at_s).clamp(-0.1, 0.0);
        let joints = state.position.iter_mut().zip(&mut state.speed).zip(&state.acceleration);
        for ((position, speed), acceleration) in joints {
            *position += dt * (*speed + dt / 2.0 * acceleration);
            *speed += dt * acceleration;
        }
        state
    }
}

/// Accelerometers of a run.
#[derive(Debug)]
pub(super) struct Accelerations {
    sensors: Accelerometers,
    /// Number of broadcasts so far when the last tick's motion was sent.
    broadcasts: u64,
}

impl Accelerations {
    /// Creates the accelerometers of the scenario, if it has any.
    pub(super) fn new(options: &RunOptions) -> Option<Self> {
        let sheet = options.scenario.sensors.acceleration?;
        let sensors = Accelerometers::new(&options.skin, &sheet, options.scenario.seed, UPRIGHT_GRAVITY);
        Some(Self { sensors, broadcasts: 0 })
    }

    /// Returns the stimuli of a future epoch for each bus, or an empty list if the motion is not known in advance.
    /// `now` is the time in s since the start of the loop.
    pub(super) fn stimuli_for_future_epoch(
        &self,
        options: &RunOptions,
        moved: Option<TickMotion>,
        (epoch, now): (Epoch, f64),
    ) -> Vec<(usize, Message)> {
        if moved.is_some_and(|moved| moved.is_halted) {
            return Vec::new();
        }
        match (&options.planned, options.scenario.motion) {
            (Some(planned), _) => self.acceleration_stimuli(
                options,
                |seconds| planned.state_at(seconds),
                now,
                StimulusStart::Epoch(epoch),
            ),
            (None, motion) if motion.state_at(now).is_some() => {
                let state = |seconds| motion.state_at(seconds).unwrap_or_default();
                self.acceleration_stimuli(options, state, now, StimulusStart::Epoch(epoch))
            }
            (None, _) => Vec::new(),
        }
    }

    /// Returns the stimuli that follow the latest broadcast, once per broadcast, or an empty list if they were sent
    /// ahead.
    pub(super) fn latest_stimuli(
        &mut self,
        options: &RunOptions,
        moved: Option<TickMotion>,
        (broadcasts, now): (u64, f64),
    ) -> Vec<(usize, Message)> {
        let is_known = options.planned.is_some() || options.scenario.motion.state_at(now).is_some();
        match moved {
            Some(moved) if self.broadcasts != broadcasts && (moved.is_halted || !is_known) => {
                self.broadcasts = broadcasts;
                self.acceleration_stimuli(
                    options,
                    |seconds| moved.state_before(seconds),
                    now,
                    StimulusStart::Next,
                )
            }
            _ => Vec::new(),
        }
    }

    fn acceleration_stimuli(
        &self,
        options: &RunOptions,
        state: impl Fn(f64) -> RobotState,
        now: f64,
        from: StimulusStart,
    ) -> Vec<(usize, Message)> {
        let readings = self.sensors.readings(&options.skin, state, now, |_, force| *force);
        let cells = options.skin.cells.iter().zip(readings);
        cells
            .map(|(&Cell { bus, node, .. }, reading)| {
                let words: [f64; 3] = reading.into();
                let page = SensorPage::Acceleration(words.map(Q3_12::nearest));
                (bus, Message::Stimulus { to: Node::Cell(node), from, page })
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_before_a_tick_follows_from_its_speeds_and_what_comes_after_it_is_unknown() {
        let mut state = RobotState::default();
        (state.position[1], state.speed[1], state.acceleration[1]) = (0.5, 1.0, -10.0);
        let moved = TickMotion { at_s: 2.0, state, is_halted: false };
        let before = moved.state_before(1.99);
        // q - v t + a t^2 / 2, v - a t.
        assert!((before.position[1] - (0.5 - 0.01 - 0.000_5)).abs() < 1e-12, "{before:?}");
        assert!((before.speed[1] - 1.1).abs() < 1e-12);
        assert_eq!(moved.state_before(2.5), state);
    }
}
