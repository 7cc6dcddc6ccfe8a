//! Files that a run writes: claimed before it begins, whole at its end or not there.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

/// A file that has its name only when it is whole: until then it is called `NAME.part`, and a run that
/// does not come to its end takes it away.
///
/// What is there and is no regular file (a pipe, a device, a link such as `/dev/stdout`) is written to as
/// it is.
#[derive(Debug)]
pub struct WholeFile {
    path: PathBuf,
    part: Option<PathBuf>,
}

impl WholeFile {
    /// Opens a file, so that what makes that impossible is known before there is anything to write.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn create(path: &Path) -> io::Result<(Self, File)> {
        if path.is_dir() {
            return Err(io::ErrorKind::IsADirectory.into());
        }
        if fs::symlink_metadata(path).is_ok_and(|there| !there.is_file()) {
            let file = OpenOptions::new().write(true).truncate(true).open(path)?;
            return Ok((Self { path: path.to_owned(), part: None }, file));
        }
        let mut part = OsString::from(path);
        part.push(".part");
        let file = File::create(&part)?;
        Ok((Self { path: path.to_owned(), part: Some(part.into()) }, file))
    }

    /// Its name, once it is whole.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives it its name; everything has been written.
    ///
    /// # Errors
    /// When the file system refuses.
    pub fn finish(mut self) -> io::Result<()> {
        let Some(part) = &self.part else { return Ok(()) };
        fs::rename(part, &self.path)?;
        self.part = None;
        Ok(())
    }
}

impl Drop for WholeFile {
    fn drop(&mut self) {
        if let Some(part) = &self.part {
            // Nothing more can be done.
            let _ = fs::remove_file(part);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn names(folder: &Path) -> Vec<OsString> {
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect()
    }

    #[test]
    fn a_file_has_its_name_when_it_is_whole_and_leaves_nothing_when_it_never_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.json");
        fs::write(&path, "old").unwrap();
        drop(WholeFile::create(&path).unwrap());
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        assert_eq!(names(folder.path()), ["run.json"]);
        let (whole, mut file) = WholeFile::create(&path).unwrap();
        file.write_all(b"new").unwrap();
        whole.finish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        assert_eq!(names(folder.path()), ["run.json"]);
        assert!(WholeFile::create(folder.path()).is_err(), "a directory is no file");
    }

    #[test]
    fn a_device_or_a_link_is_written_to_and_stays_what_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let [path, link] = ["file", "link"].map(|name| folder.path().join(name));
        fs::write(&path, "something longer").unwrap();
        std::os::unix::fs::symlink(&path, &link).unwrap();
        for path in [Path::new("/dev/null"), &link] {
            let (whole, mut file) = WholeFile::create(path).unwrap();
            file.write_all(b"new").unwrap();
            whole.finish().unwrap();
            assert!(!fs::symlink_metadata(path).unwrap().is_file());
        }
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
    }
}
