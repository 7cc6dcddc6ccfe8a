//! Resting: joints need not wake a cell that is not touched, because the cell would only count them.

/// Number of consecutive joints without a reply before the cell rests, so that a flickering touch does not change the
/// receive filters each time.
const QUIET_JOINTS_BEFORE_REST: u8 = 16;

/// The state of a cell that may rest.
#[derive(Debug, Default)]
pub(super) struct RestState {
    /// Number of consecutive joints without a reply, at most [`QUIET_JOINTS_BEFORE_REST`].
    quiet: u8,
    /// True if the cell rested at the last poll.
    rests: bool,
}

impl RestState {
    /// Counts joints that arrived in time and needed no reply.
    pub(super) fn count_quiet_joints(&mut self) {
        self.quiet = self.quiet.saturating_add(1).min(QUIET_JOINTS_BEFORE_REST);
    }

    /// Ends the rest: joints wake the cell again.
    pub(super) const fn end_rest(&mut self) {
        self.quiet = 0;
    }

    /// Returns true if joints need not wake the cell (deferred receive).
    pub(super) const fn is_deferring_joints(&self) -> bool {
        self.rests
    }

    /// Returns true if the cell has begun or ended to rest since the last call.
    pub(super) fn poll_rest_changed(&mut self) -> bool {
        let rests = self.quiet == QUIET_JOINTS_BEFORE_REST;
        core::mem::replace(&mut self.rests, rests) != rests
    }
}
