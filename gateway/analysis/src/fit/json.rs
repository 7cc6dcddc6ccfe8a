//! The same as JSON.

use protocol::can::Format;
use protocol::skin::Skin;
use serde::Serialize;

use super::case::{Answers, Load};
use super::limits::{Limit, Most, Need};
use super::remedy::Remedy;
use super::verdict::Verdict;
use super::{BusFit, Judged, Row, Whole, name};

#[derive(Serialize)]
struct Document<'a> {
    skin: &'a str,
    cells: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    buses: Option<Vec<Bus<'a>>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    whole: Option<Spread>,
    #[serde(skip_serializing_if = "Option::is_none")]
    table: Option<Vec<Bus<'a>>>,
}

#[derive(Serialize)]
struct Bus<'a> {
    bus: &'a str,
    #[serde(flatten)]
    judged: Figures,
    most_cells: Most,
    buses_needed: Needed,
    other_answers: Vec<Change<'a>>,
    changes: Vec<Change<'a>>,
}

#[derive(Serialize)]
struct Figures {
    name: String,
    verdict: Verdict,
    format: &'static str,
    nominal: u32,
    data: u32,
    cells: u32,
    answers: &'static str,
    period_us: f64,
    computation_us: f64,
    packet_us: f64,
    load: Shares,
    joints_us: Option<f64>,
    last_answer_us: Option<f64>,
    by_chain_us: Option<f64>,
    by_response_us: Option<f64>,
    deadline_us: f64,
    heartbeat_us: Option<f64>,
    exceeded: Vec<Limit>,
}

#[derive(Serialize)]
struct Shares {
    joints: f64,
    answers: f64,
    sensors: f64,
    heartbeats: f64,
    total: f64,
}

#[derive(Serialize)]
struct Change<'a> {
    change: &'a str,
    #[serde(flatten)]
    after: Figures,
}

#[derive(Serialize)]
struct Needed {
    #[serde(flatten)]
    by: Need,
    buses: Option<u32>,
    binding: Vec<Limit>,
}

#[derive(Serialize)]
struct Spread {
    cells: u32,
    buses_needed: Needed,
    spread: Vec<OnBuses>,
}

#[derive(Serialize)]
struct OnBuses {
    buses: u32,
    fullest: Figures,
}

/// What was found of single buses with their whole, or of common rates; all times in µs, loads as shares of 1, and what
/// has no bound as null.
#[must_use]
#[expect(clippy::missing_panics_doc, reason = "strings for keys and finite numbers are always JSON")]
pub fn json(skin: &Skin, buses: &[BusFit], whole: Option<&Whole>, table: &[Row]) -> serde_json::Value {
    let some = |list: Vec<_>| (!list.is_empty()).then_some(list);
    let document = Document {
        skin: &skin.name,
        cells: skin.cells.len(),
        buses: some(buses.iter().map(|it| bus(it, it.need)).collect()),
        whole: whole.map(spread),
        table: some(table.iter().map(|it| bus(&it.fullest, it.need)).collect()),
    };
    serde_json::to_value(document).expect("strings for keys and finite numbers")
}

fn bus(fit: &BusFit, need: Need) -> Bus<'_> {
    Bus {
        bus: &fit.name,
        judged: figures(&fit.judged),
        most_cells: fit.most,
        buses_needed: needed(need),
        other_answers: fit.answers.iter().map(change).collect(),
        changes: fit.remedies.iter().map(change).collect(),
    }
}

fn change(remedy: &Remedy) -> Change<'_> {
    Change { change: &remedy.change, after: figures(&remedy.after) }
}

fn spread(whole: &Whole) -> Spread {
    let spread =
        whole.spread.iter().map(|(buses, fullest)| OnBuses { buses: *buses, fullest: figures(fullest) });
    Spread { cells: whole.cells, buses_needed: needed(whole.need), spread: spread.collect() }
}

fn needed(by: Need) -> Needed {
    Needed { by, buses: by.buses(), binding: by.binding() }
}

fn figures(judged: &Judged) -> Figures {
    let Judged { case, load, times, exceeded } = judged;
    Figures {
        verdict: judged.verdict(),
        name: name(case.format, case.rates),
        format: match case.format {
            Format::Fd => "fd",
            Format::Classic => "classic",
        },
        nominal: case.rates.nominal(),
        data: case.rates.data(),
        cells: case.answers.cells(),
        answers: match case.answers {
            Answers::Torques { .. } => "torques",
            Answers::Sums { shared: true, .. } => "sums",
            Answers::Sums { shared: false, .. } => "sums of roots",
        },
        period_us: micros(case.period_ns),
        computation_us: micros(case.computation_ns),
        packet_us: micros(case.packet_ns()),
        load: shares(load),
        joints_us: times.joints_ns.map(micros),
        last_answer_us: times.last_ns().map(micros),
        by_chain_us: times.chain_ns.map(micros),
        by_response_us: times.response_ns.map(|it| micros(it.worst_ns)),
        deadline_us: micros(case.deadline_ns()),
        heartbeat_us: times.heartbeat_ns.map(micros),
        exceeded: exceeded.clone(),
    }
}

fn shares(load: &Load) -> Shares {
    let Load { joints, answers, sensors, heartbeats } = *load;
    Shares { joints, answers, sensors, heartbeats, total: load.total() }
}

/// Nanoseconds in µs.
#[expect(clippy::cast_precision_loss, reason = "at most a minute")]
fn micros(ns: u64) -> f64 {
    ns as f64 / 1e3
}
