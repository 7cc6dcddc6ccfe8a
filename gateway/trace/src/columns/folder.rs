//! The folder of the columns, which gets its name when it is complete.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, RenameFlags, renameat_with};

use super::npy::{Element, NpyFile};
use crate::files::{
    create_unnamed_file, exists_error, lock_exclusively, rename, sync_folder, temporary_name,
    with_creation_hint,
};

/// The name of the file that describes the columns. A folder with it is one of columns.
pub const DESCRIPTION_FILE: &str = "columns.json";
/// The first key of the description, with the version of the format as its value.
pub const FORMAT_KEY: &str = "skinbus_columns";
/// The version of the format.
pub const FORMAT_VERSION: u32 = 2;
/// Number of bytes at the beginning of a description that contain the first key.
const MARKER_BYTES: u64 = 64;

/// A folder that gets its name only when all its files are complete. Until then it is called `.NAME.PID.part`, and is
/// removed if the program fails. If the program is killed it stays, until a conversion to the same name has the same
/// process id.
#[derive(Debug)]
pub struct ColumnFolder {
    path: PathBuf,
    overwrite: bool,
    /// The folder, locked as long as it is written: a process in another container may have the same id.
    _lock: File,
    /// The folder as long as it has its temporary name.
    part: Option<PathBuf>,
}

impl ColumnFolder {
    /// Creates the folder under its temporary name. An existing folder of columns is replaced at the end if `overwrite`
    /// is true, and is an error otherwise.
    ///
    /// # Errors
    /// Returns an error, with advice to the user, if the folder cannot be created or its name is taken.
    pub fn create(path: &Path, overwrite: bool) -> io::Result<Self> {
        check_columns_writable(path, overwrite)?;
        let part = temporary_name(path);
        match fs::create_dir(&part) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                remove_left_part(&part)?;
                fs::create_dir(&part)
            }
            created => created,
        }
        .map_err(with_creation_hint)?;
        let lock = File::open(&part).inspect_err(|_| remove_columns(&part))?;
        // Not every file system has locks.
        let _ = lock_exclusively(&lock);
        Ok(Self { path: path.to_owned(), overwrite, _lock: lock, part: Some(part) })
    }

    /// Creates the file of a column.
    ///
    /// # Errors
    /// Returns an error if the file cannot be created.
    pub fn create_column(
        &self,
        table: &str,
        column: &str,
        element: Element,
        width: Option<usize>,
    ) -> io::Result<NpyFile> {
        NpyFile::create(&self.place().join(format!("{table}.{column}.npy")), element, width)
    }

    /// Creates a file for reading and writing that disappears when it is closed.
    ///
    /// # Errors
    /// Returns an error if the file cannot be created.
    pub fn create_temporary_file(&self) -> io::Result<File> {
        create_unnamed_file(self.place(), 0o600).or_else(|_| {
            // The file system has no unnamed files: the name is removed while the file is open.
            let name = self.place().join(".blocks");
            let file = File::options().read(true).write(true).create_new(true).open(&name)?;
            fs::remove_file(name)?;
            Ok(file)
        })
    }

    /// Writes the description, which must begin with [`FORMAT_KEY`], and gives the folder its name.
    ///
    /// # Errors
    /// Returns an error if the file system refuses, or if another program has created the name meanwhile.
    pub fn finish(mut self, description: &str) -> io::Result<()> {
        let Some(part) = self.part.clone() else { return Ok(()) };
        let mut file = File::create_new(part.join(DESCRIPTION_FILE))?;
        file.write_all(description.as_bytes())?;
        file.sync_all()?;
        File::open(&part)?.sync_all()?;
        if self.overwrite && self.path.exists() {
            check_columns_writable(&self.path, true)?;
            // Both names exist at every time, so another program never finds none.
            match renameat_with(CWD, &part, CWD, &self.path, RenameFlags::EXCHANGE) {
                Ok(()) => remove_columns(&part),
                Err(_) => {
                    remove_columns(&self.path);
                    rename(&part, &self.path, false)?;
                }
            }
        } else {
            rename(&part, &self.path, false)?;
        }
        self.part = None;
        sync_folder(&self.path);
        Ok(())
    }

    fn place(&self) -> &Path {
        self.part.as_deref().unwrap_or(&self.path)
    }
}

impl Drop for ColumnFolder {
    fn drop(&mut self) {
        if let Some(part) = &self.part {
            remove_columns(part);
        }
    }
}

/// Checks that a folder of columns may be written, before there is anything to write.
///
/// # Errors
/// Returns an error, with advice to the user, if it may not.
pub fn check_columns_writable(path: &Path, overwrite: bool) -> io::Result<()> {
    let kind = match fs::symlink_metadata(path) {
        Ok(about) => about.file_type(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            let parent = crate::files::parent_folder(path);
            return fs::metadata(parent).map(|_| ()).map_err(with_creation_hint);
        }
        Err(error) => return Err(with_creation_hint(error)),
    };
    let refused = |why: String| Err(io::Error::new(io::ErrorKind::AlreadyExists, why));
    if !kind.is_dir() {
        return refused("it exists and is not a folder of columns: name another folder".to_owned());
    }
    if !has_description(path) {
        return refused("the folder contains other files: name another folder".to_owned());
    }
    if !overwrite {
        return Err(exists_error());
    }
    for entry in fs::read_dir(path)? {
        let name = entry?.file_name();
        if !is_column_file(Path::new(&name)) {
            return refused(format!(
                "the folder contains {}, which is not a column file: move that file away, or name another \
                 folder",
                name.display()
            ));
        }
    }
    Ok(())
}

/// Returns true for a folder with the description of columns, of any version.
fn has_description(path: &Path) -> bool {
    let mut head = String::new();
    let read = File::open(path.join(DESCRIPTION_FILE))
        .and_then(|file| file.take(MARKER_BYTES).read_to_string(&mut head));
    read.is_ok() && head.trim_start_matches(['{', ' ', '\n']).starts_with(&format!("\"{FORMAT_KEY}\""))
}

fn is_column_file(name: &Path) -> bool {
    name == Path::new(DESCRIPTION_FILE) || name.extension().is_some_and(|end| end == "npy")
}

/// Removes the folder of a killed conversion that had the same process id.
fn remove_left_part(part: &Path) -> io::Result<()> {
    if is_left_part(part)? {
        remove_columns(part);
        return Ok(());
    }
    let name = part.display();
    let why = format!(
        "{name} exists, but was not left by an interrupted conversion: move it away, or name another folder"
    );
    Err(io::Error::new(io::ErrorKind::AlreadyExists, why))
}

/// Returns true for a folder that has only columns and that no process writes.
fn is_left_part(part: &Path) -> io::Result<bool> {
    if !fs::symlink_metadata(part)?.is_dir() {
        return Ok(false);
    }
    let is_locked =
        lock_exclusively(&File::open(part)?).is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock);
    let mut has_others = false;
    for entry in fs::read_dir(part)? {
        let entry = entry?;
        has_others |= !entry.file_type()?.is_file() || !is_column_file(Path::new(&entry.file_name()));
    }
    Ok(!is_locked && !has_others)
}

/// Removes the columns of a folder, and the folder if nothing else is in it. The description is removed last, so that
/// the rest is still a folder of columns if this is interrupted or fails. Errors cannot be handled here.
fn remove_columns(path: &Path) {
    let mut is_rest = false;
    for entry in fs::read_dir(path).into_iter().flatten().flatten() {
        let name = entry.file_name();
        if name != DESCRIPTION_FILE && is_column_file(Path::new(&name)) {
            is_rest |= fs::remove_file(entry.path()).is_err();
        }
    }
    if !is_rest {
        let _ = fs::remove_file(path.join(DESCRIPTION_FILE));
        let _ = fs::remove_dir(path);
    }
}

#[cfg(test)]
mod tests;
