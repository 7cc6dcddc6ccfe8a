//! The contents of a recording beside frames and notes.

use std::collections::BTreeMap;

use protocol::can::Frame;
use protocol::document::DocumentError;
use protocol::skin::Skin;
use serde::Serialize;

/// The contents of an MCAP recording beside frames and notes, as far as it has been read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Extras {
    /// Topics that are no frames and no notes, in the order in which they came.
    pub topics: Vec<Topic>,
    /// Earlier frames that are latched when the recording begins.
    pub latched: Vec<Latched>,
    /// Attachments by name; the largest without their bytes.
    pub attachments: Vec<(String, Vec<u8>)>,
    /// Metadata by name.
    pub metadata: Vec<(String, Vec<(String, String)>)>,
    /// What is missing at its end, when it was never finished.
    pub unfinished: Option<String>,
}

/// The metadata that says when the loop of a run began.
pub const RUN: &str = "run";
/// Its key: the first tick, in ns since 1970.
const BEGAN: &str = "began_ns";

/// Makes the facts of the metadata [`RUN`]: the time of the first tick, in ns since 1970.
#[must_use]
pub fn facts_of_run(nanos: u64) -> BTreeMap<String, String> {
    [(BEGAN.to_owned(), nanos.to_string())].into()
}

/// Returns the seconds from a time to another, both in ns since 1970; negative before it.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "to a nanosecond within three months")]
pub const fn seconds_since(zero: u64, nanos: u64) -> f64 {
    if nanos < zero { (zero - nanos) as f64 / -1e9 } else { (nanos - zero) as f64 / 1e9 }
}

/// What the skin in a recording of a run is called.
pub const SKIN: &str = "skin.toml";

impl Extras {
    /// Nothing.
    pub(super) const NONE: &Self = &Self {
        topics: Vec::new(),
        latched: Vec::new(),
        attachments: Vec::new(),
        metadata: Vec::new(),
        unfinished: None,
    };

    /// A value of the metadata.
    #[must_use]
    pub fn fact(&self, record: &str, key: &str) -> Option<&str> {
        let (_, facts) = self.metadata.iter().find(|(name, _)| name == record)?;
        facts.iter().find(|(name, _)| name == key).map(|(_, value)| value.as_str())
    }

    /// The time of the run's first tick, in ns since 1970, from which seconds count; where it is not known they count from the
    /// capture's first frame. Of what is read only once it is not known before the first frame.
    #[must_use]
    pub fn run_began(&self) -> Option<u64> {
        self.fact(RUN, BEGAN)?.parse().ok()
    }

    /// The skin that is attached; `None` when none is.
    ///
    /// # Errors
    /// Of the skin, when it is none that this version knows.
    #[must_use]
    pub fn skin(&self) -> Option<Result<Skin, DocumentError>> {
        let (_, text) = self.attachments.iter().find(|(name, _)| name == SKIN)?;
        Some(Skin::parse_recorded(SKIN, &String::from_utf8_lossy(text)))
    }
}

/// A frame that was on a bus before a recording began, and is still latched.
#[derive(Clone, Debug, PartialEq)]
pub struct Latched {
    /// Its bus.
    pub bus: String,
    /// Whether the recorder had sent it.
    pub own: bool,
    /// What it is.
    pub frame: Frame,
    /// When it was on the bus, in ns since 1970.
    pub nanos: u64,
}

/// A topic that is neither frames nor notes.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Topic {
    /// Its name.
    #[serde(rename = "topic")]
    pub name: String,
    /// The type of its messages.
    pub schema: String,
    /// How many.
    pub messages: u64,
}
