//! The door: one thread that reads the requests of all clients, answers them, and passes on the clients that become
//! pages.
//!
//! A client has [`HEAD_TIME`] for its whole head. If too many clients wait, the one that has waited longest is refused.
//! A client with the token sends its head at once and is answered by then, so that any number of clients without a
//! token cannot keep it out. Pages have a limit of their own.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Resource, getrlimit, setpriority_process};

use super::answer::{Answer, Refusal, answer};
use super::page::{self, PrefixedStream};
use super::request::MAX_HEAD_BYTES;
use super::{MAX_PAGES, Shared};

/// The time limit for a whole head, and for sending an answer.
const HEAD_TIMEOUT: Duration = Duration::from_secs(5);
/// The time limit per piece of an answer to a client with the token.
const PIECE_TIMEOUT: Duration = Duration::from_secs(5);
/// The maximum number of clients that are neither answered nor pages.
const MAX_VISITORS: usize = 256;
/// The number of file descriptors that are kept free for buses and pages.
const RESERVED_FILES: u64 = 64;
/// The maximum number of connections that are accepted before the other clients are served.
const MAX_ACCEPTED_AT_ONCE: usize = 32;
/// The interval at which the server checks whether it has to stop.
const POLL_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
/// The pause after accepting has failed.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);
/// The niceness of the door's thread, so that a storm of connections does not take the bench's processor time.
const NICE: i32 = 10;
/// The read size in bytes.
const READ_SIZE: usize = 4 * 1024;

/// A client that has not got its answer yet.
#[derive(Debug)]
struct Visitor {
    stream: TcpStream,
    head: Vec<u8>,
    /// The answer, once it is known, and the number of its bytes that were sent.
    answer: Option<(Answer, usize)>,
    until: Instant,
}

/// The next step with a visitor.
enum NextStep {
    /// The visitor waits.
    Stays(Visitor),
    /// The visitor becomes a page.
    Page(PrefixedStream),
    /// The visitor has its answer, or has gone.
    Done,
}

/// Serves until the server stops, and passes on the clients that become pages.
pub(super) fn serve(listener: &TcpListener, shared: &Shared, pages: &Sender<PrefixedStream>) {
    // On Linux the priority is the thread's own. The door also works without it.
    let _ = setpriority_process(None, NICE);
    let room = visitor_limit();
    let mut visitors = Vec::<Visitor>::new();
    let mut resting = None::<Instant>;
    while !shared.stop.load(Ordering::Relaxed) {
        resting = resting.filter(|end| Instant::now() < *end);
        let ready = wait(listener, resting.is_none(), &visitors);
        let [listener_is_ready, rest @ ..] = ready.as_slice() else { continue };
        let now = Instant::now();
        // Clients whose data has arrived are served before new ones can displace them.
        for (visitor, is_ready) in std::mem::take(&mut visitors).into_iter().zip(rest) {
            if now >= visitor.until {
                shared.refused.fetch_add(1, Ordering::Relaxed);
                // Browsers connect ahead of a request, and would show this text as its answer.
                if !visitor.head.is_empty() {
                    visitor.turn_away(Refusal::Late);
                }
            } else if *is_ready {
                enter(visitor.advance(shared), &mut visitors, pages);
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
                    let visitor = Visitor::new(stream);
                    enter(visitor.advance(shared), &mut visitors, pages);
                    if visitors.len() > room {
                        turn_oldest_away(&mut visitors, shared);
                    }
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error)
                    if matches!(error.kind(), ErrorKind::Interrupted | ErrorKind::ConnectionAborted) => {}
                Err(_) => {
                    // Out of file descriptors: this lasts until some are closed, so close one connection.
                    turn_oldest_away(&mut visitors, shared);
                    resting = Some(Instant::now() + ACCEPT_PAUSE);
                    break;
                }
            }
        }
    }
}

/// Returns the number of visitors that may wait: it leaves file descriptors for buses and pages.
fn visitor_limit() -> usize {
    let files = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    usize::try_from(files.saturating_sub(RESERVED_FILES) / 2).unwrap_or(MAX_VISITORS).clamp(4, MAX_VISITORS)
}

/// Waits for the listener and the visitors, and returns a flag for each: true if it is ready.
fn wait(listener: &TcpListener, accepts: bool, visitors: &[Visitor]) -> Vec<bool> {
    // A listener whose accept fails stays ready: it is left out during the pause.
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

/// Handles the next step of a visitor.
fn enter(next: NextStep, visitors: &mut Vec<Visitor>, pages: &Sender<PrefixedStream>) {
    match next {
        NextStep::Stays(visitor) => visitors.push(visitor),
        NextStep::Done => {}
        // The receiving end stops together with this one.
        NextStep::Page(begun) => _ = pages.send(begun),
    }
}

/// Starts a thread for each page, up to the limit. These threads have the normal priority of this one.
pub(super) fn open(pages: Receiver<PrefixedStream>, shared: &Arc<Shared>) {
    for (page, begun) in (1..).zip(pages) {
        if shared.pages.fetch_add(1, Ordering::Relaxed) >= MAX_PAGES {
            shared.pages.fetch_sub(1, Ordering::Relaxed);
            shared.refused.fetch_add(1, Ordering::Relaxed);
            Visitor::new(begun.into_stream()).turn_away(Refusal::Full);
            continue;
        }
        let of_thread = Arc::clone(shared);
        let started = thread::Builder::new().name(format!("view page {page}")).spawn(move || {
            page::serve(begun, page, &of_thread);
            of_thread.pages.fetch_sub(1, Ordering::Relaxed);
        });
        if started.is_err() {
            shared.pages.fetch_sub(1, Ordering::Relaxed);
            shared.refused.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Refuses the visitor that has waited longest, if possible one that has not shown the token.
fn turn_oldest_away(visitors: &mut Vec<Visitor>, shared: &Shared) {
    let is_known = |visitor: &Visitor| visitor.answer.as_ref().is_some_and(|(answer, _)| answer.is_known);
    let at = visitors.iter().position(|visitor| !is_known(visitor)).unwrap_or(0);
    if visitors.is_empty() {
        return;
    }
    let oldest = visitors.remove(at);
    shared.refused.fetch_add(1, Ordering::Relaxed);
    if oldest.answer.is_none() {
        oldest.turn_away(Refusal::Crowded);
    }
}

impl Visitor {
    fn new(stream: TcpStream) -> Self {
        Self { stream, head: Vec::new(), answer: None, until: Instant::now() + HEAD_TIMEOUT }
    }

    /// Reads the data that has arrived, and writes as much as the socket accepts.
    fn advance(mut self, shared: &Shared) -> NextStep {
        while self.answer.is_none() {
            let mut piece = [0; READ_SIZE];
            // The end of the head may begin in the last three bytes of the data before.
            let seen = self.head.len().saturating_sub(3);
            match self.stream.read(&mut piece) {
                Ok(0) => return NextStep::Done,
                Ok(read) => self.head.extend(piece.iter().take(read)),
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) if error.kind() == ErrorKind::WouldBlock => return NextStep::Stays(self),
                Err(_) => return NextStep::Done,
            }
            let new = self.head.get(seen..).unwrap_or_default();
            let end = new.windows(4).position(|end| end == b"\r\n\r\n").map(|at| seen + at + 4);
            if self.head.len() > MAX_HEAD_BYTES {
                shared.refused.fetch_add(1, Ordering::Relaxed);
                self.answer = Some((Answer::refusal(Refusal::Long), 0));
            } else if let Some(head) = end.and_then(|end| self.head.get(..end)) {
                match answer(head, shared) {
                    Some(answer) => self.answer = Some((answer, 0)),
                    None => return NextStep::Page(PrefixedStream::new(self.head, self.stream)),
                }
            }
        }
        self.write()
    }

    fn write(mut self) -> NextStep {
        while let Some((answer, sent)) = &mut self.answer {
            let rest = answer.bytes.get(*sent..).unwrap_or_default();
            if rest.is_empty() {
                self.close();
                return NextStep::Done;
            }
            match self.stream.write(rest) {
                Ok(0) => return NextStep::Done,
                Ok(written) => {
                    *sent += written;
                    if answer.is_known {
                        self.until = Instant::now() + PIECE_TIMEOUT;
                    }
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => return NextStep::Stays(self),
                Err(_) => return NextStep::Done,
            }
        }
        NextStep::Stays(self)
    }

    /// Sends the reason of the refusal, as far as that is possible without waiting.
    fn turn_away(mut self, why: Refusal) {
        if self.answer.is_none() {
            let _ = self.stream.write(&Answer::refusal(why).bytes);
        }
        self.close();
    }

    /// Closes the connection. Unread bytes would reset it, and the client might not read its answer.
    fn close(mut self) {
        let _ = self.stream.shutdown(Shutdown::Write);
        let mut piece = [0; READ_SIZE];
        for _ in 0..8 {
            if !matches!(self.stream.read(&mut piece), Ok(1..)) {
                break;
            }
        }
    }
}
