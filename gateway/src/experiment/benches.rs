//! Benches of experiments: runs of this program, started again as from a shell.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bench::summary::Outcome;
use paper::arm::{self, ReplyMode};
use paper::moving::BenchRun;
use paper::scale::ScaleBench;
use paper::{Effort, recorded};
use protocol::id::CellId;
use protocol::skin::Skin;
use protocol::usage::Failure;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use trace::files::write_atomically;

use crate::buses;

/// Settings that all benches share.
#[derive(Debug)]
pub(super) struct BenchRunner {
    /// Directory for the skins, scenarios, recordings and summaries of the benches.
    pub(super) folder: PathBuf,
    /// Flag that ends the bench.
    pub(super) stop: Arc<AtomicBool>,
}

/// Interval between checks whether a bench has ended.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Paths of the files of one run.
struct RunFiles {
    skin: PathBuf,
    scenario: PathBuf,
    summary: PathBuf,
    recording: Option<PathBuf>,
}

impl BenchRunner {
    /// Runs `skinbus run` on the arm and reads the recording.
    pub(super) fn run_arm_bench(&self, reply: ReplyMode, effort: Effort) -> Result<BenchRun, Failure> {
        let name = arm::run_file_name(reply);
        let what = format!("moving-arm bench ({name})");
        let file = |end: &str| self.folder.join(format!("arm-{name}{end}"));
        let recording = file(".mcap");
        let files = RunFiles {
            skin: file(".toml"),
            scenario: self.folder.join("arm-touches.toml"),
            summary: file(".json"),
            recording: Some(recording.clone()),
        };
        let text = arm::skin_toml(reply, effort);
        let texts = [text.as_str(), arm::scenario_toml(effort)];
        let buses = buses::private_directory("experiment")?;
        let ended = self.run_to_end(&what, &files, texts, 1, buses.path())?;
        if !ended.status.success() {
            return Err(bench_failure(&what, &last_message(&ended)));
        }
        let rows = recorded::read(&recording).map_err(|error| file_error(&what, &recording, &error))?;
        let summary = read_summary(&what, &files.summary)?;
        let joints = Skin::parse("the arm's skin", &text).map_err(Failure::run_error)?.robot.joints.len();
        if rows.is_empty() {
            return Err(file_error(&what, &recording, &"it contains no ticks"));
        }
        Ok(BenchRun { rows, summary, joints })
    }

    /// Runs `skinbus run` on a bench, with each bus's cells in one process, and returns its summary. Accepts the
    /// summary of a run that failed or was halted because the machine is too slow for it, but returns an error if cells
    /// failed.
    pub(super) fn run_scaled(&self, bench: &ScaleBench) -> Result<Value, Failure> {
        let what = format!("bench of {} cells ({})", bench.cells, bench.name());
        let buses = buses::private_directory("experiment")?;
        // Files that can be generated again go into a temporary directory.
        let files = RunFiles {
            skin: buses.path().join("skin.toml"),
            scenario: buses.path().join("scenario.toml"),
            summary: self.folder.join(format!("{}.json", bench.name())),
            recording: None,
        };
        let texts = [bench.skin_toml(), bench.scenario_toml()];
        let texts = texts.each_ref().map(String::as_str);
        let ended = self.run_to_end(&what, &files, texts, CellId::MAX.get(), buses.path())?;
        let is_invalid = |outcome: Outcome| ended.status.code() == Some(outcome.exit_code().into());
        let is_invalid = [Outcome::CellError, Outcome::NoController].into_iter().any(is_invalid);
        if files.summary.exists() && !is_invalid {
            read_summary(&what, &files.summary)
        } else {
            Err(bench_failure(&what, &last_message(&ended)))
        }
    }

    /// Writes the files of a run, and runs it to its end on embedded buses in a directory.
    fn run_to_end(
        &self,
        what: &str,
        files: &RunFiles,
        texts: [&str; 2],
        cells_per_process: u8,
        buses: &Path,
    ) -> Result<Output, Failure> {
        for (path, text) in [&files.skin, &files.scenario].into_iter().zip(texts) {
            write_atomically(path, text, true).map_err(|error| file_error(what, path, &error))?;
        }
        let own = std::env::current_exe().map_err(|error| file_error(what, Path::new("skinbus"), &error))?;
        let mut command = Command::new(&own);
        command.arg("run").arg(&files.skin).arg("--scenario").arg(&files.scenario);
        command.arg("--summary").arg(&files.summary).args(["--bus-kind", "embedded", "--quiet"]);
        command.arg("--cells-per-process").arg(cells_per_process.to_string());
        if let Some(path) = &files.recording {
            command.arg("--record").arg(path);
        }
        command.env("SKINBUS_DIR", buses).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        self.wait_for_command(command).map_err(|error| file_error(what, &own, &error))
    }

    /// Waits for the end of the bench; a signal ends it early.
    fn wait_for_command(&self, mut command: Command) -> io::Result<Output> {
        let mut child = command.spawn()?;
        let mut stated = false;
        while child.try_wait()?.is_none() {
            if !stated && self.stop.load(Ordering::Relaxed) {
                stated = true;
                // If the bench has just ended, the signal reaches no process, which is harmless.
                let _ = kill_process(Pid::from_child(&child), Signal::INT);
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        child.wait_with_output()
    }
}

fn bench_failure(what: &str, error: &dyn std::fmt::Display) -> Failure {
    Failure::run_error(format!("{what}: {error}"))
}

fn file_error(what: &str, path: &Path, error: &dyn std::fmt::Display) -> Failure {
    bench_failure(what, &format_args!("{}: {error}", path.display()))
}

/// Returns the last line that a run printed.
fn last_message(ended: &Output) -> String {
    let said = String::from_utf8_lossy(&ended.stderr);
    let last = said.trim_end().lines().last().unwrap_or("it printed nothing").to_owned();
    last.strip_prefix("skinbus: ").map(str::to_owned).unwrap_or(last)
}

fn read_summary(what: &str, path: &Path) -> Result<Value, Failure> {
    let text = fs::read_to_string(path).map_err(|error| file_error(what, path, &error))?;
    serde_json::from_str(&text).map_err(|error| file_error(what, path, &error))
}
