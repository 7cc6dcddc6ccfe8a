//! The moving arm's benches: this program again, as from a shell.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use paper::arm::{self, Reply};
use paper::moving::Run;
use paper::{Effort, recorded};
use protocol::skin::Skin;
use protocol::usage::Failure;
use rustix::process::{Pid, Signal, kill_process};
use trace::files::write_whole;

use crate::arguments::Programs;
use crate::buses;

/// Where benches are run, and with what.
#[derive(Debug)]
pub(super) struct Benches {
    /// For their skins, scenarios, recordings and summaries.
    pub(super) folder: PathBuf,
    pub(super) programs: Programs,
    /// Set when it has to end.
    pub(super) stop: Arc<AtomicBool>,
}

/// How often it is looked whether a bench has ended.
const LOOK: Duration = Duration::from_millis(50);

impl Benches {
    /// Runs `gateway run` on the arm and reads what it recorded.
    pub(super) fn run(&self, reply: Reply, effort: Effort) -> Result<Run, Failure> {
        let name = arm::name(reply);
        let file = |end: &str| self.folder.join(format!("arm-{name}{end}"));
        let failed = |path: &Path, error: &dyn std::fmt::Display| {
            Failure::run(format!("the bench of the moving arm ({name}): {}: {error}", path.display()))
        };
        let text = arm::skin(reply, effort);
        let [skin, scenario, recording, summary] =
            [file(".toml"), self.folder.join("arm-touches.toml"), file(".mcap"), file(".json")];
        for (path, text) in [(&skin, text.as_str()), (&scenario, arm::scenario(effort))] {
            write_whole(path, text, true).map_err(|error| failed(path, &error))?;
        }
        let own = std::env::current_exe().map_err(|error| failed(Path::new("gateway"), &error))?;
        let buses = buses::directory("experiment")?;
        let mut command = Command::new(&own);
        command.arg("run").arg(&skin).arg("--scenario").arg(&scenario).arg("--record").arg(&recording);
        command.arg("--summary").arg(&summary).args(["--bus-kind", "embedded", "--quiet"]);
        let Programs { cells_per_process, cell_node, vcan_setup } = &self.programs;
        command.arg("--cells-per-process").arg(cells_per_process.to_string());
        for (option, path) in [("--cell-node", cell_node), ("--vcan-setup", vcan_setup)] {
            if let Some(path) = path {
                command.arg(option).arg(path);
            }
        }
        command
            .env("SKINBUS_DIR", buses.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        let ended = self.wait(command).map_err(|error| failed(&own, &error))?;
        if !ended.status.success() {
            let said = String::from_utf8_lossy(&ended.stderr);
            let last = said.trim_end().lines().last().unwrap_or("it printed nothing").to_owned();
            let last = last.strip_prefix("gateway: ").unwrap_or(&last);
            return Err(Failure::run(format!("the bench of the moving arm ({name}): {last}")));
        }
        let rows = recorded::read(&recording).map_err(|error| failed(&recording, &error))?;
        let text = fs::read_to_string(&summary).map_err(|error| failed(&summary, &error))?;
        let summary = serde_json::from_str(&text).map_err(|error| failed(&summary, &error))?;
        let joints = Skin::parse("the arm's skin", &arm::skin(reply, effort))
            .map_err(Failure::run)?
            .robot
            .joints
            .len();
        if rows.is_empty() {
            return Err(failed(&recording, &"it has no ticks"));
        }
        Ok(Run { rows, summary, joints })
    }
}

impl Benches {
    /// Waits for the bench's end, which a signal makes early.
    fn wait(&self, mut command: Command) -> io::Result<Output> {
        let mut child = command.spawn()?;
        let mut stated = false;
        while child.try_wait()?.is_none() {
            if !stated && self.stop.load(Ordering::Relaxed) {
                stated = true;
                // If it has just ended, no process gets the signal.
                let _ = kill_process(Pid::from_child(&child), Signal::INT);
            }
            std::thread::sleep(LOOK);
        }
        child.wait_with_output()
    }
}
