//! `protocol/vectors.json`, for people who write cells elsewhere: frames and their meaning, frames that are refused, a
//! session in frames, and rows of configuration, joints, sensors, and torque.
//!
//! The frames are those of `protocol/tests/golden`, which another program wrote from the document. The torques are the
//! cell's own, compared here with Eq. 8 in double precision. With `SKINBUS_TAKE_OVER=yes` this test writes the file
//! instead of comparing.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

mod arm;

use arm::Case;
use model::decode::{Decoder, json};
use protocol::can::Format;
use protocol::candump::{self, Line, Record};
use protocol::message::VERSION;
use protocol::packet::Packet;
use protocol::parameters::Parameter;
use protocol::time::Micros;
use serde_json::{Map, Value, json};

const PATH: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../protocol/vectors.json");
const PACKETS: [&str; 2] = [
    include_str!("../../../protocol/tests/golden/document.log"),
    include_str!("../../../protocol/tests/golden/fd.log"),
];
const REFUSED: &str = include_str!("../../../protocol/tests/golden/bad.log");
const SESSION: &str = include_str!("../../../protocol/tests/golden/session.log");

/// Each frame of a log and what it says.
fn said<T>(log: &str, tell: impl Fn(&Record<'_>, Map<String, Value>) -> T) -> Vec<T> {
    let mut all = Vec::new();
    for line in log.lines() {
        if let Line::Frame(record) = candump::parse(line).unwrap() {
            let decoded = Decoder::new(Some(Format::Fd)).decode(Micros(0), record.interface, &record.frame);
            let mut text = Vec::new();
            json::write(&mut text, &record, &decoded).unwrap();
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

fn torques() -> Vec<Value> {
    let row = |case: Case| {
        let (jacobian, torque) = case.answer();
        json!({
            "joint": case.parameters.joint,
            "joints": case.parameters.joints,
            "rows": case.rows(),
            "pose": case.parameters.words(Parameter::Pose),
            "contact": case.parameters.words(Parameter::Contact),
            "q": case.q.map(|word| word.to_bits()),
            "sensors": case.sensors(),
            "jacobian": jacobian.map(|word| word.to_bits()),
            "torque": torque.map(|word| word.to_bits()),
        })
    };
    arm::cases().map(row).collect()
}

/// The file: an array's elements are a line each.
fn file() -> String {
    let about = "Frames as candump and cansend write them; docs/reference/protocol.md says what they mean. torques: all numbers are \
                 words as they stand in packets: parameters 1, 16 to 21, 2, 3, joints, sensors page 0, and what the cell \
                 answers; its jacobian may differ by a step or two of 2^-14, and its torque accordingly.";
    let parts = [
        ("packets", PACKETS.iter().flat_map(|log| said(log, packet)).collect()),
        ("refused", said(REFUSED, refused)),
        ("session", said(SESSION, session)),
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
        assert!(words.iter().skip(real.len()).all(|word| word.to_bits() == 0), "joints beyond the cell's");
        for (real, word) in real.iter().zip(words) {
            assert!((real - word.to_f64()).abs() < 4e-3, "{case:?}: {real} and {}", word.to_f64());
            loaded += u32::from(real.abs() > 0.1);
        }
    }
    assert!(loaded > 30, "{loaded} torques that are worth comparing");
}
