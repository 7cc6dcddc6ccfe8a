//! How long cells take, by the kernel's time stamps: a machine that is too slow shows here, and a bus that loses frames does
//! not.

use hdrhistogram::Histogram;
use protocol::time::Span;

use crate::quantiles::histogram;

/// Delays of a bus' cells in µs.
#[derive(Clone, Debug)]
pub struct Delays {
    last_reply: Histogram<u64>,
    reply: Histogram<u64>,
    not_taken: Histogram<u64>,
}

impl Default for Delays {
    fn default() -> Self {
        Self { last_reply: histogram(), reply: histogram(), not_taken: histogram() }
    }
}

// The histograms grow by themselves; they cannot refuse.
impl Delays {
    pub(super) fn last_reply(&mut self, span: Span) {
        let _ = self.last_reply.record(span.0);
    }

    pub(super) fn reply(&mut self, span: Span) {
        let _ = self.reply.record(span.0);
    }

    pub(super) fn not_taken(&mut self, span: Span) {
        let _ = self.not_taken.record(span.0);
    }

    pub(super) fn reset(&mut self) {
        for histogram in [&mut self.last_reply, &mut self.reply, &mut self.not_taken] {
            histogram.reset();
        }
    }

    /// From a broadcast to its last reply in time, for each epoch with a reply.
    #[must_use]
    pub const fn of_last_replies(&self) -> &Histogram<u64> {
        &self.last_reply
    }

    /// From a broadcast to each reply, late ones included; of sums none.
    #[must_use]
    pub const fn of_replies(&self) -> &Histogram<u64> {
        &self.reply
    }

    /// At each heartbeat, for how long joints had stood on the bus that its cell had not taken; 0 if there were none.
    #[must_use]
    pub const fn of_joints_not_taken(&self) -> &Histogram<u64> {
        &self.not_taken
    }
}
