//! The times from joints to the replies to them on a timed bus, whose time stamps are the ends of frames.

use protocol::packet::Epoch;
use protocol::time::Micros;

/// The number of different epoch bytes.
const EPOCHS: usize = 256;
/// The time in µs after which the last value of replies is replaced.
const WINDOW_US: u64 = 1_000_000;
/// The maximum time in µs from joints to a reply. A later one answers other joints, because epoch bytes come again.
const MAX_REPLY_US: u64 = 2_000_000;

/// The times from joints to the replies to them, late ones included.
#[derive(Clone, Debug)]
pub(crate) struct ReplyTimes {
    /// For each epoch byte: the end of the newest joints with it.
    joints_at: [Option<Micros>; EPOCHS],
    window_began: Option<Micros>,
    /// The longest time in this window, in the last complete one, since the last joints, and between the two before.
    in_window_us: Option<u64>,
    last_window_us: Option<u64>,
    since_joints_us: Option<u64>,
    last_epoch_us: Option<u64>,
}

impl Default for ReplyTimes {
    fn default() -> Self {
        Self {
            joints_at: [None; EPOCHS],
            window_began: None,
            in_window_us: None,
            last_window_us: None,
            since_joints_us: None,
            last_epoch_us: None,
        }
    }
}

impl ReplyTimes {
    pub(super) fn handle_joints(&mut self, at: Micros, epoch: Epoch) {
        if let Some(joints) = self.joints_at.get_mut(usize::from(epoch.0)) {
            *joints = Some(at);
        }
        self.last_epoch_us = self.since_joints_us.take();
    }

    /// Handles the torque or the sum of an epoch. One without joints is ignored.
    pub(super) fn handle_reply(&mut self, at: Micros, epoch: Epoch) {
        let Some(&Some(joints)) = self.joints_at.get(usize::from(epoch.0)) else { return };
        let Some(took) = at.0.checked_sub(joints.0).filter(|&took| took <= MAX_REPLY_US) else { return };
        self.in_window_us = self.in_window_us.max(Some(took));
        self.since_joints_us = self.since_joints_us.max(Some(took));
    }

    /// Sets the time, by which windows end.
    pub(super) fn handle_time(&mut self, now: Micros) {
        let began = *self.window_began.get_or_insert(now);
        if now.0.saturating_sub(began.0) >= WINDOW_US {
            self.last_window_us = self.in_window_us.take();
            self.window_began = Some(now);
        }
    }

    /// Returns the longest time in ms in the last complete second; `None` without a reply in it.
    pub(super) fn longest_of_second_ms(&self) -> Option<f64> {
        self.last_window_us.map(to_millis)
    }

    /// Returns the longest time in ms of the replies that came between the last two joints; `None` without a reply.
    pub(super) fn longest_of_epoch_ms(&self) -> Option<f64> {
        self.last_epoch_us.map(to_millis)
    }
}

fn to_millis(micros: u64) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "at most MAX_REPLY_US")]
    let micros = micros as f64;
    micros * 1e-3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_reply_is_that_of_its_own_joints_also_when_it_is_late() {
        let mut replies = ReplyTimes::default();
        replies.handle_time(Micros(0));
        replies.handle_reply(Micros(5), Epoch(7));
        assert_eq!(replies.longest_of_epoch_ms(), None, "no joints of epoch 7 were received");
        replies.handle_joints(Micros(10_000), Epoch(7));
        replies.handle_reply(Micros(13_000), Epoch(7));
        replies.handle_reply(Micros(12_000), Epoch(7));
        replies.handle_joints(Micros(26_000), Epoch(8));
        assert_eq!(replies.longest_of_epoch_ms(), Some(3.0));
        replies.handle_reply(Micros(27_500), Epoch(8));
        replies.handle_reply(Micros(31_000), Epoch(7));
        replies.handle_joints(Micros(42_000), Epoch(9));
        assert_eq!(replies.longest_of_epoch_ms(), Some(21.0), "a reply to the joints before the last ones");
        replies.handle_joints(Micros(58_000), Epoch(10));
        assert_eq!(replies.longest_of_epoch_ms(), None, "nobody replied to epoch 9");
        assert_eq!(replies.longest_of_second_ms(), None, "the first second is not over");
        replies.handle_time(Micros(1_000_000));
        assert_eq!(replies.longest_of_second_ms(), Some(21.0));
        replies.handle_time(Micros(2_000_000));
        assert_eq!(replies.longest_of_second_ms(), None, "a second without a reply");
    }

    #[test]
    fn a_reply_long_after_its_joints_answers_others_that_were_lost() {
        let mut replies = ReplyTimes::default();
        replies.handle_joints(Micros(0), Epoch(0));
        replies.handle_reply(Micros(MAX_REPLY_US + 1), Epoch(0));
        replies.handle_joints(Micros(MAX_REPLY_US + 2), Epoch(1));
        assert_eq!(replies.longest_of_epoch_ms(), None);
        replies.handle_joints(Micros(MAX_REPLY_US + 16_000), Epoch(2));
        // The clock went back.
        replies.handle_reply(Micros(MAX_REPLY_US), Epoch(2));
        replies.handle_joints(Micros(MAX_REPLY_US + 32_000), Epoch(3));
        assert_eq!(replies.longest_of_epoch_ms(), None);
    }
}
