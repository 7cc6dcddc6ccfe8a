//! The queue of frames for one client. It counts the frames that were dropped because the client did not read.

use std::collections::VecDeque;

use super::parcel::FrameDatagram;

/// An item of the queue.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum QueueEntry {
    /// A frame.
    Frame(FrameDatagram),
    /// A frame of a timed bus, with its end in ns since 1970.
    Stamped(u64, FrameDatagram),
    /// A report to the client: the total number of its frames that its transmit queue has refused, and the identifier of
    /// the last one.
    Refused(u32, u32),
    /// A report to the client: the total number of frames dropped for it so far.
    Dropped(u32),
}

/// A bounded queue. If it is full, new frames are dropped, as in the receive buffer of a socket. The client gets a
/// report of the total number of dropped frames before the next frame that is not dropped.
#[derive(Debug)]
pub struct ClientQueue {
    entries: VecDeque<QueueEntry>,
    frames: usize,
    limit: usize,
    dropped: u32,
    reported: u32,
}

impl ClientQueue {
    /// Creates an empty queue for at most `limit` frames.
    #[must_use]
    pub const fn new(limit: usize) -> Self {
        Self { entries: VecDeque::new(), frames: 0, limit, dropped: 0, reported: 0 }
    }

    /// Appends a frame, with its time stamp on a timed bus. Returns false if there was no room; the frame is then dropped
    /// and counted.
    pub fn push(&mut self, parcel: FrameDatagram, stamp: Option<u64>) -> bool {
        if self.frames >= self.limit {
            self.dropped = self.dropped.wrapping_add(1);
            return false;
        }
        self.push_drop_report();
        self.entries.push_back(match stamp {
            None => QueueEntry::Frame(parcel),
            Some(stamp) => QueueEntry::Stamped(stamp, parcel),
        });
        self.frames += 1;
        true
    }

    /// Appends a report of refused frames, in place of a report that is the last item.
    pub fn push_refusal(&mut self, total: u32, raw_id: u32) {
        if let Some(QueueEntry::Refused(..)) = self.entries.back() {
            self.entries.pop_back();
        }
        self.entries.push_back(QueueEntry::Refused(total, raw_id));
    }

    /// Appends a report of the dropped frames, if their number has changed since the last report. Must also be called
    /// when the queue becomes empty, so that the report has its correct position among the frames.
    pub fn push_drop_report(&mut self) {
        if self.reported != self.dropped {
            self.entries.push_back(QueueEntry::Dropped(self.dropped));
            self.reported = self.dropped;
        }
    }

    /// Returns the queued items, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = &QueueEntry> {
        self.entries.iter()
    }

    /// Removes the oldest `count` items after they were sent. Returns the number of frames among them.
    pub fn remove_sent(&mut self, count: usize) -> usize {
        let sent = self.entries.drain(..count.min(self.entries.len()));
        let frames =
            sent.filter(|entry| matches!(entry, QueueEntry::Frame(_) | QueueEntry::Stamped(..))).count();
        self.frames -= frames;
        frames
    }

    /// Returns the number of queued frames.
    #[must_use]
    pub const fn frame_count(&self) -> usize {
        self.frames
    }

    /// Returns true if the queue holds neither frames nor a report.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use protocol::can::Frame;

    fn parcel(id: u32) -> FrameDatagram {
        FrameDatagram::from_client_datagram(&Frame::classic(id, &[]).unwrap().to_bytes()[..16], true).unwrap()
    }

    #[test]
    fn what_does_not_fit_is_dropped_and_reported_before_the_next_frame() {
        let mut queue = ClientQueue::new(2);
        let kept: Vec<_> = (0..5).map(|id| queue.push(parcel(id), None)).collect();
        assert_eq!(kept, [true, true, false, false, false]);
        assert_eq!(queue.remove_sent(2), 2);
        assert!(queue.push(parcel(5), None));
        assert_eq!(
            queue.iter().copied().collect::<Vec<_>>(),
            [QueueEntry::Dropped(3), QueueEntry::Frame(parcel(5))]
        );
    }

    #[test]
    fn a_total_is_reported_once() {
        let mut queue = ClientQueue::new(0);
        queue.push_drop_report();
        assert!(queue.is_empty());
        queue.push(parcel(0), None);
        queue.push_drop_report();
        queue.push_drop_report();
        assert_eq!(queue.iter().copied().collect::<Vec<_>>(), [QueueEntry::Dropped(1)]);
        assert_eq!(queue.remove_sent(1), 0);
    }

    proptest! {
        /// Each step is `true` to push the next frame or `false` to send the oldest item.
        #[test]
        fn a_reader_knows_at_every_frame_how_many_are_missing(limit in 0_usize..6, steps in proptest::collection::vec(any::<bool>(), 0..60)) {
            let mut queue = ClientQueue::new(limit);
            let (mut pushed, mut heard, mut missing) = (0_u32, 0_u32, 0_u32);
            let mut hear = |queue: &mut ClientQueue| {
                match queue.iter().next().copied() {
                    Some(QueueEntry::Dropped(total)) => missing = total,
                    Some(QueueEntry::Stamped(..) | QueueEntry::Refused(..)) => unreachable!("never pushed"),
                    Some(QueueEntry::Frame(parcel)) => {
                        assert_eq!(parcel.raw_id(), heard + missing);
                        heard += 1;
                    }
                    None => {}
                }
                queue.remove_sent(1);
                (heard, missing)
            };
            for push in steps {
                if push {
                    queue.push(parcel(pushed), None);
                    pushed += 1;
                } else {
                    hear(&mut queue);
                }
                prop_assert!(queue.frame_count() <= limit);
            }
            queue.push_drop_report();
            while !queue.is_empty() {
                hear(&mut queue);
            }
            let (heard, missing) = hear(&mut queue);
            prop_assert_eq!(heard + missing, pushed);
            prop_assert_eq!(missing, queue.dropped);
        }
    }
}
