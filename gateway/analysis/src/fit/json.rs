//! The result of `skinbus fit` as JSON.

use protocol::can::Format;
use protocol::skin::Skin;
use serde::{Serialize, Serializer};
use serde_json::{Value, json};

use super::case::{AnswerPlan, BusLoad};
use super::limits::NeededBuses;
use super::{AssessedBus, BusFit, RatesRow, SkinFit, rates_name};

#[derive(Serialize)]
struct Document<'a> {
    skin: &'a str,
    cells: usize,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    buses: &'a [BusFit],
    #[serde(skip_serializing_if = "Option::is_none")]
    whole: Option<&'a SkinFit>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    table: Vec<BusFit>,
}

/// Returns the results as JSON: for each bus and for all cells together, or at common rates. Times are in µs, loads are
/// shares of 1, and an unbounded time is null.
#[must_use]
pub fn fit_json(skin: &Skin, buses: &[BusFit], whole: Option<&SkinFit>, table: &[RatesRow]) -> Value {
    // The number of buses in a row is that for all cells of the skin.
    let table = table.iter().map(|row| BusFit { need: row.need, ..row.fullest.clone() });
    let cells = skin.cells.len();
    json!(Document { skin: &skin.name, cells, buses, whole, table: table.collect() })
}

/// Serialises the number of buses that cells need, and the limits that require it.
pub(super) fn needed<S: Serializer>(need: &NeededBuses, serializer: S) -> Result<S::Ok, S::Error> {
    let NeededBuses { bandwidth, deadline, nodes } = need;
    json!({
        "bandwidth": bandwidth,
        "deadline": deadline,
        "nodes": nodes,
        "buses": need.required_buses(),
        "binding": need.binding_limits(),
    })
    .serialize(serializer)
}

impl Serialize for AssessedBus {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self { case, load, times, exceeded } = self;
        let answers = match case.answers {
            AnswerPlan::Torques { .. } => "torques",
            AnswerPlan::Sums { shared: true, .. } => "sums",
            AnswerPlan::Sums { shared: false, .. } => "sums of roots",
        };
        let BusLoad { joints, answers: of_answers, sensors, heartbeats } = *load;
        json!({
            "name": rates_name(case.format, case.rates),
            "verdict": self.verdict(),
            "format": if case.format == Format::Fd { "fd" } else { "classic" },
            "nominal": case.rates.nominal_rate(),
            "data": case.rates.data_rate(),
            "cells": case.answers.cells(),
            "answers": answers,
            "period_us": nanos_to_micros(case.period_ns),
            "computation_us": nanos_to_micros(case.computation_ns),
            "packet_us": nanos_to_micros(case.longest_packet_ns()),
            "load": {
                "joints": joints,
                "answers": of_answers,
                "sensors": sensors,
                "heartbeats": heartbeats,
                "total": load.total(),
            },
            "joints_us": times.joints_ns.map(nanos_to_micros),
            "last_answer_us": times.last_answer_ns().map(nanos_to_micros),
            "by_chain_us": times.chain_ns.map(nanos_to_micros),
            "by_response_us": times.response_ns.map(|it| nanos_to_micros(it.worst_ns)),
            "deadline_us": nanos_to_micros(case.deadline_ns()),
            "heartbeat_us": times.heartbeat_ns.map(nanos_to_micros),
            "exceeded": exceeded,
        })
        .serialize(serializer)
    }
}

/// Converts ns to µs.
#[expect(clippy::cast_precision_loss, reason = "at most a minute")]
pub(super) fn nanos_to_micros(ns: u64) -> f64 {
    ns as f64 / 1e3
}
