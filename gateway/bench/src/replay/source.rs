//! The thread that reads the capture ahead of the player.

use std::sync::atomic::Ordering;
use std::time::Duration;

use super::checks::CellChecks;
use super::replay_plan::{FrameSelection, PlanSummary, PlayerStep, ReplayPlan, reason};
use super::shared_state::SharedState;
use trace::capture::{CaptureEntry, CaptureError, Reader};

/// Number of steps read ahead: some tenths of a second of traffic on a full bus.
pub(super) const STEP_QUEUE_LENGTH: usize = 16_384;
/// Pause while the queue is full. The steps in the queue last much longer than the pause.
const FULL_QUEUE_PAUSE: Duration = Duration::from_millis(2);

/// Reads a capture once per pass and queues the steps.
struct CaptureReader<'a> {
    shared_state: &'a SharedState,
    replay_plan: ReplayPlan<'a>,
    queue: rtrb::Producer<PlayerStep>,
}

/// Reads the capture to its end, or until the player has ended.
pub(super) fn read_capture(
    shared_state: &SharedState,
    queue: rtrb::Producer<PlayerStep>,
) -> Result<PlanSummary, CaptureError> {
    let CellChecks { options, survey, routes, .. } = &shared_state.checks;
    let (bus_links, hears) = (routes.destinations.clone(), options.receives_cell_messages());
    let selection = FrameSelection { only: options.only, destinations: bus_links, reads: hears };
    let mut source = CaptureReader { shared_state, replay_plan: ReplayPlan::new(survey, &selection), queue };
    let mut pass = 0_u32;
    while options.passes.is_none_or(|passes| pass < passes) && !source.is_over() {
        if hears && (pass > 0 || !shared_state.checks.are_cells_fresh()) {
            source.queue_step(source.replay_plan.restore_step());
        }
        let mut comparator = shared_state.comparator();
        comparator.expect_next_pass();
        for (bus, bus_link) in survey.buses.iter().zip(&routes.destinations) {
            let Some(bus_link) = *bus_link else { continue };
            bus.latched.iter().for_each(|message| comparator.expect_message(bus_link, message, false));
        }
        drop(comparator);
        source.read_pass()?;
        pass = pass.saturating_add(1);
    }
    shared_state.comparator().expect_end();
    shared_state.ready.store(true, Ordering::Relaxed);
    Ok(source.replay_plan.into_summary())
}

impl CaptureReader<'_> {
    fn read_pass(&mut self) -> Result<(), CaptureError> {
        let mut reader = Reader::open_all(&self.shared_state.checks.options.files)?;
        while let Some(entry) = reader.next()? {
            let CaptureEntry::Frame(record) = entry else {
                self.replay_plan.count_skipped(reason::NOTE_BETWEEN_FRAMES);
                continue;
            };
            let flow = self.replay_plan.add_frame(&record, &mut self.shared_state.comparator());
            self.push_steps();
            if flow.is_break() || self.is_over() {
                break;
            }
        }
        self.replay_plan.end_pass(&mut self.shared_state.comparator());
        self.push_steps();
        Ok(())
    }

    fn push_steps(&mut self) {
        while let Some(step) = self.replay_plan.next_step() {
            self.queue_step(step);
        }
    }

    fn queue_step(&mut self, mut step: PlayerStep) {
        while let Err(rtrb::PushError::Full(back)) = self.queue.push(step) {
            self.shared_state.ready.store(true, Ordering::Relaxed);
            if self.is_over() {
                return;
            }
            step = back;
            std::thread::sleep(FULL_QUEUE_PAUSE);
        }
    }

    fn is_over(&self) -> bool {
        self.shared_state.is_over() || self.queue.is_abandoned()
    }
}
