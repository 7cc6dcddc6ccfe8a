//! Series from the ticks of a recording: joints, torques, the loop's timing.

use crate::report::thin::ThinnedLine;
use protocol::quantiles::TimeHistogram;
use trace::ros2::read::{Joints, Torques};
use trace::ros2::skin::LoopTiming;

/// Names of the changes between a halted robot and one that moves.
pub(super) const HALTED: &str = "halted";
pub(super) const RESUMED: &str = "resumed";
/// Maximum number of changes of the control loop's state that are listed.
const MAX_LISTED_CHANGES: usize = 12;

/// The series and counts of all ticks.
#[derive(Debug, Default)]
pub(super) struct TickSeries {
    pub(super) position: Vec<ThinnedLine>,
    pub(super) velocity: Vec<ThinnedLine>,
    pub(super) distributed: Vec<ThinnedLine>,
    pub(super) central: Vec<ThinnedLine>,
    pub(super) active: ThinnedLine,
    pub(super) contributing: ThinnedLine,
    pub(super) late: TickDurations,
    pub(super) took: TickDurations,
    pub(super) central_took: TickDurations,
    /// Durations of ticks without a central computation.
    pub(super) plain: TimeHistogram,
    pub(super) counts: TickCounts,
    /// Sum of active cells over all ticks with a central computation, and the number of these ticks.
    pub(super) active_sum: (u64, u64),
    /// The first and the last tick in s; for frames only, the first joints and the last frame.
    pub(super) first: Option<f64>,
    pub(super) last: f64,
    /// Time in s and size of the largest number of skipped ticks.
    pub(super) skip: Option<(f64, u64)>,
    /// Changes of the control loop's state, with their times in s.
    pub(super) changes: Vec<(f64, &'static str)>,
    /// Number of halts, and the time of the first one in s.
    pub(super) halts: (u64, Option<f64>),
    number: Option<u64>,
    comparing: Option<bool>,
    halt: u8,
}

/// Counts of ticks.
#[derive(Debug, Default)]
pub(super) struct TickCounts {
    pub(super) ticks: u64,
    pub(super) skipped: u64,
    /// Ticks that were run, by their numbers, but are missing from the recording.
    pub(super) unrecorded: u64,
    pub(super) bad: u64,
    pub(super) halted: u64,
    pub(super) refused: u64,
}

/// The duration of a part of each tick: as a series in µs, and as a histogram.
#[derive(Debug, Default)]
pub(super) struct TickDurations {
    pub(super) line: ThinnedLine,
    pub(super) times: TimeHistogram,
}

impl TickDurations {
    fn push(&mut self, at: f64, micros: f64) {
        self.line.push(at, micros);
        self.times.record(micros_to_nanos(micros));
    }
}

impl TickSeries {
    pub(super) fn new(joints: usize) -> Self {
        let each = || vec![ThinnedLine::default(); joints];
        Self { position: each(), velocity: each(), distributed: each(), central: each(), ..Self::default() }
    }

    pub(super) fn record_joints(&mut self, at: f64, joints: &Joints) {
        push_points(&mut self.position, at, joints.position.iter().copied());
        push_points(&mut self.velocity, at, joints.velocity.iter().copied());
    }

    pub(super) fn record_torques(&mut self, at: f64, torques: &Torques) {
        push_points(&mut self.distributed, at, torques.distributed.iter().copied());
        // Without a central computation, the line has a gap.
        push_points(
            &mut self.central,
            at,
            torques.central.iter().copied().chain(std::iter::repeat(f64::NAN)),
        );
        let compared = !torques.central.is_empty();
        self.active.push(at, if compared { torques.active.into() } else { f64::NAN });
        if compared {
            self.active_sum = (self.active_sum.0 + u64::from(torques.active), self.active_sum.1 + 1);
        }
        if self.comparing.is_some_and(|before| before != compared) {
            self.record_change(
                at,
                if compared { "with central computation" } else { "without central computation" },
            );
        }
        self.comparing = Some(compared);
    }

    pub(super) fn record_timing(&mut self, at: f64, timing: &LoopTiming) {
        self.first.get_or_insert(at);
        self.last = self.last.max(at);
        self.counts.record_tick(timing, self.number.replace(timing.tick));
        if timing.skipped > self.skip.map_or(0, |(_, skipped)| skipped) {
            self.skip = Some((at, timing.skipped));
        }
        self.contributing.push(at, timing.contributing.into());
        self.late.push(at, timing.late_us);
        self.took.push(at, timing.took_us);
        if timing.central_us > 0.0 {
            self.central_took.push(at, timing.central_us);
        } else {
            self.central_took.line.push(at, f64::NAN);
            self.plain.record(micros_to_nanos(timing.took_us));
        }
        if timing.halted != self.halt {
            self.halt = timing.halted;
            self.record_change(at, if timing.halted == 0 { RESUMED } else { HALTED });
        }
    }

    pub(super) fn record_change(&mut self, at: f64, what: &'static str) {
        if what == HALTED {
            self.halts = (self.halts.0 + 1, self.halts.1.or(Some(at)));
        }
        if self.changes.len() < MAX_LISTED_CHANGES {
            self.changes.push((at, what));
        }
    }

    /// Returns the time from the first tick to the last, in s.
    pub(super) fn duration_s(&self) -> f64 {
        self.first.map_or(0.0, |first| self.last - first)
    }
}

impl TickCounts {
    /// Counts a tick, and the skipped or unrecorded ones since the tick with the number `before`.
    fn record_tick(&mut self, timing: &LoopTiming, before: Option<u64>) {
        self.ticks += 1;
        self.skipped = self.skipped.saturating_add(timing.skipped);
        if let Some(before) = before {
            let expected = before.saturating_add(1).saturating_add(timing.skipped);
            self.unrecorded = self.unrecorded.saturating_add(timing.tick.saturating_sub(expected));
        }
        self.bad += u64::from(timing.bad != 0);
        self.halted += u64::from(timing.halted != 0);
        self.refused += u64::from(timing.refused);
    }
}

fn push_points(lines: &mut [ThinnedLine], at: f64, values: impl Iterator<Item = f64>) {
    lines.iter_mut().zip(values).for_each(|(line, value)| line.push(at, value));
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "not negative, and below 2^53 ns"
)]
fn micros_to_nanos(micros: f64) -> u64 {
    (micros.max(0.0) * 1e3).round() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_ticks_that_cannot_be_are_counted_as_far_as_a_count_goes() {
        let mut motion = TickSeries::new(1);
        for tick in [u64::MAX - 1, 0, u64::MAX] {
            motion.record_timing(0.0, &LoopTiming { tick, skipped: u64::MAX, ..LoopTiming::default() });
        }
        assert_eq!((motion.counts.ticks, motion.counts.skipped), (3, u64::MAX));
    }
}
