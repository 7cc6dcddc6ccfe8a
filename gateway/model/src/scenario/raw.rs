//! A scenario's file as parsed, before it is checked.

use core::fmt;

use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::times::MAX_DURATION_S;
use super::{DEFAULT_DURATION, MotionKind};
use crate::accelerometer::sensor::DataSheetInput;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Scenario {
    #[serde(default = "one")]
    pub(super) version: i64,
    pub(super) duration_s: Option<f64>,
    #[serde(default = "one")]
    pub(super) seed: i64,
    pub(super) touches_repeat_s: Option<f64>,
    #[serde(default)]
    pub(super) motion: Motion,
    #[serde(default)]
    pub(super) mode: Vec<Mode>,
    #[serde(default)]
    pub(super) touch: Vec<Touch>,
    #[serde(default)]
    pub(super) fault: Vec<Fault>,
    #[serde(default)]
    pub(super) sensors: Sensors,
}

const fn one() -> i64 {
    1
}

/// The course of a touch's force, as given in the file.
#[derive(Debug)]
pub(super) enum TouchProfile {
    Word(String),
    /// Times in s after the start of the touch, and forces in N; each point must have two numbers.
    Points(Vec<Vec<f64>>),
}

impl Default for TouchProfile {
    fn default() -> Self {
        Self::Word(super::ForceProfile::Step.name().to_owned())
    }
}

impl<'de> Deserialize<'de> for TouchProfile {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct RawValueVisitor;
        impl<'de> Visitor<'de> for RawValueVisitor {
            type Value = TouchProfile;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("either a word in quotes or a list of points [[t_s, force_n], ...]")
            }

            fn visit_str<E: Error>(self, word: &str) -> Result<TouchProfile, E> {
                Ok(TouchProfile::Word(word.to_owned()))
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut all: A) -> Result<TouchProfile, A::Error> {
                let mut points = Vec::new();
                while let Some(point) = all.next_element()? {
                    points.push(point);
                }
                Ok(TouchProfile::Points(points))
            }
        }
        from.deserialize_any(RawValueVisitor)
    }
}

/// A cell as a scenario's file names it.
#[derive(Debug)]
pub(super) enum CellReference {
    Node(i64),
    /// `BUS:NODE`.
    Text(String),
}

impl fmt::Display for CellReference {
    /// Formats the name as in the file.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Node(node) => node.fmt(f),
            Self::Text(text) => write!(f, "{text:?}"),
        }
    }
}

impl<'de> Deserialize<'de> for CellReference {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct RawValueVisitor;
        impl Visitor<'_> for RawValueVisitor {
            type Value = CellReference;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("either a node id or \"BUS:NODE\"")
            }

            fn visit_i64<E: Error>(self, node: i64) -> Result<CellReference, E> {
                Ok(CellReference::Node(node))
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<CellReference, E> {
                Ok(CellReference::Text(text.to_owned()))
            }
        }
        from.deserialize_any(RawValueVisitor)
    }
}

impl Scenario {
    /// Returns the duration in s from the file. The default is [`DEFAULT_DURATION`], or one second after the last start
    /// or end of an event if that is later.
    pub(super) fn duration_s(&self) -> f64 {
        let end = |at_s: f64, for_s: Option<f64>| at_s + for_s.unwrap_or(0.0);
        let touches = self.touch.iter().map(|touch| end(touch.at_s, touch.touch_duration_s()));
        let faults = self.fault.iter().map(|fault| end(fault.at_s, fault.for_s));
        let ends = touches.chain(faults).chain(self.mode.iter().map(|mode| mode.at_s));
        let last = || ends.fold(0.0, f64::max) + 1.0;
        self.duration_s.unwrap_or_else(|| last().clamp(DEFAULT_DURATION.seconds(), MAX_DURATION_S))
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Motion {
    pub(super) kind: String,
    pub(super) start: Option<Vec<f64>>,
    pub(super) start_rad: Option<Vec<f64>>,
    pub(super) amplitude: Option<Vec<f64>>,
    pub(super) amplitude_rad: Option<Vec<f64>>,
    pub(super) period_s: Option<f64>,
}

impl Default for Motion {
    fn default() -> Self {
        Self {
            kind: MotionKind::Kinesthetic.name().to_owned(),
            start: None,
            start_rad: None,
            amplitude: None,
            amplitude_rad: None,
            period_s: None,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Mode {
    pub(super) at_s: f64,
    pub(super) kind: String,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Touch {
    #[serde(default)]
    pub(super) at_s: f64,
    pub(super) for_s: Option<f64>,
    pub(super) bus: Option<String>,
    pub(super) cells: Option<Vec<CellReference>>,
    #[serde(default)]
    pub(super) all: bool,
    pub(super) force_n: Option<f64>,
    #[serde(default)]
    pub(super) profile: TouchProfile,
    #[serde(default)]
    pub(super) proximity: f64,
    pub(super) temperature_c: Option<[f64; 2]>,
}

impl Touch {
    /// Returns the duration of the touch in s, if the file gives one; for points, the time of the last point.
    fn touch_duration_s(&self) -> Option<f64> {
        match &self.profile {
            TouchProfile::Points(points) => points.last()?.first().copied(),
            TouchProfile::Word(_) => self.for_s,
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Fault {
    pub(super) at_s: f64,
    pub(super) kind: String,
    pub(super) for_s: Option<f64>,
    pub(super) bus: Option<String>,
    pub(super) cells: Option<Vec<CellReference>>,
    #[serde(default)]
    pub(super) all: bool,
    pub(super) one_way: Option<bool>,
    pub(super) probability: Option<f64>,
    pub(super) delay_us: Option<i64>,
    pub(super) n_per_s: Option<f64>,
    pub(super) frames_per_s: Option<f64>,
    pub(super) id: Option<i64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Sensors {
    /// Times in s and temperatures in °C.
    pub(super) temperature_c: Vec<[f64; 2]>,
    pub(super) force: Option<ForceErrors>,
    pub(super) acceleration: Option<DataSheetInput>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct ForceErrors {
    pub(super) kind: Option<String>,
    pub(super) offset_n: Option<f64>,
    pub(super) gain: Option<f64>,
    pub(super) hysteresis: Option<f64>,
    pub(super) creep: Option<f64>,
    pub(super) drift_n: Option<f64>,
    pub(super) temperature_n_per_c: Option<f64>,
    pub(super) temperature_gain_per_c: Option<f64>,
    pub(super) crosstalk: Option<f64>,
    pub(super) noise_n: Option<f64>,
}
