//! Time to compute the duration of a frame: `cargo bench -p protocol --bench frame_time`

use std::hint::black_box;
use std::time::Duration;

use criterion::{Criterion, Throughput};
use protocol::can::{BIT_RATE_SWITCH, Format, Frame};
use protocol::id::{CellId, Id, Kind, Node};
use protocol::packet::{Epoch, Packet};
use protocol::wire_time::FrameBits;

/// Returns the replies of cells 1 to 253 in one epoch.
fn reply_frames(format: Format) -> Vec<Frame> {
    let packets = CellId::all().take(253).map(|cell| {
        let word = i16::from(cell.get()).wrapping_mul(-0x3D4D);
        let words: [i16; 6] = std::array::from_fn(|at| word.rotate_left(u32::try_from(at).unwrap_or(0)));
        Packet {
            id: Id::new(Kind::Torque, Node::Cell(cell)),
            words: words.into(),
            epoch: Epoch(17),
            count: 1,
        }
    });
    packets.flat_map(|packet| packet.frames(format)).collect()
}

fn max_length_fd_frames() -> Vec<Frame> {
    let bytes: [u8; 64] = std::array::from_fn(|at| u8::try_from(at * 37 % 256).unwrap_or(0));
    (0..253).map(|id| Frame::fd(0x200 + id, BIT_RATE_SWITCH, &bytes).expect("64 bytes fit")).collect()
}

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(30)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(1))
        .configure_from_args();
    let mut group = criterion.benchmark_group("frame time");
    for (name, frames) in [
        ("FD, 16 bytes", reply_frames(Format::Fd)),
        ("FD, 64 bytes", max_length_fd_frames()),
        ("classic, 8 bytes", reply_frames(Format::Classic)),
    ] {
        assert!(
            frames
                .iter()
                .all(|frame| FrameBits::from_frame(frame).is_some_and(|bits| bits.total_bits() > 100)),
            "{name}"
        );
        group.throughput(Throughput::Elements(frames.len() as u64));
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                black_box(&frames)
                    .iter()
                    .filter_map(FrameBits::from_frame)
                    .map(FrameBits::total_bits)
                    .sum::<u32>()
            });
        });
    }
    group.finish();
    criterion.final_summary();
}
