//! Benches of up to ten thousand cells: the time to start, processor and memory use, the lateness of the loop, and the
//! share of replies in time at the highest rate that the bench holds.
//!
//! A bench has the fewest buses that have enough node ids for its cells. The cells of each bus are one process. A bench
//! holds a rate if the share [`MIN_IN_TIME_SHARE`] of the replies arrives in time while the share [`ACTIVE_SHARE`] of
//! the cells is touched, and if the reason for every loss is known.

mod section;

use std::fmt::Write;

use protocol::id::CellId;
use serde_json::Value;

use super::distributed::{TickTimes, measure_tick_times};
use super::line::count_to_f64;
use super::ticks::{self, TickBench, skin_with_fewer_cells};
use super::{Effort, ExperimentLab};
use model::generate::{SkinRequest, generate};
use model::scenario::TorqueSource;

pub use section::scale_section;

/// The share of cells that are touched, 0 to 1.
pub const ACTIVE_SHARE: f64 = 0.05;
/// The share of replies that must be in time, 0 to 1.
pub const MIN_IN_TIME_SHARE: f64 = 0.99;
/// The force on a touched cell, in N.
const TOUCH_N: f64 = 0.5;
/// The number of cells of the smallest bench in a full measurement: that of the paper's arm.
const PAPER_CELLS: usize = 253;

/// The size and the load of a bench.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleBench {
    /// The number of cells.
    pub cells: usize,
    /// The number of buses.
    pub buses: usize,
    /// The number of joint broadcasts per second.
    pub hz: f64,
    /// True if the share [`ACTIVE_SHARE`] of the cells is touched.
    pub active: bool,
    /// The duration of the run, in s.
    pub seconds: f64,
}

impl ScaleBench {
    /// Returns the name of the bench's files, without extension.
    #[must_use]
    pub fn name(&self) -> String {
        let Self { cells, buses, hz, active, seconds: _ } = self;
        format!("scale-{cells}-on-{buses}-{hz}-hz-{}", if *active { "active" } else { "quiet" })
    }

    /// Returns the text of the bench's `skin.toml`.
    ///
    /// # Panics
    /// Never panics in practice, because the buses have enough node ids.
    #[must_use]
    pub fn skin_toml(&self) -> String {
        let Self { cells, buses, hz, .. } = *self;
        let target = SkinRequest { cells, buses, broadcast_hz: hz, ..SkinRequest::default() };
        generate(&target).expect("so many cells fit on the arm")
    }

    /// Returns the text of the bench's `scenario.toml`. The first cells of each bus are touched; their number differs
    /// by at most one between buses.
    #[must_use]
    pub fn scenario_toml(&self) -> String {
        let mut text = format!(
            "duration_s = {:?}\n\n[motion]\nkind = \"kinesthetic\"\n\n[[mode]]\nat_s = 0.0\nkind = \"distributed\"\n",
            self.seconds
        );
        let touched = if self.active { touched_cells(self.cells) } else { 0 };
        for bus in 0..self.buses {
            let here = touched / self.buses + usize::from(bus < touched % self.buses);
            if here > 0 {
                let nodes: Vec<_> = (1..=here).map(|node| node.to_string()).collect();
                let nodes = nodes.join(", ");
                let _ = write!(
                    text,
                    "\n[[touch]]\nbus = \"vcan{bus}\"\ncells = [{nodes}]\nforce_n = {TOUCH_N:?}\n"
                );
            }
        }
        text
    }
}

/// Returns the number of touched cells of a bench with this many cells.
const fn touched_cells(cells: usize) -> usize {
    cells.div_ceil(20)
}

/// The measurements of one bench, from its summary.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BenchFigures {
    /// The time from the start of the bench to the first joints, in s.
    pub start_s: f64,
    /// The processor use of the gateway, of the buses and of the cells, in cores.
    pub cores: [f64; 3],
    /// The memory of the gateway, of all bus servers together, and of the largest process of cells, in MB.
    pub memory_mb: [f64; 3],
    /// The median duration of a tick without a central computation, in µs.
    pub tick_us: f64,
    /// The 99th percentile of the lateness of ticks, and that of a thread that does nothing else, in µs.
    pub late_us: [f64; 2],
    /// The number of replies that were due.
    pub due: f64,
    /// The number of replies that arrived before the next joints.
    pub in_time: f64,
    /// The number of replies and packets that are missing for an unknown reason.
    pub unknown: f64,
    /// True if the run reached its end and the robot was not halted.
    pub done: bool,
}

impl BenchFigures {
    /// Extracts the measurements from a summary (`bench::summary::Summary` as JSON).
    #[must_use]
    pub fn from_summary(summary: &Value) -> Self {
        let figure = |keys: &[&str]| {
            let value = keys.iter().try_fold(summary, |value, key| value.get(key));
            value.and_then(Value::as_f64).unwrap_or(f64::NAN)
        };
        let buses = summary.get("buses").and_then(Value::as_array);
        let over_buses = |key: &str, what: &str| {
            let of_bus = |bus: &Value| bus.get(key)?.get(what)?.as_f64();
            buses.into_iter().flatten().filter_map(of_bus).sum::<f64>()
        };
        let megabytes = |key| figure(&[key]) * 1_024.0 * 1e-6;
        Self {
            start_s: figure(&["first_broadcast_s"]),
            cores: ["gateway", "buses", "cells"].map(|part| figure(&["processor", part])),
            memory_mb: ["gateway_private_kib", "buses_private_kib", "cell_private_kib"].map(megabytes),
            tick_us: figure(&["loop", "took_distributed_us", "p50"]),
            late_us: ["late_us", "idle_late_us"].map(|late| figure(&["loop", late, "p99"])),
            due: over_buses("replies", "due"),
            in_time: over_buses("replies", "in_time"),
            unknown: over_buses("replies", "unknown") + over_buses("uplink", "unknown"),
            done: summary.get("outcome").and_then(Value::as_str) == Some("done"),
        }
    }

    /// Returns the share of the replies due that arrived in time, 0 to 1.
    #[must_use]
    pub fn in_time_share(&self) -> f64 {
        if self.due > 0.0 { self.in_time / self.due } else { f64::NAN }
    }

    /// Returns true if the bench holds its rate.
    fn holds_rate(&self) -> bool {
        self.done && self.in_time_share() >= MIN_IN_TIME_SHARE && self.unknown <= 0.0
    }
}

/// The measurements for one number of cells, at the highest rate that the bench holds. If it holds none, they are at
/// the lowest rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SizeFigures {
    /// The number of cells.
    pub cells: usize,
    /// The number of buses.
    pub buses: usize,
    /// The number of joint broadcasts per second.
    pub hz: f64,
    /// True if the bench holds this rate.
    pub holds: bool,
    /// The measurements while no cells are touched.
    pub quiet: BenchFigures,
    /// The measurements while the share [`ACTIVE_SHARE`] of the cells is touched.
    pub active: BenchFigures,
}

/// The times of three kinds of ticks without threads, in ns: with the fewest cells, with the fewest cells on as many
/// buses as the most cells need, and with the most cells.
pub type ComparedTicks = [f64; 3];

/// All measurements of the experiment.
#[derive(Clone, Debug)]
pub struct ScaleMeasurements {
    /// The measurements for each number of cells.
    pub sizes: Vec<SizeFigures>,
    /// The times of ticks without threads over the number of cells. All cells are active, on as many buses as the
    /// largest number needs.
    pub ticks: TickTimes,
    /// The times of three ticks without threads that are compared. All cells are active.
    pub beside: ComparedTicks,
}

/// The numbers of cells and rates to be measured.
#[derive(Clone, Copy, Debug)]
struct ScaleMeasurementPlan {
    /// The numbers of cells, in ascending order.
    cells: &'static [usize],
    /// The rates in Hz, in descending order.
    rates: &'static [f64],
    /// The duration of a bench, in s.
    seconds: f64,
    /// The number of different numbers of cells in ticks without threads, besides one cell per bus.
    steps: usize,
    /// The number of measurements for each of these ticks.
    rounds: usize,
}

const FULL_PLAN: ScaleMeasurementPlan = ScaleMeasurementPlan {
    cells: &[PAPER_CELLS, 2 * PAPER_CELLS, 4 * PAPER_CELLS, 10 * PAPER_CELLS, 20 * PAPER_CELLS, 10_000],
    rates: &[62.5, 31.25, 15.625],
    seconds: 5.0,
    steps: 10,
    rounds: 100,
};

const QUICK_PLAN: ScaleMeasurementPlan =
    ScaleMeasurementPlan { cells: &[24, 300], rates: &[62.5], seconds: 1.0, steps: 4, rounds: 5 };

/// Runs all benches and measures all ticks.
///
/// # Errors
/// Returns the error of the lab.
///
/// # Panics
/// Never panics in practice: generated skins are valid, and all lines are fitted to enough points.
pub fn measure_scale<L: ExperimentLab>(lab: &mut L, effort: Effort) -> Result<ScaleMeasurements, L::Error> {
    let extent = match effort {
        Effort::Quick => QUICK_PLAN,
        Effort::Full => FULL_PLAN,
    };
    let mut sizes = Vec::new();
    for &cells in extent.cells {
        sizes.push(measure_bench_size(lab, cells, extent)?);
    }
    lab.check_stopped()?;
    let (fewest, most) = (extent.cells.first().copied(), extent.cells.last().copied());
    let (ticks, beside) = measure_ticks(fewest.unwrap_or(1), most.unwrap_or(1), extent, || lab.now_ns());
    Ok(ScaleMeasurements { sizes, ticks, beside })
}

/// Finds the highest rate that a bench with this many cells holds, and measures at this rate.
fn measure_bench_size<L: ExperimentLab>(
    lab: &mut L,
    cells: usize,
    extent: ScaleMeasurementPlan,
) -> Result<SizeFigures, L::Error> {
    let buses = cells.div_ceil(CellId::COUNT);
    let of = |hz, active| ScaleBench { cells, buses, hz, active, seconds: extent.seconds };
    let (mut hz, mut active) = (f64::NAN, BenchFigures::default());
    for &rate in extent.rates {
        lab.check_stopped()?;
        hz = rate;
        active = BenchFigures::from_summary(&lab.run_scaled_bench(&of(hz, true))?);
        if active.holds_rate() {
            break;
        }
    }
    lab.check_stopped()?;
    let quiet = BenchFigures::from_summary(&lab.run_scaled_bench(&of(hz, false))?);
    Ok(SizeFigures { cells, buses, hz, holds: active.holds_rate(), quiet, active })
}

/// Measures ticks without threads: for different numbers of cells, and three for comparison.
fn measure_ticks(
    fewest: usize,
    most: usize,
    extent: ScaleMeasurementPlan,
    now: impl Fn() -> u64 + Copy,
) -> (TickTimes, ComparedTicks) {
    let skin = |cells, buses| ticks::generated_skin(cells, buses).expect("so many cells fit on the arm");
    let buses = most.div_ceil(CellId::COUNT);
    let large = skin(most, buses);
    // Each bus has at least one cell, because a bus without cells has no chain to be computed.
    let numbers: Vec<usize> =
        (0..=extent.steps).map(|step| (most * step / extent.steps).max(buses)).collect();
    let parts: Vec<_> = numbers.iter().map(|&cells| skin_with_fewer_cells(&large, cells)).collect();
    let all_active = |place: usize, mode| {
        let part = parts.get(place).unwrap_or(&large);
        TickBench::new(part, part.cells.len(), mode)
    };
    let over = measure_tick_times(&numbers, extent.rounds, 14, all_active, now)
        .expect("more than two numbers of cells");
    let few = skin(fewest, fewest.div_ceil(CellId::COUNT));
    let skins = [&few, &skin_with_fewer_cells(&large, fewest.max(buses)), &large];
    let mut loops = skins.map(|skin| TickBench::new(skin, skin.cells.len(), TorqueSource::Distributed));
    let measured = super::samples::measure_interleaved(loops.len(), extent.rounds, 15, |thing| {
        let Some(ticks) = loops.get_mut(thing) else { return f64::NAN };
        ticks.run_epoch(now);
        ticks.run_epoch(now).tick
    });
    let medians = super::samples::medians(&measured);
    (over, std::array::from_fn(|place| medians.get(place).copied().unwrap_or(f64::NAN)))
}

/// Returns the number of cells as the x of a figure.
fn cell_count_as_float(size: &SizeFigures) -> f64 {
    count_to_f64(size.cells)
}

#[cfg(test)]
mod tests;
