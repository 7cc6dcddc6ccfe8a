//! One client of a bus: its socket, and what waits for it.

use std::os::fd::OwnedFd;

use protocol::bus::Filter;
use protocol::bus::batch::{BATCH, Outgoing, is_shortage};
use protocol::bus::embedded::{encode_dropped, peer_process};
use protocol::can::FD_BYTES;
use rustix::event::epoll::{self, EventData, EventFlags};
use rustix::io::Errno;

use super::Totals;
use super::parcel::Parcel;
use super::queue::{Entry, Queue};
use super::routing::ClientId;

/// Frames that wait for a client beyond what its socket holds.
const QUEUE: usize = 256;

/// What sending to any client takes.
#[derive(Debug)]
pub(super) struct Post {
    pub(super) epoll: OwnedFd,
    pub(super) outgoing: Box<Outgoing>,
    pub(super) totals: Totals,
}

/// Outcome of sending what waits for a client.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Sent {
    /// It was sent, or waits until its socket has room, which `epoll` reports.
    Done,
    /// The system lacks memory: to be tried again soon.
    Shortage,
    /// It does not read any more.
    Gone,
    /// Its socket fails for a reason that does not pass.
    Failed(Errno),
}

#[derive(Debug)]
pub(super) struct Client {
    pub(super) id: ClientId,
    pub(super) socket: OwnedFd,
    /// The process at the other end, if it is in this pid namespace.
    pub(super) process: Option<u32>,
    /// The other client of that process, if there are two.
    pub(super) sibling: Option<ClientId>,
    queue: Queue,
    /// Its hello; nothing is routed before.
    pub(super) greeted: bool,
    pub(super) fd: bool,
    /// Filters of which some parts have arrived.
    pub(super) filters: Option<Vec<Filter>>,
    /// Its socket is full; `epoll` reports when it is not.
    blocked: bool,
    /// It is in the list of clients with something to send.
    dirty: bool,
    /// Receptions in succession that failed.
    pub(super) failures: u32,
}

impl Client {
    pub(super) fn new(id: ClientId, socket: OwnedFd) -> Self {
        let queue = Queue::new(QUEUE);
        Self {
            id,
            process: peer_process(&socket),
            sibling: None,
            socket,
            queue,
            greeted: false,
            fd: true,
            filters: None,
            blocked: false,
            dirty: false,
            failures: 0,
        }
    }

    /// Takes a frame that is to be sent to it; whether it has to be flushed from now on, and had not before.
    pub(super) fn take(&mut self, parcel: Parcel, post: &mut Post) -> bool {
        post.totals.routed += 1;
        if !self.queue.push(parcel) {
            post.totals.dropped += 1;
            return false;
        }
        // A client that does not read any more is found again, and muted, at the end of the round.
        if !self.blocked && self.queue.frames() >= BATCH {
            let _ = self.send(post);
        }
        !self.blocked && !std::mem::replace(&mut self.dirty, true)
    }

    /// Sends what waits for it before its process gets a newer frame by another socket. Errors are found again at the end
    /// of the round.
    pub(super) fn send_early(&mut self, post: &mut Post) {
        if self.dirty && !self.blocked {
            let _ = self.send(post);
        }
    }

    /// Sends what waits for it, unless there is no room.
    pub(super) fn flush(&mut self, post: &mut Post) -> Sent {
        self.dirty = false;
        if self.blocked { Sent::Done } else { self.send(post) }
    }

    /// Takes its socket out of `epoll`, and sends nothing to it, until it is resumed.
    pub(super) fn pause(&mut self, post: &Post) {
        self.blocked = true;
        let _ = epoll::delete(&post.epoll, &self.socket);
    }

    /// Ends a pause; whether the system allowed it.
    pub(super) fn resume(&mut self, post: &Post) -> bool {
        let data = EventData::new_u64(self.id.0 as u64);
        let resumed = epoll::add(&post.epoll, &self.socket, data, EventFlags::IN).is_ok();
        self.blocked = !resumed;
        resumed
    }

    /// Whether it can be sent to again and could not before.
    pub(super) fn unblock(&mut self, post: &Post) -> bool {
        let free = self.blocked && self.watch(post, EventFlags::IN);
        self.blocked &= !free;
        free
    }

    /// Counts what waits for it as abandoned.
    pub(super) fn abandon(&mut self, post: &mut Post) {
        post.totals.abandoned += self.queue.frames() as u64;
        self.queue = Queue::new(QUEUE);
    }

    /// Sends what waits for it until it is all sent or its socket is full.
    fn send(&mut self, post: &mut Post) -> Sent {
        loop {
            self.queue.report_dropped();
            if self.queue.is_empty() {
                return Sent::Done;
            }
            post.outgoing.clear();
            for entry in self.queue.iter().take(BATCH) {
                match entry {
                    Entry::Frame(parcel) => post.outgoing.push(parcel.bytes(), parcel.byte_len()),
                    Entry::Dropped(total) => {
                        let notice = encode_dropped(*total);
                        let mut bytes = [0; FD_BYTES];
                        for (to, from) in bytes.iter_mut().zip(notice) {
                            *to = from;
                        }
                        post.outgoing.push(&bytes, notice.len())
                    }
                };
            }
            match post.outgoing.send(&self.socket) {
                Ok(count) => post.totals.delivered += self.queue.sent(count) as u64,
                // Its socket may have room: that would be reported at once, again and again.
                Err(error) if is_shortage(&error) => return Sent::Shortage,
                Err(error) => match Errno::from_io_error(&error) {
                    Some(Errno::INTR) => {}
                    Some(Errno::AGAIN) => {
                        self.blocked = self.watch(post, EventFlags::IN | EventFlags::OUT);
                        return if self.blocked { Sent::Done } else { Sent::Shortage };
                    }
                    Some(Errno::PIPE | Errno::CONNRESET | Errno::NOTCONN) => return Sent::Gone,
                    errno => return Sent::Failed(errno.unwrap_or(Errno::IO)),
                },
            }
        }
    }

    fn watch(&self, post: &Post, flags: EventFlags) -> bool {
        epoll::modify(&post.epoll, &self.socket, EventData::new_u64(self.id.0 as u64), flags).is_ok()
    }
}
