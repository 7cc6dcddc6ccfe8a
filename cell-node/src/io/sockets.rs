//! The sockets of a process: one wakes it, the other is only read while it is awake (deferred receive).

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use protocol::bus::batch::BATCH;
use protocol::bus::{Bus, BusError, Filter, Inbox, Options, Received, SendError};
use protocol::can::Frame;

use super::Line;
use super::Stopped;

/// The receive filters of a process.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub(super) struct Hearing {
    /// Of the socket that wakes it.
    pub(super) at_once: Vec<Filter>,
    /// Of the socket that is read before frames that woke it.
    pub(super) deferred: Vec<Filter>,
}

/// How long after a filter was taken from the second socket frames may still come there.
const SETTLED: Duration = Duration::from_millis(50);
/// Batches that are read from the second socket at once: what its buffer holds.
const BATCHES: usize = 16;

/// The open bus, and a second socket for deferred frames.
///
/// Waking a process costs more than processing a frame, so a frame that is only needed together with a later one, or
/// need only be counted, does not wake it.
#[derive(Debug)]
pub struct Sockets {
    bus: Bus,
    deferred: Bus,
    /// In a network a frame comes before most timers; a cell that rests is woken by timers alone.
    is_network: bool,
    /// The second socket has filters.
    keeps: bool,
    /// Until then they may belong to those that wake, because a filter was moved.
    settled: Option<Instant>,
    /// Received deferred, and not taken yet.
    deferred_frames: VecDeque<Received>,
    inbox: Inbox,
    /// Received by the socket that wakes the process.
    woke: Inbox,
    /// Both, in the order of the kernel's time stamps.
    came: Vec<Arrived>,
}

/// A frame that was received.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrived {
    pub(super) received: Received,
    /// It was deferred, and came before anything that woke the process: it waited because it could.
    pub(super) waited: bool,
}

impl Sockets {
    /// Opens the bus.
    ///
    /// # Errors
    /// When it cannot be used as requested.
    pub(super) fn open(line: &Line, options: &Options, deferred: &[Filter]) -> Result<Self, Stopped> {
        let second = Options { filters: deferred.to_vec(), own_frames: false, ..options.clone() };
        Ok(Self {
            bus: line.open(options)?,
            deferred: line.open(&second)?,
            is_network: line.wires,
            keeps: !deferred.is_empty(),
            settled: None,
            deferred_frames: VecDeque::new(),
            inbox: Inbox::new(),
            woke: Inbox::new(),
            came: Vec::new(),
        })
    }

    pub(super) fn name(&self) -> &str {
        self.bus.name()
    }

    /// Replaces the filters `before` by `hearing`.
    pub(super) fn set_filters(&mut self, hearing: &Hearing, before: &Hearing) -> Result<(), BusError> {
        // A filter that moves between the sockets is set on both for a moment, so that no frame is lost.
        let (update, old) =
            (only_in(&hearing.deferred, &before.deferred), only_in(&before.deferred, &hearing.deferred));
        if !update.is_empty() {
            self.deferred.set_filters(&[&before.deferred[..], &update].concat())?;
        }
        if hearing.at_once != before.at_once {
            self.bus.set_filters(&hearing.at_once)?;
        }
        if !old.is_empty() {
            self.deferred.set_filters(&hearing.deferred)?;
            self.settled = Some(Instant::now() + SETTLED);
        }
        self.keeps = !hearing.deferred.is_empty();
        Ok(())
    }

    pub(super) fn send(&self, frames: &[Frame]) -> Result<(), SendError> {
        self.bus.send(frames)
    }

    /// Drops the last frames and receives those that are there, for a timer that was due at a wall's time in ns; whether
    /// there are any.
    pub(super) fn look(&mut self, due_nanos: u64) -> Result<bool, BusError> {
        self.clear();
        self.bus.receive(&mut self.woke)?;
        // Also what a late server put there after it was settled.
        self.receive_deferred()?;
        self.order(due_nanos);
        Ok(!self.came.is_empty())
    }

    /// Drops the last frames and waits for one that wakes; the deferred ones are received with it.
    pub(super) fn wait(&mut self, wait: Duration) -> Result<(), BusError> {
        self.clear();
        if let Some(settled) = self.settled {
            let left = settled.saturating_duration_since(Instant::now());
            if self.bus.wait_with(&self.deferred, wait.min(left))? {
                self.bus.receive(&mut self.woke)?;
                self.receive_deferred()?;
                self.order(0);
            }
            if left.is_zero() {
                self.settled = None;
            }
            return Ok(());
        }
        if self.is_network || !self.keeps {
            self.bus.wait_and_receive(&mut self.woke, wait)?;
        } else if self.bus.wait(Some(wait))? {
            self.bus.receive(&mut self.woke)?;
        }
        if self.woke.frames().len() > 0 {
            if self.keeps {
                self.receive_deferred()?;
            }
            self.order(u64::MAX);
        }
        Ok(())
    }

    fn clear(&mut self) {
        self.woke.clear();
        self.came.clear();
    }

    fn receive_deferred(&mut self) -> Result<(), BusError> {
        for _ in 0..BATCHES {
            let count = self.deferred.receive(&mut self.inbox)?;
            self.deferred_frames.extend(self.inbox.frames());
            if count < BATCH {
                break;
            }
        }
        Ok(())
    }

    /// Puts the frames of both in order. Deferred ones from before the first that woke the process, and before `until`,
    /// waited because they could.
    fn order(&mut self, until: u64) {
        let until = self.woke.frames().next().map_or(until, |first| first.at_nanos.min(until));
        let mut earlier = |than: u64, came: &mut Vec<Arrived>| {
            while let Some(&received) = self.deferred_frames.front().filter(|first| first.at_nanos < than) {
                self.deferred_frames.pop_front();
                came.push(Arrived { received, waited: received.at_nanos < until });
            }
        };
        for received in self.woke.frames() {
            earlier(received.at_nanos, &mut self.came);
            self.came.push(Arrived { received, waited: false });
        }
        // When more of those that wake are waiting, they come first.
        if self.woke.frames().len() < BATCH {
            earlier(u64::MAX, &mut self.came);
        }
    }

    /// The frames received last.
    pub(super) fn frames(&self) -> &[Arrived] {
        &self.came
    }
}

/// What is in one list and not in the other.
fn only_in(these: &[Filter], those: &[Filter]) -> Vec<Filter> {
    these.iter().filter(|filter| !those.contains(filter)).copied().collect()
}
