//! The figures of a timed bus, requested again and again from its server, whoever serves it.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use protocol::bus::embedded::FiguresRequest;
use vcan_setup::embedded::TimedReport;

/// Time between two requests of [`TimedFigures::poll`].
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// The figures of a timed bus.
#[derive(Debug)]
pub struct TimedFigures {
    /// Name under which the bus is served.
    name: String,
    directory: Option<PathBuf>,
    pending: Option<FiguresRequest>,
    requested: Option<Instant>,
}

impl TimedFigures {
    /// Creates the figures of a bus that is served under this name, in `directory` or else in the usual one. Requests nothing.
    #[must_use]
    pub fn new(name: &str, directory: Option<&Path>) -> Self {
        let directory = directory.map(Path::to_owned);
        Self { name: name.to_owned(), directory, pending: None, requested: None }
    }

    /// Returns the figures of an answer that has come since the last call, and requests the next one a second after the last
    /// request. Does not wait.
    pub fn poll(&mut self) -> Option<TimedReport> {
        let answer = self.pending.as_ref().and_then(|request| request.receive(Duration::ZERO));
        if answer.is_some() {
            self.pending = None;
        }
        if self.pending.is_none() && self.requested.is_none_or(|at| at.elapsed() >= POLL_INTERVAL) {
            self.requested = Some(Instant::now());
            self.pending = FiguresRequest::send(&self.name, self.directory.as_deref()).ok();
        }
        TimedReport::from_json(&answer?)
    }
}
