//! The bridge between a bus and its lines: one thread and one `poll` for all of them.

use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::time::{Duration, Instant};

use protocol::bus::{BusError, BusKind};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use thiserror::Error;

use super::account::LineAccount;
use super::event::LineEvent;
use super::options::LineOptions;
use super::participant::{LineParticipant, ReadyEnds};
use super::settings::{BridgeSettings, open};

/// The time that the program takes at its end to complete a line of text and to close the adapters.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);
/// The interval between two attempts to open a line at the start.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// The reason why lines cannot be connected to a bus.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BridgeError {
    /// Two lines have the same address.
    #[error("{0} is named twice: name each line once")]
    Twice(String),
    /// The bus cannot be opened.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A line cannot be opened.
    #[error("cannot open {line}: {source}{hint}")]
    Line {
        /// The address.
        line: String,
        /// The cause.
        source: io::Error,
        /// Advice to the user; empty if the cause contains it.
        hint: &'static str,
    },
    /// The system call that waits for data failed.
    #[error("cannot wait for lines: {0}")]
    Wait(#[source] io::Error),
}

/// The lines that are connected to a bus, and one client of the bus for each.
#[derive(Debug)]
pub struct Bridge {
    settings: BridgeSettings,
    kind: BusKind,
    participants: Vec<LineParticipant>,
}

impl Bridge {
    /// Opens the lines, and one client of the bus for each. With [`BridgeSettings::wait`], lines may be unavailable at
    /// first.
    ///
    /// # Errors
    /// Returns [`BridgeError`] if the bus or a line cannot be opened.
    pub fn open(settings: BridgeSettings, lines: Vec<LineOptions>) -> Result<Self, BridgeError> {
        let kind = settings.choice.resolve(&settings.bus);
        let mut participants: Vec<LineParticipant> = Vec::new();
        for line in lines {
            let name = line.address.to_string();
            if participants.iter().any(|other| other.name() == name) {
                return Err(BridgeError::Twice(name));
            }
            let bus = open(&settings, &line)?;
            let participant = LineParticipant::new(line, bus);
            participants.push(participant.map_err(|error| line_error(name, error))?);
        }
        let mut bridge = Self { settings, kind, participants };
        for participant in &mut bridge.participants {
            loop {
                participant.open_line(Instant::now(), &mut |_| {});
                if participant.is_up() || bridge.settings.wait {
                    break;
                }
                if let Some(error) = participant.take_closed_reason() {
                    return Err(line_error(participant.name(), error));
                }
                // A TCP connection is established in the background, so its state is queried until it is known.
                std::thread::sleep(RETRY_INTERVAL);
            }
        }
        Ok(bridge)
    }

    /// Returns the kind of the bus.
    #[must_use]
    pub const fn kind(&self) -> BusKind {
        self.kind
    }

    /// Returns the lines that are not open, each with the reason if it is known.
    #[must_use]
    pub fn unavailable_lines(&self) -> Vec<String> {
        let away = self.participants.iter().filter(|it| !it.is_up());
        let words = |it: &LineParticipant| {
            it.closed_reason().map_or_else(|| it.name(), |reason| format!("{} ({reason})", it.name()))
        };
        away.map(words).collect()
    }

    /// Forwards frames until `stop` is readable or hung up, and then closes the adapters. Returns the counts of each
    /// line, in their order. Calls `report` when a line or a bus is lost or available again, and for lost frames at
    /// most once a second for each line.
    ///
    /// # Errors
    /// Returns [`BridgeError::Wait`] if the system cannot wait.
    pub fn run(
        mut self,
        stop: impl AsFd,
        mut report: impl FnMut(&str, LineEvent),
    ) -> Result<Vec<LineAccount>, BridgeError> {
        loop {
            let ready = self.wait(Some(stop.as_fd()), None).map_err(BridgeError::Wait)?;
            let Some(ready) = ready else { return self.close(&mut report) };
            for (participant, ready) in self.participants.iter_mut().zip(ready) {
                let name = participant.name();
                participant.forward_available(&self.settings, ready, &mut |event| report(&name, event));
            }
        }
    }

    fn close(mut self, report: &mut impl FnMut(&str, LineEvent)) -> Result<Vec<LineAccount>, BridgeError> {
        let until = Instant::now() + CLOSE_TIMEOUT;
        self.participants.iter_mut().for_each(LineParticipant::start_closing);
        loop {
            // `count` visits all participants; `any` would stop at the first that is not finished.
            let left =
                self.participants.iter_mut().filter_map(|it| (!it.write_remaining()).then_some(())).count();
            if left == 0 || Instant::now() >= until {
                break;
            }
            self.wait(None, Some(until)).map_err(BridgeError::Wait)?;
        }
        for participant in &mut self.participants {
            if !participant.give_up_closing() {
                report(&participant.name(), LineEvent::NotClosed);
            }
        }
        Ok(self.participants.iter().map(LineParticipant::account).collect())
    }

    /// Waits for data or for the next time at which there is something to do. Returns which ends of each line are
    /// readable, or `None` if the bridge should stop.
    fn wait(
        &mut self,
        stop: Option<BorrowedFd<'_>>,
        until: Option<Instant>,
    ) -> io::Result<Option<Vec<ReadyEnds>>> {
        let now = Instant::now();
        let mut next = until;
        let mut interests = Vec::with_capacity(self.participants.len());
        for participant in &mut self.participants {
            interests.push(participant.poll_interest());
            next = [next, participant.next_deadline(now)].into_iter().flatten().min();
        }
        let mut polled = Vec::with_capacity(1 + 2 * interests.len());
        polled.extend(stop.map(|stop| PollFd::from_borrowed_fd(stop, PollFlags::IN)));
        for (participant, interest) in self.participants.iter().zip(&interests) {
            let (line, bus) = participant.poll_ends();
            polled.extend(
                line.zip(interest.line).map(|(line, flags)| PollFd::from_borrowed_fd(line.as_fd(), flags)),
            );
            polled.extend(bus.map(|bus| PollFd::from_borrowed_fd(bus.as_fd(), PollFlags::IN)));
        }
        let timeout = next.and_then(|next| Timespec::try_from(next.saturating_duration_since(now)).ok());
        match poll(&mut polled, timeout.as_ref()) {
            Ok(_) | Err(Errno::INTR) => {}
            // The kernel lacks memory for a moment. All ends are then treated as ready.
            Err(Errno::NOMEM | Errno::AGAIN) => std::thread::sleep(RETRY_INTERVAL),
            Err(errno) => return Err(errno.into()),
        }
        let mut came = polled.iter().map(|polled| !polled.revents().is_empty());
        if stop.is_some() && came.next() == Some(true) {
            return Ok(None);
        }
        let ready = self.participants.iter().zip(&interests).map(|(participant, interest)| {
            let (line, bus) = participant.poll_ends();
            let line = line.zip(interest.line).is_some() && came.next() == Some(true);
            ReadyEnds { line, bus: bus.is_some() && came.next() == Some(true) }
        });
        Ok(Some(ready.collect()))
    }
}

fn line_error(line: String, source: io::Error) -> BridgeError {
    // The texts of these errors already contain advice.
    let says_it = matches!(source.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::ResourceBusy);
    let hint = if says_it {
        ""
    } else if source.kind() == io::ErrorKind::PermissionDenied {
        "; join the group that may use the device (`ls -l` shows it, often dialout)"
    } else {
        "; with --wait, this command opens it when it appears"
    };
    BridgeError::Line { line, source, hint }
}
