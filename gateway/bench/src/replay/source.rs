//! The thread that reads the capture, ahead of what is sent.

use std::sync::atomic::Ordering;
use std::time::Duration;

use super::checks::Checks;
use super::hall::Hall;
use super::reel::{Cut, Reel, Selection, Step, reason};
use trace::capture::{CaptureError, Entry, Reader};

/// Steps that are read ahead: some tenths of a second of a full bus.
pub(super) const AHEAD: usize = 16_384;
/// How long it is waited for room: what is read ahead lasts longer by far.
const PAUSE: Duration = Duration::from_millis(2);

/// Reads a capture, as often as it is replayed, and hands on what is to be done.
struct Source<'a> {
    hall: &'a Hall,
    reel: Reel<'a>,
    queue: rtrb::Producer<Step>,
}

/// Reads to the end, or until nobody wants more.
pub(super) fn read(hall: &Hall, queue: rtrb::Producer<Step>) -> Result<Cut, CaptureError> {
    let Checks { options, survey, routes, .. } = &hall.checks;
    let (lanes, hears) = (routes.lanes.clone(), options.hears());
    let selection = Selection { only: options.only, pick: options.pick.clone(), lanes, reads: hears };
    let mut source = Source { hall, reel: Reel::new(survey, &selection), queue };
    let mut pass = 0_u32;
    while options.passes.is_none_or(|passes| pass < passes) && !source.is_over() {
        if hears && (pass > 0 || !hall.checks.are_fresh()) {
            source.push(source.reel.restoring());
        }
        let mut judge = hall.judge();
        judge.record_begin();
        for (bus, lane) in survey.buses.iter().zip(&routes.lanes) {
            let Some(lane) = *lane else { continue };
            bus.in_force.iter().for_each(|message| judge.record(lane, message, false));
        }
        drop(judge);
        source.pass()?;
        pass = pass.saturating_add(1);
    }
    hall.judge().record_end();
    hall.ready.store(true, Ordering::Relaxed);
    Ok(source.reel.into_cut())
}

impl Source<'_> {
    fn pass(&mut self) -> Result<(), CaptureError> {
        let mut reader = Reader::open_all(&self.hall.checks.options.files)?;
        while let Some(entry) = reader.next()? {
            let Entry::Frame(record) = entry else {
                self.reel.skip(reason::NOTE);
                continue;
            };
            let flow = self.reel.take(&record, &mut self.hall.judge());
            self.push_steps();
            if flow.is_break() || self.is_over() {
                break;
            }
        }
        self.reel.end_pass(&mut self.hall.judge());
        self.push_steps();
        Ok(())
    }

    fn push_steps(&mut self) {
        while let Some(step) = self.reel.next_step() {
            self.push(step);
        }
    }

    fn push(&mut self, mut step: Step) {
        while let Err(rtrb::PushError::Full(back)) = self.queue.push(step) {
            self.hall.ready.store(true, Ordering::Relaxed);
            if self.is_over() {
                return;
            }
            step = back;
            std::thread::sleep(PAUSE);
        }
    }

    fn is_over(&self) -> bool {
        self.hall.is_over() || self.queue.is_abandoned()
    }
}
