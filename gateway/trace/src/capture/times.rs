//! Detects suspicious times of frames: times that run backwards, and captures in which all frames have the same time.

use std::fmt;

/// The maximum number of buses whose times are checked.
const MAX_BUSES: usize = 64;
/// The number of frames with the same time from which on this is no coincidence.
const MIN_CONSTANT_FRAMES: u64 = 3;

/// Checks the times of frames. Each bus is checked separately, because frames of different buses may be recorded out of
/// order.
#[derive(Debug, Default)]
pub(super) struct TimeChecks {
    buses: Vec<BusTimes>,
    /// The index of the bus of the last frame.
    current: usize,
    frames: u64,
    latest: u64,
    /// The number of frames that are older than the frame before them on their bus, and the position of the first of
    /// these in the capture, counted from 1.
    backwards: Option<(u64, u64)>,
    /// The names of two successive files: the later one begins before the earlier one ends.
    overlap: Option<(String, String)>,
}

#[derive(Debug)]
struct BusTimes {
    name: String,
    first: u64,
    last: u64,
    frames: u64,
    /// True once two frames of the bus have different times.
    has_several: bool,
}

impl TimeChecks {
    /// Checks the time of the next frame of a bus.
    #[inline]
    pub(super) fn check_frame_time(&mut self, bus: &str, nanos: u64) {
        self.frames += 1;
        self.latest = self.latest.max(nanos);
        if self.buses.get(self.current).is_none_or(|current| current.name != bus) {
            let Some(place) = self.bus_index(bus, nanos) else { return };
            self.current = place;
        }
        let Some(bus) = self.buses.get_mut(self.current) else { return };
        bus.frames += 1;
        if nanos < bus.last {
            self.backwards.get_or_insert((0, self.frames)).0 += 1;
        }
        bus.has_several |= nanos != bus.first;
        bus.last = nanos;
    }

    fn bus_index(&mut self, bus: &str, nanos: u64) -> Option<usize> {
        let known = self.buses.iter().position(|it| it.name == bus);
        known.or_else(|| {
            let new =
                BusTimes { name: bus.to_owned(), first: nanos, last: nanos, frames: 0, has_several: false };
            (self.buses.len() < MAX_BUSES).then(|| {
                self.buses.push(new);
                self.buses.len() - 1
            })
        })
    }

    /// Returns the latest time so far, in ns since 1970.
    pub(super) const fn latest_ns(&self) -> u64 {
        self.latest
    }

    /// Records that `file` begins at an earlier time than that at which the file `before` it ends.
    pub(super) fn record_overlap(&mut self, file: &str, before: &str) {
        self.overlap.get_or_insert_with(|| (file.to_owned(), before.to_owned()));
    }

    /// Returns the remark on times that run backwards.
    pub(super) fn backwards_remark(&self) -> Option<String> {
        let (times, first) = self.backwards?;
        Some(format!(
            "the time stamps go backwards {times} times, first at frame {first}; the order of the frames is \
             kept"
        ))
    }

    /// Returns the other remarks, one per line.
    pub(super) fn remarks(&self) -> impl Iterator<Item = String> {
        let overlap = self.overlap.as_ref().map(|(file, before)| {
            format!(
                "{file} begins before {before} ends: the files are read one after the other, so their frames \
                 are not in the order of time"
            )
        });
        let constant = self.buses.iter().filter(|bus| !bus.has_several && bus.frames >= MIN_CONSTANT_FRAMES);
        let constant = constant.map(|BusTimes { name, first, frames, .. }| {
            format!(
                "all {frames} frames of {name} have the same time, {}: rates, gaps and bus loads are \
                 meaningless",
                DisplayedSeconds(*first)
            )
        });
        overlap.into_iter().chain(constant)
    }
}

/// A time in ns that is displayed in seconds, as in a log.
struct DisplayedSeconds(u64);

impl fmt::Display for DisplayedSeconds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:09}", self.0 / 1_000_000_000, self.0 % 1_000_000_000)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn remarks(frames: &[(&str, u64)]) -> Vec<String> {
        let mut times = TimeChecks::default();
        frames.iter().for_each(|(bus, nanos)| times.check_frame_time(bus, *nanos));
        times.backwards_remark().into_iter().chain(times.remarks()).collect()
    }

    #[test]
    fn one_time_for_all_frames_of_a_bus_is_remarked() {
        let nothing: [String; 0] = [];
        assert_eq!(remarks(&[("a", 5), ("a", 5)]), nothing, "two frames may have come at once");
        assert_eq!(remarks(&[("a", 5), ("a", 5), ("a", 6)]), nothing);
        assert_eq!(
            remarks(&[("a", 0), ("b", 1), ("a", 0), ("b", 2), ("a", 0)]),
            ["all 3 frames of a have the same time, 0.000000000: rates, gaps and bus loads are meaningless"]
        );
    }

    #[test]
    fn times_that_run_backwards_are_counted_by_bus() {
        let backwards =
            ["the time stamps go backwards 1 times, first at frame 3; the order of the frames is kept"];
        assert_eq!(remarks(&[("a", 5), ("b", 1), ("a", 4), ("b", 2)]), backwards);
    }
}
