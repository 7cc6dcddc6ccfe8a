//! The flash of a cell in a file, which one process at a time can use.
//!
//! A lock on the file excludes other processes. The system removes it when the process ends. A new file is locked
//! before it replaces the old one.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use protocol::input::{self, parent_folder};
use rustix::fs::{CWD, FlockOperation, RenameFlags, flock, renameat_with};
use rustix::io::Errno;

use crate::flash::{self, FlashContent, FlashError};
use crate::identity::Identity;

/// Maximum number of bytes that are read from a file. A flash image is far smaller.
const MAX_READ_BYTES: u64 = 64 << 10;

/// The flash of a cell: a file, or no storage if no directory is given.
#[derive(Debug)]
pub struct FlashFile {
    identity: Identity,
    path: Option<PathBuf>,
    /// The locked file at the path; `None` if there is no file yet.
    held: Option<File>,
}

impl FlashFile {
    /// Creates a handle for the file `BUS-NODE.flash` in a directory, or `BUS-sSERIAL.flash` for a cell that was
    /// started without a node id.
    #[must_use]
    pub fn new(directory: Option<&Path>, bus: &str, identity: Identity) -> Self {
        let name = identity.cell.map_or_else(|| format!("s{}", identity.serial), |cell| cell.to_string());
        let path = directory.map(|directory| directory.join(format!("{bus}-{name}.flash")));
        Self { identity, path, held: None }
    }

    /// Returns the name of the flash for messages: `flash of cell 12 (DIR/vcan0-12.flash)`.
    #[must_use]
    pub fn name(&self) -> String {
        let Identity { cell, serial } = self.identity;
        let cell = cell.map_or_else(|| format!("with serial number {serial}"), |cell| cell.to_string());
        self.path.as_ref().map_or_else(
            || format!("flash of cell {cell}"),
            |path| format!("flash of cell {cell} ({})", path.display()),
        )
    }

    /// Locks and reads the file. The inner result is an error if the image is invalid. Without a file, the image is
    /// empty.
    ///
    /// # Errors
    /// Returns an error if the file exists but cannot be read, or another process uses it.
    pub fn load(&mut self) -> io::Result<Result<FlashContent, FlashError>> {
        let Some(path) = &self.path else { return Ok(Ok(FlashContent::default())) };
        lock_file_at(path, &mut self.held)?;
        if self.held.is_none() {
            return Ok(Ok(FlashContent::default()));
        }
        Ok(flash::decode(self.identity, &input::read_bytes(path, MAX_READ_BYTES)?))
    }

    /// Writes a node id and parameters to a new file, which then replaces the old one. If that fails, nothing changes.
    ///
    /// # Errors
    /// Returns an error if writing fails, or another process uses the file.
    pub fn store(&mut self, kept: &FlashContent) -> io::Result<()> {
        let Some(path) = &self.path else { return Ok(()) };
        lock_file_at(path, &mut self.held)?;
        let part = path.with_extension("flash.part");
        let store = || {
            // Left over from an earlier attempt or another program.
            match fs::remove_file(&part) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
            let mut file = File::create_new(&part)?;
            file.write_all(&flash::encode(self.identity.serial, kept))?;
            file.sync_all()?;
            lock_file(&file)?;
            if self.held.is_some() {
                fs::rename(&part, path)?;
            } else {
                // Another process may have created the file meanwhile.
                match renameat_with(CWD, &part, CWD, path, RenameFlags::NOREPLACE) {
                    Err(Errno::INVAL | Errno::NOSYS) => fs::rename(&part, path)?,
                    renamed => renamed?,
                }
            }
            // Make the rename durable, where the file system supports that.
            let _ = File::open(parent_folder(path)).and_then(|folder| folder.sync_all());
            Ok(file)
        };
        // The file may not exist if its creation failed.
        self.held = Some(store().inspect_err(|_| drop(fs::remove_file(&part)))?);
        Ok(())
    }
}

/// Opens and locks the file at this path, and stores it in `held`.
fn lock_file_at(path: &Path, held: &mut Option<File>) -> io::Result<()> {
    loop {
        let file = match input::open(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                *held = None;
                return Ok(());
            }
            opened => opened?,
        };
        let is = device_and_inode(&file)?;
        if let Some(held) = held
            && device_and_inode(held)? == is
        {
            return Ok(());
        }
        lock_file(&file)?;
        // Another process may have replaced the file before it was locked.
        if fs::metadata(path).is_ok_and(|about| (about.dev(), about.ino()) == is) {
            *held = Some(file);
            return Ok(());
        }
    }
}

/// Locks a file. On a file system that does not support locks, the file stays unlocked.
fn lock_file(file: &File) -> io::Result<()> {
    match flock(file, FlockOperation::NonBlockingLockExclusive) {
        Err(Errno::WOULDBLOCK) => {
            let who = lock_holder(file).unwrap_or_else(|| "another process".to_owned());
            let why =
                format!("{who} is using it: stop that process first, or choose another --flash directory");
            Err(io::Error::new(io::ErrorKind::ResourceBusy, why))
        }
        _ => Ok(()),
    }
}

/// Returns the device and inode numbers of a file.
fn device_and_inode(file: &File) -> io::Result<(u64, u64)> {
    let about = file.metadata()?;
    Ok((about.dev(), about.ino()))
}

/// Returns the id and name of the process that has locked a file, from the kernel's list of locks.
fn lock_holder(file: &File) -> Option<String> {
    let (device, inode) = device_and_inode(file).ok()?;
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
        first.store(&FlashContent::default()).unwrap();
        first.store(&FlashContent::default()).unwrap();
        let name = fs::read_to_string("/proc/self/comm").unwrap();
        let who = format!("process {} ({}) is using it", std::process::id(), name.trim_end());
        for error in
            [second.load().map(drop).unwrap_err(), second.store(&FlashContent::default()).unwrap_err()]
        {
            assert_eq!(error.kind(), io::ErrorKind::ResourceBusy);
            let said = error.to_string();
            assert!(said.starts_with(&who) || said.starts_with("another process"), "{said}");
        }
        cell(place.path(), 2).store(&FlashContent::default()).unwrap();
        drop(first);
        assert!(second.load().unwrap().is_ok());
        second.store(&FlashContent::default()).unwrap();
        assert!(!place.path().join("vcan0-1.flash.part").exists());
    }

    #[test]
    fn a_file_that_was_deleted_or_replaced_by_hand_is_written_again() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("vcan0-1.flash");
        let mut file = cell(place.path(), 1);
        file.store(&FlashContent::default()).unwrap();
        let image = fs::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        file.store(&FlashContent::default()).unwrap();
        fs::remove_file(&path).unwrap();
        fs::write(&path, []).unwrap();
        file.store(&FlashContent::default()).unwrap();
        assert_eq!(fs::read(&path).unwrap(), image);
    }
}
