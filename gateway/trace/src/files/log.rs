//! Log files. Unlike result files, they have their name while they grow, so that other programs can follow them.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use protocol::input::parent_folder;
use protocol::stop::InterruptibleWriter;
use rustix::fs::{Access, access};

use super::target::{
    OutputTarget, device_and_inode, lock_exclusively, open_no_follow, open_stream, path_with_suffix,
    still_names_file, sync_folder, temporary_name, with_creation_hint, with_exists_hint,
    write_all_with_retries,
};

/// A log file. It has its name from the start and is locked against other writers. It always ends with a complete line.
/// An existing file is replaced when the first line is written.
#[derive(Debug)]
pub struct LogFile {
    path: PathBuf,
    state: LogTarget,
    /// The number of bytes written.
    bytes: u64,
    ended: bool,
}

#[derive(Debug)]
enum LogTarget {
    /// A regular file that this log has created.
    Opened(File),
    /// An existing file of the same name. It stays until the first line is written, and is locked until then.
    ToReplace(File),
    /// A stream such as a terminal, which has no length and no lock.
    Stream(InterruptibleWriter<File>),
}

impl LogFile {
    /// Begins a log. If `path` is a FIFO, waits until it has a reader or `stopped` is set.
    ///
    /// # Errors
    /// Returns an error, with advice to the user, if the file cannot be written.
    pub fn create(path: &Path, force: bool, stopped: &AtomicBool) -> io::Result<Self> {
        let state = match OutputTarget::inspect_target(path, force) {
            Ok(OutputTarget::Stream) => {
                LogTarget::Stream(InterruptibleWriter::new(open_stream(path, stopped)?))
            }
            Ok(OutputTarget::New) => LogTarget::Opened(create_locked(path)?),
            Ok(OutputTarget::Existing) => {
                // If the file was replaced by a symlink meanwhile, the link is not followed.
                let old = open_no_follow(path).map_err(with_creation_hint)?;
                lock_log(&old)?;
                // Missing write access to the folder is reported now, not when the first line is written.
                let writes = access(parent_folder(path), Access::WRITE_OK | Access::EXEC_OK);
                writes.map_err(|errno| with_creation_hint(errno.into()))?;
                LogTarget::ToReplace(old)
            }
            Err(error) => {
                // If another run writes the file, that is reported rather than that the file exists.
                let about = fs::symlink_metadata(path);
                if about.is_ok_and(|about| about.is_file()) {
                    File::open(path).map_or(Ok(()), |old| lock_log(&old))?;
                }
                return Err(error);
            }
        };
        Ok(Self { path: path.to_owned(), state, bytes: 0, ended: false })
    }

    /// Begins a log under the first free name of `run.log`, `run-1.log`, `run-2.log`, ...
    ///
    /// # Errors
    /// Returns an error, with advice to the user, if no such file can be written.
    pub fn create_numbered(path: &Path, stopped: &AtomicBool) -> io::Result<Self> {
        let mut number = 0;
        let mut name = path.to_owned();
        loop {
            match Self::create(&name, false, stopped) {
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                    number += 1;
                    name = path_with_suffix(path, format!("-{number}"), path.extension().unwrap_or_default());
                }
                created => return created,
            }
        }
    }

    /// Returns the name of the file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the number of bytes written.
    #[must_use]
    pub const fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Appends complete lines. Writes all of them or none.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written. The file then ends with the line before.
    pub fn append(&mut self, lines: &str) -> io::Result<()> {
        self.append_bytes(lines.as_bytes())
    }

    /// Appends complete lines, which may have any encoding.
    ///
    /// # Errors
    /// Returns an error as [`LogFile::append`] does.
    pub fn append_bytes(&mut self, lines: &[u8]) -> io::Result<()> {
        if lines.is_empty() {
            return Ok(());
        }
        if let LogTarget::ToReplace(_) = &self.state {
            self.state = LogTarget::Opened(self.replace_old_file()?);
        }
        let written = match &mut self.state {
            LogTarget::Opened(file) | LogTarget::ToReplace(file) => write_all_with_retries(file, lines),
            LogTarget::Stream(stream) => stream.write_all(lines),
        };
        match &self.state {
            _ if written.is_ok() => self.bytes += lines.len() as u64,
            // The file must not end with an incomplete line. An error of truncating it cannot be handled.
            LogTarget::Opened(file) => {
                // Truncation must not extend the file, which another program may have truncated further.
                if file.metadata().is_ok_and(|about| about.len() > self.bytes) {
                    let _ = file.set_len(self.bytes);
                }
            }
            LogTarget::ToReplace(_) | LogTarget::Stream(_) => {}
        }
        written
    }

    /// Checks that the file still has its name, and that only this program has changed it.
    ///
    /// # Errors
    /// Returns an error if another program has renamed, removed, truncated or written it.
    pub fn check_unchanged(&self) -> io::Result<()> {
        let LogTarget::Opened(file) = &self.state else { return Ok(()) };
        // If the file cannot be queried, it is not known to have changed.
        let Ok(about) = file.metadata() else { return Ok(()) };
        let (bytes, written) = (about.len(), self.bytes);
        let why = if still_names_file(&self.path, device_and_inode(&about)) == Some(false) {
            "another program renamed, removed or replaced the file while it was being written; further data \
             still goes to the original file"
                .to_owned()
        } else if bytes != written {
            format!(
                "another program changed the file while it was being written: it has {bytes} bytes, but \
                 {written} were written"
            )
        } else {
            return Ok(());
        };
        Err(io::Error::other(why))
    }

    /// Counts the lines of the file that begin with `begin`. Returns `None` if the name now belongs to another file.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read.
    pub fn count_lines_with_prefix(&self, begin: &str) -> io::Result<Option<u64>> {
        let LogTarget::Opened(file) = &self.state else { return Ok(None) };
        let there = open_no_follow(&self.path);
        let Some(there) = there.ok().filter(|there| is_same(there, file)) else { return Ok(None) };
        let mut lines = 0;
        for line in BufReader::new(there).split(b'\n') {
            lines += u64::from(line?.starts_with(begin.as_bytes()));
        }
        Ok(Some(lines))
    }

    /// Replaces the old file by a new, empty one. The old file remains available under other hard links and to programs
    /// that have it open.
    fn replace_old_file(&self) -> io::Result<File> {
        let part = temporary_name(&self.path);
        let file = create_locked(&part)?;
        fs::rename(&part, &self.path).inspect_err(|_| {
            let _ = fs::remove_file(&part);
        })?;
        Ok(file)
    }

    /// Ends the log and writes it to the disk, so that it survives a loss of power.
    ///
    /// # Errors
    /// Returns an error if the disk cannot store them.
    pub fn finish(mut self) -> io::Result<()> {
        if let LogTarget::ToReplace(_) = &self.state {
            // An empty log also replaces the old file.
            self.state = LogTarget::Opened(self.replace_old_file()?);
        }
        self.ended = true;
        let LogTarget::Opened(file) = &self.state else { return Ok(()) };
        file.sync_data()?;
        sync_folder(&self.path);
        Ok(())
    }
}

impl Drop for LogFile {
    /// Removes the file if nothing was written and [`LogFile::finish`] was not called.
    fn drop(&mut self) {
        let LogTarget::Opened(file) = &self.state else { return };
        let is_there = file
            .metadata()
            .is_ok_and(|about| still_names_file(&self.path, device_and_inode(&about)) == Some(true));
        if !self.ended && self.bytes == 0 && is_there {
            // An error of removing the file cannot be handled here.
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn is_same(one: &File, other: &File) -> bool {
    let of = |file: &File| file.metadata().ok().map(|about| device_and_inode(&about));
    of(one).is_some_and(|is| Some(is) == of(other))
}

/// Creates and locks a new file.
fn create_locked(path: &Path) -> io::Result<File> {
    let file = OpenOptions::new().append(true).create_new(true).open(path);
    let file = file.map_err(|error| with_exists_hint(with_creation_hint(error)))?;
    lock_log(&file)?;
    Ok(file)
}

/// Locks a log against other writers. Succeeds on file systems that do not support locks.
fn lock_log(file: &File) -> io::Result<()> {
    if lock_exclusively(file).is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock) {
        let why = "another run is writing this file: name another file, or wait until that run has ended";
        return Err(io::Error::new(io::ErrorKind::AlreadyExists, why));
    }
    Ok(())
}
