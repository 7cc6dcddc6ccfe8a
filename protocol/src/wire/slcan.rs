//! slcan: CAN frames and adapter commands as lines of ASCII over a serial line (the protocol of Lawicel, with
//! the FD extension of CANable).
//!
//! ```text
//!   t 123 2 1122 CR              classic data frame: identifier, DLC, data
//!   T 12345678 2 1122 CR         the same with 29 bits
//!   r 123 2 CR, R 12345678 2 CR  remote frame: no data
//!   d 123 9 (24 digits) CR, D    FD, one bit rate      DLC 9 A B C D E F: 12 16 20 24 32 48 64 bytes
//!   b 123 9 (24 digits) CR, B    FD, bit rate switched
//!   t 123 2 1122 0A51 CR         received, with time stamps on: 4 digits (ms), or 8 (µs)
//!   b 123 2 1122 S CR            received, of an error passive sender (CANable 2.5)
//!   b 123 2 1122 0A51 1 CR       received, behind a time stamp or without one: 1 error passive, 0 active (WeAct)
//!
//!   C  O  L  S6  Y5  V  N  F  Z1  M00000000  mFFFFFFFF  CR     from the host: [`Command`]
//!   CR  z CR  Z CR  BEL                                        from the adapter: done, sent, refused
//!   e1a CR  sp128057 CR  E2310800C CR  F80 CR                  from the adapter: faults, [`Report`]
//! ```
//!
//! The spaces are only for readability. Digits are hexadecimal; both cases are accepted, upper case is
//! written.
//!
//! Dialects differ in their replies: some firmware acknowledges every line, some none. The writer therefore never waits
//! for an acknowledgement, and the decoder skips unknown lines.

mod decoder;
#[cfg(feature = "host")]
mod report;
#[cfg(test)]
mod tests;

use crate::can::{BIT_RATE_SWITCH, Format, Frame, dlc_len, fd_dlc};

pub use decoder::{Decoder, LineRefusal, RejectedLines, SlcanLine};
#[cfg(feature = "host")]
pub use report::{AdapterFault, AdapterReport, BusState, ErrorCounters};

/// Maximum length of a line in bytes without its line ending: an FD frame with bit rate switch, 64 data bytes, a 29-bit
/// identifier, 8 digits of time and the state of the sender.
pub const MAX_LINE: usize = 1 + 8 + 1 + 2 * 64 + 8 + 1;
/// The line ending in both directions.
pub const CR: u8 = b'\r';
/// The byte with which an adapter reports that it refused a line.
pub const BEL: u8 = 0x07;

/// An encoded line with its line ending: 1 to [`MAX_LINE`] bytes.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub struct EncodedLine {
    bytes: heapless::Vec<u8, MAX_LINE>,
}

impl EncodedLine {
    /// Returns the bytes to send.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes
    }

    fn push(&mut self, byte: u8) {
        // The buffer cannot overflow: time stamps are never written, which leaves room for the line ending.
        let _ = self.bytes.push(byte);
    }

    /// Appends the lower four bits as a hexadecimal digit.
    fn digit(&mut self, value: u8) {
        let value = value & 15;
        self.push(if value < 10 { b'0' + value } else { b'A' - 10 + value });
    }

    fn byte(&mut self, value: u8) {
        self.digit(value >> 4);
        self.digit(value);
    }

    fn word(&mut self, value: u32) {
        value.to_be_bytes().into_iter().for_each(|byte| self.byte(byte));
    }
}

/// Encodes a frame as a line. Returns `None` for an error frame, which was never on the bus.
///
/// The data of an FD frame is padded with zeros to a length that CAN FD allows. The error state is not encoded, and a
/// classic frame with a raw DLC of 9 to 15 is encoded with DLC 8.
#[must_use]
pub fn encode(frame: &Frame) -> Option<EncodedLine> {
    if frame.is_error() {
        return None;
    }
    let data = frame.wire_bytes();
    let (kind, dlc) = match frame.format() {
        Format::Classic if frame.is_remote() => (b'r', frame.len()),
        Format::Classic => (b't', frame.len()),
        Format::Fd if frame.flags() & BIT_RATE_SWITCH != 0 => (b'b', fd_dlc(data.len())),
        Format::Fd => (b'd', fd_dlc(data.len())),
    };
    let mut text = EncodedLine::default();
    if frame.is_extended() {
        text.push(kind.to_ascii_uppercase());
        text.word(frame.id());
    } else {
        text.push(kind);
        let [.., high, low] = frame.id().to_be_bytes();
        text.digit(high);
        text.byte(low);
    }
    text.digit(dlc);
    data.iter().for_each(|&byte| text.byte(byte));
    text.push(CR);
    Some(text)
}

/// A command from a host to an adapter, other than a frame to send.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
#[non_exhaustive]
pub enum SlcanCommand {
    /// `C`: leaves the bus. Bit rates can be set only while the adapter has left it.
    Close,
    /// `O`: joins the bus.
    Open,
    /// `L`: joins the bus in listen-only mode, in which the adapter does not acknowledge frames.
    Listen,
    /// `S0` to `S9`: the nominal bit rate, see [`SlcanCommand::nominal_bit_rate`].
    BitRate(u8),
    /// `Y0` to `Y9`: the data bit rate, see [`SlcanCommand::data_bit_rate`].
    DataBitRate(u8),
    /// `V` or `v`: requests the firmware version.
    Version,
    /// `N`: requests the serial number.
    SerialNumber,
    /// `F`: requests the fault flags.
    Flags,
    /// `Z0` and `Z1`: turn off or on the time stamps of 4 digits after received frames.
    TimeStamps(bool),
    /// `M` and 8 digits: the acceptance code of an SJA1000.
    Code(u32),
    /// `m` and 8 digits: the acceptance mask of an SJA1000. Identifier bits are ignored where the mask is 1.
    Mask(u32),
}

impl SlcanCommand {
    /// Returns the command that sets this nominal bit rate, in bit/s; `None` if slcan has no command for it.
    ///
    /// `S7` is 800 kbit/s in Lawicel's protocol and 750 kbit/s in CANable's firmware and python-can, so this function
    /// returns it for both rates.
    #[must_use]
    pub const fn nominal_bit_rate(bit_rate: u32) -> Option<Self> {
        Some(Self::BitRate(match bit_rate {
            10_000 => 0,
            20_000 => 1,
            50_000 => 2,
            100_000 => 3,
            125_000 => 4,
            250_000 => 5,
            500_000 => 6,
            750_000 | 800_000 => 7,
            1_000_000 => 8,
            83_300 | 83_333 => 9,
            _ => return None,
        }))
    }

    /// Returns the command that sets this data bit rate, in bit/s: 500 k, or 1 M to 8 M. Returns `None` if slcan has no
    /// command for it.
    ///
    /// All CANable firmware supports 2 M and 5 M; the other rates depend on the firmware.
    #[must_use]
    pub const fn data_bit_rate(bit_rate: u32) -> Option<Self> {
        Some(Self::DataBitRate(match bit_rate {
            500_000 => 0,
            1_000_000 => 1,
            2_000_000 => 2,
            3_000_000 => 3,
            4_000_000 => 4,
            5_000_000 => 5,
            6_000_000 => 6,
            7_000_000 => 7,
            8_000_000 => 8,
            _ => return None,
        }))
    }

    /// Encodes the command as a line with its line ending.
    #[must_use]
    pub fn encode(self) -> EncodedLine {
        let mut text = EncodedLine::default();
        let with_digit = |text: &mut EncodedLine, letter, digit: u8| {
            text.push(letter);
            text.digit(digit);
        };
        match self {
            Self::Close => text.push(b'C'),
            Self::Open => text.push(b'O'),
            Self::Listen => text.push(b'L'),
            Self::BitRate(digit) => with_digit(&mut text, b'S', digit),
            Self::DataBitRate(digit) => with_digit(&mut text, b'Y', digit),
            Self::Version => text.push(b'V'),
            Self::SerialNumber => text.push(b'N'),
            Self::Flags => text.push(b'F'),
            Self::TimeStamps(on) => with_digit(&mut text, b'Z', on.into()),
            Self::Code(code) => {
                text.push(b'M');
                text.word(code);
            }
            Self::Mask(mask) => {
                text.push(b'm');
                text.word(mask);
            }
        }
        text.push(CR);
        text
    }

    /// Decodes a command from a line without its line ending; `None` for any other line.
    fn decode(line: &[u8]) -> Option<Self> {
        Some(match line {
            b"C" => Self::Close,
            b"O" => Self::Open,
            b"L" => Self::Listen,
            b"V" | b"v" => Self::Version,
            b"N" => Self::SerialNumber,
            b"F" => Self::Flags,
            b"Z0" => Self::TimeStamps(false),
            b"Z1" => Self::TimeStamps(true),
            [b'S', digit @ b'0'..=b'9'] => Self::BitRate(digit - b'0'),
            [b'Y', digit @ b'0'..=b'9'] => Self::DataBitRate(digit - b'0'),
            [b'M', digits @ ..] if digits.len() == 8 => Self::Code(number(digits)?),
            [b'm', digits @ ..] if digits.len() == 8 => Self::Mask(number(digits)?),
            _ => return None,
        })
    }
}

/// Returns the value of a hexadecimal digit; `None` for any other byte.
fn digit(byte: u8) -> Option<u8> {
    match byte {
        b'0'..=b'9' => Some(byte - b'0'),
        b'a'..=b'f' => Some(byte - b'a' + 10),
        b'A'..=b'F' => Some(byte - b'A' + 10),
        _ => None,
    }
}

/// Returns the value of at most 8 hexadecimal digits; `None` for other text.
fn number(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |number, &byte| Some((number << 4) | u32::from(digit(byte)?)))
}
