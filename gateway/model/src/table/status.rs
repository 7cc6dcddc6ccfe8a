//! The status of a cell, as tables and recordings name it.

/// The status of a cell.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Status {
    /// Nothing came from it yet.
    Unknown,
    /// Alive and not in contact.
    Quiet,
    /// In contact, and answered the last epoch that had time for it.
    Active,
    /// In contact, and did not answer an epoch.
    Stale,
    /// Silent for too long.
    Dead,
}

impl Status {
    /// The name that tables and summaries use.
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

    /// The number that recordings and snapshots use.
    #[must_use]
    pub const fn number(self) -> u8 {
        self as u8
    }
}
