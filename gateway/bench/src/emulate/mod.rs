//! Emulated cells, which run the machine code of a microcontroller: one emulator each, wired to the bus by slcan.
//!
//! ```text
//!   bus <── client with the cell's filters ── slcan line (UNIX socket) ──> UART of qemu-system-arm -M microbit
//!                                                                           └─ flash: a file, by semihosting
//! ```

mod firmware;
mod line;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use model::commission::{CommissionOptions, Outcome};
use protocol::bus::{Filter, KindChoices};
use protocol::factory::FactoryRecord;
use protocol::id::{Id, Kind, Node};
use protocol::skin::{Cell, Skin, SkinReply};
use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;
use tempfile::TempDir;
use thiserror::Error;
use vcan_setup::slcan::BridgeError;

use crate::commission;
use crate::processes::{LaunchError, Processes, START_TIMEOUT};
use crate::setup::Timeout;

pub use firmware::{Firmware, FirmwareError};
use line::{PlannedSlcanLines, SlcanLines};

/// Name of the emulator's program.
const QEMU: &str = "qemu-system-arm";

/// The cells to emulate.
#[derive(Clone, Debug)]
pub struct EmulatedCells {
    /// Path of the firmware's file.
    pub firmware: PathBuf,
    /// Indices into the skin's cells.
    pub cells: Vec<usize>,
}

/// An error that keeps cells from being emulated.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EmulateError {
    /// The firmware file is not usable.
    #[error(transparent)]
    Firmware(#[from] FirmwareError),
    /// The emulator is not installed.
    #[error("--emulate needs {QEMU}, which is not in PATH: run `apt-get install {QEMU}`")]
    NoEmulator,
    /// Files cannot be written.
    #[error("cannot write the files of emulated cells: {0}; set TMPDIR to a directory with free space")]
    Files(#[source] std::io::Error),
    /// The path contains characters that the emulator's command line cannot carry, or is too long.
    #[error("--flash {0}: with --emulate, the path must be UTF-8 without spaces and at most 240 bytes long")]
    Path(PathBuf),
    /// Cells of another run keep their flash in this directory.
    #[error(
        "--flash {0}: emulated cells of another run are using this directory: stop that run first, or choose another \
         directory"
    )]
    FlashInUse(PathBuf),
    /// A line or a process does not start.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// Lines cannot be joined to a bus.
    #[error(transparent)]
    Bridge(#[from] BridgeError),
    /// The system grants no thread or no pipe.
    #[error("cannot set up the serial lines of emulated cells: {0}")]
    Lines(#[source] std::io::Error),
    /// A bus does not open.
    #[error(transparent)]
    Bus(#[from] protocol::bus::BusError),
    /// A cell was not commissioned.
    #[error("the emulated {cell} was not commissioned: it {why}")]
    NotCommissioned {
        /// Name of the cell and its bus.
        cell: String,
        /// Cause.
        why: String,
    },
    /// Commissioning did not finish.
    #[error("emulated cells were not commissioned: {0}")]
    Commission(String),
    /// An emulator ended.
    #[error("the emulator of {cells} ended before its cell was commissioned ({how})")]
    Ended {
        /// Names of the cells and their bus.
        cells: String,
        /// Exit status or reason.
        how: String,
    },
    /// A signal interrupted the start.
    #[error("the run was interrupted while it was starting")]
    Interrupted,
}

impl EmulateError {
    /// Exit code: 2 for wrong use or configuration, 1 for cells that failed.
    #[must_use]
    pub const fn exit_code(&self) -> u8 {
        match self {
            Self::Firmware(_)
            | Self::NoEmulator
            | Self::Files(_)
            | Self::Path(_)
            | Self::FlashInUse(_)
            | Self::Launch(_)
            | Self::Bridge(_)
            | Self::Bus(_) => 2,
            Self::Lines(_)
            | Self::NotCommissioned { .. }
            | Self::Commission(_)
            | Self::Ended { .. }
            | Self::Interrupted => 1,
        }
    }
}

/// A firmware, and the emulator for it.
#[derive(Debug)]
pub(crate) struct Emulator<'a> {
    firmware: Firmware,
    qemu: PathBuf,
    cells: &'a [usize],
}

/// Files and slcan lines of emulated cells. End the cells' processes before dropping this value, because they use both.
#[derive(Debug)]
pub(crate) struct Emulation {
    /// Dropped first, so that the slcan lines are closed before their sockets are removed.
    _lines: SlcanLines,
    _files: TempDir,
    /// The open file holds the lock on the directory of flash files.
    _flash: Option<File>,
}

/// Settings that all emulated cells share.
#[derive(Clone, Copy, Debug)]
pub(crate) struct EmulationSetup<'a> {
    pub(crate) skin: &'a Skin,
    pub(crate) kinds: &'a KindChoices,
    pub(crate) directory: Option<&'a Path>,
    pub(crate) flash: Option<&'a Path>,
}

impl<'a> Emulator<'a> {
    /// Reads the firmware and finds the emulator in `PATH`.
    ///
    /// # Errors
    /// Returns [`EmulateError`] if either is missing.
    pub(crate) fn new(emulated: &'a EmulatedCells) -> Result<Self, EmulateError> {
        let firmware = Firmware::read(&emulated.firmware)?;
        let path = std::env::var_os("PATH").unwrap_or_default();
        let qemu = std::env::split_paths(&path).map(|folder| folder.join(QEMU)).find(|path| path.is_file());
        Ok(Self { firmware, qemu: qemu.ok_or(EmulateError::NoEmulator)?, cells: &emulated.cells })
    }

    /// Starts an emulator for each cell, adds it to the other processes, and joins it to its bus, which must exist.
    ///
    /// # Errors
    /// Returns [`EmulateError`] if an emulator or its slcan line does not start.
    pub(crate) fn start(
        &self,
        bench: &EmulationSetup<'_>,
        processes: &mut Processes,
    ) -> Result<Emulation, EmulateError> {
        let files =
            tempfile::Builder::new().prefix("skinbus-cells-").tempdir().map_err(EmulateError::Files)?;
        let _flash = bench.flash.map(lock_directory).transpose()?;
        let mut planned = PlannedSlcanLines::default();
        for cell in self.cells.iter().filter_map(|&cell| bench.skin.cells.get(cell)) {
            let place = CellFiles::for_cell(bench, files.path(), cell)?;
            let factory = factory_record(bench.skin, cell);
            fs::write(&place.program, self.firmware.image_for_cell(&factory)).map_err(EmulateError::Files)?;
            let log = File::create(&place.log).map_err(EmulateError::Files)?;
            let name = bench.skin.buses.get(cell.bus).map_or("", |bus| bus.name.as_str());
            processes.start_emulator(cell, name, self.emulator_command(&place, log), &place.log)?;
            planned.add_line(name, bench.kinds.kind_of(name), place.socket, cell_filters(cell, &factory));
        }
        let _lines = planned.connect_to_buses(bench.directory)?;
        Ok(Emulation { _lines, _files: files, _flash })
    }

    /// Returns the command that starts an emulator. The emulator then waits for its slcan line.
    fn emulator_command(&self, place: &CellFiles, log: File) -> Command {
        let mut command = Command::new(&self.qemu);
        command.args(["-M", "microbit", "-display", "none", "-monitor", "none", "-serial", "chardev:line"]);
        let socket = place.socket.display();
        command.arg("-chardev").arg(format!("socket,id=line,path={socket},server=on,wait=on"));
        let flash = place.flash.replace(',', ",,");
        command.arg("-semihosting-config").arg(format!("enable=on,target=native,arg={flash}"));
        command.arg("-kernel").arg(&place.program);
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
        command
    }

    /// Commissions the emulated cells like real ones. They must be the only cells on their buses.
    ///
    /// # Errors
    /// Returns [`EmulateError`] if a cell refuses its parameters or an emulator ends.
    pub(crate) fn commission(
        &self,
        bench: &EmulationSetup<'_>,
        processes: &mut Processes,
        signalled: &AtomicBool,
    ) -> Result<String, EmulateError> {
        let began = Instant::now();
        let mut skin = bench.skin.clone();
        skin.cells = self.cells.iter().filter_map(|&cell| bench.skin.cells.get(cell).cloned()).collect();
        // The cells already have node ids, so no walk over wires must assign them.
        skin.buses.iter_mut().for_each(|bus| bus.reply = SkinReply::Torque);
        let mut buses: Vec<_> = skin.cells.iter().map(|cell| cell.bus).collect();
        buses.sort_unstable();
        buses.dedup();
        let benches = buses.into_iter().map(|bus| commission::open(&skin, bus, bench.kinds));
        let benches = benches.collect::<Result<Vec<_>, _>>()?;
        let stop = AtomicBool::new(false);
        let (mut ended, mut timeout, mut is_over) = (None, Timeout::new(START_TIMEOUT), false);
        let wish = CommissionOptions { dry_run: false, verify: false };
        let done = commission::commission(benches, &skin, wish, &stop, |far| {
            ended = ended.take().or_else(|| processes.take_ended().into_iter().next());
            // The timeout also ends the commissioning of a cell that restarts again and again.
            is_over |= timeout.has_stalled(far.iter().map(|far| far.found + far.done).sum());
            if ended.is_some() || is_over || signalled.load(Ordering::Relaxed) {
                stop.store(true, Ordering::Relaxed);
            }
        });
        if signalled.load(Ordering::Relaxed) {
            return Err(EmulateError::Interrupted);
        }
        if let Some(ended) = ended {
            return Err(EmulateError::Ended { cells: ended.to_string(), how: ended.status_text() });
        }
        for done in &done {
            if let Some(failure) = &done.failure {
                return Err(EmulateError::Commission(failure.clone()));
            }
            let failed = done.report.cells.iter().find_map(|cell| match cell.outcome {
                Outcome::Failed(why) => Some((cell.described, why)),
                Outcome::Written | Outcome::AlreadySo | Outcome::Verified | Outcome::WouldWrite => None,
            });
            if let Some((node, why)) = failed {
                let cell = format!("cell {node} on {}", done.name);
                return Err(EmulateError::NotCommissioned { cell, why: why.to_string() });
            }
        }
        let cells: Vec<_> = skin.cells.iter().map(|cell| cell.node.to_string()).collect();
        let (s, cells) = (if cells.len() == 1 { "" } else { "s" }, cells.join(", "));
        let took = began.elapsed().as_secs_f64();
        Ok(format!("cell{s} {cells} emulated by {}, commissioned in {took:.1} s", self.qemu.display()))
    }
}

/// Paths of the files of one emulated cell.
struct CellFiles {
    program: PathBuf,
    socket: PathBuf,
    log: PathBuf,
    flash: String,
}

impl CellFiles {
    fn for_cell(bench: &EmulationSetup<'_>, files: &Path, cell: &Cell) -> Result<Self, EmulateError> {
        let bus = bench.skin.buses.get(cell.bus).map_or("", |bus| bus.name.as_str());
        let name = format!("{bus}-{}", cell.node);
        let flash = bench.flash.unwrap_or(files);
        let invalid_path = || EmulateError::Path(flash.to_owned());
        let flash = fs::canonicalize(flash).map_err(EmulateError::Files)?.join(format!("{name}.flash"));
        let flash = flash
            .to_str()
            .filter(|path| path.len() <= 240 && !path.contains(' '))
            .ok_or_else(invalid_path)?;
        Ok(Self {
            program: files.join(format!("{name}.elf")),
            socket: files.join(format!("{name}.sock")),
            log: files.join(format!("{name}.log")),
            flash: flash.to_owned(),
        })
    }
}

/// Opens a directory of flash files and locks it. On a file system without locks, the directory stays unlocked.
fn lock_directory(directory: &Path) -> Result<File, EmulateError> {
    let opened = File::open(directory).map_err(EmulateError::Files)?;
    match flock(&opened, FlockOperation::NonBlockingLockExclusive) {
        Err(Errno::WOULDBLOCK) => Err(EmulateError::FlashInUse(directory.to_owned())),
        _ => Ok(opened),
    }
}

/// The record that the factory would write into a cell.
fn factory_record(skin: &Skin, cell: &Cell) -> FactoryRecord {
    let bus = skin.buses.get(cell.bus);
    let sums = bus.is_some_and(|bus| bus.reply != SkinReply::Torque);
    FactoryRecord {
        node: Some(cell.node),
        serial: cell.serial,
        format: bus.map_or(protocol::can::Format::Fd, |bus| bus.format),
        hosted: true,
        link_ids: if sums { skin.wires(cell.bus).link_ids_of(cell.node) } else { Default::default() },
    }
}

/// The filters of a cell's CAN controller: its own identifiers, frames on its simulated wires, and the sums of the
/// cells at their other ends.
fn cell_filters(cell: &Cell, &FactoryRecord { link_ids, .. }: &FactoryRecord) -> Vec<Filter> {
    let mut filters: Vec<_> = Id::ids_received_by_cell(cell.node).map(Filter::exact).into();
    if link_ids.iter().any(Option::is_some) {
        filters.extend(link_ids.into_iter().flatten().map(|link_id| Filter::for_link(link_id.reversed())));
        let sums = cell.neighbors.iter().flatten().map(|neighbor| Id::new(Kind::Sum, Node::Cell(*neighbor)));
        filters.extend(sums.map(Filter::exact));
    }
    filters
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_of_flash_files_is_of_one_run() {
        let folder = tempfile::tempdir().unwrap();
        let held = lock_directory(folder.path()).unwrap();
        let error = lock_directory(folder.path()).unwrap_err();
        assert!(error.to_string().contains("emulated cells of another run are using this"), "{error}");
        assert_eq!(error.exit_code(), 2);
        drop(held);
        lock_directory(folder.path()).unwrap();
    }
}
