//! Private directory for the sockets of embedded buses.

use std::fs::{File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;

use protocol::bus::embedded::write_marker;
use protocol::usage::Failure;
use tempfile::{Builder, TempDir};

/// Creates a directory `skinbus-WHAT-` plus some letters in the directory for temporary files. Dropping the returned
/// value removes the directory with its content.
pub(super) fn private_directory(what: &str) -> Result<TempDir, Failure> {
    // The path of a socket has at most 107 bytes, and a directory for temporary files may be longer.
    let fits = |folder: &PathBuf| folder.as_os_str().len() <= 50;
    let folder = Some(std::env::temp_dir()).filter(fits).unwrap_or_else(|| PathBuf::from("/tmp"));
    let mine = Permissions::from_mode(0o700);
    let made = Builder::new().prefix(&format!("skinbus-{what}-")).permissions(mine).tempdir_in(folder);
    let failed = |error| Failure::run_error(format!("{error}; set SKINBUS_DIR to a directory of your own"));
    let made = made.map_err(failed)?;
    // If this program is killed, the last bus server removes the directory.
    let marked = File::open(made.path()).and_then(|directory| Ok(write_marker(directory)?));
    marked.map_err(failed)?;
    Ok(made)
}
