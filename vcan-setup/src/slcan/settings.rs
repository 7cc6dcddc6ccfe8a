//! The settings that all lines of a bus share, and the opening of a line's client of the bus.

use std::path::PathBuf;
use std::time::Duration;

use protocol::bus::{Bus, BusError, BusOptions, Filter, KindChoice};

use super::options::LineOptions;

/// The bus to which the lines are connected, and how it is opened.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct BridgeSettings {
    /// The name of the bus.
    pub bus: String,
    /// The kind of the bus.
    pub choice: KindChoice,
    /// The directory of embedded buses; `None` for the default one.
    pub directory: Option<PathBuf>,
    /// True to begin even if lines are unavailable, and to open them later.
    pub wait: bool,
}

/// Opens the client by which a line takes part in the bus.
pub(super) fn open(settings: &BridgeSettings, line: &LineOptions) -> Result<Bus, BusError> {
    let filters = if line.filters.is_empty() { vec![Filter::ALL] } else { line.filters.clone() };
    let mut options = BusOptions {
        filters,
        send_timeout: Duration::ZERO,
        directory: settings.directory.clone(),
        ..BusOptions::default()
    };
    let open = |options: &BusOptions| Bus::open(&settings.bus, settings.choice, options)?.without_time();
    match open(&options) {
        Err(BusError::ClassicOnly { .. }) if line.classic => {
            options.fd = false;
            open(&options)
        }
        opened => opened,
    }
}
