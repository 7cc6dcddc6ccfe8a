//! The directory of a test, in which its benches run.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use protocol::bus::BusKind;
use rustix::process::Pid;
use tempfile::TempDir;

use super::running::{Running, all_processes, command_line, proc};
use super::{PRESSED, Summary, TIMEOUT, names, program, skin};

/// A temporary directory for one test, with its configuration files, results and embedded buses.
pub struct TestDir {
    directory: TempDir,
    /// The kind of bus on which the benches run.
    kind: BusKind,
}

impl TestDir {
    pub fn new() -> Self {
        Self::on(BusKind::Embedded)
    }

    /// Creates a directory whose benches run on buses of this kind.
    pub(super) fn on(kind: BusKind) -> Self {
        Self { directory: TempDir::new().unwrap(), kind }
    }

    /// Returns the kind of bus on which the benches run.
    pub const fn kind(&self) -> BusKind {
        self.kind
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Returns the directory of the embedded buses, the value of `SKINBUS_DIR`.
    pub fn buses(&self) -> PathBuf {
        self.path("buses")
    }

    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, text).unwrap();
        path
    }

    /// Writes an executable script. A separate process writes it: a child that another test starts meanwhile would
    /// inherit the open file, and until its `exec` the script would be busy (ETXTBSY).
    pub fn script(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        let mut writer = Command::new("install");
        writer.args(["-m", "700", "/dev/stdin"]).arg(&path).stdin(Stdio::piped());
        let mut writer = writer.spawn().unwrap();
        writer.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        assert!(writer.wait().unwrap().success(), "{}", path.display());
        path
    }

    pub fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }

    /// Returns the names of the files in the directory, sorted.
    pub fn files(&self) -> Vec<String> {
        names(self.directory.path())
    }

    /// Writes `skin.toml`: a number of cells on an arm, on one bus.
    pub fn skin(&self, cells: usize) -> PathBuf {
        self.write("skin.toml", &skin(cells))
    }

    /// Writes `scenario.toml`.
    pub fn scenario(&self, text: &str) -> PathBuf {
        self.write("scenario.toml", text)
    }

    /// Writes `skin.toml` and `scenario.toml` for a bench of eight cells that are all pressed.
    pub fn pressed(&self) {
        self.skin(8);
        self.scenario(PRESSED);
    }

    /// Returns a command in this directory; spaces separate its arguments.
    pub fn command(&self, name: &str, words: &str) -> Command {
        self.command_of(&program(name), words)
    }

    /// Returns a command that runs any program in this directory. Words such as `SKINBUS_TOKEN=x` go to its
    /// environment.
    pub fn command_of(&self, program: &Path, words: &str) -> Command {
        let mut command = Command::new(program);
        for word in words.split(' ').filter(|word| !word.is_empty()) {
            match word.split_once('=').filter(|(name, _)| name.starts_with("SKINBUS_")) {
                Some((name, value)) => command.env(name, value),
                None => command.arg(word),
            };
        }
        command.current_dir(self.directory.path()).env("SKINBUS_DIR", self.buses()).env("NO_COLOR", "1");
        command
    }

    pub fn start(&self, name: &str, words: &str) -> Running {
        Running::start(self.command(name, words))
    }

    /// Starts a bench of `skin.toml` and `scenario.toml` for some seconds, with a log and a summary.
    pub fn bench(&self, seconds: f64, more: &str) -> Running {
        self.start(
            "skinbus",
            &format!(
                "run skin.toml --bus-kind {} --scenario scenario.toml --duration {seconds} \
                 --candump run.log --overwrite --summary run.json {more}",
                self.kind
            ),
        )
    }

    /// Starts a bench like [`Self::bench`], and waits until its loop runs.
    pub fn running_bench(&self, seconds: f64, more: &str) -> Running {
        let bench = self.bench(seconds, more);
        bench.wait_for_loop();
        bench
    }

    /// Returns the summary that a bench has written.
    pub fn summary(&self) -> Summary {
        Summary(serde_json::from_str(&self.read("run.json")).unwrap())
    }

    /// Returns the running processes of this directory, with their command lines.
    pub fn processes(&self) -> Vec<(Pid, String)> {
        let mark = format!("SKINBUS_DIR={}", self.buses().display());
        let ours = |pid: &Pid| {
            let environment = fs::read(proc(*pid, "environ")).unwrap_or_default();
            environment.split(|&byte| byte == 0).any(|word| word == mark.as_bytes())
        };
        all_processes().into_iter().filter(ours).map(|pid| (pid, command_line(pid))).collect()
    }

    /// Waits until no process and no socket of this directory remains; panics if that takes too long.
    pub fn is_left_clean(&self) {
        let left = || {
            let processes = self.processes();
            if processes.is_empty() && !self.buses().exists() { None } else { Some(processes) }
        };
        let give_up = Instant::now() + TIMEOUT;
        while let Some(processes) = left() {
            let sockets = if self.buses().exists() { names(&self.buses()) } else { Vec::new() };
            assert!(Instant::now() < give_up, "left behind: {processes:?} {sockets:?}");
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}
