//! Errors that end a run early.

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitStatus;

use model::scenario::{FaultKind, Scenario};
use protocol::bus::{BusError, BusKind};
use protocol::document::DocumentError;
use protocol::skin::Skin;
use protocol::time::Span;
use thiserror::Error;
use trace::files::is_disk_full;

use crate::bus::served::ServeError;
use crate::bus::time::BusTimeError;
use crate::emulate::EmulateError;
use crate::processes::{LaunchError, MemoryFileError};
use crate::record::OutputError;
use crate::run::TreeTooDeep;
use crate::signals::SignalError;
use crate::threads::ThreadError;
use control::external::SocketError;

/// Hint on how to separate benches that use embedded buses of the same name.
const OTHER_DIRECTORY_HINT: &str = "set SKINBUS_DIR to another directory for this run";

/// An error that ended a run early.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// A file has an invalid value.
    #[error(transparent)]
    Document(#[from] DocumentError),
    /// A bus does not open.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A program does not start.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// Frames do not take time on a bus, though they must.
    #[error(transparent)]
    Time(#[from] BusTimeError),
    /// The recording cannot be created.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// The socket for an external controller cannot be opened.
    #[error("{0}{cause}", cause = .0.source().map(|cause| format!(": {cause}")).unwrap_or_default())]
    Controller(#[from] SocketError),
    /// The tree of cells is too deep for their slots.
    #[error(transparent)]
    TooDeep(#[from] TreeTooDeep),
    /// The directory for the cells' parameters cannot be used.
    #[error("--flash {}: this directory does not exist; create it first", .0.display())]
    NoFlash(PathBuf),
    /// A scenario asks for a fault that only a simulated bus can make.
    #[error(
        "the fault {kind:?} of {bus} at {at_s} s works only in virtual time; a run with processes supports \
         kill, stop, continue, restart, link_down, link_up, stuck and drift"
    )]
    BusFault {
        /// Kind of the fault, as in the file.
        kind: &'static str,
        /// Name of the bus.
        bus: String,
        /// Time of the fault in s.
        at_s: f64,
    },
    /// Simulated wires must not be used on a real bus.
    #[error(
        "{0} is real hardware, but cells that answer with sums simulate their wires with frames that must not be sent \
         there: use a vcan or the embedded bus, or set reply = \"torque\" in the skin"
    )]
    RealWires(String),
    /// Signals cannot be caught.
    #[error(transparent)]
    Signal(#[from] SignalError),
    /// A signal ended the run before it began.
    #[error("the run was interrupted while it was starting")]
    Interrupted,
    /// The system grants no thread.
    #[error(transparent)]
    Thread(#[from] ThreadError),
    /// The system grants no file in memory.
    #[error(transparent)]
    Memory(#[from] MemoryFileError),
    /// A bus was lost.
    #[error(transparent)]
    Lost(BusError),
    /// Another gateway is on a bus.
    #[error("{}", other_gateway(.0.as_ref()))]
    OtherGateway(Option<(String, BusKind)>),
    /// Other cells are on a bus on which cells were to be started.
    #[error(
        "these cells are already on the bus: {cells}; use them with --no-spawn, {}",
        if *.embedded { format!("stop them, or {OTHER_DIRECTORY_HINT}") } else { "or stop them".to_owned() }
    )]
    CellsPresent {
        /// The cells found.
        cells: String,
        /// True if the bus is embedded.
        embedded: bool,
    },
    /// Cells have no parameters.
    #[error(
        "these cells have no parameters: {0}; write the parameters with `skinbus commission`, or delete the cells' \
         flash files if these are damaged"
    )]
    Unconfigured(String),
    /// Cells do not answer.
    #[error(
        "these cells are not ready: {cells}; {}",
        if *.spawned { "see their own messages above" } else { "start them with cell-node, or omit --no-spawn" }
    )]
    NotReady {
        /// The cells.
        cells: String,
        /// True if this run started the cells.
        spawned: bool,
    },
    /// Cells are configured for another skin.
    #[error(
        "these cells are not configured for {}: {cells}; configure them with `skinbus commission`, or \
         delete their flash files",
        .skin.display()
    )]
    OtherSkin {
        /// Path of the skin's file.
        skin: PathBuf,
        /// The cells.
        cells: String,
    },
    /// The process of a cell ended too early.
    #[error(
        "the process of {cells} ended while it was starting ({status}){}",
        reason_suffix(.said.as_deref())
    )]
    Ended {
        /// The cells of the process.
        cells: String,
        /// Exit status of the process.
        status: ExitStatus,
        /// Reason that the process gave, if any.
        said: Option<String>,
    },
    /// Cells cannot be emulated.
    #[error(transparent)]
    Emulate(#[from] EmulateError),
    /// The network differs from its description and cannot carry sums.
    #[error("{0}")]
    BrokenTree(String),
    /// Cells do not answer with sums.
    #[error("these cells did not switch to sums (parameter 6): {0}; install firmware that supports sums")]
    NoSums(String),
    /// A thread panicked.
    #[error("the {0} crashed (a bug): please report it")]
    Panicked(&'static str),
    /// A receiver ended.
    #[error("a receiver thread crashed (a bug): please report it")]
    ReceiverEnded,
}

impl RunError {
    /// Returns the error for the first bus fault in a scenario, if any.
    #[must_use]
    pub fn bus_fault(scenario: &Scenario, skin: &Skin) -> Option<Self> {
        scenario.faults.iter().find_map(|fault| match &fault.kind {
            FaultKind::Bus { bus, .. } => Some(Self::BusFault {
                kind: fault.kind.name(),
                bus: skin.buses.get(*bus)?.name.clone(),
                at_s: Span(fault.at.0).seconds(),
            }),
            FaultKind::Process { .. } | FaultKind::Sensor { .. } | FaultKind::Wire { .. } => None,
        })
    }

    /// Exit code: 2 for wrong use or configuration, 1 for a run that failed.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Emulate(error) => error.exit_code(),
            Self::Output(OutputError::Candump { source, .. } | OutputError::Mcap { source, .. })
                if is_disk_full(source) =>
            {
                1
            }
            Self::Document(_)
            | Self::Bus(_)
            | Self::Launch(_)
            | Self::Output(_)
            | Self::Controller(_)
            | Self::TooDeep(_)
            | Self::NoFlash(_)
            | Self::BusFault { .. }
            | Self::Time(_)
            | Self::RealWires(_) => 2,
            Self::Signal(_)
            | Self::Interrupted
            | Self::Thread(_)
            | Self::Memory(_)
            | Self::Lost(_)
            | Self::OtherGateway(_)
            | Self::CellsPresent { .. }
            | Self::Unconfigured(_)
            | Self::NotReady { .. }
            | Self::OtherSkin { .. }
            | Self::Ended { .. }
            | Self::BrokenTree(_)
            | Self::NoSums(_)
            | Self::Panicked(_)
            | Self::ReceiverEnded => 1,
        }
    }
}

impl From<ServeError> for RunError {
    fn from(error: ServeError) -> Self {
        match error {
            ServeError::Bus(error) => Self::Bus(error),
            ServeError::Launch(error) => Self::Launch(error),
            ServeError::Time(error) => Self::Time(error),
        }
    }
}

/// Returns the end of a sentence that gives the reason why a process ended. Without a reason, it refers to the
/// process's own message.
pub(crate) fn reason_suffix(said: Option<&str>) -> String {
    said.map_or_else(|| "; see the message above".to_owned(), |said| format!(": {said}"))
}

fn other_gateway(link: Option<&(String, BusKind)>) -> String {
    match link {
        None => "another gateway is on the bus".to_owned(),
        Some((name, kind)) => {
            let elsewhere =
                if kind.is_interface() { "run this one on another bus" } else { OTHER_DIRECTORY_HINT };
            format!("another gateway is on {name}: stop one of the two, or {elsewhere}")
        }
    }
}
