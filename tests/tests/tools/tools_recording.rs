//! A run's recording, read by third-party libraries: every value on every topic.
//!
//! `tests/tools/install` installs them; `tests/run` does that, and then runs this test.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::collections::BTreeSet;
use std::path::Path;

use process::{PRESSED, TestDir};
use recorded::{Message, Recorded};
use serde_json::Value;

/// Lists the values of a message in the script's format.
fn leaves(value: &Value, into: &mut Vec<String>) {
    match value {
        Value::Null => into.push("null".to_owned()),
        Value::Bool(value) => into.push(u8::from(*value).to_string()),
        Value::Number(number) if number.is_f64() => {
            let bytes = number.as_f64().unwrap().to_le_bytes();
            into.push(bytes.map(|byte| format!("{byte:02x}")).concat());
        }
        Value::Number(number) => into.push(number.to_string()),
        Value::String(text) if text.is_empty() => into.push("-".to_owned()),
        Value::String(text) => into.push(text.bytes().map(|byte| format!("{byte:02x}")).collect()),
        Value::Array(values) => values.iter().for_each(|value| leaves(value, into)),
        Value::Object(fields) => {
            let mut fields: Vec<_> = fields.iter().collect();
            fields.sort_by_key(|(name, _)| name.as_str());
            fields.into_iter().for_each(|(_, value)| leaves(value, into));
        }
    }
}

fn line(message: &Message) -> String {
    let mut words = vec![message.topic.clone(), message.log_nanos.to_string()];
    leaves(&message.value, &mut words);
    words.join(" ")
}

#[test]
#[ignore = "needs tests/tools/install"]
fn the_mcap_library_and_rosbags_read_every_value_on_every_topic() {
    let place = TestDir::new();
    place.pressed();
    place.scenario(PRESSED);
    place.bench(2.5, "--record run.mcap --record-split 1s").end().succeeded();
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = tests.join("../target/tools/bin/python");
    assert!(python.exists(), "{} is missing: tests/tools/install makes it ready", python.display());
    let script = tests.join("tools/recording.py");
    // The second file starts with the present state, too.
    let name = "run-1.mcap";
    let recorded = Recorded::read(&place.path(name));
    let topics: BTreeSet<_> = recorded.messages.iter().map(|message| message.topic.as_str()).collect();
    assert!(topics.len() >= 9 && topics.contains("/state/vcan0"), "{topics:?}");
    let mut ours: Vec<_> = recorded.messages.iter().map(line).collect();
    let read = |by: &str| {
        let words = format!("{} {by} {name}", script.display());
        let read = process::Running::start(place.command_of(&python, &words)).end().succeeded();
        read.stdout.lines().map(str::to_owned).collect::<Vec<_>>()
    };
    let first = |ours: &[String], theirs: &[String]| {
        let differs = ours.iter().zip(theirs).find(|(ours, theirs)| ours != theirs);
        assert_eq!((differs, ours.len()), (None, theirs.len()));
    };
    first(&ours, &read("mcap"));
    // It sorts by time, with an order of its own at equal times.
    let mut theirs = read("bag");
    ours.sort();
    theirs.sort();
    first(&ours, &theirs);
}

#[test]
#[ignore = "needs tests/tools/install"]
fn the_robot_and_its_cells_are_where_forward_kinematics_says() {
    let place = TestDir::new();
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = tests.join("../target/tools/bin/python");
    let script = tests.join("tools/recording.py");
    let examples = tests.join("../gateway/examples");
    place.start("skinbus", "skin generate --cells 12 -o rows.toml").end().succeeded();
    for (skin, file, tips) in [
        ("urdf.toml", "panda.urdf", "--tip hand"),
        ("two.toml", "two-arms.urdf", "--tip left_palm --tip right_palm"),
    ] {
        let import = format!("skin import {}/{file} {tips} -o {skin}", examples.display());
        place.start("skinbus", &import).end().succeeded();
    }
    // The same arms, by the description of their rows.
    let two = place.read("two.toml");
    let rows: String =
        two.lines().filter(|line| !line.starts_with("urdf = ")).flat_map(|line| [line, "\n"]).collect();
    place.write("two-rows.toml", &rows);
    let panda = vec![0.0, -0.5, 0.1, -2.0, 0.2, 1.6, 0.8];
    for (skin, start) in
        [("rows", vec![0.4; 6]), ("urdf", panda), ("two", vec![0.04; 12]), ("two-rows", vec![0.04; 12])]
    {
        let swing = format!(
            "[motion]\nkind = \"sine\"\nstart = {start:?}\namplitude = {:?}\nperiod_s = 2.0\n",
            vec![0.05; start.len()]
        );
        place.write("moving.toml", &swing);
        let run = format!(
            "run {skin}.toml --scenario moving.toml --bus-kind embedded --duration 1 --quiet --record {skin}.mcap"
        );
        place.start("skinbus", &run).end().succeeded();
        let words = format!("{} tf {skin}.mcap", script.display());
        let compared = process::Running::start(place.command_of(&python, &words)).end().succeeded();
        println!("{skin}: {}", compared.stdout.trim());
    }
}
