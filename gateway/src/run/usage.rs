//! What processes cost, as the kernel counts it.

use std::fs;

/// Ticks of the kernel's clock in a second, as `/proc` has it on Linux.
const CLOCK_HZ: f64 = 100.0;

/// Processor time of a process so far, in s; nothing when it has ended.
#[must_use]
pub(super) fn processor_seconds(pid: u32) -> f64 {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    // The name, in parentheses, may hold anything; user and system time are the 14th and 15th fields.
    let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace();
    fields.skip(11).take(2).filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / CLOCK_HZ
}

/// Private memory of a process in KiB.
#[must_use]
pub(super) fn private_kib(pid: u32) -> Option<u64> {
    let map = fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).ok()?;
    let kib = |line: &str| line.split_whitespace().nth(1)?.parse::<u64>().ok();
    Some(map.lines().filter(|line| line.starts_with("Private_")).filter_map(kib).sum())
}
