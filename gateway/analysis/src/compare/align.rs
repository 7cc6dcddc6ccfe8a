//! Aligns captures that did not begin with their run.
//!
//! The joints of a capture that begins in the middle of a run have epochs that are known only modulo 256. Their numbers
//! follow from comparing joints: the alignment is the one at which most joints equal those of the other capture.

use protocol::message::{Joints, Message};
use protocol::packet::Epoch;
use protocol::skin::Skin;

use super::PerCapture;
use super::numbering::JointsNumbering;

/// Maximum number of joints of a capture that are kept, counted from its start; a day at 62.5 Hz has 5.4 million.
const MAX_JOINTS_KEPT: usize = 6_000_000;
/// Number of joints that are compared to rate an alignment.
const MAX_COMPARED_JOINTS: usize = 512;
/// Minimum number of epochs that two captures must have in common to be aligned by their joints.
const MIN_COMMON_EPOCHS: usize = 8;

/// The joints of a capture, each as a hash.
#[derive(Debug)]
pub struct JointTrace {
    bus: Option<String>,
    numbering: JointsNumbering,
    first: Option<Epoch>,
    /// Hash of each joints packet, by its number since the first one; `None` for missing joints.
    joints: Vec<Option<u32>>,
}

impl JointTrace {
    /// Creates an empty trace, which records the joints of the skin's first bus with cells.
    #[must_use]
    pub fn new(skin: &Skin) -> Self {
        let bus = skin.cells.first().and_then(|cell| skin.buses.get(cell.bus));
        Self {
            bus: bus.map(|bus| bus.name.clone()),
            numbering: JointsNumbering::new(super::period_ns(skin), Some(0)),
            first: None,
            joints: Vec::new(),
        }
    }

    /// Returns the epoch of the first joints in the capture; `None` before these.
    #[must_use]
    pub fn first_epoch(&self) -> Option<u8> {
        self.first.map(|first| first.0)
    }

    /// Records the next message; ignores messages other than joints, and other buses than the traced one.
    pub fn record_message(&mut self, nanos: u64, bus: &str, message: &Message) {
        let Message::Joints { epoch, joints } = message else { return };
        if self.bus.as_deref() != Some(bus) {
            return;
        }
        let last = self.numbering.newest();
        let Some(key) = self.numbering.number_joints(nanos, *epoch, last).filter(|key| key.run == 0) else {
            return;
        };
        self.first.get_or_insert(*epoch);
        let Some(at) = usize::try_from(key.number).ok().filter(|at| *at < MAX_JOINTS_KEPT) else { return };
        if at >= self.joints.len() {
            self.joints.resize(at + 1, None);
        }
        if let Some(place) = self.joints.get_mut(at) {
            *place = Some(joints_hash(joints));
        }
    }
}

/// Returns the FNV-1a hash of the joint words.
fn joints_hash(joints: &Joints) -> u32 {
    let words = joints.positions.iter().flat_map(|word| word.to_bits().to_le_bytes());
    words.fold(0x811C_9DC5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}

/// Returns for each of two captures of one skin the number of its first joints since the run began; `None` if unknown.
#[must_use]
pub fn first_joints_numbers(a: &JointTrace, b: &JointTrace) -> PerCapture<Option<u64>> {
    let (Some(first_a), Some(first_b)) = (a.first, b.first) else { return PerCapture { a: None, b: None } };
    let of = |first: Epoch, laps: usize| u64::from(first.0) + 256 * laps as u64;
    let mut best = (equal_joints_share(a, b, of(first_a, 0), of(first_b, 0)).unwrap_or(0.0), 0, 0);
    let most = a.joints.len().max(b.joints.len()) / 256 + 1;
    for laps in 1..=most {
        for (laps_a, laps_b) in [(0, laps), (laps, 0)] {
            let share = equal_joints_share(a, b, of(first_a, laps_a), of(first_b, laps_b)).unwrap_or(0.0);
            if share > best.0 && share >= 0.5 {
                best = (share, laps_a, laps_b);
            }
        }
    }
    PerCapture { a: Some(of(first_a, best.1)), b: Some(of(first_b, best.2)) }
}

/// Returns the share of joints that are equal if the captures begin with the numbers `start_a` and `start_b`; `None` if
/// they then have too few epochs in common.
fn equal_joints_share(a: &JointTrace, b: &JointTrace, start_a: u64, start_b: u64) -> Option<f64> {
    let begin = start_a.max(start_b);
    let [skip_a, skip_b] =
        [start_a, start_b].map(|start| usize::try_from(begin - start).unwrap_or(usize::MAX));
    let (a, b) = (a.joints.get(skip_a..)?, b.joints.get(skip_b..)?);
    let common = a.len().min(b.len());
    if common < MIN_COMMON_EPOCHS {
        return None;
    }
    let step = common.div_ceil(MAX_COMPARED_JOINTS);
    let pairs = a.iter().zip(b).take(common).step_by(step).filter(|(a, b)| a.is_some() && b.is_some());
    let (equal, all) =
        pairs.fold((0_u32, 0_u32), |(equal, all), (a, b)| (equal + u32::from(a == b), all + 1));
    (all > 0).then(|| f64::from(equal) / f64::from(all))
}
