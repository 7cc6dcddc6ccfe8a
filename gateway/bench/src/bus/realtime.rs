//! Clock of the control loop: absolute deadlines, and the privileges that the machine grants to the loop's thread.

use std::sync::atomic::Ordering;
use std::thread;
use std::time::{SystemTime, UNIX_EPOCH};

use hdrhistogram::Histogram;
use protocol::can::Frame;
use protocol::time::Micros;
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::thread::{ClockId, clock_nanosleep_absolute};
use rustix::time::{Timespec, clock_gettime};

use crate::system_calls;
use control::cycle::Tick;
use control::cycle::turn::{SharedRunState, TickDriver};
use protocol::quantiles::histogram;

/// Priority of the control loop: above ordinary threads, below the kernel's own.
const CONTROL_LOOP_PRIORITY: i32 = 40;
/// Priority of a receiver: above simulated cells on the same processor, so that it reads what they send in time.
const RECEIVER_PRIORITY: i32 = 30;

/// Number of wake-ups measured on the idle machine.
const MEASURED_IDLE_WAKEUPS: u32 = 100;

/// Privileges that the machine granted to a thread.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct GrantedPrivileges {
    /// True if the thread runs with `SCHED_FIFO`.
    pub fifo: bool,
    /// True if all memory is locked.
    pub locked: bool,
}

/// Requests `SCHED_FIFO`, locked memory and punctual wake-ups for the calling thread. Returns the privileges that the
/// machine granted.
pub fn request_realtime() -> GrantedPrivileges {
    let granted = GrantedPrivileges {
        fifo: system_calls::set_fifo(CONTROL_LOOP_PRIORITY),
        // Lock only touched pages: locking each thread's whole stack would exceed the limit.
        locked: mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT).is_ok(),
    };
    system_calls::set_timer_slack(1);
    granted
}

/// Requests `SCHED_FIFO` for a receiver's thread, with a priority below that of the control loop.
pub(crate) fn prepare_receiver() {
    system_calls::set_fifo(RECEIVER_PRIORITY);
}

/// Monotonic clock in ns.
#[must_use]
pub fn monotonic_ns() -> u64 {
    let Timespec { tv_sec, tv_nsec } = clock_gettime(ClockId::Monotonic);
    u64::try_from(tv_sec).unwrap_or(0) * 1_000_000_000 + u64::try_from(tv_nsec).unwrap_or(0)
}

/// Wall clock in ns since 1970.
#[must_use]
pub fn wall_clock_ns() -> u64 {
    let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(wall.as_nanos()).unwrap_or(u64::MAX)
}

/// Sleeps until the monotonic clock reads `deadline` ns. Signals do not end the sleep.
pub(crate) fn sleep_until(deadline: u64) {
    let seconds = i64::try_from(deadline / 1_000_000_000).unwrap_or(i64::MAX);
    let nanos = i64::try_from(deadline % 1_000_000_000).unwrap_or(0);
    let until = Timespec { tv_sec: seconds, tv_nsec: nanos };
    while clock_nanosleep_absolute(ClockId::Monotonic, &until)
        .is_err_and(|errno| errno == rustix::io::Errno::INTR)
    {}
}

/// Measures how late this machine wakes a punctual, idle thread, in ns, at the period of a loop.
pub(crate) fn idle_lateness(period_ns: u64) -> Histogram<u64> {
    let measure = move || {
        request_realtime();
        let (mut histogram, mut deadline) = (histogram(), monotonic_ns());
        for _ in 0..MEASURED_IDLE_WAKEUPS {
            deadline += period_ns;
            sleep_until(deadline);
            // The histogram resizes itself, so recording cannot fail.
            let _ = histogram.record(monotonic_ns().saturating_sub(deadline));
        }
        histogram
    };
    let measuring = thread::Builder::new().spawn(measure).ok();
    measuring.and_then(|measuring| measuring.join().ok()).unwrap_or_else(histogram)
}

/// Runs `ticks` ticks, or fewer if the loop is stopped. Skips whole periods that were missed; never resets the phase.
pub fn run_ticks(
    turn: &mut TickDriver,
    shared: &SharedRunState,
    period_ns: u64,
    ticks: u64,
    mut send: impl FnMut(usize, &[Frame]) -> bool,
) {
    let start = monotonic_ns() + period_ns;
    let mut number = 0;
    while number < ticks && !shared.stop_loop.load(Ordering::Relaxed) {
        let mut due = start + number * period_ns;
        sleep_until(due);
        let skipped = monotonic_ns().saturating_sub(due) / period_ns;
        number += skipped;
        due += skipped * period_ns;
        let tick = Tick { number, time: Micros((due - start) / 1_000) };
        turn.run_tick(tick, skipped, due, monotonic_ns, &mut send);
        number += 1;
    }
}
