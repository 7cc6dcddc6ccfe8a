//! Frames as JSON: one object per frame; keys end with the unit of their value.

use std::io::{self, Write};

use protocol::candump::{Direction, Record};
use protocol::id::{Id, Kind};
use protocol::message::{Message, State};
use protocol::packet::{Bytes, PacketError};
use protocol::port::LinkId;
use protocol::schema::{self, AbsentFieldJson, BusUnits, Field, FieldFormat, Layout, PacketSchema};
use serde::ser::{Error, Serialize, SerializeMap, Serializer};

use super::fields::ParameterName;
use super::ports::PortSet;
use super::{Decoded, ForeignReason, wires};

/// The JSON object of a frame.
#[derive(serde::Serialize)]
struct FrameObject<'a> {
    time_ns: u64,
    bus: &'a str,
    /// The identifier, as candump prints it.
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
    values: Option<PacketValues>,
    #[serde(skip_serializing_if = "Option::is_none")]
    saturated: Option<bool>,
    /// The CRC in the packet.
    #[serde(skip_serializing_if = "Option::is_none")]
    crc: Option<String>,
    /// The CRC computed from the packet's bytes, if it differs.
    #[serde(skip_serializing_if = "Option::is_none")]
    crc_expected: Option<String>,
}

/// The values of a packet's words, with keys that depend on the packet kind and page.
struct PacketValues {
    link_id: Option<LinkId>,
    end: &'static [Field],
    layout: &'static Layout,
    bytes: Bytes,
    units: BusUnits,
}

impl Serialize for PacketValues {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        let Self { link_id, end, layout, bytes, units } = self;
        if let Some(LinkId { wire, back }) = link_id {
            map.serialize_entry("wire", wire)?;
            map.serialize_entry("back", back)?;
            map.serialize_entry("says", &layout.name)?;
        }
        serialize_fields(&mut map, end, &layout.name, bytes, *units)?;
        serialize_fields(&mut map, &layout.fields, &layout.name, bytes, *units)?;
        map.end()
    }
}

/// The fields that share one word, as one JSON object.
struct FieldGroup<'a>(&'a [Field], &'a [u8]);

impl Serialize for FieldGroup<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        serialize_fields(&mut map, self.0, "", self.1, BusUnits::default())?;
        map.end()
    }
}

/// Serialises each field that the packet contains. Epoch and tag are omitted, because they are keys of the frame.
fn serialize_fields<M: SerializeMap>(
    map: &mut M,
    fields: &[Field],
    page: &str,
    bytes: &[u8],
    units: BusUnits,
) -> Result<(), M::Error> {
    let Some(first) = fields.first() else { return Ok(()) };
    for field in fields.iter().filter(|field| !matches!(field.name.as_str(), "" | "epoch" | "tag")) {
        let raw = field.raw_value(bytes, 0);
        if !field.is_present(bytes, first) {
            if field.absent == AbsentFieldJson::Null {
                map.serialize_entry(&field.name, &())?;
            }
        } else if let FieldFormat::Page(_) = field.format {
            map.serialize_entry(&field.name, page)?;
        } else if field.format == FieldFormat::State {
            let state = State(u16::try_from(raw).map_err(M::Error::custom)?);
            map.serialize_entry("state", &state.flag_names().collect::<Vec<_>>())?;
            map.serialize_entry("joint", &state.joint())?;
            map.serialize_entry("version", &state.version())?;
        } else {
            map.serialize_entry(&field.name, &FieldValue(field, bytes, units))?;
            if field.format == FieldFormat::Reason {
                map.serialize_entry("because", schema::refusal_reason(raw))?;
            }
        }
    }
    Ok(())
}

/// The value of a field for JSON, or an array of values if the field has several elements.
struct FieldValue<'a>(&'a Field, &'a [u8], BusUnits);

impl Serialize for FieldValue<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self(field, bytes, units) = *self;
        let (first, elements) = (field.raw_value(bytes, 0), 0..field.element_count_in(bytes));
        let real = |element| field.element_value(field.raw_value(bytes, element), element, units);
        match &field.format {
            FieldFormat::Choice => serializer.serialize_str(field.value_name(first).unwrap_or_default()),
            FieldFormat::Flag(_) => serializer.serialize_bool(first == 1),
            FieldFormat::Hex => serializer.collect_str(&format_args!("{first:04X}")),
            FieldFormat::Parameter(_) => serializer.collect_str(&ParameterName::from_raw(first)),
            FieldFormat::Ports(..) => serializer.collect_seq(PortSet(first).ports()),
            FieldFormat::Total(_) => serializer.serialize_f64(field.sum_of_words(bytes)),
            FieldFormat::Group(parts) => {
                let of = |element: usize| FieldGroup(parts, bytes.get(element * 2..).unwrap_or_default());
                serializer.collect_seq(elements.map(of))
            }
            FieldFormat::Fixed(_)
            | FieldFormat::Threshold(_)
            | FieldFormat::Saturating(_)
            | FieldFormat::Torque
            | FieldFormat::Angle
            | FieldFormat::Position => {
                if field.labels.is_empty() {
                    serializer.serialize_f64(real(0))
                } else {
                    serializer.collect_seq(elements.map(real))
                }
            }
            FieldFormat::Word
            | FieldFormat::Unsigned(_)
            | FieldFormat::Signed
            | FieldFormat::Port
            | FieldFormat::Page(_)
            | FieldFormat::State
            | FieldFormat::Reason => {
                if field.labels.is_empty() {
                    serializer.serialize_i64(first)
                } else {
                    serializer.collect_seq(elements.map(|element| field.raw_value(bytes, element)))
                }
            }
        }
    }
}

/// Writes one frame as a JSON line, with values in the units of its bus.
///
/// # Errors
/// Returns the error of `out`.
pub fn write_json_line(
    out: &mut impl Write,
    record: &Record<'_>,
    decoded: &Decoded,
    units: BusUnits,
) -> io::Result<()> {
    let raw = record.frame.to_string();
    let id = raw.split('#').next().unwrap_or_default().to_owned();
    let mut line = FrameObject {
        time_ns: record.time.nanos,
        bus: record.interface,
        id,
        raw,
        direction: record.direction.map(|direction| match direction {
            Direction::Sent => "T",
            Direction::Received => "R",
        }),
        verdict: decoded.verdict_word(),
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
            if let ForeignReason::Data(fault) = foreign {
                line.set_crc_error(fault);
            }
            line.error = Some(foreign.to_string());
        }
        Decoded::Wire(link_id, message) => {
            line.kind = Some("wire");
            line.crc = Some(hex_word(packet_crc(record)));
            let (bytes, layout) = wires::encode_with_layout(message);
            line.epoch = wires::message_epoch(message);
            line.values = Some(PacketValues { link_id: Some(link_id), end: &[], layout, bytes, units });
        }
        Decoded::Segment { id } => line.set_kind_and_node(id),
        Decoded::Damaged { id, fault } => {
            line.set_kind_and_node(id);
            line.set_crc_error(fault);
            line.error = Some(fault.to_string());
        }
        Decoded::Meaningless { packet, error } => {
            line.set_kind_and_node(packet.id);
            line.error = Some(error.to_string());
            line.crc = Some(hex_word(packet_crc(record)));
        }
        Decoded::Message(message) => {
            line.set_kind_and_node(message.id());
            line.crc = Some(hex_word(packet_crc(record)));
            line.saturated = message.is_saturated();
            line.set_message(&message, units);
        }
    }
    serde_json::to_writer(&mut *out, &line)?;
    out.write_all(b"\n")
}

/// Returns the CRC of a packet, from the last two bytes of the frame that ends it.
fn packet_crc(record: &Record<'_>) -> u16 {
    record.frame.data().last_chunk().map_or(0, |last| u16::from_le_bytes(*last))
}

fn hex_word(word: u16) -> String {
    format!("{word:04X}")
}

impl FrameObject<'_> {
    /// Sets the keys for the packet kind and the node, from the identifier.
    fn set_kind_and_node(&mut self, id: Id) {
        self.kind = Some(id.name());
        self.node = Some(if id.kind == Kind::Command { 0 } else { id.node });
    }

    /// Sets the keys for the received and the expected CRC, if the packet's fault is a wrong CRC.
    fn set_crc_error(&mut self, fault: PacketError) {
        if let PacketError::Crc { expected, got } = fault {
            (self.crc, self.crc_expected) = (Some(hex_word(got)), Some(hex_word(expected)));
        }
    }

    fn set_message(&mut self, message: &Message, units: BusUnits) {
        (self.epoch, self.tag) = (message.epoch().map(|epoch| epoch.0), message.configuration_tag());
        let packet = message.encode();
        let layout = schema::layout(message, &packet);
        let end = PacketSchema::for_id(packet.id).map_or(&[][..], |schema| schema.trailing_fields(layout));
        let is_bare = end.is_empty() && layout.fields.is_empty();
        self.values = (!is_bare).then(|| PacketValues {
            link_id: None,
            end,
            layout,
            bytes: packet.field_bytes(),
            units,
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::Decoder;
    use protocol::candump::{self, CandumpLine};
    use protocol::time::Micros;
    use serde_json::{Value, json};

    const FD: &str = include_str!("../../../../protocol/tests/golden/fd.log");
    const CLASSIC: &str = include_str!("../../../../protocol/tests/golden/classic.log");
    const BAD: &str = include_str!("../../../../protocol/tests/golden/bad.log");
    const WIRE: &str = include_str!("../../../../protocol/tests/golden/wire.log");

    /// Returns each frame's comment in the log with its JSON object.
    fn objects(log: &str) -> Vec<(String, Value)> {
        let mut decoder = Decoder::new(None);
        let (mut comment, mut all) = ("", Vec::new());
        for line in log.lines() {
            match candump::parse(line).unwrap() {
                CandumpLine::Frame(record) => {
                    let at = Micros(record.time.nanos / 1_000);
                    let decoded = decoder.decode(at, record.interface, &record.frame);
                    let mut text = Vec::new();
                    write_json_line(&mut text, &record, &decoded, BusUnits::default()).unwrap();
                    assert_eq!(text.iter().filter(|&&byte| byte == b'\n').count(), 1);
                    all.push((comment.to_owned(), serde_json::from_slice(&text).unwrap()));
                }
                CandumpLine::Dropped { .. } | CandumpLine::CanXl | CandumpLine::Other => {
                    comment = line.trim_start_matches("# ")
                }
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
        assert_eq!(format!("{}{}", &last[2..], &last[..2]), crc, "little-endian");
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
        let contact_state = json!({
            "page": "skin", "force_n": 1.998046875, "contact_n": [1.0, 0.9990234375, -0.0009765625],
            "proximity": 1.0, "temperature_c": [25.0, -40.0],
        });
        assert_eq!(values("sensors from=12 epoch=9 contact=1,0.9990234375"), contact_state);
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
        let because = "joint k is not 1 to the chain's joints";
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
        let states = [
            (3, 2, true, true, false),
            (0, 0, false, false, false),
            (254, 3, true, false, false),
            (7, 0, true, false, true),
        ];
        let states = states.map(|(node, port, hears, works, other_version)| {
            json!({ "node": node, "port": port, "hears": hears, "works": works, "other_version": other_version })
        });
        assert_eq!((&ports["ports"], &ports["changes"]), (&json!(states), &json!(2)));
        let reply = values("write to=everyone tag=20 parameter=6 reply=sum");
        let sum = json!({
            "parameter": "reply", "write": true, "reply": "sum", "slot_us": 1500, "deepest": 6, "carry": true,
        });
        assert_eq!(reply, sum);
        let sensing = values("write to=12 tag=26 parameter=7 sensing=off");
        assert_eq!(sensing, json!({ "parameter": "sensing", "write": true, "sensing": "off" }));
        assert_eq!(values("write to=12 tag=28 parameter=8")["hysteresis"], json!(1.0));
        let links_down = json!({ "parameter": "links_down", "write": true, "deaf_ports": [0, 2] });
        assert_eq!(values("write to=12 tag=29 parameter=9"), links_down);
    }

    #[test]
    fn a_message_over_a_wire_has_the_number_of_the_wire() {
        let hello = object(WIRE, "hello wire=12 back=0 version=1 node_id=7 port=2 flags=hears+up label=3/1");
        assert_eq!((&hello["kind"], &hello["verdict"]), (&json!("wire"), &json!("ok")));
        assert_eq!((hello.get("node"), hello.get("epoch")), (None, None));
        let expected = json!({
            "wire": 12, "back": false, "says": "hello", "version": 1, "node_id": 7, "port": 2, "hears": true,
            "up": true, "unnumbered": false, "round": 3, "depth": 1,
        });
        assert_eq!(hello["values"], expected);
        let nack = object(WIRE, "nack wire=12 back=1 epoch=9");
        assert_eq!(nack["epoch"], json!(9));
        assert_eq!(nack["values"], json!({ "wire": 12, "back": true, "says": "nack" }));
    }

    #[test]
    fn a_frame_that_is_no_packet_has_an_error() {
        let wrong = object(BAD, "bad crc expected=9C2A got=E74B");
        assert_eq!((&wrong["verdict"], wrong.get("kind")), (&json!("foreign"), None));
        assert_eq!((&wrong["crc"], &wrong["crc_expected"]), (&json!("E74B"), &json!("9C2A")));
        assert_eq!(wrong["error"], json!("no packet: CRC E74B, not 9C2A"));
        let frame = candump::parse_frame("20C##10011").unwrap();
        let time = candump::Timestamp::with_six_digits(0);
        let record = Record { time, interface: "can0", frame, direction: None };
        let id = protocol::packet::data_frame_id(&frame).unwrap();
        let mut line = Vec::new();
        write_json_line(
            &mut line,
            &record,
            &Decoded::Damaged { id, fault: PacketError::Crc { expected: 1, got: 2 } },
            BusUnits::default(),
        )
        .unwrap();
        let damaged: Value = serde_json::from_slice(&line).unwrap();
        assert_eq!((&damaged["verdict"], &damaged["kind"]), (&json!("CRC"), &json!("torque")));
        assert_eq!((&damaged["node"], &damaged["crc_expected"]), (&json!(12), &json!("0001")));
        let foreign = objects(BAD).into_iter().find(|(comment, _)| comment == "bad foreign").unwrap().1;
        assert_eq!((foreign.get("node"), &foreign["error"]), (None, &json!("29-bit identifier")));
    }

    #[test]
    fn the_second_classic_frame_has_the_values() {
        let whole = objects(CLASSIC).into_iter().find(|(_, object)| object["verdict"] == "ok").unwrap().1;
        let raw = whole["raw"].as_str().unwrap();
        let crc = whole["crc"].as_str().unwrap();
        assert!(raw.ends_with(&format!("{}{}", &crc[2..], &crc[..2])), "{whole}");
    }
}
