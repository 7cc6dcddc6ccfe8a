//! Checks of the times that the cell takes to answer.

use protocol::parameters::MAX_JOINTS;
use protocol::time::Span;

use crate::arm;
use crate::bus::StopReason;
use crate::session::Session;
use crate::timings::{ANSWER_LIMITS_MS, AnswerTimes};

impl Session<'_> {
    /// Measures answer times at 62.5 joints a second. Late answers are measured again, because the computer of a
    /// simulated cell may be busy for a while.
    pub(crate) fn measure_times(&mut self) -> Result<(), StopReason> {
        const ATTEMPTS: usize = 4;
        const MEASURED_STEPS: usize = 150;
        const REQUIRED_TIME: Span = Span::from_millis(15_000);
        const MEASURED_ANSWERS: [&str; 3] = ["torque", "heartbeat to sync", "configured"];
        for attempt in 0..ATTEMPTS {
            let late =
                |name| self.timings.0.get(name).is_some_and(|times: &AnswerTimes| !times.are_in_time());
            let is_late = MEASURED_ANSWERS.iter().any(|name| late(*name));
            if attempt > 0 && !is_late || self.remaining_time() < REQUIRED_TIME {
                break;
            }
            if is_late {
                self.timings.0.retain(|name, _| !MEASURED_ANSWERS.contains(name));
            }
            self.prepare_cell(&arm::fast_parameters(6))?;
            for step in 0..self.reduced_attempts(MEASURED_STEPS) {
                if self.about.test_mode {
                    self.press(arm::press_with_sum(4_096))?;
                }
                self.step(&[0; MAX_JOINTS])?;
                if step.is_multiple_of(3) {
                    self.read(0)?;
                }
            }
        }
        Ok(())
    }

    /// Checks that answers were in time. One in 50 may be late, because the computer of a simulated cell may be busy.
    pub(crate) fn check_times(&mut self) {
        for (name, limit) in ANSWER_LIMITS_MS {
            let Some(times) = self.timings.0.get(name).copied() else { continue };
            let AnswerTimes { in_time, late, blameless, longest } = times;
            if in_time + late == 0 {
                self.findings.not_tested("TIME-2", format!("{name}: the bench was late each time"));
                continue;
            }
            let is_so = times.are_in_time();
            self.begin_expected_exchange();
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
