//! Measures the ticks of the control loop for skins with any number of cells. The ticks run without threads, sockets or
//! waiting.

use std::sync::Arc;

use protocol::can::{Format, Frame};
use protocol::message::{Joints, Message, SkinSensors};
use protocol::packet::{Epoch, WORDS, pad_with_defaults};
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{Cell, Skin};
use protocol::time::{Micros, Span};

use control::controller::{Controller, ControllerInput, ControllerOutput, KinestheticController};
use control::cycle::turn::{BusPort, SharedRunState, TickDriver, TimedRecord};
use control::cycle::{ControlCycle, Tick};
use control::robot::SimulatedArm;
use model::generate::{GenerateError, SkinRequest, generate};
use model::scenario::{ModeChange, Scenario, TorqueSource, contact_words};
use model::table::{BusTable, Snapshot};

/// The maximum number of cells in Fig. 9 of the paper.
pub const MAX_CELLS: usize = 3_000;
/// The number of buses for [`MAX_CELLS`] cells.
pub const BUSES: usize = 12;
/// The joint positions of the arm while times are measured, in rad.
pub const ARM_POSE_RAD: [f64; WORDS] = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0];
/// The force on an active cell, in N.
const TOUCH_N: f64 = 1.5;
/// The number of ticks in an epoch, with 500 ticks and 62.5 epochs per second.
const TICKS_PER_EPOCH: u64 = 8;
/// The capacity of the queues for records and broadcasts between two epochs. It is much larger than needed.
const QUEUE_CAPACITY: usize = 64;

/// Returns the skin of a UR5 with this many cells on this many buses.
///
/// # Errors
/// Returns [`GenerateError`] if the cells do not fit on the buses.
pub fn generated_skin(cells: usize, buses: usize) -> Result<Skin, GenerateError> {
    let text = generate(&SkinRequest { cells, buses, ..SkinRequest::default() })?;
    Ok(Skin::parse("generated skin", &text)?)
}

/// Returns a skin that has only `cells` of the cells: the first ones of each bus. Their number differs by at most one
/// between buses.
#[must_use]
pub fn skin_with_fewer_cells(skin: &Skin, cells: usize) -> Skin {
    let buses = skin.buses.len().max(1);
    let share = |bus: usize| cells / buses + usize::from(bus < cells % buses);
    let of_bus = |bus: usize| skin.cells_on_bus(bus).take(share(bus)).cloned().collect::<Vec<_>>();
    Skin { cells: (0..buses).flat_map(of_bus).collect(), ..skin.clone() }
}

/// Returns the sensor values of a cell that is touched.
#[must_use]
pub fn touched_sensors() -> SkinSensors {
    SkinSensors { contact: contact_words(TOUCH_N), ..SkinSensors::default() }
}

/// Returns the sensor values of all cells if the first `active` cells, in the order of `spread`, are touched.
fn sensors_with_active_cells(cells: usize, active: usize) -> Vec<SkinSensors> {
    (0..cells).map(|cell| if cell < active { touched_sensors() } else { SkinSensors::default() }).collect()
}

/// Returns the snapshot that a bus receiver passes to the loop after the first `active` cells have replied. It is
/// computed from frames by the same table as in a bench.
fn snapshot(skin: &Skin, bus: usize, active: usize) -> Snapshot {
    let mut table = BusTable::new(skin, bus);
    let cells: Vec<&Cell> = skin.cells_on_bus(bus).collect();
    let epoch = Epoch(0);
    let mut hear = |own, message: Message| {
        for frame in message.encode().frames(Format::Fd) {
            table.handle_frame(Micros(100), own, &frame, &mut |_| None);
        }
    };
    hear(true, Message::Joints { epoch, joints: Joints { in_use: 6, ..Joints::default() } });
    for cell in cells.iter().take(active) {
        // The time of a tick does not depend on the value of the torque.
        hear(false, Message::Torque { from: cell.node, epoch, torque: [409; WORDS].into() });
    }
    Snapshot { sums: table.snapshot().sums, sensors: sensors_with_active_cells(cells.len(), active) }
}

/// A controller that computes what the kinesthetic controller computes, but does not move the arm. Otherwise the robot
/// would move to its limits, faster with many cells than with few, and their ticks would not be comparable.
struct HoldingController(KinestheticController);

impl Controller for HoldingController {
    fn step(&mut self, input: &ControllerInput) -> ControllerOutput {
        match self.0.step(input) {
            ControllerOutput::Move(velocity) => {
                ControllerOutput::Move(std::hint::black_box(velocity).map(|_| 0.0))
            }
            ControllerOutput::Bad(why) => ControllerOutput::Bad(why),
        }
    }
}

/// A control loop, and the receiving ends of its buses, which pass sums to the loop.
#[derive(Debug)]
pub struct TickBench {
    turn: TickDriver,
    buses: Vec<ReceiverEnds>,
    records: rtrb::Consumer<TimedRecord>,
    mode: TorqueSource,
    number: u64,
}

/// The ends of a bus receiver's channels to the loop.
#[derive(Debug)]
struct ReceiverEnds {
    snapshot: Snapshot,
    to_loop: triple_buffer::Input<Snapshot>,
    positions: rtrb::Consumer<(Epoch, [f64; MAX_JOINTS])>,
}

/// The mean times of the ticks in an epoch, in ns.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MeanTickTimes {
    /// The time of a tick without that of the central computation.
    pub tick: f64,
    /// The time of the central computation in a tick; 0 if there is none.
    pub central: f64,
}

impl TickBench {
    /// Creates a loop over a skin. The first `active` cells are touched, distributed evenly over the buses.
    ///
    /// # Panics
    /// Panics if the skin has an external controller, which a generated skin does not have.
    #[must_use]
    pub fn new(skin: &Skin, active: usize, mode: TorqueSource) -> Self {
        let buses = skin.buses.len();
        let share = |bus: usize| active / buses + usize::from(bus < active % buses);
        let (records_in, records) = rtrb::RingBuffer::new(QUEUE_CAPACITY);
        let mut lines = Vec::with_capacity(buses);
        let mut inlets = Vec::with_capacity(buses);
        for bus in 0..buses {
            let snapshot = snapshot(skin, bus, share(bus));
            let (to_loop, from_receiver) = triple_buffer::triple_buffer(&snapshot);
            let (positions_in, positions) = rtrb::RingBuffer::new(QUEUE_CAPACITY);
            lines.push(BusPort {
                format: Format::Fd,
                snapshot: from_receiver,
                positions: positions_in,
                state: Arc::default(),
            });
            inlets.push(ReceiverEnds { snapshot, to_loop, positions });
        }
        let modes = vec![ModeChange { at: Micros(0), mode }];
        let scenario = Scenario { modes, ..Scenario::idle(Span::from_millis(1_000)) };
        let controller =
            HoldingController(KinestheticController::new(skin).expect("a generated skin moves by itself"));
        let cycle = ControlCycle::new(
            skin,
            Box::new(controller),
            Box::new(SimulatedArm::new(skin, pad_with_defaults(&ARM_POSE_RAD))),
        );
        let turn = TickDriver::new(
            cycle,
            lines,
            Arc::new(scenario),
            Arc::new(SharedRunState::default()),
            records_in,
        );
        Self { turn, buses: inlets, records, mode, number: 0 }
    }

    /// Runs the ticks of one epoch, each with a new snapshot. Returns their mean times.
    pub fn run_epoch(&mut self, now: impl Fn() -> u64 + Copy) -> MeanTickTimes {
        for _ in 0..TICKS_PER_EPOCH {
            for ReceiverEnds { snapshot, to_loop, positions } in &mut self.buses {
                // The epoch that was read back is that of the previous broadcast, as on a bus that works.
                let sent = self.number.checked_sub(1).map(|number| number / TICKS_PER_EPOCH);
                snapshot.sums.read_back = sent.map(|sent| Epoch(sent.to_le_bytes()[0]));
                to_loop.input_buffer_mut().copy_from(snapshot, self.mode == TorqueSource::Compare);
                to_loop.publish();
                while positions.pop().is_ok() {}
            }
            let tick = Tick { number: self.number, time: Micros(self.number * 2_000) };
            let take = |_, frames: &[Frame]| std::hint::black_box(!frames.is_empty());
            self.turn.run_tick(tick, 0, 0, now, take);
            self.number += 1;
        }
        let mut took = MeanTickTimes::default();
        while let Ok(TimedRecord { took_ns, central, .. }) = self.records.pop() {
            let central = central.map_or(0, |(nanos, _)| nanos);
            took.tick += nanos_to_float(took_ns.saturating_sub(central)) / 8.0;
            took.central += nanos_to_float(central) / 8.0;
        }
        took
    }

    /// Runs one more epoch and returns the state after it: the number of cells in the torque, the number of active
    /// cells in the central computation (`None` if there is none), and true if the robot is halted.
    pub fn state_after_epoch(&mut self, now: impl Fn() -> u64 + Copy) -> (u32, Option<u32>, bool) {
        self.run_epoch(now);
        let tick = Tick { number: self.number, time: Micros(self.number * 2_000) };
        self.turn.run_tick(tick, 0, 0, now, |_, _| true);
        self.number += 1;
        let timed = self.records.pop().ok();
        timed.map_or((0, None, true), |TimedRecord { record, central, .. }| {
            (record.contributing, central.map(|(_, total)| total.active), record.halted.is_some())
        })
    }
}

#[expect(clippy::cast_precision_loss, reason = "times far below 2^53 ns")]
pub(super) fn nanos_to_float(nanos: u64) -> f64 {
    nanos as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_skin_is_spread_evenly_and_its_ticks_know_who_is_touched() {
        let whole = generated_skin(240, BUSES).unwrap();
        for (cells, active) in [(0, 0), (30, 0), (30, 7), (240, 240)] {
            let part = skin_with_fewer_cells(&whole, cells);
            assert_eq!(part.cells.len(), cells);
            let counts: Vec<_> = (0..BUSES).map(|bus| part.cells_on_bus(bus).count()).collect();
            assert!(counts.iter().max().unwrap() - counts.iter().min().unwrap() <= 1, "{counts:?}");
            let target = u32::try_from(active).unwrap();
            let mut compared = TickBench::new(&part, active, TorqueSource::Compare);
            // The loop runs for more than a hundred ticks. If the broadcasts were not read back, the robot would be
            // halted.
            for _ in 0..20 {
                compared.run_epoch(|| 0);
            }
            assert_eq!(compared.state_after_epoch(|| 0), (target, Some(target), false));
            let mut distributed = TickBench::new(&part, active, TorqueSource::Distributed);
            assert_eq!(distributed.state_after_epoch(|| 0), (target, None, false));
        }
    }

    /// The clock advances by 1 ns per reading. A tick reads it at its start, before and after the central computation,
    /// and at its end.
    #[test]
    fn a_tick_is_told_without_its_central_computation() {
        let part = skin_with_fewer_cells(&generated_skin(BUSES, BUSES).unwrap(), BUSES);
        let clock = std::cell::Cell::new(0);
        let now = || {
            clock.set(clock.get() + 1);
            clock.get()
        };
        let took = |mode| TickBench::new(&part, 0, mode).run_epoch(now);
        assert_eq!(took(TorqueSource::Compare), MeanTickTimes { tick: 2.0, central: 1.0 });
        assert_eq!(took(TorqueSource::Distributed), MeanTickTimes { tick: 1.0, central: 0.0 });
    }
}
