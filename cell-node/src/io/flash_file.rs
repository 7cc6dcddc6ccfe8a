//! Flash as a file.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use protocol::input::{self, folder_of};

use crate::flash::{self, FlashError, Kept};
use crate::identity::Identity;

/// The most bytes that are read of a file; what flash holds is far less.
const LONGEST: u64 = 64 << 10;

/// Where a cell keeps its parameters; without a directory, in memory only.
#[derive(Debug)]
pub struct FlashFile {
    identity: Identity,
    path: Option<PathBuf>,
}

impl FlashFile {
    /// The file `BUS-NODE.flash` in a directory, or `BUS-sSERIAL.flash` of a cell that came without a number.
    #[must_use]
    pub fn new(directory: Option<&Path>, bus: &str, identity: Identity) -> Self {
        let name = identity.cell.map_or_else(|| format!("s{}", identity.serial), |cell| cell.to_string());
        let path = directory.map(|directory| directory.join(format!("{bus}-{name}.flash")));
        Self { identity, path }
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

    /// What it holds, which is nothing where there is no file; or why that is not used.
    ///
    /// # Errors
    /// When the file is there and cannot be read.
    pub fn load(&self) -> io::Result<Result<Kept, FlashError>> {
        let Some(path) = &self.path else { return Ok(Ok(Kept::default())) };
        match input::bytes(path, LONGEST) {
            Ok(bytes) => Ok(flash::decode(self.identity, &bytes)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Ok(Kept::default())),
            Err(error) => Err(error),
        }
    }

    /// Keeps a number and parameters: a whole new file takes the old one's place, or nothing changes.
    ///
    /// # Errors
    /// When the disk will not have it.
    pub fn store(&self, kept: &Kept) -> io::Result<()> {
        let Some(path) = &self.path else { return Ok(()) };
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
            fs::rename(&part, path)?;
            // Its name outlives a loss of power too, where the file system can promise that.
            let _ = File::open(folder_of(path)).and_then(|folder| folder.sync_all());
            Ok(())
        };
        // It may not even have been made.
        store().inspect_err(|_| drop(fs::remove_file(&part)))
    }
}
