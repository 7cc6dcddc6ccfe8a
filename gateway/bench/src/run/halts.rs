//! Halts of the robot with their reasons, and the ticks before the last halt.
//!
//! The main thread fills the ring of ticks from the loop's records, so that the loop itself has no extra work.

use std::collections::VecDeque;

use protocol::skin::Skin;
use protocol::time::{Micros, Span};

use crate::summary::{HaltSummary, TickSummary};
use control::cycle::Halt;
use control::cycle::carried::bus_bit;
use control::cycle::turn::TimedRecord;

/// Number of kept ticks: 0.4 s at 500 Hz.
const HALT_HISTORY_TICKS: usize = 200;
const MAX_LISTED_HALTS: usize = 100;

/// Halts of a run.
#[derive(Debug, Default)]
pub(super) struct HaltHistory {
    /// Latest ticks, at most [`HALT_HISTORY_TICKS`].
    ring: VecDeque<TimedRecord>,
    /// Ticks up to the last halt, at most [`HALT_HISTORY_TICKS`].
    before: Vec<TimedRecord>,
    halts: Vec<HaltSummary>,
    /// Number of ended halts that are not listed one by one.
    pub(super) further: u64,
    /// The present halt, if any.
    lasting: Option<HaltSummary>,
}

impl HaltHistory {
    /// Adds the next tick, and the begin or end of a halt.
    pub(super) fn add_tick(&mut self, timed: &TimedRecord) {
        if self.ring.len() == HALT_HISTORY_TICKS {
            self.ring.pop_front();
        }
        self.ring.push_back(*timed);
        let record = &timed.record;
        match (record.halted, &mut self.lasting) {
            (Some(why), None) => {
                self.before = self.ring.iter().copied().collect();
                self.lasting = Some(HaltSummary {
                    at_s: seconds(record.tick.time),
                    tick: record.tick.number,
                    epoch: record.epoch.0,
                    reason: halt_text(why),
                    until_s: None,
                });
            }
            (None, Some(halted)) => {
                halted.until_s = Some(seconds(record.tick.time));
                self.end_halt();
            }
            (Some(_), Some(_)) | (None, None) => {}
        }
    }

    fn end_halt(&mut self) {
        let Some(halted) = self.lasting.take() else { return };
        if self.halts.len() < MAX_LISTED_HALTS {
            self.halts.push(halted);
        } else {
            self.further += 1;
        }
    }

    /// Reason of the present halt, if any.
    pub(super) fn present_halt_reason(&self) -> Option<&str> {
        self.lasting.as_ref().map(|halted| halted.reason.as_str())
    }

    /// All listed halts, oldest first; a present halt is always included as the last.
    pub(super) fn halt_summaries(&self) -> Vec<HaltSummary> {
        self.halts.iter().chain(&self.lasting).cloned().collect()
    }

    /// Ticks up to the last halt, oldest first.
    pub(super) fn ticks_before_halt(&self, skin: &Skin) -> Vec<TickSummary> {
        self.before.iter().map(|timed| tick_summary(timed, skin)).collect()
    }
}

/// Converts a tick for the summary.
#[expect(clippy::cast_precision_loss, reason = "times far below 2^53 ns")]
fn tick_summary(timed: &TimedRecord, skin: &Skin) -> TickSummary {
    let record = &timed.record;
    let joints = |all: &[f64]| all.iter().copied().take(skin.robot.joints.len()).collect();
    let lost = skin.buses.iter().enumerate().filter(|(index, _)| record.missing & bus_bit(*index) != 0);
    TickSummary {
        tick: record.tick.number,
        time_s: seconds(record.tick.time),
        late_us: timed.late_ns as f64 / 1e3,
        took_us: timed.took_ns as f64 / 1e3,
        skipped: record.skipped,
        epoch: record.epoch.0,
        q_rad: joints(&record.q),
        qdot_rad_s: joints(&record.qdot),
        torque_nm: joints(&record.torque),
        valid: record.valid,
        contributing: record.contributing,
        age: record.age,
        stale: record.stale,
        dead: record.dead,
        lost_buses: lost.map(|(_, bus)| bus.name.clone()).collect(),
        bad_cycle: record.bad.map(|bad| bad.to_string()),
        command_rad_s: joints(&record.command),
        halted: record.halted.is_some(),
    }
}

fn halt_text(why: Halt) -> String {
    match why {
        Halt::BadCycles(why) => format!("too many bad cycles in a row: {why}"),
        Halt::Frame => "a halt frame was received".to_owned(),
    }
}

fn seconds(time: Micros) -> f64 {
    Span(time.0).seconds()
}

#[cfg(test)]
mod tests {
    use super::*;
    use control::controller::{BadCycle, Controller, ControllerInput, ControllerOutput};
    use control::cycle::carried::BusInput;
    use control::cycle::{ControlCycle, Tick};
    use control::robot::SimulatedArm;
    use model::table::BusTotals;
    use model::testing;
    use protocol::packet::pad_with_defaults;

    /// A controller that moves until a tick, and gives no answer after that.
    struct Until(u64);

    impl Controller for Until {
        fn step(&mut self, input: &ControllerInput) -> ControllerOutput {
            if input.tick < self.0 {
                ControllerOutput::Move(pad_with_defaults(&[0.25; 6]))
            } else {
                ControllerOutput::Bad(BadCycle::NoAnswer)
            }
        }
    }

    /// A control loop without a machine. Its records go to the code under test.
    struct Bench {
        cycle: ControlCycle,
        sums: BusTotals,
        halts: HaltHistory,
        tick: u64,
    }

    impl Bench {
        fn new(answers: u64) -> Self {
            let skin = testing::one_cell_skin();
            let robot = SimulatedArm::new(&skin, pad_with_defaults(&[0.0; 6]));
            let cycle = ControlCycle::new(&skin, Box::new(Until(answers)), Box::new(robot));
            Self { cycle, sums: BusTotals::default(), halts: HaltHistory::default(), tick: 0 }
        }

        fn ticks(&mut self, ticks: u64) {
            for _ in 0..ticks {
                let tick = Tick { number: self.tick, time: Micros(self.tick * 2_000) };
                let heard = BusInput { sums: &self.sums, works: true };
                let outcome = self.cycle.tick(tick, 0, [heard]);
                if let Some(epoch) = outcome.broadcast {
                    self.sums.read_back = Some(epoch);
                }
                let record = outcome.record;
                self.halts.add_tick(&TimedRecord {
                    record,
                    due_ns: 0,
                    late_ns: 1_500,
                    took_ns: 2_500,
                    central: None,
                });
                self.tick += 1;
            }
        }
    }

    #[test]
    fn the_ticks_before_a_halt_are_kept_after_it() {
        let limit = u64::from(testing::one_cell_skin().safety.bad_cycles);
        let mut bench = Bench::new(1_000);
        bench.ticks(1_000 + limit - 1);
        assert_eq!((bench.halts.present_halt_reason(), bench.halts.halt_summaries().len()), (None, 0));
        bench.ticks(5_000);
        let [halted] = bench.halts.halt_summaries().try_into().unwrap();
        let tick = 1_000 + limit - 1;
        let reason = "too many bad cycles in a row: the external controller's answer is missing";
        assert_eq!((halted.tick, halted.reason.as_str(), halted.until_s), (tick, reason, None));
        assert_eq!(bench.halts.present_halt_reason(), Some(reason));
        assert!((halted.at_s - f64::from(u32::try_from(tick).unwrap()) * 0.002).abs() < 1e-9, "{halted:?}");
        assert_eq!(u64::from(halted.epoch), tick / 8 % 256, "of the last joints, as the bus has it");

        let before = bench.halts.ticks_before_halt(&testing::one_cell_skin());
        let ticks: Vec<_> = before.iter().map(|it| it.tick).collect();
        assert_eq!(ticks, (tick - 199..=tick).collect::<Vec<_>>());
        for it in &before {
            let bad = it.tick >= 1_000;
            assert_eq!((it.bad_cycle.is_some(), it.valid, it.halted), (bad, true, it.tick == tick), "{it:?}");
            let command = if it.halted { 0.0 } else { 0.25 };
            assert!(it.command_rad_s.iter().all(|speed| (speed - command).abs() < 1e-9), "{it:?}");
            assert!((it.late_us - 1.5).abs() < 1e-9 && (it.took_us - 2.5).abs() < 1e-9);
        }
    }

    #[test]
    fn halts_that_were_resumed_have_their_ends_and_are_bounded() {
        let mut bench = Bench::new(u64::MAX);
        bench.ticks(10);
        for _ in 0..150 {
            bench.sums.halts += 1;
            bench.ticks(3);
            assert_eq!(bench.halts.present_halt_reason(), Some("a halt frame was received"));
            bench.sums.resumes += 1;
            bench.ticks(2);
            assert_eq!(bench.halts.present_halt_reason(), None);
        }
        let all = bench.halts.halt_summaries();
        assert_eq!((all.len(), bench.halts.further), (MAX_LISTED_HALTS, 50));
        for (number, halted) in (0_u64..).zip(&all) {
            assert_eq!(halted.tick, 10 + 5 * number);
            let lasted = halted.until_s.unwrap() - halted.at_s;
            assert!((lasted - 0.006).abs() < 1e-9, "{halted:?}");
        }
        bench.sums.halts += 1;
        bench.ticks(1);
        let all = bench.halts.halt_summaries();
        assert_eq!(
            (all.len(), all.last().unwrap().until_s),
            (MAX_LISTED_HALTS + 1, None),
            "one that lasts is always there"
        );
        assert_eq!(
            bench.halts.ticks_before_halt(&testing::one_cell_skin()).last().unwrap().tick,
            all.last().unwrap().tick
        );
    }
}
