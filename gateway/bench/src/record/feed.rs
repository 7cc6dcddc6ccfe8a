//! Queues to the recorder, one per producer thread. Producers never wait for room: the queue counts items that do not
//! fit, and the recording notes where they are missing.

use std::sync::{Arc, Mutex};

use protocol::message::SkinSensors;

use crate::view::BusView;
use control::cycle::turn::{BusState, TimedRecord};
use model::latched::LatchedFrame;
use model::table::CellStatus;
use trace::capture::BusNote;

/// Queue length in frames for a bus. The queues of many buses together have at most four times this length, which
/// limits memory. The queue of each bus has at least [`MIN_FRAME_QUEUE_LENGTH`] frames, more than a second of a full
/// bus.
const FRAME_QUEUE_LENGTH: usize = 65_536;
/// Minimum queue length in frames for a bus, if there are many buses.
const MIN_FRAME_QUEUE_LENGTH: usize = 16_384;

/// Returns the queue length in frames for each of `buses` buses.
#[must_use]
pub fn frame_queue_length(buses: usize) -> usize {
    (4 * FRAME_QUEUE_LENGTH / buses.max(1)).clamp(MIN_FRAME_QUEUE_LENGTH, FRAME_QUEUE_LENGTH)
}

/// Queue length in ticks: more than a second of the control loop.
pub const TICK_QUEUE_LENGTH: usize = 1_024;
/// Queue length in epochs for a bus: more than a second of broadcasts.
pub const EPOCH_QUEUE_LENGTH: usize = 128;

/// An item from the receiver of a bus, in order of arrival.
#[derive(Clone, Copy, Debug)]
pub enum CapturedItem {
    /// A received frame.
    Frame(LatchedFrame),
    /// Frames that the bus dropped because they were not read in time.
    Dropped {
        /// Time of detection in ns since 1970.
        at_nanos: u64,
        /// Number of frames.
        frames: u64,
    },
    /// Frames that did not fit into this queue.
    Unrecorded {
        /// Time of the report in ns since 1970.
        at_nanos: u64,
        /// Number of frames.
        frames: u64,
    },
    /// The bus was lost or works again.
    Bus {
        /// Time of detection in ns since 1970.
        at_nanos: u64,
        /// The event.
        what: BusNote,
    },
}

/// Contact states of the cells of a bus at the time of a joint broadcast.
#[derive(Clone, Debug)]
pub struct EpochContacts {
    /// Time in ns since 1970.
    pub at_nanos: u64,
    /// Epoch of the joints.
    pub epoch: u8,
    /// Sensor values and status of each cell, in the order of the bus.
    pub cells: Box<[(Option<SkinSensors>, CellStatus)]>,
}

/// The receiver's end of the queues to the recorder.
#[derive(Debug)]
pub struct RecorderSender {
    frames: rtrb::Producer<CapturedItem>,
    touched: Option<rtrb::Producer<EpochContacts>>,
    /// Total number of frames that did not fit into the queue.
    unrecorded: u64,
    /// Number of frames that did not fit and have not been reported to the recorder.
    unreported: u64,
    /// Number of epochs whose contact states did not fit into the queue.
    unrecorded_epochs: u64,
}

/// Items that did not fit into queues.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct UnrecordedCounts {
    /// Number of frames.
    pub frames: u64,
    /// Number of epochs whose contact states are missing.
    pub epochs: u64,
}

impl RecorderSender {
    /// Queues a frame.
    pub fn push_frame(&mut self, seen: LatchedFrame) {
        if self.unreported > 0 {
            self.report_unrecorded(seen.at_nanos);
        }
        if self.unreported > 0 || self.frames.push(CapturedItem::Frame(seen)).is_err() {
            self.unrecorded += 1;
            self.unreported += 1;
        }
    }

    /// Returns the number of frames for which the queue has room.
    #[must_use]
    pub fn free_frame_slots(&self) -> usize {
        self.frames.slots()
    }

    /// Queues a report that the bus dropped frames.
    pub fn push_dropped_frames(&mut self, at_nanos: u64, frames: u64) {
        // The queue counts frames that do not fit, which is reported separately.
        let _ = self.frames.push(CapturedItem::Dropped { at_nanos, frames });
    }

    /// Queues a report that the bus was lost or works again.
    pub fn push_bus_note(&mut self, at_nanos: u64, what: BusNote) {
        // A full queue loses frames, which is reported separately.
        let _ = self.frames.push(CapturedItem::Bus { at_nanos, what });
    }

    /// Returns true if contact states are recorded.
    #[must_use]
    pub const fn records_contacts(&self) -> bool {
        self.touched.is_some()
    }

    /// Queues contact states.
    pub fn push_contacts(&mut self, touched: EpochContacts) {
        if let Some(queue) = &mut self.touched
            && queue.push(touched).is_err()
        {
            self.unrecorded_epochs += 1;
        }
    }

    /// Queues a report of the frames that did not fit, if the queue has room. Returns true if all such frames have been
    /// reported.
    pub fn report_unrecorded(&mut self, at_nanos: u64) -> bool {
        let frames = self.unreported;
        if frames > 0 && self.frames.push(CapturedItem::Unrecorded { at_nanos, frames }).is_ok() {
            self.unreported = 0;
        }
        self.unreported == 0
    }

    /// Returns the numbers of items that did not fit into the queues.
    #[must_use]
    pub const fn unrecorded_counts(&self) -> UnrecordedCounts {
        UnrecordedCounts { frames: self.unrecorded, epochs: self.unrecorded_epochs }
    }
}

/// The recorder's end of the queues of a bus.
#[derive(Debug)]
pub struct BusFeed {
    pub(super) frames: rtrb::Consumer<CapturedItem>,
    pub(super) touched: Option<rtrb::Consumer<EpochContacts>>,
    /// State of the bus's cells.
    pub(super) view: Arc<Mutex<BusView>>,
    /// State of the bus.
    pub(super) state: Arc<BusState>,
}

/// Creates the queues for one bus out of `buses`, and returns both ends. `all` is true if contact states are recorded,
/// not only frames.
#[must_use]
pub fn bus_feed(
    buses: usize,
    all: bool,
    view: Arc<Mutex<BusView>>,
    state: Arc<BusState>,
) -> (RecorderSender, BusFeed) {
    let (frames, taken) = rtrb::RingBuffer::new(frame_queue_length(buses));
    let (touched, states) = all.then(|| rtrb::RingBuffer::new(EPOCH_QUEUE_LENGTH)).unzip();
    let outlet = RecorderSender { frames, touched, unrecorded: 0, unreported: 0, unrecorded_epochs: 0 };
    (outlet, BusFeed { frames: taken, touched: states, view, state })
}

/// All inputs of the recorder.
#[derive(Debug)]
pub struct RecorderFeed {
    /// Queues of each bus.
    pub bus_feeds: Vec<BusFeed>,
    /// Ticks of the control loop.
    pub ticks: Option<rtrb::Consumer<TimedRecord>>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::can::Frame;

    #[test]
    fn forty_buses_take_ten_times_the_memory_of_one() {
        assert_eq!(
            [0, 1, 4, 8, 16, 40].map(frame_queue_length),
            [65_536, 65_536, 65_536, 32_768, 16_384, 16_384]
        );
    }

    #[test]
    fn what_does_not_fit_is_reported_where_it_is_missing() {
        let (mut outlet, mut bus_feed) = bus_feed(1, false, Arc::default(), Arc::default());
        let frame = |at_nanos| LatchedFrame { at_nanos, from_gateway: false, frame: Frame::EMPTY };
        let all = FRAME_QUEUE_LENGTH as u64;
        (0..all + 7).for_each(|at| outlet.push_frame(frame(at)));
        assert_eq!(outlet.unrecorded_counts(), UnrecordedCounts { frames: 7, epochs: 0 });
        let mut taken = 0;
        while let Ok(CapturedItem::Frame(seen)) = bus_feed.frames.pop() {
            assert_eq!(seen.at_nanos, taken);
            taken += 1;
        }
        assert_eq!(taken, all);
        outlet.push_frame(frame(1_000_000));
        outlet.push_frame(frame(1_000_001));
        let said = bus_feed.frames.pop().unwrap();
        assert!(matches!(said, CapturedItem::Unrecorded { at_nanos: 1_000_000, frames: 7 }), "{said:?}");
        assert!(
            matches!(bus_feed.frames.pop().unwrap(), CapturedItem::Frame(seen) if seen.at_nanos == 1_000_000)
        );
        assert_eq!(outlet.unrecorded_counts().frames, 7);
    }
}
