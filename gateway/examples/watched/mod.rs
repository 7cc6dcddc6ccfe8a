//! Duration and memory use of a command, watched from outside.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// Path of the release build's program, one directory above the examples.
pub(crate) fn gateway_program() -> PathBuf {
    let program = std::env::current_exe().expect("this program has a path");
    program.parent().and_then(Path::parent).expect("it lies in a folder of the build").join("skinbus")
}

/// Runs a command. Returns its duration in s, and the peak memory of its process in MB.
pub(crate) fn run_measured(command: &mut Command) -> (f64, f64) {
    let begun = Instant::now();
    let mut child = command.spawn().expect("the release build's gateway: cargo build --release -p gateway");
    let status = Path::new("/proc").join(child.id().to_string()).join("status");
    let mut kib = 0.0_f64;
    let done = loop {
        let text = std::fs::read_to_string(&status).unwrap_or_default();
        let peak = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let peak = peak.and_then(|peak| peak.trim().trim_end_matches(" kB").parse().ok());
        kib = kib.max(peak.unwrap_or(0.0));
        if let Some(done) = child.try_wait().expect("it is a child of this program") {
            break done;
        }
        std::thread::sleep(Duration::from_millis(10));
    };
    assert!(done.success(), "{command:?}");
    (begun.elapsed().as_secs_f64(), kib / 1024.0)
}
