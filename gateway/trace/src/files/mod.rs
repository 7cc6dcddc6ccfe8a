//! Files that commands write. Nothing is overwritten unless that is asked for, and no symlink is followed to a file.
//!
//! - [`WholeFile`]: a result; under its name it is whole or not there.
//! - [`LogFile`]: a log; it is there from its first line on, and grows.

pub mod log;
mod target;

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

pub use log::LogFile;
pub use protocol::input::folder_of;
pub use target::{STANDARD_OUTPUT, check, check_regular, rename, suffixed, sync_folder, with_hint};
use target::{Target, open_stream, or_exists, part_of};
pub(crate) use target::{hold, identity, is_still, link, nameless, open_unfollowed, write_patiently};

/// A file that has a name only when it is whole. Until then it has none at all, and so is gone with a
/// program that is killed; where the file system has no such files it is called `.NAME.PID.part`, and a run
/// that does not come to its end takes it away. Once it has its name, it outlives a loss of power.
///
/// What is there and is no regular file (a FIFO, a terminal, `/dev/stdout`), and `-`, standard output, are written to as they are.
#[derive(Debug)]
pub struct WholeFile {
    path: PathBuf,
    force: bool,
    /// Until it has its name; of what is written to as it is, never.
    file: Option<File>,
    /// Whether it has another name until then.
    is_part: bool,
}

impl WholeFile {
    /// Opens a file, so that what makes that impossible is known before there is anything to write. One that exists
    /// is overwritten with `force`, and otherwise refused.
    ///
    /// # Errors
    /// When it cannot be written, and what to do.
    pub fn create(path: &Path, force: bool) -> io::Result<(Self, File)> {
        Self::create_unless(path, force, &AtomicBool::new(false))
    }

    /// The same; a FIFO that nobody reads is waited for only until `stopped`.
    ///
    /// # Errors
    /// When it cannot be written, and what to do.
    pub fn create_unless(path: &Path, force: bool, stopped: &AtomicBool) -> io::Result<(Self, File)> {
        let begun = |file, is_part| Self { path: path.to_owned(), force, file, is_part };
        if Target::of(path, force)? == Target::Stream {
            let file = open_stream(path, stopped).map_err(with_hint)?;
            return Ok((begun(None, false), file));
        }
        if let Ok(file) = nameless(folder_of(path), 0o666) {
            return Ok((begun(Some(file.try_clone()?), false), file));
        }
        let part = OpenOptions::new().write(true).create_new(true).open(part_of(path));
        let file = part.map_err(with_hint)?;
        Ok((begun(Some(file.try_clone()?), true), file))
    }

    /// Its name, once it is whole.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns true for what is written to as it is.
    #[must_use]
    pub const fn is_stream(&self) -> bool {
        self.file.is_none()
    }

    /// Gives it its name; everything has been written.
    ///
    /// # Errors
    /// When the file system refuses, or another program has made a file of this name meanwhile.
    pub fn finish(mut self) -> io::Result<()> {
        let Some(file) = &self.file else { return Ok(()) };
        file.sync_all()?;
        if !self.is_part {
            // A link never takes another file's place, so that one gets a name of its own first.
            let name = if self.force { part_of(&self.path) } else { self.path.clone() };
            link(file, &name).map_err(or_exists)?;
            self.is_part = self.force;
        }
        if self.is_part {
            rename(&part_of(&self.path), &self.path, self.force)?;
            self.is_part = false;
        }
        sync_folder(&self.path);
        Ok(())
    }
}

impl Drop for WholeFile {
    fn drop(&mut self) {
        if self.is_part {
            // Nothing more can be done.
            let _ = fs::remove_file(part_of(&self.path));
        }
    }
}

/// Writes a whole file; as [`WholeFile`].
///
/// # Errors
/// When it cannot be written, and what to do.
pub fn write_whole(path: &Path, text: &str, force: bool) -> io::Result<()> {
    let (whole, mut file) = WholeFile::create(path, force)?;
    file.write_all(text.as_bytes())?;
    whole.finish()
}

#[cfg(test)]
mod tests;
