//! A directory whose files get their names together when everything is done.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use protocol::usage::Failure;
use trace::files::{rename, sync_folder, write_atomically};

use crate::output::OverwriteOption;

/// A directory for results of experiments. Files are written to a hidden directory in it until [`Folder::finish`];
/// without that call they are removed.
#[derive(Debug)]
pub(super) struct ResultFolder {
    path: PathBuf,
    inside: PathBuf,
    /// True if this program created the directory.
    made: bool,
    overwrite: OverwriteOption,
}

impl ResultFolder {
    /// Creates the directory if it does not exist, and checks that it can be written. A directory that is not empty is
    /// accepted only with `overwrite`.
    pub(super) fn create(path: &Path, overwrite: OverwriteOption) -> Result<Self, Failure> {
        let wrong = |error: &dyn std::fmt::Display| {
            Failure::run_error(format!("-o {}: {error}; name a folder that can be written", path.display()))
        };
        let made = !path.exists();
        if !made && !path.is_dir() {
            return Err(wrong(&"it is a file"));
        }
        fs::create_dir_all(path).map_err(|error| wrong(&error))?;
        let taken = fs::read_dir(path).map_err(|error| wrong(&error))?.next().is_some();
        if taken && !overwrite.overwrite {
            let path = path.display();
            return Err(Failure::usage_error(format!(
                "-o {path}: the folder is not empty: name another folder, or overwrite files in it with --overwrite"
            )));
        }
        let inside = path.join(format!(".experiment.{}.part", std::process::id()));
        let folder = Self { path: path.to_owned(), inside, made, overwrite };
        fs::create_dir(&folder.inside).map_err(|error| wrong(&error))?;
        Ok(folder)
    }

    /// Returns the hidden directory that contains the files until they get their names.
    pub(super) fn staging_directory(&self) -> PathBuf {
        self.inside.clone()
    }

    /// Writes a file.
    pub(super) fn write(&self, name: &str, text: &str) -> Result<(), Failure> {
        write_atomically(&self.inside.join(name), text, false)
            .map_err(|error| self.write_failure(name, &error))
    }

    /// Gives all files their names, in alphabetical order. Existing files are replaced only with `overwrite`.
    pub(super) fn finish(self) -> Result<(), Failure> {
        self.publish_files()
    }

    /// Gives the files written so far their names.
    pub(super) fn publish_files(&self) -> Result<(), Failure> {
        let listed = fs::read_dir(&self.inside).and_then(Iterator::collect::<io::Result<Vec<_>>>);
        let mut names: Vec<_> = listed
            .map_err(|error| self.write_failure("", &error))?
            .iter()
            .map(fs::DirEntry::file_name)
            .collect();
        names.sort();
        for name in names {
            rename(&self.inside.join(&name), &self.path.join(&name), self.overwrite.overwrite)
                .map_err(|error| self.write_failure(&name.to_string_lossy(), &error))?;
        }
        sync_folder(&self.inside);
        if self.made {
            // The directories above it may be new too.
            self.path.ancestors().for_each(sync_folder);
        }
        Ok(())
    }

    fn write_failure(&self, name: &str, error: &io::Error) -> Failure {
        Failure::run_error(format!("{}: {error}", self.path.join(name).display()))
    }
}

impl Drop for ResultFolder {
    fn drop(&mut self) {
        // Errors cannot be handled here; a directory that is not empty stays.
        let _ = fs::remove_dir_all(&self.inside);
        if self.made {
            let _ = fs::remove_dir(&self.path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(path: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(path).unwrap().map(|it| it.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn what_is_not_finished_leaves_nothing_and_what_is_replaces_what_was_there() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("deep/er");
        let [kept, forced] = [false, true].map(|overwrite| OverwriteOption { overwrite });
        let folder = ResultFolder::create(&path, kept).unwrap();
        folder.write("report.html", "half").unwrap();
        drop(folder);
        assert!(!path.exists());
        for (overwrite, text) in [(kept, "first"), (forced, "second")] {
            let folder = ResultFolder::create(&path, overwrite).unwrap();
            folder.write("report.html", text).unwrap();
            folder.finish().unwrap();
            assert_eq!(fs::read_to_string(path.join("report.html")).unwrap(), text);
        }
        let refused = ResultFolder::create(&path, kept).unwrap_err();
        assert!(format!("{refused:?}").contains("the folder is not empty"), "{refused:?}");
        let folder = ResultFolder::create(&path, forced).unwrap();
        folder.write("report.html", "third").unwrap();
        drop(folder);
        assert_eq!(fs::read_to_string(path.join("report.html")).unwrap(), "second");
        assert_eq!(names(&path), ["report.html"]);
    }

    #[test]
    fn what_is_measured_stays_when_what_is_drawn_cannot_be_written() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("out");
        fs::create_dir_all(path.join("report.html")).unwrap();
        let folder = ResultFolder::create(&path, OverwriteOption { overwrite: true }).unwrap();
        folder.write("results.json", "{}").unwrap();
        folder.publish_files().unwrap();
        folder.write("report.html", "page").unwrap();
        let failed = folder.finish().unwrap_err();
        assert!(failed.to_string().contains("out/report.html: "), "{failed}");
        assert_eq!(names(&path), ["report.html", "results.json"]);
    }

    #[test]
    fn a_file_is_no_folder() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("file");
        fs::write(&path, "mine").unwrap();
        for path in [path.clone(), path.join("below")] {
            let error = ResultFolder::create(&path, OverwriteOption { overwrite: true }).unwrap_err();
            assert!(format!("{error:?}").contains("name a folder"), "{error:?}");
        }
        assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
    }
}
