//! Split recordings of real processes: every part can be replayed by itself, bit for bit, with presses across the split
//! and late frames; all parts together are one recording.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;

use analysis::report::run::{ReportOptions, report};
use model::generate::{Format, ReplyMode, SkinRequest, generate};
use process::replay::{TOUCHED, send_every_message};
use process::{TestDir, skin_of, until};
use rustix::process::Signal;
use serde_json::Value;

/// Returns a scenario with touches across every split of a second, on both buses.
fn touched(buses: usize) -> String {
    let more = |bus: usize| {
        format!(
            "\n[[touch]]\nat_s = 0.4\nfor_s = 2.9\nbus = \"vcan{bus}\"\ncells = [1, 3]\nforce_n = 3.0\n\
             profile = \"step\"\n\n[[touch]]\nat_s = 0.97\nfor_s = 0.06\nbus = \"vcan{bus}\"\ncells = [2]\n\
             force_n = 3.0\nprofile = \"half-sine\"\n"
        )
    };
    TOUCHED.to_owned() + &(1..buses).map(more).collect::<String>()
}

/// Returns the parts of `run.mcap`, by their numbers.
fn parts(place: &TestDir) -> Vec<String> {
    let name = |number: u32| if number == 0 { "run.mcap".to_owned() } else { format!("run-{number}.mcap") };
    (0..).map(name).take_while(|name| place.path(name).exists()).collect()
}

/// Checks that each part, and all together, are answered as recorded, with at least `min` replies, a tenth of those
/// from a machine that is always in time.
fn all_come_back(place: &TestDir, min: u64) {
    place.is_left_clean();
    let parts = parts(place);
    assert!(parts.len() >= 3, "{parts:?}");
    let route = "--expect --spawn --speed max --quiet SKINBUS_CELLS_PER_PROCESS=8";
    let mut equal = 0;
    for part in &parts {
        let (ended, replayed) = place.replayed(part, route);
        let came_back = replayed.all_came_back(&ended);
        // In the second part at least one cell was pressed in the part before.
        assert!(part != "run-1.mcap" || came_back > min / 10, "{came_back} in {part}: {:#}", replayed.0);
        equal += came_back;
    }
    // In any order.
    let backwards = parts.iter().rev().map(String::as_str).collect::<Vec<_>>().join(" ");
    let (ended, replayed) = place.replayed(&backwards, route);
    let together = replayed.all_came_back(&ended);
    assert!(together >= min && equal >= min, "{equal} one by one, {together} together");
    let title = format!("run.mcap to {} ({} parts)", parts.last().unwrap(), parts.len());
    assert_eq!(replayed.text("/file"), title);
    place.is_left_clean();
}

#[test]
fn parts_of_a_run_with_every_message_come_back() {
    let place = TestDir::new();
    let skin = place.skin(8);
    place.scenario(&touched(1));
    let bench = place.running_bench(4.2, "--record run.mcap --record-split 1s");
    send_every_message(&place.test_client(), &skin);
    bench.end().succeeded();
    all_come_back(&place, 75);
}

#[test]
fn parts_of_two_buses_of_classic_frames_come_back() {
    let place = TestDir::new();
    place.write("skin.toml", &skin_of(16, 2, Format::Classic));
    place.scenario(&touched(2));
    place.bench(4.2, "--record run.mcap --record-split 1s").end().succeeded();
    all_come_back(&place, 120);
}

#[test]
fn parts_of_cells_that_send_events_come_back() {
    let place = TestDir::new();
    place.write(
        "skin.toml",
        &skin_of(12, 1, Format::Fd).replace("format = \"fd\"", "format = \"fd\"\nsensing = \"event\""),
    );
    place.scenario(&touched(1));
    place.bench(4.2, "--record run.mcap --record-split 1s").end().succeeded();
    all_come_back(&place, 75);
}

#[test]
fn parts_of_cells_that_send_continuously_on_a_slow_bus_come_back() {
    let place = TestDir::new();
    let expected =
        SkinRequest { cells: 9, broadcast_hz: 31.25, format: Format::Classic, ..SkinRequest::default() };
    let sensing = "format = \"classic\"\nsensing = \"continuous\"\nsensing_hz = 5.0";
    place.write("skin.toml", &generate(&expected).unwrap().replace("format = \"classic\"", sensing));
    place.scenario(&touched(1));
    place.bench(4.2, "--record run.mcap --record-split 1s").end().succeeded();
    all_come_back(&place, 40);
}

#[test]
fn parts_of_sums_come_back_with_what_rounding_carries() {
    let place = TestDir::new();
    let expected = SkinRequest { cells: 10, reply: ReplyMode::Sum, ..SkinRequest::default() };
    place.write("skin.toml", &generate(&expected).unwrap());
    place.scenario(&touched(1));
    place.bench(4.2, "--record run.mcap --record-split 1s").end().succeeded();
    all_come_back(&place, 40);
}

/// Records a run of four seconds in parts, with a touch all the time.
fn recorded(place: &TestDir) {
    place.skin(8);
    place.scenario(&touched(1));
    place.bench(3.4, "--record run.mcap --record-split 1s").end().succeeded();
}

#[test]
fn explain_dump_and_report_take_a_part_and_all_of_them() {
    let place = TestDir::new();
    recorded(&place);
    let parts = parts(&place);
    let (last, count, parts) = (parts.last().unwrap(), parts.len(), parts.join(" "));
    // Cell 1 is pressed from the beginning of the run: more than half of all epoch numbers ago, unless many were
    // skipped.
    let torques =
        place.start("skinbus", &format!("dump {last} --json --kind torque --cell 1")).end().succeeded();
    let torque: Value = serde_json::from_str(torques.stdout.lines().last().unwrap()).unwrap();
    let epoch = &torque["epoch"];
    let ended = place.start("skinbus", &format!("explain {last} --epoch {epoch} --cell 1")).end().succeeded();
    // Its stimulus is in the first part.
    let stimulus = ended.stdout.split_once("stimulus at ").and_then(|(_, rest)| rest.split(' ').next());
    let stimulus_s = stimulus.and_then(|text| text.parse::<f64>().ok());
    assert!(
        ended.stdout.contains("sensors    contact 0.6") && stimulus_s.is_some_and(|at_s| at_s.abs() < 1.0),
        "{ended:#?}"
    );
    assert!(!ended.stdout.contains("not known"), "{ended:#?}");
    let whole =
        place.start("skinbus", &format!("explain {parts} --epoch {epoch} --cell 1")).end().succeeded();
    let contact = |text: &str| text.lines().find(|line| line.contains("  contact  ")).unwrap().to_owned();
    assert_eq!(contact(&whole.stdout), contact(&ended.stdout));
    // Seconds count from the first tick, also in a part without it.
    let at = |text: &str| -> f64 {
        text.split_once(" at ").unwrap().1.split_once(" s\n").unwrap().0.parse().unwrap()
    };
    let [of_all, of_part] = [&whole, &ended].map(|ended| at(&ended.stdout));
    let earliest = epoch.as_f64().unwrap() * 0.016;
    assert!((of_all - of_part).abs() < 1e-9 && of_part >= earliest, "{of_all} {of_part}");
    for files in [&parts, last] {
        let dump = format!("dump {files} --brief --from {} --kind joints -n 1", of_part - 1e-5);
        let first = place.start("skinbus", &dump).end().succeeded().stdout;
        assert!(first.contains(&format!("joints epoch {epoch}:")), "{first}");
    }
    let beginning = place.start("skinbus", "dump run.mcap --brief").end().succeeded().stdout;
    let before = beginning.lines().filter(|line| line.starts_with('-')).count();
    let joints = beginning.lines().position(|line| line.contains("joints epoch 0:")).unwrap();
    assert!(before > 0 && before <= joints, "heartbeats come before the loop: {beginning}");

    let stats = |files: &str| -> Value {
        let ended = place.start("skinbus", &format!("dump {files} --stats --json")).end().succeeded();
        serde_json::from_str(&ended.stdout).unwrap()
    };
    let lines = |files: &str| {
        place.start("skinbus", &format!("dump {files}")).end().succeeded().stdout.lines().count()
    };
    let one_by_one: usize = parts.split(' ').map(lines).sum();
    assert_eq!(lines(&parts), one_by_one);
    let all = stats(&parts);
    assert_eq!(all["source"], format!("run.mcap to {last} ({count} parts)"));
    let ended = place.start("skinbus", &format!("convert {parts} all.log --plain")).end().succeeded();
    assert!(ended.stderr.contains(&format!("{one_by_one} frames")), "{ended:#?}");
    place.start("skinbus", &format!("fit {parts}")).end().succeeded();

    // No packet of the part before counts as lost in this one.
    let summary = place.summary();
    let ways = ["dropped", "backlog", "outage", "unknown"];
    let lost: u64 = ways.iter().map(|route| summary.number(&format!("/buses/0/uplink/{route}"))).sum();
    for files in [parts.as_str(), "run-2.mcap"] {
        let files: Vec<_> = files.split(' ').map(|name| place.path(name)).collect();
        let report = report(&files, &ReportOptions::default()).unwrap();
        let findings = report.page.sections.iter().flat_map(|section| &section.findings);
        let mut found = findings
            .filter(|finding| finding.what.starts_with("lost packets, according to the cells' counters"));
        assert!(found.next().unwrap().ours.value <= lost as f64, "{files:?}");
    }
    place.start("skinbus", &format!("report {parts}")).end().succeeded();
    assert!(place.path("run.html").exists());
}

#[test]
fn files_that_are_not_the_parts_of_one_recording_are_named() {
    let place = TestDir::new();
    recorded(&place);
    let refused = |files: &str| place.start("skinbus", &format!("dump {files}")).end().refusal(2).to_owned();
    let said = "skinbus: part 1 of the recording is missing between run.mcap and run-2.mcap: name all parts from the \
                first to the last, or only one part";
    assert_eq!(refused("run-2.mcap run.mcap run-3.mcap"), said);
    fs::copy(place.path("run-1.mcap"), place.path("again.mcap")).unwrap();
    let said = "skinbus: run-1.mcap and again.mcap are both part 1 of the recording: name only one of them";
    assert_eq!(refused("run.mcap run-1.mcap again.mcap run-2.mcap"), said);
    let line = refused("run.mcap run-1.mcap run.log");
    assert_eq!(
        line,
        "skinbus: run.mcap is one part of a split recording, but run.log is not a part of it: \
                      name only parts of that recording"
    );
    let line = refused("run.mcap nothing.mcap");
    assert!(line.starts_with("skinbus: run.mcap is a file, but nothing.mcap is not: "), "{line}");
    fs::rename(place.path("run.mcap"), place.path("run-recovered.mcap")).unwrap();
    place.bench(0.1, "--record other.mcap").end().succeeded();
    let line = refused("other.mcap run-1.mcap");
    assert!(
        line.starts_with(
            "skinbus: other.mcap and run-1.mcap belong to different recordings, which began at "
        ),
        "{line}"
    );
    // The file name does not matter, and neither do missing parts at an end.
    place.start("skinbus", "dump run-2.mcap run-1.mcap run-recovered.mcap").end().succeeded();
    place.start("skinbus", "dump run-3.mcap run-2.mcap").end().succeeded();
}

#[test]
fn parts_of_a_killed_run_come_back_recovered_or_as_they_are() {
    let place = TestDir::new();
    place.skin(8);
    place.scenario(&touched(1));
    let bench = place.running_bench(600.0, "--record run.mcap --record-split 1s");
    // The file before it has just been finished.
    until("a fourth part", || place.path("run-3.mcap.part").exists().then_some(()));
    place.test_client().waits_for_joints(20);
    bench.signal(Signal::KILL);
    bench.end();
    until("the cells' end", || place.processes().is_empty().then_some(()));
    let left = fs::read_dir(place.path(".")).unwrap();
    let left = left.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let left: Vec<_> = left.collect();
    let last = left.iter().filter(|name| name.ends_with(".part")).max();
    let last = last.unwrap_or_else(|| panic!("{left:?}"));
    let route = "--expect --spawn --speed max --quiet";
    let whole = parts(&place).join(" ");
    let (ended, replayed) = place.replayed(&format!("{whole} {last}"), "--expect --spawn --speed max");
    let as_it_is = replayed.all_came_back(&ended);
    assert!(ended.stderr.contains("its end is missing"), "{ended:#?}");
    place.start("skinbus", &format!("recover {last} -o z-recovered.mcap")).end().succeeded();
    let (ended, replayed) = place.replayed(&format!("z-recovered.mcap {whole}"), route);
    assert_eq!(replayed.all_came_back(&ended), as_it_is);
    let (ended, replayed) = place.replayed("z-recovered.mcap", route);
    replayed.all_came_back(&ended);
    assert!(as_it_is > 75, "{as_it_is}");
    place.is_left_clean();
}
