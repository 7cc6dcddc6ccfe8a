//! What a recording's files are called, and who may write them.
//!
//! ```text
//!   run.mcap.part  ── finish ──>  run.mcap         then run-1.mcap.part, run-2.mcap.part, ...
//!        └─ writer killed ──────>  run-recovered.mcap
//! ```
//!
//! Who writes a file holds a lock on it, which goes with the process: a `.part` that nobody holds is orphaned.

use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};

use super::sink::folder_of;
use crate::run::file::{rename, with_remedy};

/// What a file is called in addition until it is whole.
const PART: &str = "part";

/// A file that is being written, held against others.
#[derive(Debug)]
pub struct Part {
    /// Its name for now.
    pub path: PathBuf,
    /// Its name when it is whole.
    pub goal: PathBuf,
}

/// The file that a part becomes: its name without the end.
#[must_use]
pub fn goal_of(part: &Path) -> PathBuf {
    if part.extension() == Some(OsStr::new(PART)) { part.with_extension("") } else { part.to_owned() }
}

/// The name of a recording's file: the one that was asked for, then with a number.
#[must_use]
pub fn numbered(path: &Path, number: u32) -> PathBuf {
    if number == 0 { path.to_owned() } else { suffixed(path, &format!("-{number}")) }
}

/// What a recovered file is called; never the name of one that is there.
#[must_use]
pub fn recovered(goal: &Path) -> PathBuf {
    let first = suffixed(goal, "-recovered");
    let others = (1_u32..).map(|number| suffixed(goal, &format!("-recovered-{number}")));
    std::iter::once(first).chain(others).find(|path| !exists(path)).unwrap_or_default()
}

fn suffixed(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(suffix);
    name.push(".mcap");
    path.with_file_name(name)
}

fn exists(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// The files of an earlier recording of this name that are there: it, and those with a number.
#[must_use]
pub fn series(path: &Path) -> Vec<PathBuf> {
    let numbers = (0..).map(|number| numbered(path, number)).take_while(|path| exists(path));
    // The first one may have been taken away.
    let numbers: Vec<_> = numbers.collect();
    if numbers.is_empty() {
        (1..).map(|number| numbered(path, number)).take_while(|path| exists(path)).collect()
    } else {
        numbers
    }
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
        let file = OpenOptions::new().write(true).create_new(true).open(&path).map_err(|error| {
            if error.kind() == io::ErrorKind::AlreadyExists {
                let why = format!("{} is there: another run records to this name now", path.display());
                return io::Error::new(io::ErrorKind::AlreadyExists, why);
            }
            with_remedy(error)
        })?;
        hold(&file)?;
        Ok((Self { path, goal }, file))
    }

    /// Gives the file its name; takes another file's place only when `force` says so.
    ///
    /// # Errors
    /// When it cannot have it.
    pub fn finish(&self, force: bool) -> io::Result<()> {
        rename(&self.path, &self.goal, force)
    }
}

/// Holds a file against everybody else, as long as it is open.
fn hold(file: &File) -> io::Result<()> {
    Ok(flock(file, FlockOperation::NonBlockingLockExclusive)?)
}

/// Whether somebody writes this file now.
#[must_use]
pub fn is_held(file: &File) -> bool {
    hold(file).is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
}

/// The files in a recording's folder whose writers are gone, and that are now held against others.
///
/// # Errors
/// When the folder cannot be read.
pub fn orphans(path: &Path) -> io::Result<Vec<(PathBuf, File)>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder_of(path))? {
        let path = path.with_file_name(entry?.file_name());
        let is_part = path.extension() == Some(OsStr::new(PART))
            && goal_of(&path).extension() == Some(OsStr::new("mcap"));
        if !is_part {
            continue;
        }
        // One that somebody else may not even read is not ours to repair.
        let Ok(file) = File::open(&path) else { continue };
        if hold(&file).is_ok() {
            found.push((path, file));
        }
    }
    found.sort_by(|(one, _), (other, _)| one.cmp(other));
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert_eq!(orphans(&goal).unwrap().len(), 0, "somebody writes it");
        let error = Part::create(goal.clone()).unwrap_err().to_string();
        assert!(error.ends_with("run.mcap.part is there: another run records to this name now"), "{error}");
        drop(file);
        let found = orphans(&goal).unwrap();
        assert_eq!(found[0].0, part.path);
        assert_eq!(orphans(&goal).unwrap().len(), 0, "somebody repairs it");
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
        assert_eq!(fs::read_to_string(&goal).unwrap(), "");
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
