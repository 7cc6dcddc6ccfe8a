//! The status of a cell, as named in tables and recordings.

/// The status of a cell.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Status {
    /// No packet has arrived from it yet.
    Unknown,
    /// Alive and not in contact.
    Quiet,
    /// In contact, and answered the last epoch that left time for it.
    Active,
    /// In contact, and did not answer an epoch.
    Stale,
    /// Silent for too long.
    Dead,
}

impl Status {
    /// Returns the name in tables and summaries.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unknown => "never heard",
            Self::Quiet => "quiet",
            Self::Active => "active",
            Self::Stale => "stale",
            Self::Dead => "dead",
        }
    }

    /// Returns the number in recordings and snapshots.
    #[must_use]
    pub const fn number(self) -> u8 {
        self as u8
    }
}
