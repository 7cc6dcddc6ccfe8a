//! How long answers took.

use std::collections::BTreeMap;

use protocol::parameters::MAX_JOINTS;
use protocol::time::Span;

use crate::arm;
use crate::bus::Stop;
use crate::session::Session;

/// A bench that was late by more than this does not blame the cell for what was late meanwhile.
const LATE: Span = Span::from_millis(1);

/// What is limited by TIME-2, and by how many ms.
const LIMITS: [(&str, u64); 6] = [
    ("torque", 4),
    ("heartbeat to sync", 10),
    ("heartbeat to a claimant", 20),
    ("configured", 50),
    ("commit", 300),
    ("report", 100),
];

#[derive(Clone, Copy, Debug, Default)]
struct Times {
    in_time: usize,
    late: usize,
    /// Late, and so was the bench.
    blameless: usize,
    longest: Span,
}

/// Times of answers by what they answer.
#[derive(Clone, Debug, Default)]
pub(crate) struct Timings(BTreeMap<&'static str, Times>);

impl Timings {
    /// An answer took so long, while the bench was so late itself.
    pub(crate) fn note(&mut self, what: &'static str, took: Span, bench: Span) {
        let times = self.0.entry(what).or_default();
        let limit = LIMITS.iter().find(|(name, _)| *name == what);
        let is_late = limit.is_some_and(|(_, limit)| took > Span::from_millis(*limit));
        match (is_late, bench > LATE) {
            (false, _) => times.in_time += 1,
            (true, true) => times.blameless += 1,
            (true, false) => times.late += 1,
        }
        if bench <= LATE {
            times.longest = times.longest.max(took);
        }
    }
}

impl Times {
    /// Of many answers one in 50 may be late.
    const fn are_right(self) -> bool {
        self.late * 50 <= self.in_time + self.late || self.late == 1 && self.in_time > 0
    }
}

impl Session<'_> {
    /// Measures how long answers take at 62.5 joints a second; again what came too late, for the computer of a simulated cell
    /// may be busy for a while.
    pub(crate) fn measure_times(&mut self) -> Result<(), Stop> {
        const ATTEMPTS: usize = 4;
        const ANSWERS: usize = 150;
        const TIME: Span = Span::from_millis(15_000);
        const MEASURED: [&str; 3] = ["torque", "heartbeat to sync", "configured"];
        for attempt in 0..ATTEMPTS {
            let late = |name| self.timings.0.get(name).is_some_and(|times: &Times| !times.are_right());
            let is_late = MEASURED.iter().any(|name| late(*name));
            if attempt > 0 && !is_late || self.left() < TIME {
                break;
            }
            if is_late {
                self.timings.0.retain(|name, _| !MEASURED.contains(name));
            }
            self.ready(&arm::in_time(6))?;
            for step in 0..self.attempts(ANSWERS) {
                if self.about.test_mode {
                    self.press(arm::press(4_096))?;
                }
                self.step(&[0; MAX_JOINTS])?;
                if step.is_multiple_of(3) {
                    self.read(0)?;
                }
            }
        }
        Ok(())
    }

    /// Whether answers were in time: of many, one in 50 may be late, for the computer of a simulated cell may be.
    pub(crate) fn check_times(&mut self) {
        for (name, limit) in LIMITS {
            let Some(times) = self.timings.0.get(name).copied() else { continue };
            let Times { in_time, late, blameless, longest } = times;
            if in_time + late == 0 {
                self.findings.not_tested("TIME-2", format!("{name}: the bench was late each time"));
                continue;
            }
            let is_so = times.are_right();
            self.start();
            self.check("TIME-2", is_so, || {
                format!(
                    "{name}: {late} of {} answers came after more than {limit} ms, up to {:.1} ms ({blameless} more \
                     while the bench was late)",
                    in_time + late,
                    longest.seconds() * 1e3
                )
            });
        }
    }
}
