//! Processes of a bench: cells here, embedded buses in [`crate::bus::served`]. All of them end with the gateway,
//! however it ends: each process ends when its parent dies, and dropping a [`Processes`] ends them.

pub(crate) mod ended;
mod standard_error;

use std::fmt::{self, Display, Formatter};
use std::fs::File;
use std::io::Write;
use std::os::fd::AsRawFd;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use protocol::bus::KindChoices;
use protocol::last_words::CellRange;
use protocol::sine::SineMethod;
use protocol::skin::{Cell, Skin};
use protocol::usage::path_from_env;
use rustix::fs::{MemfdFlags, memfd_create};
use rustix::process::{Pid, Resource, Rlimit, Signal, getrlimit, kill_process, setrlimit};
use thiserror::Error;

use self::standard_error::StandardErrorPipe;
use crate::remote::{Phase, ProcessState};
use crate::system_calls::end_with_parent;
use model::scenario::ProcessAction;

/// Time that two gateways on one bus need to detect each other.
pub const GATEWAY_DETECTION_TIME: Duration = Duration::from_millis(500);
/// Maximum time without progress while started cells become ready.
pub const START_TIMEOUT: Duration = Duration::from_secs(15);
/// Number of files that a gateway or a bus server opens besides its buses and clients.
const OTHER_OPEN_FILES: usize = 26;
/// Number of files that a gateway opens for each bus.
const OPEN_FILES_PER_BUS: usize = 4;
/// Time that processes have to end after SIGTERM.
const TERM_TIMEOUT: Duration = Duration::from_secs(2);

/// An error that keeps a process from starting.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LaunchError {
    /// The program does not exist.
    #[error(
        "the program {name} is not at {path}: build it with `cargo build --release`, or set {} to its path",
        path_variable(name)
    )]
    Missing {
        /// Name of the program.
        name: &'static str,
        /// Expected path.
        path: PathBuf,
    },
    /// The program exists and does not start.
    #[error("cannot start {path}: {source}")]
    Start {
        /// Path of the program.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// SIGCHLD, which reports the ends of processes, cannot be caught.
    #[error("cannot catch SIGCHLD: {0}")]
    Signal(std::io::Error),
    /// The pipe for the processes' standard error cannot be made.
    #[error("cannot create a pipe for the messages of cells: {0}")]
    Pipe(std::io::Error),
    /// The limit of open files is below the number that buses and cells need.
    #[error("this bench needs {needed} open files, but the limit is {limit}: run `ulimit -n {needed}` first")]
    Files {
        /// The limit.
        limit: u64,
        /// The number needed.
        needed: u64,
    },
    /// An embedded bus is not served.
    #[error(
        "the program {path} was started to serve the bus {bus}, but did not report success; see its messages above"
    )]
    Serve {
        /// Path of the serving program.
        path: PathBuf,
        /// Name of the bus.
        bus: String,
    },
}

/// The error of a system that grants no file in memory.
#[derive(Debug, Error)]
#[error("cannot hand the skin to the processes of cells: {0}")]
pub struct MemoryFileError(#[source] std::io::Error);

/// Raises the limit of open files for this process and all processes that it starts, so that a gateway can use `buses`
/// buses and a bus server can serve `clients` clients.
///
/// # Errors
/// Returns [`LaunchError::Files`] if the system forbids it.
pub fn raise_open_file_limit(buses: usize, clients: usize) -> Result<(), LaunchError> {
    let needed = (OTHER_OPEN_FILES + OPEN_FILES_PER_BUS * buses + clients) as u64;
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let Some(limit) = current.filter(|limit| *limit < needed) else { return Ok(()) };
    setrlimit(Resource::Nofile, Rlimit { current: Some(needed), maximum })
        .map_err(|_| LaunchError::Files { limit, needed })
}

/// Returns the name of the environment variable that overrides the path of a program of this project.
fn path_variable(name: &str) -> String {
    format!("SKINBUS_{}", name.to_ascii_uppercase().replace('-', "_"))
}

/// Path of a program of this project: from the environment (`SKINBUS_CELL_NODE`, `SKINBUS_VCAN_SETUP`), or else beside
/// this program.
///
/// # Errors
/// Returns [`LaunchError::Missing`] if the file does not exist.
pub fn program_path(name: &'static str) -> Result<PathBuf, LaunchError> {
    let beside = || std::env::current_exe().ok().and_then(|own| Some(own.parent()?.join(name)));
    let path =
        path_from_env(&path_variable(name)).or_else(beside).unwrap_or_else(|| Path::new(".").join(name));
    if path.is_file() { Ok(path) } else { Err(LaunchError::Missing { name, path }) }
}

/// Creates a file in memory that contains `bytes`. Returns it with the path by which cells open it. The file exists as
/// long as this program holds it open.
///
/// # Errors
/// Returns [`MemoryFileError`] if the system grants no file in memory.
pub fn create_memory_file(bytes: &[u8]) -> Result<(File, PathBuf), MemoryFileError> {
    let memory = || {
        let mut file = File::from(memfd_create("skin.toml", MemfdFlags::CLOEXEC)?);
        file.write_all(bytes).map(|()| file)
    };
    let file = memory().map_err(MemoryFileError)?;
    let path = PathBuf::from(format!("/proc/{}/fd/{}", std::process::id(), file.as_raw_fd()));
    Ok((file, path))
}

/// A process that runs one or several cells.
#[derive(Debug)]
struct Process {
    /// Command that started the process, kept for a restart.
    command: Command,
    bus: usize,
    bus_name: String,
    nodes: (u8, u8),
    child: Child,
    phase: Phase,
    /// File for an emulator's messages.
    log: Option<PathBuf>,
}

/// A process that ended by itself or was killed. Displayed as its cells and their bus.
#[derive(Clone, Debug)]
pub struct EndedProcess {
    /// Name of the bus.
    pub bus: String,
    /// Node ids of the first and the last cell.
    pub nodes: (u8, u8),
    /// Exit status.
    pub status: ExitStatus,
    /// Reason that the process gave, if any.
    pub reason: Option<String>,
}

impl EndedProcess {
    /// Range of the process's cells.
    #[must_use]
    pub const fn cells(&self) -> CellRange {
        CellRange(self.nodes.0, self.nodes.1)
    }

    /// Returns the exit status, with the reason that the process gave, if any.
    #[must_use]
    pub fn status_text(&self) -> String {
        let status = self.status;
        self.reason.as_ref().map_or_else(|| status.to_string(), |said| format!("{status}: {said}"))
    }

    /// Reason of the error, if the process failed by itself: neither by a signal nor with exit code 0.
    #[must_use]
    pub fn failure_reason(&self) -> Option<String> {
        let code = self.status.code().filter(|&code| code != 0)?;
        Some(self.reason.clone().unwrap_or_else(|| format!("exit code {code}, and no reason was given")))
    }
}

impl Display for EndedProcess {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{} on {}", self.cells(), self.bus)
    }
}

/// The processes of all cells.
#[derive(Debug, Default)]
pub struct Processes {
    all: Vec<Process>,
    /// Flag that SIGCHLD sets, so that hundreds of processes are polled only after one of them has changed.
    changed: Arc<AtomicBool>,
    /// Standard error of the processes; `None` before the first start.
    error: Option<StandardErrorPipe>,
    /// Processes that had already ended by themselves when they were to be restarted.
    ended_at_restart: Vec<EndedProcess>,
}

/// Settings for starting cells.
#[derive(Clone, Copy, Debug)]
pub struct CellLaunch<'a> {
    /// Path of the program.
    pub program: &'a Path,
    /// Path of the skin's file.
    pub skin_file: &'a Path,
    /// The skin.
    pub skin: &'a Skin,
    /// Kind of each bus: an interface of the kernel or an embedded bus.
    pub kinds: &'a KindChoices,
    /// Directory of embedded buses; `None` for the usual one.
    pub directory: Option<&'a Path>,
    /// Maximum number of cells per process.
    pub per_process: usize,
    /// Directory for the cells' parameters, if they keep them.
    pub flash: Option<&'a Path>,
    /// The sine with which the cells compute.
    pub sine: SineMethod,
}

impl Processes {
    /// Creates an empty set of processes.
    ///
    /// # Errors
    /// Returns [`LaunchError`] if SIGCHLD cannot be caught.
    pub fn new() -> Result<Self, LaunchError> {
        let mut processes = Self::default();
        processes.error = Some(StandardErrorPipe::new().map_err(LaunchError::Pipe)?);
        let changed = Arc::clone(&processes.changed);
        signal_hook::flag::register(signal_hook::consts::SIGCHLD, changed).map_err(LaunchError::Signal)?;
        Ok(processes)
    }

    /// Starts all cells of a skin that have no process yet. The calling thread must live as long as the cells.
    ///
    /// # Errors
    /// Returns [`LaunchError`] if a process does not start.
    pub fn start(&mut self, plan: &CellLaunch<'_>) -> Result<(), LaunchError> {
        for (bus, described) in plan.skin.buses.iter().enumerate() {
            let mut nodes: Vec<u8> = plan.skin.cells_on_bus(bus).map(|cell| cell.node.get()).collect();
            nodes.retain(|&node| !self.has_process(bus, node));
            nodes.sort_unstable();
            for nodes in group_consecutive(&nodes, plan.per_process) {
                let mut command = plan.cell_command(&described.name, nodes);
                let child = spawn_cells(&mut command, self.error.as_ref())?;
                let (phase, bus_name) = (Phase::Running, described.name.clone());
                self.all.push(Process { command, bus, bus_name, nodes, child, phase, log: None });
            }
        }
        Ok(())
    }

    /// Starts the emulator of a cell on this bus; `log` is the file for its messages. The calling thread must live as
    /// long as the emulator.
    ///
    /// # Errors
    /// Returns [`LaunchError`] if the emulator does not start.
    pub fn start_emulator(
        &mut self,
        cell: &Cell,
        bus_name: &str,
        mut command: Command,
        log: &Path,
    ) -> Result<(), LaunchError> {
        command.process_group(0);
        end_with_parent(&mut command);
        let child = spawn(&mut command)?;
        let nodes = (cell.node.get(), cell.node.get());
        let (phase, bus_name, log) = (Phase::Running, bus_name.to_owned(), Some(log.to_owned()));
        self.all.push(Process { command, bus: cell.bus, bus_name, nodes, child, phase, log });
        Ok(())
    }

    /// Returns true if a process of this cell runs.
    #[must_use]
    pub fn has_process(&self, bus: usize, node: u8) -> bool {
        self.all.iter().any(|process| process.state().runs_cell(bus, node))
    }

    /// Ids of the running processes.
    pub fn pids(&self) -> impl Iterator<Item = u32> {
        self.all.iter().filter(|process| process.is_running()).map(|process| process.child.id())
    }

    /// Returns the state of each process.
    pub fn states(&self) -> impl Iterator<Item = ProcessState> {
        self.all.iter().map(Process::state)
    }

    /// Returns the processes that have ended since the last call. Prints what the other processes have written to their
    /// standard error.
    pub fn take_ended(&mut self) -> Vec<EndedProcess> {
        self.error.iter_mut().for_each(StandardErrorPipe::read_available);
        let mut ended = std::mem::take(&mut self.ended_at_restart);
        if !self.changed.swap(false, Ordering::Relaxed) {
            return ended;
        }
        for process in self.all.iter_mut().filter(|process| process.is_running()) {
            if let Ok(Some(status)) = process.child.try_wait() {
                process.phase = Phase::Ended;
                ended.push(process.create_end_record(status, self.error.as_mut()));
            }
        }
        ended
    }

    /// Applies an action to the process of a cell. Returns true if the cell has a process.
    ///
    /// # Errors
    /// Returns [`LaunchError`] if a restarted process does not start.
    pub fn apply_action(&mut self, bus: usize, node: u8, action: ProcessAction) -> Result<bool, LaunchError> {
        let holds = |process: &&mut Process| process.state().runs_cell(bus, node);
        let Some(process) = self.all.iter_mut().find(holds) else { return Ok(false) };
        match action {
            ProcessAction::Kill => process.send_signal(Signal::KILL, Phase::Running),
            ProcessAction::Stop => process.send_signal(Signal::STOP, Phase::Stopped),
            ProcessAction::Continue => process.send_signal(Signal::CONT, Phase::Running),
            ProcessAction::Restart => {
                let lived = process.is_running();
                process.send_signal(Signal::KILL, Phase::Ended);
                // A process with an exit code had ended by itself before; a killed one has a signal status.
                let status = process.child.wait().ok().filter(|status| lived && status.signal().is_none());
                self.ended_at_restart
                    .extend(status.map(|status| process.create_end_record(status, self.error.as_mut())));
                process.child = match &process.log {
                    Some(_) => spawn(&mut process.command)?,
                    None => spawn_cells(&mut process.command, self.error.as_ref())?,
                };
                process.phase = Phase::Running;
            }
        }
        Ok(true)
    }
}

impl Process {
    const fn state(&self) -> ProcessState {
        ProcessState { bus: self.bus, nodes: self.nodes, phase: self.phase }
    }

    fn is_running(&self) -> bool {
        self.phase != Phase::Ended
    }

    /// Creates the record of a process that ended with `status`.
    fn create_end_record(&self, status: ExitStatus, error: Option<&mut StandardErrorPipe>) -> EndedProcess {
        let said = match (&self.log, error) {
            (Some(log), _) => last_emulator_message(log),
            (None, Some(error)) => {
                // The process has ended, so it has written everything.
                error.read_available();
                error.take_exit_reason(&self.bus_name, self.nodes)
            }
            (None, None) => None,
        };
        EndedProcess { bus: self.bus_name.clone(), nodes: self.nodes, status, reason: said }
    }

    /// Sends a signal and enters `phase`. Ended processes are left alone.
    fn send_signal(&mut self, signal: Signal, phase: Phase) {
        if let Some(pid) = Pid::from_raw(self.child.id().cast_signed()).filter(|_| self.is_running()) {
            let _ = kill_process(pid, signal);
            self.phase = phase;
        }
    }
}

impl Drop for Processes {
    fn drop(&mut self) {
        for process in &mut self.all {
            // A stopped process would not handle SIGTERM.
            process.send_signal(Signal::CONT, Phase::Running);
            process.send_signal(Signal::TERM, Phase::Running);
        }
        let mut children: Vec<_> = self
            .all
            .iter_mut()
            .filter(|process| process.is_running())
            .map(|process| &mut process.child)
            .collect();
        wait_or_kill(&mut children);
    }
}

impl CellLaunch<'_> {
    fn cell_command(&self, bus: &str, (first, last): (u8, u8)) -> Command {
        let mut command = Command::new(self.program);
        command.args(["--bus", bus]);
        if first == last {
            command.args(["--node", &first.to_string()]);
        } else {
            command.args(["--nodes", &format!("{first}-{last}")]);
        }
        // After the loss of a bus, a new server or interface replaces it while its cells keep running.
        command.arg("--skin").arg(self.skin_file).arg("--reconnect");
        command.args(["--bus-kind", &self.kinds.kind_of(bus).to_string()]);
        command.args(["--with-parent", &std::process::id().to_string()]);
        command.args(["--sine", self.sine.name()]);
        if let Some(flash) = self.flash {
            command.arg("--flash").arg(flash);
        }
        command.stdin(Stdio::null()).stdout(Stdio::null());
        isolate_process_group(&mut command, self.directory);
        command
    }
}

pub(crate) fn spawn(command: &mut Command) -> Result<Child, LaunchError> {
    command.spawn().map_err(|source| LaunchError::Start { path: command.get_program().into(), source })
}

/// Starts a process of cells with its standard error connected to the pipe.
fn spawn_cells(command: &mut Command, error: Option<&StandardErrorPipe>) -> Result<Child, LaunchError> {
    if let Some(error) = error {
        error.attach_to(command).map_err(LaunchError::Pipe)?;
    }
    let child = spawn(command);
    // The command is kept for a restart, and would keep the pipe's end open.
    command.stderr(Stdio::inherit());
    child
}

/// Last message of an emulator that is not mere information.
fn last_emulator_message(log: &Path) -> Option<String> {
    let text = std::fs::read_to_string(log).ok()?;
    // Register values follow a fault message.
    let is_message = |line: &&str| line.starts_with("qemu") && !line.contains(": info: ");
    text.lines().rfind(is_message).map(str::to_owned)
}

/// Puts a process into its own group: Ctrl-C on a terminal signals the whole group but is meant for the gateway alone,
/// because cells and buses must live until the final reports. `directory` is where the process finds embedded buses.
pub(crate) fn isolate_process_group(command: &mut Command, directory: Option<&Path>) {
    command.process_group(0);
    if let Some(directory) = directory {
        command.env("SKINBUS_DIR", directory);
    }
}

/// Groups consecutive numbers into ranges of at most `size`.
#[must_use]
pub fn group_consecutive(nodes: &[u8], size: usize) -> Vec<(u8, u8)> {
    let mut groups: Vec<(u8, u8)> = Vec::new();
    for &node in nodes {
        match groups.last_mut() {
            Some((first, last)) if *last + 1 == node && usize::from(node - *first) < size => *last = node,
            _ => groups.push((node, node)),
        }
    }
    groups
}

/// Waits for processes that were asked to end, and kills those that do not.
pub(crate) fn wait_or_kill(children: &mut [&mut Child]) {
    let give_up = Instant::now() + TERM_TIMEOUT;
    loop {
        let running = children
            .iter_mut()
            .filter_map(|child| child.try_wait().is_ok_and(|status| status.is_none()).then_some(()));
        if running.count() == 0 {
            return;
        }
        if Instant::now() > give_up {
            break;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    for child in children {
        let _ = child.kill();
        let _ = child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_grouped_in_runs_of_consecutive_numbers() {
        assert_eq!(group_consecutive(&[1, 2, 3, 5, 6, 254], 1).len(), 6);
        assert_eq!(group_consecutive(&[1, 2, 3, 5, 6, 254], 2), [(1, 2), (3, 3), (5, 6), (254, 254)]);
        assert_eq!(group_consecutive(&[1, 2, 3, 5, 6, 254], 64), [(1, 3), (5, 6), (254, 254)]);
    }

    #[test]
    fn a_missing_program_is_named_with_the_hint() {
        let error = program_path("no-such-program").unwrap_err().to_string();
        assert!(error.starts_with("the program no-such-program is not at /"), "{error}");
        assert!(error.ends_with("or set SKINBUS_NO_SUCH_PROGRAM to its path"), "{error}");
    }
}
