//! Foreign frames by identifier.

use core::cmp::Reverse;
use std::collections::BTreeMap;

use protocol::can::{ERROR, EXTENDED, EXTENDED_MASK, Frame, STANDARD_MASK};
use serde::Serialize;

use super::{Count, seconds};
use model::decode::Foreign;
use protocol::packet::{Length, Lengths, PacketError, data_id};

/// Identifiers of a bus that are counted separately; frames of others are counted together.
const IDENTIFIERS: usize = 4096;

/// What kind of frame it is, beside its identifier.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FrameType {
    /// It carries data.
    Data,
    /// It requests data.
    Remote,
    /// The driver's report of an error; its identifier has the kind.
    Error,
}

/// Counts foreign frames of a bus.
#[derive(Debug, Default)]
pub(super) struct Foreigners {
    identifiers: BTreeMap<(FrameType, u32), Seen>,
    /// Frames of identifiers beyond those that are counted separately.
    others: u64,
    /// Groups of frames whose CRC was checked: a frame alone, or with those before it that make a length.
    tried: u64,
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    count: Count,
    bytes: (u8, u8),
    wrong_crc: u64,
}

/// Frames that are none of this protocol.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ForeignFrames {
    /// All of them.
    pub frames: u64,
    /// Data frames with an 11-bit identifier.
    pub standard: u64,
    /// Data frames with a 29-bit identifier.
    pub extended: u64,
    /// Remote frames.
    pub remote: u64,
    /// The driver's error frames.
    pub error: u64,
    /// Expected number of packets by chance, where the chain is not known: one of 65 536 groups of frames has a right CRC.
    /// They count as packets.
    pub packets_by_chance: f64,
    /// Each, the one with the most frames first.
    pub identifiers: Vec<ForeignId>,
    /// Frames of identifiers beyond the first 4096.
    pub frames_of_other_identifiers: u64,
}

/// Foreign frames under one identifier.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ForeignId {
    /// In hexadecimal, as candump prints it: 3 or 8 digits; of an error frame the bits of the kind of error.
    pub id: String,
    /// What kind of frames these are.
    #[serde(rename = "type")]
    pub of: FrameType,
    /// Frames.
    pub frames: u64,
    /// The same by second, from the first to the last.
    pub frames_per_s: Option<f64>,
    /// The first, in s after the first frame of the capture.
    pub first_s: f64,
    /// The last.
    pub last_s: f64,
    /// Fewest data bytes; of a remote frame those that it requests.
    pub bytes_min: u8,
    /// Most data bytes.
    pub bytes_max: u8,
    /// Frames with the length of a packet and another CRC.
    pub wrong_crc: u64,
}

impl Foreigners {
    pub(super) fn take(&mut self, nanos: u64, frame: &Frame, why: Foreign) {
        let of = match why {
            Foreign::Error(_) => FrameType::Error,
            Foreign::Remote => FrameType::Remote,
            Foreign::Extended | Foreign::Data(_) => FrameType::Data,
        };
        let wrong_crc = u64::from(matches!(why, Foreign::Data(PacketError::Crc { .. })));
        self.tried += match why {
            Foreign::Data(PacketError::Crc { .. }) => 1,
            Foreign::Data(PacketError::Incomplete) => groups(frame),
            Foreign::Data(_) | Foreign::Extended | Foreign::Remote | Foreign::Error(_) => 0,
        };
        let key = (of, frame.raw_id());
        if self.identifiers.len() == IDENTIFIERS && !self.identifiers.contains_key(&key) {
            self.others += 1;
            return;
        }
        let len = frame.len();
        let seen = self.identifiers.entry(key).or_insert_with(|| Seen {
            count: Count::default(),
            bytes: (len, len),
            wrong_crc: 0,
        });
        seen.count.take(nanos);
        seen.bytes = (seen.bytes.0.min(len), seen.bytes.1.max(len));
        seen.wrong_crc += wrong_crc;
    }

    #[expect(clippy::cast_precision_loss, reason = "to be read")]
    pub(super) fn report(&self, earliest: u64) -> ForeignFrames {
        let mut foreign = ForeignFrames {
            frames: self.others,
            packets_by_chance: self.tried as f64 / 65_536.0,
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
        // Those of one number of frames stay in the order of their identifiers.
        foreign.identifiers.sort_by_key(|id| Reverse(id.frames));
        foreign
    }
}

/// How many lengths of packets a classic frame can end.
fn groups(frame: &Frame) -> u64 {
    let ends = |length: &Length| length.last_segment() == frame.data().len();
    data_id(frame).map_or(0, |id| Lengths::of(id).iter().filter(ends).count() as u64)
}

impl Seen {
    fn report(&self, of: FrameType, raw_id: u32, earliest: u64) -> ForeignId {
        let Self { count, bytes, wrong_crc } = *self;
        let since = |nanos: u64| seconds(nanos.saturating_sub(earliest));
        ForeignId {
            id: match of {
                FrameType::Error => format!("{:08X}", raw_id & (ERROR | EXTENDED_MASK)),
                _ if raw_id & EXTENDED != 0 => format!("{:08X}", raw_id & EXTENDED_MASK),
                FrameType::Data | FrameType::Remote => format!("{:03X}", raw_id & STANDARD_MASK),
            },
            of,
            frames: count.packets,
            frames_per_s: count.per_s(),
            first_s: since(count.first),
            last_s: since(count.last),
            bytes_min: bytes.0,
            bytes_max: bytes.1,
            wrong_crc,
        }
    }
}
