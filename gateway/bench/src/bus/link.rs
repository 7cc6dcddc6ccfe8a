//! One bus, shared by the threads of a run: it may be lost and reopened, and senders never wait for that.
//!
//! The receiver reopens a bus that is gone. The control loop gets the new bus through a triple buffer, where it neither
//! blocks nor frees memory. Threads that may block use [`SharedBus::send`].

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use protocol::bus::{Bus, BusError, BusKind, BusOptions, KindChoice, SendError};
use protocol::can::Frame;
use vcan_setup::embedded::TimedReport;
use vcan_setup::hosts::report::ReportReader;

use super::follow::BusSource;
use control::cycle::turn::BusState;

/// Time that the server of a timed bus has to report its figures.
const FIGURES_TIMEOUT: Duration = Duration::from_secs(2);

/// A bus shared by the threads of a run.
#[derive(Debug)]
pub struct SharedBus {
    /// Name of the bus.
    pub name: String,
    /// Transport of the frames.
    pub kind: BusKind,
    /// Size of the receive buffer in bytes that the kernel granted when the bus was first opened.
    pub receive_buffer: usize,
    /// True if time stamps are ends of frames, because frames take time on the bus.
    pub is_timed: bool,
    /// State of the bus that the control loop reads too.
    pub state: Arc<BusState>,
    /// Options with which the bus is opened, also when it is reopened.
    target: BusOptions,
    bus: Mutex<Arc<Bus>>,
    gone: AtomicBool,
}

/// The control loop's end of the triple buffer that holds the open bus.
pub type BusSlot = triple_buffer::Output<Arc<Bus>>;

/// The end of a [`SharedBus`] that the receiver's thread holds.
#[derive(Debug)]
pub struct ReceiveEnd {
    /// The link shared with the other threads.
    pub link: Arc<SharedBus>,
    /// The bus that was opened last.
    pub bus: Arc<Bus>,
    slot: triple_buffer::Input<Arc<Bus>>,
}

impl SharedBus {
    /// Creates the link of a bus that was opened with these options.
    #[must_use]
    pub fn new(bus: Bus, target: BusOptions) -> (Arc<Self>, ReceiveEnd, BusSlot) {
        let bus = Arc::new(bus);
        let link = Arc::new(Self {
            name: bus.name().to_owned(),
            kind: bus.kind(),
            receive_buffer: bus.receive_buffer_bytes(),
            is_timed: bus.is_timed(),
            state: Arc::default(),
            target,
            bus: Mutex::new(Arc::clone(&bus)),
            gone: AtomicBool::new(false),
        });
        let (slot, output) = triple_buffer::triple_buffer(&bus);
        (Arc::clone(&link), ReceiveEnd { link, bus, slot }, output)
    }

    /// Returns true if the bus must be reopened.
    #[must_use]
    pub fn is_gone(&self) -> bool {
        self.gone.load(Ordering::Relaxed)
    }

    /// Connects to the `vcan-setup link` process that joins this bus with buses of other hosts.
    ///
    /// # Errors
    /// Returns [`io::Error`] if no such process runs.
    pub fn connect_reports(&self) -> io::Result<ReportReader> {
        ReportReader::connect(&self.name, self.kind, self.target.directory.as_deref())
    }

    /// Returns the figures of a timed bus from its server; `None` if the server does not answer, or if frames take no time
    /// on the bus.
    #[must_use]
    pub fn request_figures(&self) -> Option<TimedReport> {
        let served = self.is_timed.then(|| self.kind.served_name(&self.name))?;
        TimedReport::request(&served, self.target.directory.as_deref(), FIGURES_TIMEOUT)
    }

    /// Sends frames. Blocks while the receiver replaces the bus, so the control loop must not call it.
    ///
    /// # Errors
    /// Returns [`SendError`] with the reason and the number of frames sent before it.
    pub fn send(&self, frames: &[Frame]) -> Result<(), SendError> {
        let bus = Arc::clone(&self.bus.lock().unwrap_or_else(PoisonError::into_inner));
        bus.send(frames)
    }
}

/// Returns true if a bus with this error may work again, after a wait or a reopening.
#[must_use]
pub const fn is_recoverable(error: &BusError) -> bool {
    error.is_temporary() || error.is_closed()
}

impl ReceiveEnd {
    /// Marks the bus as not working, and as `gone` if it must be reopened. Returns true if the state changed.
    pub fn mark_lost(&self, gone: bool) -> bool {
        let became_gone = gone && !self.link.gone.swap(true, Ordering::Relaxed);
        self.link.state.works.swap(false, Ordering::Relaxed) || became_gone
    }

    /// Marks the bus as working. Returns true if the state changed.
    pub fn mark_working(&self) -> bool {
        !self.link.state.works.swap(true, Ordering::Relaxed)
    }
}

impl BusSource for ReceiveEnd {
    fn bus(&self) -> Option<&Bus> {
        Some(&self.bus)
    }

    /// Reopens a bus that is gone, and passes it to all threads.
    fn reopen(&mut self) -> Result<(), BusError> {
        let SharedBus { name, kind, target, .. } = &*self.link;
        self.bus = Arc::new(Bus::open(name, KindChoice::Only(*kind), target)?);
        *self.link.bus.lock().unwrap_or_else(PoisonError::into_inner) = Arc::clone(&self.bus);
        self.slot.write(Arc::clone(&self.bus));
        self.link.gone.store(false, Ordering::Relaxed);
        Ok(())
    }
}

/// Number and total duration of the losses of a bus.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Outages {
    /// Number of losses.
    pub count: u64,
    /// Total duration of the outages that have ended.
    past_losses: Duration,
    /// Start of the present outage, if the bus is lost.
    lost_since: Option<Instant>,
}

impl Outages {
    /// Starts an outage at `now`, unless one has started already.
    pub fn begin_outage(&mut self, now: Instant) {
        if self.lost_since.is_none() {
            self.count += 1;
            self.lost_since = Some(now);
        }
    }

    /// Ends the present outage at `now`.
    pub fn end_outage(&mut self, now: Instant) {
        self.past_losses +=
            self.lost_since.take().map_or(Duration::ZERO, |since| now.saturating_duration_since(since));
    }

    /// Total lost time up to `now`, including the present outage.
    #[must_use]
    pub fn total_lost_time(&self, now: Instant) -> Duration {
        let mut until_now = *self;
        until_now.end_outage(now);
        until_now.past_losses
    }

    /// Returns true while the bus is lost.
    #[must_use]
    pub const fn is_ongoing(&self) -> bool {
        self.lost_since.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outages_are_counted_and_added_up_including_the_present_one() {
        let (start, second) = (Instant::now(), Duration::from_secs(1));
        let mut outages = Outages::default();
        outages.end_outage(start);
        assert_eq!(outages, Outages::default());
        outages.begin_outage(start);
        outages.begin_outage(start + second);
        outages.end_outage(start + 2 * second);
        outages.begin_outage(start + 5 * second);
        assert_eq!(
            (outages.count, outages.total_lost_time(start + 6 * second), outages.is_ongoing()),
            (2, 3 * second, true)
        );
        outages.end_outage(start + 9 * second);
        assert_eq!((outages.total_lost_time(start + 99 * second), outages.is_ongoing()), (6 * second, false));
    }
}
