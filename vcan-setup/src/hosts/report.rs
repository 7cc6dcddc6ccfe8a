//! Reports of a link to local programs, and the address of the link.
//!
//! A link listens at an abstract Unix address, which is unique to the bus and the network namespace. A program that
//! connects receives a [`LinkReport`] at once and after each change, as a line of JSON. It need not send anything.

use std::collections::BTreeMap;
use std::io::{self, ErrorKind, Read};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use protocol::bus::BusKind;
use protocol::bus::embedded::default_directory;
use serde::{Deserialize, Serialize};

use super::incoming::SourceAccount;
use super::outgoing::BusAccount;

/// The maximum length of a report as a line, in bytes. A report of 256 hosts is shorter.
const MAX_LINE_BYTES: usize = 1 << 20;
/// The maximum length of an abstract address, in bytes.
const MAX_ADDRESS_BYTES: usize = 107;

/// The state of a link: the other hosts, and counts of frames.
#[derive(Clone, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
pub struct LinkReport {
    /// The name of this host.
    pub host: String,
    /// Counts of the frames from the local bus to the other hosts.
    pub sent: BusAccount,
    /// The other hosts, by name.
    pub hosts: BTreeMap<String, HostReport>,
    /// Frames received from the local bus that the link had put there, or that went around a circle. They are not sent
    /// to other hosts again.
    pub returned: u64,
    /// The number of messages from hosts beyond the limit of [`SOURCES`](super::incoming::MAX_SOURCES).
    pub unknown_hosts: u64,
}

/// The state of another host.
#[derive(Clone, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
pub struct HostReport {
    /// True if the host is reachable.
    pub is_there: bool,
    /// The node ids of the cells whose frames came from the host.
    pub nodes: Vec<u8>,
    /// Counts of the frames that were received from the host.
    pub heard: SourceAccount,
    /// The host's own counts of the frames that it received from here; null until it has sent them.
    pub ours: Option<SourceAccount>,
}

/// Returns the address at which the link of a bus listens. `directory` is that of embedded buses, `None` for the
/// default.
fn link_socket_address(bus: &str, kind: BusKind, directory: Option<&Path>) -> io::Result<SocketAddr> {
    let place = if kind.is_interface() {
        PathBuf::new()
    } else {
        directory.map_or_else(default_directory, Path::to_owned)
    };
    let mut name = format!("skinbus-link {bus} {}", place.display()).into_bytes();
    if name.len() > MAX_ADDRESS_BYTES {
        name.drain(..name.len() - MAX_ADDRESS_BYTES);
    }
    SocketAddr::from_abstract_name(name)
}

/// Listens at the address of the link of a bus.
///
/// # Errors
/// Returns an error of the kind [`ErrorKind::AddrInUse`] if another process links the bus.
pub fn listen(bus: &str, kind: BusKind, directory: Option<&Path>) -> io::Result<UnixListener> {
    let listener = UnixListener::bind_addr(&link_socket_address(bus, kind, directory)?)?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}

/// A program's connection to the link of a bus.
#[derive(Debug)]
pub struct ReportReader {
    stream: UnixStream,
    buffer: Vec<u8>,
}

impl ReportReader {
    /// Connects to the link of a bus.
    ///
    /// # Errors
    /// Returns an error of the kind [`ErrorKind::ConnectionRefused`] if the bus is not linked.
    pub fn connect(bus: &str, kind: BusKind, directory: Option<&Path>) -> io::Result<Self> {
        let stream = UnixStream::connect_addr(&link_socket_address(bus, kind, directory)?)?;
        stream.set_nonblocking(true)?;
        Ok(Self { stream, buffer: Vec::new() })
    }

    /// Waits for the next report of the link.
    ///
    /// # Errors
    /// Returns an error if no report arrives in time, or if the link has ended.
    pub fn wait_for_report(&mut self, timeout: Duration) -> io::Result<LinkReport> {
        let until = Instant::now() + timeout;
        loop {
            if let Some(report) = self.read_reports()?.pop() {
                return Ok(report);
            }
            if Instant::now() >= until {
                return Err(ErrorKind::TimedOut.into());
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Returns the reports that have arrived, in order. Does not block.
    ///
    /// # Errors
    /// Returns an error if the link has ended, or if its data is not a report.
    pub fn read_reports(&mut self) -> io::Result<Vec<LinkReport>> {
        let mut piece = [0; 4_096];
        loop {
            match self.stream.read(&mut piece) {
                Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                Ok(count) => self.buffer.extend(piece.iter().take(count)),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
            if self.buffer.len() > MAX_LINE_BYTES {
                break;
            }
        }
        let Some(end) = self.buffer.iter().rposition(|&byte| byte == b'\n') else {
            let is_endless = self.buffer.len() > MAX_LINE_BYTES;
            return if is_endless { Err(ErrorKind::InvalidData.into()) } else { Ok(Vec::new()) };
        };
        let rest = self.buffer.split_off(end + 1);
        let lines = std::mem::replace(&mut self.buffer, rest);
        let reports = lines.split(|&byte| byte == b'\n').filter(|line| !line.is_empty());
        reports.map(|line| serde_json::from_slice(line).map_err(io::Error::from)).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn a_bus_has_one_place_and_reports_come_in_order_and_in_pieces() {
        let bus = format!("r{}", std::process::id());
        let of = |directory| listen(&bus, BusKind::Embedded, Some(Path::new(directory)));
        let listener = of("/one").unwrap();
        assert_eq!(of("/one").unwrap_err().kind(), ErrorKind::AddrInUse);
        assert!(of("/two").is_ok(), "another directory, another bus");
        let connect = |directory| ReportReader::connect(&bus, BusKind::Embedded, Some(Path::new(directory)));
        assert_eq!(connect("/two").unwrap_err().kind(), ErrorKind::ConnectionRefused);
        let mut reports = connect("/one").unwrap();
        let (mut stream, _) = listener.accept().unwrap();
        assert!(reports.read_reports().unwrap().is_empty());
        let report = |host: &str| {
            let hosts = [("b".to_owned(), HostReport { nodes: vec![1, 9], ..HostReport::default() })].into();
            LinkReport { host: host.to_owned(), hosts, ..LinkReport::default() }
        };
        let line = |host| format!("{}\n", serde_json::to_string(&report(host)).unwrap());
        let (whole, cut) = (line("x"), line("y"));
        stream.write_all(whole.as_bytes()).unwrap();
        stream.write_all(&cut.as_bytes()[..40]).unwrap();
        assert_eq!(reports.read_reports().unwrap(), [report("x")]);
        stream.write_all(&cut.as_bytes()[40..]).unwrap();
        stream.write_all(whole.as_bytes()).unwrap();
        assert_eq!(reports.read_reports().unwrap(), [report("y"), report("x")]);
        stream.write_all(b"{}\n").unwrap();
        assert!(reports.read_reports().is_err(), "not a report");
        drop(stream);
        assert_eq!(reports.read_reports().unwrap_err().kind(), ErrorKind::UnexpectedEof);
    }

    #[test]
    fn a_line_without_end_fills_nothing() {
        let (mut stream, other) = UnixStream::pair().unwrap();
        other.set_nonblocking(true).unwrap();
        stream.set_nonblocking(true).unwrap();
        let mut reports = ReportReader { stream: other, buffer: Vec::new() };
        let ended = (0..1_000).find_map(|_| {
            let _ = stream.write(&[b'x'; 65_536]);
            reports.read_reports().err()
        });
        assert_eq!(ended.unwrap().kind(), ErrorKind::InvalidData);
    }

    #[test]
    fn a_long_path_is_shortened_from_its_beginning() {
        let directory = format!("/{}/end", "x".repeat(200));
        let address = link_socket_address("vcan0", BusKind::Embedded, Some(Path::new(&directory))).unwrap();
        assert!(address.as_abstract_name().unwrap().ends_with(b"x/end"));
    }
}
