//! Damage to any byte, and along the structure of a file.

use std::io::Write;

use mcap::records::op;
use rand::{Rng, RngExt};

/// Extreme values for lengths, times and counts.
const EXTREMES: [u64; 14] = [
    0,
    1,
    u64::MAX,
    u64::MAX - 8,
    1 << 63,
    (1 << 63) - 1,
    1 << 32,
    u32::MAX as u64,
    i32::MAX as u64,
    1 << 31,
    1 << 30,
    1 << 16,
    255,
    18_446_744_073_709_551_000,
];

/// Builds a record: operation code, length, bytes.
pub(crate) fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

/// Builds bytes preceded by their length.
pub(crate) fn string(text: &[u8]) -> Vec<u8> {
    [&u32::try_from(text.len()).unwrap().to_le_bytes()[..], text].concat()
}

/// Builds a chunk of these records with correct checksum and lengths.
pub(crate) fn chunk(compression: &str, records: &[u8]) -> Vec<u8> {
    let packed = match compression {
        "zstd" => zstd::bulk::compress(records, 1).unwrap(),
        "lz4" => {
            let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
            encoder.write_all(records).unwrap();
            encoder.finish().0
        }
        _ => records.to_vec(),
    };
    let numbers = [0, 0, records.len() as u64].map(u64::to_le_bytes).concat();
    let checksum = crc32fast::hash(records).to_le_bytes();
    let packed = [&(packed.len() as u64).to_le_bytes()[..], &packed].concat();
    record(op::CHUNK, &[&numbers[..], &checksum, &string(compression.as_bytes()), &packed].concat())
}

/// Splits bytes into records; drops an incomplete last one.
pub(crate) fn records(mut bytes: &[u8]) -> Vec<(u8, Vec<u8>)> {
    let mut found = Vec::new();
    while let Some((&[opcode, ref length @ ..], rest)) = bytes.split_first_chunk::<9>() {
        let Some((body, rest)) = rest.split_at_checked(usize::try_from(u64::from_le_bytes(*length)).unwrap())
        else {
            break;
        };
        found.push((opcode, body.to_vec()));
        bytes = rest;
    }
    found
}

/// Unpacked content of a chunk of an intact file.
pub(crate) fn unpacked(body: &[u8]) -> Vec<u8> {
    let number =
        |at: usize| usize::try_from(u64::from_le_bytes(body[at..at + 8].try_into().unwrap())).unwrap();
    let name = usize::try_from(u32::from_le_bytes(body[28..32].try_into().unwrap())).unwrap();
    let packed = &body[40 + name..];
    match &body[32..32 + name] {
        b"zstd" => zstd::bulk::decompress(packed, number(16)).unwrap(),
        b"lz4" => {
            let mut out = Vec::new();
            std::io::copy(&mut lz4::Decoder::new(packed).unwrap(), &mut out).unwrap();
            out
        }
        _ => packed.to_vec(),
    }
}

fn at(chance: &mut impl Rng, length: usize) -> usize {
    chance.random_range(0..length.max(1))
}

fn extreme(chance: &mut impl Rng) -> u64 {
    EXTREMES[at(chance, EXTREMES.len())]
}

/// Damages some bytes in place: bits, or a number that becomes an extreme one.
fn damage(bytes: &mut [u8], chance: &mut impl Rng) -> &'static str {
    if bytes.is_empty() {
        return "nothing";
    }
    let place = at(chance, bytes.len());
    let length = bytes.len();
    match chance.random_range(0..4) {
        0 => {
            for _ in 0..chance.random_range(1..5) {
                bytes[at(chance, length)] ^= 1 << chance.random_range(0..8);
            }
            "bits"
        }
        1 => {
            let number = extreme(chance).to_le_bytes();
            bytes[place..].iter_mut().zip(number).for_each(|(to, from)| *to = from);
            "a number of 8 bytes"
        }
        2 => {
            let number = extreme(chance).to_le_bytes();
            bytes[place..].iter_mut().zip(&number[..4]).for_each(|(to, from)| *to = *from);
            "a number of 4 bytes"
        }
        _ => {
            let end = (place + chance.random_range(1..40)).min(length);
            bytes[place..end].iter_mut().for_each(|byte| *byte = chance.random());
            "some bytes"
        }
    }
}

/// A damaged file, with a description of the damage.
pub(crate) fn mutated(seed: &[u8], chance: &mut impl Rng) -> (String, Vec<u8>) {
    let mut file = seed.to_vec();
    let how = match chance.random_range(0..10) {
        0 => {
            file.truncate(at(chance, seed.len()));
            "torn"
        }
        1 | 2 => damage(&mut file, chance),
        3 => {
            let end = file.len();
            wrong_length(&mut file, 8, end, chance);
            "a record's length"
        }
        kind => {
            let mut all = records(&seed[8..]);
            let places = |all: &[(u8, Vec<u8>)], target: Option<u8>| -> Vec<usize> {
                let of = all.iter().enumerate();
                of.filter(|(_, (code, _))| target.is_none_or(|target| target == *code))
                    .map(|(at, _)| at)
                    .collect()
            };
            let how = match kind {
                4 => {
                    let place = at(chance, all.len());
                    damage(&mut all[place].1, chance);
                    "a record"
                }
                5 => {
                    let (from, to) = (at(chance, all.len()), at(chance, all.len()));
                    let taken = all.remove(from);
                    if chance.random() {
                        all.insert(to.min(all.len()), taken.clone());
                    }
                    if chance.random() {
                        all.insert(to.min(all.len()), taken);
                    }
                    "records in another order"
                }
                _ => {
                    let chunks = places(&all, Some(op::CHUNK));
                    let chunks = if chunks.is_empty() { places(&all, Some(op::MESSAGE)) } else { chunks };
                    let chosen = chunks[at(chance, chunks.len())];
                    let (code, body) = &mut all[chosen];
                    if *code == op::CHUNK {
                        let mut inside = unpacked(body);
                        inside_out(&mut inside, chance);
                        let compression = ["", "zstd", "lz4"][at(chance, 3)];
                        *body = chunk(compression, &inside)[9..].to_vec();
                    } else {
                        damage(body, chance);
                    }
                    "what is in a chunk, with the right checksum"
                }
            };
            file = seed[..8].to_vec();
            for (code, mut body) in all {
                if code == op::DATA_END {
                    // A checksum of 0 means none, so that the reader continues after the damage.
                    body.fill(0);
                }
                file.extend(record(code, &body));
            }
            if chance.random() {
                file.extend(mcap::MAGIC);
            }
            how
        }
    };
    (how.to_owned(), file)
}

/// Changes the length of one of the records from a place on, often the last one's.
fn wrong_length(bytes: &mut [u8], from: usize, to: usize, chance: &mut impl Rng) {
    let heads = records(&bytes[from..to]).into_iter().scan(from, |place, (_, body)| {
        let head = *place;
        *place += 9 + body.len();
        Some(head)
    });
    let heads: Vec<_> = heads.collect();
    let chosen = if chance.random() { at(chance, heads.len()) } else { heads.len() - 1 };
    let head = heads[chosen] + 1;
    let length = u64::from_le_bytes(bytes[head..head + 8].try_into().unwrap());
    let wrong = match chance.random_range(0..3) {
        0 => length.wrapping_add(chance.random_range(1..200)),
        1 => length.wrapping_sub(chance.random_range(1..20)),
        _ => extreme(chance),
    };
    bytes[head..head + 8].copy_from_slice(&wrong.to_le_bytes());
}

/// Damages the content of a chunk: one of its records, usually without affecting the others.
fn inside_out(inside: &mut Vec<u8>, chance: &mut impl Rng) {
    let end = inside.len();
    match chance.random_range(0..5) {
        0 => {
            damage(inside, chance);
            return;
        }
        1 | 2 => return wrong_length(inside, 0, end, chance),
        _ => {}
    }
    let mut all = records(inside);
    for _ in 0..chance.random_range(1..4) {
        let place = at(chance, all.len());
        let (code, body) = &mut all[place];
        if *code == op::MESSAGE && chance.random() {
            // Time of the record.
            let number = extreme(chance).to_le_bytes();
            let field = [6, 14, 26][at(chance, 3)];
            body[field..].iter_mut().zip(number).for_each(|(to, from)| *to = from);
        } else {
            damage(body, chance);
        }
    }
    *inside = all.iter().flat_map(|(code, body)| record(*code, body)).collect();
}
