//! Reassembly of frames to packets, with counters of rejected frames.

use protocol::can::{Format, Frame};
use protocol::id::Id;
use protocol::message::RejectedCounts;
use protocol::packet::{Lengths, PacketError, PacketRef, Reassembler, Reassembly};
use protocol::time::Micros;

use super::{MAX_RECEIVED_IDS, increment};

/// The reassembly buffers, and the counters of rejected frames.
#[derive(Debug)]
pub(super) struct Receiver {
    format: Format,
    /// The reassembly buffer of each received identifier.
    segments: [Reassembler; MAX_RECEIVED_IDS],
    /// Counters of rejected frames, by reason.
    pub(super) refused: RejectedCounts,
}

impl Receiver {
    #[inline(never)]
    pub(super) fn new(format: Format) -> Self {
        Self { format, segments: [Reassembler::NONE; MAX_RECEIVED_IDS], refused: RejectedCounts::default() }
    }

    /// Returns the packet that a frame contains or completes, if any. Joints, torques and sums have one of `lengths`.
    pub(super) fn receive_frame<'f>(
        &'f mut self,
        arrived: Micros,
        id: Id,
        slot: usize,
        lengths: Lengths,
        frame: &'f Frame,
    ) -> Option<PacketRef<'f>> {
        let packet = match self.format {
            Format::Fd => PacketRef::from_fd(frame),
            Format::Classic if frame.format() != Format::Classic => {
                Err(PacketError::Length { expected: 8, got: frame.data().len() })
            }
            Format::Classic => {
                match self.segments.get_mut(slot)?.push_borrowed(arrived, id, lengths, frame.data()) {
                    Ok(Reassembly::Waiting) => return None,
                    Ok(Reassembly::Incomplete | Reassembly::Ambiguous) => {
                        increment(&mut self.refused.incomplete);
                        return None;
                    }
                    Ok(Reassembly::Complete(packet)) => Ok(packet),
                    Err(error) => Err(error),
                }
            }
        };
        match packet {
            Ok(packet) => return Some(packet),
            Err(PacketError::Length { .. }) => increment(&mut self.refused.length),
            Err(PacketError::Crc { .. }) => increment(&mut self.refused.crc),
            Err(_) => increment(&mut self.refused.foreign),
        }
        None
    }
}
