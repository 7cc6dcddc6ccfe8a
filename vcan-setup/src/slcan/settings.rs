//! The bus of the lines, and the opening of each line's client.

use std::path::PathBuf;
use std::time::Duration;

use protocol::bus::{Bus, BusError, KindChoice, Filter, BusOptions};

use super::options::LineOptions;

/// The bus of the lines.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct BridgeSettings {
    /// The name of the bus.
    pub bus: String,
    /// The kind of the bus.
    pub choice: KindChoice,
    /// The directory of embedded buses; `None` for the usual one.
    pub directory: Option<PathBuf>,
    /// True to begin without unavailable lines, and to open them later.
    pub wait: bool,
}

/// Opens the client of a line.
pub(super) fn open(settings: &BridgeSettings, line: &LineOptions) -> Result<Bus, BusError> {
    let filters = if line.filters.is_empty() { vec![Filter::ALL] } else { line.filters.clone() };
    let mut options = BusOptions {
        filters,
        send_timeout: Duration::ZERO,
        directory: settings.directory.clone(),
        ..BusOptions::default()
    };
    let open = |options: &BusOptions| Bus::open(&settings.bus, settings.choice, options);
    match open(&options) {
        Err(BusError::ClassicOnly { .. }) if line.classic => {
            options.fd = false;
            open(&options)
        }
        opened => opened,
    }
}
