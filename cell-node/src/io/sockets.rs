//! The two sockets of a process: one whose frames wake the process, and one that is read only when the process is awake
//! (deferred receive).

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use protocol::bus::batch::MAX_BATCH_DATAGRAMS;
use protocol::bus::{Bus, BusError, BusOptions, Filter, Inbox, ReceivedFrame, SendError};
use protocol::can::Frame;

use super::BusPort;
use super::StopReason;

/// The receive filters of the two sockets.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub(super) struct ReceiveFilters {
    /// Filters of the socket whose frames wake the process.
    pub(super) at_once: Vec<Filter>,
    /// Filters of the deferred socket. Its frames are handled before a frame that woke the process, if they are older.
    pub(super) deferred: Vec<Filter>,
}

/// Time for which frames may still arrive at the deferred socket after one of its filters was removed.
const FILTER_SETTLING_TIME: Duration = Duration::from_millis(50);
/// Number of batches that are read from the deferred socket at once. They hold as many frames as its receive buffer.
const MAX_DEFERRED_BATCHES: usize = 16;

/// The open bus, and a second socket for deferred frames.
///
/// Waking a process costs more than handling a frame. Some frames are only counted, or are needed only together with a
/// later frame; they are received deferred and do not wake the process.
#[derive(Debug)]
pub struct Sockets {
    bus: Bus,
    deferred: Bus,
    /// True if the cells form a network. In a network a frame arrives before most timers are due, but a cell that
    /// joints do not wake is woken by timers only.
    is_network: bool,
    /// True if the deferred socket has at least one filter.
    has_deferred_filters: bool,
    /// Time until which the deferred socket may contain frames that should now wake the process, because their filter
    /// was moved.
    settled: Option<Instant>,
    /// Frames from the deferred socket that have not been handled yet.
    deferred_frames: VecDeque<ReceivedFrame>,
    inbox: Inbox,
    /// Frames from the socket that wakes the process.
    woke: Inbox,
    /// Frames from both sockets, in the order of the kernel's time stamps.
    arrived: Vec<MergedFrame>,
}

/// A received frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct MergedFrame {
    pub(super) received: ReceivedFrame,
    /// True if the frame was deferred and is older than all frames that woke the process.
    pub(super) waited: bool,
}

impl Sockets {
    /// Opens both sockets.
    ///
    /// # Errors
    /// Returns an error if the bus does not exist, is not accessible, or does not support `options`.
    pub(super) fn open(
        line: &BusPort,
        options: &BusOptions,
        deferred: &[Filter],
    ) -> Result<Self, StopReason> {
        let second = BusOptions { filters: deferred.to_vec(), own_frames: false, ..options.clone() };
        Ok(Self {
            bus: line.open(options)?,
            deferred: line.open(&second)?,
            is_network: line.wires,
            has_deferred_filters: !deferred.is_empty(),
            settled: None,
            deferred_frames: VecDeque::new(),
            inbox: Inbox::new(),
            woke: Inbox::new(),
            arrived: Vec::new(),
        })
    }

    pub(super) fn name(&self) -> &str {
        self.bus.name()
    }

    /// Sets the filters `hearing` on both sockets, given the present filters `before`.
    pub(super) fn set_filters(
        &mut self,
        hearing: &ReceiveFilters,
        before: &ReceiveFilters,
    ) -> Result<(), BusError> {
        // A filter that moves between the sockets is set on both for a moment, so that no frame is lost.
        let (update, old) = (
            filter_difference(&hearing.deferred, &before.deferred),
            filter_difference(&before.deferred, &hearing.deferred),
        );
        if !update.is_empty() {
            self.deferred.set_filters(&[&before.deferred[..], &update].concat())?;
        }
        if hearing.at_once != before.at_once {
            self.bus.set_filters(&hearing.at_once)?;
        }
        if !old.is_empty() {
            self.deferred.set_filters(&hearing.deferred)?;
            self.settled = Some(Instant::now() + FILTER_SETTLING_TIME);
        }
        self.has_deferred_filters = !hearing.deferred.is_empty();
        Ok(())
    }

    pub(super) fn send(&self, frames: &[Frame]) -> Result<(), SendError> {
        self.bus.send(frames)
    }

    /// Receives pending frames without waiting, before a timer is handled that was due at a wall clock time in ns.
    /// Returns true if any frames were pending.
    pub(super) fn receive_pending(&mut self, due_nanos: u64) -> Result<bool, BusError> {
        self.clear_frames();
        self.bus.receive(&mut self.woke)?;
        // Includes frames that a slow server delivered after the settling time.
        self.receive_deferred()?;
        self.merge_by_time(due_nanos);
        Ok(!self.arrived.is_empty())
    }

    /// Waits for a frame that wakes the process, and receives it together with the deferred frames.
    pub(super) fn wait_for_frames(&mut self, wait: Duration) -> Result<(), BusError> {
        self.clear_frames();
        if let Some(settled) = self.settled {
            let left = settled.saturating_duration_since(Instant::now());
            if self.bus.wait_for_either(&self.deferred, wait.min(left))? {
                self.bus.receive(&mut self.woke)?;
                self.receive_deferred()?;
                self.merge_by_time(0);
            }
            if left.is_zero() {
                self.settled = None;
            }
            return Ok(());
        }
        if self.is_network || !self.has_deferred_filters {
            self.bus.wait_and_receive(&mut self.woke, wait)?;
        } else if self.bus.wait(Some(wait))? {
            self.bus.receive(&mut self.woke)?;
        }
        if self.woke.frames().len() > 0 {
            if self.has_deferred_filters {
                self.receive_deferred()?;
            }
            self.merge_by_time(u64::MAX);
        }
        Ok(())
    }

    fn clear_frames(&mut self) {
        self.woke.clear();
        self.arrived.clear();
    }

    fn receive_deferred(&mut self) -> Result<(), BusError> {
        for _ in 0..MAX_DEFERRED_BATCHES {
            let count = self.deferred.receive(&mut self.inbox)?;
            self.deferred_frames.extend(self.inbox.frames());
            if count < MAX_BATCH_DATAGRAMS {
                break;
            }
        }
        Ok(())
    }

    /// Merges the frames of both sockets in the order of their time stamps. Deferred frames that are older than the
    /// first waking frame and than `until` are marked as having waited.
    fn merge_by_time(&mut self, until: u64) {
        let until = self.woke.frames().next().map_or(until, |first| first.at_nanos.min(until));
        let mut earlier = |than: u64, came: &mut Vec<MergedFrame>| {
            while let Some(&received) = self.deferred_frames.front().filter(|first| first.at_nanos < than) {
                self.deferred_frames.pop_front();
                came.push(MergedFrame { received, waited: received.at_nanos < until });
            }
        };
        for received in self.woke.frames() {
            earlier(received.at_nanos, &mut self.arrived);
            self.arrived.push(MergedFrame { received, waited: false });
        }
        // If the waking socket has more pending frames, those come first.
        if self.woke.frames().len() < MAX_BATCH_DATAGRAMS {
            earlier(u64::MAX, &mut self.arrived);
        }
    }

    /// Returns the frames of the last receive.
    pub(super) fn frames(&self) -> &[MergedFrame] {
        &self.arrived
    }
}

/// Returns the elements of the first list that are not in the second.
fn filter_difference(these: &[Filter], those: &[Filter]) -> Vec<Filter> {
    these.iter().filter(|filter| !those.contains(filter)).copied().collect()
}
