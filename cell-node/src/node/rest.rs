//! Resting: joints need not wake a cell that nothing touches, because it would only count them.

/// Number of consecutive joints without an answer before the cell rests, so that a flickering touch does not
/// change filters.
const QUIET_JOINTS: u8 = 16;

/// The state of resting.
#[derive(Debug, Default)]
pub(super) struct Rest {
    /// Number of consecutive joints without an answer, up to [`QUIET`].
    quiet: u8,
    /// The state at the last poll.
    rests: bool,
}

impl Rest {
    /// Counts joints that were on time and needed no answer.
    pub(super) fn count_quiet(&mut self) {
        self.quiet = self.quiet.saturating_add(1).min(QUIET_JOINTS);
    }

    /// Ends the rest: joints wake the cell again.
    pub(super) const fn end(&mut self) {
        self.quiet = 0;
    }

    /// Returns true if joints are received deferred.
    pub(super) const fn rests(&self) -> bool {
        self.rests
    }

    /// Returns true if the state has changed since the last call.
    pub(super) fn poll(&mut self) -> bool {
        let rests = self.quiet == QUIET_JOINTS;
        core::mem::replace(&mut self.rests, rests) != rests
    }
}
