//! Simulates buses in virtual time, with exact stuffing, and compares them with the computed bounds.

use std::collections::BTreeMap;

use protocol::can::{BIT_RATE_SWITCH, Format, Frame};
use protocol::packet::Length;
use protocol::parameters::Sensing;
use protocol::wire_time::{FrameBits, FrameCoding, FrameShape};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::{AnswerPlan, BusCase, PAPER_COMPUTATION_NS};
use bus_model::{BusModel, Priority, Request};

/// The times that the cells need to compute their answers in an epoch.
#[derive(Clone, Copy, Debug)]
enum Computation {
    /// The longest time for all cells.
    Longest,
    /// A random time for each cell, up to the longest.
    Any,
    /// Zero for all cells but one, which needs the longest time.
    Straggler,
}

/// The times at which the cells should send their heartbeats.
#[derive(Clone, Copy, Debug)]
enum Heartbeats {
    /// Spread over the period by node id, as if all cells started together.
    Spread,
    /// Random, as if each cell started on its own.
    Any,
    /// All while cells compute, after the same joints.
    Together,
}

/// The content of the words in packets.
#[derive(Clone, Copy, Debug)]
enum Data {
    /// Random.
    Any,
    /// Random, with zeros as in torques on joints beyond the cell.
    Zeros,
    /// The content that makes a frame longest.
    Longest,
}

/// The longest times that occurred in one simulation.
#[derive(Clone, Copy, Debug, Default)]
struct Longest {
    /// From the time at which joints should be sent to the end of the last answer, in ns.
    last_ns: u64,
    /// From the time at which a heartbeat should be sent to its end, in ns; zero if it ended before that time.
    heartbeat_ns: u64,
}

#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
enum Sent {
    Joints,
    Torque(u32),
    Sensors(u32),
    Acceleration(u32),
    Heartbeat(u32),
}

impl Sent {
    const fn id(self) -> u32 {
        match self {
            Self::Joints => 0x001,
            Self::Torque(node) => 0x200 | node,
            Self::Sensors(node) | Self::Acceleration(node) => 0x300 | node,
            Self::Heartbeat(node) => 0x400 | node,
        }
    }
}

/// A simulated bus with its cells.
struct Bench<'a> {
    case: &'a BusCase,
    data: Data,
    /// The content of the longest frame.
    longest: FrameBits,
    dice: Pcg64Mcg,
    bus: BusModel,
    /// The frames that are to be sent, by time, each with the time from which its delay counts.
    agenda: BTreeMap<(u64, u32), (Sent, u64)>,
    entered: u32,
    /// The frames on the bus by tag: the frame, the time from which its delay counts, and true if it ends a packet.
    on_the_way: Vec<(Sent, u64, bool)>,
}

impl Bench<'_> {
    fn enter(&mut self, at: u64, sent: Sent, due: u64) {
        self.agenda.insert((at, self.entered), (sent, due));
        self.entered += 1;
    }

    fn bytes(&mut self) -> [u8; 16] {
        let mut bytes: [u8; 16] = self.dice.random();
        if let Data::Zeros = self.data {
            let zeros = 2 * self.dice.random_range(0..=6);
            bytes[zeros..12].fill(0);
        }
        bytes
    }

    fn send(&mut self, at: u64, sent: Sent, due: u64) {
        let bytes = self.bytes();
        let frames = match self.case.format {
            Format::Fd => vec![Frame::fd(sent.id(), BIT_RATE_SWITCH, &bytes).unwrap()],
            Format::Classic => {
                bytes.chunks(8).map(|segment| Frame::classic(sent.id(), segment).unwrap()).collect()
            }
        };
        for (index, frame) in frames.iter().enumerate() {
            let tag = u64::try_from(self.on_the_way.len()).unwrap();
            self.on_the_way.push((sent, due, index + 1 == frames.len()));
            let bits = match self.data {
                Data::Any | Data::Zeros => FrameBits::from_frame(frame).unwrap(),
                Data::Longest => self.longest,
            };
            let priority = Priority::from_frame(frame);
            self.bus.request(Request { at, priority, bits, queue: None, tag });
        }
    }
}

/// Simulates a number of epochs of a bus whose cells are all in contact, and returns the longest times.
fn simulate(case: &BusCase, epochs: u64, seed: u64, how: (Computation, Heartbeats, Data)) -> Longest {
    let (computation, heartbeats, data) = how;
    let (cells, period) = (case.answers.cells(), case.period_ns);
    let mut bench = Bench {
        case,
        data,
        longest: match case.format {
            Format::Fd => FrameShape { coding: FrameCoding::FdSwitched, extended: false, len: 16 }.max_bits(),
            Format::Classic => {
                FrameShape { coding: FrameCoding::Classic, extended: false, len: 8 }.max_bits()
            }
        },
        dice: Pcg64Mcg::seed_from_u64(seed),
        bus: BusModel::new(case.rates),
        agenda: BTreeMap::new(),
        entered: 0,
        on_the_way: Vec::new(),
    };
    let end = epochs * period;
    for epoch in 0..epochs {
        bench.enter(epoch * period, Sent::Joints, epoch * period);
    }
    let start = bench.dice.random_range(0..250_000_000);
    for node in 1..=cells {
        let phase = match heartbeats {
            Heartbeats::Spread => (start + 250_000_000 * u64::from(node) / 255) % 250_000_000,
            Heartbeats::Any => bench.dice.random_range(0..250_000_000),
            Heartbeats::Together => period + bench.dice.random_range(0..2 * case.longest_frame_ns()),
        };
        for due in (0..).map(|it| phase + it * 250_000_000).take_while(|&due| due < end) {
            // Send a heartbeat as early as the rules allow: up to a period.
            let early = if bench.dice.random() { bench.dice.random_range(0..period) } else { 0 };
            bench.enter(due.saturating_sub(early), Sent::Heartbeat(node), due);
        }
        if let Sensing::Continuous { period_ms } = case.sensing {
            let every = u64::from(period_ms) * 1_000_000;
            let phase = bench.dice.random_range(0..every);
            for due in (0..).map(|it| phase + it * every).take_while(|&due| due < end) {
                bench.enter(due, Sent::Sensors(node), due);
            }
            let at = bench.dice.random_range(0..end);
            bench.enter(at, Sent::Acceleration(node), at);
        }
    }
    let straggler = bench.dice.random_range(1..=cells);
    let (mut longest, mut answered) = (Longest::default(), BTreeMap::<u64, u32>::new());
    loop {
        let next = bench.agenda.first_key_value().map(|(&(at, _), _)| at);
        let passes = bench.bus.poll_timeout();
        match (next, passes) {
            (None, None) => break,
            (Some(at), passes) if passes.is_none_or(|passes| at < passes) => {
                let ((at, _), (sent, due)) = bench.agenda.pop_first().unwrap();
                bench.send(at, sent, due);
            }
            (_, Some(at)) => _ = bench.bus.run_until(at),
            (Some(_), None) => unreachable!("the guard above takes it"),
        }
        while let Some(attempt) = bench.bus.poll() {
            let (sent, due, is_whole) = bench.on_the_way[usize::try_from(attempt.tag).unwrap()];
            match sent {
                _ if !is_whole => {}
                Sent::Joints => {
                    for node in 1..=cells {
                        let took = match computation {
                            Computation::Longest => case.computation_ns,
                            Computation::Any => bench.dice.random_range(0..=case.computation_ns),
                            Computation::Straggler if node == straggler => case.computation_ns,
                            Computation::Straggler => 0,
                        };
                        bench.enter(attempt.end + took, Sent::Torque(node), due);
                    }
                }
                Sent::Torque(_) => {
                    *answered.entry(due).or_default() += 1;
                    longest.last_ns = longest.last_ns.max(attempt.end - due);
                }
                Sent::Heartbeat(_) => {
                    longest.heartbeat_ns = longest.heartbeat_ns.max(attempt.end.saturating_sub(due));
                }
                Sent::Sensors(_) | Sent::Acceleration(_) => {}
            }
        }
    }
    let all = |epoch: u64| answered.get(&(epoch * period)) == Some(&cells);
    assert!((0..epochs).all(all), "every cell answered every epoch");
    longest
}

fn case(rates: &str, cells: u32) -> BusCase {
    let (format, rates) = match rates.strip_prefix("classic ") {
        Some(rates) => (Format::Classic, rates),
        None => (Format::Fd, rates),
    };
    BusCase {
        length: Length::Six,
        format,
        rates: rates.parse().unwrap(),
        period_ns: 16_000_000,
        computation_ns: PAPER_COMPUTATION_NS,
        sensing: Sensing::Off,
        answers: AnswerPlan::Torques { cells },
    }
}

/// Simulates a bus with many seeds and varied scenarios, and asserts that no time exceeds a bound. Returns the share of
/// the smaller bound that the slowest simulation reached.
fn reached(case: &BusCase, data: &[Data], seeds: u64) -> f64 {
    let times = case.times();
    let mut slowest_ns = 0;
    for seed in 0..seeds {
        let pick = |each: u64, of: usize| usize::try_from(seed / each).unwrap() % of;
        let how = (
            [Computation::Longest, Computation::Any, Computation::Straggler][pick(1, 3)],
            [Heartbeats::Together, Heartbeats::Spread, Heartbeats::Any][pick(3, 3)],
            data[pick(9, data.len())],
        );
        // One epoch more than there are between two heartbeats of a cell.
        let longest = simulate(case, 17, seed, how);
        for computed_ns in [times.chain_ns, times.response_ns.map(|it| it.worst_ns)].into_iter().flatten() {
            assert!(longest.last_ns <= computed_ns, "{} of {computed_ns}, {seed}, {how:?}", longest.last_ns);
        }
        let heartbeat_ns = times.heartbeat_ns.unwrap();
        assert!(longest.heartbeat_ns <= heartbeat_ns, "{longest:?} of {heartbeat_ns}, {seed}, {how:?}");
        slowest_ns = slowest_ns.max(longest.last_ns);
    }
    slowest_ns as f64 / times.last_answer_ns().unwrap() as f64
}

/// The content of torques and heartbeats as cells send them.
const REAL: &[Data] = &[Data::Any, Data::Zeros];

#[test]
fn the_arm_on_one_bus_at_1m_8m_is_never_slower_than_computed_and_comes_close() {
    let reached = reached(&case("1M/8M", 253), REAL, 18);
    assert!(reached >= 0.85, "{reached}");
}

#[test]
fn the_arm_on_three_buses_at_1m_5m_is_never_slower_than_computed_and_comes_close() {
    let reached = reached(&case("1M/5M", 85), REAL, 36);
    assert!(reached >= 0.85, "{reached}");
}

#[test]
fn so_are_other_numbers_of_cells_rates_and_classic_can() {
    for (rates, cells) in [
        ("500k/2M", 60),
        ("1M/2M", 110),
        ("1M", 60),
        ("500k/5M", 144),
        ("classic 1M", 55),
        ("classic 500k", 20),
    ] {
        let reached = reached(&case(rates, cells), REAL, 18);
        assert!(reached >= 0.85, "{rates} {cells}: {reached}");
    }
    // With few cells there are not enough heartbeats to block twice.
    for cells in [1, 2, 5] {
        assert!(reached(&case("1M/5M", cells), REAL, 90) >= 0.6);
    }
}

#[test]
fn with_the_longest_frames_hardly_anything_is_left() {
    for (rates, cells) in
        [("1M/8M", 253), ("1M/5M", 85), ("1M/5M", 20), ("classic 1M", 55), ("classic 1M", 10)]
    {
        let reached = reached(&case(rates, cells), &[Data::Longest], 9);
        assert!(reached >= 0.94, "{rates} {cells}: {reached}");
    }
}

#[test]
fn sensors_do_not_delay_answers_by_more_than_is_computed() {
    let sensing = Sensing::Continuous { period_ms: 20 };
    let reached = reached(&BusCase { sensing, ..case("1M/5M", 85) }, REAL, 18);
    assert!(reached >= 0.85, "{reached}");
}

#[test]
fn cells_that_take_longer_to_compute_are_waited_for() {
    for computation_ns in [0, 1_000, 2_000_000, 5_000_000] {
        let reached = reached(&BusCase { computation_ns, ..case("1M/5M", 85) }, REAL, 18);
        assert!(reached >= 0.85, "{computation_ns} ns: {reached}");
    }
}
