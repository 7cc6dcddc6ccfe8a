//! A folder whose files get their names together, when everything is done.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use protocol::usage::Failure;

/// A folder for what experiments come to. What is written stands in a hidden folder in it until [`Folder::finish`]; if that
/// never comes, nothing of it stays.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    inside: PathBuf,
    /// Whether it was made for this.
    made: bool,
}

impl Folder {
    /// Makes it where there is none, and makes sure that it can be written.
    pub(super) fn create(path: &Path) -> Result<Self, Failure> {
        let wrong = |error: &dyn std::fmt::Display| {
            Failure::run(format!("-o {}: {error}; name a folder that can be written", path.display()))
        };
        let made = !path.exists();
        if !made && !path.is_dir() {
            return Err(wrong(&"it is a file"));
        }
        fs::create_dir_all(path).map_err(|error| wrong(&error))?;
        let inside = path.join(format!(".experiment.{}.part", std::process::id()));
        let folder = Self { path: path.to_owned(), inside, made };
        fs::create_dir(&folder.inside).map_err(|error| wrong(&error))?;
        Ok(folder)
    }

    /// Where files are until they get their names.
    pub(super) fn inside(&self) -> PathBuf {
        self.inside.clone()
    }

    /// Writes a file.
    pub(super) fn write(&self, name: &str, text: &str) -> Result<(), Failure> {
        fs::write(self.inside.join(name), text).map_err(|error| self.failed(name, &error))
    }

    /// Everything gets its name; files of the same names are replaced.
    pub(super) fn finish(self) -> Result<(), Failure> {
        let listed = fs::read_dir(&self.inside).and_then(Iterator::collect::<io::Result<Vec<_>>>);
        for entry in listed.map_err(|error| self.failed("", &error))? {
            let name = entry.file_name();
            fs::rename(entry.path(), self.path.join(&name))
                .map_err(|error| self.failed(&name.to_string_lossy(), &error))?;
        }
        Ok(())
    }

    fn failed(&self, name: &str, error: &io::Error) -> Failure {
        Failure::run(format!("{}: {error}", self.path.join(name).display()))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // Nothing more can be done; a folder that has something in it stays.
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
        let folder = Folder::create(&path).unwrap();
        folder.write("report.html", "half").unwrap();
        drop(folder);
        assert!(!path.exists());
        for text in ["first", "second"] {
            let folder = Folder::create(&path).unwrap();
            folder.write("report.html", text).unwrap();
            folder.finish().unwrap();
            assert_eq!(fs::read_to_string(path.join("report.html")).unwrap(), text);
        }
        let folder = Folder::create(&path).unwrap();
        folder.write("report.html", "third").unwrap();
        drop(folder);
        assert_eq!(fs::read_to_string(path.join("report.html")).unwrap(), "second");
        assert_eq!(names(&path), ["report.html"]);
    }

    #[test]
    fn a_file_is_no_folder() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("file");
        fs::write(&path, "mine").unwrap();
        for path in [path.clone(), path.join("below")] {
            let error = Folder::create(&path).unwrap_err();
            assert!(format!("{error:?}").contains("name a folder"), "{error:?}");
        }
        assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
    }
}
