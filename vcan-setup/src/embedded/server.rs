//! The process around routing and queues: one thread, one `epoll`, many datagrams per system call.

use std::collections::VecDeque;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;

use protocol::bus::Filter;
use protocol::bus::batch::{BATCH, Batch, send_one};
use protocol::bus::embedded::{Answer, FilterPart, HELLO_MAX, Hello, VERSION, usual_directory};
use rustix::buffer::spare_capacity;
use rustix::event::epoll::{self, EventData, EventFlags};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{RecvFlags, SocketFlags, sockopt};
use thiserror::Error;

use super::client::{Client, Post};
use super::parcel::Parcel;
use super::place::{Place, PlaceError};
use super::routing::{ClientId, Router};

/// Batches taken from one client before the next one's turn: what its send buffer holds, and more.
const DRAIN: usize = 16;
/// The most that a client's socket may hold, whatever it requests.
const BUFFER_MAX: usize = 64 << 20;
const LISTENER: u64 = u64::MAX;
const STOP: u64 = u64::MAX - 1;

/// Why a bus stopped being served.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServeError {
    /// It could not begin.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A system call failed.
    #[error("cannot {doing} while serving {name}: {source}")]
    Io {
        /// The bus.
        name: String,
        /// What was tried.
        doing: &'static str,
        /// The system's error.
        source: io::Error,
    },
}

/// What a bus has done. `routed` is always `delivered + dropped + abandoned` when nothing waits.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
#[non_exhaustive]
pub struct Totals {
    /// Clients that were let in.
    pub clients: u64,
    /// Connections that were turned away: no hello, or one of another version.
    pub refused: u64,
    /// Frames taken from clients.
    pub frames: u64,
    /// Datagrams of clients that were neither a frame nor filters.
    pub garbage: u64,
    /// Frames times the clients that were to get them.
    pub routed: u64,
    /// Frames handed to clients' sockets.
    pub delivered: u64,
    /// Frames dropped because a client did not read; reported to it.
    pub dropped: u64,
    /// Frames that waited for a client that went away.
    pub abandoned: u64,
}

/// An embedded bus that can be served.
#[derive(Debug)]
pub struct Server {
    name: String,
    place: Place,
    /// Given up for a moment to turn a client away when there are no file descriptors left.
    spare: Option<OwnedFd>,
    clients: Vec<Option<Client>>,
    /// Clients with something to send at the end of the round.
    dirty: VecDeque<ClientId>,
    router: Router,
    post: Post,
}

impl Server {
    /// Takes a name in the usual directory; clients can connect from now on, and are let in by
    /// [`Server::run`].
    ///
    /// # Errors
    /// When the name is served already, or the directory is not ours alone.
    pub fn bind(name: &str) -> Result<Self, ServeError> {
        Self::bind_in(&usual_directory(), name)
    }

    /// The same in another directory.
    ///
    /// # Errors
    /// As [`Server::bind`].
    pub fn bind_in(directory: &Path, name: &str) -> Result<Self, ServeError> {
        let failed =
            |doing| move |errno: Errno| ServeError::Io { name: name.to_owned(), doing, source: errno.into() };
        let place = Place::take(directory, name)?;
        let epoll = epoll::create(epoll::CreateFlags::CLOEXEC).map_err(failed("make an epoll"))?;
        epoll::add(&epoll, &place.listener, EventData::new_u64(LISTENER), EventFlags::IN)
            .map_err(failed("listen"))?;
        Ok(Self {
            name: name.to_owned(),
            place,
            spare: epoll.try_clone().ok(),
            clients: Vec::new(),
            dirty: VecDeque::new(),
            router: Router::new(),
            post: Post { epoll, outgoing: Box::default(), totals: Totals::default() },
        })
    }

    /// The socket's path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.place.path
    }

    /// The bus's name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Serves until `stop` can be read or is hung up; what the bus has done. Clients then find it closed.
    ///
    /// # Errors
    /// When a system call fails; no client can cause that.
    pub fn run(mut self, stop: impl AsFd) -> Result<Totals, ServeError> {
        let name = self.name.clone();
        let failed = |doing, errno: Errno| ServeError::Io { name: name.clone(), doing, source: errno.into() };
        epoll::add(&self.post.epoll, &stop, EventData::new_u64(STOP), EventFlags::IN)
            .map_err(|errno| failed("wait for the end", errno))?;
        let mut events = Vec::with_capacity(256);
        let mut batch = Batch::new();
        loop {
            events.clear();
            match epoll::wait(&self.post.epoll, spare_capacity(&mut events), None) {
                Ok(_) | Err(Errno::INTR) => {}
                Err(errno) => return Err(failed("wait", errno)),
            }
            for &epoll::Event { flags, data } in &events {
                match data.u64() {
                    STOP => return Ok(self.end()),
                    LISTENER => self.accept(),
                    token => {
                        if let Ok(index) = usize::try_from(token) {
                            self.serve(ClientId(index), flags, &mut batch);
                        }
                    }
                }
            }
            while let Some(id) = self.dirty.pop_front() {
                self.flush(id);
            }
        }
    }

    fn end(&mut self) -> Totals {
        for index in 0..self.clients.len() {
            self.forget(ClientId(index));
        }
        self.post.totals
    }

    /// Lets waiting clients in.
    fn accept(&mut self) {
        loop {
            let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
            match rustix::net::accept_with(&self.place.listener, flags) {
                Ok(socket) => self.admit(socket),
                Err(Errno::INTR | Errno::CONNABORTED) => {}
                Err(Errno::MFILE | Errno::NFILE) if self.spare.take().is_some() => {
                    if rustix::net::accept_with(&self.place.listener, flags).is_ok() {
                        self.post.totals.refused += 1;
                    }
                    self.spare = self.post.epoll.try_clone().ok();
                }
                Err(_) => break,
            }
        }
    }

    fn admit(&mut self, socket: OwnedFd) {
        let index = self.clients.iter().position(Option::is_none).unwrap_or(self.clients.len());
        let data = EventData::new_u64(index as u64);
        if epoll::add(&self.post.epoll, &socket, data, EventFlags::IN).is_err() {
            self.post.totals.refused += 1;
            return;
        }
        let client = Some(Client::new(ClientId(index), socket));
        match self.clients.get_mut(index) {
            Some(slot) => *slot = client,
            None => self.clients.push(client),
        }
    }

    fn serve(&mut self, id: ClientId, flags: EventFlags, batch: &mut Batch) {
        if flags.contains(EventFlags::OUT) {
            self.unblock(id);
        }
        if flags.intersects(EventFlags::IN | EventFlags::HUP | EventFlags::ERR) {
            match self.client(id).map(|client| client.greeted) {
                Some(true) => self.drain(id, batch),
                Some(false) => self.greet(id),
                None => {}
            }
        }
    }

    fn client(&mut self, id: ClientId) -> Option<&mut Client> {
        self.clients.get_mut(id.0).and_then(Option::as_mut)
    }

    /// Reads a client's first datagram and sets its filters.
    fn greet(&mut self, id: ClientId) {
        let Some(client) = self.client(id) else { return };
        let mut bytes = [0; HELLO_MAX + 1];
        let hello = match rustix::net::recv(&client.socket, &mut bytes, RecvFlags::DONTWAIT) {
            Err(Errno::AGAIN | Errno::INTR) => return,
            Ok((0, _)) | Err(_) => return self.forget(id),
            Ok((len, _)) => Hello::decode(bytes.get(..len).unwrap_or_default()),
        };
        let Some(hello) = hello else {
            // It may not wait for an answer at all.
            let _ = send_one(&client.socket, &Answer::Refused { version: VERSION }.encode());
            self.post.totals.refused += 1;
            return self.forget(id);
        };
        let target = usize::try_from(hello.buffer).unwrap_or(BUFFER_MAX).min(BUFFER_MAX);
        if sockopt::set_socket_send_buffer_size_force(&client.socket, target).is_err() {
            // What was granted is reported, whatever it is.
            let _ = sockopt::set_socket_send_buffer_size(&client.socket, target);
        }
        let granted = sockopt::socket_send_buffer_size(&client.socket).unwrap_or(0) as u64;
        client.greeted = true;
        client.fd = hello.fd;
        if send_one(&client.socket, &Answer::Welcome { granted }.encode()).is_err() {
            return self.forget(id);
        }
        self.post.totals.clients += 1;
        self.router.insert(id, &hello);
    }

    /// Routes what a client has sent. As much as a client can have under way is taken at once, so that what
    /// it sent before another began comes first; more than that waits, so that no client holds up the rest.
    fn drain(&mut self, id: ClientId, batch: &mut Batch) {
        for _ in 0..DRAIN {
            let Some(client) = self.client(id) else { return };
            let fd = client.fd;
            match batch.receive(&client.socket) {
                Ok(_) => {}
                // It went away with frames unread; what it had sent can still be read.
                Err(error) if error.raw_os_error() == Some(Errno::CONNRESET.raw_os_error()) => continue,
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) =>
                {
                    return;
                }
                Err(_) => return self.forget(id),
            }
            for datagram in batch.datagrams() {
                let bytes = datagram.bytes();
                // A closed socket reads as empty datagrams without end.
                if bytes.is_some_and(<[u8]>::is_empty) && self.is_hung_up(id) {
                    return self.forget(id);
                }
                match bytes.and_then(|bytes| Parcel::accept(bytes, fd)) {
                    Some(parcel) => self.route(id, parcel),
                    None if bytes.is_some_and(|bytes| self.refilter(id, bytes)) => {}
                    None => self.post.totals.garbage += 1,
                }
            }
            if batch.datagrams().len() < BATCH {
                return;
            }
        }
    }

    /// Takes a part of a client's new filters, and whether it is one.
    fn refilter(&mut self, id: ClientId, bytes: &[u8]) -> bool {
        let Some(mut part) = FilterPart::decode(bytes) else { return false };
        let Some(client) = self.client(id) else { return false };
        let begun = if part.first { Some(Vec::new()) } else { client.filters.take() };
        let Some(mut filters) = begun else { return false };
        filters.append(&mut part.filters);
        if filters.len() > Filter::MAX {
            return false;
        }
        if part.last {
            self.router.set_filters(id, filters);
        } else {
            client.filters = Some(filters);
        }
        true
    }

    fn is_hung_up(&mut self, id: ClientId) -> bool {
        let Some(client) = self.client(id) else { return true };
        let mut polled = [PollFd::new(&client.socket, PollFlags::RDHUP)];
        match poll(&mut polled, Some(&Timespec::default())) {
            Ok(ready) => ready > 0,
            Err(_) => true,
        }
    }

    fn route(&mut self, from: ClientId, parcel: Parcel) {
        let Self { router, clients, dirty, post, .. } = self;
        post.totals.frames += 1;
        router.route(from, parcel.raw_id(), parcel.format(), |to, own| {
            let Some(client) = clients.get_mut(to.0).and_then(Option::as_mut) else { return };
            if client.take(parcel.marked(own), post) {
                dirty.push_back(to);
            }
        });
    }

    fn flush(&mut self, id: ClientId) {
        let Self { clients, post, .. } = self;
        let Some(client) = clients.get_mut(id.0).and_then(Option::as_mut) else { return };
        if !client.flush(post) {
            self.silence(id);
        }
    }

    fn unblock(&mut self, id: ClientId) {
        let Self { clients, post, .. } = self;
        let Some(client) = clients.get_mut(id.0).and_then(Option::as_mut) else { return };
        if client.unblock(post) {
            self.flush(id);
        }
    }

    /// Sends nothing more to a client that does not read; what it still sends is received.
    fn silence(&mut self, id: ClientId) {
        self.router.remove(id);
        let Self { clients, post, .. } = self;
        if let Some(client) = clients.get_mut(id.0).and_then(Option::as_mut) {
            client.abandon(post);
        }
    }

    fn forget(&mut self, id: ClientId) {
        self.silence(id);
        if let Some(slot) = self.clients.get_mut(id.0) {
            *slot = None;
        }
    }
}
