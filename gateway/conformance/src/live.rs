//! The bus of a conformance test outside virtual time, and the command that switches the cell off and on.

mod probe;

use std::collections::VecDeque;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bench::bus::follow::receive_batch;
use bench::bus::listen;
use protocol::bus::{Bus as Socket, BusError, BusOptions, GATEWAY_RECEIVE_BUFFER_BYTES, Inbox, KindChoice};
use protocol::can::{Format, Frame};
use protocol::time::{Micros, Span};

use crate::bus::{ObservedFrame, StopReason, TestBus};
use probe::LatenessProbe;

/// The interval at which a termination signal is checked.
const SIGNAL_POLL_INTERVAL: Span = Span::from_millis(50);
/// The time limit for a restart.
const RESTART_TIMEOUT: Span = Span::from_millis(15_000);

/// An open bus with the cell under test.
#[derive(Debug)]
pub struct SocketBus {
    socket: Socket,
    inbox: Inbox,
    waiting: VecDeque<ObservedFrame>,
    stopped: Arc<AtomicBool>,
    obeys_signals: bool,
    late: Span,
    /// Measures this computer's lateness, if the cell may be a process on it.
    probe: Option<LatenessProbe>,
    command: Option<String>,
    child: Option<(Child, Micros)>,
}

impl SocketBus {
    /// Opens a bus. `stopped` interrupts the test; `command` switches the cell off and on.
    ///
    /// # Errors
    /// Returns [`BusError`] if the bus cannot be used as requested, or if frames take time on it.
    pub fn open(
        name: &str,
        kind: KindChoice,
        stopped: Arc<AtomicBool>,
        command: Option<String>,
    ) -> Result<Self, BusError> {
        let receive_buffer = GATEWAY_RECEIVE_BUFFER_BYTES as usize;
        let options = BusOptions { own_frames: true, receive_buffer, ..BusOptions::default() };
        // On a timed bus, stimuli and sync overtake what was sent before them.
        let socket = listen::open_bus(name, kind, None, options)?.without_time()?;
        let (inbox, waiting, late) = (Inbox::new(), VecDeque::new(), Span(0));
        let probe = socket.is_virtual().unwrap_or(false).then(LatenessProbe::new).transpose();
        let probe = probe.map_err(|source| BusError::Io {
            name: name.to_owned(),
            doing: "start a thread that watches delays for",
            source,
        })?;
        Ok(Self { socket, inbox, waiting, stopped, obeys_signals: true, late, probe, command, child: None })
    }

    fn is_interrupted(&self) -> bool {
        self.obeys_signals && self.stopped.load(Ordering::Relaxed)
    }
}

fn bus_failure(error: impl ToString) -> StopReason {
    StopReason::Bus(error.to_string())
}

impl TestBus for SocketBus {
    fn now(&self) -> Micros {
        listen::now()
    }

    fn supports_format(&self, format: Format) -> bool {
        // FD frames would disturb a real classic bus.
        format == Format::Classic || self.socket.carries_fd() && self.probe.is_some()
    }

    fn send(&mut self, frames: &[Frame]) -> Result<(), StopReason> {
        self.socket.send(frames).map_err(bus_failure)
    }

    fn receive(&mut self, until: Micros) -> Result<Option<ObservedFrame>, StopReason> {
        loop {
            if self.is_interrupted() {
                return Err(StopReason::Interrupted);
            }
            if let Some(seen) = self.waiting.pop_front() {
                return Ok(Some(seen));
            }
            let before = self.now();
            let wait = until.elapsed_since(before).min(SIGNAL_POLL_INTERVAL);
            let wait_time = Duration::from_micros(wait.0);
            let count = receive_batch(&self.socket, &mut self.inbox, wait_time).map_err(bus_failure)?;
            let now = self.now();
            if self.inbox.dropped_count() > 0 {
                let name = self.socket.name();
                return Err(StopReason::Bus(format!(
                    "{name}: frames were lost because they arrived faster than this program read them"
                )));
            }
            if count == 0 {
                self.late = self.late.max(now.elapsed_since(before + wait));
                if now >= until {
                    return Ok(None);
                }
                continue;
            }
            for received in self.inbox.frames() {
                let at = if received.at_nanos == 0 { now } else { Micros(received.at_nanos / 1_000) };
                self.late = self.late.max(now.elapsed_since(at));
                self.waiting.push_back(ObservedFrame { at, frame: received.frame, own: received.own });
            }
        }
    }

    fn bench_lateness(&mut self) -> Span {
        let probed = self.probe.as_ref().map_or(Span(0), LatenessProbe::lateness);
        core::mem::take(&mut self.late).max(probed)
    }

    fn ignore_signals(&mut self) {
        self.obeys_signals = false;
    }

    fn can_restart(&self) -> bool {
        self.command.is_some()
    }

    fn begin_restart(&mut self) -> Result<(), StopReason> {
        let Some(command) = &self.command else {
            return Err(StopReason::Restart(
                "restarting the cell needs the option --restart COMMAND".to_owned(),
            ));
        };
        let child = Command::new("sh")
            .args(["-c", command])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .map_err(|error| {
                StopReason::Restart(format!("--restart {command:?}: cannot run the command: {error}"))
            })?;
        self.child = Some((child, self.now()));
        Ok(())
    }

    fn is_restarting(&mut self) -> Result<bool, StopReason> {
        let now = self.now();
        let Some((child, began)) = &mut self.child else { return Ok(false) };
        let failed = |why: String| Err(StopReason::Restart(format!("the command of --restart {why}")));
        match child.try_wait() {
            Ok(Some(status)) => {
                self.child = None;
                if status.success() { Ok(false) } else { failed(format!("failed: {status}")) }
            }
            Ok(None) if now.elapsed_since(*began) > RESTART_TIMEOUT => {
                failed("did not end within 15 s".to_owned())
            }
            Ok(None) => Ok(true),
            Err(error) => failed(error.to_string()),
        }
    }
}
