//! Names and ownership of a recording's files.
//!
//! ```text
//!   run.mcap.part  ── finish ──>  run.mcap         then run-1.mcap.part, run-2.mcap.part, ...
//!        └─ writer killed ──────>  run-recovered.mcap     and run.mcap.damaged, if more is lost than its end
//! The writer of a file holds a lock on it, which ends with its process. Before the file gets a name, the writer stores
//! the identity of the file in it. A `.part` file that is not locked and holds its own identity is therefore orphaned:
//! the process that wrote it has ended. Other `.part` files belong to other programs.
//! before the file gets a name. A `.part` file that is not locked and holds its own identity is therefore orphaned. All
//! others belong to other programs.

use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::file;
use crate::files::{
    create_unnamed_file, device_and_inode, lock_exclusively, name_unnamed_file, open_no_follow,
    parent_folder, path_with_suffix, rename, still_names_file, with_creation_hint,
};

/// The extension of a file that is not complete yet.
const PART_EXTENSION: &str = "part";
/// The extension of a recording.
const MCAP_EXTENSION: &str = "mcap";

/// A `.part` file that this process writes and has locked.
#[derive(Debug)]
pub struct PartFile {
    /// The present, temporary name.
    pub path: PathBuf,
    /// The name that the file gets when it is complete.
    pub goal: PathBuf,
    /// The device and inode of the file, which identify it under any name.
    identity: (u64, u64),
}

/// Returns the final name of a part file: its name without the extension `part`.
#[must_use]
pub fn final_name(part: &Path) -> PathBuf {
    if part.extension() == Some(OsStr::new(PART_EXTENSION)) {
        part.with_extension("")
    } else {
        part.to_owned()
    }
}

/// Returns the name of a file of a recording: `run.mcap` for number 0, `run-1.mcap` for number 1, and so on.
#[must_use]
pub fn numbered_path(path: &Path, number: u32) -> PathBuf {
    if number == 0 {
        path.to_owned()
    } else {
        path_with_suffix(path, format!("-{number}"), MCAP_EXTENSION.as_ref())
    }
}

/// Returns a name for a recovered file that no other file has.
#[must_use]
pub fn recovered_name(goal: &Path) -> PathBuf {
    let first = path_with_suffix(goal, "-recovered", MCAP_EXTENSION.as_ref());
    (0..).map(|number| numbered_path(&first, number)).find(|path| !exists(path)).unwrap_or_default()
}

fn exists(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// The extension of a damaged file that is kept beside the file recovered from it.
const DAMAGED_EXTENSION: &str = "damaged";

/// Renames a part file to `run.mcap.damaged`, so that later runs do not try to repair it. Returns the new name.
///
/// # Errors
/// Returns an error if the name belongs to another file now, or if the file cannot be renamed.
pub fn keep_damaged(part: &Path, from: &File) -> io::Result<PathBuf> {
    check_identity(part, from)?;
    let goal = final_name(part);
    for number in 0_u32.. {
        let mut name = goal.file_name().unwrap_or_default().to_owned();
        name.push(".");
        name.push(DAMAGED_EXTENSION);
        if number > 0 {
            name.push(format!("-{number}"));
        }
        let other = goal.with_file_name(name);
        match rename(part, &other, false) {
            Ok(()) => return Ok(other),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
    Err(io::Error::other("all names that a copy could get are in use: move old copies away"))
}

/// Returns the existing files of an earlier recording under this name: the first file and the numbered ones.
#[must_use]
pub fn existing_files(path: &Path) -> Vec<PathBuf> {
    let from = |first: u32| -> Vec<_> {
        (first..).map(|number| numbered_path(path, number)).take_while(|path| exists(path)).collect()
    };
    let all = from(0);
    // The first file may have been removed while the numbered ones remain.
    if all.is_empty() { from(1) } else { all }
}

impl PartFile {
    /// Creates and locks a part file.
    ///
    /// # Errors
    /// Returns an error if another program writes the file, or if it cannot be written.
    pub fn create(goal: PathBuf) -> io::Result<(Self, File)> {
        let mut name = goal.file_name().unwrap_or_default().to_owned();
        name.push(".");
        name.push(PART_EXTENSION);
        let path = goal.with_file_name(name);
        let taken = |error: io::Error| {
            if error.kind() == io::ErrorKind::AlreadyExists {
                return io::Error::new(io::ErrorKind::AlreadyExists, name_in_use_message(&path));
            }
            with_creation_hint(error)
        };
        let file = create_linked(&path).unwrap_or_else(|| create_exclusive(&path)).map_err(taken)?;
        let is = device_and_inode(&file.metadata()?);
        Ok((Self { path, goal, identity: is }, file))
    }

    /// Gives the file its final name. Replaces another file only with `force`.
    ///
    /// # Errors
    /// Returns an error if the file cannot be renamed.
    pub fn finish(&self, force: bool) -> io::Result<()> {
        if !self.has_temporary_name() {
            return Err(io::Error::other(format!("another program has replaced {}", self.path.display())));
        }
        rename(&self.path, &self.goal, force)
    }

    /// Returns true if the file still has its temporary name, or if that cannot be queried.
    #[must_use]
    pub fn has_temporary_name(&self) -> bool {
        still_names_file(&self.path, self.identity) != Some(false)
    }

    /// Removes the file, if it still has its temporary name.
    pub fn remove(&self) {
        if still_names_file(&self.path, self.identity) == Some(true) {
            // If this fails, the next run removes the file.
            let _ = fs::remove_file(&self.path);
        }
    }

    /// Opens the file for reading.
    ///
    /// # Errors
    /// Returns an error if the file cannot be opened, or if its name belongs to another file now.
    pub fn open(&self) -> io::Result<File> {
        let file = open_no_follow(&self.path)?;
        if device_and_inode(&file.metadata()?) != self.identity {
            return Err(io::Error::other("another program has put a different file under this name"));
        }
        Ok(file)
    }
}

/// Returns the error message for a recording whose name another program took while it was written.
pub(super) fn name_conflict_message(goal: &Path) -> String {
    format!("{}: another program has meanwhile created a file with this name", goal.display())
}

/// Returns the error message for a recording whose name is already in use.
fn name_in_use_message(path: &Path) -> String {
    let name = path.display();
    // A pipe is not opened, because a program at its other end would take this program for a reader.
    if fs::symlink_metadata(path).is_ok_and(|about| !about.is_file()) {
        return format!("{name} exists and is not a regular file: move it away, or record to another name");
    }
    match open_no_follow(path) {
        Ok(file) if !is_locked(&file) => format!(
            "{name} exists, but was not left by a killed run: move it away, or record to another name"
        ),
        _ => format!("{name} exists, and another run is recording to it: record to another name"),
    }
}

/// Creates a file that gets its name only after it is locked and holds its identity. Returns `None` if the file system
/// does not support files without a name.
fn create_linked(path: &Path) -> Option<io::Result<File>> {
    let mut file = create_unnamed_file(parent_folder(path), 0o666).ok()?;
    lock_and_mark(&mut file).ok()?;
    match name_unnamed_file(&file, path) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => None,
        linked => Some(linked.map(|()| file)),
    }
}

fn create_exclusive(path: &Path) -> io::Result<File> {
    let mut file = OpenOptions::new().write(true).create_new(true).open(path)?;
    lock_and_mark(&mut file).inspect_err(|_| {
        // A file without an identity could never be recognised as an orphan.
        let _ = fs::remove_file(path);
    })?;
    Ok(file)
}

/// Locks a file and writes its identity into it.
fn lock_and_mark(file: &mut File) -> io::Result<()> {
    lock_exclusively(file)?;
    let about = file.metadata()?;
    file.write_all(&file::file_prefix(&about)?)
}

/// Returns true if another process holds the lock on the file.
#[must_use]
pub fn is_locked(file: &File) -> bool {
    lock_exclusively(file).is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
}

/// The reason why a `.part` file is neither repaired nor removed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PartFileError {
    /// It is a symlink.
    #[error("it is a symlink")]
    Symlink,
    /// It is a folder, a pipe or a device.
    #[error("it is not a regular file")]
    Irregular,
    /// It cannot be queried.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It cannot be read.
    #[error("it cannot be read: {0}")]
    Unreadable(#[source] io::Error),
    /// It belongs to another user.
    #[error("it belongs to user {owner}, but this program runs as user {me}")]
    Owner {
        /// The user id of the owner.
        owner: u32,
        /// The user id of this process.
        me: u32,
    },
    /// It has several hard links.
    #[error("it has {0} hard links")]
    Linked(u64),
    /// Another process holds the lock.
    #[error("another program is writing it")]
    Locked,
    /// The file does not hold its own identity, so it may be a copy or a file of another program.
    #[error("it was not created here by a run of this program")]
    ForeignIdentity,
}

impl PartFileError {
    /// Returns true if the file may be a recording, so that the user should be told of it.
    #[must_use]
    pub const fn may_be_recording(&self) -> bool {
        matches!(self, Self::Owner { .. } | Self::Linked(_) | Self::ForeignIdentity)
    }
}

/// A file left by a run that was killed, now locked by this process; or the reason why it is left alone.
pub type OrphanClaim = Result<File, PartFileError>;

/// Returns the `.part` files in the folder of a recording, each with the file or the reason why it is left alone.
///
/// # Errors
/// Returns an error if the folder cannot be read.
pub fn find_part_files(path: &Path) -> io::Result<Vec<(PathBuf, OrphanClaim)>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(parent_folder(path))? {
        let path = path.with_file_name(entry?.file_name());
        let is_part = path.extension() == Some(OsStr::new(PART_EXTENSION))
            && final_name(&path).extension() == Some(OsStr::new(MCAP_EXTENSION));
        if is_part {
            let what = claim_orphan(&path);
            found.push((path, what));
        }
    }
    found.sort_by(|(one, _), (other, _)| one.cmp(other));
    Ok(found)
}

/// Opens and locks a `.part` file, if the process that wrote it has ended.
fn claim_orphan(path: &Path) -> OrphanClaim {
    // Opening anything but a regular file may have side effects.
    let kind = fs::symlink_metadata(path)?.file_type();
    if kind.is_symlink() {
        return Err(PartFileError::Symlink);
    }
    if !kind.is_file() {
        return Err(PartFileError::Irregular);
    }
    let mut file = open_no_follow(path).map_err(PartFileError::Unreadable)?;
    let about = file.metadata()?;
    let (owner, me) = (about.uid(), rustix::process::geteuid().as_raw());
    if !about.is_file() {
        return Err(PartFileError::Irregular);
    }
    if owner != me {
        return Err(PartFileError::Owner { owner, me });
    }
    if about.nlink() != 1 {
        return Err(PartFileError::Linked(about.nlink()));
    }
    lock_exclusively(&file).map_err(|error| {
        if error.kind() == io::ErrorKind::WouldBlock { PartFileError::Locked } else { error.into() }
    })?;
    if file::has_own_identity(&mut file).map_err(PartFileError::Unreadable)? {
        Ok(file)
    } else {
        Err(PartFileError::ForeignIdentity)
    }
}

/// Removes an orphaned file, if the name is still that of the file.
///
/// # Errors
/// Returns an error if the name belongs to another file now, or if the file cannot be removed.
pub fn remove(path: &Path, file: &File) -> io::Result<()> {
    check_identity(path, file)?;
    fs::remove_file(path)
}

/// Checks that a name is still that of the given file.
fn check_identity(path: &Path, file: &File) -> io::Result<()> {
    if still_names_file(path, device_and_inode(&file.metadata()?)) == Some(true) {
        return Ok(());
    }
    Err(io::Error::other("another program has put a different file under this name, which was kept"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn orphans(path: &Path) -> Vec<(PathBuf, OrphanClaim)> {
        let found = find_part_files(path).unwrap().into_iter();
        found.filter(|(_, found)| found.is_ok()).collect()
    }

    #[test]
    fn files_are_numbered_from_the_second_on() {
        let name = |number| numbered_path(Path::new("there/run.mcap"), number).display().to_string();
        assert_eq!([0, 1, 12].map(name), ["there/run.mcap", "there/run-1.mcap", "there/run-12.mcap"]);
        assert_eq!(final_name(Path::new("a/run-1.mcap.part")), Path::new("a/run-1.mcap"));
        assert_eq!(final_name(Path::new("a/run.mcap")), Path::new("a/run.mcap"));
    }

    #[test]
    fn a_part_is_held_until_its_writer_is_gone_and_then_orphaned() {
        let folder = tempfile::tempdir().unwrap();
        let goal = folder.path().join("run.mcap");
        let (part, file) = PartFile::create(goal.clone()).unwrap();
        assert_eq!(orphans(&goal).len(), 0, "somebody writes it");
        let error = PartFile::create(goal.clone()).unwrap_err().to_string();
        assert!(
            error.ends_with("part exists, and another run is recording to it: record to another name"),
            "{error}"
        );
        drop(file);
        let found = orphans(&goal);
        assert_eq!(found[0].0, part.path);
        assert_eq!(orphans(&goal).len(), 0, "somebody repairs it");
    }

    #[test]
    fn a_name_is_taken_by_force_only() {
        let folder = tempfile::tempdir().unwrap();
        let goal = folder.path().join("run.mcap");
        let (part, _file) = PartFile::create(goal.clone()).unwrap();
        fs::write(&goal, "somebody's").unwrap();
        assert_eq!(part.finish(false).unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read_to_string(&goal).unwrap(), "somebody's");
        part.finish(true).unwrap();
        assert!(fs::read(&goal).unwrap().starts_with(crate::container::MAGIC));
        assert_eq!(recovered_name(&goal), folder.path().join("run-recovered.mcap"));
        fs::write(folder.path().join("run-recovered.mcap"), "").unwrap();
        assert_eq!(recovered_name(&goal), folder.path().join("run-recovered-1.mcap"));
        for number in 1..3 {
            fs::write(numbered_path(&goal, number), "").unwrap();
        }
        assert_eq!(existing_files(&goal).len(), 3);
        fs::remove_file(&goal).unwrap();
        assert_eq!(existing_files(&goal).len(), 2);
    }
}
