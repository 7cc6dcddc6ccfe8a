//! Instruction counts of the gateway's receiver and of latched packets: `cargo bench -p model --bench instructions`
//!
//! Valgrind counts them, so the results do not depend on the load of the machine.
//! `docs/explanation/benchmarks.md` lists the required programs.

#![expect(
    missing_docs,
    unused_qualifications,
    clippy::disallowed_methods,
    reason = "gungraun's macros write them"
)]

use std::hint::black_box;

use gungraun::{library_benchmark, library_benchmark_group};
use model::generate::{SkinRequest, generate};
use model::latched::{LatchedFrame, LatchedPackets};
use model::table::BusTable;
use protocol::can::Format;
use protocol::fixed::{Q1_14, Q3_12, Q5_10};
use protocol::id::{CellId, Node};
use protocol::message::{
    Answer, Heartbeat, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, State, StimulusStart,
};
use protocol::packet::{self, Epoch, WORDS, pad_with_defaults};
use protocol::parameters::Parameter;
use protocol::skin::Skin;
use protocol::time::Micros;

#[path = "../../../protocol/benches/counted/mod.rs"]
mod counted;

const CELLS: usize = 253;
/// Time of the first epoch in ns since 1970.
const FIRST_EPOCH_NANOS: u64 = 1_700_000_000_000_000_000;
/// Time between two epochs, in ns.
const EPOCH_NANOS: u64 = 16_000_000;

/// The frames of one epoch, by its number.
type EpochFramesFn = fn(u8, Format) -> Vec<LatchedFrame>;

fn skin(format: Format) -> Skin {
    let text = generate(&SkinRequest { cells: CELLS, ..SkinRequest::default() }).expect("a UR5 has room");
    let mut skin = Skin::parse("skin.toml", &text).expect("a generated skin is sound");
    skin.buses.iter_mut().for_each(|bus| bus.format = format);
    skin
}

/// Returns a value that is never dropped, so that no count includes its drop.
fn leak_value<T>(value: T) -> &'static mut T {
    Box::leak(Box::new(value))
}

/// Returns the frames of messages in an epoch, 22 us apart: first those of the gateway, then those of cells.
fn message_frames(
    number: u8,
    format: Format,
    from_gateway: &[Message],
    others: impl Iterator<Item = Message>,
) -> Vec<LatchedFrame> {
    let messages =
        from_gateway.iter().map(|message| (true, *message)).chain(others.map(|message| (false, message)));
    let frames = messages.flat_map(|(from_gateway, message)| {
        message.encode().frames(format).map(move |it| (from_gateway, it))
    });
    let began = FIRST_EPOCH_NANOS + u64::from(number) * EPOCH_NANOS;
    let received = |(at, (from_gateway, frame)): (u64, _)| LatchedFrame {
        at_nanos: began + at * 22_000,
        from_gateway,
        frame,
    };
    (0..).zip(frames).map(received).collect()
}

fn cells() -> impl Iterator<Item = CellId> {
    CellId::all().take(CELLS)
}

/// Returns the joints and the torques of an epoch.
fn torques(number: u8, format: Format) -> Vec<LatchedFrame> {
    let epoch = Epoch(number);
    let positions = pad_with_defaults(&[0.3, -1.2, 1.0, -1.4, -0.6, 0.2_f64].map(Q1_14::nearest));
    let joints = Message::Joints { epoch, joints: Joints { positions, in_use: 6 } };
    let words: [i16; WORDS] = [0.1, -0.2, 0.3, 0.05, 0.01, 0.0].map(|nm| Q3_12::nearest(nm).to_bits());
    let torque = |from| Message::Torque { from, epoch, torque: words.into() };
    message_frames(number, format, &[joints], cells().map(torque))
}

/// Returns a heartbeat of each cell.
fn heartbeats(number: u8, format: Format) -> Vec<LatchedFrame> {
    let state = State::CONFIGURED.with_flags(State::TEST_MODE, true).with_flags(State::ACTIVE, true);
    let heartbeat = |cell: CellId| {
        let serial = u32::from(cell.get());
        let heartbeat = Heartbeat { serial, sent: number.into(), state, ..Heartbeat::default() };
        let page = NetworkPage::Heartbeat(heartbeat);
        Message::Network { from: Node::Cell(cell), epoch: Epoch(number), page }
    };
    message_frames(number, format, &[], cells().map(heartbeat))
}

/// Returns the stimulus that presses all cells, after the write of the mode that each of them confirms.
fn presses(number: u8, format: Format) -> Vec<LatchedFrame> {
    let (mode, words) = (Parameter::Mode.number(), packet::padded_words([1]));
    let request = Request::Write { number: mode, words };
    let write = Message::Configure { to: Node::Everyone, tag: 0, request };
    let answer = Answer::Value { number: mode, written: true, words };
    let confirmed = cells().map(|from| Message::Configured { from, tag: 0, answer });
    let contact = [Q5_10::nearest(0.5); 3];
    let skin = SkinSensors { contact, proximity: Q1_14::nearest(0.9), ..SkinSensors::default() };
    let page = SensorPage::Skin(skin);
    let press = Message::Stimulus { to: Node::Everyone, from: StimulusStart::Next, page };
    let press = message_frames(number, format, &[press], std::iter::empty());
    [message_frames(number, format, &[write], confirmed), press].concat()
}

/// Returns an epoch of pressed cells.
fn pressed_epoch_frames(format: Format) -> Vec<LatchedFrame> {
    [heartbeats(0, format), presses(1, format), torques(2, format)].concat()
}

/// A table that has received an epoch, and the next frames of its bus.
struct Receiver {
    table: BusTable,
    next: Vec<LatchedFrame>,
}

impl Receiver {
    fn new(format: Format, comparing: bool, next: EpochFramesFn) -> &'static mut Self {
        let mut table = BusTable::new(&skin(format), 0);
        table.set_torque_comparison(comparing);
        receive(&mut table, &pressed_epoch_frames(format));
        leak_value(Self { table, next: next(3, format) })
    }

    /// Receives the next frames, and returns the number of cells that contribute to the sum.
    fn contributing_after_next(&mut self) -> u32 {
        receive(&mut self.table, &self.next);
        self.table.snapshot().sums.contributing
    }
}

fn receive(table: &mut BusTable, frames: &[LatchedFrame]) {
    for LatchedFrame { at_nanos, from_gateway, frame } in black_box(frames) {
        table.handle_frame(Micros(at_nanos / 1_000), *from_gateway, frame, &mut |_| None);
    }
}

#[library_benchmark]
#[bench::fd(Receiver::new(Format::Fd, false, torques))]
#[bench::classic(Receiver::new(Format::Classic, false, torques))]
#[bench::fd_compared(Receiver::new(Format::Fd, true, torques))]
#[bench::classic_compared(Receiver::new(Format::Classic, true, torques))]
#[bench::fd_heartbeats(Receiver::new(Format::Fd, false, heartbeats))]
#[bench::classic_heartbeats(Receiver::new(Format::Classic, false, heartbeats))]
fn table(receiver: &mut Receiver) -> u32 {
    receiver.contributing_after_next()
}

/// The latched packets of an epoch, and the next frames of their bus.
struct Latching {
    latched: LatchedPackets,
    next: Vec<LatchedFrame>,
}

impl Latching {
    fn new(format: Format, next: EpochFramesFn) -> &'static mut Self {
        let mut latched = LatchedPackets::default();
        pressed_epoch_frames(format).iter().for_each(|&frame| latched.receive(frame));
        leak_value(Self { latched, next: next(3, format) })
    }

    /// Latches the next frames, and returns true if the last of them is not the end of a packet.
    fn is_within_a_packet_after_next(&mut self) -> bool {
        black_box(&self.next).iter().for_each(|&frame| self.latched.receive(frame));
        self.latched.is_within_a_packet(FIRST_EPOCH_NANOS)
    }
}

#[library_benchmark]
#[bench::fd_torques(Latching::new(Format::Fd, torques))]
#[bench::classic_torques(Latching::new(Format::Classic, torques))]
#[bench::fd_heartbeats(Latching::new(Format::Fd, heartbeats))]
#[bench::classic_heartbeats(Latching::new(Format::Classic, heartbeats))]
#[bench::fd_presses(Latching::new(Format::Fd, presses))]
#[bench::classic_presses(Latching::new(Format::Classic, presses))]
fn latch(latching: &mut Latching) -> bool {
    latching.is_within_a_packet_after_next()
}

library_benchmark_group!(name = received; benchmarks = table, latch);

/// Runs each benchmark once and checks its result.
fn check_benchmarks() {
    for format in [Format::Fd, Format::Classic] {
        for next in [torques, heartbeats] {
            assert_eq!(Receiver::new(format, true, next).contributing_after_next(), 253);
        }
        for next in [torques, heartbeats, presses] {
            let latching = Latching::new(format, next);
            assert!(!latching.is_within_a_packet_after_next(), "all packets are whole");
            assert!(latching.latched.frames().len() > 2 * CELLS, "each cell's heartbeat and mode");
        }
    }
}

mod all {
    use super::received;

    gungraun::main!(library_benchmark_groups = received);

    pub(super) fn run() {
        main();
    }
}

fn main() {
    counted::main(check_benchmarks, all::run);
}
