//! Checks of the times that the cell takes to answer.

use protocol::parameters::MAX_JOINTS;
use protocol::time::Span;

use crate::arm;
use crate::bus::StopReason;
use crate::session::Session;
use crate::timings::{ANSWER_LIMITS_MS, AnswerTimeCounts};

impl Session<'_> {
    /// Measures answer times at 62.5 joints a second. Late answers are measured again, because the computer of a
    /// simulated cell may be busy for a while.
    pub(crate) fn measure_answer_times(&mut self) -> Result<(), StopReason> {
        const MAX_MEASURING_ATTEMPTS: usize = 4;
        const MEASURED_JOINTS_COUNT: usize = 150;
        const MIN_REMAINING_TIME: Span = Span::from_millis(15_000);
        const MEASURED_ANSWERS: [&str; 3] = ["torque", "heartbeat to sync", "configured"];
        for attempt in 0..MAX_MEASURING_ATTEMPTS {
            let late =
                |name| self.timings.0.get(name).is_some_and(|times: &AnswerTimeCounts| !times.are_in_time());
            let is_late = MEASURED_ANSWERS.iter().any(|name| late(*name));
            if attempt > 0 && !is_late || self.remaining_time() < MIN_REMAINING_TIME {
                break;
            }
            if is_late {
                self.timings.0.retain(|name, _| !MEASURED_ANSWERS.contains(name));
            }
            self.prepare_cell(&arm::fast_example_parameters(6))?;
            for step in 0..self.reduced_attempts(MEASURED_JOINTS_COUNT) {
                if self.about.test_mode {
                    self.send_stimulus(arm::press_with_sum(4_096))?;
                }
                self.send_next_joints(&[0; MAX_JOINTS])?;
                if step.is_multiple_of(3) {
                    self.read_parameter(0)?;
                }
            }
        }
        Ok(())
    }

    /// Checks that answers were in time. One in 50 may be late, because the computer of a simulated cell may be busy.
    pub(crate) fn check_answer_times(&mut self) {
        for (name, limit) in ANSWER_LIMITS_MS {
            let Some(times) = self.timings.0.get(name).copied() else { continue };
            let AnswerTimeCounts { in_time, late, blameless, longest } = times;
            if in_time + late == 0 {
                self.findings
                    .mark_not_tested("TIME-2", format!("{name}: this computer was late in every attempt"));
                continue;
            }
            let is_so = times.are_in_time();
            self.begin_expected_exchange();
            self.check("TIME-2", is_so, || {
                format!(
                    "{name}: {late} of {} answers took more than {limit} ms, up to {:.1} ms ({blameless} \
                     more late answers do not count, because this computer was late)",
                    in_time + late,
                    longest.seconds() * 1e3
                )
            });
        }
    }
}
