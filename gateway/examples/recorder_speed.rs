//! Speed of the recorder, its cost per frame, and bytes per frame.
//!
//! ```sh
//! cargo run --release -p gateway --example recorder_speed -- [FOLDER] [LOG]
//! ```
//!
//! The frames are those of 253 cells that are all pressed on a moving arm, or those of a candump log. First they go
//! through the recorder as fast as it accepts them, for ten seconds, into a file in FOLDER (default: the working
//! directory), which is removed again. Then only frames are written at their own times, flushed every 40 ms as in a
//! run.
#![allow(clippy::print_stdout, reason = "the figures are its output")]

use std::error::Error;
use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use bench::record::feed::{self, RecorderFeed};
use bench::record::{McapOutput, RecordOptions, RecordingOutputs};
use model::central::CentralComputation;
use model::latched::LatchedFrame;
use protocol::can::Format;
use protocol::candump::{self, CandumpLine, Direction, Record, Timestamp};
use protocol::fixed::{Q1_14, Q3_12};
use protocol::message::{Joints, Message};
use protocol::packet::pad_with_defaults;
use protocol::packet::{Epoch, Length, WORDS, Words};
use protocol::skin::Skin;
use trace::recording::file::FileWriter;
use trace::recording::layout::Layout;
use trace::recording::series::{FileHead, SplitLimits};

const SKIN_TOML: &str = include_str!("ur5-253.toml");
/// Time for which frames are pushed.
const FRAME_PUSH_TIME: Duration = Duration::from_secs(10);
/// Interval between flushes of a run in ns.
const FLUSH_INTERVAL_NS: u64 = 40_000_000;

fn main() -> Result<(), Box<dyn Error>> {
    let mut words = std::env::args_os().skip(1);
    let folder = words.next().map_or_else(|| PathBuf::from("."), PathBuf::from);
    let skin = Skin::parse("ur5-253.toml", SKIN_TOML)?;
    let frames = match words.next() {
        Some(log) => parse_log_frames(&std::fs::read_to_string(log)?)?,
        None => simulated_run_frames(&skin, 60),
    };
    println!("{} frames, {:.1} s of bus traffic", frames.len(), duration_s(&frames));
    measure_speed(&skin, &folder, &frames)?;
    measure_recording_size(&frames)
}

#[expect(clippy::cast_precision_loss, reason = "times far below 2^53 ns")]
fn duration_s(frames: &[LatchedFrame]) -> f64 {
    let ends = frames.first().zip(frames.last());
    ends.map_or(0.0, |(first, last)| last.at_nanos.saturating_sub(first.at_nanos) as f64 * 1e-9)
}

/// Frames of 253 cells that are pressed by 1.5 N each, while each joint swings to and fro.
fn simulated_run_frames(skin: &Skin, seconds: u32) -> Vec<LatchedFrame> {
    let central = CentralComputation::new(skin);
    let (hz, began) = (skin.timing.broadcast_hz(), 1_700_000_000_000_000_000_u64);
    let mut frames = Vec::new();
    let mut add_message = |at_nanos, own, message: &Message| {
        frames.extend(message.encode().frames(Format::Fd).map(|frame| LatchedFrame {
            at_nanos,
            from_gateway: own,
            frame,
        }));
    };
    let mut number = 0_u32;
    loop {
        let time = f64::from(number) / hz;
        if time >= f64::from(seconds) {
            return frames;
        }
        let at = began + u64::from(number) * 16_000_000;
        let epoch = Epoch(number.to_le_bytes()[0]);
        let swings = [(0.3, 0.0), (-1.2, 0.4), (1.0, 0.9), (-1.4, 1.3), (-1.57, 2.0), (0.2, 2.7)];
        let q: [f64; WORDS] = swings.map(|(middle, phase): (f64, f64)| middle + (time + phase).sin() * 0.4);
        let positions = q.map(|q| Q1_14::from_radians(q).unwrap_or_default());
        add_message(
            at,
            true,
            &Message::Joints {
                epoch,
                joints: Joints { positions: pad_with_defaults(&positions), in_use: 6 },
            },
        );
        let links = central.link_frames(&positions);
        for (place, cell) in skin.cells.iter().enumerate() {
            let torque = central.cell_torque(place, &links, 1.5).map(|nm| Q3_12::nearest(nm).to_bits());
            let torque = Words::new(Length::Six, torque);
            // Cells wake one after the other, in an order that varies by ns.
            let after = 150_000
                + place as u64 * 22_000
                + (u64::from(number) * 7_919 + place as u64 * 104_729) % 9_973;
            add_message(at + after, false, &Message::Torque { from: cell.node, epoch, torque });
        }
        number += 1;
    }
}

fn parse_log_frames(text: &str) -> Result<Vec<LatchedFrame>, Box<dyn Error>> {
    let mut frames = Vec::new();
    for line in text.lines() {
        if let CandumpLine::Frame(Record { time, frame, direction, .. }) = candump::parse(line)? {
            frames.push(LatchedFrame {
                at_nanos: time.nanos,
                from_gateway: direction == Some(Direction::Sent),
                frame,
            });
        }
    }
    Ok(frames)
}

/// Pushes frames into the recorder as fast as it accepts them.
#[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
fn measure_speed(
    skin: &Skin,
    folder: &std::path::Path,
    frames: &[LatchedFrame],
) -> Result<(), Box<dyn Error>> {
    let path = folder.join("recorder_speed.mcap");
    let split = SplitLimits { bytes: u64::MAX / 2, age: Duration::MAX };
    let mcap = McapOutput {
        path: path.clone(),
        split,
        attachments: Vec::new(),
        robot: None,
        command_line: Vec::new(),
    };
    let options = RecordOptions { mcap: Some(mcap), force: true, ..RecordOptions::default() };
    let outputs =
        RecordingOutputs::open_outputs(&options, &AtomicBool::new(false), |line| println!("{line}"))?;
    let (mut outlet, bus_feed) = feed::bus_feed(1, true, Arc::default(), Arc::default());
    let feed = RecorderFeed { bus_feeds: vec![bus_feed], ticks: None };
    let recorder = outputs.start(feed, Layout::new(skin), FileHead::default())?;
    let began = Instant::now();
    let mut count = 0_u64;
    'pushed: loop {
        for chunk in frames.chunks(1_024) {
            if began.elapsed() >= FRAME_PUSH_TIME {
                break 'pushed;
            }
            // A bus never waits; this loop does, so that it measures the sustainable rate.
            while outlet.free_frame_slots() < chunk.len() {
                std::thread::sleep(Duration::from_micros(200));
            }
            chunk.iter().for_each(|&seen| outlet.push_frame(seen));
            count += chunk.len() as u64;
        }
    }
    let unrecorded = outlet.unrecorded_counts();
    let recording = recorder.finish(unrecorded, 0);
    let took = began.elapsed().as_secs_f64();
    let bytes: u64 = recording.files.iter().map(|file| file.bytes).sum();
    println!(
        "recorder alone: {:.0} frames/s to disk, {} of {count} frames, {} lost, {:.2} us of processor time per frame, {:.1} bytes per frame",
        recording.frames as f64 / took,
        recording.frames,
        recording.lost,
        recording.processor_s / recording.frames as f64 * 1e6,
        bytes as f64 / recording.frames as f64,
    );
    std::fs::remove_file(path)?;
    Ok(())
}

/// A writer that counts bytes.
#[derive(Default)]
struct ByteCounter(u64);

impl Write for ByteCounter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0 += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Writes only frames, flushed as in a run.
#[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
fn measure_recording_size(frames: &[LatchedFrame]) -> Result<(), Box<dyn Error>> {
    let mut writer = FileWriter::new(ByteCounter::default())?;
    let mut channel = writer.channel::<Record<'_>>("/can/vcan0", &[("time_digits", "9")])?;
    let (mut flushes, mut next) = (0_u64, 0);
    let began = Instant::now();
    for &LatchedFrame { at_nanos, from_gateway: own, frame } in frames {
        if at_nanos >= next {
            writer.flush()?;
            next = at_nanos + FLUSH_INTERVAL_NS;
            flushes += 1;
        }
        let direction = Some(if own { Direction::Sent } else { Direction::Received });
        let time = Timestamp::with_nine_digits(at_nanos);
        let message = Record { time, interface: "vcan0", frame, direction };
        writer.write(&mut channel, at_nanos, &message)?;
    }
    writer.finish()?;
    let took = began.elapsed().as_secs_f64();
    let (count, bytes) = (frames.len() as f64, writer.into_inner().0);
    println!(
        "frames alone, flushed {flushes} times: {:.1} bytes per frame, {:.2} us per frame",
        bytes as f64 / count,
        took / count * 1e6,
    );
    Ok(())
}
