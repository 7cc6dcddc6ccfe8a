//! The server of an embedded bus: one thread, one `epoll`, and many datagrams per system call.

use std::collections::VecDeque;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::time::{Duration, Instant};

use protocol::bus::Filter;
use protocol::bus::batch::{Datagram, MAX_BATCH_DATAGRAMS, ReceiveBatch, is_memory_shortage};
use protocol::bus::embedded::{FilterPart, default_directory};
use rustix::buffer::spare_capacity;
use rustix::event::epoll::{self, EventData, EventFlags};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{Shutdown, shutdown};
use thiserror::Error;

use super::client::{Client, SendContext, SendOutcome};
use super::parcel::FrameDatagram;
use super::place::{BusSocket, BusSocketError};
use super::routing::{ClientId, Router};
use super::timed::{BusClock, RoundEffects, TimedBus};

pub use super::timed::TimedReport;
pub use super::totals::BusTotals;

mod admission;
#[cfg(test)]
mod tests;
mod timed_rounds;

/// The maximum number of batches read from one client before the next client is served. It is more than a send buffer
/// holds.
const MAX_BATCHES_PER_CLIENT: usize = 16;
/// The time for which a socket is not polled after an error that may persist, such as a lack of memory or file
/// descriptors.
const PAUSE: Duration = Duration::from_millis(1);
/// The number of consecutive failed receptions after which a client is disconnected. They take a second.
const MAX_FAILURES: u32 = 1_000;
const LISTENER: u64 = u64::MAX;
const STOP: u64 = u64::MAX - 1;
const ROUND_END: u64 = u64::MAX - 2;

/// The reason why a bus cannot be served any longer.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServeError {
    /// The socket of the bus cannot be created.
    #[error(transparent)]
    Place(#[from] BusSocketError),
    /// A system call failed.
    #[error("cannot {doing} while serving {name}: {source}")]
    Io {
        /// The name of the bus.
        name: String,
        /// A description of the failed operation.
        doing: &'static str,
        /// The system error.
        source: io::Error,
    },
}

/// An embedded bus whose name is bound and which [`Server::run`] serves.
#[derive(Debug)]
pub struct Server {
    name: String,
    place: BusSocket,
    /// A reserved file descriptor. If no others are free, it is released for a moment to accept a client and disconnect
    /// it.
    spare: Option<OwnedFd>,
    /// A client that is being disconnected for lack of file descriptors, and whose hello has not arrived yet.
    parting: Option<OwnedFd>,
    clients: Vec<Option<Client>>,
    /// The clients that have queued frames, which are sent at the end of the round.
    dirty: VecDeque<ClientId>,
    router: Router,
    post: SendContext,
    /// The `epoll` tokens of sockets that are not polled until `resume_at`.
    paused: Vec<u64>,
    resume_at: Option<Instant>,
    /// The bus on which frames take time; `None` if they are passed on at once.
    timed: Option<Box<TimedRounds>>,
}

/// A timed bus with its clock.
#[derive(Debug)]
struct TimedRounds {
    bus: TimedBus,
    clock: BusClock,
    /// A timer for the end of a round: a timeout of `epoll` counts in ms.
    timer: Option<OwnedFd>,
    /// The difference by which times of the wall clock are to be increased in this round, in ns.
    wall_offset: i64,
    effects: RoundEffects,
}

/// A source of datagrams. Tests replace it to simulate errors.
trait Receive {
    /// Receives datagrams from a socket, as [`ReceiveBatch::receive`] does.
    fn receive(&mut self, socket: &OwnedFd) -> io::Result<usize>;
    /// Returns the datagrams as [`ReceiveBatch::datagrams`] does.
    fn datagrams(&self) -> impl ExactSizeIterator<Item = Datagram<'_>>;
}

impl Receive for ReceiveBatch {
    fn receive(&mut self, socket: &OwnedFd) -> io::Result<usize> {
        self.receive(socket)
    }

    fn datagrams(&self) -> impl ExactSizeIterator<Item = Datagram<'_>> {
        self.datagrams()
    }
}

impl Server {
    /// Binds the name of a bus in the default directory. Clients can connect from now on; [`Server::run`] accepts them.
    ///
    /// # Errors
    /// Returns [`ServeError`] if the name is already served, or if the directory is accessible to other users.
    pub fn bind(name: &str) -> Result<Self, ServeError> {
        Self::bind_in(&default_directory(), name)
    }

    /// Binds the name of a bus in another directory.
    ///
    /// # Errors
    /// Returns [`ServeError`] as [`Server::bind`] does.
    pub fn bind_in(directory: &Path, name: &str) -> Result<Self, ServeError> {
        let failed =
            |doing| move |errno: Errno| ServeError::Io { name: name.to_owned(), doing, source: errno.into() };
        let place = BusSocket::bind(directory, name)?;
        let epoll = epoll::create(epoll::CreateFlags::CLOEXEC).map_err(failed("create an epoll instance"))?;
        epoll::add(&epoll, &place.listener, EventData::new_u64(LISTENER), EventFlags::IN)
            .map_err(failed("listen"))?;
        Ok(Self {
            name: name.to_owned(),
            place,
            spare: epoll.try_clone().ok(),
            parting: None,
            clients: Vec::new(),
            dirty: VecDeque::new(),
            router: Router::new(),
            post: SendContext { epoll, outgoing: Box::default(), totals: BusTotals::default() },
            paused: Vec::new(),
            resume_at: None,
            timed: None,
        })
    }

    /// Returns the path of the socket.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.place.path
    }

    /// Returns the name of the bus.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Serves the bus until `stop` is readable or hung up, and then closes it. Returns the counts of frames and
    /// clients.
    ///
    /// # Errors
    /// Returns [`ServeError`] if a system call fails, which no client can cause.
    pub fn run(self, stop: impl AsFd) -> Result<BusTotals, ServeError> {
        self.run_with(stop, ReceiveBatch::new())
    }

    fn run_with(mut self, stop: impl AsFd, mut batch: impl Receive) -> Result<BusTotals, ServeError> {
        let name = self.name.clone();
        let failed = |doing, errno: Errno| ServeError::Io { name: name.clone(), doing, source: errno.into() };
        epoll::add(&self.post.epoll, &stop, EventData::new_u64(STOP), EventFlags::IN)
            .map_err(|errno| failed("watch for the stop request", errno))?;
        self.create_round_timer().map_err(|errno| failed("create the timer of the bus", errno))?;
        let mut events = Vec::with_capacity(256);
        loop {
            events.clear();
            let pause = self.resume_at.map(|at| at.saturating_duration_since(Instant::now()));
            self.set_round_timer().map_err(|errno| failed("set the timer of the bus", errno))?;
            let timeout = pause.and_then(|pause| Timespec::try_from(pause).ok());
            match epoll::wait(&self.post.epoll, spare_capacity(&mut events), timeout.as_ref()) {
                Ok(_) | Err(Errno::INTR) => {}
                Err(errno) if is_memory_shortage(&errno.into()) => std::thread::sleep(PAUSE),
                Err(errno) => return Err(failed("wait", errno)),
            }
            self.begin_timed_round();
            for &epoll::Event { flags, data } in &events {
                match data.u64() {
                    STOP => return Ok(self.end()),
                    LISTENER => self.accept_clients(),
                    ROUND_END => {}
                    token => {
                        if let Ok(index) = usize::try_from(token) {
                            self.serve(ClientId(index), flags, &mut batch);
                        }
                    }
                }
            }
            if self.resume_at.is_some_and(|at| at <= Instant::now()) {
                self.resume();
            }
            self.end_timed_round();
            while let Some(id) = self.dirty.pop_front() {
                self.flush(id);
            }
            self.note_delivered();
        }
    }

    /// Stops polling a socket for a while. `epoll` would report the error again at once, because it is a lasting state.
    fn pause(&mut self, token: u64) {
        let Self { post, place, .. } = self;
        if token == LISTENER {
            let none = EventFlags::empty();
            let _ = epoll::modify(&post.epoll, &place.listener, EventData::new_u64(LISTENER), none);
        } else if let Some(client) =
            usize::try_from(token).ok().and_then(|index| client(&mut self.clients, index))
        {
            client.pause_sending(post);
        }
        if !self.paused.contains(&token) {
            self.paused.push(token);
        }
        self.resume_at.get_or_insert_with(|| Instant::now() + PAUSE);
    }

    /// Polls all paused sockets again.
    fn resume(&mut self) {
        self.resume_at = None;
        for token in std::mem::take(&mut self.paused) {
            let Self { post, place, .. } = self;
            if token == LISTENER {
                let data = EventData::new_u64(LISTENER);
                let resumed = epoll::modify(&post.epoll, &place.listener, data, EventFlags::IN).is_ok();
                if self.parting.is_some() || self.spare.is_none() {
                    self.close_parting_client();
                }
                if !resumed {
                    self.pause(LISTENER);
                }
            } else if let Ok(index) = usize::try_from(token)
                && let Some(client) = client(&mut self.clients, index)
            {
                if client.resume_sending(post) {
                    self.flush(ClientId(index));
                } else {
                    self.pause(token);
                }
            }
        }
    }

    fn end(&mut self) -> BusTotals {
        for index in 0..self.clients.len() {
            self.remove_client(ClientId(index));
        }
        self.post.totals
    }

    fn serve(&mut self, id: ClientId, flags: EventFlags, batch: &mut impl Receive) {
        if flags.contains(EventFlags::OUT) {
            self.unblock(id);
        }
        if flags.intersects(EventFlags::IN | EventFlags::HUP | EventFlags::ERR) {
            match self.client(id).map(|client| client.greeted) {
                Some(true) => self.drain(id, batch),
                Some(false) => self.receive_hello(id),
                None => {}
            }
        }
    }

    fn client(&mut self, id: ClientId) -> Option<&mut Client> {
        client(&mut self.clients, id.0)
    }

    /// Routes the datagrams that a client has sent. All data that can be in flight from the client is read, so that it
    /// is routed before data that another client sent later. Data beyond that waits, so that no client delays the
    /// others.
    fn drain(&mut self, id: ClientId, batch: &mut impl Receive) {
        for _ in 0..MAX_BATCHES_PER_CLIENT {
            let Some(client) = self.client(id) else { return };
            let fd = client.fd;
            match batch.receive(&client.socket) {
                Ok(_) => client.failures = 0,
                // The client disconnected without reading all its frames. The frames that it sent before can still be
                // read.
                Err(error) if error.raw_os_error() == Some(Errno::CONNRESET.raw_os_error()) => continue,
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) =>
                {
                    return;
                }
                Err(error) => {
                    return self.handle_failure(id, Errno::from_io_error(&error).unwrap_or(Errno::IO));
                }
            }
            let mut failure = None;
            for datagram in batch.datagrams() {
                let bytes = datagram.bytes();
                // Empty datagrams are received from a closed socket, without end.
                if bytes.is_some_and(<[u8]>::is_empty) {
                    match self.is_hung_up(id) {
                        Ok(true) => return self.remove_client(id),
                        Ok(false) => {}
                        Err(errno) => failure = Some(errno),
                    }
                }
                match bytes.and_then(|bytes| FrameDatagram::from_client_datagram(bytes, fd)) {
                    Some(parcel) => match &mut self.timed {
                        None => self.route(id, parcel, None),
                        Some(timed) => {
                            self.post.totals.frames += 1;
                            timed.collect(id, parcel, datagram);
                        }
                    },
                    None if bytes.is_some_and(|bytes| self.refilter(id, bytes)) => {}
                    None => self.post.totals.garbage += 1,
                }
            }
            if let Some(errno) = failure {
                return self.handle_failure(id, errno);
            }
            if batch.datagrams().len() < MAX_BATCH_DATAGRAMS {
                return;
            }
        }
    }

    /// Adds a datagram with some of a client's new filters. Returns false if the datagram holds no filters.
    fn refilter(&mut self, id: ClientId, bytes: &[u8]) -> bool {
        let Some(mut part) = FilterPart::decode(bytes) else { return false };
        let Some(client) = self.client(id) else { return false };
        let begun = if part.first { Some(Vec::new()) } else { client.filters.take() };
        let Some(mut filters) = begun else { return false };
        filters.append(&mut part.filters);
        if filters.len() > Filter::MAX_COUNT {
            return false;
        }
        if part.last {
            self.router.set_filters(id, filters);
        } else {
            client.filters = Some(filters);
        }
        true
    }

    fn is_hung_up(&mut self, id: ClientId) -> Result<bool, Errno> {
        let Some(client) = self.client(id) else { return Ok(true) };
        let mut polled = [PollFd::new(&client.socket, PollFlags::RDHUP)];
        let ready = rustix::io::retry_on_intr(|| poll(&mut polled, Some(&Timespec::default())))?;
        Ok(ready > 0)
    }

    /// Stops polling a client whose reception failed. Disconnects it after [`MAX_FAILURES`] consecutive failures.
    fn handle_failure(&mut self, id: ClientId, errno: Errno) {
        let Some(client) = self.client(id) else { return };
        client.failures += 1;
        if client.failures < MAX_FAILURES {
            return self.pause(id.0 as u64);
        }
        self.count_failed(id, errno);
        self.remove_client(id);
    }

    /// Disconnects a client whose socket failed, and counts it.
    fn count_failed(&mut self, id: ClientId, errno: Errno) {
        if self.client(id).is_some() {
            self.post.totals.failed += 1;
            self.post.totals.failure = Some(errno);
        }
    }

    /// Queues a frame for all clients that receive it, with its time stamp on a timed bus.
    fn route(&mut self, from: ClientId, parcel: FrameDatagram, stamp: Option<u64>) {
        let Self { router, clients, dirty, post, .. } = self;
        post.totals.frames += u64::from(stamp.is_none());
        router.route(from, parcel.raw_id(), parcel.format(), |to, own| {
            // The kernel stamps a frame when it is sent to the client. If the process has a second socket, its queue is
            // therefore sent first, so that the time stamps of both sockets are in order.
            let sibling = client(clients, to.0).and_then(|client| client.sibling);
            if let Some(sibling) = sibling.and_then(|sibling| client(clients, sibling.0)) {
                sibling.send_now(post);
            }
            let Some(client) = clients.get_mut(to.0).and_then(Option::as_mut) else { return };
            if client.enqueue(parcel.with_own_mark(own), stamp, post) {
                dirty.push_back(to);
            }
        });
    }

    fn flush(&mut self, id: ClientId) {
        let Self { clients, post, .. } = self;
        let Some(client) = client(clients, id.0) else { return };
        match client.flush(post) {
            SendOutcome::Done => {}
            SendOutcome::Shortage => self.pause(id.0 as u64),
            SendOutcome::Gone => self.release(id),
            SendOutcome::Failed(errno) => {
                self.count_failed(id, errno);
                self.release(id);
            }
        }
    }

    /// Closes the sending side of a client's socket, so that the client notices and may reconnect. Frames from the
    /// client are received until it closes its side.
    fn release(&mut self, id: ClientId) {
        if let Some(client) = self.client(id) {
            let _ = shutdown(&client.socket, Shutdown::Write);
        }
        self.unsubscribe(id);
    }

    fn unblock(&mut self, id: ClientId) {
        let Self { clients, post, .. } = self;
        let Some(client) = client(clients, id.0) else { return };
        if client.try_unblock(post) {
            self.flush(id);
        }
    }

    /// Stops sending to a client that does not read. Frames from the client are still received.
    fn unsubscribe(&mut self, id: ClientId) {
        self.router.remove(id);
        let Self { clients, post, .. } = self;
        if let Some(client) = clients.get_mut(id.0).and_then(Option::as_mut) {
            client.abandon_queue(post);
        }
    }

    fn remove_client(&mut self, id: ClientId) {
        self.unsubscribe(id);
        self.paused.retain(|token| *token != id.0 as u64);
        if let Some(timed) = &mut self.timed {
            timed.bus.forget_client(id);
        }
        let client = self.clients.get_mut(id.0).and_then(Option::take);
        if let Some(sibling) = client.and_then(|client| client.sibling).and_then(|id| self.client(id)) {
            sibling.sibling = None;
        }
    }
}

fn client(clients: &mut [Option<Client>], index: usize) -> Option<&mut Client> {
    clients.get_mut(index).and_then(Option::as_mut)
}
