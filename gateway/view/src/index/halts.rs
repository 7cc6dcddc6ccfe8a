//! The reasons of halts, from the timing of the loop that a recording contains.

use trace::ros2::skin::LoopTiming;

/// The halts of a recording, with their reasons.
#[derive(Debug, Default)]
pub(super) struct HaltReasons {
    /// The times in ns since 1970 at which the state changed, each with the reason of the halt that began there.
    changes: Vec<(u64, Option<String>)>,
    /// The reason of the last bad cycle.
    last_bad: u8,
    has_ticks: bool,
}

impl HaltReasons {
    /// Returns true if the recording contains reasons of halts.
    pub(super) const fn are_known(&self) -> bool {
        self.has_ticks
    }

    /// Adds the next tick, at a time in ns since 1970. Returns the reason of a halt that begins with it.
    pub(super) fn add_tick(&mut self, at: u64, timing: &LoopTiming) -> Option<String> {
        self.has_ticks = true;
        let was_halted = self.changes.last().is_some_and(|(_, reason)| reason.is_some());
        if timing.bad != 0 {
            self.last_bad = timing.bad;
        }
        if was_halted == (timing.halted != 0) {
            return None;
        }
        let reason = (timing.halted != 0).then(|| halt_text(timing.halted, self.last_bad));
        self.changes.push((at, reason.clone()));
        reason
    }

    /// Returns the reason of the halt at a time, and when it began.
    pub(super) fn reason_at(&self, at: u64) -> Option<(u64, String)> {
        let place = self.changes.partition_point(|(began, _)| *began <= at).checked_sub(1)?;
        let (began, reason) = self.changes.get(place)?;
        Some((*began, reason.clone()?))
    }
}

/// Returns the words of a run for the numbers in its recording.
fn halt_text(halted: u8, bad: u8) -> String {
    let bad = match bad {
        1 => "the torque is not valid",
        2 => "no external controller is connected",
        3 => "the external controller's answer is missing",
        4 => "the external controller sent nonsense",
        _ => "unknown reason",
    };
    match halted {
        1 => format!("too many bad cycles in a row: {bad}"),
        _ => "a halt frame was received".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_halt_has_its_reason_until_the_robot_is_resumed() {
        let mut halts = HaltReasons::default();
        assert!(!halts.are_known());
        let mut begun = Vec::new();
        for (at, bad, halted) in [(10, 0, 0), (20, 1, 0), (30, 1, 1), (40, 0, 1), (50, 0, 0), (60, 0, 2)] {
            let timing = LoopTiming { bad, halted, ..LoopTiming::default() };
            begun.extend(halts.add_tick(at, &timing).map(|_| at));
        }
        assert_eq!((begun, halts.are_known()), (vec![30, 60], true));
        assert_eq!(halts.reason_at(29), None);
        let reason = "too many bad cycles in a row: the torque is not valid".to_owned();
        assert_eq!(
            [halts.reason_at(30), halts.reason_at(49)],
            [Some((30, reason.clone())), Some((30, reason))]
        );
        assert_eq!(halts.reason_at(55), None);
        assert_eq!(halts.reason_at(u64::MAX), Some((60, "a halt frame was received".to_owned())));
    }
}
