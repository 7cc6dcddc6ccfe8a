//! slcan lines of emulated cells: one thread per bus, in which each line is a participant of the bus.

use std::collections::BTreeMap;
use std::io::{PipeWriter, pipe};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

use protocol::bus::{Choice, Filter};
use vcan_setup::slcan::{Address, Bridge, LineOptions, Settings};

use super::EmulateError;

/// The lines of some buses; dropping it ends them.
#[derive(Debug, Default)]
pub(super) struct Lines {
    buses: Vec<Bus>,
}

/// The thread that serves the lines of a bus.
#[derive(Debug)]
struct Bus {
    /// Closing this end of the pipe ends the thread.
    stop: Option<PipeWriter>,
    thread: Option<JoinHandle<()>>,
}

/// Lines to be joined to buses.
#[derive(Debug, Default)]
pub(super) struct Planned {
    by_bus: BTreeMap<String, (Choice, Vec<LineOptions>)>,
}

impl Planned {
    /// Adds a line to a bus: its socket and the filters of its cell.
    pub(super) fn add(&mut self, bus: &str, kind: Choice, socket: PathBuf, filters: Vec<Filter>) {
        let line = LineOptions { filters, ..LineOptions::new(Address::Unix(socket)) };
        self.by_bus.entry(bus.to_owned()).or_insert((kind, Vec::new())).1.push(line);
    }

    /// Joins the lines to their buses. Waits for lines whose emulator is not running yet.
    ///
    /// # Errors
    /// Returns [`EmulateError`] if a bus does not open or a thread cannot be started.
    pub(super) fn join(self, directory: Option<&Path>) -> Result<Lines, EmulateError> {
        let mut lines = Lines::default();
        for (bus, (choice, options)) in self.by_bus {
            let settings = Settings { bus, choice, directory: directory.map(Path::to_owned), wait: true };
            let (stopped, stop) = pipe().map_err(EmulateError::Lines)?;
            let bridge = Bridge::open(settings, options)?;
            let work = move || {
                // A line ends with its emulator, whose exit is reported elsewhere.
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
