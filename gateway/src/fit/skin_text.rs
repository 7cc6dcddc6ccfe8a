//! Tables of `skinbus fit` for a skin.

use analysis::fit::case::{AnswerPlan, BusCase};
use analysis::fit::limits::{Limit, MAX_NODES_PER_BUS, NeededBuses};
use analysis::fit::starving::StarvingFrames;
use analysis::fit::verdict::{FitSummary, format_percent};
use analysis::fit::{AssessedBus, BusFit, RatesRow, SkinFit, SpreadFit, rates_name};
use protocol::parameters::Sensing;
use protocol::skin::Skin;
use protocol::usage::printable;

use crate::print::{self, KeyValueTable, comma_separated, count_with_noun, format_decimals, or_else_text};

/// Columns of the table over bit rates.
const TABLE_HEADER: [&str; 8] = [
    "bit rates",
    "packet\nµs",
    "load\n%",
    "last\nms",
    "cells\nper bus",
    "buses\nneeded",
    "roots:\nload %",
    "roots:\nlast ms",
];

/// Formats a table with one line for each pair of bit rates.
pub(super) fn table(skin: &Skin, rows: &[RatesRow]) -> String {
    let Some(first) = rows.first() else { return String::new() };
    let lines = rows.iter().map(|row| {
        let BusFit { rated, most, answers, .. } = &row.fullest;
        let roots = answers.iter().map(|it| &it.after).find(|it| is_roots_only(&it.case));
        vec![
            rates_name(rated.case.format, rated.case.rates),
            format_micros(rated.case.longest_packet_ns()),
            format_percent_number(rated.load.total()),
            last_ms(rated),
            most.max_cells_in_time().to_string(),
            row.need.short_text(),
            or_else_text(roots.map(|it| format_percent_number(it.load.total())), ""),
            or_else_text(roots.map(last_ms), ""),
        ]
    });
    let table = print::table(TABLE_HEADER, lines, |column| column > 0);
    let case = &first.fullest.rated.case;
    let cells = skin.cells.len();
    let bus = match skin.buses.len() {
        1 => format!("{cells} cells on one bus"),
        buses => format!(
            "{cells} cells on {buses} buses, here for the fullest bus (cells: {})",
            case.answers.cells()
        ),
    };
    format!(
        "{}: {bus}, a joints message every {} ms, each cell computes for {} µs\n{table}\npacket  time of the longest packet \
         on the bus\nload    bus load in the worst case, when all cells answer: joints messages, {}, heartbeats{}\nlast    \
         longest time from the scheduled joints message to the end of the last answer\ncells   cells that a bus can \
         serve in time; but transceivers can drive only about {}\nbuses   buses that {cells} cells need and, if \
         several, what limits a bus: time or nodes\nroots   load and last if cells send sums and only the roots \
         are on this bus; if all cells are on it, sums save no frames\n",
        printable(&skin.name),
        format_millis(case.period_ns),
        format_micros(case.computation_ns),
        answer_kind_name(case),
        sensor_traffic_suffix(case),
        MAX_NODES_PER_BUS - 1,
    )
}

/// Formats the results of the buses at their bit rates: a section for each bus, and one for all cells of the skin.
pub(super) fn format_bus_fits(skin: &Skin, buses: &[BusFit], whole: Option<&SkinFit>) -> String {
    let Some(first) = buses.first() else { return String::new() };
    let case = &first.rated.case;
    let period = format!("joints every {} ms", format_millis(case.period_ns));
    let computation = format!("each cell computes for {} µs", format_micros(case.computation_ns));
    let mut rows = KeyValueTable::new(&skin.name, period, computation).names_in_one_line();
    for bus in buses {
        add_bus_section(&mut rows, bus);
    }
    // With one bus, its own section has the same values.
    if let Some(whole) = whole.filter(|_| buses.len() > 1) {
        rows.add_section(format!("all {} cells", whole.cells), "", "if each bus is as full as the fullest");
        rows.add_row("buses needed", format_needed_buses(&whole.need), format_each_need(&whole.need));
        for SpreadFit { buses, fullest } in &whole.spread {
            let on = format!("{} of {} cells", count_with_noun(*buses, "bus"), fullest.case.answers.cells());
            rows.add_row(on, format_load_and_last_answer(fullest), fullest.verdict());
        }
    }
    rows.to_text()
}

fn add_bus_section(rows: &mut KeyValueTable, bus: &BusFit) {
    let BusFit { name: bus_name, rated, starving, most, need, answers, hints } = bus;
    let AssessedBus { case, load, times, .. } = rated;
    let cells = case.answers.cells();
    let worst = FitSummary::worst_case(rated);
    rows.add_section(
        format!("{bus_name} at {}", worst.rates),
        format!("{cells} cells, {}", answer_kind_name(case)),
        "",
    );
    rows.add_row(worst.case_name(), worst.table_value(), worst.cells);
    let parts = [
        (format!("joints and {}", answer_kind_name(case)), load.joints + load.answers),
        ("sensors".to_owned(), load.sensors),
        ("heartbeats".to_owned(), load.heartbeats),
    ];
    let parts = parts
        .iter()
        .filter(|it| it.1 > 0.0)
        .map(|(what, share)| format!("{what} {}", format_percent_number(*share)));
    rows.add_row("  load", format_percent(load.total()), comma_separated(parts));
    let bounds = [("by chain", times.chain_ns), ("by analysis", times.response_ns.map(|it| it.worst_ns))];
    let bounds = bounds.iter().filter_map(|(how, ns)| Some(format!("{how} {}", format_millis((*ns)?))));
    let due = format!("due after {} ms", format_millis(case.deadline_ns()));
    rows.add_row("last answer", format_last_answer(rated), comma_separated([due].into_iter().chain(bounds)));
    let heartbeat =
        or_else_text(times.heartbeat_ns.map(|ns| format!("{} ms", format_millis(ns))), "no upper bound");
    rows.add_row("heartbeats delayed by", heartbeat, "a cell silent for 600 ms counts as dead");
    for (index, frames) in starving.iter().enumerate() {
        let (which, from) = format_starving(frames, cells);
        rows.add_row(if index == 0 { "no bound for" } else { "" }, which, from);
    }
    let others = format!("bandwidth {}, deadline {}, nodes {}", most.bandwidth, most.deadline, most.nodes);
    rows.add_row("cells that fit", most.max_cells_in_time().min(most.nodes), others);
    rows.add_row("buses needed", format_needed_buses(need), format_each_need(need));
    if !hints.is_empty() {
        rows.add_section("  possible changes", "", "");
        for hint in hints {
            rows.add_row(
                format!("  {}", hint.change),
                format_load_and_last_answer(&hint.after),
                hint.after.verdict(),
            );
        }
    }
    rows.add_section("  with other replies", "", "");
    for hint in answers {
        rows.add_row(
            format!("  {}", hint.change),
            format_load_and_last_answer(&hint.after),
            hint.after.verdict(),
        );
    }
    if !answers.iter().any(|it| is_roots_only(&it.after.case)) {
        rows.add_row("  sums", "not possible", "a cell has no route to the gateway");
    }
}

/// Formats the frames of one kind that have no bound, and the node id from which on.
fn format_starving(starving: &StarvingFrames, all_cells: u32) -> (String, String) {
    let name = starving.frames.name();
    match (starving.cells, starving.from_node) {
        (Some(cells), Some(node)) if cells < all_cells => {
            (format!("{name} of {}", count_with_noun(cells, "cell")), format!("node {node} and above"))
        }
        _ => (format!("all {name}"), String::new()),
    }
}

fn is_roots_only(case: &BusCase) -> bool {
    matches!(case.answers, AnswerPlan::Sums { shared: false, .. })
}

const fn answer_kind_name(case: &BusCase) -> &'static str {
    match case.answers {
        AnswerPlan::Torques { .. } => "torques",
        AnswerPlan::Sums { .. } => "sums",
    }
}

const fn sensor_traffic_suffix(case: &BusCase) -> &'static str {
    match case.sensing {
        Sensing::Off => "",
        Sensing::Continuous { .. } => ", sensors",
        Sensing::Event => ", sensors while nothing changes",
    }
}

/// Formats the load of a bus and the time of the last answer.
fn format_load_and_last_answer(rated: &AssessedBus) -> String {
    format!("{}, {}", format_percent(rated.load.total()), format_last_answer(rated))
}

fn format_last_answer(rated: &AssessedBus) -> String {
    let AssessedBus { case, load, times, .. } = rated;
    match times.last_answer_ns() {
        Some(last_ns) => format!("{} ms", format_millis(last_ns)),
        None if load.total() > 1.0 => "no upper bound".to_owned(),
        None => format!("above {} ms", format_millis(case.period_ns)),
    }
}

/// Formats the time of the last answer in ms for a column of numbers.
#[expect(clippy::cast_precision_loss, reason = "printed with few digits")]
fn last_ms(rated: &AssessedBus) -> String {
    format_decimals(rated.times.last_answer_ns().map(|ns| ns as f64 / 1e6), 2, "-")
}

fn format_needed_buses(need: &NeededBuses) -> String {
    let why = comma_separated(need.binding_limits().into_iter().map(Limit::name));
    match need.required_buses() {
        None => format!("impossible: {why}"),
        Some(1) => "1".to_owned(),
        Some(buses) => format!("{buses}: {why}"),
    }
}

fn format_each_need(need: &NeededBuses) -> String {
    let needs = [("bandwidth", need.bandwidth), ("deadline", need.deadline), ("nodes", need.nodes)];
    comma_separated(needs.map(|(name, buses)| format!("{name} {}", or_else_text(buses, "impossible"))))
}

#[expect(clippy::cast_precision_loss, reason = "printed with few digits")]
fn format_millis(ns: u64) -> String {
    // Write at most two decimals, without trailing zeros.
    format!("{:.2}", ns as f64 / 1e6).trim_end_matches('0').trim_end_matches('.').to_owned()
}

#[expect(clippy::cast_precision_loss, reason = "printed with few digits")]
fn format_micros(ns: u64) -> String {
    format!("{:.1}", ns as f64 / 1e3)
}

/// Formats a share in %, for a column or a list.
fn format_percent_number(share: f64) -> String {
    format!("{:.1}", 100.0 * share)
}
