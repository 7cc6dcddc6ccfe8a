//! Counts of foreign frames by identifier.

use core::cmp::Reverse;
use std::collections::BTreeMap;

use protocol::can::{ERROR, EXTENDED, EXTENDED_MASK, Frame, STANDARD_MASK};
use serde::Serialize;

use super::{TimedCount, nanos_to_seconds};
use model::decode::ForeignReason;
use protocol::packet::{Length, Lengths, PacketError, data_frame_id};

/// Maximum number of identifiers of a bus that are counted separately. Frames with further identifiers share one count.
const MAX_COUNTED_IDENTIFIERS: usize = 4096;

/// The type of a foreign frame.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FrameType {
    /// A data frame.
    Data,
    /// A remote frame.
    Remote,
    /// The driver's error report; its identifier contains the kind of error.
    Error,
}

/// Counts the foreign frames of a bus.
#[derive(Debug, Default)]
pub(super) struct ForeignCounter {
    identifiers: BTreeMap<(FrameType, u32), IdentifierCounts>,
    /// Number of frames with identifiers that are not counted separately.
    others: u64,
    /// Number of frames, or groups of frames, whose CRC was checked: a frame by itself, or together with the frames
    /// before it that could be segments of the same packet.
    checked_groups: u64,
}

#[derive(Clone, Copy, Debug)]
struct IdentifierCounts {
    count: TimedCount,
    bytes: (u8, u8),
    wrong_crc: u64,
}

/// Counts of the frames that do not belong to this protocol.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ForeignFrames {
    /// Total number of frames.
    pub frames: u64,
    /// Data frames with an 11-bit identifier.
    pub standard: u64,
    /// Data frames with a 29-bit identifier.
    pub extended: u64,
    /// Remote frames.
    pub remote: u64,
    /// The driver's error frames.
    pub error: u64,
    /// Number of packets that are expected by chance if the chain is unknown: one in 65 536 of the checked groups of
    /// frames has a valid CRC. Such frames count as packets.
    pub packets_by_chance: f64,
    /// Counts by identifier, largest first.
    pub identifiers: Vec<ForeignId>,
    /// Frames with identifiers beyond the 4096 that are counted separately.
    pub frames_of_other_identifiers: u64,
}

/// Counts of the foreign frames with one identifier.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ForeignId {
    /// The identifier in hexadecimal with 3 or 8 digits, as candump prints it. For an error frame, the bits are those
    /// of the kind of error.
    pub id: String,
    /// The type of the frames.
    #[serde(rename = "type")]
    pub of: FrameType,
    /// Number of frames.
    pub frames: u64,
    /// Frames per second, from the first frame to the last.
    pub frames_per_s: Option<f64>,
    /// Time of the first frame with the identifier, in s after the first frame of the capture.
    pub first_s: f64,
    /// Time of the last frame with the identifier, in s after the first frame of the capture.
    pub last_s: f64,
    /// Smallest number of data bytes; for remote frames, of requested bytes.
    pub bytes_min: u8,
    /// Largest number of data bytes; for remote frames, of requested bytes.
    pub bytes_max: u8,
    /// Frames with the length of a packet but a wrong CRC.
    pub wrong_crc: u64,
}

impl ForeignCounter {
    pub(super) fn record(&mut self, nanos: u64, frame: &Frame, why: ForeignReason) {
        let of = match why {
            ForeignReason::Error(_) => FrameType::Error,
            ForeignReason::Remote => FrameType::Remote,
            ForeignReason::Extended | ForeignReason::Data(_) => FrameType::Data,
        };
        let wrong_crc = u64::from(matches!(why, ForeignReason::Data(PacketError::Crc { .. })));
        self.checked_groups += match why {
            ForeignReason::Data(PacketError::Crc { .. }) => 1,
            ForeignReason::Data(PacketError::Incomplete) => completed_length_count(frame),
            ForeignReason::Data(_)
            | ForeignReason::Extended
            | ForeignReason::Remote
            | ForeignReason::Error(_) => 0,
        };
        let key = (of, frame.raw_id());
        if self.identifiers.len() == MAX_COUNTED_IDENTIFIERS && !self.identifiers.contains_key(&key) {
            self.others += 1;
            return;
        }
        let len = frame.len();
        let seen = self.identifiers.entry(key).or_insert_with(|| IdentifierCounts {
            count: TimedCount::default(),
            bytes: (len, len),
            wrong_crc: 0,
        });
        seen.count.record(nanos);
        seen.bytes = (seen.bytes.0.min(len), seen.bytes.1.max(len));
        seen.wrong_crc += wrong_crc;
    }

    #[expect(clippy::cast_precision_loss, reason = "for display")]
    pub(super) fn report(&self, earliest: u64) -> ForeignFrames {
        let mut foreign = ForeignFrames {
            frames: self.others,
            packets_by_chance: self.checked_groups as f64 / 65_536.0,
            frames_of_other_identifiers: self.others,
            ..ForeignFrames::default()
        };
        for (&(of, raw_id), seen) in &self.identifiers {
            let frames = seen.count.packets;
            foreign.frames += frames;
            *match of {
                FrameType::Data if raw_id & EXTENDED == 0 => &mut foreign.standard,
                FrameType::Data => &mut foreign.extended,
                FrameType::Remote => &mut foreign.remote,
                FrameType::Error => &mut foreign.error,
            } += frames;
            foreign.identifiers.push(seen.report(of, raw_id, earliest));
        }
        // Identifiers with the same number of frames stay in order.
        foreign.identifiers.sort_by_key(|id| Reverse(id.frames));
        foreign
    }
}

/// Returns the number of different packet lengths that a classic frame can be the last segment of.
fn completed_length_count(frame: &Frame) -> u64 {
    let ends = |length: &Length| length.last_segment_bytes() == frame.data().len();
    data_frame_id(frame).map_or(0, |id| Lengths::for_id(id).iter().filter(ends).count() as u64)
}

impl IdentifierCounts {
    fn report(&self, of: FrameType, raw_id: u32, earliest: u64) -> ForeignId {
        let Self { count, bytes, wrong_crc } = *self;
        let since = |nanos: u64| nanos_to_seconds(nanos.saturating_sub(earliest));
        ForeignId {
            id: match of {
                FrameType::Error => format!("{:08X}", raw_id & (ERROR | EXTENDED_MASK)),
                _ if raw_id & EXTENDED != 0 => format!("{:08X}", raw_id & EXTENDED_MASK),
                FrameType::Data | FrameType::Remote => format!("{:03X}", raw_id & STANDARD_MASK),
            },
            of,
            frames: count.packets,
            frames_per_s: count.packets_per_s(),
            first_s: since(count.first),
            last_s: since(count.last),
            bytes_min: bytes.0,
            bytes_max: bytes.1,
            wrong_crc,
        }
    }
}
