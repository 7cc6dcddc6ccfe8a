//! Embedded buses that this gateway serves itself, each in a process of its own.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};

use protocol::bus::{Bus, BusError, BusKind, Choice, Options};
use thiserror::Error;

use crate::processes::{LaunchError, apart, end, program, spawn};

/// An embedded bus in a process of its own, so that it takes its socket away even when the gateway is
/// killed.
#[derive(Debug)]
pub struct ServedBus {
    bus: String,
    child: Child,
}

impl ServedBus {
    /// Serves a bus and waits until clients can connect; in a directory, if not in the usual one.
    ///
    /// # Errors
    /// When the program does not start or does not say that it serves.
    pub fn start(program: &Path, bus: &str, directory: Option<&Path>) -> Result<Self, LaunchError> {
        let mut served = Self::begin(program, bus, directory)?;
        served.wait(program)?;
        Ok(served)
    }

    /// Starts the program, which serves the bus soon.
    fn begin(program: &Path, bus: &str, directory: Option<&Path>) -> Result<Self, LaunchError> {
        let mut command = Command::new(program);
        command.args(["serve", bus, "--until-eof"]).stdin(Stdio::piped()).stdout(Stdio::piped());
        apart(&mut command, directory);
        Ok(Self { bus: bus.to_owned(), child: spawn(&mut command)? })
    }

    /// Waits until clients can connect.
    fn wait(&mut self, program: &Path) -> Result<(), LaunchError> {
        let start = |source| LaunchError::Start { path: program.to_owned(), source };
        let mut line = String::new();
        if let Some(out) = self.child.stdout.take() {
            BufReader::new(out).read_line(&mut line).map_err(start)?;
        }
        if line.starts_with("serving ") {
            return Ok(());
        }
        Err(LaunchError::Serve { path: program.to_owned(), bus: self.bus.clone() })
    }

    /// Its process.
    #[must_use]
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// The bus.
    #[must_use]
    pub fn bus(&self) -> &str {
        &self.bus
    }

    /// Ends its process, which takes its socket away; clients find a closed connection.
    pub fn end(&mut self) {
        // Its standard input ends, and so does it.
        drop(self.child.stdin.take());
        end(&mut [&mut self.child]);
    }

    /// How its process ended, if it did.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().ok().flatten()
    }
}

/// A bus that is neither opened nor served.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServeError {
    /// It does not open.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// Its server does not start.
    #[error(transparent)]
    Launch(#[from] LaunchError),
}

/// A bus to be opened: its name, its kind, and how.
pub type Target<'a> = (&'a str, Choice, Options);

/// Whether a bus may be made that is on this machine neither as an interface nor as an embedded bus, where either would do
/// ([`Choice::Auto`]).
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Absent {
    /// An embedded bus is made: all cells are started here.
    Made,
    /// An error: an empty bus would not be the one that cells are on.
    Refused,
}

/// Opens a bus; an embedded one without a server is served.
///
/// # Errors
/// When it does not open, or is not served.
pub fn open_or_serve(
    name: &str,
    kind: Choice,
    target: &Options,
    absent: Absent,
) -> Result<(Bus, Option<ServedBus>), ServeError> {
    let (opened, mut served) = open_or_serve_all(&[(name, kind, target.clone())], absent)?;
    let bus = opened.into_iter().next().ok_or_else(|| BusError::Name(name.to_owned()))?;
    Ok((bus, served.pop()))
}

/// Opens buses, in this order; embedded ones without a server are served, and all their servers start at once.
///
/// # Errors
/// When one does not open, or is not served.
pub fn open_or_serve_all(
    buses: &[Target<'_>],
    absent: Absent,
) -> Result<(Vec<Bus>, Vec<ServedBus>), ServeError> {
    let mut begun = Vec::with_capacity(buses.len());
    for (name, kind, target) in buses {
        let opened = Bus::open(name, *kind, target);
        let is_served = matches!(opened, Err(BusError::NotServed { .. }))
            || (absent == Absent::Made && matches!(opened, Err(BusError::Absent { .. })));
        begun.push(match opened {
            Err(_) if is_served => {
                let program = program("vcan-setup")?;
                Err(ServedBus::begin(&program, name, target.directory.as_deref())
                    .map(|served| (program, served))?)
            }
            opened => Ok(opened?),
        });
    }
    let (mut opened, mut all_served) = (Vec::with_capacity(buses.len()), Vec::new());
    for ((name, _, target), begun) in buses.iter().zip(begun) {
        opened.push(match begun {
            Ok(bus) => bus,
            Err((program, mut served)) => {
                served.wait(&program)?;
                all_served.push(served);
                // Not by the choice: an interface of this name may have come meanwhile.
                Bus::open(name, Choice::Only(BusKind::Embedded), target)?
            }
        });
    }
    Ok((opened, all_served))
}

impl Drop for ServedBus {
    fn drop(&mut self) {
        self.end();
    }
}
