//! The door of a server: one thread that reads and answers the requests of all clients. It passes clients that become
//! pages or viewers on to their own threads.
//!
//! A client must send the whole head of its request within [`HEAD_TIMEOUT`]. If too many clients wait, the one that has
//! waited longest is refused. A client with the token sends its head at once and is answered before that, so clients
//! without a token cannot keep it out, however many they are. The number of pages is limited separately.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Resource, getrlimit, setpriority_process};

use super::answer::{HttpResponse, RefusalReason};
use super::page::PrefixedStream;
use super::request::MAX_HEAD_BYTES;

/// The time within which a client must send the head of its request, and must receive the answer.
const HEAD_TIMEOUT: Duration = Duration::from_secs(5);
/// The time within which a client with the token must receive each piece of an answer.
const ANSWER_PIECE_TIMEOUT: Duration = Duration::from_secs(5);
/// The maximum number of clients that are neither answered yet nor pages.
const MAX_PENDING_CLIENTS: usize = 256;
/// The number of file descriptors that are kept free for buses and pages.
const RESERVED_FILE_DESCRIPTORS: u64 = 64;
/// The maximum number of connections that are accepted before the clients that wait are served.
const MAX_ACCEPTED_AT_ONCE: usize = 32;
/// The interval at which the server checks whether it has to stop.
const POLL_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
/// The time for which no connection is accepted after accepting has failed.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);
/// The niceness of the thread, so that many connections do not take processor time from the bench.
const THREAD_NICENESS: i32 = 10;
/// The maximum number of bytes that are read at once.
const READ_CHUNK_BYTES: usize = 4 * 1024;

/// A server whose clients come in by the door.
pub(crate) trait DoorKeeper: Send + Sync + 'static {
    /// The maximum number of clients that are served at the same time.
    const MAX_CLIENTS: usize;
    /// The reason for which further ones are refused.
    const FULL: RefusalReason;
    /// The beginning of the names of the clients' threads.
    const THREAD_NAME: &'static str;

    /// Returns true once the server ends.
    fn is_stopped(&self) -> bool;
    /// Counts a request that is refused.
    fn count_refusal(&self);
    /// Returns the number of clients that are served now.
    fn served(&self) -> &AtomicUsize;
    /// Answers a request with this head. Returns `None` if the client is to be served by a thread of its own.
    fn answer(&self, head: &[u8]) -> Option<HttpResponse>;
    /// Serves a client until it disconnects.
    fn serve(&self, begun: PrefixedStream, number: u64);
}

/// A client that has not received its answer yet.
#[derive(Debug)]
struct PendingClient {
    stream: TcpStream,
    head: Vec<u8>,
    /// The answer and the number of its bytes that were already sent; `None` until the request is complete.
    answer: Option<(HttpResponse, usize)>,
    until: Instant,
}

/// The next step for a visitor after its data was read and written.
enum ClientNextStep {
    /// The visitor stays, because its request or answer is not complete.
    Stays(PendingClient),
    /// The visitor becomes a page with a WebSocket.
    Page(PrefixedStream),
    /// The visitor has received its answer, or has disconnected.
    Done,
}

/// Serves clients until the server stops. Passes clients that become pages to `pages`.
pub(crate) fn serve_clients(
    listener: &TcpListener,
    shared: &impl DoorKeeper,
    pages: &Sender<PrefixedStream>,
) {
    // On Linux, niceness applies to the thread alone. If it cannot be set, the door works without it.
    let _ = setpriority_process(None, THREAD_NICENESS);
    let room = pending_client_limit();
    let mut visitors = Vec::<PendingClient>::new();
    let mut resting = None::<Instant>;
    while !shared.is_stopped() {
        resting = resting.filter(|end| Instant::now() < *end);
        let ready = wait_until_ready(listener, resting.is_none(), &visitors);
        let [listener_is_ready, rest @ ..] = ready.as_slice() else { continue };
        let now = Instant::now();
        // Clients whose data has arrived are served before new clients can push them out.
        for (visitor, is_ready) in std::mem::take(&mut visitors).into_iter().zip(rest) {
            if now >= visitor.until {
                shared.count_refusal();
                // Browsers open connections before they need them, and would take this text for the answer to a later
                // request.
                if !visitor.head.is_empty() {
                    visitor.refuse(RefusalReason::Late);
                }
            } else if *is_ready {
                apply_next_step(visitor.read_and_answer(shared), &mut visitors, pages);
            } else {
                visitors.push(visitor);
            }
        }
        if !listener_is_ready || resting.is_some() {
            continue;
        }
        for _ in 0..MAX_ACCEPTED_AT_ONCE {
            match listener.accept() {
                Ok((stream, _)) => {
                    if stream.set_nonblocking(true).is_err() {
                        continue;
                    }
                    let visitor = PendingClient::new(stream);
                    apply_next_step(visitor.read_and_answer(shared), &mut visitors, pages);
                    if visitors.len() > room {
                        refuse_oldest_client(&mut visitors, shared);
                    }
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error)
                    if matches!(error.kind(), ErrorKind::Interrupted | ErrorKind::ConnectionAborted) => {}
                Err(_) => {
                    // No file descriptor is free. This lasts until one is closed, so one client is disconnected.
                    refuse_oldest_client(&mut visitors, shared);
                    resting = Some(Instant::now() + ACCEPT_PAUSE);
                    break;
                }
            }
        }
    }
}

/// Returns the maximum number of visitors for which file descriptors are left beside those of buses and pages.
fn pending_client_limit() -> usize {
    let files = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    usize::try_from(files.saturating_sub(RESERVED_FILE_DESCRIPTORS) / 2)
        .unwrap_or(MAX_PENDING_CLIENTS)
        .clamp(4, MAX_PENDING_CLIENTS)
}

/// Waits until a client connects or the socket of a visitor is ready. Returns a flag for the listener and each
/// visitor: true if it is ready.
fn wait_until_ready(listener: &TcpListener, accepts: bool, visitors: &[PendingClient]) -> Vec<bool> {
    // While accepting fails, the listener is always ready, so it is not polled during the pause.
    let listened = if accepts { PollFlags::IN } else { PollFlags::empty() };
    let mut files = vec![PollFd::new(listener, listened)];
    files.extend(visitors.iter().map(|visitor| {
        let flags = if visitor.answer.is_some() { PollFlags::OUT } else { PollFlags::IN };
        PollFd::new(&visitor.stream, flags)
    }));
    let timeout = if accepts { POLL_INTERVAL } else { Timespec { tv_sec: 0, tv_nsec: 10_000_000 } };
    if poll(&mut files, Some(&timeout)).is_err() {
        return Vec::new();
    }
    files.iter().map(|file| !file.revents().is_empty()).collect()
}

/// Keeps a visitor, passes it on as a page, or drops it.
fn apply_next_step(next: ClientNextStep, visitors: &mut Vec<PendingClient>, pages: &Sender<PrefixedStream>) {
    match next {
        ClientNextStep::Stays(visitor) => visitors.push(visitor),
        ClientNextStep::Done => {}
        // If the receiver no longer exists, the server stops, so the error is ignored.
        ClientNextStep::Page(begun) => _ = pages.send(begun),
    }
}

/// Starts a thread for each new client, up to the maximum number. These threads have normal priority.
pub(crate) fn start_client_threads<K: DoorKeeper>(clients: Receiver<PrefixedStream>, shared: &Arc<K>) {
    for (number, begun) in (1..).zip(clients) {
        if shared.served().fetch_add(1, Ordering::Relaxed) >= K::MAX_CLIENTS {
            shared.served().fetch_sub(1, Ordering::Relaxed);
            shared.count_refusal();
            PendingClient::new(begun.into_stream()).refuse(K::FULL);
            continue;
        }
        let of_thread = Arc::clone(shared);
        let started = thread::Builder::new().name(format!("{} {number}", K::THREAD_NAME)).spawn(move || {
            of_thread.serve(begun, number);
            of_thread.served().fetch_sub(1, Ordering::Relaxed);
        });
        if started.is_err() {
            shared.served().fetch_sub(1, Ordering::Relaxed);
            shared.count_refusal();
        }
    }
}

/// Refuses the visitor that has waited longest. Visitors that have sent the token are spared as long as possible.
fn refuse_oldest_client(visitors: &mut Vec<PendingClient>, shared: &impl DoorKeeper) {
    let is_known =
        |visitor: &PendingClient| visitor.answer.as_ref().is_some_and(|(answer, _)| answer.is_known);
    let at = visitors.iter().position(|visitor| !is_known(visitor)).unwrap_or(0);
    if visitors.is_empty() {
        return;
    }
    let oldest = visitors.remove(at);
    shared.count_refusal();
    if oldest.answer.is_none() {
        oldest.refuse(RefusalReason::Crowded);
    }
}

impl PendingClient {
    fn new(stream: TcpStream) -> Self {
        Self { stream, head: Vec::new(), answer: None, until: Instant::now() + HEAD_TIMEOUT }
    }

    /// Reads the data that has arrived from a visitor, and sends as much of the answer as the socket accepts.
    fn read_and_answer(mut self, shared: &impl DoorKeeper) -> ClientNextStep {
        while self.answer.is_none() {
            let mut piece = [0; READ_CHUNK_BYTES];
            // The empty line that ends the head may begin in the last three bytes that were read before.
            let seen = self.head.len().saturating_sub(3);
            match self.stream.read(&mut piece) {
                Ok(0) => return ClientNextStep::Done,
                Ok(read) => self.head.extend(piece.iter().take(read)),
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) if error.kind() == ErrorKind::WouldBlock => return ClientNextStep::Stays(self),
                Err(_) => return ClientNextStep::Done,
            }
            let new = self.head.get(seen..).unwrap_or_default();
            let end = new.windows(4).position(|end| end == b"\r\n\r\n").map(|at| seen + at + 4);
            if self.head.len() > MAX_HEAD_BYTES {
                shared.count_refusal();
                self.answer = Some((HttpResponse::from_refusal(RefusalReason::Long), 0));
            } else if let Some(head) = end.and_then(|end| self.head.get(..end)) {
                match shared.answer(head) {
                    Some(answer) => self.answer = Some((answer, 0)),
                    None => return ClientNextStep::Page(PrefixedStream::new(self.head, self.stream)),
                }
            }
        }
        self.send_answer()
    }

    fn send_answer(mut self) -> ClientNextStep {
        while let Some((answer, sent)) = &mut self.answer {
            let rest = answer.bytes.get(*sent..).unwrap_or_default();
            if rest.is_empty() {
                self.close();
                return ClientNextStep::Done;
            }
            match self.stream.write(rest) {
                Ok(0) => return ClientNextStep::Done,
                Ok(written) => {
                    *sent += written;
                    if answer.is_known {
                        self.until = Instant::now() + ANSWER_PIECE_TIMEOUT;
                    }
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => return ClientNextStep::Stays(self),
                Err(_) => return ClientNextStep::Done,
            }
        }
        ClientNextStep::Stays(self)
    }

    /// Refuses the visitor. Sends the reason only as far as the socket accepts it at once.
    fn refuse(mut self, why: RefusalReason) {
        if self.answer.is_none() {
            let _ = self.stream.write(&HttpResponse::from_refusal(why).bytes);
        }
        self.close();
    }

    /// Closes the connection after reading what has arrived. Closing with unread data would reset it, and the answer
    /// might be lost.
    fn close(mut self) {
        let _ = self.stream.shutdown(Shutdown::Write);
        let mut piece = [0; READ_CHUNK_BYTES];
        for _ in 0..8 {
            if !matches!(self.stream.read(&mut piece), Ok(1..)) {
                break;
            }
        }
    }
}
