//! slcan lines of emulated cells. One thread per bus joins the lines to it as participants.

use std::collections::BTreeMap;
use std::io::{PipeWriter, pipe};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

use protocol::bus::{Filter, KindChoice};
use vcan_setup::slcan::{Bridge, BridgeSettings, LineAddress, LineOptions};

use super::EmulateError;

/// Running slcan lines of emulated cells. Dropping this value ends their threads.
#[derive(Debug, Default)]
pub(super) struct SlcanLines {
    buses: Vec<LineThread>,
}

/// The thread that serves the slcan lines of one bus.
#[derive(Debug)]
struct LineThread {
    /// Write end of a pipe; closing it ends the thread.
    stop: Option<PipeWriter>,
    thread: Option<JoinHandle<()>>,
}

/// slcan lines that are yet to be joined to their buses.
#[derive(Debug, Default)]
pub(super) struct PlannedSlcanLines {
    by_bus: BTreeMap<String, (KindChoice, Vec<LineOptions>)>,
}

impl PlannedSlcanLines {
    /// Adds a line to a bus: its socket and the filters of its cell.
    pub(super) fn add_line(&mut self, bus: &str, kind: KindChoice, socket: PathBuf, filters: Vec<Filter>) {
        let line = LineOptions { filters, ..LineOptions::new(LineAddress::Unix(socket)) };
        self.by_bus.entry(bus.to_owned()).or_insert((kind, Vec::new())).1.push(line);
    }

    /// Joins the lines to their buses. Waits for lines whose emulator is not running yet.
    ///
    /// # Errors
    /// Returns [`EmulateError`] if a bus does not open or a thread cannot be started.
    pub(super) fn connect_to_buses(self, directory: Option<&Path>) -> Result<SlcanLines, EmulateError> {
        let mut lines = SlcanLines::default();
        for (bus, (choice, options)) in self.by_bus {
            let settings =
                BridgeSettings { bus, choice, directory: directory.map(Path::to_owned), wait: true };
            let (stopped, stop) = pipe().map_err(EmulateError::Lines)?;
            let bridge = Bridge::open(settings, options)?;
            let work = move || {
                // A line ends when its emulator exits, which is reported elsewhere.
                drop(bridge.run(stopped, |_, _| {}));
            };
            let thread = std::thread::Builder::new().name("slcan".to_owned()).spawn(work);
            let thread = Some(thread.map_err(EmulateError::Lines)?);
            lines.buses.push(LineThread { stop: Some(stop), thread });
        }
        Ok(lines)
    }
}

impl Drop for LineThread {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
