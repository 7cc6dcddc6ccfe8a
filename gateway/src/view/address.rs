//! The file with a page's address, for scripts.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use protocol::usage::{Failure, print};
use tempfile::Builder;
use trace::files::folder_of;

/// The most bytes of a file that may be an address.
const LONGEST: u64 = 4096;

/// A file with the address of a page, which goes with this value. Only its user can read it, since the token is in it.
#[derive(Debug)]
pub(super) struct AddressFile {
    path: PathBuf,
    text: String,
}

impl AddressFile {
    /// Writes an address to a new file, in place of one that an earlier page has left; or to a pipe or a terminal, or for `-` to
    /// standard output, where nothing stays.
    pub(super) fn write(path: &Path, url: &str) -> Result<Option<Self>, Failure> {
        let text = format!("{url}\n");
        if path == Path::new("-") {
            return print(&text).map(|()| None);
        }
        let refused =
            |error: io::Error| Failure::usage(format!("--address-file {}: {error}", path.display()));
        if is_stream(path).map_err(refused)? {
            let written = OpenOptions::new()
                .write(true)
                .open(path)
                .and_then(|mut file| file.write_all(text.as_bytes()));
            return written.map(|()| None).map_err(refused);
        }
        let file = Builder::new().prefix(".skinbus-").tempfile_in(folder_of(path));
        let mut file = file.map_err(|error| refused(error.kind().into()))?;
        file.write_all(text.as_bytes()).map_err(refused)?;
        file.persist(path).map_err(|error| refused(error.error))?;
        Ok(Some(Self { path: path.to_owned(), text }))
    }
}

impl Drop for AddressFile {
    fn drop(&mut self) {
        // It may be another page's by now.
        if start_of(&self.path).is_ok_and(|text| text == self.text) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Checks what a path leads to: a pipe or a terminal, else a file that may be written or replaced.
fn is_stream(path: &Path) -> io::Result<bool> {
    let is_link = match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
        about => about?.is_symlink(),
    };
    let about = fs::metadata(path);
    if about.as_ref().is_ok_and(|about| !about.is_file() && !about.is_dir()) {
        return Ok(true);
    }
    let is_left =
        || start_of(path).is_ok_and(|text| text.starts_with("http://") && text.lines().count() == 1);
    if is_link || about.is_ok_and(|about| about.is_dir()) || !is_left() {
        let why = "it exists, and is no page's address: name another file";
        return Err(io::Error::new(io::ErrorKind::AlreadyExists, why));
    }
    Ok(false)
}

fn start_of(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    File::open(path)?.take(LONGEST).read_to_string(&mut text)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};

    #[test]
    fn an_address_is_its_users_alone_and_goes_with_its_page() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("address");
        let written = AddressFile::write(&path, "http://127.0.0.1:1/?token=a").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "http://127.0.0.1:1/?token=a\n");
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        drop(written);
        assert!(!path.exists());

        // One that was left is replaced, and the newer one is not taken away by the older.
        let older = AddressFile::write(&path, "http://127.0.0.1:2/").unwrap();
        let newer = AddressFile::write(&path, "http://127.0.0.1:3/").unwrap();
        drop(older);
        assert_eq!(fs::read_to_string(&path).unwrap(), "http://127.0.0.1:3/\n");
        drop(newer);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn no_other_file_is_written_to() {
        let folder = tempfile::tempdir().unwrap();
        let [notes, link] = ["notes", "link"].map(|name| folder.path().join(name));
        fs::write(&notes, "not an address\n").unwrap();
        symlink(&notes, &link).unwrap();
        let missing = folder.path().join("no/such/file");
        for path in [&notes, &link, folder.path(), missing.as_path()] {
            let refused = AddressFile::write(path, "http://127.0.0.1:1/").unwrap_err().to_string();
            assert!(refused.starts_with(&format!("--address-file {}: ", path.display())), "{refused}");
        }
        assert_eq!(fs::read_to_string(&notes).unwrap(), "not an address\n");
    }
}
