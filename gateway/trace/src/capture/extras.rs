//! The contents of a recording beside frames and notes.

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
