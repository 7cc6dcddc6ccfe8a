//! The same as JSON.

use protocol::can::Format;
use protocol::skin::Skin;
use serde::{Serialize, Serializer};
use serde_json::{Value, json};

use super::case::Answers;
use super::limits::Need;
use super::{BusFit, Judged, Row, Whole, name};

/// What was found of single buses with their whole, or of common rates; all times in µs, loads as shares of 1, and what
/// has no bound as null.
#[must_use]
pub fn json(skin: &Skin, buses: &[BusFit], whole: Option<&Whole>, table: &[Row]) -> Value {
    let mut document = json!({ "skin": skin.name, "cells": skin.cells.len() });
    let mut add = |key: &str, value: Option<Value>| {
        value.into_iter().for_each(|value| document[key] = value);
    };
    add("buses", (!buses.is_empty()).then(|| json!(buses)));
    add("whole", whole.map(|whole| json!(whole)));
    // A row's buses are those for all cells of the skin.
    let rows = table.iter().map(|row| BusFit { need: row.need, ..row.fullest.clone() });
    add("table", (!table.is_empty()).then(|| rows.map(|row| json!(row)).collect()));
    document
}

/// How many buses, and what asks for so many.
pub(super) fn needed<S: Serializer>(need: &Need, serializer: S) -> Result<S::Ok, S::Error> {
    let Need { bandwidth, deadline, nodes } = need;
    json!({
        "bandwidth": bandwidth,
        "deadline": deadline,
        "nodes": nodes,
        "buses": need.buses(),
        "binding": need.binding(),
    })
    .serialize(serializer)
}

impl Serialize for Judged {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self { case, load, times, exceeded } = self;
        let answers = match case.answers {
            Answers::Torques { .. } => "torques",
            Answers::Sums { shared: true, .. } => "sums",
            Answers::Sums { shared: false, .. } => "sums of roots",
        };
        let mut load_and_total = json!(load);
        load_and_total["total"] = load.total().into();
        json!({
            "name": name(case.format, case.rates),
            "verdict": self.verdict(),
            "format": if case.format == Format::Fd { "fd" } else { "classic" },
            "nominal": case.rates.nominal(),
            "data": case.rates.data(),
            "cells": case.answers.cells(),
            "answers": answers,
            "period_us": micros(case.period_ns),
            "computation_us": micros(case.computation_ns),
            "packet_us": micros(case.packet_ns()),
            "load": load_and_total,
            "joints_us": times.joints_ns.map(micros),
            "last_answer_us": times.last_ns().map(micros),
            "by_chain_us": times.chain_ns.map(micros),
            "by_response_us": times.response_ns.map(|it| micros(it.worst_ns)),
            "deadline_us": micros(case.deadline_ns()),
            "heartbeat_us": times.heartbeat_ns.map(micros),
            "exceeded": exceeded,
        })
        .serialize(serializer)
    }
}

/// Nanoseconds in µs.
#[expect(clippy::cast_precision_loss, reason = "at most a minute")]
fn micros(ns: u64) -> f64 {
    ns as f64 / 1e3
}
