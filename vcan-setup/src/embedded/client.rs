//! One client of a bus: its socket, and what waits for it.

use std::os::fd::OwnedFd;

use protocol::bus::Filter;
use protocol::bus::batch::{BATCH, Outgoing};
use protocol::bus::embedded::encode_dropped;
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

#[derive(Debug)]
pub(super) struct Client {
    id: ClientId,
    pub(super) socket: OwnedFd,
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
}

impl Client {
    pub(super) const fn new(id: ClientId, socket: OwnedFd) -> Self {
        let queue = Queue::new(QUEUE);
        Self { id, socket, queue, greeted: false, fd: true, filters: None, blocked: false, dirty: false }
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

    /// Sends what waits for it, unless there is no room; whether it still listens.
    pub(super) fn flush(&mut self, post: &mut Post) -> bool {
        self.dirty = false;
        self.blocked || self.send(post)
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

    /// Sends what waits for it until it is all sent or its socket is full; whether it still listens.
    fn send(&mut self, post: &mut Post) -> bool {
        loop {
            self.queue.report_dropped();
            if self.queue.is_empty() {
                return true;
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
                Err(error) => match error.raw_os_error().map(Errno::from_raw_os_error) {
                    Some(Errno::INTR) => {}
                    Some(Errno::AGAIN | Errno::NOBUFS | Errno::NOMEM) => {
                        self.blocked = self.watch(post, EventFlags::IN | EventFlags::OUT);
                        return self.blocked;
                    }
                    _ => return false,
                },
            }
        }
    }

    fn watch(&self, post: &Post, flags: EventFlags) -> bool {
        epoll::modify(&post.epoll, &self.socket, EventData::new_u64(self.id.0 as u64), flags).is_ok()
    }
}
