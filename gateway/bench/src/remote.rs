//! Remote control of a run by another process: lines of JSON over two pipes, on which neither side blocks.
//!
//! ```text
//!   server of the page ── BenchCommand ──> main thread of the run
//!   server of the page <── BenchState ──── main thread of the run
//! ```
//!
//! Each [`BenchState`] is complete: a state that did not fit into the pipe is superseded by the next one.

use std::io;
use std::os::fd::OwnedFd;

use model::scenario::ProcessAction;
use protocol::quantiles::Quantiles;
use rustix::io::{Errno, ioctl_fionbio, read, write};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Number of bytes read at once.
const READ_CHUNK_BYTES: usize = 4_096;
/// Maximum length of a line in bytes. The state of 16 buses with one process per cell is shorter.
const MAX_LINE_BYTES: usize = 1 << 20;

/// A command to a bench. Buses are indices into the skin's buses.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(tag = "on", rename_all = "lowercase", deny_unknown_fields)]
pub enum BenchCommand {
    /// Applies an action to the process of a cell, and so to all cells of that process.
    Process {
        /// The action, such as kill, stop or restart.
        action: ProcessAction,
        /// Bus of the cell.
        bus: usize,
        /// Node id of the cell.
        node: u8,
    },
    /// Takes the link between two cells down in both directions, or brings it up again.
    Link {
        /// True to take the link down.
        down: bool,
        /// Bus of the cells.
        bus: usize,
        /// Node ids of the cells.
        nodes: [u8; 2],
    },
    /// Takes a bus down, or brings it up again.
    Bus {
        /// True to take the bus down.
        down: bool,
        /// The bus.
        bus: usize,
    },
    /// Ends the run in order, as at the end of its duration.
    End,
}

/// Connection to a program that controls a run.
#[derive(Debug)]
pub struct Remote {
    /// Name of the option that made the connection, without its dashes. Notes about commands begin with it.
    pub name: &'static str,
    /// Carries commands to the run, and its state back.
    pub lines: JsonPipe,
    /// True if the run ends when this connection ends.
    pub ends_run: bool,
}

/// State of a bench that is under remote control.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
pub struct BenchState {
    /// Processes of cells that the run has started.
    pub processes: Vec<ProcessState>,
    /// Links that are down, in one direction or in both.
    pub links_down: Vec<DownLink>,
    /// State of each bus.
    pub buses: Vec<BusStatus>,
    /// Lateness of the ticks.
    pub lateness: TickLateness,
    /// Reason for the present halt, if the robot is halted.
    #[serde(default)]
    pub halted: Option<String>,
    /// Latest answers to commands, oldest first.
    pub answers: Vec<CommandReply>,
}

impl BenchState {
    /// Returns a copy of the state that contains only the process of one cell, or no process.
    #[must_use]
    pub fn for_cell(&self, cell: Option<(usize, u8)>) -> Self {
        let is_its = |process: &&ProcessState| cell.is_some_and(|(bus, node)| process.runs_cell(bus, node));
        let processes = self.processes.iter().filter(is_its).copied().collect();
        Self { processes, ..self.clone() }
    }
}

/// A process of cells.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
pub struct ProcessState {
    /// Bus of its cells.
    pub bus: usize,
    /// Node ids of the first and the last cell of the process.
    pub nodes: (u8, u8),
    /// State of the process.
    pub phase: Phase,
}

impl ProcessState {
    /// Returns true if the process runs this cell.
    #[must_use]
    pub const fn runs_cell(&self, bus: usize, node: u8) -> bool {
        self.bus == bus && self.nodes.0 <= node && node <= self.nodes.1
    }
}

/// State of a process.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// The process runs.
    Running,
    /// This run has stopped the process.
    Stopped,
    /// The process has ended.
    Ended,
}

/// A link that is down.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
pub struct DownLink {
    /// Bus of its two cells.
    pub bus: usize,
    /// Node ids of the cells, the smaller one first.
    pub nodes: [u8; 2],
}

/// State of a bus.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
pub struct BusStatus {
    /// True if a command has taken the bus down.
    pub down: bool,
    /// True if the links of its cells can be taken down, which is the case if they answer with sums.
    pub links: bool,
}

/// Lateness of ticks in µs.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Serialize)]
pub struct TickLateness {
    /// Ticks of the last full second.
    pub second: Quantiles,
    /// All ticks.
    pub all: Quantiles,
    /// Number of ticks that were skipped because they were late by a period or more.
    pub skipped: u64,
}

/// The answer to a command.
#[derive(Clone, Debug, Deserialize, Eq, PartialEq, Serialize)]
pub struct CommandReply {
    /// Number of the command, from 1.
    pub number: u64,
    /// True if the command was carried out, false if it was refused.
    pub done: bool,
    /// Description of the action, or the command and the reason of the refusal.
    pub text: String,
}

/// One side of two pipes that carry lines of JSON.
#[derive(Debug)]
pub struct JsonPipe {
    input: OwnedFd,
    output: OwnedFd,
    /// Received bytes that have not been parsed.
    received: Vec<u8>,
    /// Sent bytes that have not been written.
    unwritten: Vec<u8>,
    ended: bool,
}

impl JsonPipe {
    /// Reads from one pipe and writes to another. Sets both to non-blocking.
    ///
    /// # Errors
    /// Returns [`io::Error`] if a pipe cannot be set to non-blocking.
    pub fn new(input: impl Into<OwnedFd>, output: impl Into<OwnedFd>) -> io::Result<Self> {
        let (input, output) = (input.into(), output.into());
        ioctl_fionbio(&input, true)?;
        ioctl_fionbio(&output, true)?;
        Ok(Self { input, output, received: Vec::new(), unwritten: Vec::new(), ended: false })
    }

    /// Returns true if the other side has ended.
    #[must_use]
    pub const fn has_ended(&self) -> bool {
        self.ended
    }

    /// Sends a value as one line. If the line before is not fully written, drops the value and returns false.
    pub fn send(&mut self, value: &impl Serialize) -> bool {
        self.flush();
        if self.ended || !self.unwritten.is_empty() {
            return false;
        }
        let Ok(mut line) = serde_json::to_vec(value) else { return false };
        line.push(b'\n');
        self.unwritten = line;
        self.flush();
        !self.ended
    }

    fn flush(&mut self) {
        while !self.unwritten.is_empty() {
            match write(&self.output, &self.unwritten) {
                Ok(written) => _ = self.unwritten.drain(..written),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return,
                Err(_) => {
                    self.ended = true;
                    self.unwritten.clear();
                }
            }
        }
    }

    /// Returns the value of the next line that has arrived. Skips lines that are too long or hold no such value.
    pub fn receive<T: DeserializeOwned>(&mut self) -> Option<T> {
        loop {
            if let Some(end) = self.received.iter().position(|&byte| byte == b'\n') {
                let line: Vec<_> = self.received.drain(..=end).collect();
                if let Ok(value) = serde_json::from_slice(&line) {
                    return Some(value);
                }
            } else if !self.read_available() {
                return None;
            }
        }
    }

    /// Reads the bytes that have arrived. Returns true if there were any.
    fn read_available(&mut self) -> bool {
        let mut chunk = [0; READ_CHUNK_BYTES];
        if self.received.len() > MAX_LINE_BYTES {
            self.received.clear();
        }
        match read(&self.input, &mut chunk) {
            Ok(0) => self.ended = true,
            Ok(count) => {
                self.received.extend(chunk.iter().take(count));
                return true;
            }
            Err(Errno::AGAIN | Errno::INTR) => {}
            Err(_) => self.ended = true,
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Write, pipe};

    /// Creates both sides of two pipes.
    fn pair() -> (JsonPipe, JsonPipe) {
        let ((one_in, two_out), (two_in, one_out)) = (pipe().unwrap(), pipe().unwrap());
        (JsonPipe::new(one_in, one_out).unwrap(), JsonPipe::new(two_in, two_out).unwrap())
    }

    #[test]
    fn commands_are_json_and_nothing_else_is_one() {
        let read = |text: &str| serde_json::from_str::<BenchCommand>(text).ok();
        let kill = BenchCommand::Process { action: ProcessAction::Kill, bus: 0, node: 12 };
        assert_eq!(read(r#"{"on":"process","action":"kill","bus":0,"node":12}"#), Some(kill));
        let link = BenchCommand::Link { down: true, bus: 1, nodes: [3, 4] };
        assert_eq!(read(r#"{"on":"link","down":true,"bus":1,"nodes":[3,4]}"#), Some(link));
        assert_eq!(
            read(r#"{"on":"bus","down":false,"bus":0}"#),
            Some(BenchCommand::Bus { down: false, bus: 0 })
        );
        for wrong in [
            r#"{"on":"process","action":"shoot","bus":0,"node":12}"#,
            r#"{"on":"process","action":"kill","bus":0,"node":256}"#,
            r#"{"on":"process","action":"kill","bus":-1,"node":1}"#,
            r#"{"on":"process","action":"kill","bus":0,"node":1,"pid":1}"#,
            r#"{"on":"link","down":true,"bus":1,"nodes":[3]}"#,
            r#"{"on":"bus","bus":0}"#,
            r#"{"on":"machine","down":true}"#,
        ] {
            assert_eq!(read(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn values_come_as_they_were_sent_and_other_lines_are_passed_over() {
        let (mut run, mut page) = pair();
        let command = BenchCommand::Bus { down: true, bus: 2 };
        assert_eq!(run.receive::<BenchCommand>(), None);
        assert!(page.send(&"no command") && page.send(&command) && page.send(&command));
        assert_eq!((run.receive(), run.receive()), (Some(command), Some(command)));
        assert_eq!((run.receive::<BenchCommand>(), run.has_ended()), (None, false));
        let answers = vec![CommandReply { number: 1, done: false, text: "\"a\"\nb".to_owned() }];
        let process = ProcessState { bus: 1, nodes: (1, 63), phase: Phase::Stopped };
        let state = BenchState { answers, processes: vec![process; 3_000], ..BenchState::default() };
        // The state is larger than a pipe.
        assert!(run.send(&state) && !run.send(&state));
        let mut received = None;
        while received.is_none() {
            received = page.receive::<BenchState>();
            run.flush();
        }
        assert_eq!(received, Some(state));
        drop(run);
        assert_eq!((page.receive::<BenchState>(), page.has_ended()), (None, true));
        assert!(!page.send(&command));
    }

    #[test]
    fn a_side_that_reads_nothing_or_ends_no_line_holds_nothing_up() {
        let (mut run, page) = pair();
        let sent = (0..100_000).take_while(|_| run.send(&BenchState::default())).count();
        assert!((100..10_000).contains(&sent), "{sent}: a pipe holds 64 KiB");
        assert!(!run.has_ended());
        drop(page);
        assert!(!run.send(&BenchState::default()) && run.has_ended());

        let ((input, mut other), (_reader, output)) = (pipe().unwrap(), pipe().unwrap());
        let mut lines = JsonPipe::new(input, output).unwrap();
        for _ in 0..40 {
            other.write_all(&[b'x'; 60_000]).unwrap();
            assert_eq!(lines.receive::<BenchCommand>(), None);
        }
        assert!(lines.received.len() <= MAX_LINE_BYTES + 60_000);
        other.write_all(b"\n{\"on\":\"bus\",\"down\":true,\"bus\":0}\n").unwrap();
        assert_eq!(lines.receive(), Some(BenchCommand::Bus { down: true, bus: 0 }));
    }
}
