//! The contents of a cell's flash: its node id and parameters, as bytes with a version and a CRC.
//!
//! ```text
//!   byte 0..3  "SKIN"      4  version, 2      5  the node id, 0 for none
//!        6..9  serial number, little endian  10  1 when parameters follow, 0 when zeros do
//!       11..   the parameters' image, 120 bytes and 12 more for each row after the sixth (see `protocol::parameters`)
//!     last 2   CRC-16 over all bytes before it, little endian
//! ```

use protocol::id::CellId;
use protocol::packet::crc16;
use protocol::parameters::{IMAGE_BYTES, MAX_IMAGE_BYTES, Parameters};
use thiserror::Error;

use crate::identity::Identity;

const MAGIC: &[u8; 4] = b"SKIN";
const VERSION: u8 = 2;
const HEAD_BYTES: usize = 11;

/// Size of a flash image in bytes, with parameters of up to 6 rows.
pub const BYTES: usize = HEAD_BYTES + IMAGE_BYTES + 2;
/// Maximum size of a flash image in bytes.
pub const MAX_BYTES: usize = HEAD_BYTES + MAX_IMAGE_BYTES + 2;

/// A flash image.
pub type FlashImage = heapless::Vec<u8, MAX_BYTES>;

/// The node id and parameters kept in flash.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct FlashContent {
    /// The node id, if the cell has one.
    pub number: Option<CellId>,
    /// The parameters, if the cell is configured.
    pub parameters: Option<Parameters>,
}

/// The contents of flash when the cell started.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a cell has no heap")]
pub enum FlashState {
    /// Flash contains no image.
    Empty,
    /// Flash contains an image with a wrong CRC.
    Damaged,
    /// Flash contains valid parameters.
    Valid(Parameters),
}

/// The error for an image that cannot be used.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[non_exhaustive]
pub enum FlashError {
    /// The image has a size that no image can have.
    #[error("the flash image has {got} bytes, not {BYTES} to {MAX_BYTES}")]
    Size {
        /// Size of the image in bytes.
        got: usize,
    },
    /// The CRC of the image is wrong.
    #[error("the CRC of the flash image is wrong")]
    Damaged,
    /// The version of the image is unknown.
    #[error("the flash image has version {got}, not {VERSION}")]
    Version {
        /// The version of the image.
        got: u8,
    },
    /// The image belongs to another cell.
    #[error("the flash image belongs to cell {cell} with serial number {serial}")]
    OtherCell {
        /// Node id of the other cell, 0 for none.
        cell: u8,
        /// Serial number of the other cell.
        serial: u32,
    },
    /// The parameters in the image are invalid.
    #[error("the parameters in the flash image are invalid: {0}")]
    Parameters(#[from] protocol::parameters::ParameterError),
}

/// Encodes a flash image.
#[must_use]
pub fn encode(serial: u32, kept: &FlashContent) -> FlashImage {
    let mut bytes = FlashImage::new();
    encode_into(&mut bytes, serial, kept);
    bytes
}

/// Encodes a flash image into an empty buffer. The image is not copied, which saves stack.
pub fn encode_into(bytes: &mut FlashImage, serial: u32, kept: &FlashContent) {
    let number = kept.number.map_or(0, CellId::get);
    let serial = serial.to_le_bytes();
    let head: [&[u8]; 4] = [MAGIC, &[VERSION, number], &serial, &[kept.parameters.is_some().into()]];
    bytes.extend(head.into_iter().flatten().copied());
    match &kept.parameters {
        Some(parameters) => parameters.encode_image_parts().for_each(|part| bytes.extend(part)),
        None => bytes.extend([0; IMAGE_BYTES]),
    }
    bytes.extend(crc16(bytes).to_le_bytes());
}

/// Decodes a flash image. Never panics.
///
/// # Errors
/// Returns an error if the image has a wrong size, CRC or version, belongs to another cell (by its serial
/// number, and by its node id if `identity` has one), or its parameters are invalid.
pub fn decode(identity: Identity, bytes: &[u8]) -> Result<FlashContent, FlashError> {
    let size = FlashError::Size { got: bytes.len() };
    let Some((body, crc)) = bytes.split_last_chunk().filter(|_| (BYTES..=MAX_BYTES).contains(&bytes.len()))
    else {
        return Err(size);
    };
    if crc16(body) != u16::from_le_bytes(*crc) || !body.starts_with(MAGIC) {
        return Err(FlashError::Damaged);
    }
    let Some((&[_, _, _, _, version, cell, s0, s1, s2, s3, configured], image)) = body.split_first_chunk()
    else {
        return Err(size);
    };
    if version != VERSION {
        return Err(FlashError::Version { got: version });
    }
    let serial = u32::from_le_bytes([s0, s1, s2, s3]);
    let number = CellId::new(cell.into()).ok();
    let is_another = identity.cell.is_some() && number.is_some() && number != identity.cell;
    if is_another || serial != identity.serial {
        return Err(FlashError::OtherCell { cell, serial });
    }
    let parameters = (configured == 1).then(|| Parameters::from_image(image)).transpose()?;
    Ok(FlashContent { number, parameters })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use protocol::fixed::Q1_14;
    use protocol::parameters::Pose;

    fn identity() -> Identity {
        Identity { cell: CellId::new(12).ok(), serial: 100_012 }
    }

    fn kept() -> FlashContent {
        FlashContent { number: CellId::new(12).ok(), parameters: Some(parameters()) }
    }

    fn parameters() -> Parameters {
        let pose = Pose { normal: [Q1_14::ZERO, Q1_14::ZERO, Q1_14::nearest(1.0)], ..Pose::default() };
        Parameters { joint: 2, joints: 6, pose, period_us: 16_000, ..Parameters::default() }
    }

    // ID-3, CONF-8
    #[test]
    fn what_was_kept_comes_back_to_the_same_cell_only() {
        let bytes = encode(100_012, &kept());
        assert_eq!(&bytes[..11], b"SKIN\x02\x0c\xac\x86\x01\x00\x01");
        assert_eq!(decode(identity(), &bytes), Ok(kept()));
        assert_eq!(decode(Identity { cell: None, ..identity() }, &bytes), Ok(kept()));
        let bare = FlashContent { parameters: None, ..kept() };
        assert_eq!(decode(identity(), &encode(100_012, &bare)), Ok(bare));
        let nameless = FlashContent { number: None, ..kept() };
        assert_eq!(decode(identity(), &encode(100_012, &nameless)), Ok(nameless));
        let elsewhere = Identity { cell: CellId::new(13).ok(), ..identity() };
        assert_eq!(decode(elsewhere, &bytes), Err(FlashError::OtherCell { cell: 12, serial: 100_012 }));
        let other = Identity { serial: 7, ..identity() };
        assert_eq!(decode(other, &bytes), Err(FlashError::OtherCell { cell: 12, serial: 100_012 }));
        assert_eq!(decode(identity(), &bytes[1..]), Err(FlashError::Size { got: BYTES - 1 }));
    }

    proptest! {
        #[test]
        fn one_wrong_bit_is_noticed(bit in 0..BYTES * 8) {
            let mut bytes = encode(100_012, &kept());
            bytes[bit / 8] ^= 1 << (bit % 8);
            prop_assert_eq!(decode(identity(), &bytes), Err(FlashError::Damaged));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = decode(identity(), &bytes);
        }
    }
}
