//! One CAN frame of any kind, laid out as the kernel lays it out.
//!
//! ```text
//!   struct can_frame, 16 bytes                     struct canfd_frame, 72 bytes
//!   byte 0..3  identifier and flags, host order    byte 0..3   the same
//!        4     length 0..=8                             4      length 0..=64
//!        5     padding                                  5      flags: 1 BRS, 2 ESI, 4 FDF
//!        6     reserved (embedded bus: 1 = own)         6      reserved (embedded bus: 1 = own)
//!        7     raw DLC 9..=15 or 0                      7      reserved
//!        8..15 data                                     8..71  data
//! ```

use thiserror::Error;

/// Set in an identifier of 29 bits.
pub const EXTENDED: u32 = 0x8000_0000;
/// Set in a remote frame.
pub const REMOTE: u32 = 0x4000_0000;
/// Set in an error frame, which is a message of the driver and never was on the wire.
pub const ERROR: u32 = 0x2000_0000;
/// The bits of an 11-bit identifier.
pub const STANDARD_MASK: u32 = 0x7FF;
/// The bits of a 29-bit identifier.
pub const EXTENDED_MASK: u32 = 0x1FFF_FFFF;

/// FD flag: the data phase ran at the data bit rate.
pub const BIT_RATE_SWITCH: u8 = 1;
/// FD flag: the sender is error passive.
pub const ERROR_STATE: u8 = 2;
/// FD flag: "this is an FD frame"; kernels set it from 6.1 on.
pub const FD_FORMAT: u8 = 4;

/// The bits of FD flags that a log has a digit for; the kernel reserves the others.
const FD_FLAGS: u8 = 0xF;

/// Bytes of `struct can_frame`.
pub const CLASSIC_BYTES: usize = 16;
/// Bytes of `struct canfd_frame`.
pub const FD_BYTES: usize = 72;

/// The length on the wire of so many bytes in an FD frame: the next one that CAN FD has, up to 64.
#[must_use]
pub const fn fd_len(len: usize) -> usize {
    dlc_len(fd_dlc(len))
}

/// The DLC of so many bytes in an FD frame, or of the next length that CAN FD has.
#[must_use]
pub const fn fd_dlc(len: usize) -> u8 {
    match len {
        0..=8 => len.to_le_bytes()[0],
        9..=12 => 9,
        13..=16 => 10,
        17..=20 => 11,
        21..=24 => 12,
        25..=32 => 13,
        33..=48 => 14,
        _ => 15,
    }
}

/// How many bytes an FD frame of this DLC (its lower four bits) has.
#[must_use]
pub const fn dlc_len(dlc: u8) -> usize {
    let dlc = (dlc & 15) as usize;
    match dlc {
        0..=8 => dlc,
        9..=12 => 4 * dlc - 24,
        _ => 16 * dlc - 176,
    }
}

/// A number that does not fit its identifier.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[error("{got:X} does not fit an identifier of {bits} bits: at most {max:X}")]
pub struct IdentifierError {
    /// The number.
    pub got: u32,
    /// Bits of the identifier: 11 or 29.
    pub bits: u8,
    /// The largest identifier of that many bits.
    pub max: u32,
}

/// Checks an identifier that comes from elsewhere, and returns it as [`Frame`] keeps it. `flags` are those of [`EXTENDED`],
/// [`REMOTE`] and [`ERROR`] that it has; an extended identifier and an error's kind have 29 bits, any other one 11.
///
/// # Errors
/// When the number has more bits than that.
pub const fn identifier(number: u32, flags: u32) -> Result<u32, IdentifierError> {
    let (bits, max) = if flags & (EXTENDED | ERROR) == 0 { (11, STANDARD_MASK) } else { (29, EXTENDED_MASK) };
    if number > max {
        return Err(IdentifierError { got: number, bits, max });
    }
    Ok(number | flags & !EXTENDED_MASK)
}

/// Classic CAN or CAN FD.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Format {
    /// Up to 8 bytes, one bit rate.
    Classic,
    /// Up to 64 bytes, and a faster data phase when the bit rate switches.
    Fd,
}

impl Format {
    /// What descriptions and options call it: `classic` or `fd`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Classic => "classic",
            Self::Fd => "fd",
        }
    }

    /// The one that this is not.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::Classic => Self::Fd,
            Self::Fd => Self::Classic,
        }
    }

    /// How many data bytes a frame has at most: 8 or 64.
    #[must_use]
    pub const fn max_len(self) -> usize {
        match self {
            Self::Classic => 8,
            Self::Fd => 64,
        }
    }

    /// How many bytes the kernel's struct of a frame has: 16 or 72.
    #[must_use]
    pub const fn byte_len(self) -> usize {
        8 + self.max_len()
    }
}

/// A CAN frame: data, remote or error; classic or FD.
// In this order and at multiples of 8, or else copies of it wait for the bytes that have just been written.
#[derive(Clone, Copy, Eq, Hash, PartialEq)]
#[repr(C, align(8))]
pub struct Frame {
    id: u32,
    format: Format,
    flags: u8,
    raw_dlc: u8,
    len: u8,
    data: [u8; 64],
}

/// Bytes that are no frame of the kernel's.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum FrameError {
    /// Neither `struct can_frame` nor `struct canfd_frame`.
    #[error("{got} bytes are no CAN frame: a classic one has 16, an FD one 72")]
    Size {
        /// Bytes that came.
        got: usize,
    },
    /// More data than the format carries.
    #[error("{got} data bytes do not fit: at most {max}")]
    Length {
        /// Bytes given.
        got: usize,
        /// Bytes that fit.
        max: usize,
    },
}

impl Frame {
    /// A classic frame with identifier 0 and no data, to fill buffers with.
    pub const EMPTY: Self =
        Self { id: 0, format: Format::Classic, flags: 0, raw_dlc: 0, len: 0, data: [0; 64] };

    /// A classic data frame. `id` carries the flag [`EXTENDED`] for 29 bits.
    ///
    /// # Errors
    /// When there are more than 8 bytes.
    pub fn classic(id: u32, data: &[u8]) -> Result<Self, FrameError> {
        Self::with_data(id, Format::Classic, 0, data)
    }

    /// An FD data frame with the given FD flags; the FDF flag is set as the kernel sets it.
    ///
    /// # Errors
    /// When there are more than 64 bytes.
    pub fn fd(id: u32, flags: u8, data: &[u8]) -> Result<Self, FrameError> {
        Self::with_data(id, Format::Fd, flags | FD_FORMAT, data)
    }

    /// A frame with every field given; what captures are read into.
    ///
    /// # Errors
    /// When the data does not fit the format.
    pub fn with_data(id: u32, format: Format, flags: u8, data: &[u8]) -> Result<Self, FrameError> {
        let mut bytes = [0; 64];
        if let Some(bytes) = bytes.get_mut(..data.len()) {
            bytes.copy_from_slice(data);
        }
        Self::filled(id, format, flags, bytes, data.len())
    }

    /// The same with the data in its place already; what is behind `len` has to be 0.
    #[inline(always)]
    pub(crate) fn filled(
        id: u32,
        format: Format,
        flags: u8,
        data: [u8; 64],
        len: usize,
    ) -> Result<Self, FrameError> {
        let max = format.max_len();
        let short = u8::try_from(len).ok().filter(|_| len <= max);
        let len = short.ok_or(FrameError::Length { got: len, max })?;
        Ok(Self { id, format, flags, raw_dlc: 0, len, data })
    }

    /// A remote frame that requests `len` bytes.
    ///
    /// # Errors
    /// When more than 8 bytes are requested.
    pub fn remote(id: u32, len: u8) -> Result<Self, FrameError> {
        if len > 8 {
            return Err(FrameError::Length { got: usize::from(len), max: 8 });
        }
        let mut frame = Self::with_data(id | REMOTE, Format::Classic, 0, &[])?;
        frame.len = len;
        Ok(frame)
    }

    /// The same classic frame with the DLC as it was on the wire (9 to 15, when the length is 8).
    #[must_use]
    pub const fn with_raw_dlc(mut self, raw_dlc: u8) -> Self {
        self.raw_dlc = raw_dlc;
        self
    }

    /// Identifier and flags, as the kernel keeps them in one word.
    #[must_use]
    pub const fn raw_id(&self) -> u32 {
        self.id
    }

    /// The identifier without its flags.
    #[must_use]
    pub const fn id(&self) -> u32 {
        if self.is_extended() || self.is_error() { self.id & EXTENDED_MASK } else { self.id & STANDARD_MASK }
    }

    /// Whether the identifier has 29 bits.
    #[must_use]
    pub const fn is_extended(&self) -> bool {
        self.id & EXTENDED != 0
    }

    /// Whether this requests data instead of carrying it. In CAN FD no frame does, whatever its flag says.
    #[must_use]
    pub const fn is_remote(&self) -> bool {
        matches!(self.format, Format::Classic) && self.id & REMOTE != 0
    }

    /// Whether this is the driver's report of an error.
    #[must_use]
    pub const fn is_error(&self) -> bool {
        self.id & ERROR != 0
    }

    /// Classic or FD.
    #[must_use]
    pub const fn format(&self) -> Format {
        self.format
    }

    /// The FD flags; 0 in a classic frame.
    #[must_use]
    pub const fn flags(&self) -> u8 {
        self.flags
    }

    /// The DLC as it was on the wire, when it said 9 to 15 for 8 bytes; else 0.
    #[must_use]
    pub const fn raw_dlc(&self) -> u8 {
        self.raw_dlc
    }

    /// How many bytes it carries, or requests when remote.
    #[must_use]
    pub const fn len(&self) -> u8 {
        self.len
    }

    /// Whether it carries nothing.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The bytes it carries; none in a remote frame.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        let len = if self.is_remote() { 0 } else { usize::from(self.len) };
        self.data.get(..len).unwrap_or_default()
    }

    /// The bytes between control field and checksum on a wire: an FD frame of a length that CAN FD does not have is
    /// filled up with zeros, and its remote flag means nothing.
    pub(crate) fn on_wire(&self) -> &[u8] {
        let len = match self.format {
            Format::Classic => self.data().len(),
            Format::Fd => fd_len(usize::from(self.len)),
        };
        self.data.get(..len).unwrap_or(&self.data)
    }

    /// The kernel's struct; only the first [`Frame::byte_len`] bytes are its own.
    #[must_use]
    pub fn to_bytes(&self) -> [u8; FD_BYTES] {
        let [a, b, c, d] = self.id.to_ne_bytes();
        let mut bytes = [0; FD_BYTES];
        let (head, data) = bytes.split_at_mut(8);
        let (flags, dlc) = match self.format {
            Format::Classic => (0, self.raw_dlc),
            Format::Fd => (self.flags, 0),
        };
        head.copy_from_slice(&[a, b, c, d, self.len, flags, 0, dlc]);
        data.copy_from_slice(&self.data);
        bytes
    }

    /// How many bytes the kernel's struct has: 16 or 72.
    #[must_use]
    pub const fn byte_len(&self) -> usize {
        self.format.byte_len()
    }

    /// Reads the kernel's struct. Never panics.
    ///
    /// # Errors
    /// When the size is that of neither struct, or the length byte is above what the format carries.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, FrameError> {
        let format = match bytes.len() {
            CLASSIC_BYTES => Format::Classic,
            FD_BYTES => Format::Fd,
            got => return Err(FrameError::Size { got }),
        };
        let Some((&[a, b, c, d, len, flags, _reserved, dlc], data)) = bytes.split_first_chunk() else {
            return Err(FrameError::Size { got: bytes.len() });
        };
        let got = usize::from(len);
        let body = data.get(..got).ok_or(FrameError::Length { got, max: data.len() })?;
        let id = u32::from_ne_bytes([a, b, c, d]);
        match format {
            // Other values there are padding that nobody cleared.
            Format::Classic => {
                let dlc = if got == 8 && matches!(dlc, 9..=15) { dlc } else { 0 };
                Self::with_data(id, format, 0, body).map(|frame| frame.with_raw_dlc(dlc))
            }
            Format::Fd => Self::with_data(id, format, flags & FD_FLAGS, body),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_layout_is_the_kernels() {
        let frame = Frame::fd(0x22C, BIT_RATE_SWITCH, &[0xAA, 0xBB]).unwrap();
        let bytes = frame.to_bytes();
        assert_eq!(bytes[..4], 0x22C_u32.to_ne_bytes());
        assert_eq!(bytes[4..10], [2, BIT_RATE_SWITCH | FD_FORMAT, 0, 0, 0xAA, 0xBB]);
        assert_eq!(frame.byte_len(), 72);
    }

    #[test]
    fn a_remote_frame_is_one_with_the_flag_given_or_not() {
        for id in [0x123, 0x123 | REMOTE] {
            let frame = Frame::remote(id, 5).unwrap();
            assert_eq!((frame.is_remote(), frame.id(), frame.len(), frame.data()), (true, 0x123, 5, &[][..]));
        }
    }

    #[test]
    fn every_dlc_has_its_length() {
        let lens = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];
        for (dlc, len) in (0..).zip(lens) {
            assert_eq!(dlc_len(dlc), len);
            assert_eq!(fd_dlc(len), dlc);
        }
        for len in 0..=64 {
            assert_eq!(Some(fd_len(len)), lens.into_iter().find(|&it| it >= len), "{len}");
        }
    }

    #[test]
    fn an_identifier_has_the_bits_that_its_flags_say() {
        for (number, flags, bits, max) in [
            (0x7FF, 0, 11, STANDARD_MASK),
            (0x7FF, REMOTE, 11, STANDARD_MASK),
            (0x1FFF_FFFF, EXTENDED, 29, EXTENDED_MASK),
            (0x1FFF_FFFF, ERROR, 29, EXTENDED_MASK),
            (0x1FFF_FFFF, EXTENDED | REMOTE, 29, EXTENDED_MASK),
        ] {
            assert_eq!(identifier(number, flags), Ok(number | flags));
            for got in [number + 1, (number + 1) | EXTENDED, u32::MAX] {
                assert_eq!(identifier(got, flags), Err(IdentifierError { got, bits, max }));
            }
        }
        let wrong = identifier(0x18F0_10FE, 0).unwrap_err().to_string();
        assert_eq!(wrong, "18F010FE does not fit an identifier of 11 bits: at most 7FF");
    }

    #[test]
    fn bytes_of_the_struct_without_a_meaning_are_left_out() {
        let mut bytes = [0; FD_BYTES];
        bytes[4..8].copy_from_slice(&[7, 0, 0, 0x55]);
        assert_eq!(Frame::from_bytes(&bytes[..CLASSIC_BYTES]).unwrap().raw_dlc(), 0);
        bytes[4] = 8;
        assert_eq!(Frame::from_bytes(&bytes[..CLASSIC_BYTES]).unwrap().raw_dlc(), 0);
        bytes[5] = 0xF5;
        assert_eq!(Frame::from_bytes(&bytes).unwrap().flags(), 5);
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        assert_eq!(Frame::classic(1, &[0; 9]), Err(FrameError::Length { got: 9, max: 8 }));
        assert_eq!(Frame::fd(1, 0, &[0; 65]), Err(FrameError::Length { got: 65, max: 64 }));
        assert_eq!(Frame::from_bytes(&[0; 12]), Err(FrameError::Size { got: 12 }));
        let mut bytes = [0; CLASSIC_BYTES];
        bytes[4] = 9;
        assert_eq!(Frame::from_bytes(&bytes), Err(FrameError::Length { got: 9, max: 8 }));
    }

    proptest! {
        #[test]
        fn every_frame_comes_back(id: u32, fd: bool, flags in 0_u8..8, dlc in 9_u8..16, data in proptest::collection::vec(any::<u8>(), 0..=64)) {
            let id = id & !REMOTE;
            let frame = if fd {
                Frame::with_data(id, Format::Fd, flags, &data).unwrap()
            } else {
                let data = &data[..data.len().min(8)];
                Frame::classic(id, data).unwrap().with_raw_dlc(if data.len() == 8 { dlc } else { 0 })
            };
            prop_assert_eq!(Frame::from_bytes(&frame.to_bytes()[..frame.byte_len()]), Ok(frame));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            let _ = Frame::from_bytes(&bytes);
        }
    }
}
