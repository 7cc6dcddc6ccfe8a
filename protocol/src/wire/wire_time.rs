//! How long a frame takes on a real bus: its bits with the stuff bits that its own bits make, and two bit rates.
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
//! After ISO 11898-1. After five equal bits comes a stuff bit, counted at the rate of the bit that follows it. In classic CAN
//! that holds from SOF to the last bit of the CRC; in CAN FD to the last bit of the data, where a run of five makes the first
//! of the *fixed* stuff bits (fsb: 6 of them, or 7 with the longer CRC) and not one more. BRS is counted as nominal and the
//! CRC delimiter as data: each is in part the other, and together they are one bit of each for every sample point.
//! The intermission (int3) is counted: no node can send earlier.

mod extremes;
mod rates;
mod stuffing;

pub use extremes::{Coding, Shape};
pub use rates::{BitRates, BitRatesError, bit_rate};

use crate::can::{BIT_RATE_SWITCH, ERROR_STATE, Format, Frame, fd_dlc};
use stuffing::Run;

/// CRC-15/CAN: polynomial 0x4599, initial value 0; leading zeros change nothing.
const CRC: crc::Crc<u16> = crc::Crc::<u16>::new(&crc::CRC_15_CAN);

/// Classic: delimiters, ACK, end of frame, intermission.
const CLASSIC_TAIL: u32 = 13;
/// FD: ACK and its delimiter, end of frame, intermission.
const FD_TAIL: u32 = 12;
/// FD, up to 16 bytes: stuff bit count, CRC of 17 bits, 6 fixed stuff bits, delimiter.
const FD_CHECK: u32 = 28;
/// FD, above 16 bytes: the same with a CRC of 21 bits and 7 fixed stuff bits.
const FD_LONG_CHECK: u32 = 33;

/// The bits of a frame on the wire, stuff bits and intermission included.
#[derive(Clone, Copy, Debug, Default, Eq, Hash, PartialEq)]
pub struct Bits {
    /// Bits at the nominal bit rate; all of them, unless the bit rate switches.
    pub nominal: u32,
    /// Bits at the data bit rate.
    pub data: u32,
}

impl Bits {
    /// The bits of this very frame. Nothing for a driver's error frame, which never was on a wire.
    ///
    /// A length that CAN FD does not have counts as the next one that it has, filled up with zeros.
    #[must_use]
    pub fn of(frame: &Frame) -> Option<Self> {
        match frame.format() {
            _ if frame.is_error() => None,
            Format::Classic => Some(Self { nominal: classic(frame), data: 0 }),
            Format::Fd => Some(fd(frame)),
        }
    }

    /// All bits, of both rates.
    #[must_use]
    pub const fn total(self) -> u32 {
        self.nominal + self.data
    }

    /// How long they take, in s.
    #[must_use]
    pub fn seconds(self, rates: BitRates) -> f64 {
        f64::from(self.nominal) / f64::from(rates.nominal()) + f64::from(self.data) / f64::from(rates.data())
    }

    /// How long they take, in ns; the nominal and the data part are rounded up each, so that the sum is exact at all rates
    /// that divide 1 GHz and never short.
    #[must_use]
    pub const fn nanoseconds(self, rates: BitRates) -> u64 {
        const SECOND: u64 = 1_000_000_000;
        let nominal = (self.nominal as u64 * SECOND).div_ceil(rates.nominal() as u64);
        let data = (self.data as u64 * SECOND).div_ceil(rates.data() as u64);
        nominal + data
    }
}

/// All bits of a classic frame.
fn classic(frame: &Frame) -> u32 {
    let remote = u64::from(frame.is_remote());
    let dlc = u64::from(if frame.raw_dlc() > 8 { frame.raw_dlc() & 15 } else { frame.len() });
    let id = u64::from(frame.id());
    let (head, len) = if frame.is_extended() {
        ((extended(id) << 7) | (remote << 6) | dlc, 39)
    } else {
        ((id << 7) | (remote << 6) | dlc, 19)
    };
    let data = frame.on_wire();
    let mut run = Run::IDLE.bits(head, len);
    let mut digest = CRC.digest();
    digest.update(head.to_be_bytes().get(3..).unwrap_or_default());
    digest.update(data);
    for &byte in data {
        run = run.byte(byte);
    }
    run = run.bits(u64::from(digest.finalize()), 15);
    len + 8 * u32::try_from(data.len()).unwrap_or(0) + 15 + run.stuffed + CLASSIC_TAIL
}

/// Both kinds of bits of an FD frame.
fn fd(frame: &Frame) -> Bits {
    let switched = frame.flags() & BIT_RATE_SWITCH != 0;
    let passive = frame.flags() & ERROR_STATE != 0;
    // RRS 0, IDE 0, or RRS 0 alone; then FDF 1, res 0.
    let fdf_res_brs = 0b100 | u64::from(switched);
    let id = u64::from(frame.id());
    let (head, len) = if frame.is_extended() {
        ((extended(id) << 4) | fdf_res_brs, 36)
    } else {
        ((id << 5) | fdf_res_brs, 17)
    };
    let data = frame.on_wire();
    let dlc = fd_dlc(data.len());
    let head = Run::IDLE.bits(head, len);
    let mut run = head.bits((u64::from(passive) << 4) | u64::from(dlc), 5);
    for &byte in data {
        run = run.byte(byte);
    }
    let last = data.last().copied().unwrap_or(dlc);
    let stuffed = run.stuffed - head.stuffed - u32::from(run.ended_on(last));
    parts(switched, len + head.stuffed, data.len(), stuffed)
}

/// The bits of an FD frame from those of its head and the number of bytes and of stuff bits in what follows.
fn parts(switched: bool, head: u32, bytes: usize, stuffed: u32) -> Bits {
    let check = if bytes > 16 { FD_LONG_CHECK } else { FD_CHECK };
    let data = 5 + 8 * u32::try_from(bytes).unwrap_or(0) + check + stuffed;
    let nominal = head + FD_TAIL;
    if switched { Bits { nominal, data } } else { Bits { nominal: nominal + data, data: 0 } }
}

/// SOF, the first 11 bits of the identifier, SRR and IDE, the other 18 bits.
const fn extended(id: u64) -> u64 {
    ((id >> 18) << 20) | (0b11 << 18) | (id & 0x3_FFFF)
}
