//! A CAN frame of any kind: classic or FD; data, remote or error. Conversion to and from the kernel's
//! structs:
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

/// Flag of a 29-bit identifier.
pub const EXTENDED: u32 = 0x8000_0000;
/// Flag in the identifier of a remote frame.
pub const REMOTE: u32 = 0x4000_0000;
/// Flag in the identifier of an error frame, which a driver creates to report an error and never sends on the wire.
pub const ERROR: u32 = 0x2000_0000;
/// Mask of an 11-bit identifier.
pub const STANDARD_MASK: u32 = 0x7FF;
/// Mask of a 29-bit identifier.
pub const EXTENDED_MASK: u32 = 0x1FFF_FFFF;

/// FD flag: the data phase ran at the data bit rate.
pub const BIT_RATE_SWITCH: u8 = 1;
/// FD flag: the sender is error passive.
pub const ERROR_STATE: u8 = 2;
/// FD flag: the frame is an FD frame (`CANFD_FDF`). Kernels set it from version 6.1 on.
pub const FD_FORMAT: u8 = 4;

/// FD flags that fit the single hexadecimal digit in a log; the kernel reserves the other bits.
const FD_FLAGS_MASK: u8 = 0xF;

/// Size of `struct can_frame` in bytes.
pub const CLASSIC_BYTES: usize = 16;
/// Size of `struct canfd_frame` in bytes.
pub const FD_BYTES: usize = 72;

/// Returns the data length of an FD frame that carries `len` bytes: the smallest of 0 to 8, 12, 16, 20, 24, 32, 48 and
/// 64 that is not less.
#[must_use]
pub const fn rounded_fd_len(len: usize) -> usize {
    dlc_len(fd_dlc(len))
}

/// Returns the DLC of an FD frame that carries `len` bytes, rounded up to a length that CAN FD allows.
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

/// Returns the number of data bytes that a DLC stands for in an FD frame. Only the lower four bits count.
#[must_use]
pub const fn dlc_len(dlc: u8) -> usize {
    let dlc = (dlc & 15) as usize;
    match dlc {
        0..=8 => dlc,
        9..=12 => 4 * dlc - 24,
        _ => 16 * dlc - 176,
    }
}

/// The error for an identifier that does not fit its 11 or 29 bits.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[error("{got:X} does not fit an identifier of {bits} bits: at most {max:X}")]
pub struct IdentifierError {
    /// The number that does not fit.
    pub got: u32,
    /// Number of bits of the identifier: 11 or 29.
    pub bits: u8,
    /// The largest identifier with that many bits.
    pub max: u32,
}

/// Checks an untrusted identifier and returns it combined with its flags, as [`Frame`] stores it. `flags` may contain
/// [`EXTENDED`], [`REMOTE`] and [`ERROR`]. Extended identifiers and error frames have 29 bits, all others 11.
///
/// # Errors
/// Returns an error if the number has more bits than the identifier.
pub const fn check_identifier(number: u32, flags: u32) -> Result<u32, IdentifierError> {
    let (bits, max) = if flags & (EXTENDED | ERROR) == 0 { (11, STANDARD_MASK) } else { (29, EXTENDED_MASK) };
    if number > max {
        return Err(IdentifierError { got: number, bits, max });
    }
    Ok(number | flags & !EXTENDED_MASK)
}

/// A frame format: classic CAN or CAN FD.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Format {
    /// Up to 8 bytes at one bit rate.
    Classic,
    /// Up to 64 bytes, optionally with a faster data phase (bit rate switch).
    Fd,
}

impl Format {
    /// Returns the name that descriptions and options use: `classic` or `fd`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Classic => "classic",
            Self::Fd => "fd",
        }
    }

    /// Returns the other format.
    #[must_use]
    pub const fn other_format(self) -> Self {
        match self {
            Self::Classic => Self::Fd,
            Self::Fd => Self::Classic,
        }
    }

    /// Returns the maximum number of data bytes: 8 or 64.
    #[must_use]
    pub const fn max_len(self) -> usize {
        match self {
            Self::Classic => 8,
            Self::Fd => 64,
        }
    }

    /// Returns the size of the kernel's struct in bytes: 16 or 72.
    #[must_use]
    pub const fn byte_len(self) -> usize {
        8 + self.max_len()
    }
}

/// A CAN frame: data, remote or error; classic or FD.
// This field order and alignment keep copies of a frame from stalling on bytes that were just written.
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

/// The error for bytes that do not form a CAN frame.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum FrameError {
    /// The size is that of neither `struct can_frame` nor `struct canfd_frame`.
    #[error("{got} bytes are not a CAN frame: a classic frame has 16 bytes, an FD frame 72")]
    Size {
        /// Number of bytes received.
        got: usize,
    },
    /// There is more data than the frame format can carry.
    #[error("{got} data bytes do not fit: the maximum is {max}")]
    Length {
        /// Number of data bytes.
        got: usize,
        /// Maximum number of data bytes in this format.
        max: usize,
    },
}

impl Frame {
    /// A classic frame with identifier 0 and no data, for initialising buffers.
    pub const EMPTY: Self =
        Self { id: 0, format: Format::Classic, flags: 0, raw_dlc: 0, len: 0, data: [0; 64] };

    /// Creates a classic data frame. For a 29-bit identifier, `id` includes the flag [`EXTENDED`].
    ///
    /// # Errors
    /// Returns an error if `data` has more than 8 bytes.
    pub fn classic(id: u32, data: &[u8]) -> Result<Self, FrameError> {
        Self::with_data(id, Format::Classic, 0, data)
    }

    /// Creates an FD data frame with the given FD flags, and sets [`FD_FORMAT`] as the kernel does.
    ///
    /// # Errors
    /// Returns an error if `data` has more than 64 bytes.
    pub fn fd(id: u32, flags: u8, data: &[u8]) -> Result<Self, FrameError> {
        Self::with_data(id, Format::Fd, flags | FD_FORMAT, data)
    }

    /// Creates a frame from all its fields, as read from a capture.
    ///
    /// # Errors
    /// Returns an error if the format cannot carry this much data.
    pub fn with_data(id: u32, format: Format, flags: u8, data: &[u8]) -> Result<Self, FrameError> {
        let mut bytes = [0; 64];
        if let Some(bytes) = bytes.get_mut(..data.len()) {
            bytes.copy_from_slice(data);
        }
        Self::with_buffer(id, format, flags, bytes, data.len())
    }

    /// Like [`Frame::with_data`], with the data in a buffer of full size. The bytes after `len` must be 0.
    #[inline(always)]
    pub(crate) fn with_buffer(
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

    /// Makes this a data frame with `len` bytes, which must not be more than the format can carry. Returns the bytes,
    /// which the caller writes.
    #[inline]
    pub(crate) fn rewrite(&mut self, id: u32, format: Format, flags: u8, len: usize) -> &mut [u8] {
        let before = usize::from(self.len);
        if before > len {
            self.data.get_mut(len..before).unwrap_or_default().fill(0);
        }
        (self.id, self.format, self.flags, self.raw_dlc) = (id, format, flags, 0);
        let data = self.data.get_mut(..len).unwrap_or_default();
        self.len = u8::try_from(data.len()).unwrap_or_default();
        data
    }

    /// Creates a remote frame that requests `len` bytes.
    ///
    /// # Errors
    /// Returns an error if more than 8 bytes are requested.
    pub fn remote(id: u32, len: u8) -> Result<Self, FrameError> {
        if len > 8 {
            return Err(FrameError::Length { got: usize::from(len), max: 8 });
        }
        let mut frame = Self::with_data(id | REMOTE, Format::Classic, 0, &[])?;
        frame.len = len;
        Ok(frame)
    }

    /// Sets the DLC that was on the wire: 9 to 15 in a classic frame with 8 data bytes.
    #[must_use]
    pub const fn with_raw_dlc(mut self, raw_dlc: u8) -> Self {
        self.raw_dlc = raw_dlc;
        self
    }

    /// Returns the identifier and its flags in one word, as the kernel stores them.
    #[must_use]
    pub const fn raw_id(&self) -> u32 {
        self.id
    }

    /// Returns the identifier without its flags.
    #[must_use]
    pub const fn id(&self) -> u32 {
        if self.is_extended() || self.is_error() { self.id & EXTENDED_MASK } else { self.id & STANDARD_MASK }
    }

    /// Returns true if the identifier has 29 bits.
    #[must_use]
    pub const fn is_extended(&self) -> bool {
        self.id & EXTENDED != 0
    }

    /// Returns true if this is a remote frame, which requests data. CAN FD has no remote frames, so this returns false
    /// for an FD frame with the flag [`REMOTE`].
    #[must_use]
    pub const fn is_remote(&self) -> bool {
        matches!(self.format, Format::Classic) && self.id & REMOTE != 0
    }

    /// Returns true if this is an error report from the driver.
    #[must_use]
    pub const fn is_error(&self) -> bool {
        self.id & ERROR != 0
    }

    /// Returns the format.
    #[must_use]
    pub const fn format(&self) -> Format {
        self.format
    }

    /// Returns the FD flags; 0 in a classic frame.
    #[must_use]
    pub const fn flags(&self) -> u8 {
        self.flags
    }

    /// Returns the DLC that was on the wire if it was 9 to 15 (with 8 data bytes), else 0.
    #[must_use]
    pub const fn raw_dlc(&self) -> u8 {
        self.raw_dlc
    }

    /// Returns the number of data bytes, or of requested bytes in a remote frame.
    #[must_use]
    pub const fn len(&self) -> u8 {
        self.len
    }

    /// Returns true if the length is 0.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns the data bytes; empty for a remote frame.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        let len = if self.is_remote() { 0 } else { usize::from(self.len) };
        self.data.get(..len).unwrap_or_default()
    }

    /// Returns the data bytes that are on the wire between control field and checksum. Data of a length that CAN FD
    /// does not allow is padded with zeros. The remote flag of an FD frame is ignored.
    pub(crate) fn wire_bytes(&self) -> &[u8] {
        let len = match self.format {
            Format::Classic => self.data().len(),
            Format::Fd => rounded_fd_len(usize::from(self.len)),
        };
        self.data.get(..len).unwrap_or(&self.data)
    }

    /// Returns the frame as the kernel's struct. Only the first [`Frame::byte_len`] bytes are valid.
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

    /// Returns the size of the kernel's struct in bytes: 16 or 72.
    #[must_use]
    pub const fn byte_len(&self) -> usize {
        self.format.byte_len()
    }

    /// Decodes the bytes of the kernel's struct. Never panics.
    ///
    /// # Errors
    /// Returns an error if the size is that of neither struct, or the length byte exceeds the maximum of the format.
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
            // Any other value of this byte is uninitialised padding.
            Format::Classic => {
                let dlc = if got == 8 && matches!(dlc, 9..=15) { dlc } else { 0 };
                Self::with_data(id, format, 0, body).map(|frame| frame.with_raw_dlc(dlc))
            }
            Format::Fd => Self::with_data(id, format, flags & FD_FLAGS_MASK, body),
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
            assert_eq!(Some(rounded_fd_len(len)), lens.into_iter().find(|&it| it >= len), "{len}");
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
            assert_eq!(check_identifier(number, flags), Ok(number | flags));
            for got in [number + 1, (number + 1) | EXTENDED, u32::MAX] {
                assert_eq!(check_identifier(got, flags), Err(IdentifierError { got, bits, max }));
            }
        }
        let wrong = check_identifier(0x18F0_10FE, 0).unwrap_err().to_string();
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
