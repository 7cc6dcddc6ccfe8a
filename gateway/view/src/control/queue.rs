//! Events that wait for their reader. The sender never waits: events that do not fit are dropped and counted.

use std::collections::VecDeque;
use std::io::Write;
use std::sync::{Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use super::event::ControlEvent;
use crate::lock_ignoring_poison;

/// The maximum number of bytes that wait.
const MAX_WAITING_BYTES: usize = 4 << 20;
/// The number of bytes that are written at once.
const WRITE_BYTES: usize = 64 << 10;

/// Events that wait to be written.
#[derive(Debug, Default)]
pub struct EventQueue {
    waiting: Mutex<WaitingLines>,
    changed: Condvar,
}

/// The reason why the last events were not read.
#[derive(Clone, Copy, Debug, Eq, PartialEq, thiserror::Error)]
pub enum UnreadEvents {
    /// The reader took too long.
    #[error("the last events were not read within {} s: read standard output to its end", .0.as_secs())]
    Slow(Duration),
    /// The reader closed its end, or the output failed.
    #[error("standard output was closed before the last event")]
    Closed,
}

#[derive(Debug, Default)]
struct WaitingLines {
    lines: VecDeque<Vec<u8>>,
    /// The number of bytes in `lines`, and in the lines that are being written.
    bytes: usize,
    dropped: u64,
    /// The number of dropped events that the reader knows of.
    reported_dropped: u64,
    /// True if no more events will come.
    is_complete: bool,
    /// True if the reader has closed its end.
    is_closed: bool,
}

impl EventQueue {
    /// Adds an event. Drops and counts it if too much waits already.
    pub fn push(&self, event: &ControlEvent) {
        let line = event_line(event);
        let mut waiting = self.lock();
        if waiting.is_closed {
            return;
        }
        if waiting.bytes + line.len() > MAX_WAITING_BYTES {
            waiting.dropped += 1;
            return;
        }
        waiting.add_dropped_count();
        waiting.add(line);
        drop(waiting);
        self.changed.notify_all();
    }

    /// Adds the last event, which is never dropped, and waits at most `timeout` until all events are written.
    ///
    /// # Errors
    /// Returns the reason why they are not.
    pub fn finish(&self, event: &ControlEvent, timeout: Duration) -> Result<(), UnreadEvents> {
        let until = Instant::now() + timeout;
        let mut waiting = self.lock();
        waiting.add_dropped_count();
        waiting.add(event_line(event));
        waiting.is_complete = true;
        self.changed.notify_all();
        while waiting.bytes > 0 && !waiting.is_closed {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(UnreadEvents::Slow(timeout));
            }
            waiting = match self.changed.wait_timeout(waiting, left) {
                Ok((waiting, _)) => waiting,
                Err(poisoned) => poisoned.into_inner().0,
            };
        }
        if waiting.is_closed { Err(UnreadEvents::Closed) } else { Ok(()) }
    }

    /// Writes the events as they come, until the last one is written or the reader has closed its end.
    pub fn write_to(&self, output: &mut impl Write) {
        loop {
            let mut waiting = self.lock();
            while waiting.lines.is_empty() {
                if waiting.is_complete {
                    return;
                }
                waiting = self.changed.wait(waiting).unwrap_or_else(std::sync::PoisonError::into_inner);
            }
            let mut text = Vec::new();
            while text.len() < WRITE_BYTES
                && let Some(line) = waiting.lines.pop_front()
            {
                text.extend(line);
            }
            drop(waiting);
            let written = output.write_all(&text).and_then(|()| output.flush());
            let mut waiting = self.lock();
            waiting.bytes -= text.len();
            if written.is_err() {
                waiting.is_closed = true;
                waiting.lines.clear();
                waiting.bytes = 0;
            }
            let is_closed = waiting.is_closed;
            drop(waiting);
            self.changed.notify_all();
            if is_closed {
                return;
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, WaitingLines> {
        lock_ignoring_poison(&self.waiting)
    }
}

impl WaitingLines {
    fn add(&mut self, line: Vec<u8>) {
        self.bytes += line.len();
        self.lines.push_back(line);
    }

    /// Adds an event with the number of dropped events, if the reader does not know it.
    fn add_dropped_count(&mut self) {
        if self.dropped > self.reported_dropped {
            self.reported_dropped = self.dropped;
            self.add(event_line(&ControlEvent::Dropped { count: self.dropped }));
        }
    }
}

fn event_line(event: &ControlEvent) -> Vec<u8> {
    let mut line = serde_json::to_vec(event).unwrap_or_default();
    line.push(b'\n');
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{self, Read, pipe};
    use std::sync::Arc;
    use std::thread;

    fn bus_event(up: bool) -> ControlEvent {
        ControlEvent::Bus { bus: "vcan0".to_owned(), up }
    }

    #[test]
    fn events_that_do_not_fit_are_counted_and_the_last_one_is_written() {
        let queue = Arc::new(EventQueue::default());
        let (mut reader, mut writer) = pipe().unwrap();
        let length = event_line(&bus_event(true)).len();
        let pushed = 2 * MAX_WAITING_BYTES / length;
        (0..pushed).for_each(|_| queue.push(&bus_event(true)));
        let writing = thread::spawn({
            let queue = Arc::clone(&queue);
            move || queue.write_to(&mut writer)
        });
        let reading = thread::spawn(move || {
            let mut text = String::new();
            reader.read_to_string(&mut text).unwrap();
            text
        });
        queue.finish(&bus_event(false), Duration::from_secs(10)).unwrap();
        writing.join().unwrap();
        let text = reading.join().unwrap();
        let lines: Vec<_> = text.lines().collect();
        let kept = MAX_WAITING_BYTES / length;
        assert_eq!(lines.len(), kept + 2);
        assert_eq!(lines[kept], format!(r#"{{"event":"dropped","count":{}}}"#, pushed - kept));
        assert_eq!(lines[kept + 1], r#"{"event":"bus","bus":"vcan0","up":false}"#);
    }

    #[test]
    fn a_reader_that_sleeps_or_has_gone_holds_nothing_up() {
        let queue = EventQueue::default();
        queue.push(&bus_event(true));
        let slow = queue.finish(&bus_event(false), Duration::from_millis(10));
        assert_eq!(slow, Err(UnreadEvents::Slow(Duration::from_millis(10))));

        struct Gone;
        impl Write for Gone {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(io::ErrorKind::BrokenPipe.into())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let queue = EventQueue::default();
        queue.push(&bus_event(true));
        queue.write_to(&mut Gone);
        queue.push(&bus_event(true));
        assert_eq!(queue.finish(&bus_event(false), Duration::from_secs(10)), Err(UnreadEvents::Closed));
    }
}
