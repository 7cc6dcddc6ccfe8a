//! Checks `protocol/vectors.json`, which is for cells that are written elsewhere: packets and their contents, refused
//! frames, segments and their outcome, exchanges of one cell with its bus, messages over wires, and rows of arithmetic.
//!
//! All vectors except the torques are those of `protocol/tests/golden`, which another program wrote from the documents.
//! The torques are the cell's own, compared here with Eq. 8 in double precision. With `SKINBUS_TAKE_OVER=yes` this test
//! writes the file instead of comparing it.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

mod arm;

use arm::ArmCase;
use model::decode::{Decoder, json};
use protocol::can::Format;
use protocol::candump::{self, CandumpLine, Record};
use protocol::message::VERSION;
use protocol::packet::Packet;
use protocol::parameters::Parameter;
use protocol::schema::BusUnits;
use protocol::time::Micros;
use serde_json::{Map, Value, json};

const PATH: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../protocol/vectors.json");
const PACKETS: [&str; 2] = [
    include_str!("../../../../protocol/tests/golden/document.log"),
    include_str!("../../../../protocol/tests/golden/fd.log"),
];
const REFUSED: &str = include_str!("../../../../protocol/tests/golden/bad.log");
const REASSEMBLY: &str = include_str!("../../../../protocol/tests/golden/classic.log");
const SESSION: &str = include_str!("../../../../protocol/tests/golden/session.log");
const REFUSALS: &str = include_str!("../../../../protocol/tests/golden/refusals.log");
const EXCHANGE: &str = include_str!("../../../../protocol/tests/golden/exchange.log");
const WIRE: &str = include_str!("../../../../protocol/tests/golden/wire.log");
const ARITHMETIC: &str = include_str!("../../../../protocol/tests/golden/arithmetic.json");

/// Converts each frame of a log, with its JSON description, by `tell`.
fn convert_log<T>(log: &str, tell: impl Fn(&Record<'_>, Map<String, Value>) -> T) -> Vec<T> {
    let mut all = Vec::new();
    for line in log.lines() {
        if let CandumpLine::Frame(record) = candump::parse(line).unwrap() {
            let decoded = Decoder::new(Some(Format::Fd)).decode(Micros(0), record.interface, &record.frame);
            let mut text = Vec::new();
            json::write_json_line(&mut text, &record, &decoded, BusUnits::default()).unwrap();
            let mut object: Map<String, Value> = serde_json::from_slice(&text).unwrap();
            object.retain(|key, _| {
                !matches!(key.as_str(), "time_ns" | "bus" | "raw" | "id" | "verdict" | "crc")
            });
            all.push(tell(&record, object));
        }
    }
    all
}

fn packet(record: &Record<'_>, mut says: Map<String, Value>) -> Value {
    let classic = Packet::from_fd(&record.frame).unwrap().frames(Format::Classic);
    says.insert("fd".to_owned(), record.frame.to_string().into());
    says.insert("classic".to_owned(), classic.map(|frame| frame.to_string()).collect());
    says.into()
}

fn refused(record: &Record<'_>, says: Map<String, Value>) -> Value {
    json!({ "fd": record.frame.to_string(), "error": says["error"] })
}

fn session(record: &Record<'_>, says: Map<String, Value>) -> Value {
    let from = Packet::from_fd(&record.frame).unwrap().id.sender().map_or("gateway", |_| "cell");
    json!({ "from": from, "fd": record.frame.to_string(), "kind": says["kind"] })
}

/// Returns the frames of a log, each with the last title and the last comment above it.
fn commented(log: &str) -> impl Iterator<Item = (&str, &str, Record<'_>)> {
    let (mut title, mut comment) = ("", "");
    log.lines().filter_map(move |line| {
        title = line.strip_prefix("## ").unwrap_or(title);
        comment = line.strip_prefix("# ").unwrap_or(comment);
        if let CandumpLine::Frame(record) = candump::parse(line).unwrap() {
            Some((title, comment, record))
        } else {
            None
        }
    })
}

/// Returns segments in the order of their arrival, each with its time and with the outcome of reassembly.
fn reassembly() -> Vec<Value> {
    let rows = commented(REASSEMBLY).map(|(title, comment, record)| {
        let outcome = match comment.split_once(' ') {
            None => comment,
            Some(("whole", _)) => "complete",
            Some(_) => "refused",
        };
        let at_us = record.time.nanos / 1_000 % 10_000_000;
        json!({ "case": title, "at_us": at_us, "frame": record.frame.to_string(), "outcome": outcome })
    });
    rows.collect()
}

/// Returns the frames that one cell receives and sends from its start on: a row for each start, and one for each frame.
fn exchanges() -> Vec<Value> {
    let mut rows = Vec::new();
    let mut title = "";
    let mut frames = commented(EXCHANGE);
    for line in EXCHANGE.lines() {
        title = line.strip_prefix("## ").unwrap_or(title);
        if let Some(fields) = line.strip_prefix("# start ") {
            let fields = fields.split(' ').map(|field| field.split_once('=').unwrap());
            let number = |text: &str| text.parse::<u32>().map_or_else(|_| Value::from(text), Value::from);
            let start: Map<_, _> = fields.map(|(key, value)| (key.to_owned(), number(value))).collect();
            rows.push(json!({ "exchange": title, "start": start }));
        } else if line.starts_with('(') {
            let (_, comment, record) = frames.next().unwrap();
            let (from, meaning) = comment.split_once(' ').unwrap();
            let at_us = record.time.nanos / 1_000 % 10_000_000;
            let frame = record.frame.to_string();
            rows.push(json!({ "at_us": at_us, "from": from, "frame": frame, "meaning": meaning }));
        }
    }
    rows
}

/// Returns messages over wires, each with its contents, or with an error if it is refused.
fn wires() -> Vec<Value> {
    let row = |(_, meaning, record): (&str, &str, Record<'_>)| json!({ "frame": record.frame.to_string(), "meaning": meaning });
    commented(WIRE).map(row).collect()
}

fn arithmetic(section: &str) -> Vec<Value> {
    let all: Value = serde_json::from_str(ARITHMETIC).unwrap();
    all[section].as_array().unwrap().clone()
}

fn torques() -> Vec<Value> {
    let row = |case: ArmCase| {
        let (jacobian, torque) = case.answer();
        json!({
            "joint": case.parameters.joint,
            "joints": case.parameters.joints,
            "rows": case.rows(),
            "pose": case.parameters.words(Parameter::Pose),
            "contact": case.parameters.words(Parameter::Contact),
            "q": case.of_chain(case.q.map(|word| word.to_bits())),
            "sensors": case.sensors(),
            "jacobian": case.of_chain(jacobian.map(|word| word.to_bits())),
            "jacobian_exact": case.of_chain(case.exact_jacobian().map(|word| word.to_bits())),
            "torque": case.of_chain(torque),
        })
    };
    arm::cases().map(row).collect()
}

/// Returns the text of `vectors.json`, with each element of an array on its own line.
fn file() -> String {
    let about = "Frames are in the format of candump and cansend; docs/reference/protocol.md defines their meaning, \
                 and docs/reference/cell.md the behaviour of a cell. packets: frames and their meaning. refused: \
                 frames that are not valid packets. reassembly: segments in the order of their arrival, and the \
                 result of each. session: a cell is configured and pressed. refusals: each is a write to the cell of \
                 session after its commit, out of test mode, and the answer (for parameter 127: the answer to a \
                 commit after that write). exchanges: a start, then all frames that one cell receives (bus) and has \
                 to send (cell); the title names the requirements, and cell.md lists the options that it needs; flash \
                 is empty, or has the parameters that session commits. wires: messages over wires. All other numbers \
                 are words as in packets. forces: parameter 3, sensors page 0, F_z with 16 fraction bits, J, torque. \
                 sums: epochs of one cell, with its own J and F_z, the sums of its children, and its sum. torques: \
                 parameters 1, 16 to 21, 2, 3, joints, sensors page 0, and the answer of this project's cell; the \
                 jacobian of another cell may differ from jacobian_exact as J-3 allows, and its torque accordingly.";
    let parts = [
        ("packets", PACKETS.iter().flat_map(|log| convert_log(log, packet)).collect()),
        ("refused", convert_log(REFUSED, refused)),
        ("reassembly", reassembly()),
        ("session", convert_log(SESSION, session)),
        ("refusals", convert_log(REFUSALS, session)),
        ("exchanges", exchanges()),
        ("wires", wires()),
        ("forces", arithmetic("forces")),
        ("sums", arithmetic("sums")),
        ("torques", torques()),
    ];
    let array = |(name, rows): &(&str, Vec<Value>)| {
        let rows: Vec<_> = rows.iter().map(|row| format!("    {row}")).collect();
        format!("  \"{name}\": [\n{}\n  ]", rows.join(",\n"))
    };
    let parts: Vec<_> = parts.iter().map(array).collect();
    format!(
        "{{\n  \"about\": {},\n  \"version\": {VERSION},\n{}\n}}\n",
        Value::from(about),
        parts.join(",\n")
    )
}

#[test]
fn the_vectors_are_what_the_code_says() {
    let file = file();
    if std::env::var_os("SKINBUS_TAKE_OVER").is_some() {
        std::fs::write(PATH, &file).unwrap();
    }
    let _: Value = serde_json::from_str(&file).unwrap();
    assert!(std::fs::read_to_string(PATH).unwrap() == file, "SKINBUS_TAKE_OVER=yes writes the vectors again");
}

#[test]
fn the_torques_are_those_of_equation_8() {
    let mut loaded = 0;
    for case in arm::cases() {
        let (real, (_, words)) = (case.real(), case.answer());
        assert!(words.iter().skip(real.len()).all(|&word| word == 0), "joints beyond the cell's");
        for (real, word) in real.iter().zip(words) {
            let word = case.parameters.torque_format.to_real(word);
            assert!((real - word).abs() < 4e-3, "{case:?}: {real} and {word}");
            loaded += u32::from(real.abs() > 0.1);
        }
    }
    assert!(loaded > 30, "{loaded} torques that are worth comparing");
}
