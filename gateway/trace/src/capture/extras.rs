//! Attachments, metadata and other topics of a recording: everything except its frames and notes.

use std::collections::BTreeMap;

use protocol::can::Frame;
use protocol::document::DocumentError;
use protocol::sine::SineMethod;
use protocol::skin::Skin;
use serde::Serialize;

/// Attachments, metadata and other topics of an MCAP recording. A recording that is still being read may hold more of
/// them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordingExtras {
    /// Topics that hold neither frames nor notes, in the order of their first messages.
    pub topics: Vec<Topic>,
    /// Frames that were sent before the recording began and were still latched by the cells then.
    pub latched: Vec<LatchedFrame>,
    /// Attachments by name. The largest are listed without their bytes.
    pub attachments: Vec<(String, Vec<u8>)>,
    /// Metadata records by name.
    pub metadata: Vec<(String, Vec<(String, String)>)>,
    /// A description of what is missing at the end of the file; `None` if the recording was finished.
    pub unfinished: Option<String>,
}

/// The name of the metadata record that holds the time of a run's first tick.
pub const RUN_METADATA: &str = "run";
/// The key of the first tick's time in [`RUN_METADATA`], in ns since 1970.
const BEGAN_KEY: &str = "began_ns";

/// The key of the cells' sine in [`RUN_METADATA`]: the name of a [`SineMethod`].
const SINE_KEY: &str = "sine";

/// Returns the contents of the metadata record [`RUN_METADATA`] for a first tick at `nanos` ns since 1970, and the sine
/// with which this build's cells compute.
#[must_use]
pub fn run_metadata(nanos: u64) -> BTreeMap<String, String> {
    let sine = SineMethod::default().name().to_owned();
    [(BEGAN_KEY.to_owned(), nanos.to_string()), (SINE_KEY.to_owned(), sine)].into()
}

/// Returns the time from `zero` to `nanos` in s, both given in ns since 1970. The result is negative if `nanos` is
/// earlier.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "to a nanosecond within three months")]
pub const fn seconds_since(zero: u64, nanos: u64) -> f64 {
    if nanos < zero { (zero - nanos) as f64 / -1e9 } else { (nanos - zero) as f64 / 1e9 }
}

/// The name of the metadata record that holds the properties of a run and of its buses.
const CONFIGURATION_METADATA: &str = "configuration";
/// Prefix of the key in [`CONFIGURATION_METADATA`] that states the time of a bus; the name of the bus follows.
const BUS_TIME_KEY_PREFIX: &str = "skinbus_bus_time/";
/// The value of such a key if frames take the time of their bits on the bus.
const REAL_BUS_TIME: &str = "real";

/// Returns the property that a recording has of a bus on which frames take the time of their bits.
#[must_use]
pub fn bus_time_property(bus: &str) -> (String, String) {
    (format!("{BUS_TIME_KEY_PREFIX}{bus}"), REAL_BUS_TIME.to_owned())
}

/// The name of the attachment that holds the skin of a recorded run.
pub const SKIN_ATTACHMENT: &str = "skin.toml";

impl RecordingExtras {
    /// An empty set of extras, for captures that have none.
    pub(super) const NONE: &Self = &Self {
        topics: Vec::new(),
        latched: Vec::new(),
        attachments: Vec::new(),
        metadata: Vec::new(),
        unfinished: None,
    };

    /// Returns the value of `key` in the metadata record `record`.
    #[must_use]
    pub fn metadata_value(&self, record: &str, key: &str) -> Option<&str> {
        let (_, facts) = self.metadata.iter().find(|(name, _)| name == record)?;
        facts.iter().find(|(name, _)| name == key).map(|(_, value)| value.as_str())
    }

    /// Returns the time of the run's first tick, in ns since 1970. Times that are given in seconds of the run count
    /// from it. If the recording does not store it, this is the time of the capture's first frame. For an input that
    /// can be read only once, such as a pipe, it is known only after the first frame has been read.
    #[must_use]
    pub fn run_began(&self) -> Option<u64> {
        self.metadata_value(RUN_METADATA, BEGAN_KEY)?.parse().ok()
    }

    /// Returns the name of the sine with which the recorded cells computed; `None` if the recording does not state it.
    #[must_use]
    pub fn sine_name(&self) -> Option<&str> {
        self.metadata_value(RUN_METADATA, SINE_KEY)
    }

    /// Returns the names of the buses on which frames took the time of their bits. The time stamps of their frames are
    /// the ends of the frames.
    pub fn timed_buses(&self) -> impl Iterator<Item = &str> {
        let run = self.metadata.iter().filter(|(name, _)| name == CONFIGURATION_METADATA);
        let timed = run.flat_map(|(_, facts)| facts).filter(|(_, value)| value == REAL_BUS_TIME);
        timed.filter_map(|(key, _)| key.strip_prefix(BUS_TIME_KEY_PREFIX))
    }

    /// Returns the attached skin; `None` if the recording has none.
    ///
    /// # Errors
    /// Returns [`DocumentError`] if this version cannot read the skin.
    #[must_use]
    pub fn skin(&self) -> Option<Result<Skin, DocumentError>> {
        let (_, text) = self.attachments.iter().find(|(name, _)| name == SKIN_ATTACHMENT)?;
        Some(Skin::parse_recorded(SKIN_ATTACHMENT, &String::from_utf8_lossy(text)))
    }
}

/// A frame that was sent before the recording began and that the cells still obey, such as a configuration.
#[derive(Clone, Debug, PartialEq)]
pub struct LatchedFrame {
    /// The bus of the frame.
    pub bus: String,
    /// True if the recorder's own program had sent the frame.
    pub own: bool,
    /// The frame.
    pub frame: Frame,
    /// The time of the frame on the bus, in ns since 1970.
    pub nanos: u64,
}

/// A topic that holds neither frames nor notes.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
pub struct Topic {
    /// The name of the topic.
    #[serde(rename = "topic")]
    pub name: String,
    /// The type of its messages.
    pub schema: String,
    /// The number of its messages.
    pub messages: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timed_buses_are_those_whose_time_is_real() {
        let facts =
            [("bus/can0", "real"), ("skinbus_bus_time/can0", "real"), ("skinbus_bus_time/can1", "no")];
        let facts = facts.map(|(key, value)| (key.to_owned(), value.to_owned())).to_vec();
        assert_eq!(bus_time_property("can0"), facts[1]);
        let of = |record: &str| {
            let metadata = vec![(record.to_owned(), facts.clone())];
            let extras = RecordingExtras { metadata, ..RecordingExtras::default() };
            extras.timed_buses().map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(of("configuration"), ["can0"]);
        assert_eq!(of("machine"), [""; 0]);
    }
}
