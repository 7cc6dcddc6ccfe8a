//! Tests which benches the experiment runs, and how it evaluates their summaries.

use std::cell::Cell;

use super::*;
use crate::arm::ReplyMode;
use crate::moving::BenchRun;
use analysis::report::figure::FindingVerdict;
use model::scenario::Scenario;
use protocol::skin::Skin;
use serde_json::json;

/// A lab that makes up the results of benches: up to a number of replies per second, all are in time. It stores which
/// benches were requested.
struct FakeLab {
    most: f64,
    ran: Vec<ScaleBench>,
    clock: Cell<u64>,
}

impl ExperimentLab for FakeLab {
    type Error = &'static str;

    fn now_ns(&self) -> u64 {
        self.clock.set(self.clock.get() + 1);
        self.clock.get()
    }

    fn run_bench(&mut self, _: ReplyMode, _: Effort) -> Result<BenchRun, &'static str> {
        Err("no bench of the moving arm is asked for")
    }

    fn run_scaled_bench(&mut self, bench: &ScaleBench) -> Result<Value, &'static str> {
        self.ran.push(*bench);
        Ok(summary(bench, bench.hz * count_to_f64(bench.cells) <= self.most))
    }

    fn check_stopped(&mut self) -> Result<(), &'static str> {
        Ok(())
    }
}

/// Returns the summary of a bench. If `in_time` is false, half of the replies are late.
pub(crate) fn summary(bench: &ScaleBench, in_time: bool) -> Value {
    let due = if bench.active { count_to_f64(touched_cells(bench.cells)) * bench.hz } else { 0.0 };
    let bus = json!({
        "replies": { "due": due / 2.0, "in_time": if in_time { due / 2.0 } else { due / 4.0 }, "unknown": 0 },
        "uplink": { "unknown": 0 },
    });
    json!({
        "outcome": "done", "first_broadcast_s": 1.5, "buses": [bus, bus],
        "processor": { "gateway": 0.1, "buses": 0.2, "cells": 0.3 },
        "gateway_private_kib": 100_000, "buses_private_kib": 2_000, "cell_private_kib": 1_000,
        "loop": {
            "took_distributed_us": { "p50": 2.0 }, "late_us": { "p99": 90.0 }, "idle_late_us": { "p99": 60.0 },
        },
    })
}

fn made(most: f64) -> FakeLab {
    FakeLab { most, ran: Vec::new(), clock: Cell::new(0) }
}

#[test]
fn every_bench_has_a_skin_and_a_scenario_that_fits_it_and_a_name_of_its_own() {
    for (cells, buses, active, touched) in [(24, 1, true, 2), (300, 2, true, 15), (300, 2, false, 0)] {
        let bench = ScaleBench { cells, buses, hz: 31.25, active, seconds: 2.0 };
        let skin = Skin::parse("skin.toml", &bench.skin_toml()).unwrap();
        assert_eq!((skin.cells.len(), skin.buses.len()), (cells, buses));
        let scenario = Scenario::parse("scenario.toml", &bench.scenario_toml(), &skin).unwrap();
        let touches: usize = scenario.touches.iter().map(|touch| touch.cells.len()).sum();
        assert_eq!((touches, scenario.duration.seconds().to_string()), (touched, "2".to_owned()));
        assert!(!bench.name().contains(' '));
    }
}

#[test]
fn rates_are_tried_from_the_highest_until_one_holds() {
    let mut lab = made(500.0 * 62.5);
    let found = |lab: &mut FakeLab, cells| measure_bench_size(lab, cells, FULL_PLAN).unwrap();
    let small = found(&mut lab, 253);
    assert_eq!((small.buses, small.hz.to_string(), small.holds), (1, "62.5".to_owned(), true));
    assert_eq!(lab.ran.len(), 2, "one active and one quiet");
    let larger = found(&mut lab, 1_012);
    assert_eq!((larger.buses, larger.hz.to_string(), larger.holds), (4, "15.625".to_owned(), true));
    let most = found(&mut lab, 10_000);
    assert_eq!((most.buses, most.hz.to_string(), most.holds), (40, "15.625".to_owned(), false));
    assert!((most.active.in_time_share() - 0.5).abs() < 1e-9 && most.quiet.in_time_share().is_nan());
    assert!(lab.ran.last().is_some_and(|bench| !bench.active));
}

#[test]
fn a_summary_is_added_up_over_its_buses() {
    let bench = ScaleBench { cells: 300, buses: 2, hz: 20.0, active: true, seconds: 1.0 };
    let figures = BenchFigures::from_summary(&summary(&bench, true));
    assert!((figures.due - 300.0).abs() < 1e-9 && (figures.in_time_share() - 1.0).abs() < 1e-9);
    assert!(figures.done && figures.holds_rate());
    assert!((figures.memory_mb[0] - 102.4).abs() < 1e-9);
    let mut lost = summary(&bench, true);
    lost["buses"][1]["uplink"]["unknown"] = json!(1);
    assert!(!BenchFigures::from_summary(&lost).holds_rate(), "a packet is missing for no known reason");
    let halted = json!({ "outcome": "halted" });
    assert!(!BenchFigures::from_summary(&halted).holds_rate());
}

#[test]
fn bars_are_rated_by_what_was_measured() {
    let mut measured = measure_scale(&mut made(1e9), Effort::Quick).unwrap();
    let rated = |measured: &ScaleMeasurements, what: &str| {
        let section = scale_section(measured);
        let found = section.findings.iter().find(|finding| finding.what.contains(what)).unwrap();
        (found.ours.value, found.verdict)
    };
    assert_eq!(rated(&measured, "to the first joints"), (1.5, FindingVerdict::Better));
    assert_eq!(rated(&measured, "private memory").1, FindingVerdict::Better);
    measured.beside = [1.0, 4.0, 4.5];
    assert_eq!(rated(&measured, "without threads").1, FindingVerdict::Worse);
    assert_eq!(rated(&measured, "measured the same way").1, FindingVerdict::Better);
    measured.sizes[1].active.memory_mb[0] = 201.0;
    assert_eq!(rated(&measured, "private memory").1, FindingVerdict::Worse);
}
