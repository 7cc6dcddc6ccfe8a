//! Files that commands write. Nothing is overwritten unless that is asked for, and no symlink is followed to a file.
//!
//! - [`WholeFile`]: a result; under its name it is whole or not there.
//! - [`LogFile`]: a log; it is there from its first line on, and grows.

pub mod log;
mod target;

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use rustix::fs::{AtFlags, CWD, Mode, OFlags, linkat, open};

pub use log::LogFile;
use target::{Target, exists, folder_of, open_stream, part_of, sync_folder};
pub use target::{check, check_regular, rename, sync, with_remedy};

/// A file that has a name only when it is whole. Until then it has none at all, and so is gone with a
/// program that is killed; where the file system has no such files it is called `.NAME.PID.part`, and a run
/// that does not come to its end takes it away. Once it has its name, it outlives a loss of power.
///
/// What is there and is no regular file (a FIFO, a terminal, `/dev/stdout`) is written to as it is.
#[derive(Debug)]
pub struct WholeFile {
    path: PathBuf,
    force: bool,
    state: State,
}

#[derive(Debug)]
enum State {
    /// Written to as it is, or finished.
    Named,
    /// Without a name, held open by this.
    Nameless(File),
    /// Under another name.
    Part(File),
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
        let path = path.to_owned();
        if Target::of(&path, force)? == Target::Stream {
            let file = open_stream(&path, stopped).map_err(with_remedy)?;
            return Ok((Self { path, force, state: State::Named }, file));
        }
        let flags = OFlags::TMPFILE | OFlags::WRONLY | OFlags::CLOEXEC;
        if let Ok(file) = open(folder_of(&path), flags, Mode::from_raw_mode(0o666)).map(File::from) {
            let state = State::Nameless(file.try_clone()?);
            return Ok((Self { path, force, state }, file));
        }
        let part = OpenOptions::new().write(true).create_new(true).open(part_of(&path));
        let file = part.map_err(with_remedy)?;
        let state = State::Part(file.try_clone()?);
        Ok((Self { path, force, state }, file))
    }

    /// Its name, once it is whole.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives it its name; everything has been written.
    ///
    /// # Errors
    /// When the file system refuses, or another program has made a file of this name meanwhile.
    pub fn finish(mut self) -> io::Result<()> {
        match &self.state {
            State::Named => return Ok(()),
            State::Nameless(file) => {
                file.sync_all()?;
                let nameless = format!("/proc/self/fd/{}", file.as_raw_fd());
                // A link never takes another file's place, so that one gets a name of its own first.
                let name = if self.force { part_of(&self.path) } else { self.path.clone() };
                match linkat(CWD, nameless, CWD, name, AtFlags::SYMLINK_FOLLOW) {
                    Err(rustix::io::Errno::EXIST) => return Err(exists()),
                    linked => linked?,
                }
                if self.force {
                    self.state = State::Part(file.try_clone()?);
                }
            }
            State::Part(file) => file.sync_all()?,
        }
        if let State::Part(_) = self.state {
            rename(&part_of(&self.path), &self.path, self.force)?;
        }
        self.state = State::Named;
        sync_folder(&self.path);
        Ok(())
    }
}

impl Drop for WholeFile {
    fn drop(&mut self) {
        if matches!(self.state, State::Part(_)) {
            // Nothing more can be done.
            let _ = fs::remove_file(part_of(&self.path));
        }
    }
}

#[cfg(test)]
mod tests;
