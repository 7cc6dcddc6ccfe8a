//! One skin and one run of it through `fit`, `report` and `experiment`: the same numbers in the same words.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use protocol::can::Format;
use protocol::candump::{Direction, Record, Timestamp, write_record};
use protocol::fixed::Q1_14;
use protocol::id::{CellId, Node};
use protocol::message::{
    Heartbeat, Joints, Message, NetworkPage, SensorPage, SkinSensors, State, StimulusStart,
};
use protocol::packet::pad_with_defaults;
use protocol::packet::{Epoch, WORDS};
use serde_json::Value;
use tempfile::TempDir;
use trace::recording::file::FileWriter;

/// Skin of the paper's arm.
const ARM: &str = include_str!("../../examples/ur5-253.toml");
const CELLS: i64 = 253;
/// Number of its cells that answer.
const ANSWERING: i64 = 120;
const MS: u64 = 1_000_000;

/// A skin, and a recording and a log of one run of it.
struct Files(TempDir);

impl Files {
    /// Creates the files, with bit rates in the skin or without.
    fn new(rates: &str) -> Self {
        let files = Self(tempfile::tempdir().unwrap());
        let skin = ARM.replace("format = \"fd\"", &format!("format = \"fd\"\n{rates}"));
        fs::write(files.path("skin.toml"), &skin).unwrap();
        let mut mcap = FileWriter::new(fs::File::create(files.path("run.mcap")).unwrap()).unwrap();
        mcap.attach("skin.toml", "application/toml", 7, skin.as_bytes()).unwrap();
        let mut topic = mcap.channel::<Record<'_>>("/can/vcan0", &[]).unwrap();
        let mut log = String::new();
        for (nanos, message) in run() {
            for frame in message.encode().frames(Format::Fd) {
                let time = Timestamp::with_nine_digits(nanos);
                let direction = Some(Direction::Received);
                let record = Record { time, interface: "vcan0", frame, direction };
                mcap.write(&mut topic, nanos, &record).unwrap();
                write_record(&mut log, &record).unwrap();
                writeln!(log).unwrap();
            }
        }
        mcap.finish().unwrap();
        fs::write(files.path("run.log"), log).unwrap();
        files
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn gateway(&self, arguments: &str) -> String {
        let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
        command.args(arguments.split(' ')).current_dir(self.0.path()).env("NO_COLOR", "1");
        let Output { status, stdout, stderr } = command.output().unwrap();
        let said = String::from_utf8(stderr).unwrap();
        assert_eq!(status.code(), Some(0), "{arguments}: {said}");
        String::from_utf8(stdout).unwrap()
    }

    fn report(&self, options: &str) -> String {
        self.gateway(&format!("report run.mcap --overwrite{options}"));
        text(&self.path("run.html"))
    }
}

/// Text of a page without tags, with one space between cells and paragraphs.
fn text(page: &Path) -> String {
    let html = fs::read_to_string(page).unwrap().replace('\u{a0}', " ");
    let parts = html.split('<').filter_map(|part| part.split_once('>').map(|(_, text)| text.trim()));
    parts.filter(|part| !part.is_empty()).collect::<Vec<_>>().join(" ")
}

/// The two columns beside a name in a table.
fn row<'a>(table: &'a str, name: &str) -> [&'a str; 2] {
    let rows = table.lines().filter_map(|line| line.trim_matches(['│', ' ']).strip_prefix(name));
    let row = rows.map(|rest| rest.trim().split_once("   ")).next().flatten();
    let (value, beside) = row.unwrap_or_else(|| panic!("no {name} in\n{table}"));
    [value.trim(), beside.trim()]
}

fn cell(node: i64) -> CellId {
    CellId::new(node).unwrap()
}

/// A run: a start-up in which all cells send at once; then two seconds of joints that fewer than half answer, with
/// stimuli.
fn run() -> Vec<(u64, Message)> {
    let mut now = 1_700_000_000_000_000_000;
    let mut said = Vec::new();
    for node in 1..=CELLS {
        let heartbeat = Heartbeat {
            serial: u32::try_from(node).unwrap(),
            state: State::CLAIMING_NODE_ID,
            ..Heartbeat::default()
        };
        let page = NetworkPage::Heartbeat(heartbeat);
        said.push((now, Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(0), page }));
    }
    now += 400 * MS;
    for epoch in 0..125 {
        let epoch = Epoch(epoch);
        for node in 1..=ANSWERING {
            let page = SensorPage::Skin(SkinSensors::default());
            said.push((
                now,
                Message::Stimulus { to: Node::Cell(cell(node)), from: StimulusStart::Next, page },
            ));
        }
        let joints = Joints { positions: pad_with_defaults(&[Q1_14::from_bits(0x2345); WORDS]), in_use: 6 };
        said.push((now, Message::Joints { epoch, joints }));
        for node in 1..=ANSWERING {
            let torque = [0x1234; WORDS];
            said.push((now + MS, Message::Torque { from: cell(node), epoch, torque: torque.into() }));
        }
        now += 16 * MS;
    }
    said
}

#[test]
fn four_commands_give_the_same_figures_for_one_skin_in_the_same_words() {
    let files = Files::new("bitrate = 1000000\ndata_bitrate = 5000000");
    let fit = files.gateway("fit skin.toml");
    let worst = row(&fit, "worst case");
    assert_eq!(worst, ["118.9 %: does not fit: bandwidth", "all 253 cells answer"]);
    assert_eq!(row(&fit, "buses needed"), ["3: nodes", "bandwidth 2, deadline 2, nodes 3"]);

    let shadow = files.gateway("fit run.mcap");
    assert_eq!(row(&shadow, "worst case"), worst);
    let run = row(&shadow, "this run");
    let (load, verdict) = run[0].split_once(": ").unwrap();
    assert_eq!((verdict, run[1]), ("in time, but 254 nodes", "at most 120 of 253 cells answered"));
    assert_eq!(row(&shadow, "highest in any second")[0], load);
    let of_log = files.gateway("fit run.log --skin skin.toml");
    assert_eq!((row(&of_log, "worst case"), row(&of_log, "this run")), (worst, run));
    let unknown = files.gateway("fit run.log --nominal 1M --data 5M");
    assert_eq!(row(&unknown, "worst case")[0], "?");
    assert_eq!(row(&unknown, "this run"), [run[0], "at most 120 of 253 observed cells answered"]);

    let report = files.report("");
    let at = "vcan0 at 1M/5M";
    let limits = "load at most 100 %, replies before the next joints message, at most 110 nodes";
    for words in [
        format!(
            "{at}, worst case: does not fit: bandwidth (all 253 cells answer) 119 % {limits} (skin: bitrate) ✗"
        ),
        format!("{at}, this run: {verdict} ({}) {load} {limits} (skin: bitrate) ✗", run[1]),
        format!("worst case does not fit: bandwidth 118.9 % {}", worst[1]),
        format!("{load} {} {}, 120 on average", row(&shadow, "highest in any 16 ms")[0], run[1]),
    ] {
        assert!(report.contains(&words), "{words}: {report}");
    }

    files.gateway("experiment load -o laws");
    let experiment = text(&files.path("laws/report.html"));
    for words in [
        "worst case of one bus at 1M/5M: does not fit: bandwidth (all 253 cells answer) 119 %",
        "1M/5M 70.4 111.8 118.9 212 2 3 (nodes)",
    ] {
        assert!(experiment.contains(words), "{words}: {experiment}");
    }
    assert!(!experiment.contains("not met"), "{experiment}");
    // The whole table: rates, cells that a bus has time for, and buses needed.
    let table: Value = serde_json::from_str(&files.gateway("fit skin.toml --table --json")).unwrap();
    let results: Value = serde_json::from_slice(&fs::read(files.path("laws/results.json")).unwrap()).unwrap();
    let findings = results["experiments"][0]["findings"].as_array().unwrap();
    let rows = table["table"].as_array().unwrap();
    assert_eq!((findings.len(), rows.len()), (7, 7));
    for (finding, row) in findings.iter().zip(rows) {
        let (name, verdict) = (row["name"].as_str().unwrap(), row["verdict"].as_str().unwrap());
        let what = format!("worst case of one bus at {name}: {verdict} (all 253 cells answer)");
        assert_eq!(finding["what"], what.as_str());
        let [ours, load] =
            [&finding["ours"]["value"], &row["load"]["total"]].map(|value| value.as_f64().unwrap());
        assert!((ours - 100.0 * load).abs() < 1e-9);
        assert_eq!(finding["verdict"], "Stated");
    }
}

#[test]
fn stimuli_and_start_up_are_no_load_of_operation() {
    let files = Files::new("");
    let shadow = files.gateway("fit run.mcap");
    assert_eq!(row(&shadow, "bench frames, left out"), ["15000 frames", "15000 stimuli"]);
    let percent = |text: &str| text.split(' ').next().unwrap().parse::<f64>().unwrap();
    let average = percent(row(&shadow, "average load")[0]);
    // 121 packets of 60 to 70 us in 16 ms, and 253 heartbeats at once before them.
    assert!((45.0..54.0).contains(&average), "{shadow}");
    let start_up = shadow.split_once("start-up").unwrap().1;
    assert!(percent(row(start_up, "highest in any 16 ms")[0]) > 95.0, "{start_up}");
    assert!(row(&shadow, "busy at least 16 ms")[0].starts_with("0 times"), "{shadow}");
    // Without bench-only frames, the log is the same.
    let log = fs::read_to_string(files.path("run.log")).unwrap();
    let without: String = log.split_inclusive('\n').filter(|line| !line.contains(" 7")).collect();
    assert!(without.len() < log.len() * 3 / 5);
    fs::write(files.path("less.log"), without).unwrap();
    let [log, less] = ["run.log", "less.log"].map(|name| files.gateway(&format!("fit {name}")));
    for name in ["average load", "highest in any second", "busy at least 16 ms", "all frames", "torque"] {
        assert_eq!(row(&log, name), row(&less, name), "{name}");
    }
    let all = files.gateway("fit run.mcap --bench-traffic");
    assert_eq!(row(&all, "bench frames, counted")[0], "15000 frames");
    assert!(percent(row(&all, "average load")[0]) > average + 40.0, "{all}");
}

#[test]
fn default_rates_are_shown_and_not_rated() {
    let files = Files::new("");
    let text = files.report("");
    assert!(
        text.contains("vcan0 at 1M/5M, worst case: does not fit: bandwidth (all 253 cells answer) 119 % ")
    );
    assert!(!text.contains("not met"), "{text}");
    let rated = files.report(" --nominal 1M --data 8M");
    assert!(rated.contains("vcan0 at 1M/8M, worst case: in time, but 254 nodes"), "{rated}");
    assert!(rated.contains("110 nodes (--nominal, --data) ✗ not met"), "{rated}");
}
