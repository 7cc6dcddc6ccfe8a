//! Reports of a recording while it is written.

/// An event of a recording that is to be reported.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum RecordingEvent {
    /// A file could not be written further. The run continues.
    BrokeOff(String),
    /// Any other event, such as a finished file.
    Other(String),
}

impl RecordingEvent {
    /// Returns the text of the event without its consequences, for the summary of the run.
    #[must_use]
    pub fn description(&self) -> &str {
        match self {
            Self::BrokeOff(what) | Self::Other(what) => what,
        }
    }
}

impl core::fmt::Display for RecordingEvent {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let more = match self {
            Self::BrokeOff(_) => {
                ": the run continues without recording; the data recorded so far can be read, and later data \
                 is only counted"
            }
            Self::Other(_) => "",
        };
        write!(f, "{}{more}", self.description())
    }
}
