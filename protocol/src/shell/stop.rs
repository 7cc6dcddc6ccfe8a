//! Requests to end, also while the reader of the output does not read.

use std::io::{self, Write};
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FileType, fstat};
use rustix::io::Errno;

/// How often a waiting program checks whether to end.
const LOOK: Duration = Duration::from_millis(100);
/// How many looks long a reader is waited for after that.
const LOOKS: u32 = 10;
/// What a pipe that takes anything takes at once, without waiting.
const PIECE: usize = 4_096;

/// Set by the signal handler when the program shall end.
#[must_use]
pub fn flag() -> &'static Arc<AtomicBool> {
    static FLAG: LazyLock<Arc<AtomicBool>> = LazyLock::new(Arc::default);
    &FLAG
}

/// Writes to a pipe or a terminal without being held up there when the program is to end: a reader who takes nothing
/// then is given a second, and the rest is an error.
#[derive(Debug)]
pub struct Stoppable<F> {
    file: F,
    /// Whether writing may have to wait.
    waits: bool,
    /// Looks that are left once the program is to end.
    looks: u32,
}

impl<F: AsFd> Stoppable<F> {
    /// Writes to a file of any kind.
    pub fn new(file: F) -> Self {
        let waits =
            fstat(&file).is_ok_and(|about| FileType::from_raw_mode(about.st_mode) != FileType::RegularFile);
        Self { file, waits, looks: LOOKS }
    }

    /// Waits until something can be written, or an error reported.
    fn wait(&mut self) -> io::Result<()> {
        let timeout = Timespec::try_from(LOOK).ok();
        loop {
            match poll(&mut [PollFd::new(&self.file, PollFlags::OUT)], timeout.as_ref()) {
                Ok(0) if flag().load(Ordering::Relaxed) => {
                    if self.looks == 0 {
                        return Err(io::Error::new(io::ErrorKind::TimedOut, "nobody reads it"));
                    }
                    self.looks -= 1;
                }
                Ok(0) | Err(Errno::INTR) => {}
                Ok(_) => return Ok(()),
                Err(errno) => return Err(errno.into()),
            }
        }
    }
}

impl<F: AsFd> Write for Stoppable<F> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if !self.waits {
            return Ok(rustix::io::write(&self.file, bytes)?);
        }
        let piece = bytes.get(..PIECE).unwrap_or(bytes);
        loop {
            self.wait()?;
            match rustix::io::write(&self.file, piece) {
                // Somebody else was quicker.
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
        Stoppable::new(write).write_all(&all).unwrap();
        assert_eq!(reader.join().unwrap(), all);
        // Nobody reads this one.
        let (_read, write) = io::pipe().unwrap();
        flag().store(true, Ordering::Relaxed);
        let mut out = Stoppable::new(File::from(std::os::fd::OwnedFd::from(write)));
        let error = out.write_all(&all).unwrap_err();
        flag().store(false, Ordering::Relaxed);
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
    }
}
