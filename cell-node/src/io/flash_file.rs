//! Flash as a file.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use protocol::id::CellId;

use crate::flash::{self, FlashError, Kept};
use crate::node::{Flash, Identity};

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

    /// What it holds: a number, and parameters. What is there but not sound is damaged; why is the last value.
    ///
    /// # Errors
    /// When the file is there and cannot be read.
    pub fn load(&self) -> io::Result<(Option<CellId>, Flash, Option<FlashError>)> {
        let Some(path) = &self.path else { return Ok((None, Flash::Empty, None)) };
        let bytes = match fs::read(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((None, Flash::Empty, None)),
            Err(error) => return Err(error),
        };
        Ok(match flash::decode(self.identity, &bytes) {
            Ok(kept) => (kept.number, kept.parameters.map_or(Flash::Empty, Flash::Sound), None),
            Err(error) => (None, Flash::Damaged, Some(error)),
        })
    }

    /// Keeps a number and parameters: a whole new file takes the old one's place, or nothing changes.
    ///
    /// # Errors
    /// When the disk will not have it.
    pub fn store(&self, kept: &Kept) -> io::Result<()> {
        let Some(path) = &self.path else { return Ok(()) };
        let part = path.with_extension("flash.part");
        let store = || {
            let mut file = File::create(&part)?;
            file.write_all(&flash::encode(self.identity.serial, kept))?;
            file.sync_all()?;
            fs::rename(&part, path)?;
            // Its name outlives a loss of power too, where the file system can promise that.
            let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
            let _ = File::open(folder.unwrap_or_else(|| Path::new("."))).and_then(|folder| folder.sync_all());
            Ok(())
        };
        let stored = store();
        if stored.is_err() {
            // It may not even have been made.
            let _ = fs::remove_file(&part);
        }
        stored
    }
}
