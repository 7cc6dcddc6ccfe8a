//! The bus of some lines, and how the client of each line is opened.

use std::path::PathBuf;
use std::time::Duration;

use protocol::bus::{Bus, BusError, Choice, Filter, Options};

use super::options::LineOptions;

/// The bus of some lines.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Settings {
    /// Its name.
    pub bus: String,
    /// Its kind.
    pub choice: Choice,
    /// Where embedded buses live; `None` is the usual directory.
    pub directory: Option<PathBuf>,
    /// Begin without lines that are away, and open them when they are there.
    pub wait: bool,
}

/// Opens the client of a line.
pub(super) fn open(settings: &Settings, line: &LineOptions) -> Result<Bus, BusError> {
    let filters = if line.filters.is_empty() { vec![Filter::ALL] } else { line.filters.clone() };
    let mut options = Options {
        filters,
        send_timeout: Duration::ZERO,
        directory: settings.directory.clone(),
        ..Options::default()
    };
    let open = |options: &Options| Bus::open(&settings.bus, settings.choice, options);
    match open(&options) {
        Err(BusError::ClassicOnly { .. }) if line.classic => {
            options.fd = false;
            open(&options)
        }
        opened => opened,
    }
}
