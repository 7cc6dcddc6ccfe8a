//! The thread that reads the capture, ahead of what is sent.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::checks::Checks;
use super::hall::Hall;
use super::reel::{Cut, Flow, Reel, Selection, Step, reason};
use trace::capture::{CaptureError, Entry, Reader};

/// Steps that are read ahead: some tenths of a second of a full bus.
pub(super) const AHEAD: usize = 16_384;
/// How long it is waited for room: what is read ahead lasts longer by far.
const PAUSE: Duration = Duration::from_millis(2);

/// Reads a capture so many times (without end when there is no number), and hands on what is to be done.
#[derive(Debug)]
pub(super) struct Source {
    pub(super) checks: Arc<Checks>,
    pub(super) selection: Selection,
    pub(super) passes: Option<u32>,
    /// Whether the state in force is brought about before the first pass, and before the others.
    pub(super) restores: (bool, bool),
    pub(super) hall: Arc<Hall>,
    /// Set when the queue is full for the first time, or all has been read.
    pub(super) ready: Arc<AtomicBool>,
}

impl Source {
    /// Reads to the end, or until nobody wants more.
    pub(super) fn run(self, files: &[PathBuf], mut queue: rtrb::Producer<Step>) -> Result<Cut, CaptureError> {
        let mut reel = Reel::new(&self.checks.survey, &self.selection);
        let mut pass = 0_u32;
        while self.passes.is_none_or(|passes| pass < passes) && !self.is_over(&queue) {
            if if pass == 0 { self.restores.0 } else { self.restores.1 } {
                self.push(&mut queue, reel.restoring());
            }
            let mut judge = self.hall.judge();
            judge.record_begin();
            for (bus, lane) in self.checks.survey.buses.iter().zip(&self.selection.lanes) {
                let in_force =
                    lane.iter().flat_map(|lane| bus.in_force.iter().map(|message| (*lane, message)));
                in_force.for_each(|(lane, message)| judge.record(lane, message, false));
            }
            drop(judge);
            self.pass(files, &mut reel, &mut queue)?;
            pass = pass.saturating_add(1);
        }
        self.hall.judge().record_end();
        self.ready.store(true, Ordering::Relaxed);
        Ok(reel.into_cut())
    }

    fn pass(
        &self,
        files: &[PathBuf],
        reel: &mut Reel<'_>,
        queue: &mut rtrb::Producer<Step>,
    ) -> Result<(), CaptureError> {
        let mut reader = Reader::open_all(files)?;
        let mut steps = Vec::new();
        while let Some(entry) = reader.next()? {
            let Entry::Frame(record) = entry else {
                reel.skip(reason::NOTE);
                continue;
            };
            let flow = reel.take(&record, &mut self.hall.judge(), |step| steps.push(step));
            for step in steps.drain(..) {
                self.push(queue, step);
            }
            if flow == Flow::Enough || self.is_over(queue) {
                break;
            }
        }
        reel.end_pass(&mut self.hall.judge(), |step| steps.push(step));
        for step in steps {
            self.push(queue, step);
        }
        Ok(())
    }

    fn push(&self, queue: &mut rtrb::Producer<Step>, mut step: Step) {
        while let Err(rtrb::PushError::Full(back)) = queue.push(step) {
            self.ready.store(true, Ordering::Relaxed);
            if self.is_over(queue) {
                return;
            }
            step = back;
            std::thread::sleep(PAUSE);
        }
    }

    fn is_over(&self, queue: &rtrb::Producer<Step>) -> bool {
        self.hall.is_over() || queue.is_abandoned()
    }
}
