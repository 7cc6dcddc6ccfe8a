//! What is handed over to the recorder: bounded queues, one for each producer thread. No producer waits for
//! room: what does not fit is counted, and the recording notes where it is missing.

use std::sync::{Arc, Mutex};

use protocol::message::SkinSensors;

use crate::view::View;
use control::cycle::turn::{BusState, Timed};
use model::latched::Seen;
use model::table::Status;
use trace::capture::BusNote;

/// Frames of a bus that may wait; of many buses together no more than four times that, so that their memory has a limit,
/// but of each more than a second of a full bus.
const FRAMES: usize = 65_536;
/// See [`FRAMES`].
const FRAMES_OF_MANY: usize = 16_384;

/// How many frames of each of so many buses may wait.
#[must_use]
pub fn frames(buses: usize) -> usize {
    (4 * FRAMES / buses.max(1)).clamp(FRAMES_OF_MANY, FRAMES)
}

/// Ticks that may wait: more than a second.
pub const TICKS: usize = 1_024;
/// Epochs of a bus that may wait: more than a second.
pub const EPOCHS: usize = 128;

/// What a bus' receiver hands over, in the order in which it came.
#[derive(Clone, Copy, Debug)]
pub enum Captured {
    /// A frame.
    Frame(Seen),
    /// Frames that the bus dropped because they were not taken in time.
    Dropped {
        /// When this was known, in ns since 1970.
        at_nanos: u64,
        /// How many.
        frames: u64,
    },
    /// Frames that did not fit into this queue.
    Unrecorded {
        /// When this was reported, in ns since 1970.
        at_nanos: u64,
        /// How many.
        frames: u64,
    },
    /// The bus was lost, or works again.
    Bus {
        /// When this was known, in ns since 1970.
        at_nanos: u64,
        /// Which of the two.
        what: BusNote,
    },
}

/// The contact state of a bus' cells when joints were on it.
#[derive(Clone, Debug)]
pub struct Touched {
    /// When, in ns since 1970.
    pub at_nanos: u64,
    /// The joints' epoch.
    pub epoch: u8,
    /// Each cell, in the bus' order.
    pub cells: Box<[(Option<SkinSensors>, Status)]>,
}

/// A receiver's end of its queues.
#[derive(Debug)]
pub struct Outlet {
    frames: rtrb::Producer<Captured>,
    touched: Option<rtrb::Producer<Touched>>,
    /// Frames that did not fit, in all.
    unrecorded: u64,
    /// Of these, those that are not reported yet.
    unreported: u64,
    /// Epochs that did not fit.
    untouched: u64,
}

/// What did not fit into queues.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Unrecorded {
    /// Frames.
    pub frames: u64,
    /// Contact states of an epoch.
    pub epochs: u64,
}

impl Outlet {
    /// Hands a frame over.
    pub fn frame(&mut self, seen: Seen) {
        if self.unreported > 0 {
            self.tell(seen.at_nanos);
        }
        if self.unreported > 0 || self.frames.push(Captured::Frame(seen)).is_err() {
            self.unrecorded += 1;
            self.unreported += 1;
        }
    }

    /// Frames that fit into the queue now.
    #[must_use]
    pub fn free(&self) -> usize {
        self.frames.slots()
    }

    /// Reports that the bus dropped frames.
    pub fn dropped(&mut self, at_nanos: u64, frames: u64) {
        // A full queue is reported by itself.
        let _ = self.frames.push(Captured::Dropped { at_nanos, frames });
    }

    /// Reports that the bus was lost, or works again.
    pub fn bus(&mut self, at_nanos: u64, what: BusNote) {
        // In a full queue frames are lost, which is reported by itself.
        let _ = self.frames.push(Captured::Bus { at_nanos, what });
    }

    /// Whether contact states are recorded.
    #[must_use]
    pub const fn wants_touched(&self) -> bool {
        self.touched.is_some()
    }

    /// Hands contact states over.
    pub fn touched(&mut self, touched: Touched) {
        if let Some(queue) = &mut self.touched
            && queue.push(touched).is_err()
        {
            self.untouched += 1;
        }
    }

    /// Reports what did not fit, if there is room for the report; whether nothing remains to be reported.
    pub fn tell(&mut self, at_nanos: u64) -> bool {
        let frames = self.unreported;
        if frames > 0 && self.frames.push(Captured::Unrecorded { at_nanos, frames }).is_ok() {
            self.unreported = 0;
        }
        self.unreported == 0
    }

    /// What did not fit.
    #[must_use]
    pub const fn unrecorded(&self) -> Unrecorded {
        Unrecorded { frames: self.unrecorded, epochs: self.untouched }
    }
}

/// The recorder's end of a bus.
#[derive(Debug)]
pub struct BusFeed {
    pub(super) frames: rtrb::Consumer<Captured>,
    pub(super) touched: Option<rtrb::Consumer<Touched>>,
    /// The state of its cells.
    pub(super) view: Arc<Mutex<View>>,
    /// The state of the bus.
    pub(super) state: Arc<BusState>,
}

/// The queues of one of so many buses, both ends; `all` if more than frames is recorded.
#[must_use]
pub fn bus_feed(buses: usize, all: bool, view: Arc<Mutex<View>>, state: Arc<BusState>) -> (Outlet, BusFeed) {
    let (frames, taken) = rtrb::RingBuffer::new(frames(buses));
    let (touched, states) = all.then(|| rtrb::RingBuffer::new(EPOCHS)).unzip();
    let outlet = Outlet { frames, touched, unrecorded: 0, unreported: 0, untouched: 0 };
    (outlet, BusFeed { frames: taken, touched: states, view, state })
}

/// All input of the recorder.
#[derive(Debug)]
pub struct Feed {
    /// Each bus.
    pub bus_feeds: Vec<BusFeed>,
    /// The control loop's ticks.
    pub ticks: Option<rtrb::Consumer<Timed>>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::can::Frame;

    #[test]
    fn forty_buses_take_ten_times_the_memory_of_one() {
        assert_eq!([0, 1, 4, 8, 16, 40].map(frames), [65_536, 65_536, 65_536, 32_768, 16_384, 16_384]);
    }

    #[test]
    fn what_does_not_fit_is_reported_where_it_is_missing() {
        let (mut outlet, mut bus_feed) = bus_feed(1, false, Arc::default(), Arc::default());
        let frame = |at_nanos| Seen { at_nanos, own: false, frame: Frame::EMPTY };
        let all = FRAMES as u64;
        (0..all + 7).for_each(|at| outlet.frame(frame(at)));
        assert_eq!(outlet.unrecorded(), Unrecorded { frames: 7, epochs: 0 });
        let mut taken = 0;
        while let Ok(Captured::Frame(seen)) = bus_feed.frames.pop() {
            assert_eq!(seen.at_nanos, taken);
            taken += 1;
        }
        assert_eq!(taken, all);
        outlet.frame(frame(1_000_000));
        outlet.frame(frame(1_000_001));
        let said = bus_feed.frames.pop().unwrap();
        assert!(matches!(said, Captured::Unrecorded { at_nanos: 1_000_000, frames: 7 }), "{said:?}");
        assert!(
            matches!(bus_feed.frames.pop().unwrap(), Captured::Frame(seen) if seen.at_nanos == 1_000_000)
        );
        assert_eq!(outlet.unrecorded().frames, 7);
    }
}
