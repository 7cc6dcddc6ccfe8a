//! The bits of a frame on the wire: those that arbitration compares, and the time that all of them take.

#[path = "../../../protocol/src/tests/wire_time/oracle.rs"]
mod oracle;

use protocol::can::{BIT_RATE_SWITCH, ERROR_STATE, Format, Frame};
use protocol::wire_time::BitRates;

/// Number of nominal bits of an error frame: two flags of 6 bits, a delimiter of 8, and the intermission of 3.
const ERROR_FRAME_BITS: u32 = 6 + 6 + 8 + 3;
/// Number of bits of the intermission, which no error damages.
const INTERMISSION_BITS: u32 = 3;

/// A frame as its bits on the wire.
#[derive(Clone, Debug)]
pub struct WireFrame {
    arbitration: u64,
    /// Number of bits before, at and after the data bit rate.
    sections: [u32; 3],
}

impl WireFrame {
    /// Creates the bits of a frame.
    #[must_use]
    pub fn new(frame: &Frame) -> Self {
        let bits = (0..64).rev().zip(arbitration_bits(frame));
        let arbitration = bits.fold(0, |word, (place, bit)| word | u64::from(bit) << place);
        Self { arbitration, sections: oracle::bits(frame) }
    }

    /// Returns the bits that arbitration compares, in their order on the wire from the most significant bit on.
    #[must_use]
    pub const fn arbitration_bits(&self) -> u64 {
        self.arbitration
    }

    /// Returns the time in ns that the frame takes on the bus, including the intermission. If a bit is damaged, this is
    /// the time of the bits up to and including that one, and of an error frame. The bits at each rate are rounded up
    /// to whole ns.
    #[must_use]
    pub fn nanoseconds(&self, rates: BitRates, damaged_bit: Option<u32>) -> u64 {
        let [head, data, tail] = self.sections;
        let [nominal, data] = match damaged_bit {
            None => [head + tail, data],
            Some(bit) => {
                let in_data = bit.saturating_sub(head).min(data);
                [bit - in_data + ERROR_FRAME_BITS, in_data]
            }
        };
        let time = |bits: u32, rate: u32| (u64::from(bits) * 1_000_000_000).div_ceil(u64::from(rate));
        time(nominal, rates.nominal_rate()) + time(data, rates.data_rate())
    }

    /// Returns the number of bits up to and including the damaged one, if a damaged transmission took this time.
    #[must_use]
    pub fn damaged_bit(&self, rates: BitRates, took_ns: u64) -> Option<u32> {
        let exposed = self.sections.iter().sum::<u32>() - INTERMISSION_BITS;
        (1..=exposed).find(|&bit| self.nanoseconds(rates, Some(bit)) == took_ns)
    }

    /// Returns the longest time in ns that a transmission of the frame can take, complete or damaged.
    #[must_use]
    pub fn longest_ns(&self, rates: BitRates) -> u64 {
        let exposed = self.sections.iter().sum::<u32>() - INTERMISSION_BITS;
        self.nanoseconds(rates, Some(exposed)).max(self.nanoseconds(rates, None))
    }
}

/// Writes the bits from the first of the identifier to the last that arbitration compares.
fn arbitration_bits(frame: &Frame) -> Vec<u8> {
    let remote = u8::from(frame.is_remote());
    if frame.is_extended() {
        let id: Vec<_> = format!("{:029b}", frame.id()).bytes().map(|digit| digit - b'0').collect();
        // SRR and IDE, recessive.
        [&id[..11], &[1, 1], &id[11..], &[remote]].concat()
    } else {
        let id: Vec<_> = format!("{:011b}", frame.id()).bytes().map(|digit| digit - b'0').collect();
        // RTR, and IDE dominant.
        [&id[..], &[remote, 0]].concat()
    }
}
