//! The experiments with real processes in their quick form, and their failures.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use process::{TestDir, names};
use rustix::process::Signal;
use serde_json::Value;

#[test]
fn the_moving_arm_is_run_recorded_drawn_and_rated() {
    let place = TestDir::new();
    let ended = place.start("skinbus", "experiment fig7 fig6 fig8 --quick -o results").end();
    assert!(ended.status.success(), "{}", ended.stderr);
    assert!(ended.stderr.contains("fig6: joint torques of the moving arm"), "{}", ended.stderr);
    let results: Value = serde_json::from_str(&place.read("results/results.json")).unwrap();
    let experiments = results["experiments"].as_array().unwrap();
    let named: Vec<_> = experiments.iter().map(|experiment| experiment["name"].as_str().unwrap()).collect();
    assert_eq!(named, ["fig6", "fig7", "fig8"], "in the page's order");
    let finding = |experiment: usize, what: &str| {
        let findings = experiments[experiment]["findings"].as_array().unwrap();
        let found = findings.iter().find(|finding| finding["what"].as_str().unwrap().contains(what));
        found.unwrap_or_else(|| panic!("{what} in {findings:?}"))
    };
    let value = |finding: &Value| finding["ours"]["value"].as_f64().unwrap();
    let single = finding(0, "Q3.12");
    assert!(value(single) > 0.0 && value(single) <= 1.2e-4, "{single}");
    assert_eq!(
        (single["paper"]["value"].as_f64(), single["verdict"].as_str()),
        (Some(0.0054), Some("Better"))
    );
    // Sums of all cells, rounded: far above a step of Q3.12, far below the result of truncation.
    let summed = value(finding(0, "Q7.8"));
    assert!((1e-4..0.0356).contains(&summed), "{summed}");
    assert!((value(finding(1, "active at once")) - 24.0).abs() < 0.5);
    assert!(value(finding(1, "velocity")) > 0.0);
    assert!(
        value(finding(2, "maximum of T_skin after the switchover")) <= 0.0,
        "the central computation is off"
    );
    let page = place.read("results/report.html");
    assert!(page.contains("<svg") && page.contains("35.6\u{a0}mNm"));
    let torque = place.read("results/fig6-joint2.csv");
    let mut lines = torque.lines();
    assert_eq!(lines.next(), Some("time (s),central (Nm),distributed (Nm)"));
    let rows: Vec<Vec<&str>> = lines.map(|line| line.split(',').collect()).collect();
    let seconds = |row: &Vec<&str>| row[0].parse::<f64>().unwrap();
    // 2.4 s at 500 Hz, less the ticks that a busy machine skips; central until 1.2 s and not after.
    assert!(rows.len() > 100 && rows.windows(2).all(|pair| seconds(&pair[0]) < seconds(&pair[1])));
    assert!(rows.iter().all(|row| row[1].is_empty() == (seconds(row) > 1.1995)), "{torque}");
    assert!(rows.iter().any(|row| row[2].parse::<f64>().unwrap().abs() > 0.1), "somebody pushes");
    for name in ["arm-single.mcap", "arm-sum.mcap", "fig8.svg", "fig7-active.csv"] {
        assert!(names(&place.path("results")).contains(&name.to_owned()), "{name}");
    }
    assert_eq!(names(&place.path("results")).iter().filter(|name| name.starts_with('.')).count(), 0);
}

#[test]
fn benches_over_their_cells_are_run_drawn_and_rated() {
    let place = TestDir::new();
    let ended = place.start("skinbus", "experiment scale --quick -o results").end();
    assert!(ended.status.success(), "{}", ended.stderr);
    let results: Value = serde_json::from_str(&place.read("results/results.json")).unwrap();
    let findings = results["experiments"][0]["findings"].as_array().unwrap();
    let value = |what: &str| {
        let found = findings.iter().find(|finding| finding["what"].as_str().unwrap().contains(what));
        found.unwrap_or_else(|| panic!("{what} in {findings:?}"))["ours"]["value"].as_f64().unwrap()
    };
    assert!(value("missing for no known reason, 300 cells") <= 0.0);
    assert!(value("to the first joints") > 0.0 && value("private memory of the gateway") > 0.0);
    let rows = place.read("results/scale-processor.csv");
    let rows: Vec<&str> = rows.lines().collect();
    assert!(
        rows[0].starts_with("cells,\"all, none active (cores)\",all (cores),gateway (cores)"),
        "{rows:?}"
    );
    assert!(rows.len() == 3 && rows[1].starts_with("24,") && rows[2].starts_with("300,"), "{rows:?}");
    let summary =
        |name: &str| -> Value { serde_json::from_str(&place.read(&format!("results/{name}"))).unwrap() };
    let active = summary("scale-300-on-2-62.5-hz-active.json");
    assert_eq!(
        (active["cells"].as_array().unwrap().len(), active["buses"].as_array().unwrap().len()),
        (300, 2)
    );
    // The first cells of each bus, 15 in all.
    let due = |cell: &&Value| cell["due"].as_u64().unwrap() > 0;
    assert_eq!(active["cells"].as_array().unwrap().iter().filter(due).count(), 15);
    assert!(
        active["gateway_private_kib"].as_u64().unwrap() > 0
            && active["buses_private_kib"].as_u64().unwrap() > 0
    );
    let quiet = summary("scale-300-on-2-62.5-hz-quiet.json");
    assert_eq!(quiet["cells"].as_array().unwrap().iter().filter(due).count(), 0);
    assert!(names(&place.path("results")).iter().all(|name| !name.ends_with(".toml")), "skins are not kept");
}

#[test]
fn a_failed_or_interrupted_experiment_leaves_nothing() {
    let place = TestDir::new();
    place.write("file", "mine");
    for (words, code, said) in [
        ("experiment fig9 --quick", 2, "-o DIR is missing"),
        ("experiment fig11 -o results", 2, "there is no experiment of this name"),
        ("experiment fig9 --quick -o file", 1, "it is a file; name a folder that can be written"),
        (
            "experiment fig7 --quick -o results SKINBUS_CELL_NODE=nowhere/cell-node",
            1,
            "moving-arm bench (single)",
        ),
    ] {
        let ended = place.start("skinbus", words).end();
        assert_eq!(ended.status.code(), Some(code), "{words}: {}", ended.stderr);
        let error = ended.stderr.lines().last().unwrap_or_default();
        assert!(error.starts_with("skinbus: ") && error.contains(said), "{words}: {}", ended.stderr);
        assert!(!place.path("results").exists(), "{words}");
    }
    assert_eq!(place.read("file"), "mine");
    let running = place.start("skinbus", "experiment fig7 --quick -o results");
    running.wait_for_stderr("fig7: ");
    running.signal(Signal::INT);
    let ended = running.end();
    assert_eq!(ended.status.code(), Some(1), "{}", ended.stderr);
    assert!(ended.stderr.contains("ended by a signal: nothing was written"), "{}", ended.stderr);
    assert!(!place.path("results").exists());
}
