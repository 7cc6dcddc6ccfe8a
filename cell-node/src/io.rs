//! The shell around the cells of a process: clock, bus, flash files. It decides nothing.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use protocol::bus::{Bus, BusError, Inbox};
use protocol::can::{Format, Frame};
use protocol::parameters::Parameters;
use protocol::time::{Micros, Span};

use crate::flash::{self, FlashError};
use crate::node::{Flash, Identity, Node};

/// Waits while an interface is down before it is tried again.
const DOWN: Duration = Duration::from_millis(100);

/// Where a cell keeps its parameters; without a directory, in memory only.
#[derive(Debug)]
pub struct FlashFile {
    identity: Identity,
    path: Option<PathBuf>,
}

impl FlashFile {
    /// The file `BUS-NODE.flash` in a directory.
    #[must_use]
    pub fn new(directory: Option<&std::path::Path>, bus: &str, identity: Identity) -> Self {
        let path = directory.map(|directory| directory.join(format!("{bus}-{}.flash", identity.cell)));
        Self { identity, path }
    }

    /// What people call it: `flash of cell 12 (DIR/vcan0-12.flash)`.
    #[must_use]
    pub fn name(&self) -> String {
        let cell = self.identity.cell;
        self.path.as_ref().map_or_else(
            || format!("flash of cell {cell}"),
            |path| format!("flash of cell {cell} ({})", path.display()),
        )
    }

    /// What it holds. What is there but not sound is damaged; why is the second value.
    ///
    /// # Errors
    /// When the file is there and cannot be read.
    pub fn load(&self) -> io::Result<(Flash, Option<FlashError>)> {
        let Some(path) = &self.path else { return Ok((Flash::Empty, None)) };
        let bytes = match fs::read(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((Flash::Empty, None)),
            Err(error) => return Err(error),
        };
        Ok(match flash::decode(self.identity, &bytes) {
            Ok(parameters) => (Flash::Sound(parameters), None),
            Err(error) => (Flash::Damaged, Some(error)),
        })
    }

    /// Keeps parameters: a whole new file takes the old one's place, or nothing changes.
    ///
    /// # Errors
    /// When the disk will not have it.
    pub fn store(&self, parameters: &Parameters) -> io::Result<()> {
        let Some(path) = &self.path else { return Ok(()) };
        let part = path.with_extension("flash.part");
        let store = || {
            let mut file = File::create(&part)?;
            file.write_all(&flash::encode(self.identity, parameters))?;
            file.sync_all()?;
            fs::rename(&part, path)
        };
        let stored = store();
        if stored.is_err() {
            // It may not even have been made.
            let _ = fs::remove_file(&part);
        }
        stored
    }
}

/// Some cells that share a process and a socket.
#[derive(Debug)]
pub struct Cells {
    cells: Vec<(Node, FlashFile)>,
    /// Which cells hear an identifier, as indices.
    hearers: HashMap<u32, Vec<usize>>,
    format: Format,
    start: Instant,
    outbox: Vec<Frame>,
}

/// Why cells stop.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Stopped {
    /// Another cell has a number.
    #[error(
        "cell {cell} is on {bus} already, with serial number {serial}: stop that one or give this one another number"
    )]
    Taken {
        /// The bus.
        bus: String,
        /// The number.
        cell: u8,
        /// Who has it.
        serial: u32,
    },
    /// The bus is gone.
    #[error(transparent)]
    Bus(#[from] BusError),
}

impl Cells {
    /// No cells yet, on a bus of this format.
    #[must_use]
    pub fn new(format: Format) -> Self {
        let (cells, hearers, outbox) = (Vec::new(), HashMap::new(), Vec::new());
        Self { cells, hearers, format, start: Instant::now(), outbox }
    }

    /// Starts a cell with what flash holds; a simulated cell has no sensors, so it obeys stimuli.
    pub fn start(&mut self, identity: Identity, flash: &Flash, file: FlashFile) {
        let index = self.cells.len();
        for id in identity.hears() {
            self.hearers.entry(u32::from(id.to_bits())).or_default().push(index);
        }
        self.cells.push((Node::new(identity, self.format, flash, true, self.now()), file));
    }

    /// Runs the cells until the bus is gone or a number turns out to be taken.
    ///
    /// # Errors
    /// Always: it only ends by stopping.
    pub fn run(&mut self, bus: &Bus) -> Result<core::convert::Infallible, Stopped> {
        let mut inbox = Inbox::new();
        loop {
            match self.turn(bus, &mut inbox) {
                Ok(()) => {}
                // What was to be sent is lost, as on a microcontroller without a bus.
                Err(Stopped::Bus(error)) if error.may_pass() => {
                    self.outbox.clear();
                    std::thread::sleep(DOWN);
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Lets time pass, sends, waits, and takes what came.
    fn turn(&mut self, bus: &Bus, inbox: &mut Inbox) -> Result<(), Stopped> {
        let now = self.now();
        let mut next = Micros(u64::MAX);
        for (node, _) in &mut self.cells {
            if node.poll_timeout() <= now {
                node.handle_timeout(now);
            }
            next = next.min(node.poll_timeout());
        }
        self.flush(bus)?;
        let wait = Duration::from_micros(next.since(now).0);
        let count = if wait >= Bus::PATIENCE {
            bus.receive_patiently(inbox)?
        } else if bus.wait(Some(wait))? {
            bus.receive(inbox)?
        } else {
            0
        };
        if count == 0 {
            return Ok(());
        }
        let (now, wall) = (self.now(), wall_nanos());
        for received in inbox.frames() {
            let age = Span(wall.saturating_sub(received.at_nanos) / 1_000);
            let hearers = self.hearers.get(&received.frame.raw_id()).map_or(&[][..], Vec::as_slice);
            for &index in hearers {
                let Some((node, _)) = self.cells.get_mut(index) else { continue };
                node.handle_frame(now, age, &received.frame);
                if let Some(serial) = node.taken() {
                    let (bus, cell) = (bus.name().to_owned(), node.identity().cell.get());
                    return Err(Stopped::Taken { bus, cell, serial });
                }
            }
        }
        self.flush(bus)
    }

    /// Writes what has to go into flash, and sends what is to be sent.
    fn flush(&mut self, bus: &Bus) -> Result<(), Stopped> {
        for (node, file) in &mut self.cells {
            if let Some(parameters) = node.poll_store() {
                node.handle_stored(file.store(&parameters).is_ok());
            }
            while let Some(packet) = node.poll_transmit() {
                self.outbox.extend(packet.frames(self.format));
            }
        }
        if !self.outbox.is_empty() {
            bus.send(&self.outbox).map_err(|error| error.cause)?;
            self.outbox.clear();
        }
        Ok(())
    }

    fn now(&self) -> Micros {
        Micros(u64::try_from(self.start.elapsed().as_micros()).unwrap_or(u64::MAX))
    }
}

fn wall_nanos() -> u64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |time| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX))
}
