//! Benches of up to ten thousand cells: the time to start, the cost, the lateness of the loop, and the replies in time
//! at the highest rate that holds.
//!
//! Each number of cells is on the fewest buses with enough node ids, and the cells of each bus are one process. A rate
//! holds if a share of [`HOLDS`] of the replies arrives in time while a share of [`ACTIVE`] of the cells is touched,
//! and all losses have a known reason.

mod section;

use std::fmt::Write;

use protocol::id::CellId;
use serde_json::Value;

use super::distributed::{TickTimes, over};
use super::line::count;
use super::ticks::{self, Ticks, spread};
use super::{Effort, Lab};
use model::generate::{Target, generate};
use model::scenario::Mode;

pub use section::section;

/// The share of cells that are touched.
pub const ACTIVE_SHARE: f64 = 0.05;
/// The share of replies that must be in time.
pub const MIN_IN_TIME_SHARE: f64 = 0.99;
/// The force on a touched cell, in N.
const TOUCH_N: f64 = 0.5;
/// The number of cells of the smallest bench in a full measurement: that of the paper's arm.
const PAPER: usize = 253;

/// A bench.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleBench {
    /// The number of cells.
    pub cells: usize,
    /// The number of buses.
    pub buses: usize,
    /// Joint broadcasts per second.
    pub hz: f64,
    /// True if [`ACTIVE`] of its cells are touched.
    pub active: bool,
    /// The duration of the run, in s.
    pub seconds: f64,
}

impl ScaleBench {
    /// Returns the name of its files.
    #[must_use]
    pub fn name(&self) -> String {
        let Self { cells, buses, hz, active, seconds: _ } = self;
        format!("scale-{cells}-on-{buses}-{hz}-hz-{}", if *active { "active" } else { "quiet" })
    }

    /// Returns its `skin.toml`.
    ///
    /// # Panics
    /// Never: this number of cells fits.
    #[must_use]
    pub fn skin(&self) -> String {
        let Self { cells, buses, hz, .. } = *self;
        let target = Target { cells, buses, broadcast_hz: hz, ..Target::default() };
        generate(&target).expect("so many cells fit on the arm")
    }

    /// Returns its `scenario.toml`. The touched cells are the first ones of each bus; their numbers differ by at most
    /// one between buses.
    #[must_use]
    pub fn scenario(&self) -> String {
        let mut text = format!(
            "duration_s = {:?}\n\n[motion]\nkind = \"kinesthetic\"\n\n[[mode]]\nat_s = 0.0\nkind = \"distributed\"\n",
            self.seconds
        );
        let touched = if self.active { share(self.cells) } else { 0 };
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

/// Returns the number of touched cells.
const fn share(cells: usize) -> usize {
    cells.div_ceil(20)
}

/// The figures of a bench's summary.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BenchFigures {
    /// The time from its start to the first joints, in s.
    pub start_s: f64,
    /// Processor use of the gateway, the buses and the cells, in cores.
    pub cores: [f64; 3],
    /// Memory of the gateway, of all bus servers, and of the largest cell process, in MB.
    pub memory_mb: [f64; 3],
    /// The median duration of a tick without a central computation, in µs.
    pub tick_us: f64,
    /// The 99th percentile of the lateness of ticks, and that of an idle thread, in µs.
    pub late_us: [f64; 2],
    /// Replies that were due.
    pub due: f64,
    /// Replies that arrived before the next joints.
    pub in_time: f64,
    /// Replies and packets missing for no known reason.
    pub unknown: f64,
    /// True if the run was completed with the robot moving.
    pub done: bool,
}

impl BenchFigures {
    /// Reads a summary (`bench::summary::Summary` as JSON).
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

    /// Returns the share of due replies that arrived in time.
    #[must_use]
    pub fn share(&self) -> f64 {
        if self.due > 0.0 { self.in_time / self.due } else { f64::NAN }
    }

    /// Returns true if the rate holds.
    fn holds(&self) -> bool {
        self.done && self.share() >= MIN_IN_TIME_SHARE && self.unknown <= 0.0
    }
}

/// The measurements of one number of cells, at the highest rate that holds, or else at the lowest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SizeFigures {
    /// The number of cells.
    pub cells: usize,
    /// The number of buses.
    pub buses: usize,
    /// Joint broadcasts per second.
    pub hz: f64,
    /// True if that rate holds.
    pub holds: bool,
    /// The figures without touched cells.
    pub quiet: BenchFigures,
    /// The figures with [`ACTIVE`] of the cells touched.
    pub active: BenchFigures,
}

/// Times of ticks without threads, in ns: of the fewest cells, of the fewest cells on as many buses as the most, and of
/// the most.
pub type ComparedTicks = [f64; 3];

/// All measurements.
#[derive(Clone, Debug)]
pub struct Scale {
    /// Ticks over cells, all of them active, on as many buses as the largest number needs.
    pub sizes: Vec<SizeFigures>,
    /// Ticks over cells, all active, on as many buses as the most of them need.
    pub ticks: TickTimes,
    /// Times of the compared ticks, with all cells active.
    pub beside: ComparedTicks,
}

/// The extent of the measurements.
#[derive(Clone, Copy, Debug)]
struct ScaleExtent {
    /// Numbers of cells, in ascending order.
    cells: &'static [usize],
    /// Rates, in descending order.
    rates: &'static [f64],
    /// The duration of a bench, in s.
    seconds: f64,
    /// The number of steps of the number of cells in ticks without threads, after one per bus.
    steps: usize,
    /// The number of measurements of these ticks.
    rounds: usize,
}

const FULL: ScaleExtent = ScaleExtent {
    cells: &[PAPER, 2 * PAPER, 4 * PAPER, 10 * PAPER, 20 * PAPER, 10_000],
    rates: &[62.5, 31.25, 15.625],
    seconds: 5.0,
    steps: 10,
    rounds: 100,
};

const QUICK: ScaleExtent = ScaleExtent { cells: &[24, 300], rates: &[62.5], seconds: 1.0, steps: 4, rounds: 5 };

/// Measures everything.
///
/// # Errors
/// Returns the error of the lab.
///
/// # Panics
/// Never: the skins generated here fit, and fits have enough points.
pub fn measure<L: Lab>(lab: &mut L, effort: Effort) -> Result<Scale, L::Error> {
    let extent = match effort {
        Effort::Quick => QUICK,
        Effort::Full => FULL,
    };
    let mut sizes = Vec::new();
    for &cells in extent.cells {
        sizes.push(size(lab, cells, extent)?);
    }
    lab.go_on()?;
    let (fewest, most) = (extent.cells.first().copied(), extent.cells.last().copied());
    let (ticks, beside) = loops(fewest.unwrap_or(1), most.unwrap_or(1), extent, || lab.now());
    Ok(Scale { sizes, ticks, beside })
}

/// Finds the highest rate that this number of cells holds, and measures at it.
fn size<L: Lab>(lab: &mut L, cells: usize, extent: ScaleExtent) -> Result<SizeFigures, L::Error> {
    let buses = cells.div_ceil(CellId::COUNT);
    let of = |hz, active| ScaleBench { cells, buses, hz, active, seconds: extent.seconds };
    let (mut hz, mut active) = (f64::NAN, BenchFigures::default());
    for &rate in extent.rates {
        lab.go_on()?;
        hz = rate;
        active = BenchFigures::from_summary(&lab.scaled(&of(hz, true))?);
        if active.holds() {
            break;
        }
    }
    lab.go_on()?;
    let quiet = BenchFigures::from_summary(&lab.scaled(&of(hz, false))?);
    Ok(SizeFigures { cells, buses, hz, holds: active.holds(), quiet, active })
}

/// Measures ticks without threads: over cells, and three of them for comparison.
fn loops(fewest: usize, most: usize, extent: ScaleExtent, now: impl Fn() -> u64 + Copy) -> (TickTimes, ComparedTicks) {
    let skin = |cells, buses| ticks::skin(cells, buses).expect("so many cells fit on the arm");
    let buses = most.div_ceil(CellId::COUNT);
    let large = skin(most, buses);
    // A bus without cells has no robot to compute, so each bus has at least one cell.
    let numbers: Vec<usize> =
        (0..=extent.steps).map(|step| (most * step / extent.steps).max(buses)).collect();
    let parts: Vec<_> = numbers.iter().map(|&cells| spread(&large, cells)).collect();
    let all_active = |place: usize, mode| {
        let part = parts.get(place).unwrap_or(&large);
        Ticks::new(part, part.cells.len(), mode)
    };
    let over = over(&numbers, extent.rounds, 14, all_active, now).expect("more than two numbers of cells");
    let few = skin(fewest, fewest.div_ceil(CellId::COUNT));
    let skins = [&few, &spread(&large, fewest.max(buses)), &large];
    let mut loops = skins.map(|skin| Ticks::new(skin, skin.cells.len(), Mode::Distributed));
    let measured = super::samples::interleaved(loops.len(), extent.rounds, 15, |thing| {
        let Some(ticks) = loops.get_mut(thing) else { return f64::NAN };
        ticks.epoch(now);
        ticks.epoch(now).tick
    });
    let medians = super::samples::medians(&measured);
    (over, std::array::from_fn(|place| medians.get(place).copied().unwrap_or(f64::NAN)))
}

/// Returns the number of cells for an axis.
fn cells_of(size: &SizeFigures) -> f64 {
    count(size.cells)
}

#[cfg(test)]
mod tests;
