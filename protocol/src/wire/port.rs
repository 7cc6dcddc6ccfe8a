//! Messages that two neighbouring cells exchange over the wire between their ports, and the simulation of such wires on
//! a bench.
//!
//! A wire connects two ports and is not part of any bus. The bench simulates wires on the cells' bus with classic
//! frames with 29-bit identifiers, which only the cell at the other end of the wire accepts. They are never sent to a
//! real bus.
//!
//! ```text
//!   identifier   28 | 27 ... 1 | 0                byte  0     1 ... 5     6  7
//!                 1 |   wire   | direction              kind  the kind's   CRC-16 over the identifier
//!                                                                          (4 bytes) and bytes 0 to 5
//! ```
//!
//! | kind | name | bytes 1 to 5 | meaning |
//! |---|---|---|---|
//! | 1 | hello | version, node id, port + flags, round, depth | periodic: the sender's state and rank |
//! | 2 | join | | requests to send sums to the receiver |
//! | 3 | grant | round, depth | accepts a join; the sender's rank |
//! | 4 | refuse | | rejects a join, or a hello from a cell that is not a child |
//! | 5 | leave | | the sender is no longer a child of the receiver |
//! | 6 | leave_ack | | acknowledges leave: no sum of the receiver is taken from now on |
//! | 7 | state | epoch | the sender's sums from this epoch on are for the receiver |
//! | 8 | nack | epoch | the receiver's sum of this epoch was not taken |
//! | 9 | repair | round | the sender is unreachable: requests a round later than this one |
//! | 10 | node_id | walk, first, last | node ids for the receiver and the cells below it |
//! | 11 | return | walk, first, last | the walk is done; the node ids that remain (none when first > last) |
//! | 12 | probe | | requests a hello |

use crate::can::{EXTENDED, EXTENDED_MASK, Format, Frame, REMOTE};
use crate::packet::{Epoch, crc16};

/// Bit that is set in the identifiers of all simulated wires.
pub const WIRE_FLAG: u32 = 0x1000_0000;
/// Maximum number of wires that a bus can simulate.
pub const MAX_WIRES: usize = 1 << 16;
/// Number of ports of a cell.
pub const PORTS: usize = 4;
/// Index of the uplink, the wire of a root to the gateway's side. It follows the ports.
pub const UPLINK: usize = PORTS;
/// Size of a message with its CRC, in bytes.
pub const MESSAGE_BYTES: usize = 8;

/// The identifier of one direction of a simulated wire: the frames that one end sends.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct LinkId {
    /// The number of the wire on its bus.
    pub wire: u16,
    /// True for the second of the two directions.
    pub back: bool,
}

/// The distance to the gateway, and the version of the tree to which it belongs.
///
/// A cell's rank only ever improves: to a later round, or to a smaller depth in the same round. A cell accepts a parent
/// only if the parent's rank is better than its own, so that parents never form a loop.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub struct TreeRank {
    /// Round of the exploration in which the depth was determined (the version of the tree), modulo 2^8.
    pub round: u8,
    /// Number of wires between the sender and the gateway: 0 for the gateway, 1 for a root.
    pub depth: u8,
}

impl TreeRank {
    /// Returns true if this rank is better than `other`: of a later round, or with a smaller depth in the same round.
    #[must_use]
    pub const fn is_better_than(self, other: Self) -> bool {
        match self.round.wrapping_sub(other.round).cast_signed() {
            0 => self.depth < other.depth,
            later => later > 0,
        }
    }

    /// Returns the rank of a child, one wire deeper.
    #[must_use]
    pub const fn child_rank(self) -> Self {
        Self { round: self.round, depth: self.depth.saturating_add(1) }
    }
}

/// The hello: a message that a cell sends periodically over every port, with its state and rank.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Hello {
    /// Protocol version of the sender.
    pub version: u8,
    /// Node id of the sender; 0 for the gateway and for a cell without a node id.
    pub number: u8,
    /// Number of the port that sends the hello.
    pub port: u8,
    /// True if the sender receives hellos over this wire.
    pub receives: bool,
    /// True if the receiver is the parent, to which the sender sends its sums.
    pub is_parent: bool,
    /// True if the sender, or a cell below it, has no node id yet.
    pub unnumbered: bool,
    /// The rank of the sender; `None` while it is unreachable.
    pub rank: Option<TreeRank>,
}

/// A message over a wire.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum PortMessage {
    /// The sender's state and rank.
    Hello(Hello),
    /// Requests to become a child of the receiver and send it sums.
    Join,
    /// Accepts a join, with the sender's rank.
    Grant(TreeRank),
    /// Rejects a join, or answers a hello of a cell that takes the sender for its parent but is not its child.
    Refuse,
    /// Reports that the sender is not a child of the receiver any more.
    Leave,
    /// Acknowledges a leave.
    LeaveAck,
    /// Announces that from this epoch on, the sender's sums are for the receiver.
    State(Epoch),
    /// Reports that the receiver's sum of this epoch was not accepted.
    Nack(Epoch),
    /// Reports that the sender is unreachable, and requests a round later than this one.
    Repair(u8),
    /// Passes free node ids to the receiver, for itself and the cells below it.
    NodeId(NodeIdWalk),
    /// Reports that all cells below the sender have a node id, or that there were not enough, and returns the rest.
    Return(NodeIdWalk),
    /// Requests a hello.
    Probe,
}

/// The free node ids in a walk over the tree, which assigns one to each cell.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct NodeIdWalk {
    /// Number of the walk.
    pub walk: u8,
    /// First free node id.
    pub first: u8,
    /// Last free node id.
    pub last: u8,
}

const RECEIVES_FLAG: u8 = 1 << 3;
const PARENT_FLAG: u8 = 1 << 4;
const UNNUMBERED_FLAG: u8 = 1 << 5;
const HAS_RANK_FLAG: u8 = 1 << 6;

impl PortMessage {
    /// Encodes kind and content of the message, without the CRC.
    #[must_use]
    pub fn encode(self) -> [u8; 6] {
        match self {
            Self::Hello(hello) => {
                let flag = |set, flag| if set { flag } else { 0 };
                let flags = flag(hello.receives, RECEIVES_FLAG)
                    | flag(hello.is_parent, PARENT_FLAG)
                    | flag(hello.unnumbered, UNNUMBERED_FLAG)
                    | flag(hello.rank.is_some(), HAS_RANK_FLAG);
                let (round, depth) = hello.rank.map_or((0, 0), |rank| (rank.round, rank.depth));
                [1, hello.version, hello.number, (hello.port & 7) | flags, round, depth]
            }
            Self::Join => [2, 0, 0, 0, 0, 0],
            Self::Grant(rank) => [3, rank.round, rank.depth, 0, 0, 0],
            Self::Refuse => [4, 0, 0, 0, 0, 0],
            Self::Leave => [5, 0, 0, 0, 0, 0],
            Self::LeaveAck => [6, 0, 0, 0, 0, 0],
            Self::State(epoch) => [7, epoch.0, 0, 0, 0, 0],
            Self::Nack(epoch) => [8, epoch.0, 0, 0, 0, 0],
            Self::Repair(round) => [9, round, 0, 0, 0, 0],
            Self::NodeId(walk) => [10, walk.walk, walk.first, walk.last, 0, 0],
            Self::Return(walk) => [11, walk.walk, walk.first, walk.last, 0, 0],
            Self::Probe => [12, 0, 0, 0, 0, 0],
        }
    }

    const fn decode(bytes: [u8; 6]) -> Option<Self> {
        let [kind, a, b, c, d, e] = bytes;
        let walk = NodeIdWalk { walk: a, first: b, last: c };
        Some(match kind {
            1 => Self::Hello(Hello {
                version: a,
                number: b,
                port: c & 7,
                receives: c & RECEIVES_FLAG != 0,
                is_parent: c & PARENT_FLAG != 0,
                unnumbered: c & UNNUMBERED_FLAG != 0,
                rank: if c & HAS_RANK_FLAG == 0 { None } else { Some(TreeRank { round: d, depth: e }) },
            }),
            2 => Self::Join,
            3 => Self::Grant(TreeRank { round: a, depth: b }),
            4 => Self::Refuse,
            5 => Self::Leave,
            6 => Self::LeaveAck,
            7 => Self::State(Epoch(a)),
            8 => Self::Nack(Epoch(a)),
            9 => Self::Repair(a),
            10 => Self::NodeId(walk),
            11 => Self::Return(walk),
            12 => Self::Probe,
            _ => return None,
        })
    }
}

/// Returns the message of a frame over a simulated wire. Returns `None` if the identifier or the CRC is not that of a
/// wire: other buses use 29-bit identifiers, too.
#[must_use]
pub fn wire_message(frame: &Frame) -> Option<(LinkId, PortMessage)> {
    let link_id = LinkId::from_raw_id(frame.raw_id()).filter(|_| frame.format() == Format::Classic)?;
    Some((link_id, link_id.decode_frame(frame)?))
}

impl LinkId {
    /// Returns the identifier of frames with this link id, including the flag [`EXTENDED`].
    #[must_use]
    pub const fn raw_id(self) -> u32 {
        EXTENDED | WIRE_FLAG | ((self.wire as u32) << 1) | self.back as u32
    }

    /// Returns the link id for an identifier; `None` if the identifier is not that of a wire. `raw_id` includes the
    /// flags.
    #[must_use]
    pub const fn from_raw_id(raw_id: u32) -> Option<Self> {
        let bits = raw_id & EXTENDED_MASK & !WIRE_FLAG;
        if raw_id & (EXTENDED | REMOTE | WIRE_FLAG) != EXTENDED | WIRE_FLAG
            || (bits >> 1) as usize >= MAX_WIRES
        {
            return None;
        }
        let [low, high, ..] = (bits >> 1).to_le_bytes();
        Some(Self { wire: u16::from_le_bytes([low, high]), back: bits & 1 == 1 })
    }

    /// Returns the other direction of the same wire.
    #[must_use]
    pub const fn reversed(self) -> Self {
        Self { wire: self.wire, back: !self.back }
    }

    /// Encodes a message as a frame.
    #[must_use]
    pub fn encode_frame(self, message: PortMessage) -> Frame {
        let body = message.encode();
        let [a, b, c, d, e, f] = body;
        let [low, high] = self.checksum(body).to_le_bytes();
        Frame::classic(self.raw_id(), &[a, b, c, d, e, f, low, high]).unwrap_or(Frame::EMPTY)
    }

    /// Decodes the message of a frame. Returns `None` if the frame has another link id, is damaged, or has an
    /// undefined kind.
    #[must_use]
    pub fn decode_frame(self, frame: &Frame) -> Option<PortMessage> {
        let &[a, b, c, d, e, f, low, high] = frame.data() else { return None };
        let body = [a, b, c, d, e, f];
        let sound = frame.raw_id() == self.raw_id() && self.checksum(body) == u16::from_le_bytes([low, high]);
        if sound { PortMessage::decode(body) } else { None }
    }

    fn checksum(self, body: [u8; 6]) -> u16 {
        let [i0, i1, i2, i3] = (self.raw_id() & EXTENDED_MASK).to_le_bytes();
        let [a, b, c, d, e, f] = body;
        crc16(&[i0, i1, i2, i3, a, b, c, d, e, f])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_link_id_is_its_identifier() {
        let link_id = LinkId { wire: 3, back: true };
        assert_eq!(link_id.raw_id(), 0x9000_0007);
        assert_eq!(LinkId::from_raw_id(0x9000_0007), Some(link_id));
        for other in [0x1000_0007, 0x8000_0007, 0xD000_0007, 0x9002_0000] {
            assert_eq!(LinkId::from_raw_id(other), None, "{other:08X}");
        }
    }

    #[test]
    fn a_rank_of_a_later_round_or_a_smaller_depth_is_better() {
        let rank = |round, depth| TreeRank { round, depth };
        assert!(rank(1, 9).is_better_than(rank(0, 1)));
        assert!(rank(0, 9).is_better_than(rank(255, 1)));
        assert!(rank(4, 1).is_better_than(rank(4, 2)));
        assert!(!rank(4, 2).is_better_than(rank(4, 2)));
        assert!(rank(4, 2).is_better_than(rank(4, 2).child_rank()));
    }

    proptest! {
        #[test]
        fn a_message_is_read_on_its_own_link_id_only(wire: u16, back: bool, body: [u8; 6]) {
            let link_id = LinkId { wire, back };
            if let Some(message) = PortMessage::decode(body) {
                let frame = link_id.encode_frame(message);
                prop_assert_eq!(link_id.decode_frame(&frame), Some(message));
                prop_assert_eq!(link_id.reversed().decode_frame(&frame), None);
            }
        }

        #[test]
        fn one_wrong_bit_is_noticed(bit in 0_usize..64, body: [u8; 5]) {
            let [a, b, c, ..] = body;
            let link_id = LinkId { wire: 7, back: false };
            let frame = link_id.encode_frame(PortMessage::NodeId(NodeIdWalk { walk: a, first: b, last: c }));
            let mut data: [u8; MESSAGE_BYTES] = frame.data().try_into().unwrap();
            data[bit / 8] ^= 1 << (bit % 8);
            let damaged = Frame::classic(frame.raw_id(), &data).unwrap();
            prop_assert_eq!(link_id.decode_frame(&damaged), None);
        }
    }
}
