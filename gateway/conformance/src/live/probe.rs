//! The lateness of this computer, measured by a thread that sleeps and checks when it is woken. A cell that is a
//! process on this computer waits for a processor in the same way.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use bench::bus::listen::now;
use protocol::time::Span;

/// The time that the thread sleeps before each measurement.
const SLEEP_TIME: Duration = Duration::from_millis(1);

#[derive(Debug, Default)]
struct ProbeState {
    /// The time at which the thread should be woken, in us.
    due: AtomicU64,
    /// The maximum lateness, in us.
    late: AtomicU64,
    over: AtomicBool,
}

/// A handle of the thread, which ends when this handle is dropped.
#[derive(Debug)]
pub(super) struct LatenessProbe(Arc<ProbeState>);

impl LatenessProbe {
    pub(super) fn new() -> io::Result<Self> {
        let shared = Arc::new(ProbeState::default());
        shared.due.store(u64::MAX, Ordering::Relaxed);
        let own = Arc::clone(&shared);
        thread::Builder::new().spawn(move || {
            // Cells do the same.
            protocol::bus::set_batch_scheduling();
            while !own.over.load(Ordering::Relaxed) {
                let due = now().0 + 1_000;
                own.due.store(due, Ordering::Relaxed);
                thread::sleep(SLEEP_TIME);
                own.late.fetch_max(now().0.saturating_sub(due), Ordering::Relaxed);
            }
        })?;
        Ok(Self(shared))
    }

    /// Returns the maximum lateness since the last call, including the lateness of a present wait.
    pub(super) fn lateness(&self) -> Span {
        let waits = now().0.saturating_sub(self.0.due.load(Ordering::Relaxed));
        Span(self.0.late.swap(0, Ordering::Relaxed).max(waits))
    }
}

impl Drop for LatenessProbe {
    fn drop(&mut self) {
        self.0.over.store(true, Ordering::Relaxed);
    }
}
