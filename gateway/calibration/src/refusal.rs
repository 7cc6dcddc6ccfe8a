//! The reasons for which a calibration refuses a recording.

use serde::Serialize;
use thiserror::Error;

use crate::observe::{BroadcastGap, BusObservations};
use crate::rounded::rounded;

/// The gaps in the broadcasts of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct GapSummary {
    /// The number of broadcasts, in time or not.
    pub broadcasts: usize,
    /// The number of broadcasts whose readings are left out because their motion is unknown: around gaps, and where
    /// positions do not form a smooth motion. The first and the last ones of a recording are always left out.
    pub left_out: usize,
    /// The number of broadcasts that were not in time.
    pub gaps: usize,
    /// The longest gap, in ms; `None` without a gap.
    pub longest_ms: Option<f64>,
    /// The start of the longest gap, in s since the first broadcast.
    pub longest_at_s: Option<f64>,
}

impl GapSummary {
    /// Returns the gaps of one bus; `known` is the number of broadcasts whose motion is known.
    pub(crate) fn from_bus(bus: &BusObservations, known: usize) -> Self {
        let broadcasts = bus.joints.iter().flatten().count();
        let longest = bus.gaps.iter().max_by(|one, other| one.took_ms.total_cmp(&other.took_ms));
        Self {
            broadcasts,
            left_out: broadcasts.saturating_sub(known),
            gaps: bus.gaps.len(),
            longest_ms: longest.map(|BroadcastGap { took_ms, .. }| rounded(*took_ms, 1)),
            longest_at_s: longest.map(|BroadcastGap { at_s, .. }| rounded(*at_s, 3)),
        }
    }

    /// Returns the sum of the gaps of this bus and of another one.
    pub(crate) fn merged_with(self, other: Self) -> Self {
        let is_longer = other.longest_ms > self.longest_ms;
        let (longest_ms, longest_at_s) = if is_longer {
            (other.longest_ms, other.longest_at_s)
        } else {
            (self.longest_ms, self.longest_at_s)
        };
        Self {
            broadcasts: self.broadcasts + other.broadcasts,
            left_out: self.left_out + other.left_out,
            gaps: self.gaps + other.gaps,
            longest_ms,
            longest_at_s,
        }
    }
}

impl core::fmt::Display for GapSummary {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let Self { broadcasts, left_out, gaps, .. } = self;
        match (gaps, self.longest_ms.zip(self.longest_at_s)) {
            (1.., Some((ms, at))) => {
                let gaps = if *gaps == 1 { "1 gap".to_owned() } else { format!("{gaps} gaps, the longest") };
                write!(f, "the joint broadcasts have {gaps} of {ms} ms at {at} s")?;
            }
            _ => f.write_str("the joint broadcasts have no gap")?,
        }
        write!(f, "; {left_out} of {broadcasts} broadcasts are not used")
    }
}

/// The reason for which a calibration refuses a recording.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum Refusal {
    /// The joints on a bus are those of another robot.
    #[error(
        "{bus}: the recorded frames have {got} joints, but the skin has {joints}: give the skin with which \
         the recording was made"
    )]
    Joints {
        /// The bus.
        bus: String,
        /// The number of joints in frames.
        got: u8,
        /// The number of joints of the chain.
        joints: usize,
    },
    /// The broadcast rate of joints differs from the skin's.
    #[error(
        "{bus}: joints messages were broadcast {got} times a second, but the skin specifies {hz}: correct \
         joint_broadcast_hz in the skin"
    )]
    Rate {
        /// The bus.
        bus: String,
        /// The rate in the recording, in Hz.
        got: f64,
        /// The rate that the skin specifies, in Hz.
        hz: f64,
    },
    /// The motion is known for too few broadcasts.
    #[error(
        "{bus}: {disturbance}; too few broadcasts remain for a calibration: make a longer recording, in \
         which the control loop skips no ticks"
    )]
    Disturbed {
        /// The bus.
        bus: String,
        /// The gaps in the broadcasts on the bus.
        disturbance: GapSummary,
    },
    /// The readings scatter more than the data sheet allows for sensors on this robot.
    #[error(
        "the readings scatter {times} times as much as the data sheet states ({noise_mg} mg instead of \
         {sheet_mg} mg), so no pose is reliable; {disturbance}; record again with a control loop that skips \
         no ticks, or give the sensors' data sheet with --data-sheet"
    )]
    Scatter {
        /// The ratio of the scatter to the value that the data sheet predicts.
        times: f64,
        /// The scatter of readings, in mg.
        noise_mg: f64,
        /// The noise in the data sheet, in mg.
        sheet_mg: f64,
        /// The gaps of the recording.
        disturbance: GapSummary,
    },
    /// Readings before and after a gap were not taken at the times of their joints.
    #[error(
        "{bus}: from {at_s} s on, readings come {ms} ms later after their joints messages than before, so no pose is \
         reliable; {disturbance}; record again with a control loop that skips no ticks"
    )]
    Shifted {
        /// The bus.
        bus: String,
        /// The start of the shift, in s since the first broadcast.
        at_s: f64,
        /// The shift of readings against their joints, in ms.
        ms: f64,
        /// The gaps of the recording.
        disturbance: GapSummary,
    },
}
