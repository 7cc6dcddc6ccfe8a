//! The sockets of a process: what wakes it comes by one, what can wait until it is awake by another.

use std::time::Duration;

use protocol::bus::{Bus, BusError, Filter, Inbox, Options, Received};
use protocol::can::Frame;

use super::Line;
use super::Stopped;

/// What a process hears.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub(super) struct Hearing {
    /// What wakes it.
    pub(super) at_once: Vec<Filter>,
    /// What it hears before that.
    pub(super) deferred: Vec<Filter>,
}

/// The open bus, twice when something is heard aside.
///
/// Waking a process costs more than all that it does with a frame, so it is not woken for what only has to be known
/// by the time that something else comes.
#[derive(Debug)]
pub struct Sockets {
    bus: Bus,
    deferred: Option<Bus>,
    /// What came aside.
    waited: Inbox,
    /// What woke the process.
    woke: Inbox,
    /// Both, in the order of the kernel's time stamps.
    came: Vec<Received>,
}

impl Sockets {
    /// Opens the bus; `deferred` asks for the second socket.
    ///
    /// # Errors
    /// When it cannot be used as it is asked for.
    pub(super) fn open(line: &Line, options: &Options, deferred: Option<&[Filter]>) -> Result<Self, Stopped> {
        let bus = line.open(options)?;
        let open = |filters: &[Filter]| {
            line.open(&Options { filters: filters.to_vec(), own_frames: false, ..options.clone() })
        };
        Ok(Self {
            bus,
            deferred: deferred.map(open).transpose()?,
            waited: Inbox::new(),
            woke: Inbox::new(),
            came: Vec::new(),
        })
    }

    pub(super) fn name(&self) -> &str {
        self.bus.name()
    }

    /// Puts other filters in force than those that are.
    pub(super) fn set_filters(&self, hearing: &Hearing, before: &Hearing) -> Result<(), BusError> {
        // What moves from one socket to the other comes by both for a moment rather than by none.
        let (update, old) =
            (only_in(&hearing.deferred, &before.deferred), only_in(&before.deferred, &hearing.deferred));
        if let (Some(deferred), true) = (&self.deferred, !update.is_empty()) {
            deferred.set_filters(&[&before.deferred[..], &update].concat())?;
        }
        if hearing.at_once != before.at_once {
            self.bus.set_filters(&hearing.at_once)?;
        }
        if let (Some(deferred), true) = (&self.deferred, !old.is_empty()) {
            deferred.set_filters(&hearing.deferred)?;
        }
        Ok(())
    }

    pub(super) fn send(&self, frames: &[Frame]) -> Result<(), BusError> {
        self.bus.send(frames).map_err(|error| error.cause)
    }

    /// Forgets what came last, and takes what has come by now; whether there is anything.
    pub(super) fn look(&mut self) -> Result<bool, BusError> {
        self.wait(Duration::ZERO)?;
        if self.came.is_empty() {
            self.take_deferred()?;
        }
        Ok(!self.came.is_empty())
    }

    /// Forgets what came last, and waits for what wakes; with it comes what waited.
    pub(super) fn wait(&mut self, wait: Duration) -> Result<(), BusError> {
        self.waited.clear();
        self.woke.clear();
        self.came.clear();
        if wait >= Bus::TIMEOUT {
            self.bus.receive_one_patiently(&mut self.woke)?;
        } else if self.bus.wait(Some(wait))? {
            self.bus.receive(&mut self.woke)?;
        }
        if self.woke.frames().len() > 0 {
            self.take_deferred()?;
        }
        Ok(())
    }

    fn take_deferred(&mut self) -> Result<(), BusError> {
        if let Some(deferred) = &self.deferred {
            deferred.receive(&mut self.waited)?;
        }
        let mut waited = self.waited.frames().peekable();
        for received in self.woke.frames() {
            while let Some(earlier) = waited.next_if(|waited| waited.at_nanos < received.at_nanos) {
                self.came.push(earlier);
            }
            self.came.push(received);
        }
        self.came.extend(waited);
        Ok(())
    }

    /// What came last.
    pub(super) fn frames(&self) -> &[Received] {
        &self.came
    }
}

/// What is in one list and not in the other.
fn only_in(these: &[Filter], those: &[Filter]) -> Vec<Filter> {
    these.iter().filter(|filter| !those.contains(filter)).copied().collect()
}
