//! What the ticks of a recording say: joints, torques, the loop's timing.

use hdrhistogram::Histogram;

use super::{COLUMNS, GRAIN_S};
use crate::report::thin::Thinned;
use model::quantiles::histogram;
use trace::ros2::read::{Joints, Torques};
use trace::ros2::skin::LoopTiming;

/// Changes of the loop that are named.
const TURNS: usize = 12;

/// What the ticks said.
#[derive(Debug)]
pub(super) struct Motion {
    pub(super) position: Vec<Thinned>,
    pub(super) velocity: Vec<Thinned>,
    pub(super) distributed: Vec<Thinned>,
    pub(super) central: Vec<Thinned>,
    pub(super) active: Thinned,
    pub(super) contributing: Thinned,
    pub(super) late: Thinned,
    pub(super) took: Thinned,
    pub(super) central_took: Thinned,
    /// In ns.
    pub(super) late_ns: Histogram<u64>,
    pub(super) took_ns: Histogram<u64>,
    pub(super) central_ns: Histogram<u64>,
    /// Of ticks without a central computation.
    pub(super) plain_ns: Histogram<u64>,
    pub(super) ticks: u64,
    pub(super) skipped: u64,
    /// Ticks that happened, by their numbers, and are not in the recording.
    pub(super) unrecorded: u64,
    pub(super) bad: u64,
    pub(super) halted: u64,
    pub(super) refused: u64,
    /// Active cells of all ticks with a central computation together, and these ticks.
    pub(super) active_sum: (u64, u64),
    /// The first and the last tick, in s.
    pub(super) first: Option<f64>,
    pub(super) last: f64,
    /// When what changed.
    pub(super) turns: Vec<(f64, &'static str)>,
    number: Option<u64>,
    comparing: Option<bool>,
    halt: u8,
}

impl Motion {
    pub(super) fn new(joints: usize) -> Self {
        let thinned = || Thinned::new(COLUMNS, GRAIN_S);
        let each = || (0..joints).map(|_| thinned()).collect::<Vec<_>>();
        Self {
            position: each(),
            velocity: each(),
            distributed: each(),
            central: each(),
            active: thinned(),
            contributing: thinned(),
            late: thinned(),
            took: thinned(),
            central_took: thinned(),
            late_ns: histogram(),
            took_ns: histogram(),
            central_ns: histogram(),
            plain_ns: histogram(),
            ticks: 0,
            skipped: 0,
            unrecorded: 0,
            bad: 0,
            halted: 0,
            refused: 0,
            active_sum: (0, 0),
            first: None,
            last: 0.0,
            turns: Vec::new(),
            number: None,
            comparing: None,
            halt: 0,
        }
    }

    pub(super) fn joints(&mut self, at: f64, joints: &Joints) {
        for (series, value) in self.position.iter_mut().zip(&joints.position) {
            series.push(at, *value);
        }
        for (series, value) in self.velocity.iter_mut().zip(&joints.velocity) {
            series.push(at, *value);
        }
    }

    pub(super) fn torques(&mut self, at: f64, torques: &Torques) {
        for (series, value) in self.distributed.iter_mut().zip(&torques.distributed) {
            series.push(at, *value);
        }
        // Without a central computation the line has a gap.
        let central = torques.central.iter().copied().chain(std::iter::repeat(f64::NAN));
        for (series, value) in self.central.iter_mut().zip(central) {
            series.push(at, value);
        }
        let compared = !torques.central.is_empty();
        self.active.push(at, if compared { torques.active.into() } else { f64::NAN });
        if compared {
            self.active_sum = (self.active_sum.0 + u64::from(torques.active), self.active_sum.1 + 1);
        }
        if self.comparing.is_some_and(|before| before != compared) {
            self.turn(at, if compared { "central computation on" } else { "central computation off" });
        }
        self.comparing = Some(compared);
    }

    pub(super) fn timing(&mut self, at: f64, timing: &LoopTiming) {
        self.first.get_or_insert(at);
        self.last = self.last.max(at);
        self.ticks += 1;
        self.skipped = self.skipped.saturating_add(timing.skipped);
        if let Some(before) = self.number.replace(timing.tick) {
            let expected = before.saturating_add(1).saturating_add(timing.skipped);
            self.unrecorded = self.unrecorded.saturating_add(timing.tick.saturating_sub(expected));
        }
        self.bad += u64::from(timing.bad != 0);
        self.halted += u64::from(timing.halted != 0);
        self.refused += u64::from(timing.refused);
        self.contributing.push(at, timing.contributing.into());
        self.late.push(at, timing.late_us);
        self.took.push(at, timing.took_us);
        note(&mut self.late_ns, timing.late_us);
        note(&mut self.took_ns, timing.took_us);
        if timing.central_us > 0.0 {
            self.central_took.push(at, timing.central_us);
            note(&mut self.central_ns, timing.central_us);
        } else {
            self.central_took.push(at, f64::NAN);
            note(&mut self.plain_ns, timing.took_us);
        }
        if timing.halted != self.halt {
            self.halt = timing.halted;
            self.turn(at, if timing.halted == 0 { "goes on" } else { "halted" });
        }
    }

    fn turn(&mut self, at: f64, what: &'static str) {
        if self.turns.len() < TURNS {
            self.turns.push((at, what));
        }
    }

    /// From the first tick to the last, in s.
    pub(super) fn seconds(&self) -> f64 {
        self.first.map_or(0.0, |first| self.last - first)
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "not negative, and below 2^53 ns"
)]
fn note(histogram: &mut Histogram<u64>, micros: f64) {
    // The histogram grows by itself; it cannot refuse.
    let _ = histogram.record((micros.max(0.0) * 1e3).round() as u64);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_ticks_that_cannot_be_are_counted_as_far_as_a_count_goes() {
        let mut motion = Motion::new(1);
        for tick in [u64::MAX - 1, 0, u64::MAX] {
            motion.timing(0.0, &LoopTiming { tick, skipped: u64::MAX, ..LoopTiming::default() });
        }
        assert_eq!((motion.ticks, motion.skipped), (3, u64::MAX));
    }
}
