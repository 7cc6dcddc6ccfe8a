//! Reassembly of packets from classic frames.

use core::ops::Range;

use super::{Length, Lengths, MAX_BYTES, Packet, PacketError, PacketRef, SEGMENT_BYTES};
use crate::id::{Command, Id, Kind};
use crate::time::{Micros, Span};

/// The result of adding a classic frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Reassembly<P = Packet> {
    /// The packet still lacks segments.
    Waiting,
    /// The packet is complete and its CRC is correct.
    Complete(P),
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
    /// The data of the pending segments without gaps, so that a packet can be read where it lies.
    bytes: [u8; MAX_BYTES],
    /// The pending segments in the order of their arrival. Only the first `waiting` are in use.
    segments: [PendingSegment; Length::MAX_SEGMENTS],
    waiting: u8,
    /// Number of segments at the front of the buffer that may belong to a packet already reported as incomplete. That
    /// packet is not reported again.
    reported: u8,
    /// True if a packet was lost before the last complete one and has not been reported yet.
    unreported_loss: bool,
}

#[derive(Clone, Copy, Debug, Default)]
struct PendingSegment {
    arrived: Micros,
    byte_count: u8,
}

impl Reassembler {
    /// The maximum time between the segments of joints, torques and sums. It is less than the usual 16 ms between two
    /// broadcasts, so that segments of different packets are rarely combined: one in 65 536 such combinations has a
    /// correct CRC.
    const MAX_PERIODIC_SEGMENT_GAP: Span = Span::from_millis(15);
    /// The maximum time between the segments of all other packets. Most of them are sent only once, so no later packet
    /// can be mixed in.
    const MAX_SEGMENT_GAP: Span = Span::from_millis(100);

    /// An empty buffer.
    pub const NONE: Self = Self {
        bytes: [0; MAX_BYTES],
        segments: [PendingSegment { arrived: Micros(0), byte_count: 0 }; Length::MAX_SEGMENTS],
        waiting: 0,
        reported: 0,
        unreported_loss: false,
    };

    /// Returns the maximum time from the arrival of the first segment of a packet to that of the last.
    #[must_use]
    pub fn max_gap(id: Id) -> Span {
        let is_periodic = matches!(id.kind, Kind::Sum | Kind::Torque) || id == Id::command(Command::Joints);
        if is_periodic { Self::MAX_PERIODIC_SEGMENT_GAP } else { Self::MAX_SEGMENT_GAP }
    }

    /// Returns true if the buffer holds a segment of an incomplete packet.
    #[must_use]
    pub const fn is_waiting(&self) -> bool {
        self.waiting > 0
    }

    /// Returns the number of segments in the buffer.
    #[must_use]
    pub fn waiting_segment_count(&self) -> usize {
        self.waiting.into()
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
        Ok(match self.push_borrowed(at, id, lengths, data)? {
            Reassembly::Complete(packet) => Reassembly::Complete(packet.to_packet()),
            Reassembly::Waiting => Reassembly::Waiting,
            Reassembly::Incomplete => Reassembly::Incomplete,
            Reassembly::Ambiguous => Reassembly::Ambiguous,
        })
    }

    /// Like [`push`](Self::push), with a complete packet where it lies in the buffer.
    ///
    /// # Errors
    /// Returns an error as [`push`](Self::push) does.
    pub fn push_borrowed(
        &mut self,
        at: Micros,
        id: Id,
        lengths: Lengths,
        data: &[u8],
    ) -> Result<Reassembly<PacketRef<'_>>, PacketError> {
        let lengths = lengths.restricted_to(id);
        if data.len() != SEGMENT_BYTES
            && !lengths.iter().any(|length| data.len() == length.last_segment_bytes())
        {
            return Err(PacketError::Length { expected: SEGMENT_BYTES, got: data.len() });
        }
        if self.waiting_segment_count() == Length::MAX_SEGMENTS {
            self.drop_segments(1);
        }
        self.append(at, data);

        let within = Self::max_gap(id);
        let mut found = None;
        let mut belong_together = false;
        for length in lengths.iter() {
            let Some((place, since)) = self.segments_of_last(length) else { continue };
            if PacketRef::decode(id, self.bytes.get(place.clone()).unwrap_or_default()).is_err() {
                continue;
            }
            if at.elapsed_since(since) > within {
                belong_together = true;
            } else if found.replace((place, length)).is_some() {
                self.clear();
                return Ok(Reassembly::Ambiguous);
            }
        }
        let Some((place, length)) = found else {
            return Ok(self.drop_oldest(at, within, lengths.longest().segments(), belong_together));
        };
        let older = self.waiting_segment_count().saturating_sub(length.segments());
        let lost = older > usize::from(self.reported) || self.unreported_loss;
        self.clear();
        self.unreported_loss = lost;
        let packet = self.bytes.get(place).and_then(|bytes| PacketRef::split(id, length, bytes));
        Ok(packet.map_or(Reassembly::Incomplete, |(packet, _)| Reassembly::Complete(packet)))
    }

    /// Removes all segments, and forgets losses that have not been reported. Their bytes stay, for a packet that is
    /// read where it lies.
    const fn clear(&mut self) {
        (self.waiting, self.reported, self.unreported_loss) = (0, 0, false);
    }

    /// Returns the pending segments.
    fn pending(&self) -> &[PendingSegment] {
        self.segments.get(..self.waiting_segment_count()).unwrap_or_default()
    }

    /// Returns the number of bytes of the first `count` segments.
    fn byte_count(&self, count: usize) -> usize {
        self.pending().iter().take(count).map(|segment| usize::from(segment.byte_count)).sum()
    }

    /// Appends a segment, for which there must be room.
    fn append(&mut self, at: Micros, data: &[u8]) {
        let first = self.byte_count(self.waiting_segment_count());
        if let (Some(segment), Some(place), Ok(byte_count)) = (
            self.segments.get_mut(usize::from(self.waiting)),
            self.bytes.get_mut(first..first + data.len()),
            u8::try_from(data.len()),
        ) {
            if let (Some(place), Some(data)) = (place.first_chunk_mut(), data.first_chunk::<SEGMENT_BYTES>())
            {
                // Not a call of memcpy, which takes a Cortex-M0 longer.
                *place = *data;
            } else {
                place.copy_from_slice(data);
            }
            *segment = PendingSegment { arrived: at, byte_count };
            self.waiting += 1;
        }
    }

    /// Drops the oldest `count` segments.
    fn drop_segments(&mut self, count: usize) {
        let bytes = self.byte_count(count);
        self.bytes.copy_within(bytes.., 0);
        self.segments.copy_within(count.min(Length::MAX_SEGMENTS).., 0);
        self.waiting = self.waiting.saturating_sub(u8::try_from(count).unwrap_or(u8::MAX));
    }

    /// Returns the place of the bytes of the newest segments that together have this length, and the arrival time of
    /// the first of them. Returns `None` if segments are missing or have other sizes.
    fn segments_of_last(&self, length: Length) -> Option<(Range<usize>, Micros)> {
        let skipped = self.waiting_segment_count().checked_sub(length.segments())?;
        let (first, end) = (self.byte_count(skipped), self.byte_count(self.waiting_segment_count()));
        let since = self.pending().get(skipped)?.arrived;
        (end - first == length.bytes()).then_some((first..end, since))
    }

    /// Handles a segment that completes no packet. Drops the segments that are too old. If there are none, drops the
    /// oldest segment once the buffer holds as many as the longest packet has.
    fn drop_oldest(
        &mut self,
        now: Micros,
        within: Span,
        segments: usize,
        belong_together: bool,
    ) -> Reassembly<PacketRef<'static>> {
        let is_late = |segment: &&PendingSegment| now.elapsed_since(segment.arrived) > within;
        let late = self.pending().iter().filter(is_late).count();
        let dropped =
            if late > 0 { late } else { (self.waiting_segment_count() + 1).saturating_sub(segments) };
        let reported = usize::from(self.reported);
        let is_new = dropped > reported;
        let reported = match (is_new, late > 0 && !belong_together) {
            _ if dropped == 0 => reported,
            (true, false) => segments - 1,
            (true, true) => 0,
            (false, _) => reported - dropped,
        };
        if dropped > 0 {
            self.drop_segments(dropped);
        }
        self.reported = u8::try_from(reported).unwrap_or(u8::MAX);
        let unreported = core::mem::take(&mut self.unreported_loss);
        if is_new || unreported { Reassembly::Incomplete } else { Reassembly::Waiting }
    }
}
