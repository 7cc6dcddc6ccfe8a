//! Frames to send, with the cells that count their packets.

use protocol::can::Frame;

/// The frames of the cells of a process, in sending order.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    frames: Vec<Frame>,
    /// For the last frame of each packet, the index of the cell that counts it.
    ends: Vec<Option<usize>>,
}

impl Outbox {
    /// Appends a packet of the cell with this index.
    pub(super) fn push_packet(&mut self, place: usize, frames: impl IntoIterator<Item = Frame>) {
        self.frames.extend(frames);
        self.ends.resize(self.frames.len(), None);
        if let Some(end) = self.ends.last_mut() {
            *end = Some(place);
        }
    }

    /// Appends a frame that no cell counts.
    pub(super) fn push_uncounted(&mut self, frame: Frame) {
        self.frames.push(frame);
        self.ends.push(None);
    }

    /// Returns the pending frames.
    pub(super) fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// Removes the first `count` frames after they were sent.
    pub(super) fn sent(&mut self, count: usize) {
        self.frames.drain(..count);
        self.ends.drain(..count);
    }

    /// Removes all frames as lost. Returns the index of the counting cell for each packet.
    pub(super) fn lose(&mut self) -> impl Iterator<Item = usize> {
        self.frames.clear();
        self.ends.drain(..).flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_is_lost_with_its_last_frame() {
        let frame = |id| Frame::classic(id, &[]).unwrap();
        let filled = || {
            let mut outbox = Outbox::default();
            outbox.push_packet(7, [frame(0), frame(1)]);
            outbox.push_uncounted(frame(2));
            outbox.push_packet(8, [frame(3)]);
            outbox
        };
        for (sent, lost) in [(0, vec![7, 8]), (1, vec![7, 8]), (2, vec![8]), (3, vec![8]), (4, vec![])] {
            let mut outbox = filled();
            outbox.sent(sent);
            assert_eq!(outbox.frames().len(), 4 - sent);
            assert_eq!(outbox.lose().collect::<Vec<_>>(), lost, "{sent}");
            assert!(outbox.frames().is_empty());
        }
    }
}
