//! `skinbus view` of recordings of earlier builds: a page at a moment shows what `skinbus dump` prints up to it.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::collections::BTreeMap;
use std::path::Path;

use process::page::{Page, address};
use process::{Running, TestDir};
use serde_json::Value;

/// A page of a recording, which stays at its beginning.
struct Recording {
    place: TestDir,
    files: Vec<String>,
    _served: Running,
    page: Page,
}

impl Recording {
    fn new(names: &[&str], more: &str) -> Self {
        let place = TestDir::new();
        for name in names {
            let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings").join(name);
            std::fs::copy(from, place.path(name)).unwrap();
        }
        let files: Vec<_> = names.iter().map(|name| (*name).to_owned()).collect();
        let served = place.start("skinbus", &format!("view {} --at 0 {more}", files.join(" ")));
        let page = Page::new(&address(&served));
        let mut it = Self { place, files, _served: served, page };
        it.page.wait_for_status("all is read", |said| said["playback"]["read"] == 1.0);
        it
    }

    /// Returns the output of `dump` with these options.
    fn dumped(&self, more: &str) -> Vec<Value> {
        let words = format!("dump {} --json {more}", self.files.join(" "));
        let dumped = self.place.start("skinbus", &words).end().succeeded();
        dumped.stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    fn at(&mut self, at_s: f64) -> Value {
        self.page.send(&format!(r#"{{"do":"seek","at_s":{at_s}}}"#));
        self.page.wait_for_status("the position", |said| {
            let at = said["playback"]["at_s"].as_f64().unwrap();
            (at - at_s).abs() < 1e-6
        })
    }

    fn length(&mut self) -> f64 {
        self.page.wait_for_status("words", |_| true)["playback"]["of_s"].as_f64().unwrap()
    }
}

/// Returns the words of the last torque of each cell, as `dump` prints them.
fn torques(dumped: &[Value]) -> BTreeMap<(String, u64), (u64, Vec<f64>)> {
    let torques = dumped.iter().filter(|line| line["kind"] == "torque" && line["verdict"] == "ok");
    let one = |line: &Value| {
        let words = line["values"]["torque_nm"].as_array().unwrap().iter();
        let words = words.map(|word| word.as_f64().unwrap()).collect();
        let from = (line["bus"].as_str().unwrap().to_owned(), line["node"].as_u64().unwrap());
        (from, (line["epoch"].as_u64().unwrap(), words))
    };
    torques.map(one).collect()
}

fn agrees_with_dump(names: &[&str], more: &str) {
    let mut recording = Recording::new(names, more);
    let (length, mut compared) = (recording.length(), 0);
    // Forwards and backwards.
    for share in [0.9, 0.2, 0.55, 0.3, 0.999, 0.7] {
        let at_s = (length * share * 1e3).round() / 1e3;
        let said = recording.at(at_s);
        assert_eq!(said["playback"]["exact"], true);
        // Up to and including this moment, to the next ns.
        let dumped = recording.dumped(&format!("--to {:.9}", at_s + 1e-9));
        let torques = torques(&dumped);
        compared += torques.len();
        for ((bus, node), (epoch, words)) in torques {
            recording.page.send(&format!(r#"{{"do":"choose","cell":"{bus}:{node}"}}"#));
            let index =
                recording.page.scene["buses"].as_array().unwrap().iter().position(|it| it["name"] == bus);
            let bus = index.unwrap();
            let said = recording.page.wait_for_status("the cell", |said| {
                said["detail"]["node"] == node && said["detail"]["bus"] == bus
            });
            let torque = &said["detail"]["torque"];
            assert_eq!(torque["epoch"], epoch, "{names:?} at {at_s}, {bus}:{node}");
            let shown: Vec<_> =
                torque["distributed"].as_array().unwrap().iter().map(|it| it.as_f64().unwrap()).collect();
            assert_eq!(shown, words, "{names:?} at {at_s}, {bus}:{node}");
        }
        let last = dumped.iter().rev().find(|line| line["kind"] == "joints");
        // Two buses have joints at different times.
        let Some(last) = last.filter(|_| names[0] != "two.mcap") else { continue };
        let positions = last["values"]["position_rad"].as_array().unwrap().clone();
        let snapshot = recording.page.wait_for_snapshot("the position", |it| (it.time - at_s).abs() < 1e-6);
        for (joint, position) in snapshot.joints.iter().zip(positions) {
            assert!((f64::from(joint[0]) - position.as_f64().unwrap()).abs() < 1e-6, "{names:?} {at_s}");
        }
    }
    assert!(compared > 3 || names[0].starts_with("sums"), "{names:?}: {compared}");
}

#[test]
fn torques_and_positions_are_those_of_dump_at_every_moment() {
    agrees_with_dump(&["fd.mcap"], "");
    agrees_with_dump(&["classic.mcap"], "");
    agrees_with_dump(&["two.mcap"], "");
    agrees_with_dump(&["sums.mcap"], "");
}

#[test]
fn the_parts_of_a_split_recording_are_one_in_any_order() {
    agrees_with_dump(&["split-2.mcap", "split.mcap", "split-1.mcap"], "");
}

#[test]
fn a_log_needs_a_skin_and_is_shown_with_it() {
    let place = TestDir::new();
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings");
    std::fs::copy(from.join("classic.log"), place.path("classic.log")).unwrap();
    let ended = place.start("skinbus", "view classic.log").end();
    assert_eq!(ended.refusal(2), "skinbus: classic.log contains no skin: name one with --skin");
}

#[test]
fn what_cannot_be_shown_is_named() {
    let place = TestDir::new();
    place.write("text.log", "(1.000000) can0 123#00\n");
    place.write("empty.mcap", "");
    for (words, expected) in [
        (
            "view nothing.mcap",
            "there is no file nothing.mcap: name a skin (to show its buses), a recording, or a bus with --skin",
        ),
        ("view /dev/null", "/dev/null is not a regular file: name a skin, to show its buses, or a recording"),
        ("view -", "there is no file -: name a skin (to show its buses), a recording, or a bus with --skin"),
        ("view text.log text.log", "the file text.log is named twice: name it once"),
    ] {
        let ended = place.start("skinbus", words).end();
        assert!(ended.refusal(2).contains(expected), "{words}: {}", ended.refusal(2));
    }
}

#[test]
fn pages_play_and_nothing_they_send_ends_it() {
    let mut recording = Recording::new(&["fd.mcap"], "");
    let page = &mut recording.page;
    page.send(r#"{"do":"play","speed":1}"#);
    page.wait_for_status("it plays", |said| {
        said["playback"]["playing"] == true && said["playback"]["at_s"].as_f64() > Some(0.05)
    });
    page.send(r#"{"do":"pause"}"#);
    page.wait_for_status("it stays", |said| said["playback"]["playing"] == false);
    for wrong in [
        r#"{"do":"seek","at_s":-1e308}"#,
        r#"{"do":"seek","at_s":1e308}"#,
        r#"{"do":"seek","at_s":1e999}"#,
        r#"{"do":"play","speed":-3}"#,
        r#"{"do":"jump","to":"nothing","forward":true}"#,
        r#"{"do":"step"}"#,
        r#"{"do":"press","cell":1,"force_n":5}"#,
        r#"{"do":"halt"}"#,
        r#"{"do":"choose","cell":"vcan99:1","frame":18446744073709551615}"#,
        r#"{"do":"choose","cell":1,"frame":0}"#,
    ] {
        page.send(wrong);
    }
    for _ in 0..50 {
        page.send(r#"{"do":"seek","at_s":0.5}"#);
        page.send(r#"{"do":"step","forward":true}"#);
    }
    page.wait_for_status("the next epoch", |said| {
        let at = said["playback"]["at_s"].as_f64().unwrap();
        (0.5..0.52).contains(&at)
    });
    page.send(r#"{"do":"seek","at_s":0.25}"#);
    page.wait_for_status("the last position", |said| said["playback"]["at_s"] == 0.25);
}
