//! The process around routing and queues: one thread, one `epoll`, many datagrams per system call.

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::thread::JoinHandle;

use protocol::bus::Filter;
use protocol::bus::batch::{BATCH, Batch, Outgoing};
use protocol::bus::embedded::{
    Answer, FilterPart, HELLO_MAX, Hello, VERSION, encode_dropped, usual_directory,
};
use protocol::can::FD_BYTES;
use rustix::buffer::spare_capacity;
use rustix::event::epoll::{self, EventData, EventFlags};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{RecvFlags, SendFlags, SocketFlags, sockopt};
use thiserror::Error;

use super::parcel::Parcel;
use super::place::{Place, PlaceError};
use super::queue::{Entry, Queue};
use super::routing::{ClientId, Router};

/// Frames that wait for a client beyond what its socket holds.
const QUEUE: usize = 256;
/// Batches taken from one client before the next one's turn: what its send buffer holds, and more.
const DRAIN: usize = 16;
/// The most that a client's socket may hold, whatever it asks for.
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
    /// The system does not let it go on.
    #[error("cannot {doing} while serving {name}: {source}")]
    Io {
        /// The bus.
        name: String,
        /// What was tried.
        doing: &'static str,
        /// What the system said.
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
    /// Frames dropped because a client did not read; it was told.
    pub dropped: u64,
    /// Frames that waited for a client that went away.
    pub abandoned: u64,
}

#[derive(Debug)]
struct Client {
    socket: OwnedFd,
    queue: Queue,
    /// What it said when it came; nothing is routed before.
    greeted: bool,
    fd: bool,
    /// Filters that it has begun to put in force.
    filters: Option<Vec<Filter>>,
    /// Its socket is full; `epoll` tells when it is not.
    blocked: bool,
    /// It is in the list of those to whom something has to be sent.
    dirty: bool,
}

/// An embedded bus that can be served.
#[derive(Debug)]
pub struct Server {
    name: String,
    place: Place,
    epoll: OwnedFd,
    /// Given up for a moment to turn a client away when there are no file descriptors left.
    spare: Option<OwnedFd>,
    clients: Vec<Option<Client>>,
    dirty: Vec<ClientId>,
    router: Router,
    totals: Totals,
    outgoing: Box<Outgoing>,
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
            spare: spare(&epoll),
            epoll,
            clients: Vec::new(),
            dirty: Vec::new(),
            router: Router::new(),
            totals: Totals::default(),
            outgoing: Box::default(),
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
    /// When the system does not let it go on; no client can bring that about.
    pub fn run(mut self, stop: impl AsFd) -> Result<Totals, ServeError> {
        let name = self.name.clone();
        let failed = |doing, errno: Errno| ServeError::Io { name: name.clone(), doing, source: errno.into() };
        epoll::add(&self.epoll, &stop, EventData::new_u64(STOP), EventFlags::IN)
            .map_err(|errno| failed("wait for the end", errno))?;
        let mut events = Vec::with_capacity(256);
        let mut batch = Batch::new();
        loop {
            events.clear();
            match epoll::wait(&self.epoll, spare_capacity(&mut events), None) {
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
            let mut dirty = std::mem::take(&mut self.dirty);
            for id in dirty.drain(..) {
                self.flush(id);
            }
            self.dirty = dirty;
        }
    }

    fn end(&mut self) -> Totals {
        for index in 0..self.clients.len() {
            self.forget(ClientId(index));
        }
        self.totals
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
                        self.totals.refused += 1;
                    }
                    self.spare = spare(&self.epoll);
                }
                Err(_) => break,
            }
        }
    }

    fn admit(&mut self, socket: OwnedFd) {
        let index = self.clients.iter().position(Option::is_none).unwrap_or(self.clients.len());
        let added = epoll::add(&self.epoll, &socket, EventData::new_u64(index as u64), EventFlags::IN);
        if added.is_err() {
            self.totals.refused += 1;
            return;
        }
        let client = Client {
            socket,
            queue: Queue::new(QUEUE),
            greeted: false,
            fd: true,
            filters: None,
            blocked: false,
            dirty: false,
        };
        match self.clients.get_mut(index) {
            Some(slot) => *slot = Some(client),
            None => self.clients.push(Some(client)),
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

    /// Reads a client's first datagram and puts its filters in force.
    fn greet(&mut self, id: ClientId) {
        let Some(client) = self.clients.get_mut(id.0).and_then(Option::as_mut) else { return };
        let mut bytes = [0; HELLO_MAX + 1];
        let hello = match rustix::net::recv(&client.socket, &mut bytes, RecvFlags::DONTWAIT) {
            Err(Errno::AGAIN | Errno::INTR) => return,
            Ok((0, _)) | Err(_) => return self.forget(id),
            Ok((len, _)) => Hello::decode(bytes.get(..len).unwrap_or_default()),
        };
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        let Some(hello) = hello else {
            // It may not wait for an answer at all.
            let _ = rustix::net::send(&client.socket, &Answer::Refused { version: VERSION }.encode(), flags);
            self.totals.refused += 1;
            return self.forget(id);
        };
        let wanted = usize::try_from(hello.buffer).unwrap_or(BUFFER_MAX).min(BUFFER_MAX);
        if sockopt::set_socket_send_buffer_size_force(&client.socket, wanted).is_err() {
            // What was granted is reported, whatever it is.
            let _ = sockopt::set_socket_send_buffer_size(&client.socket, wanted);
        }
        let granted = sockopt::socket_send_buffer_size(&client.socket).unwrap_or(0) as u64;
        client.greeted = true;
        client.fd = hello.fd;
        if rustix::net::send(&client.socket, &Answer::Welcome { granted }.encode(), flags).is_err() {
            return self.forget(id);
        }
        self.totals.clients += 1;
        self.router.insert(id, &hello);
    }

    /// Routes what a client has sent. As much as a client can have under way is taken at once, so that what
    /// it sent before another began comes first; more than that waits, so that no client holds up the rest.
    fn drain(&mut self, id: ClientId, batch: &mut Batch) {
        for _ in 0..DRAIN {
            let Some(client) = self.clients.get_mut(id.0).and_then(Option::as_mut) else { return };
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
                    None => self.totals.garbage += 1,
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
        let Some(client) = self.clients.get_mut(id.0).and_then(Option::as_mut) else { return false };
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
        let Self { router, clients, dirty, totals, outgoing, epoll, .. } = self;
        totals.frames += 1;
        router.route(from, parcel.raw_id(), parcel.format(), |to, own| {
            let Some(client) = clients.get_mut(to.0).and_then(Option::as_mut) else { return };
            totals.routed += 1;
            if !client.queue.push(parcel.marked(own)) {
                totals.dropped += 1;
            } else if !client.blocked {
                // Who does not listen any more is found out again, and silenced, at the end of the round.
                if client.queue.frames() >= BATCH {
                    let _ = send(client, to, epoll, outgoing, totals);
                }
                if !client.dirty {
                    client.dirty = true;
                    dirty.push(to);
                }
            }
        });
    }

    fn flush(&mut self, id: ClientId) {
        let Self { clients, totals, outgoing, epoll, .. } = self;
        let Some(client) = clients.get_mut(id.0).and_then(Option::as_mut) else { return };
        client.dirty = false;
        if !client.blocked && send(client, id, epoll, outgoing, totals) == Sent::Deaf {
            self.silence(id);
        }
    }

    fn unblock(&mut self, id: ClientId) {
        let Self { clients, epoll, .. } = self;
        let Some(client) = clients.get_mut(id.0).and_then(Option::as_mut) else { return };
        if client.blocked && watch(epoll, client, id, EventFlags::IN) {
            client.blocked = false;
            self.flush(id);
        }
    }

    /// Sends nothing more to a client that does not listen; what it still says is heard.
    fn silence(&mut self, id: ClientId) {
        self.router.remove(id);
        let Self { clients, totals, .. } = self;
        if let Some(client) = clients.get_mut(id.0).and_then(Option::as_mut) {
            abandon(client, totals);
        }
    }

    fn forget(&mut self, id: ClientId) {
        self.silence(id);
        if let Some(slot) = self.clients.get_mut(id.0) {
            *slot = None;
        }
    }
}

/// What came of sending.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Sent {
    /// Everything, or as much as there was room for.
    Heard,
    /// Nobody listens any more.
    Deaf,
}

/// Sends what waits for a client until it is all sent or its socket is full.
fn send(
    client: &mut Client,
    id: ClientId,
    epoll: &OwnedFd,
    outgoing: &mut Outgoing,
    totals: &mut Totals,
) -> Sent {
    loop {
        client.queue.tell();
        if client.queue.is_empty() {
            return Sent::Heard;
        }
        outgoing.clear();
        for entry in client.queue.iter().take(BATCH) {
            match entry {
                Entry::Frame(parcel) => outgoing.push(parcel.bytes(), parcel.byte_len()),
                Entry::Dropped(total) => {
                    let notice = encode_dropped(*total);
                    let mut bytes = [0; FD_BYTES];
                    for (to, from) in bytes.iter_mut().zip(notice) {
                        *to = from;
                    }
                    outgoing.push(&bytes, notice.len())
                }
            };
        }
        match outgoing.send(&client.socket) {
            Ok(count) => totals.delivered += client.queue.sent(count) as u64,
            Err(error) => match error.raw_os_error().map(Errno::from_raw_os_error) {
                Some(Errno::INTR) => {}
                Some(Errno::AGAIN | Errno::NOBUFS | Errno::NOMEM) => {
                    client.blocked = watch(epoll, client, id, EventFlags::IN | EventFlags::OUT);
                    return if client.blocked { Sent::Heard } else { Sent::Deaf };
                }
                _ => return Sent::Deaf,
            },
        }
    }
}

fn watch(epoll: &OwnedFd, client: &Client, id: ClientId, flags: EventFlags) -> bool {
    epoll::modify(epoll, &client.socket, EventData::new_u64(id.0 as u64), flags).is_ok()
}

/// Counts what waits for a client as abandoned.
fn abandon(client: &mut Client, totals: &mut Totals) {
    totals.abandoned += client.queue.frames() as u64;
    client.queue = Queue::new(QUEUE);
}

/// A file descriptor to give up in need.
fn spare(epoll: &OwnedFd) -> Option<OwnedFd> {
    epoll.try_clone().ok()
}

/// A bus that is served by a thread of this process until this is dropped.
#[derive(Debug)]
pub struct Served {
    path: std::path::PathBuf,
    stop: Option<UnixStream>,
    thread: Option<JoinHandle<Result<Totals, ServeError>>>,
}

impl Served {
    /// Serves a bus in the usual directory.
    ///
    /// # Errors
    /// As [`Server::bind`].
    pub fn start(name: &str) -> Result<Self, ServeError> {
        Self::start_in(&usual_directory(), name)
    }

    /// Serves a bus in another directory.
    ///
    /// # Errors
    /// As [`Server::bind`].
    pub fn start_in(directory: &Path, name: &str) -> Result<Self, ServeError> {
        let failed = |doing| move |source| ServeError::Io { name: name.to_owned(), doing, source };
        let server = Server::bind_in(directory, name)?;
        let path = server.path().to_owned();
        let (stop, stopped) = UnixStream::pair().map_err(failed("make a handle to stop it"))?;
        let thread = std::thread::Builder::new()
            .name(format!("bus {name}"))
            .spawn(move || server.run(stopped))
            .map_err(failed("start a thread"))?;
        Ok(Self { path, stop: Some(stop), thread: Some(thread) })
    }

    /// The socket's path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Stops serving; what the bus has done.
    ///
    /// # Errors
    /// When it had failed before.
    ///
    /// # Panics
    /// When its thread did.
    pub fn stop(mut self) -> Result<Totals, ServeError> {
        drop(self.stop.take());
        let thread = self.thread.take().expect("stopped once");
        thread.join().expect("the bus's thread does not panic")
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // Who wants to know the outcome calls `stop`.
            let _ = thread.join();
        }
    }
}
