//! The factory record of a firmware cell: a section in flash with the node id, serial number and wires. The
//! manufacturer writes it into the program file before the program is loaded into the microcontroller.
//!
//! ```text
//!   byte 0..3  "CELL"                         4  version, 1       5  the node id, 0 for none
//!        6     flags: 1 classic frames, 2 an emulator that keeps the cell's flash in a file
//!        7     0                           8..11 serial number, little endian
//!        12    by port, whether it is wired (bit 4: to the gateway's side)
//!        13    by port, which direction of the wire it sends in
//!        14..23 by port, the wire's number, little endian
//!        24..29 0                          30..31 CRC-16 over all bytes before it, little endian
//! ```
//!
//! Only cells on a bench have wires in this record, because the bench simulates wires with frames ([`crate::port`]).

use crate::can::Format;
use crate::id::CellId;
use crate::packet::crc16;
use crate::port::{LinkId, PORTS};

/// Size of a record in bytes.
pub const RECORD_BYTES: usize = 32;
/// The linker section that holds the record.
pub const SECTION: &str = ".factory";
/// The bytes of a record that was not written: erased flash.
pub const ERASED_RECORD: [u8; RECORD_BYTES] = [0xFF; RECORD_BYTES];

const RECORD_MAGIC: &[u8; 4] = b"CELL";
const RECORD_VERSION: u8 = 1;
const CLASSIC_CAN_FLAG: u8 = 1;
const HOSTED_FLAG: u8 = 2;

/// The settings of a cell that its manufacturer chooses.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct FactoryRecord {
    /// The node id, if assigned at the factory.
    pub node: Option<CellId>,
    /// The serial number.
    pub serial: u32,
    /// The frame format of the cell's bus.
    pub format: Format,
    /// True if the cell runs in an emulator that keeps the flash in a file.
    pub hosted: bool,
    /// The link id that each port sends with. The last entry is the uplink to the gateway's side.
    pub link_ids: [Option<LinkId>; PORTS + 1],
}

impl FactoryRecord {
    /// Encodes the record.
    #[must_use]
    pub fn encode(&self) -> [u8; RECORD_BYTES] {
        let flag = |set, flag| if set { flag } else { 0 };
        let flags = flag(self.format == Format::Classic, CLASSIC_CAN_FLAG) | flag(self.hosted, HOSTED_FLAG);
        let [s0, s1, s2, s3] = self.serial.to_le_bytes();
        let (mut wired, mut back, mut wires) = (0, 0, [0; 2 * (PORTS + 1)]);
        for ((port, link_id), wire) in self.link_ids.iter().enumerate().zip(wires.as_chunks_mut().0) {
            let Some(link_id) = link_id else { continue };
            wired |= 1 << port;
            back |= flag(link_id.back, 1 << port);
            *wire = link_id.wire.to_le_bytes();
        }
        let head = [RECORD_VERSION, self.node.map_or(0, CellId::get), flags, 0, s0, s1, s2, s3, wired, back];
        let body: [&[u8]; 3] = [RECORD_MAGIC, &head, &wires];
        let mut bytes = [0; RECORD_BYTES];
        for (byte, value) in bytes.iter_mut().zip(body.into_iter().flatten()) {
            *byte = *value;
        }
        if let Some((body, crc)) = bytes.split_last_chunk_mut() {
            *crc = crc16(body).to_le_bytes();
        }
        bytes
    }

    /// Decodes a record. Returns `None` if it was not written or is damaged. Never panics.
    #[must_use]
    pub fn decode(bytes: &[u8; RECORD_BYTES]) -> Option<Self> {
        let (body, crc) = bytes.split_last_chunk()?;
        let (magic, rest) = body.split_first_chunk::<4>()?;
        let (&[version, node, flags, _, s0, s1, s2, s3, wired, back], rest) = rest.split_first_chunk()?;
        if magic != RECORD_MAGIC || version != RECORD_VERSION || crc16(body) != u16::from_le_bytes(*crc) {
            return None;
        }
        let (wires, _) = rest.as_chunks();
        let link_id = |port: usize| {
            let bit = 1 << port;
            let wire = u16::from_le_bytes(*wires.get(port)?);
            (wired & bit != 0).then_some(LinkId { wire, back: back & bit != 0 })
        };
        Some(Self {
            node: CellId::new(node.into()).ok(),
            serial: u32::from_le_bytes([s0, s1, s2, s3]),
            format: if flags & CLASSIC_CAN_FLAG == 0 { Format::Fd } else { Format::Classic },
            hosted: flags & HOSTED_FLAG != 0,
            link_ids: core::array::from_fn(link_id),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn link_id() -> impl Strategy<Value = Option<LinkId>> {
        proptest::option::of((any::<u16>(), any::<bool>()).prop_map(|(wire, back)| LinkId { wire, back }))
    }

    #[test]
    fn a_record_is_laid_out_as_its_table_says() {
        let mut link_ids = [None; PORTS + 1];
        link_ids[1] = Some(LinkId { wire: 0x0203, back: false });
        link_ids[4] = Some(LinkId { wire: 7, back: true });
        let node = CellId::new(12).ok();
        let factory =
            FactoryRecord { node, serial: 100_012, format: Format::Classic, hosted: true, link_ids };
        let bytes = factory.encode();
        assert_eq!(bytes[..14], *b"CELL\x01\x0c\x03\0\xac\x86\x01\0\x12\x10");
        assert_eq!(bytes[14..30], [0, 0, 3, 2, 0, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn erased_flash_is_no_record() {
        assert_eq!(FactoryRecord::decode(&ERASED_RECORD), None);
        assert_eq!(FactoryRecord::decode(&[0; RECORD_BYTES]), None);
    }

    proptest! {
        #[test]
        fn every_record_comes_back_and_no_wrong_bit_passes(
            node in 0_i64..=254, serial: u32, classic: bool, hosted: bool,
            link_ids in proptest::array::uniform5(link_id()), bit in 0..RECORD_BYTES * 8,
        ) {
            let format = if classic { Format::Classic } else { Format::Fd };
            let factory = FactoryRecord { node: CellId::new(node).ok(), serial, format, hosted, link_ids };
            let mut bytes = factory.encode();
            prop_assert_eq!(FactoryRecord::decode(&bytes), Some(factory));
            bytes[bit / 8] ^= 1 << (bit % 8);
            prop_assert_eq!(FactoryRecord::decode(&bytes), None);
        }
    }
}
