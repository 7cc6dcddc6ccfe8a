//! The packets that wait to be sent, in a ring in which they are encoded in place.

use protocol::id::Id;
use protocol::packet::{Epoch, Length, Packet, Words};

/// Maximum number of pending packets. The caller collects them after every call of the node.
const CAPACITY: u8 = 16;

const EMPTY: Packet =
    Packet { id: Id::from_bits(0), words: Words::zeros(Length::Six), epoch: Epoch(0), count: 0 };

/// The packets that wait to be sent, the oldest first.
#[derive(Debug)]
pub(super) struct Outbox {
    packets: [Packet; CAPACITY as usize],
    first: u8,
    waiting: u8,
}

impl Outbox {
    // Not inlined, so that it is constructed in place.
    #[inline(never)]
    pub(super) const fn new() -> Self {
        Self { packets: [EMPTY; CAPACITY as usize], first: 0, waiting: 0 }
    }

    /// Returns the number of pending packets.
    pub(super) const fn len(&self) -> u8 {
        self.waiting
    }

    /// Appends a packet, which has the content of an earlier one until the caller writes it. Returns `None` if the
    /// outbox is full.
    pub(super) fn push(&mut self) -> Option<&mut Packet> {
        if self.waiting == CAPACITY {
            return None;
        }
        let place = (self.first + self.waiting) % CAPACITY;
        self.waiting += 1;
        self.packets.get_mut(usize::from(place))
    }

    /// Removes the oldest packet, which can be read until the next call.
    pub(super) fn pop(&mut self) -> Option<&Packet> {
        self.waiting = self.waiting.checked_sub(1)?;
        let place = self.first;
        self.first = (place + 1) % CAPACITY;
        self.packets.get(usize::from(place))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_come_out_in_order_around_the_end_of_the_ring() {
        let mut outbox = Outbox::new();
        let push = |outbox: &mut Outbox, epoch| outbox.push().map(|packet| packet.epoch = Epoch(epoch));
        for round in 0..10 {
            for epoch in 0..CAPACITY {
                assert!(push(&mut outbox, round + epoch).is_some());
            }
            assert!(push(&mut outbox, 99).is_none(), "it is full");
            for epoch in 0..CAPACITY - 3 {
                assert_eq!(outbox.pop().map(|packet| packet.epoch), Some(Epoch(round + epoch)));
            }
            assert_eq!(outbox.len(), 3);
            while outbox.pop().is_some() {}
        }
    }
}
