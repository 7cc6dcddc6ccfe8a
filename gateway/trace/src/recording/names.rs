//! What a recording's files are called, and who may write them.
//!
//! ```text
//!   run.mcap.part  ── finish ──>  run.mcap         then run-1.mcap.part, run-2.mcap.part, ...
//!        └─ writer killed ──────>  run-recovered.mcap     and run.mcap.damaged, if more is lost than its end
//! ```
//!
//! Who writes a file holds a lock on it, which goes with the process, and has put its own mark into it before it had a
//! name: a `.part` that nobody holds and that bears this mark is orphaned. Any other is somebody else's.

use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::file;
use crate::files::{
    folder_of, hold, identity, is_still, link, nameless, open_unfollowed, rename, suffixed, with_hint,
};

/// What a file is called in addition until it is whole.
const PART: &str = "part";
/// How a recording's name ends.
const MCAP: &str = "mcap";

/// A file that is being written, held against others.
#[derive(Debug)]
pub struct Part {
    /// Its name for now.
    pub path: PathBuf,
    /// Its name when it is whole.
    pub goal: PathBuf,
    /// Which file it is, whatever has its name: device and inode.
    is: (u64, u64),
}

/// The file that a part becomes: its name without the end.
#[must_use]
pub fn goal_of(part: &Path) -> PathBuf {
    if part.extension() == Some(OsStr::new(PART)) { part.with_extension("") } else { part.to_owned() }
}

/// The name of a recording's file: the one that was asked for, then with a number.
#[must_use]
pub fn numbered(path: &Path, number: u32) -> PathBuf {
    if number == 0 { path.to_owned() } else { suffixed(path, format!("-{number}"), MCAP.as_ref()) }
}

/// What a recovered file is called; never the name of one that is there.
#[must_use]
pub fn recovered(goal: &Path) -> PathBuf {
    let first = suffixed(goal, "-recovered", MCAP.as_ref());
    (0..).map(|number| numbered(&first, number)).find(|path| !exists(path)).unwrap_or_default()
}

fn exists(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// What a file is called in addition that is damaged, and kept beside what was recovered from it.
const DAMAGED: &str = "damaged";

/// Keeps a `.part` under another name, at which no run looks for what it could repair: `run.mcap.damaged`. That name.
///
/// # Errors
/// When it is another file now, or cannot have another name.
pub fn keep_damaged(part: &Path, from: &File) -> io::Result<PathBuf> {
    is_its_own(part, from)?;
    let goal = goal_of(part);
    for number in 0_u32.. {
        let mut name = goal.file_name().unwrap_or_default().to_owned();
        name.push(".");
        name.push(DAMAGED);
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
    Err(io::Error::other("it has no name left"))
}

/// The files of an earlier recording of this name that are there: it, and those with a number.
#[must_use]
pub fn series(path: &Path) -> Vec<PathBuf> {
    let from = |first: u32| -> Vec<_> {
        (first..).map(|number| numbered(path, number)).take_while(|path| exists(path)).collect()
    };
    let all = from(0);
    // The first one may have been taken away.
    if all.is_empty() { from(1) } else { all }
}

impl Part {
    /// Begins a file that nobody else is writing.
    ///
    /// # Errors
    /// When somebody is, or it cannot be written.
    pub fn create(goal: PathBuf) -> io::Result<(Self, File)> {
        let mut name = goal.file_name().unwrap_or_default().to_owned();
        name.push(".");
        name.push(PART);
        let path = goal.with_file_name(name);
        let taken = |error: io::Error| {
            if error.kind() == io::ErrorKind::AlreadyExists {
                return io::Error::new(io::ErrorKind::AlreadyExists, why_taken(&path));
            }
            with_hint(error)
        };
        let file = unnamed(&path).unwrap_or_else(|| named(&path)).map_err(taken)?;
        let is = identity(&file.metadata()?);
        Ok((Self { path, goal, is }, file))
    }

    /// Gives the file its name; takes another file's place only when `force` says so.
    ///
    /// # Errors
    /// When it cannot have it.
    pub fn finish(&self, force: bool) -> io::Result<()> {
        if !self.is_there() {
            return Err(io::Error::other(format!("{} is another file now", self.path.display())));
        }
        rename(&self.path, &self.goal, force)
    }

    /// Whether it still has its name for now, or that cannot be looked at.
    #[must_use]
    pub fn is_there(&self) -> bool {
        is_still(&self.path, self.is) != Some(false)
    }

    /// Takes the file away, if it is still there.
    pub fn remove(&self) {
        if is_still(&self.path, self.is) == Some(true) {
            // Else the next run takes it away.
            let _ = fs::remove_file(&self.path);
        }
    }

    /// The file, to be read.
    ///
    /// # Errors
    /// When it cannot be opened, or its name is that of another file now.
    pub fn open(&self) -> io::Result<File> {
        let file = open_unfollowed(&self.path)?;
        if identity(&file.metadata()?) != self.is {
            return Err(io::Error::other("it is another file now"));
        }
        Ok(file)
    }
}

/// The error for a name that another program has given to a file while a recording was written.
pub(super) fn taken_meanwhile(goal: &Path) -> String {
    format!("{}: another program made a file of this name meanwhile", goal.display())
}

/// Why a recording cannot begin under a name.
fn why_taken(path: &Path) -> String {
    let name = path.display();
    // A pipe is not opened: whoever waits at its other end would take that for a reader.
    if fs::symlink_metadata(path).is_ok_and(|about| !about.is_file()) {
        return format!("{name} is there and is no regular file: move it away, or record to another name");
    }
    match open_unfollowed(path) {
        Ok(file) if !is_held(&file) => format!(
            "{name} is there, and no run that was killed has left it: move it away, or record to another name"
        ),
        _ => format!("{name} is there: another run records to this name now: record to another name"),
    }
}

/// A file that gets its name when it is held and bears its mark; nothing where the file system has none like it.
fn unnamed(path: &Path) -> Option<io::Result<File>> {
    let mut file = nameless(folder_of(path), 0o666).ok()?;
    claim(&mut file).ok()?;
    match link(&file, path) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => None,
        linked => Some(linked.map(|()| file)),
    }
}

fn named(path: &Path) -> io::Result<File> {
    let mut file = OpenOptions::new().write(true).create_new(true).open(path)?;
    claim(&mut file).inspect_err(|_| {
        // It is ours, and nobody's without its mark.
        let _ = fs::remove_file(path);
    })?;
    Ok(file)
}

/// Holds a file, and makes it ours for whoever finds it later.
fn claim(file: &mut File) -> io::Result<()> {
    hold(file)?;
    let about = file.metadata()?;
    file.write_all(&file::mark(&about)?)
}

/// Whether somebody writes this file now.
#[must_use]
pub fn is_held(file: &File) -> bool {
    hold(file).is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
}

/// Why a `.part` in a recording's folder is not ours to touch.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Leftover {
    /// A link to something.
    #[error("it is a symlink")]
    Symlink,
    /// A folder, a pipe, a device.
    #[error("it is no regular file")]
    Irregular,
    /// It cannot be looked at.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It cannot be read.
    #[error("it cannot be read: {0}")]
    Unreadable(#[source] io::Error),
    /// Somebody else's.
    #[error("it belongs to user {owner}, and this is user {me}")]
    Owner {
        /// Whose it is.
        owner: u32,
        /// Who asks.
        me: u32,
    },
    /// It has other names.
    #[error("it has {0} names (hard links)")]
    Linked(u64),
    /// Its writer is there.
    #[error("another program is writing it")]
    Held,
    /// It has no mark, or that of another file.
    #[error("no run of this program has begun it here")]
    Unmarked,
}

impl Leftover {
    /// Whether it may be a recording.
    #[must_use]
    pub const fn may_be_recording(&self) -> bool {
        matches!(self, Self::Owner { .. } | Self::Linked(_) | Self::Unmarked)
    }
}

/// A file that a run left which was killed, held against others from now on; or why it is not.
pub type Orphan = Result<File, Leftover>;

/// What of unfinished recordings is in a recording's folder.
///
/// # Errors
/// When the folder cannot be read.
pub fn parts(path: &Path) -> io::Result<Vec<(PathBuf, Orphan)>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder_of(path))? {
        let path = path.with_file_name(entry?.file_name());
        let is_part = path.extension() == Some(OsStr::new(PART))
            && goal_of(&path).extension() == Some(OsStr::new(MCAP));
        if is_part {
            let what = look(&path);
            found.push((path, what));
        }
    }
    found.sort_by(|(one, _), (other, _)| one.cmp(other));
    Ok(found)
}

/// Whose a file is.
fn look(path: &Path) -> Orphan {
    // Of what is no file not even an opening is harmless.
    let kind = fs::symlink_metadata(path)?.file_type();
    if kind.is_symlink() {
        return Err(Leftover::Symlink);
    }
    if !kind.is_file() {
        return Err(Leftover::Irregular);
    }
    let mut file = open_unfollowed(path).map_err(Leftover::Unreadable)?;
    let about = file.metadata()?;
    let (owner, me) = (about.uid(), rustix::process::geteuid().as_raw());
    if !about.is_file() {
        return Err(Leftover::Irregular);
    }
    if owner != me {
        return Err(Leftover::Owner { owner, me });
    }
    if about.nlink() != 1 {
        return Err(Leftover::Linked(about.nlink()));
    }
    hold(&file).map_err(|error| {
        if error.kind() == io::ErrorKind::WouldBlock { Leftover::Held } else { error.into() }
    })?;
    if file::is_marked(&mut file).map_err(Leftover::Unreadable)? { Ok(file) } else { Err(Leftover::Unmarked) }
}

/// Takes an orphan away, if its name is still its own.
///
/// # Errors
/// When it is not, or cannot be taken away.
pub fn remove(path: &Path, file: &File) -> io::Result<()> {
    is_its_own(path, file)?;
    fs::remove_file(path)
}

/// Makes sure that a name is still that of a file.
fn is_its_own(path: &Path, file: &File) -> io::Result<()> {
    if is_still(path, identity(&file.metadata()?)) == Some(true) {
        return Ok(());
    }
    Err(io::Error::other("another file has its name now, and stays"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn orphans(path: &Path) -> Vec<(PathBuf, Orphan)> {
        let found = parts(path).unwrap().into_iter();
        found.filter(|(_, found)| found.is_ok()).collect()
    }

    #[test]
    fn files_are_numbered_from_the_second_on() {
        let name = |number| numbered(Path::new("there/run.mcap"), number).display().to_string();
        assert_eq!([0, 1, 12].map(name), ["there/run.mcap", "there/run-1.mcap", "there/run-12.mcap"]);
        assert_eq!(goal_of(Path::new("a/run-1.mcap.part")), Path::new("a/run-1.mcap"));
        assert_eq!(goal_of(Path::new("a/run.mcap")), Path::new("a/run.mcap"));
    }

    #[test]
    fn a_part_is_held_until_its_writer_is_gone_and_then_orphaned() {
        let folder = tempfile::tempdir().unwrap();
        let goal = folder.path().join("run.mcap");
        let (part, file) = Part::create(goal.clone()).unwrap();
        assert_eq!(orphans(&goal).len(), 0, "somebody writes it");
        let error = Part::create(goal.clone()).unwrap_err().to_string();
        assert!(
            error.ends_with("part is there: another run records to this name now: record to another name"),
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
        let (part, _file) = Part::create(goal.clone()).unwrap();
        fs::write(&goal, "somebody's").unwrap();
        assert_eq!(part.finish(false).unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read_to_string(&goal).unwrap(), "somebody's");
        part.finish(true).unwrap();
        assert!(fs::read(&goal).unwrap().starts_with(crate::container::MAGIC));
        assert_eq!(recovered(&goal), folder.path().join("run-recovered.mcap"));
        fs::write(folder.path().join("run-recovered.mcap"), "").unwrap();
        assert_eq!(recovered(&goal), folder.path().join("run-recovered-1.mcap"));
        for number in 1..3 {
            fs::write(numbered(&goal, number), "").unwrap();
        }
        assert_eq!(series(&goal).len(), 3);
        fs::remove_file(&goal).unwrap();
        assert_eq!(series(&goal).len(), 2);
    }
}
