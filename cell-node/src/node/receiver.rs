//! From frames to packets: reassembly of segments by slot, and counts of what cannot be used.

use protocol::can::{Format, Frame};
use protocol::id::Id;
use protocol::message::Refused;
use protocol::packet::{Lengths, Packet, PacketError, Reassembly, Segment};
use protocol::time::Micros;

use super::{HEARD, count};

/// First segments that wait for the second, and counts of what was refused.
#[derive(Debug)]
pub(super) struct Receiver {
    format: Format,
    /// By slot of the identifier among those that are received.
    segments: [Segment; HEARD],
    /// What cannot be used, by its reason.
    pub(super) refused: Refused,
}

impl Receiver {
    #[inline(never)]
    pub(super) fn new(format: Format) -> Self {
        Self { format, segments: [Segment::NONE; HEARD], refused: Refused::default() }
    }

    /// The packet that this frame, which arrived then, is or completes.
    /// Joints, torques and sums have one of these lengths.
    pub(super) fn take(
        &mut self,
        arrived: Micros,
        id: Id,
        slot: usize,
        lengths: Lengths,
        frame: &Frame,
    ) -> Option<Packet> {
        let packet = match self.format {
            Format::Fd => Packet::from_fd(frame),
            Format::Classic if frame.format() != Format::Classic => {
                Err(PacketError::Length { expected: 8, got: frame.data().len() })
            }
            Format::Classic => match self.segments.get_mut(slot)?.push(arrived, id, lengths, frame.data()) {
                Ok(Reassembly::Waiting) => return None,
                Ok(Reassembly::Incomplete | Reassembly::Ambiguous) => {
                    count(&mut self.refused.incomplete);
                    return None;
                }
                Ok(Reassembly::Complete(packet)) => Ok(packet),
                Err(error) => Err(error),
            },
        };
        match packet {
            Ok(packet) => return Some(packet),
            Err(PacketError::Length { .. }) => count(&mut self.refused.length),
            Err(PacketError::Crc { .. }) => count(&mut self.refused.crc),
            Err(_) => count(&mut self.refused.foreign),
        }
        None
    }
}
