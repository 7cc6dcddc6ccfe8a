//! Files that a run writes: claimed before it begins, whole at its end or not there.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, CWD, Mode, OFlags, linkat, open};

/// A file that has a name only when it is whole. Until then it has none at all, and so is gone with a
/// program that is killed; where the file system has no such files it is called `.NAME.PID.part`, and a run
/// that does not come to its end takes it away.
///
/// What is there and is no regular file (a pipe, a device, a link such as `/dev/stdout`) is written to as
/// it is.
#[derive(Debug)]
pub struct WholeFile {
    path: PathBuf,
    state: State,
}

#[derive(Debug)]
enum State {
    /// Written to as it is, or finished.
    Named,
    /// Without a name, held open by this.
    Nameless(File),
    /// Under another name.
    Part,
}

impl WholeFile {
    /// Opens a file, so that what makes that impossible is known before there is anything to write.
    ///
    /// # Errors
    /// When it cannot be written, and what to do.
    pub fn create(path: &Path) -> io::Result<(Self, File)> {
        Self::open(path.to_owned()).map_err(with_remedy)
    }

    fn open(path: PathBuf) -> io::Result<(Self, File)> {
        if path.is_dir() {
            return Err(io::ErrorKind::IsADirectory.into());
        }
        if fs::symlink_metadata(&path).is_ok_and(|there| !there.is_file()) {
            let file = OpenOptions::new().write(true).truncate(true).open(&path)?;
            return Ok((Self { path, state: State::Named }, file));
        }
        let folder =
            path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
        let flags = OFlags::TMPFILE | OFlags::WRONLY | OFlags::CLOEXEC;
        if let Ok(file) = open(folder, flags, Mode::from_raw_mode(0o666)).map(File::from) {
            let state = State::Nameless(file.try_clone()?);
            return Ok((Self { path, state }, file));
        }
        let whole = Self { path, state: State::Part };
        let file = File::create(whole.part())?;
        Ok((whole, file))
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
        if let State::Nameless(file) = &self.state {
            // A link never takes another file's place, so it gets a name of its own first.
            let file = format!("/proc/self/fd/{}", file.as_raw_fd());
            linkat(CWD, file, CWD, self.part(), AtFlags::SYMLINK_FOLLOW)?;
            self.state = State::Part;
        }
        if matches!(self.state, State::Part) {
            fs::rename(self.part(), &self.path)?;
            self.state = State::Named;
        }
        Ok(())
    }

    /// A name that no other program gives.
    fn part(&self) -> PathBuf {
        let mut name = OsString::from(".");
        name.push(self.path.file_name().unwrap_or_default());
        name.push(format!(".{}.part", std::process::id()));
        self.path.with_file_name(name)
    }
}

/// Why a file cannot be begun, and what to do when it is because of where it is to be.
#[must_use]
pub fn with_remedy(error: io::Error) -> io::Error {
    let place = matches!(
        error.kind(),
        io::ErrorKind::NotFound
            | io::ErrorKind::NotADirectory
            | io::ErrorKind::IsADirectory
            | io::ErrorKind::PermissionDenied
            | io::ErrorKind::ReadOnlyFilesystem
    );
    if !place {
        return error;
    }
    io::Error::new(error.kind(), format!("{error}; name a file in a folder that can be written"))
}

impl Drop for WholeFile {
    fn drop(&mut self) {
        if matches!(self.state, State::Part) {
            // Nothing more can be done.
            let _ = fs::remove_file(self.part());
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
    }

    #[test]
    fn who_names_a_place_for_no_file_is_told_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "mine").unwrap();
        for (path, why) in [
            (folder.path().to_owned(), "is a directory"),
            (folder.path().join("none/run.json"), "No such file or directory (os error 2)"),
            (file.join("run.json"), "Not a directory (os error 20)"),
        ] {
            let error = WholeFile::create(&path).unwrap_err();
            assert_eq!(error.to_string(), format!("{why}; name a file in a folder that can be written"));
        }
        let full = with_remedy(io::ErrorKind::StorageFull.into());
        assert_eq!(full.to_string(), "no storage space", "another folder may be as full");
    }

    #[test]
    fn two_that_write_to_one_name_do_not_meet() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.log");
        let (first, mut file) = WholeFile::create(&path).unwrap();
        assert!(names(folder.path()).is_empty(), "no name yet, or else another run could take it away");
        drop(WholeFile::create(&path).unwrap());
        file.write_all(b"first").unwrap();
        first.finish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "first");
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
