//! The delays of cells, by the kernel's time stamps: large delays show a busy machine, not a bus that loses frames.

use hdrhistogram::Histogram;
use protocol::time::Span;

use protocol::quantiles::histogram;

/// Delays of the cells of a bus in µs, from the time stamps of frames.
#[derive(Clone, Debug)]
pub struct Delays {
    last_reply: Histogram<u64>,
    reply: Histogram<u64>,
    joints_pending: Histogram<u64>,
}

impl Default for Delays {
    fn default() -> Self {
        Self { last_reply: histogram(), reply: histogram(), joints_pending: histogram() }
    }
}

// Recording cannot fail: the histograms resize themselves.
impl Delays {
    pub(super) fn record_last_reply_delay(&mut self, span: Span) {
        let _ = self.last_reply.record(span.0);
    }

    pub(super) fn record_reply_delay(&mut self, span: Span) {
        let _ = self.reply.record(span.0);
    }

    pub(super) fn record_pending_joints_age(&mut self, span: Span) {
        let _ = self.joints_pending.record(span.0);
    }

    pub(super) fn reset(&mut self) {
        for histogram in [&mut self.last_reply, &mut self.reply, &mut self.joints_pending] {
            histogram.reset();
        }
    }

    /// Returns the delays in µs from a broadcast to its last reply in time, one for each epoch with a reply.
    #[must_use]
    pub const fn last_reply_delays(&self) -> &Histogram<u64> {
        &self.last_reply
    }

    /// Returns the delays in µs from a broadcast to each reply, late replies included; empty on a bus with sums.
    #[must_use]
    pub const fn reply_delays(&self) -> &Histogram<u64> {
        &self.reply
    }

    /// Returns for each heartbeat the age in µs of the oldest joints on the bus that the cell had not received when it
    /// sent the heartbeat; 0 if it had received all.
    #[must_use]
    pub const fn pending_joints_ages(&self) -> &Histogram<u64> {
        &self.joints_pending
    }
}
