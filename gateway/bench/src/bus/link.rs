//! One bus as the threads of a run share it: it may be lost and reopened, and no thread waits for it.
//!
//! The receiver reopens a bus that is gone. The loop finds the new one in a triple buffer, where it neither waits nor
//! frees anything; threads that may wait use [`Link::send`].

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use protocol::bus::{Bus, BusError, BusKind, Choice, Options, SendError};
use protocol::can::Frame;
use vcan_setup::hosts::report::Reports;

use super::follow::Source;
use control::cycle::turn::BusState;

/// One bus.
#[derive(Debug)]
pub struct Link {
    /// Its name.
    pub name: String,
    /// What carries its frames.
    pub kind: BusKind,
    /// How many bytes may wait unread, as they were granted when it was first opened.
    pub receive_buffer: usize,
    /// Its state.
    pub state: Arc<BusState>,
    /// How it was opened, and is again.
    target: Options,
    bus: Mutex<Arc<Bus>>,
    gone: AtomicBool,
}

/// Where the loop finds the bus.
pub type Slot = triple_buffer::Output<Arc<Bus>>;

/// The receiver's end of a link.
#[derive(Debug)]
pub struct ReceiveEnd {
    /// The link.
    pub link: Arc<Link>,
    /// The bus, as it was opened last.
    pub bus: Arc<Bus>,
    slot: triple_buffer::Input<Arc<Bus>>,
}

impl Link {
    /// The link of a bus that was opened with these options.
    #[must_use]
    pub fn new(bus: Bus, target: Options) -> (Arc<Self>, ReceiveEnd, Slot) {
        let bus = Arc::new(bus);
        let link = Arc::new(Self {
            name: bus.name().to_owned(),
            kind: bus.kind(),
            receive_buffer: bus.receive_buffer(),
            state: Arc::default(),
            target,
            bus: Mutex::new(Arc::clone(&bus)),
            gone: AtomicBool::new(false),
        });
        let (slot, output) = triple_buffer::triple_buffer(&bus);
        (Arc::clone(&link), ReceiveEnd { link, bus, slot }, output)
    }

    /// Whether it has to be reopened.
    #[must_use]
    pub fn is_gone(&self) -> bool {
        self.gone.load(Ordering::Relaxed)
    }

    /// Connects to the program that joins it with buses of other hosts.
    ///
    /// # Errors
    /// When there is none.
    pub fn reports(&self) -> io::Result<Reports> {
        Reports::connect(&self.name, self.kind, self.target.directory.as_deref())
    }

    /// Sends frames; not for the loop, for a bus that is being exchanged is waited for.
    ///
    /// # Errors
    /// The reason, and how many were sent before it.
    pub fn send(&self, frames: &[Frame]) -> Result<(), SendError> {
        let bus = Arc::clone(&self.bus.lock().unwrap_or_else(PoisonError::into_inner));
        bus.send(frames)
    }
}

/// Whether a bus with this error may be used again, by waiting or by reopening it.
#[must_use]
pub const fn may_return(error: &BusError) -> bool {
    error.may_pass() || error.is_closed()
}

impl ReceiveEnd {
    /// Notes that it does not work; `gone` if it has to be reopened. Whether that is a change.
    pub fn lose(&self, gone: bool) -> bool {
        let bus_event = gone && !self.link.gone.swap(true, Ordering::Relaxed);
        self.link.state.works.swap(false, Ordering::Relaxed) || bus_event
    }

    /// Notes that it works. Whether that is a change.
    pub fn regain(&self) -> bool {
        !self.link.state.works.swap(true, Ordering::Relaxed)
    }
}

impl Source for ReceiveEnd {
    fn bus(&self) -> Option<&Bus> {
        Some(&self.bus)
    }

    /// Reopens a bus that is gone, and hands it to all threads.
    fn reopen(&mut self) -> Result<(), BusError> {
        let Link { name, kind, target, .. } = &*self.link;
        self.bus = Arc::new(Bus::open(name, Choice::Only(*kind), target)?);
        *self.link.bus.lock().unwrap_or_else(PoisonError::into_inner) = Arc::clone(&self.bus);
        self.slot.write(Arc::clone(&self.bus));
        self.link.gone.store(false, Ordering::Relaxed);
        Ok(())
    }
}

/// How often a bus was lost, and for how long.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Outages {
    /// How often.
    pub times: u64,
    /// For how long in total, without the present outage.
    lost: Duration,
    /// Since when it is lost.
    since: Option<Instant>,
}

impl Outages {
    /// It is lost from now on, if it was not.
    pub fn begin(&mut self, now: Instant) {
        if self.since.is_none() {
            self.times += 1;
            self.since = Some(now);
        }
    }

    /// It is there again.
    pub fn end(&mut self, now: Instant) {
        self.lost += self.since.take().map_or(Duration::ZERO, |since| now.saturating_duration_since(since));
    }

    /// For how long it was lost until now.
    #[must_use]
    pub fn lost(&self, now: Instant) -> Duration {
        let mut until_now = *self;
        until_now.end(now);
        until_now.lost
    }

    /// Whether it is lost.
    #[must_use]
    pub const fn lasts(&self) -> bool {
        self.since.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outages_are_counted_and_added_up_including_the_present_one() {
        let (start, second) = (Instant::now(), Duration::from_secs(1));
        let mut outages = Outages::default();
        outages.end(start);
        assert_eq!(outages, Outages::default());
        outages.begin(start);
        outages.begin(start + second);
        outages.end(start + 2 * second);
        outages.begin(start + 5 * second);
        assert_eq!((outages.times, outages.lost(start + 6 * second), outages.lasts()), (2, 3 * second, true));
        outages.end(start + 9 * second);
        assert_eq!((outages.lost(start + 99 * second), outages.lasts()), (6 * second, false));
    }
}
