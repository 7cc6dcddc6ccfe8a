//! Where received frames land.

use super::BusKind;
use super::batch::{BATCH, Batch, Datagram};
use super::embedded::{OWN_BYTE, decode_dropped};
use crate::can::Frame;

/// One received frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Received {
    /// The frame.
    pub frame: Frame,
    /// When it reached this socket, in nanoseconds of the wall clock (`SO_TIMESTAMPNS`); 0 if the kernel
    /// did not say.
    pub at_nanos: u64,
    /// Whether this very socket sent it.
    pub own: bool,
}

/// Buffers for [`super::Bus::receive`], filled again and again: nothing is allocated after
/// [`Inbox::new`].
#[derive(Debug)]
pub struct Inbox {
    pub(super) batch: Batch,
    frames: Vec<Received>,
    dropped: u32,
    unreadable: u64,
}

/// What a batch of datagrams was.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Taken {
    /// Frames and notices.
    Frames,
    /// The other end is gone, after the frames that are in the inbox.
    End,
}

impl Inbox {
    /// Empty buffers for up to 64 frames.
    #[must_use]
    pub fn new() -> Self {
        Self { batch: Batch::new(), frames: Vec::with_capacity(BATCH), dropped: 0, unreadable: 0 }
    }

    /// The frames of the last [`super::Bus::receive`], in the order in which they came.
    pub fn frames(&self) -> impl ExactSizeIterator<Item = Received> + '_ {
        self.frames.iter().copied()
    }

    /// How many frames the kernel, or the embedded bus, has dropped for this socket so far because it was
    /// not read in time: a running total that wraps (`SO_RXQ_OVFL`). The kernel tells it with the next frame
    /// that arrives, the embedded bus also when the socket has been read empty.
    #[must_use]
    pub const fn dropped(&self) -> u32 {
        self.dropped
    }

    /// How many datagrams were neither a frame nor a notice; 0 unless the other end is broken.
    #[must_use]
    pub const fn unreadable(&self) -> u64 {
        self.unreadable
    }

    /// Forgets the frames.
    pub fn clear(&mut self) {
        self.frames.clear();
    }

    /// Reads the batch's datagrams into frames.
    pub(super) fn take(&mut self, kind: BusKind) -> Taken {
        let Self { batch, frames, dropped, unreadable } = self;
        frames.clear();
        for datagram in batch.datagrams() {
            match datagram.bytes() {
                Some([]) => return Taken::End,
                Some(bytes) => match Frame::from_bytes(bytes) {
                    Ok(frame) => frames.push(received(frame, datagram, bytes, kind, dropped)),
                    Err(_) => match decode_dropped(bytes).filter(|_| kind == BusKind::Embedded) {
                        Some(total) => *dropped = total,
                        None => *unreadable += 1,
                    },
                },
                None => *unreadable += 1,
            }
        }
        Taken::Frames
    }
}

fn received(
    frame: Frame,
    datagram: Datagram<'_>,
    bytes: &[u8],
    kind: BusKind,
    dropped: &mut u32,
) -> Received {
    let notes = datagram.notes();
    let own = match kind {
        BusKind::SocketCan => datagram.is_own(),
        BusKind::Embedded => bytes.get(OWN_BYTE) == Some(&1),
    };
    if let Some(total) = notes.dropped {
        *dropped = total;
    }
    Received { frame, at_nanos: notes.at_nanos.unwrap_or(0), own }
}

impl Default for Inbox {
    fn default() -> Self {
        Self::new()
    }
}
