//! The lines of emulated cells: a thread for each bus, and in it one participant of the bus for each line.

use std::collections::BTreeMap;
use std::io::{PipeWriter, pipe};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

use protocol::bus::{Choice, Filter};
use vcan_setup::slcan::{Address, Bridge, LineOptions, Settings};

use super::EmulateError;

/// Lines of some buses, until this is dropped.
#[derive(Debug, Default)]
pub(super) struct Lines {
    buses: Vec<Bus>,
}

/// The lines of a bus.
#[derive(Debug)]
struct Bus {
    /// Its other end hangs up when this is closed, which ends the thread.
    stop: Option<PipeWriter>,
    thread: Option<JoinHandle<()>>,
}

/// Lines to be joined to buses.
#[derive(Debug, Default)]
pub(super) struct Planned {
    by_bus: BTreeMap<String, (Choice, Vec<LineOptions>)>,
}

impl Planned {
    /// Adds a line to a bus: its socket, and what passes to it.
    pub(super) fn add(&mut self, bus: &str, kind: Choice, socket: PathBuf, filters: Vec<Filter>) {
        let line = LineOptions { filters, ..LineOptions::new(Address::Unix(socket)) };
        self.by_bus.entry(bus.to_owned()).or_insert((kind, Vec::new())).1.push(line);
    }

    /// Joins them. Lines that are away, because their emulator is not there yet or again, are waited for.
    ///
    /// # Errors
    /// When a bus does not open or there is no thread.
    pub(super) fn join(self, directory: Option<&Path>) -> Result<Lines, EmulateError> {
        let mut lines = Lines::default();
        for (bus, (choice, options)) in self.by_bus {
            let settings = Settings { bus, choice, directory: directory.map(Path::to_owned), wait: true };
            let (stopped, stop) = pipe().map_err(EmulateError::Lines)?;
            let bridge = Bridge::open(settings, options)?;
            let work = move || {
                // A line goes away with its emulator, whose end is reported.
                drop(bridge.run(stopped, |_, _| {}));
            };
            let thread = std::thread::Builder::new().name("slcan".to_owned()).spawn(work);
            let thread = Some(thread.map_err(EmulateError::Lines)?);
            lines.buses.push(Bus { stop: Some(stop), thread });
        }
        Ok(lines)
    }
}

impl Drop for Bus {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
