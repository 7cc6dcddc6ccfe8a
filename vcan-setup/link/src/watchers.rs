//! Sends the reports of a link to programs on the same machine.

use std::io::{ErrorKind, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::{UnixListener, UnixStream};

use vcan_setup::hosts::report::LinkReport;

/// The maximum number of connected programs; further ones are disconnected.
const WATCHERS: usize = 64;

/// The connected programs, and the socket at which further ones connect.
#[derive(Debug)]
pub(crate) struct Watchers {
    listener: UnixListener,
    streams: Vec<UnixStream>,
    /// The line with the newest report, which all programs have received.
    line: Vec<u8>,
    /// True while no connection can be accepted, because the process has no free file descriptor.
    is_full: bool,
}

impl Watchers {
    pub(crate) const fn new(listener: UnixListener) -> Self {
        Self { listener, streams: Vec::new(), line: Vec::new(), is_full: false }
    }

    /// Returns the listening socket to poll; `None` while no connection can be accepted.
    pub(crate) fn listener(&self) -> Option<BorrowedFd<'_>> {
        (!self.is_full).then(|| self.listener.as_fd())
    }

    /// Accepts waiting connections, and sends the newest report to each.
    pub(crate) fn accept(&mut self) {
        loop {
            let mut stream = match self.listener.accept() {
                Ok((stream, _)) => stream,
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) => {
                    self.is_full = error.kind() != ErrorKind::WouldBlock;
                    return;
                }
            };
            let is_taken = self.streams.len() < WATCHERS
                && stream.set_nonblocking(true).is_ok()
                && stream.write_all(&self.line).is_ok();
            if is_taken {
                self.streams.push(stream);
            }
        }
    }

    /// Sends a report to all programs if it has changed. A program that does not read in time is disconnected, because
    /// an incomplete line would be worse for it.
    pub(crate) fn send(&mut self, report: &LinkReport) {
        let Ok(mut line) = serde_json::to_vec(report) else { return };
        line.push(b'\n');
        if line != self.line {
            self.streams.retain_mut(|stream| stream.write_all(&line).is_ok());
            self.line = line;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use protocol::bus::BusKind;
    use vcan_setup::hosts::report::{ReportReader, listen};

    use super::*;

    #[test]
    fn whoever_connects_has_the_newest_report_and_who_does_not_read_is_hung_up_on() {
        let bus = format!("w{}", std::process::id());
        let place = (BusKind::Embedded, Some(Path::new("/watchers")));
        let mut watchers = Watchers::new(listen(&bus, place.0, place.1).unwrap());
        let report = |returned| LinkReport { host: "x".repeat(100), returned, ..LinkReport::default() };
        watchers.send(&report(1));
        let mut reads = ReportReader::connect(&bus, place.0, place.1).unwrap();
        let _sleeps = ReportReader::connect(&bus, place.0, place.1).unwrap();
        watchers.accept();
        watchers.send(&report(1));
        assert_eq!(reads.read_reports().unwrap(), [report(1)], "once");
        for returned in 2..100_000 {
            watchers.send(&report(returned));
            assert_eq!(reads.read_reports().unwrap(), [report(returned)]);
            if watchers.streams.len() == 1 {
                return;
            }
        }
        panic!("{} watchers", watchers.streams.len());
    }
}
