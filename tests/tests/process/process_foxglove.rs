//! The layout for Foxglove in docs/how-to/ matches a recording: its topics, the paths in them, and its panels.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::collections::{BTreeMap, BTreeSet};

use process::TestDir;
use recorded::Recorded;
use serde_json::Value;

const LAYOUT: &str = include_str!("../../../docs/how-to/foxglove-layout.json");

/// Returns the value at a path within a message of a topic, such as `.values[3].name`.
fn at<'a>(message: &'a Value, path: &str) -> Option<&'a Value> {
    let steps = path.split(['.', '[']).filter(|step| !step.is_empty());
    steps.into_iter().try_fold(message, |value, step| match step.strip_suffix(']') {
        Some(index) => value.get(index.parse::<usize>().unwrap()),
        None => value.get(step),
    })
}

/// Collects the panels of a layout's tree.
fn placed(layout: &Value, panels: &mut Vec<String>) {
    if let Some(panel) = layout.as_str() {
        return panels.push(panel.to_owned());
    }
    assert!(["row", "column"].contains(&layout["direction"].as_str().unwrap()));
    assert!((1.0..99.0).contains(&layout["splitPercentage"].as_f64().unwrap()));
    placed(&layout["first"], panels);
    placed(&layout["second"], panels);
}

#[test]
fn every_topic_and_path_of_the_layout_is_in_a_recording() {
    let place = TestDir::new();
    place.skin(40);
    let scenario = "duration_s = 1.5\n[[touch]]\ncells = [3, 30]\nforce_n = 4.0\nfor_s = 1.2\n";
    place.scenario(scenario);
    place.bench(1.5, "--record run.mcap").end();
    let recorded = Recorded::read(&place.path("run.mcap"));
    let mut topics = BTreeMap::<_, Vec<_>>::new();
    for message in &recorded.messages {
        topics.entry(message.topic.as_str()).or_default().push(&message.value);
    }
    let messages =
        |topic: &str| topics.get(topic).unwrap_or_else(|| panic!("{topic} is not in the recording"));

    let layout: Value = serde_json::from_str(LAYOUT).unwrap();
    let mut panels = Vec::new();
    placed(&layout["layout"], &mut panels);
    let described: BTreeSet<_> = layout["configById"].as_object().unwrap().keys().cloned().collect();
    assert_eq!(panels.iter().cloned().collect::<BTreeSet<_>>(), described);
    assert_eq!(panels.len(), described.len(), "each stands once");

    let mut kinds = BTreeSet::new();
    for (panel, config) in layout["configById"].as_object().unwrap() {
        let (kind, _) = panel.split_once('!').unwrap();
        kinds.insert(kind);
        match kind {
            "3D" => {
                for (topic, options) in config["topics"].as_object().unwrap() {
                    if topic == "/robot_description" {
                        // The robot is drawn on the frames of its links.
                        let urdf = messages(topic)[0]["data"].as_str().unwrap();
                        let poses = [messages("/tf")[0], messages("/tf_static")[0]];
                        let frames = poses.iter().flat_map(|it| it["transforms"].as_array().unwrap());
                        let frames: BTreeSet<_> =
                            frames.map(|frame| frame["child_frame_id"].as_str().unwrap()).collect();
                        let links = urdf
                            .match_indices("<child link=\"")
                            .map(|(at, found)| urdf[at + found.len()..].split('"').next().unwrap());
                        assert!(links.into_iter().all(|link| frames.contains(link)), "{frames:?}");
                        continue;
                    }
                    let cloud = messages(topic)[0];
                    let fields = cloud["fields"].as_array().unwrap().iter().map(|field| &field["name"]);
                    assert!(
                        fields.into_iter().any(|name| *name == options["colorField"]),
                        "{topic}: {cloud}"
                    );
                    assert_eq!(cloud["header"]["frame_id"], config["followTf"], "{topic}");
                }
            }
            "Plot" => {
                let paths = config["paths"].as_array().unwrap();
                assert!(!paths.is_empty(), "{panel}");
                for path in paths {
                    assert_eq!(path["timestampMethod"], "headerStamp");
                    let path = path["value"].as_str().unwrap();
                    let (topic, field) = path.split_at(path.find('.').unwrap());
                    let values = messages(topic).iter().filter_map(|message| at(message, field));
                    assert!(values.filter(|value| value.is_number()).count() > 0, "{path}");
                }
            }
            "DiagnosticSummary" => {
                let topic = config["topicToRender"].as_str().unwrap();
                assert!(messages(topic)[0]["status"][0]["level"].is_number(), "{topic}");
            }
            "RawMessages" => _ = messages(config["topicPath"].as_str().unwrap()),
            other => panic!("{other}: its topics are not checked"),
        }
    }
    assert_eq!(kinds, BTreeSet::from(["3D", "DiagnosticSummary", "Plot", "RawMessages"]));
}
