//! Reassembly of packets from classic frames.

use heapless::Deque;

use super::{Length, Lengths, MAX_BYTES, Packet, PacketError, SEGMENT_BYTES};
use crate::id::{Command, Id, Kind};
use crate::time::{Micros, Span};

/// The result of adding a classic frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Reassembly {
    /// The packet still lacks segments.
    Waiting,
    /// The packet is complete and its CRC is correct.
    Complete(Packet),
    /// A packet was lost: its segments do not fit together, or arrived too far apart. The oldest segment is dropped,
    /// and the one after it counts as the first. Returned once for each lost packet of which several segments arrived.
    Incomplete,
    /// The segment completes packets of several lengths with correct CRCs; all of them are dropped.
    Ambiguous,
}

/// The reassembly buffer for one identifier: the segments received so far of one packet.
///
/// Segments arrive in order. The last segment of a packet arrives within [`Reassembler::max_gap`] after the first. The
/// length of a packet follows from its kind and the chain of its bus; if the chain is unknown, all lengths are tried.
/// If the CRC is wrong, only the oldest segment is dropped, so that a lost frame costs one packet and not all later
/// ones.
#[derive(Clone, Debug, Default)]
pub struct Reassembler {
    waiting: Deque<PendingSegment, { Length::MAX_SEGMENTS }>,
    /// Number of segments at the front of the buffer that may belong to a packet already reported as incomplete. That
    /// packet is not reported again.
    reported: usize,
    /// True if a packet was lost before the last complete one and has not been reported yet.
    unreported_loss: bool,
}

#[derive(Clone, Copy, Debug)]
struct PendingSegment {
    data: [u8; SEGMENT_BYTES],
    len: usize,
    since: Micros,
}

impl Reassembler {
    /// The maximum time between the segments of joints, torques and sums. It is less than the usual 16 ms between two
    /// broadcasts, so that segments of different packets are rarely combined: one in 65 536 such combinations has a
    /// correct CRC.
    const MAX_PERIODIC_GAP: Span = Span::from_millis(15);
    /// The maximum time between the segments of all other packets. Most of them are sent only once, so no later packet
    /// can be mixed in.
    const MAX_GAP: Span = Span::from_millis(100);

    /// An empty buffer.
    pub const NONE: Self = Self { waiting: Deque::new(), reported: 0, unreported_loss: false };

    /// Returns the maximum time from the arrival of the first segment of a packet to that of the last.
    #[must_use]
    pub fn max_gap(id: Id) -> Span {
        let is_periodic = matches!(id.kind, Kind::Sum | Kind::Torque) || id == Id::command(Command::Joints);
        if is_periodic { Self::MAX_PERIODIC_GAP } else { Self::MAX_GAP }
    }

    /// Returns true if the buffer holds a segment of an incomplete packet.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Returns the number of segments in the buffer.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Adds the next classic frame with this identifier. Its packets can have one of `lengths`, restricted to the
    /// lengths that the identifier allows ([`Lengths::for_id`]).
    ///
    /// # Errors
    /// Returns an error if no segment of packets with these lengths has the size of the frame. The buffer does not
    /// change then.
    pub fn push(
        &mut self,
        at: Micros,
        id: Id,
        lengths: Lengths,
        data: &[u8],
    ) -> Result<Reassembly, PacketError> {
        let lengths = lengths.restricted_to(id);
        if !lengths.iter().any(|length| [SEGMENT_BYTES, length.last_segment()].contains(&data.len())) {
            return Err(PacketError::Length { expected: SEGMENT_BYTES, got: data.len() });
        }
        let mut newest = PendingSegment { data: [0; SEGMENT_BYTES], len: data.len(), since: at };
        for (byte, &data) in newest.data.iter_mut().zip(data) {
            *byte = data;
        }
        if self.waiting.is_full() {
            self.waiting.pop_front();
        }
        let _ = self.waiting.push_back(newest);

        let within = Self::max_gap(id);
        let mut found = None;
        let mut belong_together = false;
        for length in lengths.iter() {
            let Some((packet, since)) = self.packet_ending_with(id, length) else { continue };
            if at.elapsed_since(since) > within {
                belong_together = true;
            } else if found.replace((packet, length.segments())).is_some() {
                *self = Self::NONE;
                return Ok(Reassembly::Ambiguous);
            }
        }
        if let Some((packet, segments)) = found {
            let lost = self.waiting.len().saturating_sub(segments) > self.reported || self.unreported_loss;
            *self = Self { unreported_loss: lost, ..Self::NONE };
            return Ok(Reassembly::Complete(packet));
        }
        Ok(self.drop_oldest(at, within, lengths.longest().segments(), belong_together))
    }

    /// Returns the packet of this length that ends with the newest segment, and the arrival time of its first segment.
    /// Returns `None` if the CRC is wrong or segments are missing.
    fn packet_ending_with(&self, id: Id, length: Length) -> Option<(Packet, Micros)> {
        let skipped = self.waiting.len().checked_sub(length.segments())?;
        let mut bytes = [0; MAX_BYTES];
        let mut rest = bytes.get_mut(..length.bytes())?;
        let mut since = None;
        for segment in self.waiting.iter().skip(skipped) {
            since.get_or_insert(segment.since);
            let (place, after) = rest.split_at_mut_checked(segment.len)?;
            place.copy_from_slice(segment.data.get(..segment.len)?);
            rest = after;
        }
        if !rest.is_empty() {
            return None;
        }
        let packet = Packet::decode(id, bytes.get(..length.bytes())?).ok()?;
        Some((packet, since?))
    }

    /// Handles a segment that completes no packet. Drops the segments that are too old. If there are none, drops the
    /// oldest segment once the buffer holds as many as the longest packet has.
    fn drop_oldest(
        &mut self,
        now: Micros,
        within: Span,
        segments: usize,
        belong_together: bool,
    ) -> Reassembly {
        let is_late = |waiting: &PendingSegment| now.elapsed_since(waiting.since) > within;
        let late = self.waiting.iter().filter(|waiting| is_late(waiting)).count();
        let dropped = if late > 0 { late } else { (self.waiting.len() + 1).saturating_sub(segments) };
        for _ in 0..dropped {
            self.waiting.pop_front();
        }
        let is_new = dropped > self.reported;
        self.reported = match (is_new, late > 0 && !belong_together) {
            _ if dropped == 0 => self.reported,
            (true, false) => segments - 1,
            (true, true) => 0,
            (false, _) => self.reported - dropped,
        };
        let owed = core::mem::take(&mut self.unreported_loss);
        if is_new || owed { Reassembly::Incomplete } else { Reassembly::Waiting }
    }
}
