//! The buffer of received frames.

use std::io;

use super::batch::{MAX_BATCH_DATAGRAMS, ReceiveBatch};
use super::carrier::BusBackend;
use crate::can::Frame;

/// A received frame.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ReceivedFrame {
    /// The frame.
    pub frame: Frame,
    /// Time of arrival at this socket, in nanoseconds of the wall clock (`SO_TIMESTAMPNS`); 0 if the kernel
    /// did not report it. On a timed bus the end of the frame on the bus.
    pub at_nanos: u64,
    /// True if the receiving socket itself sent the frame.
    pub own: bool,
}

/// A reusable buffer for [`super::Bus::receive`]. It does not allocate after [`Inbox::new`].
#[derive(Debug)]
pub struct Inbox {
    pub(super) batch: ReceiveBatch,
    /// The error that followed the frames of the last receive. The next receive returns it.
    pub(super) failure: Option<io::Error>,
    frames: Vec<ReceivedFrame>,
    dropped: u32,
    refused: u32,
    unreadable: u64,
}

impl Inbox {
    /// Creates an empty buffer for up to 64 frames.
    #[must_use]
    pub fn new() -> Self {
        Self {
            batch: ReceiveBatch::new(),
            failure: None,
            frames: Vec::with_capacity(MAX_BATCH_DATAGRAMS),
            dropped: 0,
            refused: 0,
            unreadable: 0,
        }
    }

    /// Returns the frames of the last [`super::Bus::receive`], in order of arrival.
    pub fn frames(&self) -> impl ExactSizeIterator<Item = ReceivedFrame> + '_ {
        self.frames.iter().copied()
    }

    /// Returns the number of frames that the kernel or the embedded bus has dropped for this socket because it was not
    /// read fast enough: a running total that wraps (`SO_RXQ_OVFL`). The kernel reports a new total with the next frame
    /// that arrives. The embedded bus also reports it when the socket has been read empty.
    #[must_use]
    pub const fn dropped_count(&self) -> u32 {
        self.dropped
    }

    /// Returns the number of frames of this socket that the transmit queue of a timed bus has refused: a running total
    /// that wraps.
    #[must_use]
    pub const fn refused_count(&self) -> u32 {
        self.refused
    }

    /// Returns the number of received datagrams that were neither a frame nor a drop notice; 0 unless the other end is
    /// faulty.
    #[must_use]
    pub const fn unreadable_count(&self) -> u64 {
        self.unreadable
    }

    /// Removes all frames from the buffer.
    pub fn clear(&mut self) {
        self.frames.clear();
    }

    /// Decodes the datagrams of the batch into frames. Returns true if the other end closed the connection after them.
    pub(super) fn decode(&mut self, carrier: &dyn BusBackend) -> bool {
        let Self { batch, frames, dropped, refused, unreadable, failure: _ } = self;
        frames.clear();
        for datagram in batch.datagrams() {
            let bytes = datagram.bytes();
            if bytes.is_some_and(<[u8]>::is_empty) {
                return true;
            }
            let (bytes, stamp) = bytes.map_or((None, None), |bytes| {
                let (bytes, stamp) = carrier.split_stamp(bytes);
                (Some(bytes), stamp)
            });
            if let Some(Ok(frame)) = bytes.map(Frame::from_bytes) {
                let notes = datagram.info();
                *dropped = notes.dropped.unwrap_or(*dropped);
                let at_nanos = stamp.or(notes.at_nanos).unwrap_or(0);
                frames.push(ReceivedFrame { frame, at_nanos, own: carrier.is_own(datagram) });
            } else if let Some(total) = bytes.and_then(|bytes| carrier.decode_drop_notice(bytes)) {
                *dropped = total;
            } else if let Some(total) = bytes.and_then(|bytes| carrier.decode_refusal_notice(bytes)) {
                *refused = total;
            } else {
                *unreadable += 1;
            }
        }
        false
    }
}

impl Default for Inbox {
    fn default() -> Self {
        Self::new()
    }
}
