//! Recordings that are cut off or damaged are repaired: intact content is kept, and the rest is reported.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::BTreeMap;
use std::fs;
use std::io::Cursor;
use std::path::Path;
use std::process::{Command, Output};

use mcap::read::{Summary, attachment, metadata};
use mcap::records::{MessageHeader, op};
use mcap::{MessageStream, WriteOptions};
use protocol::can::Frame;
use protocol::candump::{Record, Timestamp};
use trace::recording::file::{CHUNKS_PER_DESCRIPTION, FileWriter};
use trace::recording::recover::{RecoverError, RecoveryResult, recover};
use trace::ros2::standard::JointState;

/// A recording with messages of two topics in five chunks, a file and metadata.
fn recording() -> Vec<u8> {
    let mut writer = FileWriter::new(Vec::new()).unwrap();
    writer.write_metadata("program", &BTreeMap::from([("a".to_owned(), "b".to_owned())])).unwrap();
    writer.attach("skin.toml", "application/toml", 7, b"version = 1\n").unwrap();
    let mut can = writer.channel::<Record<'_>>("/can/vcan0", &[("time_digits", "9")]).unwrap();
    let mut joints = writer.channel::<JointState<'_>>("/arm/joint_states", &[]).unwrap();
    writer.flush().unwrap();
    for number in 0..50_u8 {
        let nanos = u64::from(number) * 1_000;
        let frame = Frame::classic(0x123, &[number; 8]).unwrap();
        let time = Timestamp::with_nine_digits(nanos);
        let record = Record { time, interface: "vcan0", frame, direction: None };
        writer.write(&mut can, nanos, &record).unwrap();
        let q = [f64::from(number)];
        let state = JointState { nanos, names: &[], position: &q, velocity: &[], effort: &[] };
        writer.write(&mut joints, nanos, &state).unwrap();
        if number % 10 == 9 {
            writer.flush().unwrap();
        }
    }
    writer.finish().unwrap();
    writer.into_inner()
}

/// Topic, time, sequence and bytes of each message of a finished file.
fn messages(bytes: &[u8]) -> Vec<(String, u64, u32, Vec<u8>)> {
    let summary = Summary::read(bytes).unwrap().expect("it has its end");
    let messages = MessageStream::new(bytes).unwrap().map(|message| {
        let message = message.unwrap();
        assert!(message.channel.schema.is_some());
        (message.channel.topic.clone(), message.log_time, message.sequence, message.data.into_owned())
    });
    let messages: Vec<_> = messages.collect();
    assert_eq!(summary.stats.unwrap().message_count, messages.len() as u64);
    messages
}

fn recovered(bytes: &[u8]) -> Result<(RecoveryResult, Vec<u8>), RecoverError> {
    let mut out = Vec::new();
    recover(Cursor::new(bytes), &mut out).map(|recovered| (recovered, out))
}

#[test]
fn a_whole_file_comes_back_with_everything_in_it() {
    let bytes = recording();
    let (said, copy) = recovered(&bytes).unwrap();
    assert!(said.is_sound(), "{said:?}");
    assert_eq!((said.messages, said.frames, said.last_nanos), (100, 50, 49_000));
    assert_eq!(messages(&copy), messages(&bytes));
    let summary = Summary::read(&copy).unwrap().unwrap();
    let attached = attachment(&copy, &summary.attachment_indexes[0]).unwrap();
    assert_eq!((attached.name.as_str(), &attached.data[..]), ("skin.toml", &b"version = 1\n"[..]));
    assert_eq!(metadata(&copy, &summary.metadata_indexes[0]).unwrap().metadata["a"], "b");
    let channel = summary.channels.values().find(|channel| channel.topic == "/can/vcan0").unwrap();
    assert_eq!(channel.metadata["time_digits"], "9");
}

#[test]
fn a_file_that_breaks_off_anywhere_keeps_what_was_handed_on() {
    let bytes = recording();
    let all = messages(&bytes);
    let mut most = 0;
    for end in 0..bytes.len() {
        match recovered(&bytes[..end]) {
            Ok((said, copy)) => {
                let kept = messages(&copy);
                assert!(
                    all.starts_with(&kept) && kept.len().is_multiple_of(20),
                    "{end}: whole chunks, in order"
                );
                assert!(kept.len() >= most, "{end}: more bytes, fewer messages");
                assert!(
                    !said.is_sound() && said.damaged == (0, 0) && said.orphaned_messages == 0,
                    "{end}: {said:?}"
                );
                most = kept.len();
                // A repaired file needs no repair.
                let (again, _) = recovered(&copy).unwrap();
                assert!(again.is_sound() && again.messages == kept.len() as u64, "{end}: {again:?}");
            }
            Err(RecoverError::Empty(_)) => assert!(most == 0 && end < 64, "{end}"),
            Err(other) => panic!("{end}: {other}"),
        }
    }
    assert_eq!(most, 100);
}

#[test]
fn a_damaged_chunk_is_omitted_and_said_and_the_others_are_kept() {
    let bytes = recording();
    let all = messages(&bytes);
    let chunks = Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
    for (number, chunk) in chunks.iter().enumerate().skip(1) {
        let mut bytes = bytes.clone();
        let middle =
            usize::try_from(chunk.chunk_start_offset + chunk.chunk_length - chunk.compressed_size / 2)
                .unwrap();
        bytes[middle] ^= 0x10;
        let (said, copy) = recovered(&bytes).unwrap();
        assert_eq!((said.damaged.0, said.messages, said.has_end), (1, 80, true), "{said:?}");
        let lost = (number - 1) * 20;
        assert_eq!(messages(&copy), [&all[..lost], &all[lost + 20..]].concat());
        assert!(said.to_string().contains(" damaged bytes are lost"), "{said}");
    }
    // The first chunk has the types and topics, which are also outside of chunks and in the summary.
    let mut first = bytes;
    first[usize::try_from(chunks[0].chunk_start_offset + chunks[0].chunk_length - 9).unwrap()] ^= 0x10;
    let (said, copy) = recovered(&first).unwrap();
    assert_eq!((said.messages, said.orphaned_messages, said.damaged.0), (100, 0, 1), "{said:?}");
    assert_eq!(messages(&copy), all);
    // Without an end they are known from records outside of chunks.
    let end =
        usize::try_from(chunks.last().unwrap().message_index_offsets.values().max().unwrap() + 1).unwrap();
    let (said, copy) = recovered(&first[..end]).unwrap();
    assert_eq!((said.messages, said.orphaned_messages, said.stated), (100, 0, None), "{said:?}");
    assert_eq!(messages(&copy), all);
}

#[test]
fn types_and_topics_of_a_recording_by_others_are_known_from_its_summary() {
    let mut chunks = WriteOptions::new().chunk_size(Some(64)).create(Cursor::new(Vec::new())).unwrap();
    let schema = chunks.add_schema("a/B", "ros2msg", b"uint8 a").unwrap();
    let topic = chunks.add_channel(schema, "/b", "cdr", &BTreeMap::new()).unwrap();
    for sequence in 0..20 {
        let header = MessageHeader { channel_id: topic, sequence, log_time: 7, publish_time: 7 };
        chunks.write_to_known_channel(&header, &[1; 40]).unwrap();
    }
    chunks.finish().unwrap();
    let bytes = chunks.into_inner().into_inner();
    let all = messages(&bytes);
    let summary = Summary::read(&bytes).unwrap().unwrap();
    let first = &summary.chunk_indexes[0];
    let mut damaged = bytes.clone();
    damaged[usize::try_from(first.chunk_start_offset + first.chunk_length - 9).unwrap()] ^= 1;
    let (said, copy) = recovered(&damaged).unwrap();
    let lost = summary.chunk_indexes.len();
    assert!(said.messages >= 20 - 2 && said.orphaned_messages == 0 && lost > 5, "{said:?}");
    assert!(all.ends_with(&messages(&copy)), "{said}");
    // Without an end the other channels are unknown.
    let end = bytes.windows(9).position(|at| at == [15, 4, 0, 0, 0, 0, 0, 0, 0]).unwrap();
    let (said, _) = recovered(&damaged[..end]).unwrap();
    assert!(said.messages == 0 && said.orphaned_messages >= 18 && said.lost_more_than_kept(), "{said:?}");
}

#[test]
fn frames_of_other_programs_count_as_frames() {
    for (schema, encoding, frames) in [
        ("can_msgs/msg/Frame", "cdr", 3),
        ("ros2_socketcan_msgs/msg/FdFrame", "cdr", 3),
        ("can_msgs/Frame", "ros1", 3),
        ("a/B", "cdr", 0),
    ] {
        let mut writer = WriteOptions::new().create(Cursor::new(Vec::new())).unwrap();
        let schema = writer.add_schema(schema, "ros2msg", b"uint8 a").unwrap();
        let topic = writer.add_channel(schema, "/from_can_bus", encoding, &BTreeMap::new()).unwrap();
        for sequence in 0..3 {
            let header = MessageHeader { channel_id: topic, sequence, log_time: 7, publish_time: 7 };
            writer.write_to_known_channel(&header, &[1; 40]).unwrap();
        }
        writer.finish().unwrap();
        let (said, _) = recovered(&writer.into_inner().into_inner()).unwrap();
        assert_eq!((said.messages, said.frames), (3, frames), "{encoding}");
    }
}

#[test]
fn types_and_topics_are_described_outside_of_chunks_again_and_again() {
    let mut writer = FileWriter::new(Vec::new()).unwrap();
    let mut joints = writer.channel::<JointState<'_>>("/arm/joint_states", &[]).unwrap();
    let state = JointState { nanos: 1, names: &[], position: &[1.0], velocity: &[], effort: &[] };
    let count = 3 * CHUNKS_PER_DESCRIPTION + 5;
    for _ in 0..count {
        writer.write(&mut joints, 1, &state).unwrap();
        writer.flush().unwrap();
    }
    let (mut at, mut chunks, mut since, mut described) = (8, 0, 0, Vec::new());
    let bytes = writer.into_inner();
    while at < bytes.len() {
        let code = bytes[at];
        at += 9 + usize::try_from(u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap())).unwrap();
        (chunks, since) = if code == op::CHUNK { (chunks + 1, since + 1) } else { (chunks, since) };
        if code == op::CHANNEL {
            described.push(since);
            since = 0;
        }
        assert!(since <= CHUNKS_PER_DESCRIPTION);
    }
    assert_eq!(
        (chunks, described),
        (count, vec![1, CHUNKS_PER_DESCRIPTION, CHUNKS_PER_DESCRIPTION, CHUNKS_PER_DESCRIPTION])
    );
}

/// Checks that all messages of undamaged chunks are kept in order, and that no message was invented.
fn keeps_what_is_intact(original: &[u8], damaged: &[u8], bytes: std::ops::Range<usize>, what: &str) {
    let all = messages(original);
    let chunks = Summary::read(original).unwrap().unwrap().chunk_indexes;
    let (said, copy) = recovered(damaged).unwrap();
    let kept = messages(&copy);
    let mut at = kept.iter();
    for (number, chunk) in chunks.iter().skip(1).enumerate() {
        let start = usize::try_from(chunk.chunk_start_offset).unwrap();
        let end = start + usize::try_from(chunk.chunk_length).unwrap();
        let own = &all[20 * number..20 * number + 20];
        if bytes.end <= start || end <= bytes.start {
            assert!(
                own.iter().all(|message| at.by_ref().any(|it| it == message)),
                "{what}: chunk {number}, {said}"
            );
        }
    }
    assert!(kept.iter().all(|message| all.contains(message)), "{what}: {said}");
    // A footer with a checksum of 0 has none.
    assert!(!said.is_sound() || bytes.end > original.len() - 12, "{what}: {said:?}");
}

#[test]
fn wherever_damage_is_every_intact_chunk_is_kept() {
    let bytes = recording();
    let first = &Summary::read(&bytes).unwrap().unwrap().chunk_indexes[0];
    let first = usize::try_from(first.chunk_start_offset + first.chunk_length).unwrap();
    for at in first..bytes.len() {
        let flip = [1, 0x40, 0x80, 0xFF][at % 4];
        let mut damaged = bytes.clone();
        damaged[at] ^= flip;
        keeps_what_is_intact(&bytes, &damaged, at..at + 1, &format!("{flip:x} at {at}"));
        for length in [9, 100, 700] {
            if at % 13 != length % 13 {
                continue;
            }
            let end = (at + length).min(bytes.len());
            let mut damaged = bytes.clone();
            damaged[at..end].fill(0);
            if damaged != bytes {
                keeps_what_is_intact(&bytes, &damaged, at..end, &format!("{length} zeros at {at}"));
            }
            damaged.drain(at..end);
            keeps_what_is_intact(&bytes, &damaged, at..end, &format!("{length} bytes gone at {at}"));
        }
    }
}

#[test]
fn a_length_that_leads_over_others_or_beyond_the_end_hides_nothing() {
    let bytes = recording();
    let summary = Summary::read(&bytes).unwrap().unwrap();
    let chunk = usize::try_from(summary.chunk_indexes[2].chunk_start_offset).unwrap();
    let attached = usize::try_from(summary.attachment_indexes[0].offset).unwrap();
    // A chunk's own fields give its length too.
    for (at, expected) in [(chunk, [80, 100]), (attached, [100, 100])] {
        for length in [7, 300, 2_000, 1 << 20, u64::MAX] {
            let mut damaged = bytes.clone();
            let own = u64::from_le_bytes(damaged[at + 1..at + 9].try_into().unwrap());
            damaged[at + 1..at + 9].copy_from_slice(&own.wrapping_add(length).to_le_bytes());
            let (said, _) = recovered(&damaged).unwrap();
            assert!(expected.contains(&said.messages) && said.damaged.0 == 1, "{at} + {length}: {said}");
        }
    }
    // Damage in the header loses the profile.
    for at in 8..17 {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x21;
        let (said, _) = recovered(&damaged).unwrap();
        assert!(said.messages == 100 && !said.is_sound(), "{at}: {said}");
    }
    // Blocks that were never written are zeros, as after a power loss.
    let zeros = [&bytes[..chunk], &[0; 300_000]].concat();
    let (said, _) = recovered(&zeros).unwrap();
    assert_eq!((said.messages, said.unfinished_bytes, said.damaged.0), (20, 300_000, 0), "{said}");
}

#[test]
fn a_description_is_never_taken_for_a_message() {
    let bytes = recording();
    let (mut at, mut places) = (8, Vec::new());
    while bytes[at] != op::DATA_END {
        if matches!(bytes[at], op::SCHEMA | op::CHANNEL) {
            places.push(at);
        }
        at += 9 + usize::try_from(u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap())).unwrap();
    }
    assert_eq!(places.len(), 4);
    for at in places {
        let mut damaged = bytes.clone();
        damaged[at] = op::MESSAGE;
        keeps_what_is_intact(&bytes, &damaged, at..at + 1, &format!("a description at {at}"));
    }
}

/// Adds to an eight-byte number in a file.
fn add(file: &mut [u8], at: usize, more: u64) {
    let number = u64::from_le_bytes(file[at..at + 8].try_into().unwrap());
    file[at..at + 8].copy_from_slice(&number.wrapping_add(more).to_le_bytes());
}

#[test]
fn a_wrong_length_within_a_chunk_hides_none_behind_it() {
    let bytes = recording();
    let chunks = Summary::read(&bytes[..]).unwrap().unwrap().chunk_indexes;
    let [at, next, last] =
        [2, 3, 5].map(|number| usize::try_from(chunks[number].chunk_start_offset).unwrap());
    // After its times, sizes, checksum and the name of its compression.
    let packed = at + 9 + 36;
    let wrong = [1, 40, 1 << 10, next - at, last - at, 1 << 40].map(|more| more as u64);
    for more in wrong.into_iter().chain([1, 100].map(u64::wrapping_neg)) {
        let mut damaged = bytes.clone();
        add(&mut damaged, packed, more);
        keeps_what_is_intact(&bytes, &damaged, packed..packed + 8, &format!("{more} more bytes"));
    }
}

#[test]
fn descriptions_that_moved_into_the_place_of_a_chunk_are_found() {
    let bytes = recording();
    let summary = Summary::read(&bytes).unwrap().unwrap();
    let [first, second] = [0, 1].map(|number| {
        let chunk = &summary.chunk_indexes[number];
        usize::try_from(chunk.chunk_start_offset + chunk.chunk_length).unwrap()
    });
    // The writer was killed: they are in the first chunk and after it.
    let killed = &bytes[..second];
    for gone in [9, 100, 300] {
        let damaged = [&killed[..first - gone], &killed[first..]].concat();
        let (said, _) = recovered(&damaged).unwrap();
        assert_eq!((said.messages, said.orphaned_messages), (20, 0), "{gone}: {said}");
    }
}

#[test]
fn a_message_outside_of_chunks_that_leads_over_others_hides_none() {
    let options = WriteOptions::new().use_chunks(false);
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    let schema = writer.add_schema("a/B", "ros2msg", b"uint8 a").unwrap();
    let channel = writer.add_channel(schema, "/b", "cdr", &BTreeMap::new()).unwrap();
    for sequence in 0..40 {
        let header = MessageHeader { channel_id: channel, sequence, log_time: 7, publish_time: 7 };
        writer.write_to_known_channel(&header, &[0xFF; 60]).unwrap();
    }
    writer.finish().unwrap();
    let bytes = writer.into_inner().into_inner();
    let record = 31 + 60;
    let first = bytes.windows(9).position(|head| head == [op::MESSAGE, 82, 0, 0, 0, 0, 0, 0, 0]).unwrap();
    let killed = &bytes[..first + 40 * record];
    let sequences = |damaged: &[u8]| {
        let (said, copy) = recovered(damaged).unwrap();
        assert_eq!(said.damaged.0, 1, "{said}");
        messages(&copy).into_iter().map(|(.., sequence, _)| sequence).collect::<Vec<_>>()
    };
    for place in [3, 20, 36, 37, 38] {
        let at = first + usize::try_from(place).unwrap() * record;
        let others = (0..40).filter(|number| *number != place).collect::<Vec<_>>();
        for more in [10, 91, 100] {
            let mut damaged = killed.to_vec();
            add(&mut damaged, at + 1, more);
            assert_eq!(sequences(&damaged), others, "{more} more bytes of {place}");
        }
        let damaged = [&killed[..at + 20], &killed[at + 70..]].concat();
        assert_eq!(sequences(&damaged), others, "bytes gone of {place}");
    }
}

#[test]
fn what_is_no_recording_is_named() {
    let says = |bytes: &[u8]| recovered(bytes).unwrap_err().to_string();
    assert_eq!(
        says(b"PK\x03\x04 and so on"),
        "it is not an MCAP file: it begins with 50 4b 03 04 20 61 6e 64, but MCAP begins with 89 4d 43 41 50; name a recording"
    );
    assert_eq!(says(b""), "it ends after 0 bytes, before its first message, so nothing can be recovered");
}

fn gateway(folder: &Path, words: &str) -> Output {
    let program = env!("CARGO_BIN_EXE_skinbus");
    Command::new(program).args(words.split(' ')).current_dir(folder).output().unwrap()
}

#[test]
fn the_command_says_what_it_did_and_overwrites_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let bytes = recording();
    // In the middle of the third chunk with messages.
    let third = Summary::read(&bytes).unwrap().unwrap().chunk_indexes[3].chunk_start_offset;
    fs::write(path("run.mcap.part"), &bytes[..usize::try_from(third).unwrap() + 50]).unwrap();
    fs::write(path("whole.mcap"), &bytes).unwrap();
    fs::write(path("there.mcap"), "somebody's").unwrap();
    fs::write(path("a.zip"), "PK\x03\x04").unwrap();
    let says = |words: &str, code: i32| {
        let Output { status, stdout, stderr } = gateway(folder.path(), words);
        let text = String::from_utf8([stdout, stderr].concat()).unwrap();
        assert_eq!((status.code(), text.lines().count()), (Some(code), 1), "{words}: {text}");
        text.trim_end().to_owned()
    };
    let said = says("recover run.mcap.part", 0);
    assert!(
        said.starts_with("run-recovered.mcap, ")
            && said.contains("; 50 bytes of an unfinished record are lost"),
        "{said}"
    );
    assert_eq!(messages(&fs::read(path("run-recovered.mcap")).unwrap()).len(), 40);
    assert!(path("run.mcap.part").exists(), "it stays");
    assert!(says("recover run.mcap.part", 0).starts_with("run-recovered-1.mcap, "));
    assert_eq!(
        says("recover whole.mcap", 0),
        "whole.mcap is intact, there is nothing to recover: 100 messages"
    );
    assert!(!path("whole-recovered.mcap").exists());
    // No message came back, or too few.
    let begun = usize::try_from(Summary::read(&bytes).unwrap().unwrap().chunk_indexes[1].chunk_start_offset);
    fs::write(path("begun.mcap"), &bytes[..begun.unwrap() + 40]).unwrap();
    let said = says("recover begun.mcap", 1);
    assert!(said.starts_with("skinbus: begun.mcap: no message could be recovered: 0 messages"), "{said}");
    assert!(!path("begun-recovered.mcap").exists());
    let index = Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
    let [from, to] = [1, 4].map(|at| usize::try_from(index[at].chunk_start_offset).unwrap());
    let mut gap = bytes;
    gap[from..to + 200].fill(0);
    fs::write(path("gap.mcap"), &gap).unwrap();
    let said = says("recover gap.mcap", 1);
    assert!(
        said.contains("most of gap.mcap is lost, only a part could be recovered: gap-recovered.mcap, ")
            && said.contains(" 20 of 100 messages"),
        "{said}"
    );
    let exists = "skinbus: -o there.mcap: the file exists: name another file, or add --overwrite";
    assert_eq!(says("recover run.mcap.part -o there.mcap", 2), exists);
    assert_eq!(fs::read_to_string(path("there.mcap")).unwrap(), "somebody's");
    says("recover run.mcap.part -o there.mcap --overwrite", 0);
    assert_eq!(messages(&fs::read(path("there.mcap")).unwrap()).len(), 40);
    let itself = "skinbus: -o whole.mcap is also an input of this command: name another file for the output";
    assert_eq!(says("recover whole.mcap -o whole.mcap --overwrite", 2), itself);
    assert!(
        says("recover a.zip", 1)
            .starts_with("skinbus: a.zip: it is not an MCAP file: it begins with 50 4b 03 04")
    );
    assert!(says("recover -", 2).ends_with("name the new file with -o"));
    assert!(says("recover gone.mcap", 2).contains("gone.mcap: No such file"));
    let nowhere = "skinbus: -o none/new.mcap: No such file or directory (os error 2); name a file in a folder that can be \
                   written";
    assert_eq!(says("recover run.mcap.part -o none/new.mcap", 2), nowhere);
    let held = fs::File::open(path("run.mcap.part")).unwrap();
    rustix::fs::flock(&held, rustix::fs::FlockOperation::LockExclusive).unwrap();
    let recorded = "skinbus: run.mcap.part is still being recorded: wait until the run ends";
    assert_eq!(says("recover run.mcap.part", 2), recorded);
}
