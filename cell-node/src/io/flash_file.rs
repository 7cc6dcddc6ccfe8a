//! Flash as a file, which one process at a time uses.
//!
//! A lock on the file keeps other processes away, and ends with the process. A file that takes the place of another one is
//! locked before that.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use protocol::input::{self, folder_of};
use rustix::fs::{CWD, FlockOperation, RenameFlags, flock, renameat_with};
use rustix::io::Errno;

use crate::flash::{self, FlashError, Kept};
use crate::identity::Identity;

/// The most bytes that are read of a file; what flash holds is far less.
const LONGEST: u64 = 64 << 10;

/// Where a cell keeps its parameters; without a directory, in memory only.
#[derive(Debug)]
pub struct FlashFile {
    identity: Identity,
    path: Option<PathBuf>,
    /// The file at that path while it is locked; `None` while there is none.
    held: Option<File>,
}

impl FlashFile {
    /// The file `BUS-NODE.flash` in a directory, or `BUS-sSERIAL.flash` of a cell that came without a number.
    #[must_use]
    pub fn new(directory: Option<&Path>, bus: &str, identity: Identity) -> Self {
        let name = identity.cell.map_or_else(|| format!("s{}", identity.serial), |cell| cell.to_string());
        let path = directory.map(|directory| directory.join(format!("{bus}-{name}.flash")));
        Self { identity, path, held: None }
    }

    /// What people call it: `flash of cell 12 (DIR/vcan0-12.flash)`.
    #[must_use]
    pub fn name(&self) -> String {
        let Identity { cell, serial } = self.identity;
        let cell = cell.map_or_else(|| format!("with serial number {serial}"), |cell| cell.to_string());
        self.path.as_ref().map_or_else(
            || format!("flash of cell {cell}"),
            |path| format!("flash of cell {cell} ({})", path.display()),
        )
    }

    /// Locks it, and reads what it holds, which is nothing where there is no file; or why that is not used.
    ///
    /// # Errors
    /// When the file is there and cannot be read, or another process has it.
    pub fn load(&mut self) -> io::Result<Result<Kept, FlashError>> {
        let Some(path) = &self.path else { return Ok(Ok(Kept::default())) };
        lock(path, &mut self.held)?;
        if self.held.is_none() {
            return Ok(Ok(Kept::default()));
        }
        Ok(flash::decode(self.identity, &input::bytes(path, LONGEST)?))
    }

    /// Keeps a number and parameters: a whole new file takes the old one's place, or nothing changes.
    ///
    /// # Errors
    /// When the disk will not have it, or another process has the file.
    pub fn store(&mut self, kept: &Kept) -> io::Result<()> {
        let Some(path) = &self.path else { return Ok(()) };
        lock(path, &mut self.held)?;
        let part = path.with_extension("flash.part");
        let store = || {
            // A leftover of an earlier attempt, or of another program.
            match fs::remove_file(&part) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
            let mut file = File::create_new(&part)?;
            file.write_all(&flash::encode(self.identity.serial, kept))?;
            file.sync_all()?;
            hold(&file)?;
            if self.held.is_some() {
                fs::rename(&part, path)?;
            } else {
                // Another process may have made one meanwhile.
                match renameat_with(CWD, &part, CWD, path, RenameFlags::NOREPLACE) {
                    Err(Errno::INVAL | Errno::NOSYS) => fs::rename(&part, path)?,
                    renamed => renamed?,
                }
            }
            // Its name outlives a loss of power too, where the file system can promise that.
            let _ = File::open(folder_of(path)).and_then(|folder| folder.sync_all());
            Ok(file)
        };
        // It may not even have been made.
        self.held = Some(store().inspect_err(|_| drop(fs::remove_file(&part)))?);
        Ok(())
    }
}

/// Makes `held` the locked file that is at a path now.
fn lock(path: &Path, held: &mut Option<File>) -> io::Result<()> {
    loop {
        let file = match input::open(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                *held = None;
                return Ok(());
            }
            opened => opened?,
        };
        let is = identity(&file)?;
        if let Some(held) = held
            && identity(held)? == is
        {
            return Ok(());
        }
        hold(&file)?;
        // Another process may have replaced it before it was locked.
        if fs::metadata(path).is_ok_and(|about| (about.dev(), about.ino()) == is) {
            *held = Some(file);
            return Ok(());
        }
    }
}

/// Locks a file; where the file system has no locks, it stays without.
fn hold(file: &File) -> io::Result<()> {
    match flock(file, FlockOperation::NonBlockingLockExclusive) {
        Err(Errno::WOULDBLOCK) => {
            let who = holder(file).unwrap_or_else(|| "another process".to_owned());
            let why = format!("{who} uses it: end that one first, or name another --flash directory");
            Err(io::Error::new(io::ErrorKind::ResourceBusy, why))
        }
        _ => Ok(()),
    }
}

/// The device and the inode of a file.
fn identity(file: &File) -> io::Result<(u64, u64)> {
    let about = file.metadata()?;
    Ok((about.dev(), about.ino()))
}

/// The process that has locked a file, by id and name, as the kernel lists it.
fn holder(file: &File) -> Option<String> {
    let (device, inode) = identity(file).ok()?;
    let place = format!("{:02x}:{:02x}:{inode}", rustix::fs::major(device), rustix::fs::minor(device));
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let line =
        locks.lines().find(|line| line.contains("FLOCK") && line.split_whitespace().any(|it| it == place))?;
    let process: u32 = line.split_whitespace().nth(4)?.parse().ok()?;
    let name = fs::read_to_string(format!("/proc/{process}/comm")).ok()?;
    Some(format!("process {process} ({})", name.trim_end()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::id::CellId;

    fn cell(directory: &Path, number: i64) -> FlashFile {
        let identity = Identity { cell: Some(CellId::new(number).unwrap()), serial: 7 };
        FlashFile::new(Some(directory), "vcan0", identity)
    }

    #[test]
    fn one_at_a_time_uses_a_cells_file_and_the_other_is_told_who() {
        let place = tempfile::tempdir().unwrap();
        let mut first = cell(place.path(), 1);
        let mut second = cell(place.path(), 1);
        assert!(first.load().unwrap().is_ok() && second.load().unwrap().is_ok(), "there is no file yet");
        first.store(&Kept::default()).unwrap();
        first.store(&Kept::default()).unwrap();
        let name = fs::read_to_string("/proc/self/comm").unwrap();
        let who = format!("process {} ({}) uses it", std::process::id(), name.trim_end());
        for error in [second.load().map(drop).unwrap_err(), second.store(&Kept::default()).unwrap_err()] {
            assert_eq!(error.kind(), io::ErrorKind::ResourceBusy);
            let said = error.to_string();
            assert!(said.starts_with(&who) || said.starts_with("another process"), "{said}");
        }
        cell(place.path(), 2).store(&Kept::default()).unwrap();
        drop(first);
        assert!(second.load().unwrap().is_ok());
        second.store(&Kept::default()).unwrap();
        assert!(!place.path().join("vcan0-1.flash.part").exists());
    }

    #[test]
    fn a_file_that_was_deleted_or_replaced_by_hand_is_written_again() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("vcan0-1.flash");
        let mut file = cell(place.path(), 1);
        file.store(&Kept::default()).unwrap();
        let image = fs::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        file.store(&Kept::default()).unwrap();
        fs::remove_file(&path).unwrap();
        fs::write(&path, []).unwrap();
        file.store(&Kept::default()).unwrap();
        assert_eq!(fs::read(&path).unwrap(), image);
    }
}
