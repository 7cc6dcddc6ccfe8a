//! Totals over the tick records of the control loop.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use protocol::skin::Skin;
use protocol::time::Span;

use super::accelerations::TickMotion;
use super::halts::HaltHistory;
use super::status_line::StatusLine;
use crate::remote::TickLateness;
use control::cycle::turn::TimedRecord;
use model::accelerometer::RobotState;
use model::scenario::TorqueSource;
use protocol::quantiles::{Quantiles, histogram};

/// Totals over the tick records of the control loop.
#[derive(Debug)]
pub(super) struct LoopTotals {
    pub(super) late: Histogram<u64>,
    pub(super) took: Histogram<u64>,
    pub(super) took_distributed: Histogram<u64>,
    pub(super) central: Histogram<u64>,
    pub(super) ticks: u64,
    pub(super) skipped: u64,
    pub(super) bad: BTreeMap<String, u64>,
    /// Number of ticks without data from a bus, by the bus's bit in the record of a tick.
    pub(super) missing: [u64; 32],
    pub(super) halts: HaltHistory,
    last: Option<TimedRecord>,
    before: Option<TimedRecord>,
    /// Start of the interval for which `recent` holds values.
    since: Instant,
    recent: Histogram<u64>,
    /// Figures of the ticks' lateness, updated once a second.
    pub(super) lateness: TickLateness,
    pub(super) first_broadcast_s: Option<f64>,
}

impl LoopTotals {
    pub(super) fn new() -> Self {
        Self {
            late: histogram(),
            took: histogram(),
            took_distributed: histogram(),
            central: histogram(),
            ticks: 0,
            skipped: 0,
            bad: BTreeMap::new(),
            missing: [0; 32],
            halts: HaltHistory::default(),
            last: None,
            before: None,
            since: Instant::now(),
            recent: histogram(),
            lateness: TickLateness::default(),
            first_broadcast_s: None,
        }
    }

    pub(super) fn add_records(&mut self, records: &mut rtrb::Consumer<TimedRecord>, began: Instant) {
        while let Ok(timed) = records.pop() {
            if self.first_broadcast_s.is_none() {
                self.first_broadcast_s = Some(began.elapsed().as_secs_f64());
            }
            self.ticks += 1;
            self.skipped += timed.record.skipped;
            record_value(&mut self.late, timed.late_ns);
            record_value(&mut self.recent, timed.late_ns);
            record_value(&mut self.took, timed.took_ns);
            match timed.central {
                Some((nanos, _)) => record_value(&mut self.central, nanos),
                None => record_value(&mut self.took_distributed, timed.took_ns),
            }
            for (bus, ticks) in self.missing.iter_mut().enumerate() {
                *ticks += u64::from(timed.record.missing >> bus & 1);
            }
            if let Some(bad) = timed.record.bad {
                *self.bad.entry(bad.to_string()).or_default() += 1;
            }
            self.halts.add_tick(&timed);
            self.before = self.last.replace(timed);
        }
        if self.since.elapsed() >= Duration::from_secs(1) {
            let [second, all] = [&self.recent, &self.late].map(|late| Quantiles::from_histogram(late, 1e-3));
            self.lateness = TickLateness { second, all, skipped: self.skipped };
            self.since = Instant::now();
            self.recent.reset();
        }
    }

    /// Returns the motion of the robot in the last tick.
    pub(super) fn last_motion(&self) -> Option<TickMotion> {
        let [before, last] = [self.before?, self.last?].map(|timed| timed.record);
        let [began, at_s] = [before, last].map(|record| Span(record.tick.time.0).seconds());
        let mut state = RobotState { position: last.q, speed: last.qdot, ..RobotState::default() };
        let speeds = last.qdot.iter().zip(before.qdot);
        for (acceleration, (now, before)) in state.acceleration.iter_mut().zip(speeds) {
            *acceleration = (now - before) / (at_s - began);
        }
        Some(TickMotion { at_s, state, is_halted: last.halted.is_some() })
    }

    /// Returns the text of the progress line for `width` columns.
    pub(super) fn progress_text(
        &self,
        elapsed: Duration,
        (duration, skin): (Span, &Skin),
        comparing: bool,
        lost: &[&str],
        width: Option<usize>,
    ) -> String {
        let Some(TimedRecord { record, .. }) = self.last else { return "starting".to_owned() };
        let line = StatusLine {
            elapsed_s: elapsed.as_secs_f64(),
            duration_s: duration.seconds(),
            lost,
            halted: self.halts.present_halt_reason(),
            contributing: record.contributing,
            cells: skin.cells.len(),
            stale: record.stale,
            dead: record.dead,
            late_us: Quantiles::from_histogram(&self.late, 1e-3).p99,
            mode: if comparing { TorqueSource::Compare } else { TorqueSource::Distributed }.name(),
            torque_nm: record.torque.get(..skin.robot.joints.len()).unwrap_or(&record.torque),
        };
        line.text(width)
    }
}

/// A histogram without a bound resizes itself, so recording cannot fail.
fn record_value(histogram: &mut Histogram<u64>, value: u64) {
    let _ = histogram.record(value);
}
