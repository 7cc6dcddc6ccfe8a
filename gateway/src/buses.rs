//! A private directory for embedded buses.

use std::fs::{File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;

use protocol::bus::embedded::mark;
use protocol::usage::Failure;
use tempfile::{Builder, TempDir};

/// Makes one in the folder for temporary files, `skinbus-WHAT-` and some letters; gone with what is in it when this is
/// dropped.
pub(super) fn directory(what: &str) -> Result<TempDir, Failure> {
    // A socket's path has at most 107 bytes; a folder for temporary files may have more.
    let fits = |folder: &PathBuf| folder.as_os_str().len() <= 50;
    let folder = Some(std::env::temp_dir()).filter(fits).unwrap_or_else(|| PathBuf::from("/tmp"));
    let mine = Permissions::from_mode(0o700);
    let made = Builder::new().prefix(&format!("skinbus-{what}-")).permissions(mine).tempdir_in(folder);
    let failed = |error| Failure::run(format!("{error}; set SKINBUS_DIR to a directory of your own"));
    let made = made.map_err(failed)?;
    // If this program is killed, the last server removes it.
    let marked = File::open(made.path()).and_then(|directory| Ok(mark(directory)?));
    marked.map_err(failed)?;
    Ok(made)
}
