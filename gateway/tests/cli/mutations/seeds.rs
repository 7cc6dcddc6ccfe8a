//! Seed recordings: of several writers, with each compression.

use std::collections::BTreeMap;
use std::process::Command;

use mcap::records::MessageHeader;
use mcap::write::{Metadata, NoSeek};
use mcap::{Attachment, Compression, WriteOptions, Writer};
use protocol::can::Format;
use protocol::candump::{Record, Timestamp};
use protocol::fixed::{Q1_14, Q3_12};
use protocol::id::CellId;
use protocol::message::{Joints, Message as Packet};
use protocol::packet::Epoch;
use trace::capture::Reader;
use trace::capture::convert::{CaptureWriter, convert};
use trace::capture::log::LogStyle;
use trace::ros2::cdr::CdrWriter as Cdr;
use trace::ros2::skin::{LoopTiming, Torques};
use trace::ros2::standard::JointState;
use trace::ros2::{Header, Message};

use super::mutate::{chunk, record, string};
use protocol::packet::pad_with_defaults;

const BEGAN: u64 = 1_700_000_000_000_000_000;

/// Description of a small skin.
pub(crate) fn skin() -> String {
    let made = Command::new(env!("CARGO_BIN_EXE_skinbus"))
        .args(["skin", "generate", "--cells", "3"])
        .output()
        .unwrap();
    String::from_utf8(made.stdout).unwrap()
}

/// Recordings of every kind.
pub(crate) fn all(skin: &str) -> Vec<(&'static str, Vec<u8>)> {
    let chunks = |compression| WriteOptions::new().compression(compression).chunk_size(Some(8 << 10));
    let log: String = (0..200)
        .map(|at| format!("({}.{:06}) can{} {:03X}#1122\n# a note\n", at / 9, at * 7, at % 2, at))
        .collect();
    vec![
        ("zstd", run(skin, chunks(Some(Compression::Zstd)), false)),
        ("lz4", run(skin, chunks(Some(Compression::Lz4)), false)),
        ("uncompressed", run(skin, chunks(None), false)),
        ("no chunks", run(skin, WriteOptions::new().use_chunks(false), false)),
        ("attachments last", run(skin, chunks(None), true)),
        ("converted", converted(&log)),
        ("another bridge's", bridge()),
    ]
}

fn converted(log: &str) -> Vec<u8> {
    let mut out = Vec::new();
    let mut from = Reader::from_read("log", std::io::Cursor::new(log.to_owned().into_bytes())).unwrap();
    let mut to =
        CaptureWriter::new(&mut out, trace::capture::CaptureFormat::Mcap, LogStyle::default()).unwrap();
    convert(&mut from, &mut to, |_, _| Ok(())).unwrap();
    to.finish().unwrap();
    drop(to);
    out
}

struct File {
    writer: Writer<NoSeek<Vec<u8>>>,
    channels: BTreeMap<String, u16>,
    sequence: u32,
}

impl File {
    fn put(&mut self, schema: (&str, &str), topic: &str, nanos: u64, data: &[u8]) {
        let channel = self.channels.get(topic).copied().unwrap_or_else(|| {
            let schema = self.writer.add_schema(schema.0, "ros2msg", schema.1.as_bytes()).unwrap();
            let facts = [("time_digits".to_owned(), "9".to_owned())].into();
            let channel = self.writer.add_channel(schema, topic, "cdr", &facts).unwrap();
            self.channels.insert(topic.to_owned(), channel);
            channel
        });
        let (sequence, log_time) = (self.sequence, nanos);
        self.sequence += 1;
        let header = MessageHeader { channel_id: channel, sequence, log_time, publish_time: nanos };
        self.writer.write_to_known_channel(&header, data).unwrap();
    }

    fn message<M: Message>(&mut self, topic: &str, nanos: u64, message: &M) {
        let mut data = Vec::new();
        message.encode_into(&mut data);
        self.put((M::TYPE, M::DEFINITION), topic, nanos, &data);
    }

    fn packet(&mut self, topic: &str, nanos: u64, packet: &Packet) {
        for frame in packet.encode().frames(Format::Fd) {
            let time = Timestamp::with_nine_digits(nanos);
            let record = Record { time, interface: "vcan0", frame, direction: None };
            self.message(topic, nanos, &record);
        }
    }
}

fn begin(options: WriteOptions) -> File {
    let writer = options.profile("ros2").disable_seeking(true).create(NoSeek::new(Vec::new())).unwrap();
    File { writer, channels: BTreeMap::new(), sequence: 0 }
}

/// A recording of a run of three cells.
pub(crate) fn run(skin: &str, options: WriteOptions, files_last: bool) -> Vec<u8> {
    let mut file = begin(options);
    let facts = [("duration_s".to_owned(), "1".to_owned())].into();
    let attached = Attachment {
        log_time: BEGAN,
        create_time: BEGAN,
        name: "skin.toml".to_owned(),
        media_type: "application/toml".to_owned(),
        data: skin.as_bytes().into(),
    };
    let files = |file: &mut File| {
        let metadata = Metadata { name: "configuration".to_owned(), metadata: BTreeMap::clone(&facts) };
        file.writer.write_metadata(&metadata).unwrap();
        file.writer.attach(&attached).unwrap();
    };
    if !files_last {
        files(&mut file);
    }
    let cells = [1, 2, 3].map(|cell| CellId::new(cell).unwrap());
    file.packet("/state/vcan0", BEGAN, &joints(255));
    for tick in 0..64_u64 {
        let at = BEGAN + tick * 2_000_000;
        let timing = LoopTiming {
            nanos: at,
            tick,
            late_us: 3.0,
            took_us: 2.0,
            contributing: 3,
            ..LoopTiming::default()
        };
        file.message("/gateway/timing", at, &timing);
        let (names, q) = (["joint1"; 6], [0.1; 6]);
        let names = &names.map(str::to_owned);
        let states = JointState { nanos: at, names, position: &q, velocity: &q, effort: &q };
        file.message("/UR5/joint_states", at, &states);
        let torques = Torques { nanos: at, distributed: &q, central: &q, active: 3 };
        file.message("/UR5/torques", at, &torques);
        if tick % 8 == 0 {
            let epoch = u8::try_from(tick / 8).unwrap();
            file.packet("/can/vcan0", at, &joints(epoch));
            for (place, from) in cells.into_iter().enumerate() {
                let torque = [Q3_12::nearest(0.25); 6];
                let packet =
                    Packet::Torque { from, epoch: Epoch(epoch), torque: torque.map(Q3_12::to_bits).into() };
                file.packet("/can/vcan0", at + 1_000 * (place as u64 + 1), &packet);
            }
        }
    }
    let note = trace::capture::CaptureNote {
        kind: trace::capture::NoteKind::Dropped(12),
        nanos: BEGAN,
        interface: "vcan0",
        line: 0,
        text: b"DROPCOUNT: dropped 12 CAN frames on 'vcan0' socket (total drops 12)",
    };
    file.message("/can/notes", BEGAN + 5, &note);
    if files_last {
        files(&mut file);
    }
    file.writer.finish().unwrap();
    file.writer.into_inner().into_inner()
}

fn joints(epoch: u8) -> Packet {
    let positions = [Q1_14::from_radians(0.1).unwrap_or_default(); 6];
    Packet::Joints {
        epoch: Epoch(epoch),
        joints: Joints { positions: pad_with_defaults(&positions), in_use: 6 },
    }
}

/// Frames as recorded by another bridge.
pub(crate) fn bridge() -> Vec<u8> {
    let mut file = begin(WriteOptions::new().compression(None));
    for number in 0..100_u8 {
        let nanos = BEGAN + u64::from(number) * 1_000_000;
        let mut data = Vec::new();
        let mut out = Cdr::new(&mut data);
        out.put(Header { nanos: u64::from(number) * 1_000_000_000 + 5, frame_id: "can0" });
        out.put(0x100 + u32::from(number));
        [0_u8, 1, 0, 8, 1, 2, 3, 4, 5, 6, 7, 8].into_iter().for_each(|byte| out.put(byte));
        file.put(("can_msgs/msg/Frame", ""), "/from_can_bus", nanos, &data);
    }
    file.writer.finish().unwrap();
    file.writer.into_inner().into_inner()
}

/// Files of at most 1 MiB that claim, name or unpack to far more.
pub(crate) fn bombs(skin: &str) -> Vec<(&'static str, Vec<u8>)> {
    const MIB: usize = 1 << 20;
    let file = |records: &[Vec<u8>]| {
        let header = record(1, &[string(b"ros2"), string(b"")].concat());
        [mcap::MAGIC.to_vec(), header, records.concat()].concat()
    };
    let schema = |id: u16, name: &[u8]| {
        let bytes = [&id.to_le_bytes()[..], &string(name), &string(b"ros2msg"), &string(b"")].concat();
        record(3, &bytes)
    };
    let channel = |id: u16, topic: &[u8], facts: &[u8]| {
        let (id, schema) = (id.to_le_bytes(), 1_u16.to_le_bytes());
        record(4, &[&id[..], &schema, &string(topic), &string(b"cdr"), &string(facts)].concat())
    };
    let message =
        |channel: u16, data: &[u8]| record(5, &[&channel.to_le_bytes()[..], &[0; 20], data].concat());
    let zeros = |bytes: usize| vec![0; bytes];
    let can = Record::TYPE.as_bytes();
    // Together more than the address space of a command.
    let names = (1..=6).map(|id| chunk("zstd", &schema(id, &vec![b'n'; 100 * MIB]))).collect::<Vec<_>>();
    let short_names = (1..=30).map(|id| chunk("zstd", &schema(id, &vec![b'n'; 3 * MIB]))).collect::<Vec<_>>();
    let channels = (0..=u16::MAX).map(|id| channel(id, id.to_string().as_bytes(), b""));
    let channels = [schema(1, b"a/B")].into_iter().chain(channels).collect::<Vec<_>>().concat();
    let each = (0..=u16::MAX).map(|id| message(id, b"")).collect::<Vec<_>>().concat();
    let frames = [schema(1, can), channel(1, b"/can/vcan0", b"")].concat();
    let many = [frames.clone(), message(1, b"").repeat(2_000_000)].concat();
    let long = [frames, message(1, &zeros(100 * MIB))].concat();
    let skinned = {
        let attached =
            [&[0; 16][..], &string(b"skin.toml"), &string(b""), &(skin.len() as u64).to_le_bytes()];
        record(9, &[&attached.concat()[..], skin.as_bytes(), &[0; 4]].concat())
    };
    let described =
        |topic: &[u8]| [schema(1, b"sensor_msgs/msg/JointState"), channel(1, topic, b"")].concat();
    let joints = {
        // A sequence of 12 million joints.
        let head = [&[0, 1, 0, 0][..], &[0; 8], &1_u32.to_le_bytes(), &[0; 4], &0_u32.to_le_bytes()].concat();
        let count = 12_000_000_u32.to_le_bytes();
        [described(b"/UR5/joint_states"), message(1, &[&head[..], &count, &zeros(100 * MIB)].concat())]
            .concat()
    };
    vec![
        ("names of 100 MB", file(&names)),
        ("names of 3 MB", file(&short_names)),
        ("65 536 channels", file(&[chunk("zstd", &channels), chunk("zstd", &each)])),
        ("many messages", file(&[chunk("zstd", &many)])),
        ("a long message", file(&[chunk("zstd", &long)])),
        (
            "many facts",
            file(&[chunk("zstd", &[schema(1, can), channel(1, b"/x", &zeros(100 * MIB))].concat())]),
        ),
        ("a chunk of zeros", file(&[chunk("lz4", &zeros(100 * MIB))])),
        ("many chunks", file(&vec![chunk("zstd", &record(7, &zeros(20 * MIB))); 40])),
        ("many joints", file(&[skinned, chunk("zstd", &joints)])),
    ]
}
