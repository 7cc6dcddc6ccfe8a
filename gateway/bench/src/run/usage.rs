//! What processes cost, as the kernel counts it.

use std::fs;

use rustix::time::{ClockId, clock_gettime};

/// Processor time of this process so far, in s.
#[must_use]
pub(super) fn own_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    std::time::Duration::try_from(time).map_or(0.0, |time| time.as_secs_f64())
}

/// Processor time of another process so far, in s; nothing when it has ended.
///
/// From `schedstat`, which counts ns: the usual figures are sampled a hundred times a second, and miss
/// cells that all wake up together for some µs.
#[must_use]
pub(super) fn processor_seconds(pid: u32) -> f64 {
    let Ok(threads) = fs::read_dir(format!("/proc/{pid}/task")) else { return 0.0 };
    let nanos = threads.flatten().filter_map(|thread| {
        let text = fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<f64>().ok()
    });
    nanos.sum::<f64>() * 1e-9
}

/// Private memory of a process in KiB.
#[must_use]
pub(super) fn private_kib(pid: u32) -> Option<u64> {
    let map = fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).ok()?;
    let kib = |line: &str| line.split_whitespace().nth(1)?.parse::<u64>().ok();
    Some(map.lines().filter(|line| line.starts_with("Private_")).filter_map(kib).sum())
}
