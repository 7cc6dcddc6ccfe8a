//! Finds and runs the program `vcan-link`, which joins a bus with those of other hosts. It replaces the process of
//! `vcan-setup link`.
//!
//! The program depends on Zenoh. It is therefore a workspace of its own, and is installed separately. Both programs
//! must have the same version.

use std::env;
use std::ffi::{OsStr, OsString};
use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use protocol::usage::{path_from_env, shell_quoted_os};
use rustix::fs::{Access, access};
use thiserror::Error;

/// The name of the program.
pub const LINK_PROGRAM_NAME: &str = "vcan-link";
/// The environment variable for the path of `vcan-link`. It is needed if the program is neither beside `vcan-setup` nor
/// on `PATH`.
pub const PATH_VARIABLE: &str = "SKINBUS_VCAN_LINK";
/// The environment variable by which `vcan-setup` tells `vcan-link` its version.
const CALLER_VERSION_VARIABLE: &str = "VCAN_SETUP_VERSION";
/// The version of this crate, which is part of both programs.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The reason why `vcan-link` cannot be run.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProgramError {
    /// `vcan-link` was not found.
    #[error(
        "vcan-link was found neither beside vcan-setup nor on PATH; to install it, run in the project's \
         folder: `cargo install --locked --path vcan-setup/link`"
    )]
    Missing,
    /// The system cannot run the file that [`PATH_VARIABLE`] names.
    #[error("cannot run {}: {source}; correct {PATH_VARIABLE}, which names it", shell_quoted_os(path.as_os_str()))]
    Named {
        /// The file.
        path: PathBuf,
        /// The system error.
        source: io::Error,
    },
    /// The system cannot run the file that was found.
    #[error("cannot run {}: {source}", shell_quoted_os(path.as_os_str()))]
    Found {
        /// The file.
        path: PathBuf,
        /// The system error.
        source: io::Error,
    },
    /// `vcan-link` and the `vcan-setup` that runs it have different versions.
    #[error(
        "vcan-link {VERSION} was run by vcan-setup {0}, but both must have the same version; to install it, \
         run in the project's folder: `cargo install --locked --path vcan-setup/link`"
    )]
    Version(String),
}

/// Replaces this process by `vcan-link`, with the same process id, so that signals and the exit code are those of
/// `vcan-link`. Returns only if that fails.
pub fn exec_link_program(arguments: impl IntoIterator<Item = OsString>) -> ProgramError {
    let start = |path: &Path| Command::new(path).args(arguments).env(CALLER_VERSION_VARIABLE, VERSION).exec();
    if let Some(path) = path_from_env(PATH_VARIABLE) {
        let source = start(&path);
        return ProgramError::Named { path, source };
    }
    let own = env::current_exe().ok();
    match find_program(own.as_deref().and_then(Path::parent), env::var_os("PATH").as_deref()) {
        Some(path) => {
            let source = start(&path);
            ProgramError::Found { path, source }
        }
        None => ProgramError::Missing,
    }
}

/// Finds `vcan-link` beside `vcan-setup`, or else in the folders of `PATH`. Returns the first file that is executable.
/// If none is, returns the first file, so that an error can name it.
fn find_program(beside: Option<&Path>, path: Option<&OsStr>) -> Option<PathBuf> {
    let folders = beside.map(Path::to_owned).into_iter();
    let folders = folders.chain(path.into_iter().flat_map(env::split_paths));
    // An empty entry in PATH means the current folder, which is not searched.
    let folders = folders.filter(|folder| !folder.as_os_str().is_empty());
    let files: Vec<_> =
        folders.map(|folder| folder.join(LINK_PROGRAM_NAME)).filter(|file| file.is_file()).collect();
    let executable = files.iter().find(|file| access(file.as_path(), Access::EXEC_OK).is_ok());
    executable.or_else(|| files.first()).cloned()
}

/// Checks that the `vcan-setup` that ran this program has the same version. Succeeds if the program was run directly.
///
/// # Errors
///
/// Returns [`ProgramError::Version`] if the versions differ.
pub fn check_caller() -> Result<(), ProgramError> {
    check_caller_version(env::var_os(CALLER_VERSION_VARIABLE).as_deref())
}

fn check_caller_version(caller: Option<&OsStr>) -> Result<(), ProgramError> {
    match caller {
        Some(version) if version != VERSION => {
            Err(ProgramError::Version(version.to_string_lossy().into_owned()))
        }
        Some(_) | None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn it_is_found_beside_or_on_path_and_what_cannot_be_executed_comes_last() {
        let folder = tempfile::tempdir().unwrap();
        let [beside, odd, plain] = [&b"beside"[..], b"o d\xff", b"plain"].map(|name| {
            let folder = folder.path().join(OsStr::from_bytes(name));
            fs::create_dir(&folder).unwrap();
            folder
        });
        let put = |folder: &Path, mode| {
            let file = folder.join(LINK_PROGRAM_NAME);
            fs::write(&file, "").unwrap();
            fs::set_permissions(&file, fs::Permissions::from_mode(mode)).unwrap();
            file
        };
        let path = env::join_paths([Path::new(""), &plain, &odd]).unwrap();
        let found = || find_program(Some(&beside), Some(&path));
        assert_eq!(found(), None);
        let in_plain = put(&plain, 0o644);
        assert_eq!(found(), Some(in_plain), "the error is about this one");
        let in_odd = put(&odd, 0o755);
        assert_eq!(found(), Some(in_odd));
        let in_beside = put(&beside, 0o755);
        assert_eq!(found(), Some(in_beside));
        assert_eq!(find_program(None, None), None);
        fs::create_dir(folder.path().join(LINK_PROGRAM_NAME)).unwrap();
        assert_eq!(find_program(Some(folder.path()), None), None, "a folder");
    }

    #[test]
    fn another_version_is_refused_with_both() {
        assert!(check_caller_version(None).is_ok() && check_caller_version(Some(VERSION.as_ref())).is_ok());
        let error = check_caller_version(Some("0.0.9".as_ref())).unwrap_err().to_string();
        assert!(error.starts_with(&format!("vcan-link {VERSION} was run by vcan-setup 0.0.9, ")), "{error}");
        assert!(check_caller_version(Some("".as_ref())).is_err());
    }
}
