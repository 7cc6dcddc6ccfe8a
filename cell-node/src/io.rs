//! The shell around the cells of a process: clock, bus, flash files. It decides nothing.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use protocol::bus::{Bus, BusError, Inbox};
use protocol::can::{Format, Frame};
use protocol::id::{CellId, Kind};
use protocol::packet;
use protocol::time::{Micros, Span};

use crate::flash::{self, FlashError, Kept};
use crate::node::{Flash, Identity, Node};

/// Waits while an interface is down before it is tried again.
const DOWN: Duration = Duration::from_millis(100);

/// From one comparison with the wall's clock to the next.
const MEASURE: Span = Span::from_millis(250);

/// Where a cell keeps its parameters; without a directory, in memory only.
#[derive(Debug)]
pub struct FlashFile {
    identity: Identity,
    path: Option<PathBuf>,
}

impl FlashFile {
    /// The file `BUS-NODE.flash` in a directory, or `BUS-sSERIAL.flash` of a cell that came without a number.
    #[must_use]
    pub fn new(directory: Option<&std::path::Path>, bus: &str, identity: Identity) -> Self {
        let name = identity.cell.map_or_else(|| format!("s{}", identity.serial), |cell| cell.to_string());
        let path = directory.map(|directory| directory.join(format!("{bus}-{name}.flash")));
        Self { identity, path }
    }

    /// What people call it: `flash of cell 12 (DIR/vcan0-12.flash)`.
    #[must_use]
    pub fn name(&self) -> String {
        let Identity { cell, serial } = self.identity;
        let cell = cell.map_or_else(|| format!("with serial number {serial}"), |cell| cell.to_string());
        self.path.as_ref().map_or_else(
            || format!("flash of cell {cell}"),
            |path| format!("flash of cell {cell} ({})", path.display()),
        )
    }

    /// What it holds: a number, and parameters. What is there but not sound is damaged; why is the last value.
    ///
    /// # Errors
    /// When the file is there and cannot be read.
    pub fn load(&self) -> io::Result<(Option<CellId>, Flash, Option<FlashError>)> {
        let Some(path) = &self.path else { return Ok((None, Flash::Empty, None)) };
        let bytes = match fs::read(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((None, Flash::Empty, None)),
            Err(error) => return Err(error),
        };
        Ok(match flash::decode(self.identity, &bytes) {
            Ok(kept) => (kept.number, kept.parameters.map_or(Flash::Empty, Flash::Sound), None),
            Err(error) => (None, Flash::Damaged, Some(error)),
        })
    }

    /// Keeps a number and parameters: a whole new file takes the old one's place, or nothing changes.
    ///
    /// # Errors
    /// When the disk will not have it.
    pub fn store(&self, kept: &Kept) -> io::Result<()> {
        let Some(path) = &self.path else { return Ok(()) };
        let part = path.with_extension("flash.part");
        let store = || {
            let mut file = File::create(&part)?;
            file.write_all(&flash::encode(self.identity.serial, kept))?;
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
    /// Where a number stands in `cells`.
    places: [Option<u8>; 256],
    format: Format,
    clock: Clock,
    outbox: Vec<Frame>,
}

/// A monotonic clock, and how the wall's time is had from it without asking twice.
#[derive(Debug)]
struct Clock {
    start: Instant,
    /// The wall's time at the start, in µs since 1970; measured again now and then, because somebody may set
    /// the wall's clock.
    wall: u64,
    /// When it was measured.
    measured: Micros,
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
        let (cells, outbox) = (Vec::new(), Vec::new());
        let mut clock = Clock { start: Instant::now(), wall: 0, measured: Micros(0) };
        clock.set(Micros(0));
        Self { cells, places: [None; 256], format, clock, outbox }
    }

    /// Starts a cell with what flash holds; a simulated cell has no sensors, so it obeys stimuli.
    pub fn start(&mut self, identity: Identity, flash: &Flash, file: FlashFile) {
        if let Some(place) = identity.cell.and_then(|cell| self.places.get_mut(usize::from(cell.get()))) {
            *place = u8::try_from(self.cells.len()).ok();
        }
        let node = Node::new(identity, self.format, flash, true, self.clock.now());
        self.cells.push((node, file));
    }

    /// Runs the cells until the bus is gone or a number turns out to be taken.
    ///
    /// # Errors
    /// Always: it only ends by stopping.
    pub fn run(&mut self, bus: &Bus) -> Result<core::convert::Infallible, Stopped> {
        let mut inbox = Inbox::new();
        let mut now = self.clock.now();
        loop {
            match self.turn(bus, &mut inbox, now) {
                Ok(()) => {}
                // What was to be sent is lost, as on a microcontroller without a bus.
                Err(Stopped::Bus(error)) if error.may_pass() => {
                    self.outbox.clear();
                    std::thread::sleep(DOWN);
                }
                Err(error) => return Err(error),
            }
            now = self.clock.now();
            self.take(&inbox, bus, now)?;
        }
    }

    /// Lets time pass, sends, and waits for frames.
    fn turn(&mut self, bus: &Bus, inbox: &mut Inbox, now: Micros) -> Result<(), Stopped> {
        inbox.clear();
        let mut next = Micros(u64::MAX);
        for (node, file) in &mut self.cells {
            if node.poll_timeout() <= now {
                node.handle_timeout(now);
                collect(node, file, self.format, &mut self.outbox);
            }
            next = next.min(node.poll_timeout());
        }
        if now.since(self.clock.measured) >= MEASURE {
            self.clock.set(now);
        }
        self.flush(bus)?;
        let wait = Duration::from_micros(next.since(now).0);
        if wait >= Bus::PATIENCE {
            bus.receive_one_patiently(inbox)?;
        } else if bus.wait(Some(wait))? {
            bus.receive(inbox)?;
        }
        Ok(())
    }

    /// Gives each frame to the cells that may hear it, and takes at once what they say to it.
    fn take(&mut self, inbox: &Inbox, bus: &Bus, now: Micros) -> Result<(), Stopped> {
        for received in inbox.frames() {
            let age = self.clock.age(now, received.at_nanos);
            // Anything else than one of our packets goes to all: each counts what it cannot use.
            let id = packet::data_id(&received.frame).ok().filter(|id| id.kind != Kind::Command);
            let one = id.and_then(|id| *self.places.get(usize::from(id.node))?);
            let hearers = match one {
                Some(place) => self.cells.get_mut(usize::from(place)..=usize::from(place)),
                None => self.cells.get_mut(..),
            };
            for (node, file) in hearers.unwrap_or_default() {
                node.handle_frame(now, age, &received.frame);
                if let Some(serial) = node.taken() {
                    let (bus, cell) = (bus.name().to_owned(), node.identity().cell.map_or(0, CellId::get));
                    return Err(Stopped::Taken { bus, cell, serial });
                }
                collect(node, file, self.format, &mut self.outbox);
            }
        }
        Ok(())
    }

    /// Sends what is to be sent.
    fn flush(&mut self, bus: &Bus) -> Result<(), Stopped> {
        if !self.outbox.is_empty() {
            bus.send(&self.outbox).map_err(|error| error.cause)?;
            self.outbox.clear();
        }
        Ok(())
    }
}

/// Writes what a cell has for flash, and takes what it has to send.
fn collect(node: &mut Node, file: &FlashFile, format: Format, outbox: &mut Vec<Frame>) {
    if let Some(kept) = node.poll_store() {
        node.handle_stored(file.store(&kept).is_ok());
    }
    while let Some(packet) = node.poll_transmit() {
        outbox.extend(packet.frames(format));
    }
}

impl Clock {
    fn now(&self) -> Micros {
        Micros(u64::try_from(self.start.elapsed().as_micros()).unwrap_or(u64::MAX))
    }

    /// Compares itself with the wall's clock.
    fn set(&mut self, now: Micros) {
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_micros();
        self.wall = u64::try_from(wall).unwrap_or(0).saturating_sub(self.now().0);
        self.measured = now;
    }

    /// How long before `now` a wall's time in ns was.
    const fn age(&self, now: Micros, at_nanos: u64) -> Span {
        Span((self.wall + now.0).saturating_sub(at_nanos / 1_000))
    }
}
