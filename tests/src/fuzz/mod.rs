//! Fuzz targets: each takes any bytes, and panics if an invariant is broken. `tests/fuzz/run` searches with libFuzzer;
//! `tests/tests/fuzz_seeds.rs` runs the seeds of `tests/fuzz/seeds`, and variations of them, in every test run.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::missing_panics_doc,
    reason = "a target stops when something is wrong"
)]

mod cells;
mod clients;
mod files;
mod frames;

use arbitrary::{Result, Unstructured};
use protocol::can::{Format, Frame};
use protocol::id::Id;
use protocol::packet::{Epoch, Lengths, MAX_WORDS, Packet, Words};

/// A fuzz target: a function that takes any bytes, and panics if an invariant is broken.
pub type Target = fn(&[u8]);

/// All targets by name, which is also the folder of their seeds.
pub const TARGETS: &[(&str, Target)] = &[
    ("packet", frames::packet),
    ("reassembly", frames::reassembly),
    ("slcan", frames::slcan),
    ("hosts", frames::hosts),
    ("decoder", frames::decoder),
    ("shadow", frames::shadow),
    ("candump", files::candump),
    ("capture", files::capture),
    ("recover", files::recover),
    ("report", files::report),
    ("flash", files::flash),
    ("skin", files::skin),
    ("scenario", files::scenario),
    ("urdf", files::urdf),
    ("mesh", files::mesh),
    ("page", clients::page),
    ("controller", clients::controller),
    ("cell", cells::cell),
    ("tracker", cells::tracker),
    ("tree", cells::tree),
];

/// Returns any frame: mostly with an identifier of 11 bits, sometimes a whole packet with a correct CRC.
fn frame(from: &mut Unstructured<'_>) -> Result<Frame> {
    let kind = from.int_in_range(0..=15_u8)?;
    let format = if from.arbitrary()? { Format::Fd } else { Format::Classic };
    if kind < 10 {
        let packet = packet(from)?;
        let frames: Vec<_> = packet.frames(format).collect();
        return Ok(*from.choose(&frames)?);
    }
    let length = from.int_in_range(0..=format.max_len())?;
    let data = from.bytes(length)?;
    let id = if kind < 14 { u32::from(from.arbitrary::<u16>()? & 0x7FF) } else { from.arbitrary()? };
    let fallback = || Frame::classic(0x123, &[]).unwrap();
    let frame = if kind == 15 {
        Frame::remote(id, u8::try_from(length.min(8)).unwrap())
    } else {
        Frame::with_data(id, format, from.arbitrary()?, data)
    };
    Ok(frame.unwrap_or_else(|_| fallback()))
}

/// Returns any packet with a correct CRC.
fn packet(from: &mut Unstructured<'_>) -> Result<Packet> {
    let id = Id::from_bits(from.arbitrary::<u16>()? & 0x7FF);
    let lengths: Vec<_> = Lengths::for_id(id).iter().collect();
    let length = *from.choose(&lengths)?;
    let mut words = [0; MAX_WORDS];
    for word in words.iter_mut().take(length.words()) {
        *word = from.arbitrary()?;
    }
    let (epoch, count) = (Epoch(from.arbitrary()?), from.arbitrary()?);
    Ok(Packet { id, words: Words::new(length, words), epoch, count })
}
