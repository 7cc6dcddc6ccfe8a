//! Where commands read from, when somebody may say stop meanwhile.

use std::fs::File;
use std::io::{self, Read};
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bench::signals::caught;
use protocol::stop;
use protocol::usage::Failure;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use signal_hook::consts::{SIGINT, SIGTERM};
use trace::capture::Reader;

/// How long a signal to end may wait, when nothing comes.
pub(crate) const LOOK: Duration = Duration::from_millis(200);

/// A flag that SIGINT and SIGTERM set.
pub(crate) fn stopped() -> Result<Arc<AtomicBool>, Failure> {
    caught(&[SIGINT, SIGTERM]).map_err(Failure::run)
}

/// Opens a capture, standard input or the parts of a recording, so that its reader can be told to stop. Signals are caught
/// from when a file is open: one that ends the program while it waits for a pipe's other end has nothing to put in order.
pub(crate) fn captures(
    sources: &[PathBuf],
    through: impl Fn(Interruptible) -> Box<dyn Read + Send> + Send + 'static,
) -> Result<Reader, Failure> {
    let flag = OnceLock::new();
    let interruptible = move |file| {
        // Once, however many parts there are. Where signals cannot be caught they end the program at once.
        let caught = || stopped().unwrap_or_else(|_| Arc::clone(stop::flag()));
        through(Interruptible { file, stopped: Arc::clone(flag.get_or_init(caught)) })
    };
    if let [one] = sources
        && one.as_os_str() == "-"
    {
        let input = io::stdin().as_fd().try_clone_to_owned();
        let input = input.map_err(|error| Failure::run(format!("standard input: {error}")))?;
        return Reader::from_read("standard input", interruptible(input.into())).map_err(Failure::usage);
    }
    Reader::open_through(sources, Box::new(interruptible)).map_err(Failure::usage)
}

/// A file whose reader can be told to stop: then it is at its end.
pub(crate) struct Interruptible {
    pub(crate) file: File,
    pub(crate) stopped: Arc<AtomicBool>,
}

impl Read for Interruptible {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let timeout = Timespec::try_from(LOOK).ok();
        while !self.stopped.load(Ordering::Relaxed) {
            match poll(&mut [PollFd::new(&self.file, PollFlags::IN)], timeout.as_ref()) {
                Ok(0) | Err(rustix::io::Errno::INTR) => {}
                Ok(_) => return self.file.read(buffer),
                Err(errno) => return Err(errno.into()),
            }
        }
        Ok(0)
    }
}
