//! Errors that keep a replay from starting, or end it.

use std::path::PathBuf;
use std::process::ExitStatus;

use protocol::bus::{BusError, KindsError};
use protocol::sine::UnknownSineMethod;
use thiserror::Error;

use crate::error::{RunError, reason_suffix};
use model::decode::MAX_BUSES;
use trace::capture::CaptureError;

/// An error of cells that are not in the state of the recording.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
pub enum CellMismatch {
    /// All cells differ.
    #[error(
        "the recording was made with another skin: the configurations of all {count} cells differ: {cells}; {}",
        hint(*.spawned)
    )]
    Skin {
        /// Number of cells.
        count: usize,
        /// Names of the cells, with their configurations.
        cells: String,
        /// True if this replay started the cells.
        spawned: bool,
    },
    /// Some cells differ.
    #[error("these cells have a different configuration in the recording: {cells}; {}", hint(*.spawned))]
    Cells {
        /// Names of the cells, with their configurations.
        cells: String,
        /// True if this replay started the cells.
        spawned: bool,
    },
    /// Some cells are absent.
    #[error(
        "these cells of the recording are not on the bus: {0}; start them with cell-node, or start all cells with \
         --spawn"
    )]
    Absent(String),
    /// The recording has no heartbeat.
    #[error(
        "the replies cannot be compared: the recording has no heartbeat of a cell, so its skin is unknown; record \
         for at least half a second"
    )]
    Unknown,
}

fn hint(spawned: bool) -> &'static str {
    if spawned {
        "name the recording's skin with --skin"
    } else {
        "configure them for the recording's skin, or start them from it with --spawn"
    }
}

/// An error that keeps a replay from starting, or ends it.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// An error that runs can have too: of a skin, a bus, a program or a thread.
    #[error(transparent)]
    Run(RunError),
    /// The recording names a sine that this build does not have.
    #[error(
        "the cells in the recording used a different sine function: {error}; replay it with the build that \
         recorded it"
    )]
    Sine {
        /// The unknown name.
        error: UnknownSineMethod,
    },
    /// A bus cannot have the kind that is named for it.
    #[error(transparent)]
    Kinds(#[from] KindsError),
    /// Standard input cannot be read twice.
    #[error(
        "a replay reads its input twice, which is impossible with standard input: save the frames to a file, \
         and give its path"
    )]
    StandardInput,
    /// A pipe cannot be read twice.
    #[error(
        "{} is not a regular file, but a replay reads its input twice: save the frames to a file, and name \
         that file",
        .0.display()
    )]
    Pipe(PathBuf),
    /// The capture does not open.
    #[error(transparent)]
    Open(CaptureError),
    /// The capture cannot be read to its end.
    #[error(transparent)]
    Read(CaptureError),
    /// A line cannot be read, and no such line is tolerated.
    #[error("{0}")]
    Line(String),
    /// The capture has too many buses.
    #[error("{0} has frames of too many buses: the maximum for a replay is {MAX_BUSES}")]
    Buses(String),
    /// The capture has nothing to send.
    #[error("{0} contains no frames")]
    Empty(String),
    /// The bus does not exist, so no cell on it can answer.
    #[error("{0}; or start fresh cells on an embedded bus with --spawn")]
    BusAbsent(BusError),
    /// The requested part has nothing to send.
    #[error("there are no frames to send between --from and --to: {name} ends at {ends_s:.3} s")]
    NothingLeft {
        /// Display name of the capture.
        name: String,
        /// Time of the last frame in s, from the start of the run or, without a run, from the first frame.
        ends_s: f64,
    },
    /// An option names a bus that is not in the capture.
    #[error("{option}: {capture} has no bus {bus}; it has {buses}")]
    NoBus {
        /// The option and its value.
        option: String,
        /// Display name of the capture.
        capture: String,
        /// Name of the bus.
        bus: String,
        /// Names of the capture's buses.
        buses: String,
    },
    /// A bus of the capture is mapped to two buses.
    #[error("--map names {0} twice: each bus can be mapped only once")]
    MapTwice(String),
    /// Two buses of the capture are mapped to one.
    #[error(
        "two buses of the capture are mapped to the same bus, so their replies cannot be distinguished: map each to \
         its own bus, or omit --expect, --lockstep and --only inputs"
    )]
    Merged,
    /// The skin of the cells to start is unknown.
    #[error(
        "--spawn: {0} contains no skin, unlike recordings of `skinbus run --record`: name the skin with --skin \
         SKIN.toml"
    )]
    NoSkin(String),
    /// The skin does not have a bus of the capture.
    #[error(
        "--spawn: the capture is sent to {bus}, but the skin {skin} has only {buses}: map the capture's bus to one of \
         these with --map"
    )]
    NotOfSkin {
        /// Name of the bus.
        bus: String,
        /// Name of the skin.
        skin: String,
        /// Names of the skin's buses.
        buses: String,
    },
    /// Other cells are on a bus on which cells were to be started.
    #[error("these cells are already on {bus}: {cells}; omit --spawn to use them, or stop them")]
    CellsPresent {
        /// Name of the bus.
        bus: String,
        /// The cells found.
        cells: String,
    },
    /// A process of cells ended too early.
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
    /// Another gateway is on a bus.
    #[error("another gateway is on {0}: stop it, or send the capture to another bus with --map")]
    OtherGateway(String),
    /// No cell is on the buses.
    #[error("no cell answers on {0}: start the cells with cell-node, or with --spawn")]
    NoCell(String),
    /// The cells are not in the state of the recording.
    #[error(transparent)]
    Mismatch(#[from] CellMismatch),
    /// Cells do not confirm that they are in test mode.
    #[error("these cells did not enter test mode: {0}")]
    NoTestMode(String),
    /// Cells measure and ignore stimuli.
    #[error(
        "these cells use their own sensors and ignore stimuli, unlike in the recording: {0}; use --test-mode, which \
         puts them into test mode during the replay"
    )]
    Measuring(String),
}

/// All errors of a run can end a replay.
impl<E> From<E> for ReplayError
where
    RunError: From<E>,
{
    fn from(error: E) -> Self {
        Self::Run(error.into())
    }
}

impl ReplayError {
    /// Exit code: 2 for wrong use or configuration, 1 for a replay that failed.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Run(error) => error.exit_code(),
            Self::Kinds(_)
            | Self::BusAbsent(_)
            | Self::StandardInput
            | Self::Pipe(_)
            | Self::Open(_)
            | Self::Buses(_)
            | Self::NothingLeft { .. }
            | Self::NoBus { .. }
            | Self::MapTwice(_)
            | Self::Merged
            | Self::NoSkin(_)
            | Self::Sine { .. }
            | Self::NotOfSkin { .. } => 2,
            Self::Read(_)
            | Self::Line(_)
            | Self::Empty(_)
            | Self::CellsPresent { .. }
            | Self::Ended { .. }
            | Self::OtherGateway(_)
            | Self::NoCell(_)
            | Self::Mismatch(_)
            | Self::NoTestMode(_)
            | Self::Measuring(_) => 1,
        }
    }
}
