//! Processes that a test starts: their output, their end, and their child processes.

use std::fs;
use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};

use super::{TIMEOUT, reports_event, reports_event_on, signal, until};

/// A running process whose output is collected; it is ended when this value is dropped.
pub struct Running {
    child: Child,
    out: Output,
    err: Output,
}

/// The exit status and the complete output of a process.
#[derive(Debug)]
pub struct Ended {
    pub status: ExitStatus,
    pub stdout: String,
    pub stderr: String,
}

impl Ended {
    /// Returns the exit code, if a signal did not end the process.
    pub fn code(&self) -> Option<i32> {
        self.status.code()
    }

    /// Returns the signal that ended the process, if one did.
    pub fn signal(&self) -> Option<i32> {
        self.status.signal()
    }

    /// Checks that the process succeeded, and returns its result.
    pub fn succeeded(self) -> Self {
        assert_eq!(self.code(), Some(0), "{self:#?}");
        self
    }

    /// Returns the head of the table that a run prints below its verdict.
    pub fn head(&self) -> &str {
        let mut table = self.stdout.lines().skip_while(|line| !line.starts_with('┌'));
        table.nth(1).unwrap_or_else(|| panic!("no table: {self:#?}"))
    }

    /// Checks that the process ended with this exit code and one line on standard error, and returns that line.
    pub fn refusal(&self, code: i32) -> &str {
        assert_eq!((self.code(), self.stdout.as_str()), (Some(code), ""), "{self:#?}");
        let line = self.stderr.trim_end_matches('\n');
        assert!(!line.is_empty() && !line.contains('\n'), "one line: {self:#?}");
        line
    }
}

impl Running {
    pub fn start(mut command: Command) -> Self {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap_or_else(|error| panic!("{command:?}: {error}"));
        let out = Output::from_pipe(child.stdout.take().unwrap());
        let err = Output::from_pipe(child.stderr.take().unwrap());
        Self { child, out, err }
    }

    pub fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    pub fn signal(&self, it: Signal) {
        signal(self.pid(), it);
    }

    /// Waits for a text on standard error.
    pub fn wait_for_stderr(&self, words: &str) {
        self.err.wait_for(words);
    }

    /// Waits until a bench has reported an event of a cell.
    pub fn wait_for_event(&self, cell: u8, what: &str) {
        self.err.wait_until(what, |text| reports_event(text, cell, what));
    }

    /// Waits until a bench has reported an event of a cell on this bus.
    pub fn wait_for_event_on(&self, bus: &str, cell: u8, what: &str) {
        self.err.wait_until(what, |text| reports_event_on(text, bus, cell, what));
    }

    /// Waits until a bench's loop runs: progress lines then appear.
    pub fn wait_for_loop(&self) {
        self.err.wait_until("progress", |text| text.contains(" s  ") || text.contains("\nstarting\n"));
    }

    /// Waits for a text on standard output.
    pub fn wait_for_stdout(&self, words: &str) {
        self.out.wait_for(words);
    }

    /// Returns standard error so far.
    pub fn stderr(&self) -> String {
        self.err.text.lock().unwrap().clone()
    }

    /// Returns true if the program has not ended.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Waits until the process has ended, and returns its result.
    pub fn end(self) -> Ended {
        self.end_after(Duration::ZERO)
    }

    /// Waits until a process that takes the time `run` has ended, and returns its result.
    pub fn end_after(mut self, run: Duration) -> Ended {
        let give_up = Instant::now() + run + TIMEOUT;
        // Polling costs an emulated processor 2 % of its time.
        let look = Duration::from_millis(if run.is_zero() { 5 } else { 200 });
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(Instant::now() < give_up, "still running after {TIMEOUT:?}: {}", self.stderr());
            std::thread::sleep(look);
        };
        Ended { status, stdout: self.out.whole(), stderr: self.err.whole() }
    }

    /// Returns the processes of the bench's cells, each with its node ids.
    pub fn cells(&self) -> Vec<(Pid, String)> {
        let mark = format!("--with-parent {}", self.pid().as_raw_nonzero());
        let cell = |pid| {
            let line = command_line(pid) + " ";
            let (_, after) = line.split_once("--node ").or_else(|| line.split_once("--nodes "))?;
            let nodes = after.split(' ').next()?.to_owned();
            line.contains(&format!("{mark} ")).then_some((pid, nodes))
        };
        all_processes().into_iter().filter_map(cell).collect()
    }

    /// Returns the process of one cell.
    pub fn cell(&self, node: u8) -> Pid {
        let node = node.to_string();
        let found = self.cells().into_iter().find(|(_, nodes)| *nodes == node);
        found.unwrap_or_else(|| panic!("no process of cell {node}: {:?}", self.cells())).0
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// An output of a process, read as it comes.
struct Output {
    text: Arc<Mutex<String>>,
    reader: Option<JoinHandle<()>>,
}

impl Output {
    fn from_pipe(mut pipe: impl Read + Send + 'static) -> Self {
        let text = Arc::new(Mutex::new(String::new()));
        let shared = Arc::clone(&text);
        let read = move || {
            let mut bytes = [0; 4096];
            let mut all = Vec::new();
            while let Ok(count @ 1..) = pipe.read(&mut bytes) {
                all.extend_from_slice(&bytes[..count]);
                *shared.lock().unwrap() = String::from_utf8_lossy(&all).into_owned();
            }
        };
        Self { text, reader: Some(std::thread::spawn(read)) }
    }

    fn wait_for(&self, words: &str) {
        self.wait_until(words, |text| text.contains(words));
    }

    fn wait_until(&self, words: &str, said: impl Fn(&str) -> bool) {
        let give_up = Instant::now() + TIMEOUT;
        loop {
            let text = self.text.lock().unwrap().clone();
            if said(&text) {
                return;
            }
            let over = self.reader.as_ref().is_none_or(JoinHandle::is_finished);
            assert!(!over && Instant::now() < give_up, "never printed {words:?}, but this:\n{text}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits until the process has closed the output, and returns its complete text.
    fn whole(&mut self) -> String {
        let reader = self.reader.take().unwrap();
        until("the end of an output: a process still has it open", || reader.is_finished().then_some(()));
        reader.join().unwrap();
        self.text.lock().unwrap().clone()
    }
}

pub(crate) fn proc(pid: Pid, file: &str) -> PathBuf {
    PathBuf::from(format!("/proc/{}/{file}", pid.as_raw_nonzero()))
}

pub(crate) fn all_processes() -> Vec<Pid> {
    let entries = fs::read_dir("/proc").unwrap().flatten();
    entries.filter_map(|entry| Pid::from_raw(entry.file_name().to_str()?.parse().ok()?)).collect()
}

pub(crate) fn command_line(pid: Pid) -> String {
    let bytes = fs::read(proc(pid, "cmdline")).unwrap_or_default();
    String::from_utf8_lossy(&bytes).replace('\0', " ").trim_end().to_owned()
}
