//! The CAN controller FDCAN1 and its message RAM.
//!
//! ```text
//!   4000A400 + 000  28 standard filters, a word each       + 0B0  FIFO 0: 3 elements of 18 words
//!              070  8 extended filters, two words each       278  buffers to send: 3 elements of 18 words
//! ```

use protocol::can::{self, Format, Frame};

use super::{change, frame_of, read, wait, write};

const FDCAN: usize = 0x4000_6400;
const DBTP: usize = FDCAN + 0x0C;
const CCCR: usize = FDCAN + 0x18;
const NBTP: usize = FDCAN + 0x1C;
const PSR: usize = FDCAN + 0x44;
const TDCR: usize = FDCAN + 0x48;
const IR: usize = FDCAN + 0x50;
const IE: usize = FDCAN + 0x54;
const ILE: usize = FDCAN + 0x5C;
const RXGFC: usize = FDCAN + 0x80;
const RXF0S: usize = FDCAN + 0x90;
const RXF0A: usize = FDCAN + 0x94;
const TXBC: usize = FDCAN + 0xC0;
const TXFQS: usize = FDCAN + 0xC4;
const TXBAR: usize = FDCAN + 0xCC;

const RAM: usize = 0x4000_A400;
const EXTENDED_FILTERS: usize = RAM + 0x70;
const FIFO_0: usize = RAM + 0xB0;
const TO_SEND: usize = RAM + 0x278;
/// Size in bytes of an element of the message RAM: two words and the data.
const ELEMENT: usize = 72;
/// Number of standard filters, and of extended ones.
const STANDARD_FILTERS: usize = 28;
const EXTENDED: usize = 8;

/// Bits of the register `CCCR`.
const INIT: u32 = 1;
const CONFIGURE: u32 = 1 << 1;
const FD: u32 = 1 << 8 | 1 << 9; // FD frames, bit rate switch
/// Bit of the register `IR`: a frame is in FIFO 0.
const RECEIVED: u32 = 1;
/// Bit of the register `PSR`: the controller is bus off.
const BUS_OFF: u32 = 1 << 7;

/// Joins the bus. No frames are received until filters are set.
pub(super) fn open(format: Format) {
    change(CCCR, 0, INIT);
    wait(CCCR, INIT, INIT);
    change(CCCR, 0, CONFIGURE);
    // 1 Mbit/s from 80 MHz: 80 quanta, 1 + 63 before the sample point, 16 after it; the jump width is 16.
    write(NBTP, 15 << 25 | 62 << 8 | 15);
    // 5 Mbit/s: 16 quanta, 1 + 11 and 4. The transceiver's delay is measured, and the sample point is 12
    // quanta after it.
    write(DBTP, 1 << 23 | 10 << 8 | 3 << 4 | 3);
    write(TDCR, 12 << 8);
    change(CCCR, FD, if format == Format::Fd { FD } else { 0 });
    write(TXBC, 0); // first in, first out: keeps the order of a cell's frames
    // Reject frames that pass no filter.
    write(RXGFC, 8 << 24 | 28 << 16 | 2 << 4 | 2 << 2);
    filter(core::iter::empty(), core::iter::empty());
    write(IE, RECEIVED);
    write(ILE, 1);
    change(CCCR, INIT, 0);
}

/// Sets filters that pass these identifiers to FIFO 0: `standard` of 11 bits, `extended` of 29 bits. There are enough
/// filters for all identifiers that a cell receives. An element of zeros is a disabled filter, so this function can be
/// called while the controller is on the bus.
pub(super) fn filter(standard: impl Iterator<Item = u32>, extended: impl Iterator<Item = u32>) {
    // A dual filter with two equal identifiers, to FIFO 0.
    let mut standard = standard.map(|id| 1 << 30 | 1 << 27 | id << 16 | id);
    for index in 0..STANDARD_FILTERS {
        write(RAM + 4 * index, standard.next().unwrap_or(0));
    }
    let mut extended = extended.map(|id| [1 << 29 | id, 1 << 30 | id]);
    for index in 0..EXTENDED {
        let [first, second] = extended.next().unwrap_or([0; 2]);
        write(EXTENDED_FILTERS + 8 * index, first);
        write(EXTENDED_FILTERS + 8 * index + 4, second);
    }
}

/// Clears the interrupt flag for received frames.
pub(super) fn acknowledge() {
    write(IR, RECEIVED);
}

/// Returns true if FIFO 0 is empty.
pub(super) fn is_empty() -> bool {
    read(RXF0S) & 15 == 0
}

/// Returns the next frame in FIFO 0; `None` if there is none.
pub(super) fn receive() -> Option<Frame> {
    // After too many errors the controller leaves the bus; this makes it rejoin after 129 idle phases.
    if read(PSR) & BUS_OFF != 0 {
        change(CCCR, INIT, 0);
    }
    while !is_empty() {
        let index = read(RXF0S) >> 8 & 3;
        let element = FIFO_0 + ELEMENT * index as usize;
        let head = [read(element), read(element + 4)];
        let mut data = [0; 64];
        for (place, bytes) in data.as_chunks_mut().0.iter_mut().enumerate() {
            *bytes = read(element + 8 + 4 * place).to_le_bytes();
        }
        let dlc = (head[1] >> 16 & 15).to_le_bytes()[0];
        if let Some(behind) = data.get_mut(can::dlc_len(dlc)..) {
            behind.fill(0);
        }
        write(RXF0A, index);
        if let Some(frame) = frame_of(head, &data) {
            return Some(frame);
        }
    }
    None
}

/// Passes a frame to the controller. Returns false if all transmit buffers are in use.
pub(super) fn send(frame: &Frame) -> bool {
    let state = read(TXFQS);
    if state & 1 << 21 != 0 {
        return false;
    }
    let index = state >> 16 & 3;
    let element = TO_SEND + ELEMENT * index as usize;
    let id = if frame.is_extended() { frame.id() | 1 << 30 } else { frame.id() << 18 };
    let remote = if frame.is_remote() { 1 << 29 } else { 0 };
    let flags = match frame.format() {
        Format::Classic => 0,
        Format::Fd if frame.flags() & can::BIT_RATE_SWITCH != 0 => 1 << 21 | 1 << 20,
        Format::Fd => 1 << 21,
    };
    write(element, id | remote);
    write(element + 4, flags | u32::from(can::fd_dlc(frame.len().into())) << 16);
    // Pad with zeros to a length that CAN FD has.
    let mut data = [0; 64];
    data.iter_mut().zip(frame.data()).for_each(|(byte, value)| *byte = *value);
    for (place, bytes) in data.as_chunks().0.iter().enumerate() {
        write(element + 8 + 4 * place, u32::from_le_bytes(*bytes));
    }
    write(TXBAR, 1 << index);
    true
}
