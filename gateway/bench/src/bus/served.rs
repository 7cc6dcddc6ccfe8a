//! Embedded buses that this gateway serves, each in a process of its own.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};

use protocol::bus::{Bus, BusError, BusOptions, KindChoice};
use thiserror::Error;

use super::time::{BusTimeError, ServedTime, check_bus_time};
use crate::processes::{LaunchError, isolate_process_group, program_path, spawn, wait_or_kill};

/// An embedded bus in a process of its own, which removes its socket even if the gateway is killed.
#[derive(Debug)]
pub struct ServedBus {
    bus: String,
    child: Child,
}

impl ServedBus {
    /// Serves a bus, in `directory` or else in the usual one, and waits until clients can connect.
    ///
    /// # Errors
    /// Returns [`LaunchError`] if the program does not start or does not report that it serves the bus.
    pub fn start(
        program: &Path,
        bus: &str,
        directory: Option<&Path>,
        time: Option<ServedTime>,
    ) -> Result<Self, LaunchError> {
        let mut served = Self::spawn_server(program, bus, directory, time)?;
        served.wait_until_serving(program)?;
        Ok(served)
    }

    /// Starts the program, which will serve the bus.
    fn spawn_server(
        program: &Path,
        bus: &str,
        directory: Option<&Path>,
        time: Option<ServedTime>,
    ) -> Result<Self, LaunchError> {
        let mut command = Command::new(program);
        command.args(["serve", bus, "--until-eof"]);
        if let Some(ServedTime { rates, queue }) = time {
            command.args(["--rates", &rates.to_string(), "--queue", &queue.to_string()]);
        }
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        isolate_process_group(&mut command, directory);
        let child = spawn(&mut command)?;
        Ok(Self { bus: bus.to_owned(), child })
    }

    /// Waits until clients can connect.
    fn wait_until_serving(&mut self, program: &Path) -> Result<(), LaunchError> {
        let start = |source| LaunchError::Start { path: program.to_owned(), source };
        let mut line = String::new();
        if let Some(output) = self.child.stdout.take() {
            BufReader::new(output).read_line(&mut line).map_err(start)?;
        }
        if line.starts_with("serving ") {
            return Ok(());
        }
        Err(LaunchError::Serve { path: program.to_owned(), bus: self.bus.clone() })
    }

    /// Process id of the server.
    #[must_use]
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Name under which the bus is served: [`protocol::bus::BusKind::served_name`].
    #[must_use]
    pub fn bus_name(&self) -> &str {
        &self.bus
    }

    /// Ends the server process. The process removes its socket, and clients find a closed connection.
    pub fn stop(&mut self) {
        // The server ends when its standard input is closed.
        drop(self.child.stdin.take());
        wait_or_kill(&mut [&mut self.child]);
    }

    /// Exit status of the server, or `None` while it runs.
    pub fn exit_status(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().ok().flatten()
    }
}

/// An error of a bus that can neither be opened nor served.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServeError {
    /// The bus does not open.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The server does not start.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// Frames do not take time on the bus, though they must.
    #[error(transparent)]
    Time(#[from] BusTimeError),
}

/// A bus to open.
#[derive(Clone, Debug)]
pub struct BusTarget<'a> {
    /// Name of the bus.
    pub name: &'a str,
    /// Kind of the bus.
    pub kind: KindChoice,
    /// Options for opening it.
    pub options: BusOptions,
    /// Time that frames take on it; `None` if the user does not ask for any.
    pub time: Option<ServedTime>,
}

/// Action for a bus that exists neither as an interface nor as an embedded bus, if its kind is [`KindChoice::Auto`].
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum AbsentBusAction {
    /// Serve a new embedded bus, because this program starts all its cells.
    Create,
    /// Return an error, because the cells are expected on a bus that exists already.
    Fail,
}

/// Opens a bus. Serves an embedded bus that has no server.
///
/// # Errors
/// Returns [`ServeError`] if the bus does not open or cannot be served.
pub fn open_or_serve(
    target: BusTarget<'_>,
    absent: AbsentBusAction,
) -> Result<(Bus, Option<ServedBus>), ServeError> {
    let name = target.name;
    let (opened, mut served) = open_or_serve_all(&[target], absent)?;
    let bus = opened.into_iter().next().ok_or_else(|| BusError::Name(name.to_owned()))?;
    Ok((bus, served.pop()))
}

/// Opens buses in the given order. Serves embedded buses that have no server; all servers start at once.
///
/// # Errors
/// Returns [`ServeError`] if a bus does not open or cannot be served.
pub fn open_or_serve_all(
    buses: &[BusTarget<'_>],
    absent: AbsentBusAction,
) -> Result<(Vec<Bus>, Vec<ServedBus>), ServeError> {
    let mut begun = Vec::with_capacity(buses.len());
    for BusTarget { name, kind, options, time } in buses {
        let opened = Bus::open(name, *kind, options);
        let is_served = matches!(opened, Err(BusError::NotServed { .. }))
            || (absent == AbsentBusAction::Create && matches!(opened, Err(BusError::Absent { .. })));
        begun.push(match opened {
            Err(_) if is_served => {
                let program = program_path("vcan-setup")?;
                let name = kind.served_kind().served_name(name);
                Err(ServedBus::spawn_server(&program, &name, options.directory.as_deref(), *time)
                    .map(|served| (program, served))?)
            }
            opened => Ok(opened?),
        });
    }
    let (mut opened, mut all_served) = (Vec::with_capacity(buses.len()), Vec::new());
    for (BusTarget { name, kind, options, time }, begun) in buses.iter().zip(begun) {
        let bus = match begun {
            Ok(bus) => bus,
            Err((program, mut served)) => {
                served.wait_until_serving(&program)?;
                all_served.push(served);
                // Not by the user's choice: an interface of this name may have appeared meanwhile.
                Bus::open(name, KindChoice::Only(kind.served_kind()), options)?
            }
        };
        check_bus_time(&bus, *time)?;
        opened.push(bus);
    }
    Ok((opened, all_served))
}

impl Drop for ServedBus {
    fn drop(&mut self) {
        self.stop();
    }
}
