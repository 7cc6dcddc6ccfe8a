//! Instruction counts of packets and frame times: `cargo bench -p protocol --bench instructions`
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
use protocol::can::{Format, Frame};
use protocol::id::{CellId, Id, Kind, Node};
use protocol::packet::{Epoch, Length, Lengths, Packet, Reassembler, Reassembly};
use protocol::time::Micros;
use protocol::wire_time::FrameBits;

mod counted;

/// Returns a torque packet of a cell.
fn packet() -> Packet {
    let cell = CellId::all().nth(11).expect("there are 254 cells");
    let words = [0x1234, -0x0102, 0x0055, -1, 0, 0x4000];
    Packet { id: Id::new(Kind::Torque, Node::Cell(cell)), words: words.into(), epoch: Epoch(200), count: 1 }
}

fn fd_frame() -> Frame {
    packet().frames(Format::Fd).next().expect("a packet has a frame")
}

fn classic_frames() -> [Frame; 2] {
    let mut frames = packet().frames(Format::Classic);
    [(); 2].map(|()| frames.next().expect("a packet has two classic frames"))
}

fn encode(packet: Packet, format: Format) -> [Option<Frame>; 2] {
    let mut frames = black_box(packet).frames(format);
    [frames.next(), frames.next()]
}

fn decode(frame: Frame) -> Packet {
    Packet::from_fd(black_box(&frame)).expect("a whole packet")
}

const SIX_WORDS: Lengths = Lengths::only(Length::Six);

fn reassemble(id: Id, frames: [Frame; 2]) -> Packet {
    let mut segment = Reassembler::NONE;
    let [first, second] = black_box(&frames);
    let waiting = segment.push(Micros(0), id, SIX_WORDS, first.data());
    match (waiting, segment.push(Micros(134), id, SIX_WORDS, second.data())) {
        (Ok(Reassembly::Waiting), Ok(Reassembly::Complete(packet))) => packet,
        paired => unreachable!("two segments of one packet: {paired:?}"),
    }
}

#[library_benchmark]
#[bench::fd(packet(), Format::Fd)]
#[bench::classic_pair(packet(), Format::Classic)]
fn encoded(packet: Packet, format: Format) -> [Option<Frame>; 2] {
    encode(packet, black_box(format))
}

#[library_benchmark]
#[bench::fd(fd_frame())]
fn decoded(frame: Frame) -> Packet {
    decode(frame)
}

#[library_benchmark]
#[bench::classic(packet().id, classic_frames())]
fn paired(id: Id, frames: [Frame; 2]) -> Packet {
    reassemble(id, frames)
}

#[library_benchmark]
#[bench::fd_16_bytes(fd_frame())]
#[bench::classic_8_bytes(classic_frames()[0])]
fn bits(frame: Frame) -> Option<FrameBits> {
    FrameBits::from_frame(black_box(&frame))
}

library_benchmark_group!(name = packets; benchmarks = encoded, decoded, paired);
library_benchmark_group!(name = frame_time; benchmarks = bits);

/// Runs each benchmark once and checks its result.
fn check_benchmarks() {
    let packet = packet();
    assert_eq!(encode(packet, Format::Fd), [Some(fd_frame()), None]);
    assert_eq!(decode(fd_frame()), packet);
    assert_eq!(encode(packet, Format::Classic), classic_frames().map(Some));
    assert_eq!(reassemble(packet.id, classic_frames()), packet);
    assert_ne!(FrameBits::from_frame(&fd_frame()), FrameBits::from_frame(&classic_frames()[0]));
}

mod all {
    use super::{frame_time, packets};

    gungraun::main!(library_benchmark_groups = packets, frame_time);

    pub(super) fn run() {
        main();
    }
}

fn main() {
    counted::main(check_benchmarks, all::run);
}
