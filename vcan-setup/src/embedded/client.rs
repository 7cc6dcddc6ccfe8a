//! A client of a bus, as the server sees it: its socket, and the queue of frames for it.

use std::os::fd::OwnedFd;

use protocol::bus::Filter;
use protocol::bus::batch::{MAX_BATCH_DATAGRAMS, Outgoing, is_memory_shortage};
use protocol::bus::embedded::{encode_drop_notice, encode_refusal_notice, peer_process};
use protocol::can::FD_BYTES;
use rustix::event::epoll::{self, EventData, EventFlags};
use rustix::io::Errno;

use super::BusTotals;
use super::parcel::FrameDatagram;
use super::queue::{ClientQueue, QueueEntry};
use super::routing::ClientId;

/// The maximum number of frames in a client's queue, beyond those in its socket buffer.
const MAX_QUEUED_FRAMES: usize = 256;

/// The objects that are needed to send to any client.
#[derive(Debug)]
pub(super) struct SendContext {
    pub(super) epoll: OwnedFd,
    pub(super) outgoing: Box<Outgoing>,
    pub(super) totals: BusTotals,
}

/// The result of sending the frames in a client's queue.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum SendOutcome {
    /// The queue is empty, or the socket is full; in the latter case `epoll` reports when it has room.
    Done,
    /// The system lacks memory. Sending is tried again soon.
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
    /// The id of the client's process, if that is in the same pid namespace.
    pub(super) process: Option<u32>,
    /// The other client of the same process, if the process has two.
    pub(super) sibling: Option<ClientId>,
    queue: ClientQueue,
    /// True once the client's first message, the hello, was received. The client gets frames only afterwards.
    pub(super) greeted: bool,
    pub(super) fd: bool,
    /// True if the client gets time stamps of a timed bus, and reports of refused frames.
    pub(super) stamps: bool,
    /// The number of frames of the client that its transmit queue has refused.
    refused: u32,
    /// The new filters that have arrived so far; `None` if no change of filters is in progress.
    pub(super) filters: Option<Vec<Filter>>,
    /// True while the client's socket is full. `epoll` reports when it has room.
    blocked: bool,
    /// True while the client is in the list of clients that have frames to be sent.
    dirty: bool,
    /// The number of failed receptions from the client since the last successful one.
    pub(super) failures: u32,
}

impl Client {
    pub(super) fn new(id: ClientId, socket: OwnedFd) -> Self {
        let queue = ClientQueue::new(MAX_QUEUED_FRAMES);
        Self {
            id,
            process: peer_process(&socket),
            sibling: None,
            socket,
            queue,
            greeted: false,
            fd: true,
            stamps: false,
            refused: 0,
            filters: None,
            blocked: false,
            dirty: false,
            failures: 0,
        }
    }

    /// Queues a frame, with its time stamp on a timed bus. Returns true if the client must be added to the list of
    /// clients to be flushed.
    pub(super) fn enqueue(
        &mut self,
        parcel: FrameDatagram,
        stamp: Option<u64>,
        post: &mut SendContext,
    ) -> bool {
        post.totals.routed += 1;
        if !self.queue.push(parcel, stamp.filter(|_| self.stamps)) {
            post.totals.dropped += 1;
            return false;
        }
        // If the client no longer reads, sending fails again at the end of the round, and is handled there.
        if !self.blocked && self.queue.frame_count() >= MAX_BATCH_DATAGRAMS {
            let _ = self.send(post);
        }
        !self.blocked && !std::mem::replace(&mut self.dirty, true)
    }

    /// Queues a report of a refused frame, if the client understands it. Returns true if the client must be added to the
    /// list of clients to be flushed.
    pub(super) fn enqueue_refusal(&mut self, raw_id: u32) -> bool {
        self.refused = self.refused.wrapping_add(1);
        if !self.stamps {
            return false;
        }
        self.queue.push_refusal(self.refused, raw_id);
        !self.blocked && !std::mem::replace(&mut self.dirty, true)
    }

    /// Sends the queue at once, before the same process gets a newer frame by its other socket. Errors are ignored,
    /// because they occur again at the end of the round.
    pub(super) fn send_now(&mut self, post: &mut SendContext) {
        if self.dirty && !self.blocked {
            let _ = self.send(post);
        }
    }

    /// Sends the queue, unless the socket is full.
    pub(super) fn flush(&mut self, post: &mut SendContext) -> SendOutcome {
        self.dirty = false;
        if self.blocked { SendOutcome::Done } else { self.send(post) }
    }

    /// Excludes the socket from `epoll`, and sends nothing to it until it is resumed.
    pub(super) fn pause_sending(&mut self, post: &SendContext) {
        self.blocked = true;
        let _ = epoll::delete(&post.epoll, &self.socket);
    }

    /// Includes the socket in `epoll` again. Returns true on success.
    pub(super) fn resume_sending(&mut self, post: &SendContext) -> bool {
        let data = EventData::new_u64(self.id.0 as u64);
        let resumed = epoll::add(&post.epoll, &self.socket, data, EventFlags::IN).is_ok();
        self.blocked = !resumed;
        resumed
    }

    /// Returns true if the client was blocked and can be sent to again.
    pub(super) fn try_unblock(&mut self, post: &SendContext) -> bool {
        let free = self.blocked && self.set_epoll_flags(post, EventFlags::IN);
        self.blocked &= !free;
        free
    }

    /// Drops the frames in the queue, and counts them as abandoned.
    pub(super) fn abandon_queue(&mut self, post: &mut SendContext) {
        post.totals.abandoned += self.queue.frame_count() as u64;
        self.queue = ClientQueue::new(MAX_QUEUED_FRAMES);
    }

    /// Sends the queue until it is empty or the socket is full.
    fn send(&mut self, post: &mut SendContext) -> SendOutcome {
        loop {
            self.queue.push_drop_report();
            if self.queue.is_empty() {
                return SendOutcome::Done;
            }
            post.outgoing.clear();
            for entry in self.queue.iter().take(MAX_BATCH_DATAGRAMS) {
                match entry {
                    QueueEntry::Frame(parcel) => _ = post.outgoing.push(parcel.bytes(), parcel.byte_len()),
                    QueueEntry::Stamped(stamp, parcel) => {
                        post.outgoing.push(parcel.bytes(), parcel.byte_len());
                        post.outgoing.append_stamp(*stamp);
                    }
                    QueueEntry::Dropped(total) => {
                        push_notice(&mut post.outgoing, &encode_drop_notice(*total))
                    }
                    QueueEntry::Refused(total, raw_id) => {
                        push_notice(&mut post.outgoing, &encode_refusal_notice(*total, *raw_id));
                    }
                }
            }
            match post.outgoing.send(&self.socket) {
                Ok(count) => post.totals.delivered += self.queue.remove_sent(count) as u64,
                // The socket is not treated as full, because `epoll` would report room in it at once, again and again.
                Err(error) if is_memory_shortage(&error) => return SendOutcome::Shortage,
                Err(error) => match Errno::from_io_error(&error) {
                    Some(Errno::INTR) => {}
                    Some(Errno::AGAIN) => {
                        self.blocked = self.set_epoll_flags(post, EventFlags::IN | EventFlags::OUT);
                        return if self.blocked { SendOutcome::Done } else { SendOutcome::Shortage };
                    }
                    Some(Errno::PIPE | Errno::CONNRESET | Errno::NOTCONN) => return SendOutcome::Gone,
                    errno => return SendOutcome::Failed(errno.unwrap_or(Errno::IO)),
                },
            }
        }
    }

    fn set_epoll_flags(&self, post: &SendContext, flags: EventFlags) -> bool {
        epoll::modify(&post.epoll, &self.socket, EventData::new_u64(self.id.0 as u64), flags).is_ok()
    }
}

fn push_notice(outgoing: &mut Outgoing, notice: &[u8]) {
    let mut bytes = [0; FD_BYTES];
    for (to, from) in bytes.iter_mut().zip(notice) {
        *to = *from;
    }
    outgoing.push(&bytes, notice.len());
}
