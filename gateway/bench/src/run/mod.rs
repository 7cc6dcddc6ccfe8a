//! A bench, live: buses, cells, receivers, the control loop, and the thread that watches over them.
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

use calibration::motion::Motion;
use protocol::bus::Kinds;
use protocol::skin::Skin;

use self::commander::Remote;
pub use self::network::TooDeep;
use crate::emulate::Emulated;
pub use crate::error::RunError;
use crate::remote::Lines;
use crate::summary::Summary;
use model::scenario::Scenario;

/// What a run needs to know.
#[derive(Clone, Debug)]
pub struct Options {
    /// The skin's file, which cells read too.
    pub skin_file: PathBuf,
    /// The skin.
    pub skin: Skin,
    /// What happens.
    pub scenario: Scenario,
    /// Which kind each bus is.
    pub kinds: Kinds,
    /// Where embedded buses are, if not where they usually are.
    pub directory: Option<PathBuf>,
    /// Whether cells are started; else they are on the bus already.
    pub spawn: bool,
    /// Cells that are emulated, and by which firmware; the others are processes.
    pub emulated: Option<Emulated>,
    /// At most so many cells in a process.
    pub cells_per_process: usize,
    /// Where cells keep their parameters, if they do.
    pub flash: Option<PathBuf>,
    /// Bytes that may wait in the gateway's socket of a bus, as the kernel counts them: about 1 KiB a frame.
    pub receive_buffer: usize,
    /// What is recorded where.
    pub record: crate::record::Options,
    /// Whether progress is shown.
    pub quiet: bool,
    /// What moves the robot in place of the scenario.
    pub planned: Option<Motion>,
    /// Lines that are true once the loop begins, and are shown then.
    pub announced: Vec<String>,
}

/// Runs a bench to its end, or until SIGINT or SIGTERM. A run that fails has a summary too, with the reason. While the
/// loop runs, `remote` commands the bench.
///
/// # Errors
/// When it cannot begin because of wrong use or configuration; cells and buses that were started are ended again.
pub fn run(options: &Options, remote: Option<Lines>) -> Result<Summary, RunError> {
    let mut bench = match start::start(options) {
        Ok(bench) => bench,
        Err(error) if error.exit_code() == 1 => {
            return Ok(Summary::of_no_run(&options.skin, error.to_string()));
        }
        Err(error) => return Err(error),
    };
    bench.remote = remote.map(Remote::new);
    match bench.begin() {
        Ok(()) => {
            bench.announce();
            Ok(bench.watch())
        }
        Err(error) => bench.give_up(error),
    }
}
