//! Recordings with one damaged place. The content of unchanged records must come back, whatever the reader makes of the
//! damage. The making of the file determines these records, not a reader of this project.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::Cursor;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::process::Command;

use mcap::records::op;
use mcap::{MessageStream, WriteOptions};
use protocol::can::Frame;
use protocol::candump::{Record, Timestamp};
use rand::{Rng, RngExt};
use rand_pcg::Pcg64Mcg;
use trace::capture::CaptureNote;
use trace::recording::file::FileWriter;
use trace::recording::recover::{RecoverError, recover};
use trace::ros2::standard::JointState;

use super::mutate::{records, unpacked};
use super::seeds;

/// Number of files of the quick test.
const QUICK: u64 = 400;
/// One of this many files goes through the commands.
const COMMAND_INTERVAL: u64 = 10;

/// A message: topic, sequence, time, bytes.
type Message = (String, u32, u64, Vec<u8>);

/// A record of a file: its position, operation code, messages, and the descriptions in it by kind and number.
struct FileRecord {
    bytes: Range<usize>,
    code: u8,
    messages: Vec<Message>,
    described: BTreeSet<(u8, u16)>,
}

/// An intact file.
struct Seed {
    name: String,
    bytes: Vec<u8>,
    parts: Vec<FileRecord>,
}

fn number<const N: usize>(body: &[u8], at: usize) -> [u8; N] {
    body[at..at + N].try_into().unwrap()
}

fn id(body: &[u8]) -> u16 {
    u16::from_le_bytes(number(body, 0))
}

impl Seed {
    fn new(name: impl Into<String>, bytes: Vec<u8>) -> Self {
        let (mut parts, mut topics, mut at) = (Vec::new(), BTreeMap::new(), 8);
        for (code, body) in records(&bytes[8..]) {
            let end = at + 9 + body.len();
            let within = if code == op::CHUNK { records(&unpacked(&body)) } else { vec![(code, body)] };
            let mut part =
                FileRecord { bytes: at..end, code, messages: Vec::new(), described: BTreeSet::new() };
            for (code, body) in within {
                match code {
                    op::SCHEMA | op::CHANNEL => {
                        part.described.insert((code, id(&body)));
                        if code == op::CHANNEL {
                            let length = usize::try_from(u32::from_le_bytes(number(&body, 4))).unwrap();
                            let topic = String::from_utf8(body[8..8 + length].to_vec()).unwrap();
                            topics.insert(id(&body), (topic, u16::from_le_bytes(number(&body, 2))));
                        }
                    }
                    op::MESSAGE => {
                        let (sequence, time) = (number(&body, 2), number(&body, 6));
                        let topic = topics[&id(&body)].0.clone();
                        let (sequence, time) = (u32::from_le_bytes(sequence), u64::from_le_bytes(time));
                        part.messages.push((topic, sequence, time, body[22..].to_vec()));
                    }
                    _ => {}
                }
            }
            parts.push(part);
            at = end;
        }
        Self { name: name.into(), bytes, parts }
    }

    /// Records without a damaged byte.
    fn intact(&self, damaged: &Range<usize>) -> impl Iterator<Item = &FileRecord> {
        let is_apart =
            |part: &&FileRecord| damaged.end <= part.bytes.start || part.bytes.end <= damaged.start;
        self.parts.iter().filter(is_apart)
    }

    /// Returns true if intact records contain all descriptions that the record's messages need.
    fn is_described(&self, damaged: &Range<usize>) -> bool {
        let all = |parts: &mut dyn Iterator<Item = &FileRecord>| -> BTreeSet<_> {
            parts.flat_map(|part| part.described.iter().copied()).collect()
        };
        all(&mut self.intact(damaged)) == all(&mut self.parts.iter())
    }
}

/// A recording by this project's writer with `flushes` flushes.
fn own(flushes: u64, ends: bool, chance: &mut impl Rng) -> Vec<u8> {
    let mut writer = FileWriter::new(Vec::new()).unwrap();
    writer.write_metadata("program", &[("a".to_owned(), "b".to_owned())].into()).unwrap();
    writer.attach("skin.toml", "application/toml", 7, b"version = 1\n").unwrap();
    let facts = [("time_digits", "9")];
    let mut buses = ["can0", "can1"].map(|bus| {
        let topic = format!("/can/{bus}");
        (bus, writer.channel::<Record<'_>>(&topic, &facts).unwrap())
    });
    let mut joints = writer.channel::<JointState<'_>>("/arm/joint_states", &[]).unwrap();
    let mut notes = writer.channel::<CaptureNote<'_>>("/can/notes", &[]).unwrap();
    if chance.random() {
        writer.flush().unwrap();
    }
    let mut nanos = 1_700_000_000_000_000_000;
    for flush in 0..flushes {
        for _ in 0..chance.random_range(1..8) {
            nanos += chance.random_range(0..2_000_000);
            let (interface, channel) = &mut buses[usize::from(chance.random::<bool>())];
            let data: [u8; 8] = chance.random();
            let frame = Frame::classic(chance.random_range(0..0x800), &data).unwrap();
            let record =
                Record { time: Timestamp::with_nine_digits(nanos), interface, frame, direction: None };
            writer.write(channel, nanos, &record).unwrap();
            let q = [chance.random::<f64>()];
            let state = JointState { nanos, names: &[], position: &q, velocity: &[], effort: &[] };
            writer.write(&mut joints, nanos, &state).unwrap();
        }
        if flush % 16 == 3 {
            let kind = trace::capture::NoteKind::Text;
            let note = CaptureNote { kind, nanos, interface: "can0", line: 0, text: b"a word" };
            writer.write(&mut notes, nanos, &note).unwrap();
        }
        writer.flush().unwrap();
    }
    if ends {
        writer.finish().unwrap();
    }
    writer.into_inner()
}

/// Files of this project's writer and of others, finished and unfinished.
fn seeds() -> Vec<Seed> {
    let mut chance = Pcg64Mcg::new(36);
    let mut all = Vec::new();
    for flushes in [1, 5, 40, 150] {
        for ends in [true, false] {
            let name = format!("own, {flushes} flushes, end: {ends}");
            all.push(Seed::new(name, own(flushes, ends, &mut chance)));
        }
    }
    let skin = seeds::skin();
    for compression in [None, Some(mcap::Compression::Zstd), Some(mcap::Compression::Lz4)] {
        for size in [1 << 10, 16 << 10] {
            let options = WriteOptions::new().compression(compression).chunk_size(Some(size));
            all.push(Seed::new(format!("{compression:?}, {size}"), seeds::run(&skin, options, false)));
        }
    }
    let bare = WriteOptions::new().calculate_chunk_crcs(true).calculate_data_section_crc(false);
    all.push(Seed::new("no checksum of the data", seeds::run(&skin, bare.chunk_size(Some(4 << 10)), true)));
    all.push(Seed::new("no chunks", seeds::run(&skin, WriteOptions::new().use_chunks(false), false)));
    all.push(Seed::new("another bridge's", seeds::bridge()));
    // The writers of these files were killed.
    let cut = all.iter().filter(|seed| seed.bytes.ends_with(mcap::MAGIC)).map(|seed| {
        let end = seed.parts.iter().find(|part| part.code == op::DATA_END).unwrap();
        Seed::new(format!("{}, no end", seed.name), seed.bytes[..end.bytes.start].to_vec())
    });
    let cut: Vec<_> = cut.collect();
    all.extend(cut);
    assert!(all.iter().all(|seed| seed.bytes.len() <= 200_000));
    all
}

/// A file with one damaged place, a description of the damage, and the range of changed bytes.
fn damaged(seed: &Seed, chance: &mut impl Rng) -> (&'static str, Vec<u8>, Range<usize>) {
    let mut file = seed.bytes.clone();
    let length = file.len();
    let part = &seed.parts[chance.random_range(0..seed.parts.len())];
    let at = if chance.random() {
        part.bytes.start + chance.random_range(0..9)
    } else {
        chance.random_range(0..length)
    };
    let span = at..(at + chance.random_range(1..600)).min(length);
    match chance.random_range(0..12) {
        0..=2 => {
            file[at] ^= 1 << chance.random_range(0..8);
            ("a bit", file, at..at + 1)
        }
        3 => {
            file[at] = file[at].wrapping_add(chance.random_range(1..=255));
            ("a byte", file, at..at + 1)
        }
        4..=6 => {
            let head = part.bytes.start + 1;
            let own = u64::from_le_bytes(number(&file, head));
            let others =
                seed.parts.iter().map(|other| (other.bytes.end as u64).wrapping_sub(head as u64 + 8));
            let choices: Vec<u64> = match chance.random_range(0..4) {
                0 => vec![own ^ (1 << chance.random_range(0..64))],
                1 => vec![0, 1, u64::MAX, 1 << 31, 1 << 40, i64::MAX as u64],
                2 => vec![
                    own.wrapping_add(chance.random_range(1..400)),
                    own.saturating_sub(chance.random_range(1..40)),
                ],
                // The length leads exactly to the start of another record.
                _ => others.filter(|length| *length < 1 << 40).collect(),
            };
            let wrong = choices[chance.random_range(0..choices.len())];
            file[head..head + 8].copy_from_slice(&wrong.to_le_bytes());
            ("a length", file, head..if wrong == own { head } else { head + 8 })
        }
        7 => {
            let head = part.bytes.start;
            file[head] = chance.random();
            ("an operation code", file, head..head + 1)
        }
        8 => {
            let end = if chance.random() { 0..8 } else { length - 8..length };
            let one = end.start + chance.random_range(0..8);
            let place = if chance.random() { end } else { one..one + 1 };
            place.clone().for_each(|at| file[at] = !file[at]);
            ("the magic bytes", file, place)
        }
        9 => {
            file.truncate(at);
            ("torn", file, at..length)
        }
        10 => {
            file.drain(span.clone());
            ("bytes that are gone", file, span)
        }
        _ => {
            file[span.clone()].fill(0);
            ("zeros", file, span)
        }
    }
}

/// Returns true if `all` contains `few` in the same order.
fn is_within<T: PartialEq>(few: &[T], all: &[T]) -> bool {
    let mut all = all.iter();
    few.iter().all(|it| all.any(|other| other == it))
}

/// Messages that an independent reader finds in a file that is reported as whole.
fn messages(bytes: &[u8]) -> Vec<Message> {
    let each = MessageStream::new(bytes).unwrap().map(|message| {
        let message = message.unwrap();
        (message.channel.topic.clone(), message.sequence, message.log_time, message.data.into_owned())
    });
    each.collect()
}

/// Returns true if the damage is in a description that no checksum covers and that the file contains once.
fn is_undetectable(seed: &Seed, place: &Range<usize>) -> bool {
    let has_end = seed.bytes.ends_with(mcap::MAGIC);
    let of_description = |part: &FileRecord| part.code == op::SCHEMA || part.code == op::CHANNEL;
    let is_there = |part: &FileRecord| part.bytes.start < place.end && place.start < part.bytes.end;
    !seed.is_described(place)
        || (!has_end
            && seed
                .parts
                .iter()
                .any(|part| of_description(part) && is_there(part) && seed.name.contains("no chunks")))
}

fn comes_back(seed: &Seed, what: &str, file: &[u8], place: &Range<usize>) {
    let expected: Vec<_> = seed.intact(place).flat_map(|part| part.messages.iter().cloned()).collect();
    let is_unsaid = is_undetectable(seed, place);
    let mut out = Vec::new();
    let said = match recover(Cursor::new(file), &mut out) {
        Ok(said) => said,
        Err(RecoverError::Empty(_) | RecoverError::NoMcap { .. }) if expected.is_empty() => return,
        Err(error) => panic!("{what}: {error}, and {} messages are intact", expected.len()),
    };
    let kept = messages(&out);
    assert_eq!(kept.len() as u64, said.messages, "{what}: {said}");
    assert!(
        is_unsaid || is_within(&expected, &kept),
        "{what}: {} messages are intact: {said}",
        expected.len()
    );
    // Outside of chunks, no checksum shows that a message was changed.
    let all: BTreeSet<_> = seed.parts.iter().flat_map(|part| &part.messages).collect();
    let changed = kept.iter().filter(|message| !all.contains(message)).count();
    let is_bare = seed.parts.iter().any(|part| part.code == op::MESSAGE);
    assert!(changed == 0 || (is_bare && changed <= 1), "{what}: {changed} messages that never were: {said}");
    assert!(
        !said.is_sound() || kept.len() == seed.parts.iter().map(|it| it.messages.len()).sum::<usize>(),
        "{what}: {said:?}"
    );
}

/// Result of a command on a file: exit code, output and messages.
fn run(folder: &Path, words: &str) -> (Option<i32>, Vec<String>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(words.split(' ')).current_dir(folder).env("SKINBUS_DIR", folder.join("bus"));
    let ended = command.output().unwrap();
    let lines = String::from_utf8_lossy(&ended.stdout).lines().map(str::to_owned).collect();
    (ended.status.code(), lines, String::from_utf8_lossy(&ended.stderr).into_owned())
}

/// Checks that each command returns the intact content, or ends with 1 and a reason.
fn check_output(folder: &Path, seed: &Seed, what: &str, file: &[u8], place: &Range<usize>) {
    let write = |name: &str, bytes: &[u8]| fs::write(folder.join(name), bytes).unwrap();
    write("seed.mcap", &seed.bytes);
    write("m.mcap", file);
    let is_entry = |part: &FileRecord| {
        part.messages
            .iter()
            .filter(|(topic, ..)| topic.starts_with("/can/") || topic == "/from_can_bus")
            .count()
    };
    let intact: usize = seed.intact(place).map(is_entry).sum();
    let frames = |part: &FileRecord| {
        let of_bus =
            |topic: &str| (topic.starts_with("/can/") && topic != "/can/notes") || topic == "/from_can_bus";
        part.messages.iter().filter(|(topic, ..)| of_bus(topic)).count()
    };
    let frames: usize = seed.intact(place).map(frames).sum();
    let has_end = file.ends_with(mcap::MAGIC);
    let said = |line: &str, code: Option<i32>, stderr: &str| {
        // The output may end without an end of the recording.
        let tells = has_end || stderr.contains("its end is missing: ");
        assert!(code != Some(0) || tells, "{what}: gateway {line}: {stderr}");
        let refuses = code == Some(1) && !stderr.is_empty();
        assert!(code == Some(0) || refuses, "{what}: gateway {line}: {code:?}: {stderr}");
    };
    for line in ["convert m.mcap - --direction", "fit m.mcap --json", "dump m.mcap --stats --json"] {
        let (code, lines, stderr) = run(folder, line);
        said(line, code, &stderr);
        if code != Some(0) {
            continue;
        }
        let (_, whole, _) = run(folder, &line.replace("m.mcap", "seed.mcap"));
        match line.split(' ').next() {
            Some("convert") => {
                let (smallest, most) = (lines.len().min(whole.len()), intact);
                assert!(smallest >= most, "{what}: {line}: {smallest} entries of {intact}: {stderr}");
            }
            Some("fit") => {
                assert!(lines.len() >= frames, "{what}: {line}: {} of {frames}: {stderr}", lines.len())
            }
            _ => {
                let report: serde_json::Value = serde_json::from_str(&lines.join("\n")).unwrap();
                let found = report["frames"].as_u64().unwrap();
                assert!(found >= frames as u64, "{what}: {line}: {found} of {frames}: {stderr}");
            }
        }
    }
    let line = "dump m.mcap --json";
    let (code, _, stderr) = run(folder, line);
    said(line, code, &stderr);
    let is_bare = seed.parts.iter().any(|part| part.code == op::MESSAGE);
    for line in ["explain m.mcap --epoch 3 --skin skin.toml --json", "report m.mcap -o r.html --overwrite"] {
        let whole = run(folder, &line.replace("m.mcap", "seed.mcap"));
        let (code, lines, stderr) = run(folder, line);
        match (whole.0, code) {
            (Some(0), Some(0)) if line.starts_with("explain") && !is_bare && has_end => {
                let lines = lines.join("\n").replace("m.mcap", "seed.mcap");
                assert_eq!(lines, whole.1.join("\n"), "{what}: {line}: {stderr}");
            }
            // An output that was cut off within the epoch reports it.
            _ => {}
        }
        if whole.0 == Some(0) {
            said(line, code, &stderr);
        }
    }
}

#[test]
fn wherever_a_place_is_damaged_all_else_comes_back() {
    let seeds = seeds();
    let count = std::env::var("SKINBUS_MUTATIONS").map_or(QUICK, |count| count.parse().unwrap());
    let first: u64 = std::env::var("SKINBUS_MUTATIONS_SEED").map_or(0, |first| first.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("skin.toml"), seeds::skin()).unwrap();
    for seed in &seeds {
        comes_back(seed, &seed.name, &seed.bytes, &(0..0));
    }
    let mut failed = Vec::new();
    for number in first..first + count {
        let mut chance = Pcg64Mcg::new(u128::from(number).wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        let seed = &seeds[chance.random_range(0..seeds.len())];
        let (how, file, place) = damaged(seed, &mut chance);
        let what = format!("{number}, {}, {how} at {place:?}", seed.name);
        let passed = catch_unwind(AssertUnwindSafe(|| {
            comes_back(seed, &what, &file, &place);
            if number % COMMAND_INTERVAL == 0 {
                check_output(folder.path(), seed, &what, &file, &place);
            }
        }));
        if passed.is_err() {
            failed.push(what);
            let kept = std::env::temp_dir().join(format!("damaged-{number}.mcap"));
            fs::write(kept, &file).unwrap();
        }
    }
    assert!(failed.is_empty(), "{} of {count}, kept as damaged-N.mcap: {failed:#?}", failed.len());
}
