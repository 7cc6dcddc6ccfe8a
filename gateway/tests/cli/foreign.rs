//! Foreign traffic, and damaged traffic of this protocol, in `skinbus dump`.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

mod traffic;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use analysis::stats::{CaptureStats, StatsReport};
use model::decode::settle::OrderedDecoder;
use model::decode::{Decoded, ForeignReason};
use protocol::can::{Format, Frame};
use protocol::candump::{Record, Timestamp};
use protocol::id::CellId;
use protocol::message::{self, Message};
use protocol::packet::Epoch;
use protocol::time::Micros;
use serde_json::Value;

use traffic::{Random, car, others};

/// Decoded meaning of each frame, in order.
fn settled(frames: &[(u64, Frame)]) -> Vec<((u64, Frame), Decoded)> {
    let mut settler = OrderedDecoder::new(None);
    let mut all = Vec::new();
    for (nanos, frame) in frames {
        settler.push(Micros(nanos / 1_000), "can0", frame, (*nanos, *frame));
        all.extend(std::iter::from_fn(|| settler.pop()));
    }
    settler.finish();
    all.extend(std::iter::from_fn(|| settler.pop()));
    let order: Vec<_> = all.iter().map(|(it, _)| *it).collect();
    assert!(order == frames, "every frame comes back, in the order of the capture");
    all
}

fn record(nanos: u64, frame: Frame) -> Record<'static> {
    let time = Timestamp::with_nine_digits(nanos);
    Record { time, interface: "can0", frame, direction: None }
}

fn statistics(frames: &[(u64, Frame)]) -> StatsReport {
    let mut stats = CaptureStats::default();
    for ((nanos, frame), decoded) in settled(frames) {
        stats.record(&record(nanos, frame), &decoded);
    }
    stats.report()
}

fn log(frames: &[(u64, Frame)]) -> String {
    let mut text = String::new();
    for (nanos, frame) in frames {
        writeln!(text, "{}", record(*nanos, *frame)).unwrap();
    }
    text
}

/// Traffic of this protocol: joints every 16 ms, answered by cells 1 to 9.
fn ours(format: Format, epochs: u64) -> Vec<(u64, Frame)> {
    let mut frames = Vec::new();
    for epoch in 0..epochs {
        let number = Epoch(u8::try_from(epoch % 256).unwrap());
        let joints = message::Joints { in_use: 6, ..message::Joints::default() };
        let word = |cell: i64| i16::try_from(cell * 100 + i64::try_from(epoch).unwrap() % 50).unwrap();
        let torques = (1..=9).map(|cell| Message::Torque {
            from: CellId::new(cell).unwrap(),
            epoch: number,
            torque: [word(cell); 6].into(),
        });
        let messages = std::iter::once(Message::Joints { epoch: number, joints }).chain(torques);
        for (place, frame) in messages.flat_map(|message| message.encode().frames(format)).enumerate() {
            frames.push((epoch * 16_000_000 + u64::try_from(place).unwrap() * 150_000, frame));
        }
    }
    frames
}

const fn is_foreign(decoded: &Decoded) -> bool {
    matches!(decoded, Decoded::Foreign(_))
}

#[test]
fn a_car_is_foreign_and_chance_makes_one_packet_of_65536_pairs() {
    let (mut frames, mut chance, mut damaged) = (0_u64, 0_u64, 0_u64);
    for seed in 0..8 {
        let all = settled(&car(seed, 22_000));
        frames += u64::try_from(all.len()).unwrap();
        chance += u64::try_from(all.iter().filter(|(_, it)| !is_foreign(it)).count()).unwrap();
        damaged += u64::try_from(all.iter().filter(|(_, it)| matches!(it, Decoded::Damaged { .. })).count())
            .unwrap();
    }
    assert!(frames > 160_000, "{frames}");
    // 2.6 packets are expected; each takes two frames. The seeds are fixed, so the result does not vary.
    assert!(chance <= 2 * 8, "{chance} of {frames}");
    assert_eq!(damaged, 0, "a packet by chance makes nothing else ours");
}

#[test]
fn foreign_identifiers_are_counted_with_rate_length_and_times() {
    let mut frames = car(3, 20_000);
    frames.extend(others(4, 20_000));
    frames.sort_by_key(|(nanos, _)| *nanos);
    let mut expected: BTreeMap<String, u64> = BTreeMap::new();
    for (_, frame) in &frames {
        let raw = frame.to_string();
        let id = raw.split('#').next().unwrap();
        let name = if frame.is_remote() { format!("{id} remote") } else { id.to_owned() };
        *expected.entry(name).or_default() += 1;
    }
    let report = statistics(&frames);
    let bus = &report.buses[0];
    let foreign = &bus.foreign;
    let total = u64::try_from(frames.len()).unwrap();
    assert_eq!((foreign.frames, bus.cells.len(), bus.kinds.len()), (total, 0, 0));
    assert_eq!(foreign.frames, foreign.standard + foreign.extended + foreign.remote + foreign.error);
    assert_eq!((foreign.remote, foreign.error), (100, 40));
    let counted = foreign.identifiers.iter().map(|id| {
        let remote = format!("{:?}", id.of) == "Remote";
        (if remote { format!("{} remote", id.id) } else { id.id.clone() }, id.frames)
    });
    assert_eq!(counted.collect::<BTreeMap<_, _>>(), expected);
    let of = |id: &str| foreign.identifiers.iter().find(|it| it.id == id).unwrap();
    for (id, rate, bytes) in [("20C", 100.0, (8, 8)), ("0CF00400", 100.0, (8, 8)), ("300", 50.0, (64, 64))] {
        let it = of(id);
        assert!((it.frames_per_s.unwrap() - rate).abs() < 0.1, "{it:?}");
        assert_eq!((it.bytes_min, it.bytes_max), bytes);
        assert!(it.first_s < 0.1 && it.last_s > 19.9, "{it:?}");
    }
    assert_eq!(of("20D").wrong_crc, of("20D").frames, "16 bytes in one FD frame, and another CRC");
    let most = foreign.identifiers.windows(2).all(|pair| pair[0].frames >= pair[1].frames);
    assert!(most, "the one with the most frames is first");
}

#[test]
fn our_packets_are_found_among_foreign_frames_of_the_same_bus() {
    for format in [Format::Fd, Format::Classic] {
        let own = ours(format, 500);
        // A car that does not use the identifiers of this protocol that are in use here.
        let used: Vec<_> = own.iter().map(|(_, frame)| frame.id()).collect();
        let mut frames = car(7, 8_000);
        frames.extend(others(8, 8_000));
        frames.retain(|(_, frame)| !used.contains(&frame.id()));
        let foreign = frames.len();
        frames.extend(&own);
        frames.sort_by_key(|(nanos, _)| *nanos);
        for ((_, frame), decoded) in settled(&frames) {
            let ours = own.iter().any(|(_, it)| *it == frame);
            assert_eq!(is_foreign(&decoded), !ours, "{frame} {decoded:?}");
        }
        let report = statistics(&frames);
        let bus = &report.buses[0];
        assert_eq!((bus.cells.len(), bus.epochs.missing), (9, 0));
        assert_eq!(bus.foreign.frames, u64::try_from(foreign).unwrap());
        assert_eq!(bus.refused.counts_by_reason().map(|(_, count)| count), [0; 4]);
    }
}

#[test]
fn single_segments_on_a_lossy_bus_are_damaged_and_not_foreign() {
    let mut random = Random(11);
    let all = ours(Format::Classic, 1_000);
    // Each frame by itself: the first segment of a packet, the second, or both may be lost.
    let kept: Vec<_> = all.iter().enumerate().filter(|(at, _)| *at < 100 || random.below(50) > 0).collect();
    let lost = all.len() - kept.len();
    let place: Vec<_> = kept.iter().map(|(at, _)| *at).collect();
    let whole = place.windows(2).filter(|pair| pair[0] % 2 == 0 && pair[1] == pair[0] + 1).count();
    let frames: Vec<_> = kept.into_iter().map(|(_, it)| *it).collect();
    let decoded = settled(&frames);
    let count = |is: fn(&Decoded) -> bool| decoded.iter().filter(|(_, it)| is(it)).count();
    assert_eq!(count(|it| matches!(it, Decoded::Message(_))), whole);
    assert_eq!(count(|it| matches!(it, Decoded::Segment { .. })), whole);
    let damaged = frames.len() - 2 * whole;
    assert!(damaged > lost / 2, "{damaged} {lost}");
    assert_eq!((count(|it| matches!(it, Decoded::Damaged { .. })), count(is_foreign)), (damaged, 0));
    let bus = &statistics(&frames).buses[0];
    assert_eq!((bus.refused.incomplete, bus.foreign.frames), (u64::try_from(damaged).unwrap(), 0));
}

#[test]
fn a_frame_waits_no_longer_than_the_reassembly_timeout() {
    let mut settler = OrderedDecoder::new(None);
    let [first, second] = [0, 1].map(|at| ours(Format::Classic, 1)[at].1);
    settler.push(Micros(1_000_000), "can0", &first, 1);
    assert_eq!(settler.pop(), None, "the second segment may come");
    settler.push(Micros(1_000_150), "can0", &second, 2);
    let settled = std::iter::from_fn(|| settler.pop()).map(|(item, it)| (item, it.verdict_word()));
    assert_eq!(settled.collect::<Vec<_>>(), [(1, "segment"), (2, "ok")]);
    // A live bus on which no more frames come.
    settler.push(Micros(2_000_000), "can0", &first, 3);
    settler.handle_time(Micros(2_010_000));
    assert_eq!(settler.pop(), None);
    settler.handle_time(Micros(2_200_000));
    assert_eq!(settler.pop().map(|(item, it)| (item, it.verdict_word())), Some((3, "foreign")));
    assert!(!settler.is_waiting());
    // A segment that has timed out is no longer a first segment.
    settler.push(Micros(2_200_100), "can0", &second, 4);
    settler.finish();
    assert_eq!(settler.pop().map(|(item, it)| (item, it.verdict_word())), Some((4, "foreign")));
}

#[test]
fn frames_that_wait_are_bounded_where_times_do_not_move_or_run_backwards() {
    for step in [0_i64, -1] {
        let mut settler = OrderedDecoder::new(None);
        let (mut out, mut most) = (0_u64, 0_u64);
        let frames = 200_000_u32;
        // Each frame has an identifier of its own as far as there are enough: no later frame settles an earlier one.
        for number in 0..frames {
            let bus = if number % 2 == 0 { "can0" } else { "can1" };
            let at = Micros(10_000_000_u64.saturating_add_signed(step * i64::from(number)));
            let id = if number < 2_000 { number } else { 0x7AA };
            let frame = Frame::classic(id, &u64::from(number).to_le_bytes()).unwrap();
            settler.push(at, bus, &frame, ());
            out += u64::try_from(std::iter::from_fn(|| settler.pop()).count()).unwrap();
            most = most.max(u64::from(number) + 1 - out);
        }
        assert!(most <= 1 << 16, "{most}");
        settler.finish();
        out += u64::try_from(std::iter::from_fn(|| settler.pop()).count()).unwrap();
        assert_eq!(out, u64::from(frames));
    }
}

#[test]
fn identifiers_are_bounded_and_what_is_beyond_them_is_counted() {
    let frames: Vec<_> = (0..10_000_u32)
        .map(|id| (u64::from(id) * 1_000, Frame::classic(0x8000_0000 | id << 8, &[]).unwrap()))
        .collect();
    let foreign = &statistics(&frames).buses[0].foreign;
    let told_apart = u64::try_from(foreign.identifiers.len()).unwrap();
    assert_eq!((foreign.frames, told_apart + foreign.frames_of_other_identifiers), (10_000, 10_000));
    assert!(told_apart <= 4096 && matches!(settled(&frames)[0].1, Decoded::Foreign(ForeignReason::Extended)));
}

fn gateway(folder: &Path, arguments: &str) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split(' ')).current_dir(folder).env("NO_COLOR", "1");
    let Output { status, stdout, stderr } = command.output().unwrap();
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!((status.code(), said.as_str()), (Some(0), ""), "{arguments}");
    String::from_utf8(stdout).unwrap()
}

#[test]
fn dump_shows_a_foreign_log_as_foreign_in_its_order() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut frames = car(3, 2_000);
    frames.extend(others(4, 2_000));
    frames.sort_by_key(|(nanos, _)| *nanos);
    let text = log(&frames);
    std::fs::write(folder.join("car.log"), &text).unwrap();
    let raw = |shown: &str| -> String {
        shown.lines().flat_map(|line| [line.split('\t').next().unwrap(), "\n"]).collect()
    };
    for kind in ["", " --kind foreign"] {
        let shown = gateway(folder, &format!("dump car.log{kind}"));
        assert!(raw(&shown) == text, "dump car.log{kind}: all of it, in its order");
        assert!(shown.lines().all(|line| line.split('\t').nth(1).unwrap().starts_with("foreign ")));
    }
    let kinds = "command,sum,torque,sensors,network,configure,configured,stimulus,wire,damaged";
    for pick in [format!("--kind {kinds}"), "--contact".to_owned()] {
        assert_eq!(gateway(folder, &format!("dump car.log {pick}")), "", "{pick}");
    }
    let mut nodes = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    let Output { status, stdout, stderr } =
        nodes.args(["dump", "car.log", "--cell", "gateway,12"]).current_dir(folder).output().unwrap();
    assert_eq!((status.code(), stdout.as_slice()), (Some(0), &b""[..]));
    assert_eq!(stderr, b"car.log contains no frame from or to gateway, 12\n");
    let json = gateway(folder, "dump car.log --json");
    for line in json.lines() {
        let line: Value = serde_json::from_str(line).unwrap();
        assert_eq!(
            (&line["verdict"], &line["kind"], &line["node"]),
            (&"foreign".into(), &Value::Null, &Value::Null)
        );
    }
    let stats: Value = serde_json::from_str(&gateway(folder, "dump car.log --stats --json")).unwrap();
    let foreign = &stats["buses"][0]["foreign"];
    assert_eq!(foreign["frames"], frames.len());
    let first = &foreign["identifiers"][0];
    assert_eq!(
        (&first["type"], first["frames_per_s"].as_f64().map(f64::round)),
        (&"data".into(), Some(100.0))
    );
    let table = gateway(folder, "dump car.log --stats");
    assert!(table.lines().all(|line| line.chars().count() <= 80), "{table}");
    // Each value ends below its heading.
    let line_with = |text: &str| table.lines().find(|line| line.contains(text)).unwrap();
    let (heads, first) = (line_with("can0 foreign"), line_with(" 001 "));
    let ends = |line: &str, text: &str| line.split_once(text).unwrap().0.chars().count() + text.len();
    assert_eq!(ends(first, "   8 "), ends(heads, "bytes "), "{table}");
    for id in ["20C", "0CF00400", "20000004", "701"] {
        assert!(
            table.lines().any(|line| line.trim_start_matches(['│', ' ']).starts_with(id)),
            "{id} in {table}"
        );
    }
}

#[test]
fn a_classic_capture_comes_back_in_its_order_with_each_segment() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let frames = ours(Format::Classic, 20);
    let text = log(&frames);
    std::fs::write(folder.join("ours.log"), &text).unwrap();
    let shown = gateway(folder, "dump ours.log");
    let verdicts: Vec<_> =
        shown.lines().map(|line| line.split('\t').nth(1).unwrap().split(' ').next().unwrap()).collect();
    assert_eq!(verdicts, ["segment", "ok"].repeat(frames.len() / 2));
    assert_eq!(gateway(folder, "dump ours.log --kind foreign"), "");
    let torques = gateway(folder, "dump ours.log --cell 3 -n 5");
    assert_eq!(torques.lines().count(), 5, "--max counts what is shown");
}
