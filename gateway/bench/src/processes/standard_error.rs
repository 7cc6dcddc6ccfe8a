//! Standard error of the cells' processes: one pipe for all of them, which is read when the end of a process is
//! noticed.
//!
//! A process writes its reason before it ends, so the reason has arrived by then.

use std::io::{self, ErrorKind, PipeReader, PipeWriter, Read, pipe};
use std::process::Command;

use protocol::last_words::{CellRange, ExitReason};
use protocol::usage::eprint_line;
use rustix::io::ioctl_fionbio;

/// Prefix of each line from a cell's process.
const LINE_PREFIX: &str = "cell-node: ";

/// Maximum length in bytes of an incomplete line.
const MAX_LINE_BYTES: usize = 1 << 16;

/// Standard error of the cells' processes.
#[derive(Debug)]
pub(super) struct StandardErrorPipe {
    read: PipeReader,
    write: PipeWriter,
    /// Beginning of a line whose end has not arrived.
    unread: Vec<u8>,
    /// Reasons that processes gave before they ended and that have not been fetched.
    words: Vec<ExitReason>,
}

impl StandardErrorPipe {
    /// Creates the pipe.
    ///
    /// # Errors
    /// Returns [`io::Error`] if the system grants no pipe.
    pub(super) fn new() -> io::Result<Self> {
        let (read, write) = pipe()?;
        ioctl_fionbio(&read, true)?;
        Ok(Self { read, write, unread: Vec::new(), words: Vec::new() })
    }

    /// Makes the pipe the standard error of a program to be started.
    ///
    /// # Errors
    /// Returns [`io::Error`] if too many files are open.
    pub(super) fn attach_to(&self, command: &mut Command) -> io::Result<()> {
        command.stderr(self.write.try_clone()?);
        Ok(())
    }

    /// Reads all that has arrived. Keeps reasons; passes other lines on to the standard error of this program.
    pub(super) fn read_available(&mut self) {
        let mut chunk = [0; 4_096];
        loop {
            match self.read.read(&mut chunk) {
                Ok(count @ 1..) => self.unread.extend(chunk.iter().take(count)),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                // The pipe is empty.
                Ok(0) | Err(_) => break,
            }
        }
        while let Some(end) = self.unread.iter().position(|&byte| byte == b'\n') {
            let line: Vec<_> = self.unread.drain(..=end).collect();
            self.handle_line(&String::from_utf8_lossy(line.strip_suffix(b"\n").unwrap_or(&line)));
        }
        if self.unread.len() > MAX_LINE_BYTES {
            eprint_line(&String::from_utf8_lossy(&core::mem::take(&mut self.unread)));
        }
    }

    fn handle_line(&mut self, line: &str) {
        match line.strip_prefix(LINE_PREFIX).and_then(ExitReason::parse) {
            Some(words) => self.words.push(words),
            None => eprint_line(line),
        }
    }

    /// Removes the reason that a process of cells gave, and returns it.
    pub(super) fn take_exit_reason(&mut self, bus: &str, (first, last): (u8, u8)) -> Option<String> {
        let cells = CellRange(first, last);
        let at = self.words.iter().position(|words| words.cells == cells && words.bus == bus)?;
        Some(self.words.remove(at).why)
    }
}

impl Drop for StandardErrorPipe {
    fn drop(&mut self) {
        self.read_available();
        if !self.unread.is_empty() {
            eprint_line(&String::from_utf8_lossy(&self.unread));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    #[test]
    fn last_words_are_kept_by_process_and_come_in_any_pieces() {
        let mut error = StandardErrorPipe::new().unwrap();
        error.write.write_all(b"cell-node: cell 3 on vcan0 ends: no ").unwrap();
        error.read_available();
        assert_eq!(error.take_exit_reason("vcan0", (3, 3)), None);
        error.write.write_all(b"memory\ncell-node: cells 1 to 4 on vcan1 end: other\n").unwrap();
        error.write.write_all(b"cell-node: cell 3 on vcan0 ends: again\n").unwrap();
        error.read_available();
        assert_eq!(error.take_exit_reason("vcan1", (3, 3)), None);
        let two = [error.take_exit_reason("vcan0", (3, 3)), error.take_exit_reason("vcan0", (3, 3))];
        assert_eq!(two, [Some("no memory".to_owned()), Some("again".to_owned())]);
        assert_eq!(error.take_exit_reason("vcan1", (1, 4)), Some("other".to_owned()));
        assert!(error.words.is_empty() && error.unread.is_empty());
    }
}
