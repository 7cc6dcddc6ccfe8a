use std::collections::VecDeque;
use std::os::unix::net::UnixStream;

use protocol::bus::{Bus, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{Frame, STANDARD_MASK};
use tempfile::TempDir;

use super::*;

/// A source of datagrams that returns given errors before it receives from the socket.
struct Faulty {
    batch: ReceiveBatch,
    /// The result of each reception to come: an error, or `None` to receive.
    errors: VecDeque<Option<Errno>>,
    /// The error of all receptions after those in `errors`.
    last: Option<Errno>,
}

impl Receive for Faulty {
    fn receive(&mut self, socket: &OwnedFd) -> io::Result<usize> {
        match self.errors.pop_front().unwrap_or(self.last) {
            Some(errno) => Err(errno.into()),
            None => self.batch.receive(socket),
        }
    }

    fn datagrams(&self) -> impl ExactSizeIterator<Item = Datagram<'_>> {
        self.batch.datagrams()
    }
}

/// A bus that a thread of the test serves.
struct TestServer {
    directory: TempDir,
    stop: UnixStream,
    thread: std::thread::JoinHandle<Result<BusTotals, ServeError>>,
}

impl TestServer {
    fn new(errors: &[Option<Errno>], last: Option<Errno>) -> Self {
        let directory = TempDir::new().unwrap();
        let server = Server::bind_in(&directory.path().join("skinbus"), "vcan0").unwrap();
        let faulty = Faulty { batch: ReceiveBatch::new(), errors: errors.iter().copied().collect(), last };
        let (stop, stopped) = UnixStream::pair().unwrap();
        let thread = std::thread::spawn(move || server.run_with(stopped, faulty));
        Self { directory, stop, thread }
    }

    fn open(&self) -> Bus {
        self.open_with(vec![Filter::ALL])
    }

    fn open_with(&self, filters: Vec<Filter>) -> Bus {
        let options = BusOptions {
            filters,
            directory: Some(self.directory.path().join("skinbus")),
            send_timeout: Duration::from_secs(20),
            receive_buffer: 4 << 20,
            ..BusOptions::default()
        };
        Bus::open("vcan0", KindChoice::Only(protocol::bus::BusKind::Embedded), &options).unwrap()
    }

    fn end(self) -> BusTotals {
        drop(self.stop);
        self.thread.join().unwrap().unwrap()
    }
}

/// Waits for `count` frames, and returns their identifiers.
fn receives(bus: &Bus, count: usize) -> Vec<u32> {
    arrivals(bus, count).into_iter().map(|(_, id)| id).collect()
}

/// Waits for `count` frames, and returns their time stamps and identifiers.
fn arrivals(bus: &Bus, count: usize) -> Vec<(u64, u32)> {
    let (mut inbox, mut all) = (Inbox::new(), Vec::new());
    while all.len() < count {
        bus.wait(None).unwrap();
        bus.receive(&mut inbox).unwrap();
        all.extend(inbox.frames().map(|received| (received.at_nanos, received.frame.id())));
    }
    all
}

#[test]
fn errors_of_a_reception_that_pass_cost_a_client_no_frame() {
    let errors = [Errno::NOMEM, Errno::NOBUFS, Errno::INTR, Errno::CONNRESET, Errno::AGAIN, Errno::IO];
    let errors: Vec<_> = (0..60).map(|at| (at % 3 == 0).then(|| errors[at / 3 % errors.len()])).collect();
    let bench = TestServer::new(&errors, None);
    let [sender, receiver] = [bench.open(), bench.open()];
    let frames: Vec<_> = (0..500).map(|id| Frame::classic(id, &[1]).unwrap()).collect();
    // The frames are sent in several batches, so that each error occurs at some of them.
    for piece in frames.chunks(5) {
        sender.send(piece).unwrap();
        let ids: Vec<_> = piece.iter().map(Frame::id).collect();
        assert_eq!(receives(&receiver, piece.len()), ids);
    }
    let totals = bench.end();
    assert_eq!((totals.frames, totals.delivered, totals.abandoned), (500, 500, 0));
    assert_eq!((totals.failed, totals.failure, totals.garbage), (0, None, 0));
}

#[test]
fn time_stamps_of_a_process_with_two_sockets_are_in_the_order_of_the_bus() {
    let bench = TestServer::new(&[], None);
    let open = |id| bench.open_with(vec![Filter { id, mask: STANDARD_MASK }]);
    // The server pairs the first two clients of a process, and the next two.
    let [sender, _idle, first, second] = [bench.open(), open(3), open(1), open(2)];
    // Within one round, the server writes to each socket at the end of the round, and possibly before.
    let expected = [1, 2, 1, 2, 2, 1];
    sender.send(&expected.map(|id| Frame::classic(id, &[]).unwrap())).unwrap();
    let mut came: Vec<_> = [first, second].iter().flat_map(|bus| arrivals(bus, 3)).collect();
    came.sort_unstable();
    assert_eq!(came.iter().map(|(_, id)| *id).collect::<Vec<_>>(), expected);
    bench.end();
}

#[test]
fn a_client_whose_socket_fails_for_good_is_hung_up_on_and_the_others_go_on() {
    // All receptions after the first one fail, so only the first client can send.
    let bench = TestServer::new(&[None], Some(Errno::BADF));
    let [sender, receiver] = [bench.open(), bench.open()];
    sender.send(&[Frame::classic(1, &[1]).unwrap()]).unwrap();
    assert_eq!(receives(&receiver, 1), [1]);
    let _ = sender.send(&[Frame::classic(2, &[1]).unwrap()]);
    let mut inbox = Inbox::new();
    let error = loop {
        sender.wait(None).unwrap();
        if let Err(error) = sender.receive(&mut inbox) {
            break error;
        }
    };
    assert!(error.is_closed(), "it can connect again: {error}");
    let again = bench.open();
    let totals = bench.end();
    assert_eq!((totals.clients, totals.failed, totals.failure), (3, 1, Some(Errno::BADF)));
    drop((again, receiver));
}
