//! Output files of commands. An existing file is overwritten only on request. A symlink to a file is never followed.
//!
//! - [`AtomicFile`]: a result file, which appears under its name only when it is complete.
//! - [`LogFile`]: a log file, which exists from its first line on and grows.

pub mod log;
mod target;

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

pub use log::LogFile;
pub use protocol::input::parent_folder;
use target::{OutputTarget, open_stream, with_exists_hint};
pub use target::{
    STANDARD_OUTPUT, check_writable, check_writable_regular_file, is_disk_full, path_with_suffix, rename,
    sync_folder, with_creation_hint,
};
pub(crate) use target::{
    create_unnamed_file, device_and_inode, exists_error, lock_exclusively, name_unnamed_file, open_no_follow,
    still_names_file, temporary_name, write_with_retries,
};

/// A file that gets its name only when it is complete. Until then it is unnamed, and so disappears if the program is
/// killed. On a file system without unnamed files it is called `.NAME.PID.part`, and a run that fails removes it. Once
/// it has its name, it survives a loss of power.
///
/// Existing targets that are not regular files (a FIFO, a terminal, `/dev/stdout`), and `-`, standard output, are
/// written directly.
#[derive(Debug)]
pub struct AtomicFile {
    path: PathBuf,
    force: bool,
    /// The open file; `None` if the target is written directly.
    file: Option<File>,
    /// True if the file has a temporary name until it is complete.
    is_part: bool,
}

impl AtomicFile {
    /// Opens a file before there is anything to write, so that errors are reported early. An existing file is
    /// overwritten if `force` is true, and is an error otherwise.
    ///
    /// # Errors
    /// Returns an error, with advice to the user, if the file cannot be written.
    pub fn create(path: &Path, force: bool) -> io::Result<(Self, File)> {
        Self::create_unless_stopped(path, force, &AtomicBool::new(false))
    }

    /// Opens a file like [`AtomicFile::create`]. If it is a FIFO, waits until it has a reader or `stopped` is set.
    ///
    /// # Errors
    /// Returns an error, with advice to the user, if the file cannot be written.
    pub fn create_unless_stopped(path: &Path, force: bool, stopped: &AtomicBool) -> io::Result<(Self, File)> {
        let begun = |file, is_part| Self { path: path.to_owned(), force, file, is_part };
        if OutputTarget::inspect_target(path, force)? == OutputTarget::Stream {
            let file = open_stream(path, stopped).map_err(with_creation_hint)?;
            return Ok((begun(None, false), file));
        }
        if let Ok(file) = create_unnamed_file(parent_folder(path), 0o666) {
            return Ok((begun(Some(file.try_clone()?), false), file));
        }
        let part = OpenOptions::new().write(true).create_new(true).open(temporary_name(path));
        let file = part.map_err(with_creation_hint)?;
        Ok((begun(Some(file.try_clone()?), true), file))
    }

    /// Returns the final name of the file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns true if the target is written directly.
    #[must_use]
    pub const fn is_stream(&self) -> bool {
        self.file.is_none()
    }

    /// Gives the complete file its name.
    ///
    /// # Errors
    /// Returns an error if the file system refuses, or if another program has created a file of this name meanwhile.
    pub fn finish(mut self) -> io::Result<()> {
        let Some(file) = &self.file else { return Ok(()) };
        file.sync_all()?;
        if !self.is_part {
            // Linking fails if the name exists. To replace a file, the new one therefore gets a temporary name and is
            // renamed.
            let name = if self.force { temporary_name(&self.path) } else { self.path.clone() };
            name_unnamed_file(file, &name).map_err(with_exists_hint)?;
            self.is_part = self.force;
        }
        if self.is_part {
            rename(&temporary_name(&self.path), &self.path, self.force)?;
            self.is_part = false;
        }
        sync_folder(&self.path);
        Ok(())
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        if self.is_part {
            // An error of removing the file cannot be handled here.
            let _ = fs::remove_file(temporary_name(&self.path));
        }
    }
}

/// Writes a text to a file that appears under its name only when it is complete, as [`AtomicFile`] does.
///
/// # Errors
/// Returns an error, with advice to the user, if the file cannot be written.
pub fn write_atomically(path: &Path, text: &str, force: bool) -> io::Result<()> {
    let (whole, mut file) = AtomicFile::create(path, force)?;
    file.write_all(text.as_bytes())?;
    whole.finish()
}

#[cfg(test)]
mod tests;
