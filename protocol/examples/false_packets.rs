//! Measures how often frames of another protocol are mistaken for a packet because their CRC is correct by
//! chance.
//!
//! ```text
//!   cargo run --release -p protocol --example false_packets [MILLION_FRAMES]
//! ```
//!
//! Classic frames of random bytes, one per ms with one torque identifier, pass through reassembly twice: once with the
//! packet length of a known chain, once with all possible lengths.
#![expect(clippy::print_stdout, reason = "the figures are its output")]
#![expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]

use protocol::id::{Id, Kind};
use protocol::packet::{Length, Lengths, Reassembler, Reassembly};
use protocol::time::Micros;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Time between two frames, in µs.
const FRAME_INTERVAL_US: u64 = 1_000;

/// Prints the result for `frames` frames of `min` to 8 random bytes.
fn print_row(name: &str, lengths: Lengths, min: usize, frames: u64) {
    let mut dice = Pcg64Mcg::seed_from_u64(1);
    let id = Id { kind: Kind::Torque, node: 12 };
    let (mut segment, mut packets, mut ambiguous) = (Reassembler::NONE, 0_u64, 0_u64);
    for frame in 0..frames {
        let (bytes, len): ([u8; 8], usize) = (dice.random(), dice.random_range(min..=8));
        let data = bytes.get(..len).unwrap_or(&bytes);
        match segment.push(Micros(frame * FRAME_INTERVAL_US), id, lengths, data) {
            Ok(Reassembly::Complete(_)) => packets += 1,
            Ok(Reassembly::Ambiguous) => ambiguous += 1,
            Ok(Reassembly::Waiting | Reassembly::Incomplete) | Err(_) => {}
        }
    }
    let one_of = if packets == 0 { "-".to_owned() } else { format!("{:.0}", frames as f64 / packets as f64) };
    println!("{name:<14} {min} to 8 {packets:>8} {one_of:>9} {ambiguous:>9}");
}

fn main() {
    let million = protocol::usage::command_line()
        .into_iter()
        .nth(1)
        .and_then(|text| text.parse().ok())
        .unwrap_or(100_u64);
    let frames = million.saturating_mul(1_000_000);
    println!("{frames} frames\nlength          bytes  packets    one of ambiguous");
    let known = [
        ("6 words", Length::Six),
        ("8 words", Length::Eight),
        ("10 words", Length::Ten),
        ("14 words", Length::Fourteen),
    ];
    for min in [8, 0] {
        for (name, length) in known {
            print_row(name, Lengths::only(length), min, frames);
        }
        print_row("each is tried", Lengths::ALL, min, frames);
    }
}
