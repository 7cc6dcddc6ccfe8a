//! Two calls that have no safe wrapper, without any logic.

/// Asks for `SCHED_FIFO` for the calling thread; returns whether it was granted.
pub(super) fn set_fifo(priority: i32) -> bool {
    let parameters = libc::sched_param { sched_priority: priority };
    // SAFETY: the pointer is to a live, initialised struct, which the call only reads.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const parameters) == 0 }
}

/// Sets how much later than asked the kernel may wake the calling thread, in ns.
pub(super) fn set_timer_slack(nanos: u64) {
    // SAFETY: this option takes one integer and touches no memory of ours.
    let _ = unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, nanos) };
}
