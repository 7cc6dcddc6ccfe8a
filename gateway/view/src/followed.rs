//! The buses that a page or a control channel receives on: each is followed by a thread, and opened again after a loss.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bench::bus::figures::TimedFigures;
use bench::bus::follow::{BusSource, FollowStep, Follower};
use bench::bus::listen::{now, open_bus, send_message};
use bench::summary::TimedReport;
use protocol::bus::batch::MAX_BATCH_DATAGRAMS;
use protocol::bus::{Bus, BusError, BusOptions, KindChoices};
use protocol::can::Format;
use protocol::message::Message;
use protocol::skin::SkinBus;
use protocol::time::Micros;

use crate::lock_ignoring_poison;

/// The time for which a thread waits for frames before it checks whether it must stop.
const RECEIVE_TIMEOUT: Duration = Duration::from_millis(50);
/// The size of the receive buffer of a bus in bytes.
const RECEIVE_BUFFER_BYTES: usize = 8 << 20;
/// The time after a step for which its thread may be late before time stands still, in µs.
const MAX_STEP_DELAY_US: u64 = 300_000;

/// A bus that a thread follows, and on which other threads send.
#[derive(Debug)]
pub(crate) struct FollowedBus {
    name: String,
    format: Format,
    bus: Mutex<Option<Arc<Bus>>>,
    /// The time in µs up to which all frames have been applied, or are about to be.
    read_to: AtomicU64,
    figures: Mutex<TimedFigures>,
}

/// Opens buses of a kind that the user chose.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BusOpener<'a> {
    /// The kind of each bus.
    pub(crate) kinds: &'a KindChoices,
    /// The directory of embedded buses; `None` for the default one.
    pub(crate) directory: Option<&'a Path>,
}

impl BusOpener<'_> {
    fn open(&self, name: &str, format: Format) -> Result<Arc<Bus>, BusError> {
        let options = BusOptions {
            own_frames: true,
            directory: self.directory.map(Path::to_owned),
            receive_buffer: RECEIVE_BUFFER_BYTES,
            ..BusOptions::default()
        };
        open_bus(name, self.kinds.kind_of(name), Some(format), options).map(Arc::new)
    }
}

/// A bus that is opened when it appears, and opened again after it was lost.
struct ReopeningBus<'a> {
    followed: &'a FollowedBus,
    opener: BusOpener<'a>,
    bus: Option<Arc<Bus>>,
}

impl BusSource for ReopeningBus<'_> {
    fn bus(&self) -> Option<&Bus> {
        self.bus.as_deref()
    }

    fn reopen(&mut self) -> Result<(), BusError> {
        let bus = self.opener.open(&self.followed.name, self.followed.format)?;
        self.bus = Some(Arc::clone(&bus));
        *lock_ignoring_poison(&self.followed.bus) = Some(bus);
        Ok(())
    }
}

impl FollowedBus {
    /// Opens a bus of the skin. If `waits` is set, a bus that does not open yet is opened later.
    ///
    /// # Errors
    /// Returns [`BusError`] if the bus cannot be opened, unless `waits` is set.
    pub(crate) fn open(described: &SkinBus, opener: BusOpener<'_>, waits: bool) -> Result<Self, BusError> {
        let bus = match opener.open(&described.name, described.format) {
            Ok(bus) => Some(bus),
            Err(_) if waits => None,
            Err(error) => return Err(error),
        };
        Ok(Self {
            name: described.name.clone(),
            format: described.format,
            bus: Mutex::new(bus),
            read_to: AtomicU64::new(u64::MAX),
            figures: Mutex::new(TimedFigures::new(&described.name, opener.directory)),
        })
    }

    /// Receives frames until `stop` is set, and passes the follower to `apply` after each step. After some frames have
    /// arrived, waits for `gather`, so that one step reads many.
    pub(crate) fn receive(
        &self,
        opener: BusOpener<'_>,
        gather: Duration,
        stop: &AtomicBool,
        mut apply: impl FnMut(&mut Follower),
    ) {
        let mut source =
            ReopeningBus { followed: self, opener, bus: lock_ignoring_poison(&self.bus).clone() };
        let mut follower = Follower::new(None, gather);
        while !stop.load(Ordering::Relaxed) {
            if let FollowStep::Gone(_) = follower.step(&mut source, RECEIVE_TIMEOUT) {
                *lock_ignoring_poison(&self.bus) = None;
            }
            // If the batch was full, more frames may be waiting to be read.
            let last = follower.frames().last().filter(|_| follower.frames().len() == MAX_BATCH_DATAGRAMS);
            let read_to = last.map_or_else(|| now().0 + MAX_STEP_DELAY_US, |last| last.at_nanos / 1_000);
            apply(&mut follower);
            self.read_to.store(read_to, Ordering::Relaxed);
        }
    }

    /// Returns true if frames take time on the bus, so that their time stamps are their ends.
    pub(crate) fn is_timed(&self) -> bool {
        lock_ignoring_poison(&self.bus).as_ref().is_some_and(|bus| bus.is_timed())
    }

    /// Returns the figures of a timed bus that have come from its server since the last call. Does not wait.
    pub(crate) fn poll_figures(&self) -> Option<TimedReport> {
        if self.is_timed() { lock_ignoring_poison(&self.figures).poll() } else { None }
    }

    /// Sends a message. Returns false if the bus does not take it; it then counts as a lost frame.
    pub(crate) fn send(&self, message: &Message) -> bool {
        let bus = lock_ignoring_poison(&self.bus).clone();
        bus.is_some_and(|bus| send_message(&bus, message, self.format).is_ok())
    }
}

/// Returns the present time. While frames wait to be read, or a thread has no processor time, time ends at the last
/// frame that was read, so that no cell seems silent.
pub(crate) fn time_of_read_frames(buses: &[FollowedBus]) -> Micros {
    let read_to = buses.iter().map(|bus| Micros(bus.read_to.load(Ordering::Relaxed))).min();
    read_to.map_or_else(now, |read_to| now().min(read_to))
}
