//! Duration of one tick of the control loop: `cargo bench -p gateway --bench tick`
//!
//! Measures 1 to 10 000 cells, 253 per bus, over complete epochs (one tick in eight sends joints to every bus, which
//! takes no time here). *Distributed* leaves the torques to the cells; *central* computes them in the tick, with no
//! cell in contact, or all. The receivers fill the snapshots, which is not measured.

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bench::bus::realtime;
use control::controller::KinestheticController;
use control::cycle::turn::{BusPort, SharedRunState, TickDriver, TimedRecord};
use control::cycle::{ControlCycle, Tick};
use control::robot::SimulatedArm;
use criterion::{BenchmarkId, Criterion};
use model::generate::{SkinRequest, generate};
use model::scenario::{ModeChange, Scenario, TorqueSource};
use model::table::{BusTotals, Snapshot};
use protocol::fixed::{Q1_14, Q5_10};
use protocol::message::SkinSensors;
use protocol::packet::pad_with_defaults;
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{Skin, SkinBus};
use protocol::time::{Micros, Span};

const CELLS_PER_BUS: usize = 253;
/// Number of ticks per broadcast.
const TICKS_PER_EPOCH: u64 = 8;

/// Work of the loop, and the contact states.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum BenchCase {
    Distributed,
    CentralNoneActive,
    CentralAllActive,
}

impl BenchCase {
    const ALL: [Self; 3] = [Self::Distributed, Self::CentralNoneActive, Self::CentralAllActive];

    const fn name(self) -> &'static str {
        match self {
            Self::Distributed => "distributed",
            Self::CentralNoneActive => "central, none active",
            Self::CentralAllActive => "central, all active",
        }
    }

    fn sensors(self) -> SkinSensors {
        match self {
            Self::CentralNoneActive => SkinSensors::default(),
            Self::Distributed | Self::CentralAllActive => SkinSensors {
                contact: [Q5_10::nearest(0.5); 3],
                proximity: Q1_14::nearest(0.9),
                ..SkinSensors::default()
            },
        }
    }
}

/// A UR5 with `cells` cells; further buses repeat the cells of the first one.
fn skin(cells: usize) -> Skin {
    let text = generate(&SkinRequest { cells: cells.min(CELLS_PER_BUS), ..SkinRequest::default() })
        .expect("a UR5 has room");
    let mut skin = Skin::parse("skin.toml", &text).expect("a generated skin is sound");
    let first = skin.clone();
    for bus in 1..cells.div_ceil(CELLS_PER_BUS) {
        let more = first.buses.iter().map(|first| SkinBus { name: format!("vcan{bus}"), ..first.clone() });
        skin.buses.extend(more);
        let room = cells - skin.cells.len();
        skin.cells.extend(first.cells.iter().take(room).cloned().map(|mut cell| {
            cell.bus = bus;
            cell
        }));
    }
    assert_eq!(skin.cells.len(), cells);
    skin
}

/// A bus's receiving ends.
struct Receiver {
    snapshots: triple_buffer::Input<Snapshot>,
    positions: rtrb::Consumer<(Epoch, [f64; MAX_JOINTS])>,
}

/// A loop, with the ends that other threads hold in a run.
struct Bench {
    turn: TickDriver,
    buses: Vec<Receiver>,
    records: rtrb::Consumer<TimedRecord>,
    tick: u64,
}

impl Bench {
    fn new(skin: &Skin, case: BenchCase) -> Self {
        let (mut lines, mut buses) = (Vec::new(), Vec::new());
        for (index, bus) in skin.buses.iter().enumerate() {
            let sensors = skin.cells_on_bus(index).map(|_| case.sensors()).collect::<Vec<_>>();
            let snapshot = Snapshot { sums: BusTotals::default(), sensors };
            let (snapshots, snapshot) = triple_buffer::triple_buffer(&snapshot);
            let (producer, positions) = rtrb::RingBuffer::new(64);
            lines.push(BusPort { format: bus.format, snapshot, positions: producer, state: Arc::default() });
            buses.push(Receiver { snapshots, positions });
        }
        let mode =
            if case == BenchCase::Distributed { TorqueSource::Distributed } else { TorqueSource::Compare };
        let modes = vec![ModeChange { at: Micros(0), mode }];
        let scenario = Scenario { modes, ..Scenario::idle(Span::from_millis(1_000)) };
        let controller = Box::new(KinestheticController::new(skin).expect("a generated skin has one"));
        let cycle = ControlCycle::new(
            skin,
            controller,
            Box::new(SimulatedArm::new(skin, pad_with_defaults(&[0.1; WORDS]))),
        );
        let (producer, records) = rtrb::RingBuffer::new(64);
        let turn =
            TickDriver::new(cycle, lines, Arc::new(scenario), Arc::new(SharedRunState::default()), producer);
        Self { turn, buses, records, tick: 0 }
    }

    /// Runs eight ticks, of which the first sends joints. Returns their duration and the number of active cells.
    fn run_epoch(&mut self) -> (Duration, u32) {
        let last = (self.tick / TICKS_PER_EPOCH).checked_sub(1).map(|epoch| Epoch(epoch.to_le_bytes()[0]));
        for Receiver { snapshots, .. } in &mut self.buses {
            let next = snapshots.input_buffer_mut();
            next.sums.read_back = last;
            next.sums.contributing = u32::try_from(next.sensors.len()).unwrap_or(u32::MAX);
            next.sums.torque = pad_with_defaults(&[0.01, -0.02, 0.03, 0.01, -0.01, 0.0]);
            snapshots.publish();
        }
        let mut sent = 0;
        let began = Instant::now();
        for number in self.tick..self.tick + TICKS_PER_EPOCH {
            let tick = Tick { number, time: Micros(number * 2_000) };
            self.turn.run_tick(tick, 0, realtime::monotonic_ns(), realtime::monotonic_ns, |_, frames| {
                sent += black_box(frames).len();
                true
            });
        }
        let took = began.elapsed();
        self.tick += TICKS_PER_EPOCH;
        assert_eq!(sent, self.buses.len(), "one broadcast on every bus");
        self.buses.iter_mut().for_each(|bus| assert!(bus.positions.pop().is_ok(), "its positions"));
        let mut active = 0;
        while let Ok(record) = self.records.pop() {
            assert_eq!((record.record.bad, record.record.halted), (None, None));
            active = record.central.map_or(0, |(_, reference_torque)| reference_torque.active);
        }
        (took, active)
    }
}

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_millis(200))
        .measurement_time(Duration::from_millis(800))
        .configure_from_args();
    for cells in [1, 253, 1_000, 2_160, 10_000_u32] {
        let skin = skin(usize::try_from(cells).expect("a few"));
        let mut group = criterion.benchmark_group("tick");
        for case in BenchCase::ALL {
            group.bench_function(BenchmarkId::new(case.name(), cells), |bencher| {
                let mut bench = Bench::new(&skin, case);
                let (_, active) = bench.run_epoch();
                assert_eq!(active, if case == BenchCase::CentralAllActive { cells } else { 0 });
                bencher.iter_custom(|ticks| {
                    let epochs = ticks.div_ceil(TICKS_PER_EPOCH);
                    let took: Duration = (0..epochs).map(|_| bench.run_epoch().0).sum();
                    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
                    took.mul_f64(ticks as f64 / (epochs * TICKS_PER_EPOCH) as f64)
                });
            });
        }
        group.finish();
    }
    criterion.final_summary();
}
