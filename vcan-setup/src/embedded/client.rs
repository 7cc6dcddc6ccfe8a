//! One client of a bus: its socket, and its queue.

use std::os::fd::OwnedFd;

use protocol::bus::Filter;
use protocol::bus::batch::{BATCH, Outgoing, is_memory_shortage};
use protocol::bus::embedded::{encode_dropped, peer_process};
use protocol::can::FD_BYTES;
use rustix::event::epoll::{self, EventData, EventFlags};
use rustix::io::Errno;

use super::BusTotals;
use super::parcel::FrameDatagram;
use super::queue::{QueueEntry, ClientQueue};
use super::routing::ClientId;

/// The maximum number of frames that wait for a client beyond those in its socket.
const QUEUE: usize = 256;

/// The resources for sending to any client.
#[derive(Debug)]
pub(super) struct SendContext {
    pub(super) epoll: OwnedFd,
    pub(super) outgoing: Box<Outgoing>,
    pub(super) totals: BusTotals,
}

/// The outcome of sending a client's queue.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum SendOutcome {
    /// The queue is sent, or waits until the socket has room, which `epoll` reports.
    Done,
    /// The system lacks memory; sending is retried soon.
    Shortage,
    /// The client no longer reads.
    Gone,
    /// The socket fails permanently.
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
    queue: ClientQueue,
    /// True once its hello was received; frames are routed only afterwards.
    pub(super) greeted: bool,
    pub(super) fd: bool,
    /// New filters of which some parts have arrived.
    pub(super) filters: Option<Vec<Filter>>,
    /// True while its socket is full; `epoll` reports when it has room.
    blocked: bool,
    /// True while it is in the list of clients with something to send.
    dirty: bool,
    /// The number of failed receptions in a row.
    pub(super) failures: u32,
}

impl Client {
    pub(super) fn new(id: ClientId, socket: OwnedFd) -> Self {
        let queue = ClientQueue::new(QUEUE);
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

    /// Queues a frame. Returns true if the client needs to be flushed and did not before.
    pub(super) fn enqueue(&mut self, parcel: FrameDatagram, post: &mut SendContext) -> bool {
        post.totals.routed += 1;
        if !self.queue.push(parcel) {
            post.totals.dropped += 1;
            return false;
        }
        // A client that no longer reads is detected again, and muted, at the end of the round.
        if !self.blocked && self.queue.frames() >= BATCH {
            let _ = self.send(post);
        }
        !self.blocked && !std::mem::replace(&mut self.dirty, true)
    }

    /// Sends the queue before the client's process gets a newer frame by another socket. Errors are detected again at
    /// the end of the round.
    pub(super) fn send_early(&mut self, post: &mut SendContext) {
        if self.dirty && !self.blocked {
            let _ = self.send(post);
        }
    }

    /// Sends the queue, unless the socket is full.
    pub(super) fn flush(&mut self, post: &mut SendContext) -> SendOutcome {
        self.dirty = false;
        if self.blocked { SendOutcome::Done } else { self.send(post) }
    }

    /// Removes the socket from `epoll`, and sends nothing to it until it is resumed.
    pub(super) fn pause(&mut self, post: &SendContext) {
        self.blocked = true;
        let _ = epoll::delete(&post.epoll, &self.socket);
    }

    /// Ends a pause. Returns true on success.
    pub(super) fn resume(&mut self, post: &SendContext) -> bool {
        let data = EventData::new_u64(self.id.0 as u64);
        let resumed = epoll::add(&post.epoll, &self.socket, data, EventFlags::IN).is_ok();
        self.blocked = !resumed;
        resumed
    }

    /// Returns true if the client was blocked and can be sent to again.
    pub(super) fn unblock(&mut self, post: &SendContext) -> bool {
        let free = self.blocked && self.watch(post, EventFlags::IN);
        self.blocked &= !free;
        free
    }

    /// Drops the queue, and counts its frames as abandoned.
    pub(super) fn abandon(&mut self, post: &mut SendContext) {
        post.totals.abandoned += self.queue.frames() as u64;
        self.queue = ClientQueue::new(QUEUE);
    }

    /// Sends the queue until it is empty or the socket is full.
    fn send(&mut self, post: &mut SendContext) -> SendOutcome {
        loop {
            self.queue.report_dropped();
            if self.queue.is_empty() {
                return SendOutcome::Done;
            }
            post.outgoing.clear();
            for entry in self.queue.iter().take(BATCH) {
                match entry {
                    QueueEntry::Frame(parcel) => post.outgoing.push(parcel.bytes(), parcel.byte_len()),
                    QueueEntry::Dropped(total) => {
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
                // The socket may have room, which `epoll` would report at once, again and again.
                Err(error) if is_memory_shortage(&error) => return SendOutcome::Shortage,
                Err(error) => match Errno::from_io_error(&error) {
                    Some(Errno::INTR) => {}
                    Some(Errno::AGAIN) => {
                        self.blocked = self.watch(post, EventFlags::IN | EventFlags::OUT);
                        return if self.blocked { SendOutcome::Done } else { SendOutcome::Shortage };
                    }
                    Some(Errno::PIPE | Errno::CONNRESET | Errno::NOTCONN) => return SendOutcome::Gone,
                    errno => return SendOutcome::Failed(errno.unwrap_or(Errno::IO)),
                },
            }
        }
    }

    fn watch(&self, post: &SendContext, flags: EventFlags) -> bool {
        epoll::modify(&post.epoll, &self.socket, EventData::new_u64(self.id.0 as u64), flags).is_ok()
    }
}
