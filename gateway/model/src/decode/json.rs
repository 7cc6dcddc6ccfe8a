//! What frames say as JSON: one object a frame, the unit at the end of each key that has one.

use std::io::{self, Write};

use protocol::can::Format;
use protocol::candump::{Direction, Record};
use protocol::fixed::{Q, Q1_14, Q3_12, Q5_10};
use protocol::id::{Id, Kind};
use protocol::message::{
    Answer, From, Heard, Heartbeat, Message, NetworkPage, PortState, Ports, Refused, Request, SensorPage,
    State, Tree,
};
use protocol::packet::{BYTES, WORDS};
use protocol::parameters::{Cuts, Events, Parameter, Reply, Sensing, Slots};
use protocol::wire::{Hello, Label, Lane, PortMessage, Walk};
use serde::Serialize;

use super::parameter::{Name, reason};
use super::{Decoded, Fault, Foreign, wires};

/// A frame and what it says.
#[derive(Serialize)]
struct Line<'a> {
    time_ns: u64,
    bus: &'a str,
    /// As candump prints it.
    id: String,
    raw: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    direction: Option<&'static str>,
    verdict: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    kind: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    node: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    epoch: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    tag: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    values: Option<Values>,
    #[serde(skip_serializing_if = "Option::is_none")]
    saturated: Option<bool>,
    /// What the packet says.
    #[serde(skip_serializing_if = "Option::is_none")]
    crc: Option<String>,
    /// What its bytes give, when that is something else.
    #[serde(skip_serializing_if = "Option::is_none")]
    crc_expected: Option<String>,
}

/// What the words say, by kind and page.
#[derive(Serialize)]
#[serde(untagged)]
enum Values {
    Joints {
        position_rad: Vec<f64>,
    },
    Torque {
        torque_nm: [f64; WORDS],
    },
    Sum {
        torque_nm: [f64; WORDS],
        cells: u8,
    },
    Felt(Felt),
    Stimulus {
        from_next: bool,
        #[serde(flatten)]
        felt: Felt,
    },
    Heartbeat {
        page: &'static str,
        serial: u32,
        configuration: String,
        sent: u16,
        refused: u16,
        #[serde(flatten)]
        state: Flags,
    },
    Heard {
        page: &'static str,
        joints: u16,
        joints_skipped: u16,
        joints_repeated: u16,
        stimuli: u16,
        stimuli_late: u16,
        torques: u16,
    },
    Refused {
        page: &'static str,
        length: u16,
        crc: u16,
        foreign: u16,
        meaning: u16,
        incomplete: u16,
        stimuli: u16,
    },
    Tree {
        page: &'static str,
        parent: Option<u8>,
        up: Option<u8>,
        depth: Option<u8>,
        round: u8,
        children: Vec<u8>,
        works: Vec<u8>,
        sent: u16,
        taken: u16,
        dropped: u16,
    },
    Ports {
        page: &'static str,
        ports: [End; 4],
        changes: u16,
    },
    Wire {
        wire: u16,
        back: bool,
        #[serde(flatten)]
        says: Says,
    },
    Read {
        parameter: String,
        write: bool,
    },
    Write {
        parameter: String,
        write: bool,
        #[serde(flatten)]
        value: Value,
    },
    Has {
        parameter: String,
        written: bool,
        #[serde(flatten)]
        value: Value,
    },
    Refusal {
        parameter: String,
        refusal: i16,
        because: &'static str,
    },
}

/// A page of sensors.
#[derive(Serialize)]
#[serde(untagged)]
enum Felt {
    Skin { page: &'static str, force_n: f64, contact_n: [f64; 3], proximity: f64, temperature_c: [f64; 2] },
    Acceleration { page: &'static str, acceleration_g: [f64; 3] },
}

/// What is at the other end of a wire.
#[derive(Serialize)]
struct End {
    node: u8,
    port: u8,
    hears: bool,
    works: bool,
    other_version: bool,
}

/// What is said over a wire; what a message does not have is not there.
#[derive(Default, Serialize)]
struct Says {
    says: &'static str,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    hello: Option<Greeting>,
    #[serde(skip_serializing_if = "Option::is_none")]
    round: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    walk: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    first: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    last: Option<u8>,
}

/// What only a hello has.
#[derive(Serialize)]
struct Greeting {
    version: u8,
    number: u8,
    port: u8,
    hears: bool,
    up: bool,
    unnumbered: bool,
}

/// A state word.
#[derive(Serialize)]
struct Flags {
    state: Vec<&'static str>,
    joint: u16,
    version: u16,
}

/// The words of a parameter.
#[derive(Serialize)]
#[serde(untagged)]
enum Value {
    Identity {
        serial: u32,
        identity_version: u16,
        configuration: String,
        #[serde(flatten)]
        state: Flags,
    },
    Mount {
        joint: i16,
        joints: i16,
    },
    Pose {
        position_m: [f64; 3],
        normal: [f64; 3],
    },
    Contact {
        alpha_c: f64,
        alpha_p_n: f64,
        contact_threshold_n: f64,
        proximity_threshold: f64,
        force_threshold_n: f64,
    },
    Timing {
        period_us: u16,
    },
    Mode {
        mode: i16,
    },
    Reply {
        reply: &'static str,
        #[serde(flatten)]
        slots: Option<SlotsValue>,
    },
    Sensing {
        sensing: &'static str,
        #[serde(skip_serializing_if = "Option::is_none")]
        period_ms: Option<u16>,
    },
    Events {
        contact_n: f64,
        proximity: f64,
        temperature_c: f64,
        acceleration_g: f64,
        hysteresis: f64,
    },
    Cuts {
        deaf_ports: Vec<u8>,
    },
    Row {
        a_m: f64,
        d_m: f64,
        alpha_rad: f64,
        theta_offset_rad: f64,
    },
    Commit {
        hash: String,
    },
    Unknown {
        words: [i16; WORDS],
    },
}

/// When sums are said.
#[derive(Serialize)]
struct SlotsValue {
    slot_us: u16,
    deepest: u8,
    carry: bool,
}

/// Writes one frame and the end of its line.
///
/// # Errors
/// When `out` fails.
pub fn write(out: &mut impl Write, record: &Record<'_>, decoded: &Decoded) -> io::Result<()> {
    let raw = record.frame.to_string();
    let id = raw.split('#').next().unwrap_or_default().to_owned();
    let mut line = Line {
        time_ns: record.time.nanos,
        bus: record.interface,
        id,
        raw,
        direction: record.direction.map(|direction| match direction {
            Direction::Sent => "T",
            Direction::Received => "R",
        }),
        verdict: decoded.verdict(),
        error: None,
        kind: None,
        node: None,
        epoch: None,
        tag: None,
        values: None,
        saturated: None,
        crc: None,
        crc_expected: None,
    };
    match *decoded {
        Decoded::Foreign(foreign) => {
            if let Foreign::Data(fault) = foreign {
                line.fails(fault);
            }
            line.error = Some(foreign.to_string());
        }
        Decoded::Wire(lane, message) => {
            line.kind = Some("wire");
            line.crc = Some(word(last_word(record)));
            line.say_over(lane, message);
        }
        Decoded::Half { id } => line.about(id),
        Decoded::Damaged { id, fault } => {
            line.about(id);
            line.fails(fault);
            line.error = Some(fault.to_string());
        }
        Decoded::Meaningless { packet, error } => {
            line.about(packet.id);
            line.error = Some(error.to_string());
            line.crc = Some(word(last_word(record)));
        }
        Decoded::Message(message) => {
            line.about(message.encode().id);
            line.crc = Some(word(last_word(record)));
            line.saturated = matches!(message, Message::Torque { .. } | Message::Sum { .. })
                .then(|| decoded.is_saturated());
            line.say(&message);
        }
    }
    serde_json::to_writer(&mut *out, &line)?;
    out.write_all(b"\n")
}

/// The CRC of a packet: the last two bytes of its only frame, or of its second one.
fn last_word(record: &Record<'_>) -> u16 {
    let end = match record.frame.format() {
        Format::Fd => BYTES,
        Format::Classic => BYTES / 2,
    };
    match record.frame.data().get(end - 2..end) {
        Some(&[low, high]) => u16::from_le_bytes([low, high]),
        Some(_) | None => 0,
    }
}

fn word(word: u16) -> String {
    format!("{word:04X}")
}

impl Line<'_> {
    /// Who speaks, and of what.
    fn about(&mut self, id: Id) {
        self.kind = Some(id.name());
        self.node = Some(if id.kind == Kind::Command { 0 } else { id.node });
    }

    /// The CRC that would have made a packet of it.
    fn fails(&mut self, fault: Fault) {
        if let Fault::Crc { expected, got } = fault {
            (self.crc, self.crc_expected) = (Some(word(got)), Some(word(expected)));
        }
    }

    fn say_over(&mut self, Lane { wire, back }: Lane, message: PortMessage) {
        let mut says = Says { says: wires::name(message), ..Says::default() };
        let label = match message {
            PortMessage::Hello(Hello { version, number, port, hears, up, unnumbered, label }) => {
                says.hello = Some(Greeting { version, number, port, hears, up, unnumbered });
                label
            }
            PortMessage::Grant(label) => Some(label),
            PortMessage::State(epoch) | PortMessage::Missed(epoch) => {
                self.epoch = Some(epoch.0);
                None
            }
            PortMessage::Seek(round) => {
                says.round = Some(round);
                None
            }
            PortMessage::Number(Walk { walk, first, last })
            | PortMessage::Return(Walk { walk, first, last }) => {
                (says.walk, says.first, says.last) = (Some(walk), Some(first), Some(last));
                None
            }
            PortMessage::Join
            | PortMessage::Refuse
            | PortMessage::Leave
            | PortMessage::Left
            | PortMessage::Ask => None,
        };
        if let Some(Label { round, depth }) = label {
            (says.round, says.depth) = (Some(round), Some(depth));
        }
        self.values = Some(Values::Wire { wire, back, says });
    }

    fn say(&mut self, message: &Message) {
        let values = match *message {
            Message::Halt | Message::Sync | Message::Resume | Message::Report => return,
            Message::Joints { epoch, joints } => {
                self.epoch = Some(epoch.0);
                let positions = joints.positions.iter().take(usize::from(joints.in_use));
                Values::Joints { position_rad: positions.map(|word| word.to_radians()).collect() }
            }
            Message::Sum { from: _, epoch, torque, count } => {
                self.epoch = Some(epoch.0);
                Values::Sum { torque_nm: torque.map(Q::to_f64), cells: count }
            }
            Message::Torque { from: _, epoch, torque } => {
                self.epoch = Some(epoch.0);
                Values::Torque { torque_nm: torque.map(Q::to_f64) }
            }
            Message::Sensors { from: _, epoch, page } => {
                self.epoch = Some(epoch.0);
                Values::Felt(felt(page))
            }
            Message::Network { from: _, epoch, page } => {
                self.epoch = Some(epoch.0);
                network(page)
            }
            Message::Configure { to: _, tag, request } => {
                self.tag = Some(tag);
                match request {
                    Request::Read { number } => {
                        Values::Read { parameter: Name(number).to_string(), write: false }
                    }
                    Request::Write { number, words } => Values::Write {
                        parameter: Name(number).to_string(),
                        write: true,
                        value: value(number, words),
                    },
                }
            }
            Message::Configured { from: _, tag, answer } => {
                self.tag = Some(tag);
                match answer {
                    Answer::Value { number, written, words } => Values::Has {
                        parameter: Name(number).to_string(),
                        written,
                        value: value(number, words),
                    },
                    Answer::Refused { number, reason: code } => Values::Refusal {
                        parameter: Name(number).to_string(),
                        refusal: code,
                        because: reason(code),
                    },
                }
            }
            Message::Stimulus { to: _, from, page } => {
                if let From::Epoch(epoch) = from {
                    self.epoch = Some(epoch.0);
                }
                Values::Stimulus { from_next: from == From::Next, felt: felt(page) }
            }
        };
        self.values = Some(values);
    }
}

fn felt(page: SensorPage) -> Felt {
    match page {
        SensorPage::Skin(skin) => {
            let contact_n = skin.contact.map(Q::to_f64);
            Felt::Skin {
                page: "skin",
                force_n: contact_n.iter().sum(),
                contact_n,
                proximity: skin.proximity.to_f64(),
                temperature_c: skin.temperature.map(Q::to_f64),
            }
        }
        SensorPage::Acceleration(xyz) => {
            Felt::Acceleration { page: "acceleration", acceleration_g: xyz.map(Q::to_f64) }
        }
    }
}

fn network(page: NetworkPage) -> Values {
    match page {
        NetworkPage::Heartbeat(Heartbeat { serial, configuration, sent, rejected, state }) => {
            Values::Heartbeat {
                page: "heartbeat",
                serial,
                configuration: word(configuration),
                sent,
                refused: rejected,
                state: flags(state),
            }
        }
        NetworkPage::Heard(Heard {
            joints,
            joints_late,
            joints_repeated,
            stimuli,
            stimuli_late,
            torques,
        }) => {
            let (joints_skipped, page) = (joints_late, "heard");
            Values::Heard { page, joints, joints_skipped, joints_repeated, stimuli, stimuli_late, torques }
        }
        NetworkPage::Refused(Refused { length, crc, foreign, meaning, incomplete, stimuli }) => {
            Values::Refused { page: "refused", length, crc, foreign, meaning, incomplete, stimuli }
        }
        NetworkPage::Tree(Tree { parent, up, depth, round, children, works, sent, taken, dropped }) => {
            let ports = |bits| wires::Bits(bits).ports().collect();
            let (up, depth) = (parent.map(|_| up), parent.map(|_| depth));
            let (children, works) = (ports(children), ports(works));
            Values::Tree { page: "tree", parent, up, depth, round, children, works, sent, taken, dropped }
        }
        NetworkPage::Ports(Ports { ports, changes }) => {
            let ports = ports.map(|PortState { number: node, port, hears, works, other_version }| End {
                node,
                port,
                hears,
                works,
                other_version,
            });
            Values::Ports { page: "ports", ports, changes }
        }
    }
}

fn flags(state: State) -> Flags {
    let set = State::NAMES.iter().filter(|(bit, _)| state.has(*bit)).map(|(_, name)| *name);
    Flags { state: set.collect(), joint: state.joint(), version: state.version() }
}

fn value(number: u8, words: [i16; WORDS]) -> Value {
    let [a, b, c, d, e, f] = words;
    let meters = |word| Q1_14::from_bits(word).to_f64();
    let radians = |word| Q1_14::from_bits(word).to_radians();
    let newtons = |word| Q5_10::from_bits(word).to_f64();
    match Parameter::from_number(number) {
        Some(Parameter::Identity) => {
            let [low, high, version, hash, state, _] = words.map(i16::cast_unsigned);
            Value::Identity {
                serial: u32::from(low) | u32::from(high) << 16,
                identity_version: version,
                configuration: word(hash),
                state: flags(State(state)),
            }
        }
        Some(Parameter::Mount) => Value::Mount { joint: a, joints: b },
        Some(Parameter::Pose) => {
            Value::Pose { position_m: [a, b, c].map(meters), normal: [d, e, f].map(meters) }
        }
        Some(Parameter::Contact) => Value::Contact {
            alpha_c: Q3_12::from_bits(a).to_f64(),
            alpha_p_n: newtons(b),
            contact_threshold_n: newtons(c),
            proximity_threshold: meters(d),
            force_threshold_n: newtons(e),
        },
        Some(Parameter::Timing) => Value::Timing { period_us: a.cast_unsigned() },
        Some(Parameter::Mode) => Value::Mode { mode: a },
        Some(switch @ (Parameter::Reply | Parameter::Sensing | Parameter::Events | Parameter::Cuts)) => {
            switched(switch, words).unwrap_or(Value::Unknown { words })
        }
        Some(Parameter::Row(_)) => {
            Value::Row { a_m: meters(a), d_m: meters(b), alpha_rad: radians(c), theta_offset_rad: radians(d) }
        }
        Some(Parameter::Commit) => Value::Commit { hash: word(a.cast_unsigned()) },
        None => Value::Unknown { words },
    }
}

/// The words of a switch, if they can be.
fn switched(parameter: Parameter, words: [i16; WORDS]) -> Option<Value> {
    match parameter {
        Parameter::Reply => Some(match Reply::from_words(words)? {
            Reply::Torque => Value::Reply { reply: "torque", slots: None },
            Reply::Sum(Slots { slot_us, deepest, carry }) => {
                Value::Reply { reply: "sum", slots: Some(SlotsValue { slot_us, deepest, carry }) }
            }
        }),
        Parameter::Sensing => Some(match Sensing::from_words(words)? {
            Sensing::Off => Value::Sensing { sensing: "off", period_ms: None },
            Sensing::Continuous { period_ms } => {
                Value::Sensing { sensing: "continuous", period_ms: Some(period_ms) }
            }
            Sensing::Event => Value::Sensing { sensing: "event", period_ms: None },
        }),
        Parameter::Events => {
            let Events { contact, proximity, temperature, acceleration, hysteresis } =
                Events::from_words(words)?;
            Some(Value::Events {
                contact_n: contact.to_f64(),
                proximity: proximity.to_f64(),
                temperature_c: temperature.to_f64(),
                acceleration_g: acceleration.to_f64(),
                hysteresis: hysteresis.to_f64(),
            })
        }
        Parameter::Cuts => {
            Some(Value::Cuts { deaf_ports: wires::Bits(Cuts::from_words(words).deaf).ports().collect() })
        }
        Parameter::Identity
        | Parameter::Mount
        | Parameter::Pose
        | Parameter::Contact
        | Parameter::Timing
        | Parameter::Mode
        | Parameter::Row(_)
        | Parameter::Commit => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::Decoder;
    use protocol::candump::{self, Line};
    use protocol::time::Micros;
    use serde_json::{Value, json};

    const FD: &str = include_str!("../../../../protocol/tests/golden/fd.log");
    const CLASSIC: &str = include_str!("../../../../protocol/tests/golden/classic.log");
    const BAD: &str = include_str!("../../../../protocol/tests/golden/bad.log");
    const WIRE: &str = include_str!("../../../../protocol/tests/golden/wire.log");

    /// Each frame's comment in the log, and its object.
    fn objects(log: &str) -> Vec<(String, Value)> {
        let mut decoder = Decoder::new(None);
        let (mut comment, mut all) = ("", Vec::new());
        for line in log.lines() {
            match candump::parse(line).unwrap() {
                Line::Frame(record) => {
                    let at = Micros(record.time.nanos / 1_000);
                    let decoded = decoder.decode(at, record.interface, &record.frame);
                    let mut text = Vec::new();
                    write(&mut text, &record, &decoded).unwrap();
                    assert_eq!(text.iter().filter(|&&byte| byte == b'\n').count(), 1);
                    all.push((comment.to_owned(), serde_json::from_slice(&text).unwrap()));
                }
                Line::Dropped { .. } | Line::CanXl | Line::Other => comment = line.trim_start_matches("# "),
            }
        }
        all
    }

    fn object(log: &str, comment: &str) -> Value {
        let found: Vec<_> = objects(log).into_iter().filter(|(of, _)| of.starts_with(comment)).collect();
        assert_eq!(found.len(), 1, "{comment}");
        found[0].1.clone()
    }

    #[test]
    fn a_packet_is_an_object_with_units_in_its_keys() {
        let torque = object(FD, "torque from=254 epoch=255 torque=7.999755859375,-8,");
        let expected = json!({
            "time_ns": torque["time_ns"], "bus": "vcan0", "id": "2FE", "raw": torque["raw"], "verdict": "ok",
            "kind": "torque", "node": 254, "epoch": 255, "saturated": true, "crc": torque["crc"],
            "values": { "torque_nm": [7.999755859375, -8.0, 7.99951171875, -7.999755859375, 0.0, -0.000244140625] },
        });
        assert_eq!(torque, expected);
        let raw = torque["raw"].as_str().unwrap();
        let (last, crc) = (&raw[raw.len() - 4..], torque["crc"].as_str().unwrap());
        assert_eq!(
            format!("{}{}", &last[2..], &last[..2]),
            crc,
            "the last two bytes, least significant first"
        );
    }

    #[test]
    fn every_kind_has_its_values() {
        let values = |comment| object(FD, comment)["values"].clone();
        let heartbeat = values("heartbeat from=12 epoch=7 serial=100001 configuration=BEEF sent=4711");
        let expected = json!({
            "page": "heartbeat", "serial": 100_001, "configuration": "BEEF", "sent": 4711, "refused": 3,
            "state": ["configured", "active"], "joint": 2, "version": 1,
        });
        assert_eq!(heartbeat, expected);
        let felt = json!({
            "page": "skin", "force_n": 1.998046875, "contact_n": [1.0, 0.9990234375, -0.0009765625],
            "proximity": 1.0, "temperature_c": [25.0, -40.0],
        });
        assert_eq!(values("sensors from=12 epoch=9 contact=1,0.9990234375"), felt);
        let from_next = values("stimulus to=everyone from=next acceleration=0,0,-8");
        let expected =
            json!({ "from_next": true, "page": "acceleration", "acceleration_g": [0.0, 0.0, -8.0] });
        assert_eq!(from_next, expected);
        let sum = values("sum from=1 epoch=0 count=1 torque=1,-1,0.00390625");
        assert_eq!(sum, json!({ "torque_nm": [1.0, -1.0, 0.00390625, -0.00390625, 0.0, 0.5], "cells": 1 }));
        let joints = values("joints epoch=1 in_use=1 positions=0.5,0,0,0,0,0");
        assert_eq!(joints, json!({ "position_rad": [core::f64::consts::FRAC_PI_4] }));
        let heard = values("heard from=12 epoch=7 joints=1000 joints_late=2");
        let expected = json!({
            "page": "heard", "joints": 1000, "joints_skipped": 2, "joints_repeated": 3, "stimuli": 40,
            "stimuli_late": 5, "torques": 600,
        });
        assert_eq!(heard, expected);
        let refusal = values("refusal from=12 tag=200 parameter=1 reason=3");
        let because = "joint k is not 1 to the robot's joints";
        assert_eq!(refusal, json!({ "parameter": "mount", "refusal": 3, "because": because }));
        let write = values("write to=254 tag=0 parameter=99 words=1,-1,32767,-32768,0,256");
        let words = [1, -1, 32_767, -32_768, 0, 256];
        assert_eq!(write, json!({ "parameter": "parameter 99", "write": true, "words": words }));
    }

    #[test]
    fn the_tree_the_ports_and_the_switches_have_theirs() {
        let values = |comment| object(FD, comment)["values"].clone();
        let expected = json!({
            "page": "tree", "parent": 3, "up": 1, "depth": 4, "round": 2, "children": [0, 2], "works": [0, 1, 2],
            "sent": 1000, "taken": 200, "dropped": 3,
        });
        assert_eq!(values("tree from=12 epoch=7 parent=3"), expected);
        let alone = values("tree from=9 epoch=200 parent=none");
        assert_eq!(
            (&alone["parent"], &alone["up"], &alone["depth"]),
            (&Value::Null, &Value::Null, &Value::Null)
        );
        let ports = values("ports from=12 epoch=7");
        let third = json!({ "node": 254, "port": 3, "hears": true, "works": false, "other_version": false });
        assert_eq!((&ports["ports"][2], &ports["changes"]), (&third, &json!(2)));
        let reply = values("write to=everyone tag=20 parameter=6 reply=sum");
        let sum = json!({
            "parameter": "reply", "write": true, "reply": "sum", "slot_us": 1500, "deepest": 6, "carry": true,
        });
        assert_eq!(reply, sum);
        let sensing = values("write to=12 tag=26 parameter=7 sensing=off");
        assert_eq!(sensing, json!({ "parameter": "sensing", "write": true, "sensing": "off" }));
        assert_eq!(values("write to=12 tag=28 parameter=8")["hysteresis"], json!(1.0));
        let cuts = json!({ "parameter": "cuts", "write": true, "deaf_ports": [0, 2] });
        assert_eq!(values("write to=12 tag=29 parameter=9"), cuts);
    }

    #[test]
    fn wires_have_their_number_and_what_is_said_over_them() {
        let hello = object(WIRE, "hello wire=12 back=0 version=1 number=7 port=2 flags=hears+up label=3/1");
        assert_eq!((&hello["kind"], &hello["verdict"]), (&json!("wire"), &json!("ok")));
        assert_eq!((hello.get("node"), hello.get("epoch")), (None, None));
        let expected = json!({
            "wire": 12, "back": false, "says": "hello", "version": 1, "number": 7, "port": 2, "hears": true,
            "up": true, "unnumbered": false, "round": 3, "depth": 1,
        });
        assert_eq!(hello["values"], expected);
        let missed = object(WIRE, "missed wire=12 back=1 epoch=9");
        assert_eq!(missed["epoch"], json!(9));
        assert_eq!(missed["values"], json!({ "wire": 12, "back": true, "says": "missed" }));
    }

    #[test]
    fn what_is_no_packet_says_why() {
        let wrong = object(BAD, "bad crc expected=9C2A got=E74B");
        assert_eq!((&wrong["verdict"], wrong.get("kind")), (&json!("foreign"), None));
        assert_eq!((&wrong["crc"], &wrong["crc_expected"]), (&json!("E74B"), &json!("9C2A")));
        assert_eq!(wrong["error"], json!("no packet: CRC E74B, not 9C2A"));
        let frame = candump::parse_frame("20C##10011").unwrap();
        let time = candump::Timestamp { nanos: 0, nine_digits: false };
        let record = Record { time, interface: "can0", frame, direction: None };
        let id = protocol::packet::data_id(&frame).unwrap();
        let mut line = Vec::new();
        write(&mut line, &record, &Decoded::Damaged { id, fault: Fault::Crc { expected: 1, got: 2 } })
            .unwrap();
        let damaged: Value = serde_json::from_slice(&line).unwrap();
        assert_eq!((&damaged["verdict"], &damaged["kind"]), (&json!("CRC"), &json!("torque")));
        assert_eq!((&damaged["node"], &damaged["crc_expected"]), (&json!(12), &json!("0001")));
        let foreign = objects(BAD).into_iter().find(|(comment, _)| comment == "bad foreign").unwrap().1;
        assert_eq!((foreign.get("node"), &foreign["error"]), (None, &json!("29-bit identifier")));
    }

    #[test]
    fn two_classic_frames_say_it_at_the_second() {
        let whole = objects(CLASSIC).into_iter().find(|(_, object)| object["verdict"] == "ok").unwrap().1;
        let raw = whole["raw"].as_str().unwrap();
        let crc = whole["crc"].as_str().unwrap();
        assert!(raw.ends_with(&format!("{}{}", &crc[2..], &crc[..2])), "{whole}");
    }
}
