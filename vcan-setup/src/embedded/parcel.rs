//! The datagrams by which clients and the server of a bus exchange frames.

use protocol::bus::embedded::OWN_FRAME_BYTE_INDEX;
use protocol::can::{FD_BYTES, FD_FORMAT, Format, Frame};

/// The index of the byte that holds the FD flags.
const FD_FLAGS_BYTE_INDEX: usize = 5;

/// A frame in the form in which the bus forwards it: a `struct can_frame` or `struct canfd_frame`.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct FrameDatagram {
    bytes: [u8; FD_BYTES],
    id: u32,
    format: Format,
}

impl FrameDatagram {
    /// Checks a client's datagram. Returns `None` if it is not a frame that `CAN_RAW` would send.
    ///
    /// The datagram must have the size of one of the structs, and the length field must fit the struct. FD frames are
    /// accepted only if the client has enabled CAN FD (`fd`). An FD frame gets the flag FDF, as in kernels from 6.1 on.
    /// The mark for own frames is removed. All other bytes are forwarded unchanged. Never panics.
    #[must_use]
    pub fn from_client_datagram(datagram: &[u8], fd: bool) -> Option<Self> {
        let frame = Frame::from_bytes(datagram).ok()?;
        if frame.format() == Format::Fd && !fd {
            return None;
        }
        let mut bytes = [0; FD_BYTES];
        bytes.get_mut(..datagram.len())?.copy_from_slice(datagram);
        if frame.format() == Format::Fd {
            *bytes.get_mut(FD_FLAGS_BYTE_INDEX)? |= FD_FORMAT;
        }
        *bytes.get_mut(OWN_FRAME_BYTE_INDEX)? = 0;
        Some(Self { bytes, id: frame.raw_id(), format: frame.format() })
    }

    /// Returns the frame with the mark that tells a client whether the frame is its own.
    #[must_use]
    pub fn with_own_mark(mut self, own: bool) -> Self {
        if let Some(byte) = self.bytes.get_mut(OWN_FRAME_BYTE_INDEX) {
            *byte = own.into();
        }
        self
    }

    /// Returns the identifier with its flag bits, as in `can_id`.
    #[must_use]
    pub const fn raw_id(&self) -> u32 {
        self.id
    }

    /// Returns the format: classic or FD.
    #[must_use]
    pub const fn format(&self) -> Format {
        self.format
    }

    /// Returns the bytes of the larger struct, of which the datagram is the first [`FrameDatagram::byte_len`].
    #[must_use]
    pub const fn bytes(&self) -> &[u8; FD_BYTES] {
        &self.bytes
    }

    /// Returns the length of the datagram in bytes: 16 for a classic frame, 72 for an FD frame.
    #[must_use]
    pub const fn byte_len(&self) -> usize {
        self.format.byte_len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::embedded::cases;
    use proptest::prelude::*;

    #[test]
    fn what_can_raw_refuses_to_send_is_refused() {
        for case in cases::refused() {
            assert_eq!(FrameDatagram::from_client_datagram(&case.datagram, case.fd), None, "{}", case.what);
        }
    }

    #[test]
    fn the_fdf_flag_is_set_and_the_own_mark_cannot_be_forged() {
        let mut bytes = Frame::with_data(0x201, Format::Fd, 1, &[7]).unwrap().to_bytes();
        bytes[OWN_FRAME_BYTE_INDEX] = 1;
        let parcel = FrameDatagram::from_client_datagram(&bytes, true).unwrap();
        assert_eq!(parcel.bytes()[4..9], [1, 1 | FD_FORMAT, 0, 0, 7]);
        assert_eq!(parcel.with_own_mark(true).bytes()[OWN_FRAME_BYTE_INDEX], 1);
        assert_eq!(parcel.with_own_mark(true).with_own_mark(false), parcel);
    }

    proptest! {
        #[test]
        fn a_frame_passes_unchanged(id: u32, fd: bool, data in proptest::collection::vec(any::<u8>(), 0..=8)) {
            let frame = if fd { Frame::fd(id, 1, &data) } else { Frame::classic(id, &data) }.unwrap();
            let parcel = FrameDatagram::from_client_datagram(&frame.to_bytes()[..frame.byte_len()], true).unwrap();
            prop_assert_eq!(&parcel.bytes()[..parcel.byte_len()], &frame.to_bytes()[..frame.byte_len()]);
            prop_assert_eq!((parcel.raw_id(), parcel.format()), (frame.raw_id(), frame.format()));
        }

        #[test]
        fn no_datagram_panics(bytes in proptest::collection::vec(any::<u8>(), 0..80), fd: bool) {
            let _ = FrameDatagram::from_client_datagram(&bytes, fd);
        }
    }
}
