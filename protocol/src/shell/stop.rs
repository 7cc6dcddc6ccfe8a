//! Requests to stop, and a writer that obeys them even if the reader of the output blocks.

use std::io::{self, Write};
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FileType, fstat};
use rustix::io::Errno;

/// Interval at which a waiting writer checks for a stop request.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Number of intervals for which a writer still waits after a stop request.
const MAX_STOP_POLLS: u32 = 10;
/// Number of bytes that a writable pipe accepts without blocking (`PIPE_BUF`).
const MAX_WRITE_BYTES: usize = 4_096;

/// Returns the stop flag, which the signal handler sets.
#[must_use]
pub fn stop_flag() -> &'static Arc<AtomicBool> {
    static STOP_FLAG: LazyLock<Arc<AtomicBool>> = LazyLock::new(Arc::default);
    &STOP_FLAG
}

/// A writer for pipes and terminals. A reader that does not read blocks the writer only until a stop request: one
/// second later, the write returns an error.
#[derive(Debug)]
pub struct InterruptibleWriter<F> {
    file: F,
    /// True if the file is a pipe or terminal, where a write may block.
    waits: bool,
    /// Number of 100 ms intervals that remain after a stop request.
    polls_left: u32,
}

impl<F: AsFd> InterruptibleWriter<F> {
    /// Creates a writer for a file of any type.
    pub fn new(file: F) -> Self {
        let waits =
            fstat(&file).is_ok_and(|about| FileType::from_raw_mode(about.st_mode) != FileType::RegularFile);
        Self { file, waits, polls_left: MAX_STOP_POLLS }
    }

    /// Waits until the file is writable or has an error. Returns an error when the time after a stop request has
    /// passed.
    fn wait(&mut self) -> io::Result<()> {
        let timeout = Timespec::try_from(POLL_INTERVAL).ok();
        loop {
            match poll(&mut [PollFd::new(&self.file, PollFlags::OUT)], timeout.as_ref()) {
                Ok(0) if stop_flag().load(Ordering::Relaxed) => {
                    if self.polls_left == 0 {
                        let why = "the program at the other end does not read it";
                        return Err(io::Error::new(io::ErrorKind::TimedOut, why));
                    }
                    self.polls_left -= 1;
                }
                Ok(0) | Err(Errno::INTR) => {}
                Ok(_) => return Ok(()),
                Err(errno) => return Err(errno.into()),
            }
        }
    }
}

impl<F: AsFd> Write for InterruptibleWriter<F> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if !self.waits {
            return Ok(rustix::io::write(&self.file, bytes)?);
        }
        let piece = bytes.get(..MAX_WRITE_BYTES).unwrap_or(bytes);
        loop {
            self.wait()?;
            match rustix::io::write(&self.file, piece) {
                // Another process filled the pipe first.
                Err(Errno::AGAIN | Errno::INTR) => {}
                done => return Ok(done?),
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::io::Read;
    use std::thread;

    #[test]
    fn a_pipe_takes_everything_as_it_is_read_and_nothing_once_the_program_is_to_end() {
        let (mut read, write) = io::pipe().unwrap();
        let all: Vec<u8> = (0..200_000_u32).flat_map(u32::to_le_bytes).collect();
        let reader = thread::spawn(move || {
            let mut got = Vec::new();
            read.read_to_end(&mut got).unwrap();
            got
        });
        InterruptibleWriter::new(write).write_all(&all).unwrap();
        assert_eq!(reader.join().unwrap(), all);
        // This pipe has no reader.
        let (_read, write) = io::pipe().unwrap();
        stop_flag().store(true, Ordering::Relaxed);
        let mut out = InterruptibleWriter::new(File::from(std::os::fd::OwnedFd::from(write)));
        let error = out.write_all(&all).unwrap_err();
        stop_flag().store(false, Ordering::Relaxed);
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
    }
}
