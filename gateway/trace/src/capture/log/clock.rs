//! Assigns times to frames whose lines hold no absolute time.
//!
//! `candump -t d` prints the time since the line before, and `-t z` the time since the first line. The log does not say
//! which option was used. Times since the first line never run backwards on one bus, so times that do are differences.
//! Without `-t` a line has no time.

use std::fmt;

use protocol::candump::Timestamp;

use super::console::LineTime;
use crate::capture::last_times::LastFrameTimes;

/// The time between successive frames, in ns, that is assumed if the lines hold no times.
const ASSUMED_STEP_NS: u64 = 1_000;
/// The maximum number of buses whose times are compared to find the reference.
const MAX_BUSES: usize = 16;
/// The number of compared times after which it is decided to what the relative times of a log refer.
const MIN_COMPARISONS: u32 = 20;

/// A remark for the user on the times and flags of a log.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
#[non_exhaustive]
pub enum LogRemark {
    /// The lines have no times.
    NoTimes,
    /// The lines have dates and times of day without a time zone; they are read as UTC.
    LocalTimes,
    /// The times count from the first frame.
    SinceFirst,
    /// The times are counted from the line before.
    Differences,
    /// The lines of FD frames do not show the flags (BRS, ESI).
    NoFlags,
}

impl fmt::Display for LogRemark {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NoTimes => {
                "its lines have no time (candump without -t): each frame is placed 1 us after the one \
                 before, so rates, gaps and bus loads are meaningless"
            }
            Self::LocalTimes => {
                "its times are dates without a time zone (candump -t A): they are read as UTC"
            }
            Self::SinceFirst => "its times count from the first frame (candump -t z), not from 1970",
            Self::Differences => {
                "its times are differences between frames (candump -t d): they are added up, from 0"
            }
            Self::NoFlags => {
                "its lines lack the FD flags (candump without -x): FD frames are read as frames without \
                 bit-rate switch"
            }
        })
    }
}

/// The reference of relative times: the first frame or the line before.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum TimeReference {
    First,
    Before,
}

/// Assigns a time to each frame of a log, one after the other.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(crate) struct Clock {
    /// The reference of relative times, once it is known.
    relative: Option<TimeReference>,
    /// The time of the last frame, in ns.
    last: Option<u64>,
}

impl Clock {
    /// The clock before the first frame.
    pub(crate) const NEW: Self = Self { relative: None, last: None };

    /// Returns the time of the last frame, in ns; 0 before the first one.
    pub(super) fn last_ns(self) -> u64 {
        self.last.unwrap_or(0)
    }

    /// Returns true if the reference of relative times is not known yet.
    pub(super) const fn is_undecided(self) -> bool {
        self.relative.is_none()
    }

    pub(super) const fn set_reference(&mut self, relative: TimeReference) {
        self.relative = Some(relative);
    }

    /// Sets the time of the last frame.
    pub(super) const fn set(&mut self, nanos: u64) {
        self.last = Some(nanos);
    }

    /// Returns the time of the next frame, and a remark if the time is not absolute.
    pub(super) fn next_frame_time(&mut self, stamp: LineTime) -> (Timestamp, Option<LogRemark>) {
        let (time, remark) = match stamp {
            LineTime::None => {
                let nanos = self.last.map_or(0, |last| last.saturating_add(ASSUMED_STEP_NS));
                (Timestamp::with_six_digits(nanos), Some(LogRemark::NoTimes))
            }
            LineTime::Absolute(time) => (time, None),
            LineTime::Local(time) => (time, Some(LogRemark::LocalTimes)),
            LineTime::Relative(time) if self.relative == Some(TimeReference::Before) => {
                let nanos = self.last_ns().saturating_add(time.nanos);
                (Timestamp { nanos, ..time }, Some(LogRemark::Differences))
            }
            LineTime::Relative(time) => (time, Some(LogRemark::SinceFirst)),
        };
        self.set(time.nanos);
        (time, remark)
    }
}

/// Compares the times of several lines to find out what they are relative to.
#[derive(Debug, Default)]
pub(super) struct TimeEvidence {
    last: LastFrameTimes<MAX_BUSES>,
    compared: u32,
    smaller: u32,
    same: u32,
}

impl TimeEvidence {
    pub(super) fn add_time(&mut self, interface: &str, nanos: u64) {
        let Some(last) = self.last.replace(interface, nanos) else { return };
        self.compared += 1;
        self.smaller += u32::from(nanos < last);
        self.same += u32::from(nanos == last && nanos > 0);
    }

    pub(super) const fn is_enough(&self) -> bool {
        self.compared >= MIN_COMPARISONS
    }

    /// Returns the reference of the times. Times since the first frame grow on each bus, with few exceptions where the
    /// clock was set.
    pub(super) const fn likely_reference(&self) -> TimeReference {
        if self.smaller * 8 > self.compared || self.same * 2 > self.compared {
            TimeReference::Before
        } else {
            TimeReference::First
        }
    }
}
