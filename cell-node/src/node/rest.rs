//! When a cell need not be woken for joints: nothing touches it, so that it would only count them.

/// Joints in a row to which there was nothing to say, before it rests: a touch that flickers changes no filters.
const QUIET: u8 = 16;

/// Whether a cell rests.
#[derive(Debug, Default)]
pub(super) struct Rest {
    /// Joints in a row to which there was nothing to say, up to [`QUIET`].
    quiet: u8,
    /// As it was read last.
    rests: bool,
}

impl Rest {
    /// Joints were taken in time to which there was nothing to say.
    pub(super) fn lengthen(&mut self) {
        self.quiet = self.quiet.saturating_add(1).min(QUIET);
    }

    /// From now on joints wake it again.
    pub(super) const fn end(&mut self) {
        self.quiet = 0;
    }

    /// Returns true if joints are received deferred.
    pub(super) const fn rests(&self) -> bool {
        self.rests
    }

    /// Returns true if that has changed since the last call.
    pub(super) fn poll(&mut self) -> bool {
        let rests = self.quiet == QUIET;
        core::mem::replace(&mut self.rests, rests) != rests
    }
}
