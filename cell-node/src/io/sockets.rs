//! The sockets of a process: one wakes it, the other is only read while it is awake (deferred receive).

use std::time::Duration;

use protocol::bus::{Bus, BusError, Filter, Inbox, Options, Received};
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

/// The open bus; a second socket where some frames are deferred.
///
/// Waking a process costs more than processing a frame, so a frame that is only needed together with a later one
/// does not wake it.
#[derive(Debug)]
pub struct Sockets {
    bus: Bus,
    deferred: Option<Bus>,
    /// Received deferred.
    waited: Inbox,
    /// Received by the socket that wakes the process.
    woke: Inbox,
    /// Both, in the order of the kernel's time stamps.
    came: Vec<Received>,
}

impl Sockets {
    /// Opens the bus; `deferred` are the filters of the second socket.
    ///
    /// # Errors
    /// When it cannot be used as requested.
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

    /// Replaces the filters `before` by `hearing`.
    pub(super) fn set_filters(&self, hearing: &Hearing, before: &Hearing) -> Result<(), BusError> {
        // A filter that moves between the sockets is set on both for a moment, so that no frame is lost.
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

    /// Drops the last frames and receives those that are there; whether there are any.
    pub(super) fn look(&mut self) -> Result<bool, BusError> {
        self.wait(Duration::ZERO)?;
        if self.came.is_empty() {
            self.take_deferred()?;
        }
        Ok(!self.came.is_empty())
    }

    /// Drops the last frames and waits for one that wakes; the deferred ones are received with it.
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

    /// The frames received last.
    pub(super) fn frames(&self) -> &[Received] {
        &self.came
    }
}

/// What is in one list and not in the other.
fn only_in(these: &[Filter], those: &[Filter]) -> Vec<Filter> {
    these.iter().filter(|filter| !those.contains(filter)).copied().collect()
}
