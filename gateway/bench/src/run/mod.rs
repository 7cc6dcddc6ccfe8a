//! A live bench: buses, cells, receivers, the control loop, and the main thread that supervises them.
//!
//! ```text
//!   main thread ── starts ──> cells, embedded buses (processes)
//!       │  ▲
//!       │  └── events, view, records, captured frames ─┐
//!       │                                              │
//!       ├─ stimuli ─> bus ─> receiver (one a bus) ─────┤
//!       │              ▲         └─ snapshot ─> control loop (SCHED_FIFO)
//!       │              └──────────── joints ───────────┘
//!       └─ progress line, summary              recorder: writes what all of them hand over
//! ```

mod accelerations;
mod begin;
mod bench;
mod commanded;
mod commander;
mod contacts;
mod end;
mod halts;
mod hosts;
mod measured;
mod network;
mod organise;
pub mod receiver;
mod start;
mod status_line;
mod usage;
mod watch;

use std::path::PathBuf;

use calibration::motion::MotionPlan;
use protocol::bus::KindChoices;
use protocol::skin::Skin;

use self::commander::RemoteControl;
pub use self::network::TreeTooDeep;
use crate::bus::time::BusTimeChoice;
use crate::emulate::EmulatedCells;
pub use crate::error::RunError;
use crate::remote::Remote;
use crate::summary::Summary;
use model::scenario::Scenario;

/// Options of a run.
#[derive(Clone, Debug)]
pub struct RunOptions {
    /// Path of the skin's file, which cells read too.
    pub skin_file: PathBuf,
    /// The skin.
    pub skin: Skin,
    /// The scenario.
    pub scenario: Scenario,
    /// Kind of each bus.
    pub kinds: KindChoices,
    /// Directory of embedded buses; `None` for the usual one.
    pub directory: Option<PathBuf>,
    /// Time that frames take on embedded buses.
    pub bus_time: BusTimeChoice,
    /// True if the run starts the cells; otherwise they must be on the bus already.
    pub spawn: bool,
    /// Cells to emulate and their firmware; the other cells are processes.
    pub emulated: Option<EmulatedCells>,
    /// Maximum number of cells per process.
    pub cells_per_process: usize,
    /// Directory for the cells' parameters, if they keep them.
    pub flash: Option<PathBuf>,
    /// Size of the gateway's receive buffer of a bus in bytes, as the kernel counts them: about 1 KiB per frame.
    pub receive_buffer: usize,
    /// Outputs of the recording.
    pub record: crate::record::RecordOptions,
    /// True if progress is hidden.
    pub quiet: bool,
    /// Motion of the robot that replaces the scenario's.
    pub planned: Option<MotionPlan>,
    /// Lines to print when the loop starts.
    pub announced: Vec<String>,
}

/// Runs a bench to its end, or until SIGINT, SIGTERM or SIGHUP. A failed run returns a summary too, with the reason. Each of
/// `remotes` controls the bench while the loop runs.
///
/// # Errors
/// Returns [`RunError`] if the run cannot start because of wrong use or configuration, after ending the cells and buses
/// that it started.
pub fn run(options: &RunOptions, remotes: Vec<Remote>) -> Result<Summary, RunError> {
    let mut bench = match start::start(options) {
        Ok(bench) => bench,
        Err(error) if error.exit_code() == 1 => {
            return Ok(Summary::for_failed_start(&options.skin, error.to_string()));
        }
        Err(error) => return Err(error),
    };
    bench.remotes = remotes.into_iter().map(RemoteControl::new).collect();
    match bench.bring_up_cells() {
        Ok(()) => {
            bench.print_announcements();
            Ok(bench.run_loop())
        }
        Err(error) => bench.end_without_loop(error),
    }
}
