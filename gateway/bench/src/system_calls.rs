//! Wrappers of three system calls that have no safe wrapper elsewhere. They contain no other logic.

use std::os::unix::process::CommandExt;
use std::process::Command;

use rustix::process::{Signal, getpid, getppid, set_parent_process_death_signal};

/// Requests `SCHED_FIFO` for the calling thread. Returns true if it was granted.
pub(crate) fn set_fifo(priority: i32) -> bool {
    let parameters = libc::sched_param { sched_priority: priority };
    // SAFETY: the pointer is to a live, initialised struct, which the call only reads.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const parameters) == 0 }
}

/// Sets the slack in ns by which the kernel may delay wake-ups of the calling thread.
pub(crate) fn set_timer_slack(nanos: u64) {
    // SAFETY: this option takes one integer and touches no memory of ours.
    let _ = unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, nanos) };
}

/// Makes the kernel kill a program when the thread that has started it ends. The programs of this project arrange this
/// themselves.
pub(crate) fn end_with_parent(command: &mut Command) {
    let parent = getpid();
    let before_exec = move || {
        set_parent_process_death_signal(Some(Signal::KILL))?;
        // The parent may have ended before that call.
        if getppid() == Some(parent) { Ok(()) } else { Err(std::io::ErrorKind::NotFound.into()) }
    };
    // SAFETY: between fork and exec only two system calls are made, and nothing is allocated or locked.
    unsafe { command.pre_exec(before_exec) };
}
