//! How late this computer is: a thread that sleeps and looks when it is woken. A cell that is a process here waits for a
//! processor as that does.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use bench::bus::listen::now;
use protocol::time::Span;

/// How long it sleeps.
const SLEEP: Duration = Duration::from_millis(1);

#[derive(Debug, Default)]
struct Shared {
    /// When it has to be woken, in us.
    due: AtomicU64,
    /// By how much it was late at most.
    late: AtomicU64,
    over: AtomicBool,
}

/// The thread, which ends with this.
#[derive(Debug)]
pub(super) struct Probe(Arc<Shared>);

impl Probe {
    pub(super) fn new() -> io::Result<Self> {
        let shared = Arc::new(Shared::default());
        shared.due.store(u64::MAX, Ordering::Relaxed);
        let own = Arc::clone(&shared);
        thread::Builder::new().spawn(move || {
            // As a cell does.
            protocol::bus::never_interrupt();
            while !own.over.load(Ordering::Relaxed) {
                let due = now().0 + 1_000;
                own.due.store(due, Ordering::Relaxed);
                thread::sleep(SLEEP);
                own.late.fetch_max(now().0.saturating_sub(due), Ordering::Relaxed);
            }
        })?;
        Ok(Self(shared))
    }

    /// By how much it was late at most since this was called last, or is now.
    pub(super) fn lateness(&self) -> Span {
        let waits = now().0.saturating_sub(self.0.due.load(Ordering::Relaxed));
        Span(self.0.late.swap(0, Ordering::Relaxed).max(waits))
    }
}

impl Drop for Probe {
    fn drop(&mut self) {
        self.0.over.store(true, Ordering::Relaxed);
    }
}
