//! A second implementation of the bit count that writes a frame bit by bit. The second program of `tests/src/bus_time`
//! includes this file, too: the module around it imports what it uses.

use super::{BIT_RATE_SWITCH, ERROR_STATE, Format, Frame};

/// Appends the `count` lowest bits of a word, the most significant first.
fn push(to: &mut Vec<bool>, word: u32, count: u32) {
    to.extend((0..count).rev().map(|place| (word >> place) & 1 == 1));
}

/// Computes CRC-15/CAN with the shift register of ISO 11898-1.
pub(crate) fn crc15(bits: &[bool]) -> u32 {
    bits.iter().fold(0, |register, &bit| {
        let feedback = bit != (register >> 14 & 1 == 1);
        let shifted = (register << 1) & 0x7FFF;
        if feedback { shifted ^ 0x4599 } else { shifted }
    })
}

/// Returns the positions of the stuff bits. A position is the number of plain bits before the stuff bit.
fn stuff_bits(bits: &[bool]) -> Vec<usize> {
    let (mut places, mut last, mut run) = (Vec::new(), None, 0);
    for (at, &bit) in bits.iter().enumerate() {
        run = if last == Some(bit) { run + 1 } else { 1 };
        last = Some(bit);
        if run == 5 {
            places.push(at + 1);
            (last, run) = (Some(!bit), 1);
        }
    }
    places
}

/// Counts the bits of a frame, including stuff bits and the intermission: those before the bit rate switch, those at the
/// data bit rate, and those after it. A frame without bit rate switch has all its bits before it.
pub(crate) fn bits(frame: &Frame) -> [u32; 3] {
    let mut plain = Vec::new();
    let (fd, id) = (frame.format() == Format::Fd, frame.id());
    let remote = u32::from(frame.is_remote());
    push(&mut plain, 0, 1);
    if frame.is_extended() {
        push(&mut plain, id >> 18, 11);
        push(&mut plain, 0b11, 2);
        push(&mut plain, id, 18);
    } else {
        push(&mut plain, id, 11);
    }
    let count = |bits: usize| u32::try_from(bits).unwrap();
    if fd {
        let lengths = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];
        let dlc = lengths.iter().position(|&length| length >= usize::from(frame.len())).unwrap();
        let switched = frame.flags() & BIT_RATE_SWITCH != 0;
        // RRS, and IDE where the identifier has 11 bits; FDF, res.
        push(&mut plain, 0, if frame.is_extended() { 1 } else { 2 });
        push(&mut plain, 0b10, 2);
        push(&mut plain, u32::from(switched), 1);
        let head = plain.len();
        push(&mut plain, u32::from(frame.flags() & ERROR_STATE != 0), 1);
        push(&mut plain, count(dlc), 4);
        for at in 0..lengths[dlc] {
            push(&mut plain, u32::from(*frame.data().get(at).unwrap_or(&0)), 8);
        }
        let places = stuff_bits(&plain);
        let early = places.iter().filter(|&&at| at < head).count();
        let late = places.iter().filter(|&&at| at >= head && at < plain.len()).count();
        // Stuff bit count, CRC, fixed stuff bits, delimiter.
        let check = if lengths[dlc] > 16 { 4 + 21 + 7 + 1 } else { 4 + 17 + 6 + 1 };
        // ACK, delimiter, end of frame, intermission.
        let [head, data, tail] = [head + early, plain.len() - head + late + check, 1 + 1 + 7 + 3].map(count);
        return if switched { [head, data, tail] } else { [head + data + tail, 0, 0] };
    }
    push(&mut plain, remote, 1);
    push(&mut plain, 0, 2);
    push(&mut plain, u32::from(frame.raw_dlc().max(frame.len())), 4);
    for &byte in frame.data() {
        push(&mut plain, u32::from(byte), 8);
    }
    let crc = crc15(&plain);
    push(&mut plain, crc, 15);
    // Delimiter, ACK, delimiter, end of frame, intermission.
    let bits = plain.len() + stuff_bits(&plain).len() + 1 + 1 + 1 + 7 + 3;
    [count(bits), 0, 0]
}
