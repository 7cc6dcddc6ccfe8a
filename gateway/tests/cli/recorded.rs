//! Copies of recordings, in a directory of a test's own.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use tempfile::TempDir;
use trace::capture::Reader;

pub(super) fn recordings() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/recordings")
}

/// Runs the program in a directory; spaces separate its arguments.
pub(super) fn skinbus(folder: &Path, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split(' ').filter(|word| !word.is_empty())).current_dir(folder).output().unwrap()
}

/// A directory with recordings and the skin of each.
pub(super) fn folder(names: &[&str]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in names {
        let from = recordings().join(name);
        fs::copy(&from, folder.path().join(name)).unwrap();
        let reader = Reader::open(&from).unwrap();
        let skin = reader.extras().attachments.iter().find(|(name, _)| name == "skin.toml");
        if let Some((_, skin)) = skin {
            fs::write(folder.path().join(name).with_extension("toml"), skin).unwrap();
        }
    }
    folder
}
