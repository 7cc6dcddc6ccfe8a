//! The time that a frame takes on a real bus: its bits with their stuff bits, at two bit rates.
//!
//! ```text
//!   classic  SOF id RTR IDE r0 DLC data CRC15 | del ACK del EOF7 int3      34 + 8n stuffed | 13     11-bit identifier
//!            SOF id SRR IDE id RTR r1 r0 DLC data CRC15 | ..               54 + 8n         | 13     29-bit
//!
//!            nominal bit rate                  data bit rate                     nominal
//!   FD       SOF id RRS IDE FDF res BRS      | ESI DLC data | SBC4 CRC fsb del | ACK del EOF7 int3
//!            17 (29-bit: 36), stuffed        | 5 + 8n, st.  | 28, n > 16: 33   | 12
//! ```
//!
//! The rules are those of ISO 11898-1. A stuff bit follows five equal bits and is counted at the rate of the
//! bit after it. In classic CAN, stuffing covers SOF to the last bit of the CRC. In CAN FD it covers SOF to
//! the last bit of the data; a run of five there makes the first of the *fixed* stuff bits (fsb: 6 of them,
//! or 7 with the longer CRC) and not an additional one. BRS is counted as nominal and the CRC delimiter as
//! data: the rate switches within each of them, and together they take one bit of each rate for every sample
//! point. The intermission (int3) is counted, because no node can send earlier.

mod extremes;
mod rates;
mod stuffing;

pub use extremes::{FrameCoding, FrameShape};
pub use rates::{BitRates, BitRatesError, parse_bit_rate};

use crate::can::{BIT_RATE_SWITCH, ERROR_STATE, Format, Frame, fd_dlc};
use stuffing::BitRun;

/// CRC-15/CAN: polynomial 0x4599, initial value 0. Because of the initial value, leading zeros do not change the CRC.
const CRC: crc::Crc<u16> = crc::Crc::<u16>::new(&crc::CRC_15_CAN);

/// Number of bits at the end of a classic frame that are not stuffed: delimiters, ACK, end of frame, intermission.
const CLASSIC_TAIL_BITS: u32 = 13;
/// Number of nominal bits at the end of an FD frame: ACK, ACK delimiter, end of frame, intermission.
const FD_TAIL_BITS: u32 = 12;
/// Number of bits between data and ACK of an FD frame with up to 16 bytes: stuff bit count, CRC of 17 bits, 6 fixed
/// stuff bits, CRC delimiter.
const FD_CRC_BITS: u32 = 28;
/// Number of bits between data and ACK of an FD frame with more than 16 bytes, with a CRC of 21 bits and 7 fixed stuff
/// bits.
const FD_LONG_CRC_BITS: u32 = 33;

/// The number of bits of a frame on the wire, including stuff bits and intermission.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, PartialEq)]
pub struct FrameBits {
    /// Number of bits at the nominal bit rate. In a frame without bit rate switch, this is all bits.
    pub nominal: u32,
    /// Number of bits at the data bit rate.
    pub data: u32,
}

impl FrameBits {
    /// Counts the bits of a frame. Returns `None` for an error frame of the driver, which was never on the
    /// wire.
    ///
    /// Data of a length that CAN FD does not allow is padded with zeros to the next length.
    #[must_use]
    pub fn from_frame(frame: &Frame) -> Option<Self> {
        match frame.format() {
            _ if frame.is_error() => None,
            Format::Classic => Some(Self { nominal: classic_frame_bits(frame), data: 0 }),
            Format::Fd => Some(fd_frame_bits(frame)),
        }
    }

    /// Returns the total number of bits, at both rates.
    #[must_use]
    pub const fn total_bits(self) -> u32 {
        self.nominal + self.data
    }

    /// Returns the duration in s.
    #[must_use]
    pub fn seconds(self, rates: BitRates) -> f64 {
        f64::from(self.nominal) / f64::from(rates.nominal_rate())
            + f64::from(self.data) / f64::from(rates.data_rate())
    }

    /// Returns the duration in ns. The nominal and the data part are each rounded up, so the duration is never too
    /// short, and it is exact if both rates divide 1 GHz.
    #[must_use]
    pub const fn nanoseconds(self, rates: BitRates) -> u64 {
        const NANOS_PER_SECOND: u64 = 1_000_000_000;
        let nominal = (self.nominal as u64 * NANOS_PER_SECOND).div_ceil(rates.nominal_rate() as u64);
        let data = (self.data as u64 * NANOS_PER_SECOND).div_ceil(rates.data_rate() as u64);
        nominal + data
    }
}

/// Counts the bits of a classic frame.
fn classic_frame_bits(frame: &Frame) -> u32 {
    let remote = u64::from(frame.is_remote());
    let dlc = u64::from(if frame.raw_dlc() > 8 { frame.raw_dlc() & 15 } else { frame.len() });
    let id = u64::from(frame.id());
    let (head, len) = if frame.is_extended() {
        ((extended_id_wire_pattern(id) << 7) | (remote << 6) | dlc, 39)
    } else {
        ((id << 7) | (remote << 6) | dlc, 19)
    };
    let data = frame.wire_bytes();
    let mut run = BitRun::IDLE_BUS.push_bits(head, len);
    let mut digest = CRC.digest();
    digest.update(head.to_be_bytes().get(3..).unwrap_or_default());
    digest.update(data);
    for &byte in data {
        run = run.push_byte(byte);
    }
    run = run.push_bits(u64::from(digest.finalize()), 15);
    len + 8 * u32::try_from(data.len()).unwrap_or(0) + 15 + run.stuffed + CLASSIC_TAIL_BITS
}

/// Counts the bits of an FD frame.
fn fd_frame_bits(frame: &Frame) -> FrameBits {
    let switched = frame.flags() & BIT_RATE_SWITCH != 0;
    let passive = frame.flags() & ERROR_STATE != 0;
    // RRS 0, IDE 0, or RRS 0 alone; then FDF 1, res 0.
    let fdf_res_brs = 0b100 | u64::from(switched);
    let id = u64::from(frame.id());
    let (head, len) = if frame.is_extended() {
        ((extended_id_wire_pattern(id) << 4) | fdf_res_brs, 36)
    } else {
        ((id << 5) | fdf_res_brs, 17)
    };
    let data = frame.wire_bytes();
    let dlc = fd_dlc(data.len());
    let head = BitRun::IDLE_BUS.push_bits(head, len);
    let mut run = head.push_bits((u64::from(passive) << 4) | u64::from(dlc), 5);
    for &byte in data {
        run = run.push_byte(byte);
    }
    let last = data.last().copied().unwrap_or(dlc);
    let stuffed = run.stuffed - head.stuffed - u32::from(run.ended_with_stuff_bit(last));
    fd_bits_from_counts(switched, len + head.stuffed, data.len(), stuffed)
}

/// Returns the bits of an FD frame. The frame has `head` bits up to BRS (with stuff bits), `bytes` data bytes, and
/// `stuffed` stuff bits after BRS.
fn fd_bits_from_counts(switched: bool, head: u32, bytes: usize, stuffed: u32) -> FrameBits {
    let check = if bytes > 16 { FD_LONG_CRC_BITS } else { FD_CRC_BITS };
    let data = 5 + 8 * u32::try_from(bytes).unwrap_or(0) + check + stuffed;
    let nominal = head + FD_TAIL_BITS;
    if switched { FrameBits { nominal, data } } else { FrameBits { nominal: nominal + data, data: 0 } }
}

/// Returns the bits of an extended identifier on the wire: SOF, the first 11 bits, SRR and IDE, and the other 18 bits.
const fn extended_id_wire_pattern(id: u64) -> u64 {
    ((id >> 18) << 20) | (0b11 << 18) | (id & 0x3_FFFF)
}
