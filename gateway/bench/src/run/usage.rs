//! Processor time and memory of processes, as the kernel counts them.

use std::collections::HashMap;
use std::fs;

use rustix::time::{ClockId, clock_gettime};

use crate::bus::served::ServedBus;
use crate::processes::Processes;
use crate::summary::ProcessorUse;

/// Processor time of this process so far in s.
fn own_processor_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    std::time::Duration::try_from(time).map_or(0.0, |time| time.as_secs_f64())
}

/// Processor time of another process so far in s, or `None` after its end.
///
/// Reads `schedstat`, which counts in ns: the usual figures are sampled a hundred times a second, and miss cells that
/// all wake up together for some µs.
fn processor_seconds(pid: u32) -> Option<f64> {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).ok()?;
    let nanos = threads.flatten().filter_map(|thread| {
        let text = fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<f64>().ok()
    });
    // A process that has ended but was not waited for still has a directory, without a time in it.
    nanos.reduce(|all, one| all + one).filter(|nanos| *nanos > 0.0).map(|nanos| nanos * 1e-9)
}

/// Private memory of a process in KiB.
#[must_use]
pub(super) fn private_memory_kib(pid: u32) -> Option<u64> {
    let map = fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).ok()?;
    let kib = |line: &str| line.split_whitespace().nth(1)?.parse::<u64>().ok();
    Some(map.lines().filter(|line| line.starts_with("Private_")).filter_map(kib).sum())
}

/// Processor times so far in s: of this program, of the cell processes and of the bus servers.
pub(super) struct ProcessorTimes {
    gateway: f64,
    /// Time of each cell process.
    cells: HashMap<u32, f64>,
    /// Time of each process that serves a bus.
    buses: HashMap<u32, f64>,
}

impl ProcessorTimes {
    /// Reads the times of this program, of cells and of bus servers.
    pub(super) fn measure(cells: &Processes, buses: &[ServedBus]) -> Self {
        let of = |pid: u32| Some((pid, processor_seconds(pid)?));
        Self {
            gateway: own_processor_seconds(),
            cells: cells.pids().filter_map(of).collect(),
            buses: buses.iter().filter_map(|bus| of(bus.pid())).collect(),
        }
    }

    /// Returns the processor use in cores since `before`, over the processes that still run.
    pub(super) fn cores_since(&self, before: &Self, seconds: f64) -> ProcessorUse {
        let since = |now: &HashMap<u32, f64>, before: &HashMap<u32, f64>| {
            // When a thread ends, its time is no longer counted, so the difference may be negative.
            let one = |(pid, spent): (&u32, &f64)| (spent - before.get(pid).unwrap_or(&0.0)).max(0.0);
            // Not `sum()`, which returns -0.0 without processes.
            now.iter().map(one).fold(0.0, |all, one| all + one) / seconds
        };
        ProcessorUse {
            gateway: (self.gateway - before.gateway) / seconds,
            cells: since(&self.cells, &before.cells),
            buses: since(&self.buses, &before.buses),
        }
    }
}
