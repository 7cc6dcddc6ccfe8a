//! Writes a long capture in virtual time, to measure the reading of captures.
//!
//! ```sh
//! cargo run --release -p gateway --example long_capture -- OUT.mcap [SECONDS [PERCENT]]
//! ```
//!
//! 253 cells on one CAN FD bus receive joints 62.5 times a second. PERCENT of them (default: 5) are pressed, each for
//! about ten seconds, and answer. All send their heartbeats. The default duration is an hour.
#![expect(clippy::print_stdout, reason = "the counts are its output")]

use std::collections::BTreeMap;
use std::error::Error;
use std::fs::File;
use std::io::{BufWriter, Write};

use model::central::CentralComputation;
use protocol::can::Format;
use protocol::candump::{Direction, Record, Timestamp};
use protocol::fixed::{Q1_14, Q3_12, Q5_10};
use protocol::id::Node;
use protocol::message::{
    Heartbeat, Joints, Message, NetworkPage, SensorPage, SkinSensors, State, StimulusStart,
};
use protocol::packet::{Epoch, Length, WORDS, Words, pad_with_defaults};
use protocol::skin::Skin;
use trace::capture::{RUN_METADATA, SKIN_ATTACHMENT, run_metadata};
use trace::recording::file::{Channel, FileWriter};

const SKIN_TOML: &str = include_str!("ur5-253.toml");
const BUS: &str = "vcan0";
const BEGAN_NS: u64 = 1_700_000_000_000_000_000;
const PERIOD_NS: u64 = 16_000_000;
/// Number of epochs between two heartbeats of a cell: 256 ms.
const HEARTBEAT_EPOCHS: u64 = 16;
/// Number of epochs for which a cell is pressed.
const TOUCH_EPOCHS: u64 = 625;
/// Force of a touch in N.
const FORCE_N: f64 = 1.5;

/// A bus whose frames are written to a recording.
struct RecordedBus<W: Write> {
    writer: FileWriter<W>,
    channel: Channel,
    frames: u64,
}

impl<W: Write> RecordedBus<W> {
    fn send(&mut self, at_ns: u64, direction: Direction, message: &Message) -> std::io::Result<()> {
        for frame in message.encode().frames(Format::Fd) {
            let time = Timestamp::with_nine_digits(at_ns);
            let record = Record { time, interface: BUS, frame, direction: Some(direction) };
            self.writer.write(&mut self.channel, at_ns, &record)?;
            self.frames += 1;
        }
        Ok(())
    }
}

#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    reason = "few epochs, and counters modulo their range"
)]
fn main() -> Result<(), Box<dyn Error>> {
    let mut words = protocol::usage::command_line().into_iter().skip(1);
    let out = words.next().ok_or("name the recording: long_capture OUT.mcap [SECONDS [PERCENT]]")?;
    let seconds: u64 = words.next().map_or(Ok(3_600), |word| word.parse())?;
    let percent: u64 = words.next().map_or(Ok(5), |word| word.parse())?;
    let skin = Skin::parse("ur5-253.toml", SKIN_TOML)?;
    let central = CentralComputation::new(&skin);
    let mut writer = FileWriter::new(BufWriter::with_capacity(1 << 20, File::create(&out)?))?;
    writer.attach(SKIN_ATTACHMENT, "application/toml", BEGAN_NS, SKIN_TOML.as_bytes())?;
    writer.write_metadata(RUN_METADATA, &run_metadata(BEGAN_NS))?;
    writer.write_metadata("part", &BTreeMap::from([("number".to_owned(), "0".to_owned())]))?;
    let channel = writer.channel::<Record<'_>>(&format!("/can/{BUS}"), &[("time_digits", "9")])?;
    let mut bus = RecordedBus { writer, channel, frames: 0 };

    let cells = skin.cells.len() as u64;
    let pressed = (cells * percent).div_ceil(100).max(1);
    // Each pressed cell is followed by the one a stride further, so that all cells have their turn.
    let is_pressed = |cell: u64, epoch: u64| {
        let from = (epoch / TOUCH_EPOCHS * pressed) % cells;
        epoch > 0 && (cell + cells - from) % cells < pressed
    };
    let hashes: Vec<_> = skin.cells.iter().map(|cell| skin.parameters(cell).hash()).collect();
    let epochs = seconds * 1_000_000_000 / PERIOD_NS;
    for number in 0..epochs {
        let (at, epoch) = (BEGAN_NS + number * PERIOD_NS, Epoch(number as u8));
        let time = number as f64 * PERIOD_NS as f64 / 1e9;
        for (place, (cell, hash)) in (0..).zip(skin.cells.iter().zip(&hashes)) {
            if number == 0 || (number + place) % HEARTBEAT_EPOCHS == 0 {
                let state = State::CONFIGURED.with_flags(State::TEST_MODE, true).with_joint(cell.joint);
                let sent = (number / HEARTBEAT_EPOCHS) as u16;
                let page = NetworkPage::Heartbeat(Heartbeat {
                    serial: cell.serial,
                    configuration: *hash,
                    sent,
                    rejected: 0,
                    state,
                });
                let beat = Message::Network { from: Node::Cell(cell.node), epoch, page };
                bus.send(at - 9_000_000 + place * 20_000, Direction::Received, &beat)?;
            }
        }
        for (place, cell) in (0..).zip(&skin.cells) {
            if number > 0 && is_pressed(place, number) != is_pressed(place, number - 1) {
                let force = if is_pressed(place, number) { FORCE_N } else { 0.0 };
                let contact = [Q5_10::nearest(force / 3.0); 3];
                let page = SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() });
                let from = StimulusStart::Epoch(epoch);
                let stimulus = Message::Stimulus { to: Node::Cell(cell.node), from, page };
                bus.send(at - 3_000_000 + place * 1_000, Direction::Sent, &stimulus)?;
            }
        }
        let swings = [(0.3, 0.0), (-1.2, 0.4), (1.0, 0.9), (-1.4, 1.3), (-1.57, 2.0), (0.2, 2.7)];
        let angles: [f64; WORDS] =
            swings.map(|(middle, phase): (f64, f64)| middle + (time + phase).sin() * 0.4);
        let positions = angles.map(|angle| Q1_14::from_radians(angle).unwrap_or_default());
        let joints = Joints { positions: pad_with_defaults(&positions), in_use: 6 };
        bus.send(at, Direction::Sent, &Message::Joints { epoch, joints })?;
        let links = central.link_frames(&joints.positions);
        let mut answers = 0;
        for (place, cell) in skin.cells.iter().enumerate() {
            if is_pressed(place as u64, number) {
                let torque = central.cell_torque(place, &links, FORCE_N);
                let torque = Words::new(Length::Six, torque.map(|value| Q3_12::nearest(value).to_bits()));
                answers += 1;
                let reply = Message::Torque { from: cell.node, epoch, torque };
                bus.send(at + 150_000 + answers * 22_000, Direction::Received, &reply)?;
            }
        }
    }
    bus.writer.finish()?;
    println!("{epochs} epochs, {} frames", bus.frames);
    Ok(())
}
