//! Computes whether a skin fits on real buses: the load, the longest time from joints to the last answer, and the
//! resulting numbers of cells and buses. Every command that reports a fit uses this module: limits, verdicts and their
//! texts ([`verdict`]), bit rates ([`rates`]), and the separation of bench traffic from that of a real bus
//! ([`traffic`]).
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
pub mod traffic;
pub mod verdict;

use protocol::can::Format;
use protocol::skin::Skin;
use protocol::wire_time::BitRates;
use serde::Serialize;

pub use json::json;

use case::{Case, Load, Times};
use hint::Hint;
use limits::{Limit, MaxCells, NeededBuses, exceeded};
use verdict::Verdict;

/// Computation time of the paper's cell, 68.5 µs: 1096 instructions at 16 MIPS.
pub const COMPUTATION_NS: u64 = 68_500;

/// Common bit rates, in bit/s: nominal and data.
pub const COMMON_RATES: [Common; 7] = [
    Common(Format::Classic, 500_000, 500_000),
    Common(Format::Classic, 1_000_000, 1_000_000),
    Common(Format::Fd, 500_000, 2_000_000),
    Common(Format::Fd, 500_000, 5_000_000),
    Common(Format::Fd, 1_000_000, 2_000_000),
    Common(Format::Fd, 1_000_000, 5_000_000),
    Common(Format::Fd, 1_000_000, 8_000_000),
];

/// A format and its bit rates, nominal and data in bit/s.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Common(pub Format, pub u32, pub u32);

impl Common {
    /// Returns the rates, if valid.
    #[must_use]
    pub fn rates(&self) -> Option<BitRates> {
        BitRates::new(self.1, self.2).ok()
    }
}

/// Formats the name of a format with its rates: `1M/5M`, `classic 1M`.
#[must_use]
pub fn name(format: Format, rates: BitRates) -> String {
    match format {
        Format::Fd => rates.to_string(),
        Format::Classic => format!("classic {rates}"),
    }
}

/// A bus with rates and cells, and its assessment.
#[derive(Clone, Debug, PartialEq)]
pub struct AssessedBus {
    /// The assessed case.
    pub case: Case,
    /// Shares of its time.
    pub load: Load,
    /// Worst-case times.
    pub times: Times,
    /// The exceeded limits.
    pub exceeded: Vec<Limit>,
}

impl AssessedBus {
    /// Assesses a bus.
    #[must_use]
    pub fn assess(case: &Case) -> Self {
        Self { case: case.clone(), load: case.load(), times: case.times(), exceeded: exceeded(case) }
    }

    /// Returns the verdict.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        Verdict::from_limits(&self.exceeded, self.case.answers.cells())
    }
}

/// The fit of one bus of a skin.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BusFit {
    /// Its name.
    #[serde(rename = "bus")]
    pub name: String,
    /// The bus as described.
    #[serde(flatten)]
    pub rated: AssessedBus,
    /// The maximum number of cells on it.
    #[serde(rename = "most_cells")]
    pub most: MaxCells,
    /// The number of buses that its cells need.
    #[serde(rename = "buses_needed", serialize_with = "json::needed")]
    pub need: NeededBuses,
    /// Alternatives to the answers of its cells.
    #[serde(rename = "other_answers")]
    pub answers: Vec<Hint>,
    /// Other hints, if it exceeds a limit.
    #[serde(rename = "changes")]
    pub hints: Vec<Hint>,
}

/// Assesses one bus of a skin, given as an index into [`Skin::buses`]; `None` if it does not exist.
#[must_use]
pub fn bus(
    skin: &Skin,
    index: usize,
    format: Format,
    rates: BitRates,
    computation_ns: u64,
) -> Option<BusFit> {
    let name = skin.buses.get(index)?.name.clone();
    let case = Case::from_skin(skin, index, format, rates, computation_ns)?;
    let most = MaxCells::for_case(&case);
    Some(BusFit {
        name,
        rated: AssessedBus::assess(&case),
        most,
        need: NeededBuses::for_cells(&most, case.answers.cells()),
        answers: hint::other_answers(skin, index, &case),
        hints: hint::hints(skin, &case),
    })
}

/// Assesses one bus of a skin as described, at these rates, with all cells answering; `None` if a cell that answers
/// with sums is unreachable.
#[must_use]
pub fn worst_case(skin: &Skin, index: usize, rates: BitRates) -> Option<AssessedBus> {
    let format = skin.buses.get(index)?.format;
    let rates = match format {
        Format::Fd => rates,
        Format::Classic => BitRates::classic(rates.nominal()).ok()?,
    };
    Some(AssessedBus::assess(&Case::from_skin(skin, index, format, rates, COMPUTATION_NS)?))
}

/// All cells of a skin, spread evenly over several buses.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SkinFit {
    /// Number of cells.
    pub cells: u32,
    /// The number of buses that they need.
    #[serde(rename = "buses_needed", serialize_with = "json::needed")]
    pub need: NeededBuses,
    /// The results for increasing numbers of buses.
    pub spread: Vec<Spread>,
}

/// Cells that are spread over several buses.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Number of buses.
    pub buses: u32,
    /// The fullest one.
    pub fullest: AssessedBus,
}

/// Spreads all cells of a skin over increasing numbers of buses like its fullest one. For several chains, only the
/// number of buses is computed. Returns `None` without a bus.
#[must_use]
pub fn whole(skin: &Skin, buses: &[BusFit]) -> Option<SkinFit> {
    let cells = u32::try_from(skin.cells.len()).unwrap_or(u32::MAX);
    let fullest = fullest(buses.iter())?;
    let need = need(skin, buses);
    let most = if carried(skin).count() > 1 { 0 } else { need.buses().unwrap_or(1) };
    let numbers = 1..=most;
    // Show only informative numbers: all below the required one are too small.
    let is_shown =
        |buses: &u32| *buses <= 6 || Some(*buses) == need.in_time() || Some(*buses) == need.buses();
    let spread = numbers
        .filter(is_shown)
        .map(|buses| (buses, fullest.rated.case.with_cells(cells.div_ceil(buses))))
        .map(|(buses, case)| Spread { buses, fullest: AssessedBus::assess(&case) });
    Some(SkinFit { cells, need, spread: spread.collect() })
}

/// Returns the chains with cells, each with its number of cells.
fn carried(skin: &Skin) -> impl Iterator<Item = (usize, u32)> {
    let on = |cell: &protocol::skin::Cell| skin.buses.get(cell.bus).map(|bus| bus.chain);
    let count = move |chain: usize| skin.cells.iter().filter(|cell| on(cell) == Some(chain)).count();
    let chains = (0..skin.robot.chains.len()).map(move |chain| (chain, count(chain)));
    chains
        .filter(|(_, cells)| *cells > 0)
        .map(|(chain, cells)| (chain, u32::try_from(cells).unwrap_or(u32::MAX)))
}

/// Returns the number of buses that all cells of a skin need. Each chain needs its own, like its fullest bus, because a
/// bus carries one chain.
fn need(skin: &Skin, buses: &[BusFit]) -> NeededBuses {
    let of_chain = |(chain, cells)| {
        let chain_of = |bus: &&BusFit| {
            let index = skin.bus_named(&bus.name)?;
            skin.buses.get(index).map(|bus| bus.chain)
        };
        let fullest = fullest(buses.iter().filter(|bus| chain_of(bus) == Some(chain)))?;
        Some(NeededBuses::for_cells(&fullest.most, cells))
    };
    let none = NeededBuses { bandwidth: Some(0), deadline: Some(0), nodes: Some(0) };
    carried(skin).filter_map(of_chain).reduce(NeededBuses::with).unwrap_or(none)
}

/// The skin with one format and its rates.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// The fullest bus as described.
    pub fullest: BusFit,
    /// The number of buses that all cells of the skin need.
    pub need: NeededBuses,
}

/// Assesses the fullest bus of a skin at all common rates, or those of one format.
#[must_use]
pub fn table(skin: &Skin, format: Option<Format>, computation_ns: u64) -> Vec<Row> {
    let rows = COMMON_RATES.iter().filter(|it| format.is_none_or(|format| format == it.0));
    let row = |common: &Common| {
        let rates = common.rates()?;
        let buses = (0..skin.buses.len()).map(|index| bus(skin, index, common.0, rates, computation_ns));
        let buses: Vec<_> = buses.flatten().collect();
        let fullest = fullest(buses.iter())?.clone();
        Some(Row { fullest, need: need(skin, &buses) })
    };
    rows.filter_map(row).collect()
}

/// Returns the bus with the highest load.
#[must_use]
pub fn fullest<'a>(buses: impl Iterator<Item = &'a BusFit>) -> Option<&'a BusFit> {
    buses.max_by(|one, other| one.rated.load.total().total_cmp(&other.rated.load.total()))
}

#[cfg(test)]
mod tests;
