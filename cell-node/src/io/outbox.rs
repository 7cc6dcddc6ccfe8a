//! The frames that wait to be sent, each with the cell whose counter of sent packets includes it.

use protocol::can::Frame;

/// The frames that the cells of a process have to send, in order.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    frames: Vec<Frame>,
    /// For the last frame of each packet, the index of the cell that counts the packet; `None` for other frames.
    ends: Vec<Option<usize>>,
}

impl Outbox {
    /// Appends the frames of a packet of the cell with the index `place`.
    pub(super) fn push_packet(&mut self, place: usize, frames: impl IntoIterator<Item = Frame>) {
        self.frames.extend(frames);
        self.ends.resize(self.frames.len(), None);
        if let Some(end) = self.ends.last_mut() {
            *end = Some(place);
        }
    }

    /// Appends a frame of a simulated wire, which no cell counts as a sent packet.
    pub(super) fn push_uncounted(&mut self, frame: Frame) {
        self.frames.push(frame);
        self.ends.push(None);
    }

    /// Returns the pending frames.
    pub(super) fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// Removes the first `count` frames, which have been sent.
    pub(super) fn mark_sent(&mut self, count: usize) {
        self.frames.drain(..count);
        self.ends.drain(..count);
    }

    /// Removes all frames, which are lost. Returns, for each packet among them, the index of the cell that counted it.
    pub(super) fn drop_all_frames(&mut self) -> impl Iterator<Item = usize> {
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
            outbox.mark_sent(sent);
            assert_eq!(outbox.frames().len(), 4 - sent);
            assert_eq!(outbox.drop_all_frames().collect::<Vec<_>>(), lost, "{sent}");
            assert!(outbox.frames().is_empty());
        }
    }
}
