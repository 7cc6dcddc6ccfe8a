//! Hints: changes for a bus that exceeds its limits, each with its result.

use protocol::can::Format;
use protocol::parameters::Sensing;
use protocol::skin::{Skin, SkinReply};
use serde::Serialize;

use super::case::{self, AnswerPlan, BusCase};
use super::limits::{Limit, MaxCells, NeededBuses, exceeded_limits};
use super::{AssessedBus, COMMON_RATES};

/// The longest period of joints that the wire protocol can express, in ns.
const MAX_JOINTS_PERIOD_NS: u64 = 65_535_000;

/// A change that a hint suggests, and the bus as it would be after the change.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Hint {
    /// The suggested change, as text.
    pub change: String,
    /// The bus after the change; for several buses, the one with the highest load.
    #[serde(flatten)]
    pub after: AssessedBus,
}

/// Returns the changes with which a bus would keep all limits; empty if it already does.
#[must_use]
pub fn hints(skin: &Skin, case: &BusCase) -> Vec<Hint> {
    let exceeded = exceeded_limits(case);
    if exceeded.is_empty() {
        return Vec::new();
    }
    let mut hints = hints_for_more_buses(case);
    // The limit of transceivers does not depend on the bit rate.
    if exceeded != [Limit::Nodes] {
        hints.extend(hints_for_faster_rates(case));
        hints.extend(hint_for_slower_joints(skin, case));
        hints.extend(hint_for_event_sensing(case));
    }
    hints
}

fn hint(change: String, case: &BusCase) -> Hint {
    Hint { change, after: AssessedBus::assess(case) }
}

/// Returns two hints: the number of buses that the timing needs, and the number that the transceivers need.
fn hints_for_more_buses(case: &BusCase) -> Vec<Hint> {
    let cells = case.answers.cells();
    let need = NeededBuses::for_cells(&MaxCells::for_case(case), cells);
    let mut numbers: Vec<_> =
        [need.buses_for_timing(), need.required_buses()].into_iter().flatten().filter(|&it| it > 1).collect();
    numbers.dedup();
    let spread = |buses: u32| {
        let each = cells.div_ceil(buses);
        hint(format!("{buses} buses of {each} cells"), &case.with_cells(each))
    };
    numbers.into_iter().map(spread).collect()
}

/// Returns the slowest common rates that meet the timing limits: one hint for the same format, and for a classic bus
/// one in CAN FD.
fn hints_for_faster_rates(case: &BusCase) -> Vec<Hint> {
    let at = |format: Format| {
        let rates = COMMON_RATES.iter().filter(|it| it.0 == format).filter_map(|it| it.rates());
        let others = rates.map(|rates| BusCase { format, rates, ..case.clone() }).filter(is_in_time);
        // Of equally slow rates, keep the first.
        others.reduce(
            |slowest, other| {
                if slowest.longest_frame_ns() < other.longest_frame_ns() { other } else { slowest }
            },
        )
    };
    let formats = match case.format {
        Format::Fd => [Some(Format::Fd), None],
        Format::Classic => [Some(Format::Classic), Some(Format::Fd)],
    };
    let cases = formats.into_iter().flatten().filter_map(at);
    cases.map(|it| hint(super::rates_name(it.format, it.rates), &it)).collect()
}

fn is_in_time(case: &BusCase) -> bool {
    exceeded_limits(case).iter().all(|&limit| limit == Limit::Nodes)
}

/// Returns the hint of a slower broadcast: the shortest period in whole ticks that meets the timing limits.
fn hint_for_slower_joints(skin: &Skin, case: &BusCase) -> Option<Hint> {
    let tick_ns = skin.timing.tick_nanos();
    let periods =
        (1_u64..).map(|ticks| case.period_ns + ticks * tick_ns).take_while(|&it| it <= MAX_JOINTS_PERIOD_NS);
    let slower = periods.map(|period_ns| BusCase { period_ns, ..case.clone() }).find(is_in_time)?;
    Some(hint(format!("joint_broadcast_hz = {}", frequency_hz(slower.period_ns)), &slower))
}

#[expect(clippy::cast_precision_loss, reason = "below 1e8")]
fn frequency_hz(period_ns: u64) -> f64 {
    (1e9 / period_ns as f64 * 1e6).round() / 1e6
}

/// Returns the hint of cells that send sensors frames on changes only.
fn hint_for_event_sensing(case: &BusCase) -> Option<Hint> {
    match case.sensing {
        Sensing::Off | Sensing::Event => None,
        Sensing::Continuous { .. } => {
            let quiet = BusCase { sensing: Sensing::Event, ..case.clone() };
            Some(hint("sensing = \"event\", quiet".to_owned(), &quiet))
        }
    }
}

/// Returns the bus with each other kind of answers: torques, sums with all cells on the bus, and sums with only the
/// roots on it. Sums are omitted if the wires do not reach all cells.
#[must_use]
pub fn hints_for_other_answers(skin: &Skin, bus: usize, case: &BusCase) -> Vec<Hint> {
    let slot_us = match skin.buses.get(bus).map(|it| it.reply) {
        Some(SkinReply::Sum { slot_us, .. }) => Some(slot_us),
        Some(SkinReply::Torque) | None => None,
    };
    let sums = |shared| case::sums_of_tree(skin, bus, case.period_ns, slot_us, shared);
    let torques = AnswerPlan::Torques { cells: case.answers.cells() };
    let others =
        [(Some(torques), "torques"), (sums(true), "sums of all cells"), (sums(false), "sums, only of roots")];
    let other = |(answers, change): (Option<AnswerPlan>, &str)| {
        let other = BusCase { answers: answers?, ..case.clone() };
        (other.answers != case.answers).then(|| hint(change.to_owned(), &other))
    };
    others.into_iter().filter_map(other).collect()
}
