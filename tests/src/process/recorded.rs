//! A recording, decoded by its own definitions and without the code that wrote it.
#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "each test file uses its part of it, and a test may stop"
)]

use std::collections::BTreeMap;
use std::path::Path;

use mcap::read::{Summary, attachment, metadata};
use mcap::{MessageStream, Schema};
use model::generate::{SkinRequest, generate};
use protocol::candump::{CandumpLine, parse};
use serde_json::{Map, Value, json};

use crate::process::vcan::{Candump, same_by_sender};
use crate::process::{PRESSED, TestDir};

/// A message of a recording.
pub struct Message {
    pub topic: String,
    /// The time in the message's header, in ns.
    pub nanos: u64,
    /// The time that the file gives for the message, in ns.
    pub log_nanos: u64,
    pub value: Value,
}

/// All messages of a recording.
pub struct Recorded {
    pub messages: Vec<Message>,
    pub attachments: BTreeMap<String, Vec<u8>>,
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
}

impl Recorded {
    /// Reads a complete MCAP file, and panics if it is not valid.
    pub fn read(path: &Path) -> Self {
        let name = path.display();
        let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{name}: {error}"));
        let summary = Summary::read(&bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        let summary = summary.unwrap_or_else(|| panic!("{name} has no end"));
        let mut types = BTreeMap::new();
        for schema in summary.schemas.values() {
            assert_eq!(schema.encoding, "ros2msg");
            types.insert(schema.name.clone(), Types::from_schema(schema));
        }
        let messages = MessageStream::new(&bytes).unwrap().map(|message| {
            let message = message.unwrap();
            let schema = message.channel.schema.as_ref().unwrap();
            assert_eq!(message.channel.message_encoding, "cdr");
            assert!(message.channel.metadata.contains_key("offered_qos_profiles"));
            let value = types[&schema.name].decode(&message.data);
            let topic = message.channel.topic.clone();
            let header =
                if topic.starts_with("/tf") { &value["transforms"][0]["header"] } else { &value["header"] };
            let stamp = |stamp: &Value| {
                stamp["sec"].as_u64().unwrap() * 1_000_000_000 + stamp["nanosec"].as_u64().unwrap()
            };
            // A text has no header.
            let stamp = header.get("stamp").map_or(message.publish_time, stamp);
            assert_eq!(stamp, message.publish_time, "{topic}");
            Message { topic, nanos: stamp, log_nanos: message.log_time, value }
        });
        let messages: Vec<_> = messages.collect();
        assert!(messages.is_sorted_by_key(|message| message.log_nanos), "{name}: in order of log_time");
        let counted: u64 = summary.stats.as_ref().unwrap().message_count;
        assert_eq!(messages.len() as u64, counted, "{name}");
        let attachments = summary.attachment_indexes.iter().map(|index| {
            let attached = attachment(&bytes, index).unwrap();
            (attached.name.clone(), attached.data.into_owned())
        });
        let metadata = summary.metadata_indexes.iter().map(|index| {
            let record = metadata(&bytes, index).unwrap();
            (record.name, record.metadata)
        });
        Self { messages, attachments: attachments.collect(), metadata: metadata.collect() }
    }

    /// Returns the messages of a topic.
    pub fn on<'a>(&'a self, topic: &'a str) -> impl Iterator<Item = &'a Message> {
        self.messages.iter().filter(move |message| message.topic == topic)
    }

    /// Returns the frames of a bus in candump's notation, with 6 digits.
    pub fn lines(&self, topic: &str) -> Vec<String> {
        self.on(topic).map(line).collect()
    }
}

/// Formats a frame as a line of candump, from the fields of its message only.
fn line(message: &Message) -> String {
    let frame = &message.value;
    let (seconds, micros) = (message.nanos / 1_000_000_000, message.nanos % 1_000_000_000 / 1_000);
    let bus = frame["header"]["frame_id"].as_str().unwrap();
    let id = frame["id"].as_u64().unwrap();
    let id = if frame["is_error"] == true {
        format!("{:08X}", id | 0x2000_0000)
    } else if frame["is_extended"] == true {
        format!("{id:08X}")
    } else {
        format!("{id:03X}")
    };
    let data: Vec<_> = frame["data"].as_array().unwrap().iter().map(|byte| byte.as_u64().unwrap()).collect();
    let data: String = data.iter().map(|byte| format!("{byte:02X}")).collect();
    let body = match (frame["is_fd"] == true, frame["is_rtr"] == true, frame["length"].as_u64().unwrap()) {
        (true, _, _) => format!("#{:X}{data}", frame["flags"].as_u64().unwrap()),
        (false, true, 0) => "R".to_owned(),
        (false, true, length) => format!("R{length}"),
        (false, false, _) => data,
    };
    format!("({seconds}.{micros:06}) {bus} {id}#{body}")
}

/// Decodes a message by the definition of its type.
pub fn decode(definition: &str, message: &[u8]) -> Value {
    Types::from_definition(definition).decode(message)
}

/// The types of a schema, by name; the main one has an empty name.
struct Types(BTreeMap<String, Vec<(String, String)>>);

impl Types {
    fn from_schema(schema: &Schema<'_>) -> Self {
        Self::from_definition(str::from_utf8(&schema.data).unwrap())
    }

    fn from_definition(text: &str) -> Self {
        let mut types = BTreeMap::new();
        for part in text.split(&"=".repeat(80)) {
            let part = part.trim_start();
            let (name, fields) = match part.strip_prefix("MSG: ") {
                Some(rest) => rest.split_once('\n').unwrap(),
                None => ("", part),
            };
            let fields = fields.lines().filter_map(|line| {
                let line = line.split('#').next().unwrap().trim();
                let (kind, name) = line.split_once(' ')?;
                (!name.contains('=')).then(|| (kind.to_owned(), name.trim().to_owned()))
            });
            types.insert(name.trim().to_owned(), fields.collect());
        }
        Self(types)
    }

    fn decode(&self, message: &[u8]) -> Value {
        assert_eq!(message[..2], [0, 1], "little-endian CDR");
        let mut from = From { bytes: &message[4..], at: 0 };
        let value = self.object("", &mut from);
        assert_eq!(from.at, from.bytes.len(), "all of {value} is read");
        value
    }

    fn object(&self, name: &str, from: &mut From<'_>) -> Value {
        let fields = self.0.get(name).unwrap_or_else(|| panic!("no type {name}"));
        let value = |(kind, name): &(String, String)| (name.clone(), self.value(kind, from));
        Value::Object(fields.iter().map(value).collect::<Map<_, _>>())
    }

    fn value(&self, kind: &str, from: &mut From<'_>) -> Value {
        if let Some(element) = kind.strip_suffix("[]") {
            let count = u32::from_le_bytes(from.number());
            return (0..count).map(|_| self.value(element, from)).collect();
        }
        match kind {
            "bool" => json!(from.number::<1>()[0] != 0),
            "uint8" | "byte" => json!(from.number::<1>()[0]),
            "uint16" => json!(u16::from_le_bytes(from.number())),
            "int32" => json!(i32::from_le_bytes(from.number())),
            "uint32" => json!(u32::from_le_bytes(from.number())),
            "uint64" => json!(u64::from_le_bytes(from.number())),
            "float32" => json!(f32::from_le_bytes(from.number())),
            "float64" => json!(f64::from_le_bytes(from.number())),
            "string" => {
                let count = u32::from_le_bytes(from.number()) as usize;
                let text = from.take(count).strip_suffix(&[0]).unwrap();
                json!(str::from_utf8(text).unwrap())
            }
            _ => self.object(kind, from),
        }
    }
}

/// The bytes of a message that are still to be decoded.
struct From<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> From<'a> {
    fn number<const N: usize>(&mut self) -> [u8; N] {
        self.at = self.at.next_multiple_of(N);
        self.take(N).try_into().unwrap()
    }

    fn take(&mut self, count: usize) -> &'a [u8] {
        let taken = &self.bytes[self.at..self.at + count];
        self.at += count;
        taken
    }
}

/// Records a bench of pressed cells, and checks that the recording has exactly the frames that candump saw.
pub fn has_what_candump_sees(place: &TestDir, cells: usize, broadcast_hz: f64, more: &str) {
    let expected = SkinRequest { cells, broadcast_hz, ..SkinRequest::default() };
    place.write("skin.toml", &generate(&expected).unwrap());
    place.scenario(PRESSED);
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    place.bench(4.0, &format!("--record run.mcap {more}")).end().succeeded();
    let (theirs, summary) = (candump.frames(), place.summary());
    assert_eq!(
        (summary.of_bus("/dropped_by_bus"), summary.number("/recording/lost")),
        (0, 0),
        "{:#}",
        summary.0
    );
    let recorded = Recorded::read(&place.path("run.mcap"));
    assert!(recorded.on("/can/notes").next().is_none());
    let frame = |line: &String| match parse(line) {
        Ok(CandumpLine::Frame(record)) => record.frame,
        other => panic!("{line}: {other:?}"),
    };
    let ours: Vec<_> = recorded.lines("/can/vcan0").iter().map(frame).collect();
    let counted = summary.total("/buses/0/received") + summary.total("/buses/0/sent");
    assert_eq!(ours.len() as u64, counted, "the recording has what is counted");
    assert!(counted > 4 * cells as u64, "{:#}", summary.0);

    same_by_sender(&ours, &theirs);
}
