//! `skinbus view --foxglove` beside Foxglove's own client and its reader of ROS 2 messages, `@foxglove/ws-protocol` and
//! `@foxglove/rosmsg2-serialization`.
//!
//! `tests/tools/install` installs them; `tests/tools/run` does that, and then runs this test.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use process::page::{Page, address};
use process::viewer::viewer_url;
use process::{PRESSED, Running, TestDir};
use recorded::Recorded;
use serde_json::Value;

/// Starts Foxglove's client, which ends when no message has come for some seconds.
fn client(place: &TestDir, url: &str, seconds: u32) -> Running {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let modules = tests.join("../target/foxglove");
    assert!(modules.exists(), "{} is missing: tests/tools/install makes it ready", modules.display());
    let mut node = Command::new("node");
    node.arg(tests.join("tools/foxglove.mjs")).arg(modules).args([url, &seconds.to_string()]);
    node.current_dir(place.path(""));
    Running::start(node)
}

fn lines(output: &str) -> Vec<Value> {
    output.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Returns the elements of an array. JavaScript writes 0 for 0.0.
fn numbers(array: &Value) -> Vec<f64> {
    array.as_array().unwrap().iter().map(|it| it.as_f64().unwrap()).collect()
}

fn topics<'a>(lines: impl IntoIterator<Item = &'a Value>) -> BTreeSet<String> {
    lines.into_iter().filter_map(|line| Some(line["topic"].as_str()?.to_owned())).collect()
}

#[test]
#[ignore = "needs tests/tools/install"]
fn foxgloves_client_gets_and_decodes_all_topics_of_a_run_and_of_its_recording() {
    let place = TestDir::new();
    place.skin(6);
    place.scenario(PRESSED);
    let bench = place.running_bench(8.0, "--record run.mcap");
    let view = place.start("skinbus", "view skin.toml --bus-kind embedded --foxglove 0");
    let live = client(&place, &viewer_url(&view), 3);
    bench.end().succeeded();
    let live = lines(&live.end().succeeded().stdout);
    drop(view);

    let recorded = Recorded::read(&place.path("run.mcap"));
    let in_file: BTreeSet<_> = recorded.messages.iter().map(|message| message.topic.clone()).collect();
    let came = topics(&live);
    assert!(came.is_subset(&in_file) && came.len() + 2 >= in_file.len(), "{came:?} of {in_file:?}");

    let view = place.start("skinbus", "view run.mcap --at 0 --foxglove 0");
    let played = client(&place, &viewer_url(&view), 5);
    played.wait_for_stdout("/UR5/joint_states");
    let mut page = Page::new(&address(&view));
    page.send(r#"{"do":"play","speed":2}"#);
    let played = lines(&played.end().succeeded().stdout);
    assert_eq!(topics(&played), in_file);
    // On a busy machine the client may be told that some messages were dropped.
    let states: BTreeMap<_, _> =
        recorded.on("/UR5/joint_states").map(|state| (state.log_nanos.to_string(), &state.value)).collect();
    let mut compared = 0;
    for came in played.iter().filter(|line| line["topic"] == "/UR5/joint_states") {
        let state = states[came["nanos"].as_str().unwrap()];
        assert_eq!(
            (numbers(&came["position"]), &came["names"]),
            (numbers(&state["position"]), &state["name"])
        );
        compared += 1;
    }
    assert!(compared > 500, "{compared} of {}", states.len());
}
