//! Computes whether a skin fits on real buses: the load, the longest time from joints to the last answer, and the
//! resulting numbers of cells and buses. Every command that reports a fit uses this module: limits, verdicts and their
//! texts ([`verdict`]), bit rates ([`rates`]). [`bus_model::traffic`] separates bench traffic from that of a real bus.
//!
//! The worst case assumes that all frames have the maximum of stuff bits ([`protocol::wire_time`]), that all cells are
//! in contact, and that the bus is free of errors. Every node sends its lowest identifier first. Joints, answers,
//! sensors and heartbeats count; stimuli, commands, configuration and simulated wires do not, because they belong to
//! the bench or are rare.
//!
//! ```text
//!   skin, rates ──> Case ──> streams ──> response   ┐
//!                      └───> chain ─────────────────┴─> Times ──> limits ──> hints
//! ```

pub mod case;
pub mod hint;
mod json;
pub mod limits;
pub mod rates;
pub mod response;
pub mod starving;
pub mod verdict;

use protocol::can::Format;
use protocol::skin::Skin;
use protocol::wire_time::BitRates;
use serde::Serialize;

pub use json::fit_json;

use case::{BusCase, BusLoad, WorstCaseTimes};
use hint::Hint;
use limits::{Limit, MaxCells, NeededBuses, exceeded_limits};
use starving::{StarvingFrames, starving_frames};
use verdict::FitVerdict;

/// Computation time of the paper's cell, 68.5 µs: 1096 instructions at 16 MIPS.
pub const PAPER_COMPUTATION_NS: u64 = 68_500;

/// Common bit rates, in bit/s: nominal and data.
pub const COMMON_RATES: [CommonRates; 7] = [
    CommonRates(Format::Classic, 500_000, 500_000),
    CommonRates(Format::Classic, 1_000_000, 1_000_000),
    CommonRates(Format::Fd, 500_000, 2_000_000),
    CommonRates(Format::Fd, 500_000, 5_000_000),
    CommonRates(Format::Fd, 1_000_000, 2_000_000),
    CommonRates(Format::Fd, 1_000_000, 5_000_000),
    CommonRates(Format::Fd, 1_000_000, 8_000_000),
];

/// A frame format with its nominal and data bit rates in bit/s.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct CommonRates(pub Format, pub u32, pub u32);

impl CommonRates {
    /// Returns the bit rates; `None` if CAN does not allow them.
    #[must_use]
    pub fn rates(&self) -> Option<BitRates> {
        BitRates::new(self.1, self.2).ok()
    }
}

/// Formats the name of a format with its rates: `1M/5M`, `classic 1M`.
#[must_use]
pub fn rates_name(format: Format, rates: BitRates) -> String {
    match format {
        Format::Fd => rates.to_string(),
        Format::Classic => format!("classic {rates}"),
    }
}

/// A bus with its load, worst-case times and exceeded limits.
#[derive(Clone, Debug, PartialEq)]
pub struct AssessedBus {
    /// The bus, with its rates and cells.
    pub case: BusCase,
    /// Shares of the bus's time, by kind of frame.
    pub load: BusLoad,
    /// Worst-case times on the bus.
    pub times: WorstCaseTimes,
    /// The limits that the bus exceeds.
    pub exceeded: Vec<Limit>,
}

impl AssessedBus {
    /// Computes load, times and exceeded limits of a bus.
    #[must_use]
    pub fn assess(case: &BusCase) -> Self {
        Self { case: case.clone(), load: case.load(), times: case.times(), exceeded: exceeded_limits(case) }
    }

    /// Returns the verdict: the bus fits, or the limit that it exceeds.
    #[must_use]
    pub fn verdict(&self) -> FitVerdict {
        FitVerdict::from_limits(&self.exceeded, self.case.answers.cells())
    }
}

/// The result of `skinbus fit` for one bus of a skin.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BusFit {
    /// Name of the bus.
    #[serde(rename = "bus")]
    pub name: String,
    /// Load, times and limits of the bus as described.
    #[serde(flatten)]
    pub rated: AssessedBus,
    /// The frames that have no bound, highest priority first.
    #[serde(rename = "without_bound")]
    pub starving: Vec<StarvingFrames>,
    /// The maximum number of cells on the bus, by each limit.
    #[serde(rename = "most_cells")]
    pub most: MaxCells,
    /// The number of buses that the cells of this bus need, by each limit.
    #[serde(rename = "buses_needed", serialize_with = "json::needed")]
    pub need: NeededBuses,
    /// The bus with each other kind of answers.
    #[serde(rename = "other_answers")]
    pub answers: Vec<Hint>,
    /// Changes with which the bus would keep all limits, if it exceeds one.
    #[serde(rename = "changes")]
    pub hints: Vec<Hint>,
}

/// Computes the fit of one bus of a skin, given as an index into [`Skin::buses`]; `None` if the bus does not exist.
#[must_use]
pub fn assess_bus(
    skin: &Skin,
    index: usize,
    format: Format,
    rates: BitRates,
    computation_ns: u64,
) -> Option<BusFit> {
    let name = skin.buses.get(index)?.name.clone();
    let case = BusCase::from_skin(skin, index, format, rates, computation_ns)?;
    let most = MaxCells::for_case(&case);
    let mut nodes: Vec<_> = skin.cells_on_bus(index).map(|cell| cell.node.get()).collect();
    nodes.sort_unstable();
    Some(BusFit {
        name,
        rated: AssessedBus::assess(&case),
        starving: starving_frames(&case, &nodes),
        most,
        need: NeededBuses::for_cells(&most, case.answers.cells()),
        answers: hint::hints_for_other_answers(skin, index, &case),
        hints: hint::hints(skin, &case),
    })
}

/// Computes the worst case of one bus of a skin at these rates, with all cells answering. Returns `None` if a cell that
/// answers with sums is unreachable.
#[must_use]
pub fn assess_worst_case(skin: &Skin, index: usize, rates: BitRates) -> Option<AssessedBus> {
    let format = skin.buses.get(index)?.format;
    let rates = match format {
        Format::Fd => rates,
        Format::Classic => BitRates::classic(rates.nominal_rate()).ok()?,
    };
    Some(AssessedBus::assess(&BusCase::from_skin(skin, index, format, rates, PAPER_COMPUTATION_NS)?))
}

/// Returns the upper bound of the time in µs from joints to their last reply on one bus of a skin at these rates, with all
/// cells answering; `None` without an upper bound.
#[must_use]
pub fn last_reply_bound_us(skin: &Skin, index: usize, rates: BitRates) -> Option<f64> {
    assess_worst_case(skin, index, rates)?.times.last_answer_ns().map(json::nanos_to_micros)
}

/// The fit of all cells of a skin, if they are spread evenly over several buses.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SkinFit {
    /// Number of cells of the skin.
    pub cells: u32,
    /// The number of buses that these cells need, by each limit.
    #[serde(rename = "buses_needed", serialize_with = "json::needed")]
    pub need: NeededBuses,
    /// The fit for increasing numbers of buses.
    pub spread: Vec<SpreadFit>,
}

/// The fit of all cells on one number of buses.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SpreadFit {
    /// Number of buses.
    pub buses: u32,
    /// The bus with the most cells.
    pub fullest: AssessedBus,
}

/// Computes the fit of all cells of a skin, spread over increasing numbers of buses that are like the one with the
/// highest load. For a skin with several chains, only the number of buses is computed. Returns `None` for a skin
/// without buses.
#[must_use]
pub fn spread_over_buses(skin: &Skin, buses: &[BusFit]) -> Option<SkinFit> {
    let cells = u32::try_from(skin.cells.len()).unwrap_or(u32::MAX);
    let fullest = most_loaded_bus(buses.iter())?;
    let need = needed_buses(skin, buses);
    let most = if chains_with_cells(skin).count() > 1 { 0 } else { need.required_buses().unwrap_or(1) };
    let numbers = 1..=most;
    // Show only informative numbers: all below the required one are too small.
    let is_shown = |buses: &u32| {
        *buses <= 6 || Some(*buses) == need.buses_for_timing() || Some(*buses) == need.required_buses()
    };
    let spread = numbers
        .filter(is_shown)
        .map(|buses| (buses, fullest.rated.case.with_cells(cells.div_ceil(buses))))
        .map(|(buses, case)| SpreadFit { buses, fullest: AssessedBus::assess(&case) });
    Some(SkinFit { cells, need, spread: spread.collect() })
}

/// Returns the chains that carry cells, each with its number of cells.
fn chains_with_cells(skin: &Skin) -> impl Iterator<Item = (usize, u32)> {
    let on = |cell: &protocol::skin::Cell| skin.buses.get(cell.bus).map(|bus| bus.chain);
    let count = move |chain: usize| skin.cells.iter().filter(|cell| on(cell) == Some(chain)).count();
    let chains = (0..skin.robot.chains.len()).map(move |chain| (chain, count(chain)));
    chains
        .filter(|(_, cells)| *cells > 0)
        .map(|(chain, cells)| (chain, u32::try_from(cells).unwrap_or(u32::MAX)))
}

/// Returns the number of buses that all cells of a skin need. A bus carries one chain, so each chain needs buses of its
/// own, like its bus with the highest load.
fn needed_buses(skin: &Skin, buses: &[BusFit]) -> NeededBuses {
    let of_chain = |(chain, cells)| {
        let chain_of = |bus: &&BusFit| {
            let index = skin.bus_index(&bus.name)?;
            skin.buses.get(index).map(|bus| bus.chain)
        };
        let fullest = most_loaded_bus(buses.iter().filter(|bus| chain_of(bus) == Some(chain)))?;
        Some(NeededBuses::for_cells(&fullest.most, cells))
    };
    let none = NeededBuses { bandwidth: Some(0), deadline: Some(0), nodes: Some(0) };
    chains_with_cells(skin).filter_map(of_chain).reduce(NeededBuses::plus).unwrap_or(none)
}

/// The fit of a skin at one pair of common bit rates.
#[derive(Clone, Debug, PartialEq)]
pub struct RatesRow {
    /// The bus with the highest load at these rates.
    pub fullest: BusFit,
    /// The number of buses that all cells of the skin need at these rates.
    pub need: NeededBuses,
}

/// Computes the fit of the bus with the highest load at each of the common bit rates, of all formats or of one.
#[must_use]
pub fn rates_table(skin: &Skin, format: Option<Format>, computation_ns: u64) -> Vec<RatesRow> {
    let rows = COMMON_RATES.iter().filter(|it| format.is_none_or(|format| format == it.0));
    let row = |common: &CommonRates| {
        let rates = common.rates()?;
        let buses =
            (0..skin.buses.len()).map(|index| assess_bus(skin, index, common.0, rates, computation_ns));
        let buses: Vec<_> = buses.flatten().collect();
        let fullest = most_loaded_bus(buses.iter())?.clone();
        Some(RatesRow { fullest, need: needed_buses(skin, &buses) })
    };
    rows.filter_map(row).collect()
}

/// Returns the bus with the highest load.
#[must_use]
pub fn most_loaded_bus<'a>(buses: impl Iterator<Item = &'a BusFit>) -> Option<&'a BusFit> {
    buses.max_by(|one, other| one.rated.load.total().total_cmp(&other.rated.load.total()))
}

#[cfg(test)]
mod tests;
