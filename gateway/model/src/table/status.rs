//! The status of a cell, as named in tables and recordings.

/// The status of a cell.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum CellStatus {
    /// No packet has arrived from the cell yet.
    Unknown,
    /// The cell is alive and not in contact.
    Quiet,
    /// The cell is in contact, and answered the last epoch for which the time to answer has passed.
    Active,
    /// The cell is in contact, and did not answer an epoch in time.
    Stale,
    /// The cell has been silent for too long.
    Dead,
}

impl CellStatus {
    /// Returns the name of the status in tables and summaries.
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

    /// Returns the number of the status in recordings and snapshots.
    #[must_use]
    pub const fn number(self) -> u8 {
        self as u8
    }
}
