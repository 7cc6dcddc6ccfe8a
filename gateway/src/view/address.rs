//! File with the address of a page, for scripts.

use std::fs::{self, File, Permissions};
use std::io::{self, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use protocol::usage::{Failure, print_text};
use trace::files::AtomicFile;

/// Maximum size in bytes of a file that may be an address.
const MAX_FILE_BYTES: u64 = 4096;

/// A file with the address of a page, which is removed on drop. Only its user can read it, because it contains the
/// token.
#[derive(Debug)]
pub(super) struct AddressFile {
    path: PathBuf,
    text: String,
}

impl AddressFile {
    /// Writes an address to a new file, or replaces the file that an earlier page left. Writes to a pipe, to a
    /// terminal, or for `-` to standard output, without creating a file.
    pub(super) fn write(path: &Path, url: &str) -> Result<Option<Self>, Failure> {
        let text = format!("{url}\n");
        if path == Path::new("-") {
            return print_text(&text).map(|()| None);
        }
        let refused =
            |error: io::Error| Failure::usage_error(format!("--address-file {}: {error}", path.display()));
        let is_file = fs::symlink_metadata(path).is_ok_and(|about| about.is_file());
        if is_file && !is_address_file(path) {
            let why = "the file exists and does not contain the address of a page: name another file";
            return Err(refused(io::Error::new(io::ErrorKind::AlreadyExists, why)));
        }
        // Without this check, the error for a symlink would name an option that does not exist.
        let is_there = is_file || path.is_symlink();
        let (whole, mut file) = AtomicFile::create(path, is_there).map_err(refused)?;
        let is_stream = whole.is_stream();
        let written = || -> io::Result<()> {
            if !is_stream {
                file.set_permissions(Permissions::from_mode(0o600))?;
            }
            file.write_all(text.as_bytes())?;
            whole.finish()
        };
        written().map_err(refused)?;
        if is_stream {
            return Ok(None);
        }
        Ok(Some(Self { path: path.to_owned(), text }))
    }
}

impl Drop for AddressFile {
    fn drop(&mut self) {
        // Remove the file only if no other page has replaced it.
        if read_beginning(&self.path).is_ok_and(|text| text == self.text) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Returns true if the file contains the address of a page that was served earlier.
fn is_address_file(path: &Path) -> bool {
    read_beginning(path).is_ok_and(|text| text.starts_with("http://") && text.lines().count() == 1)
}

fn read_beginning(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    File::open(path)?.take(MAX_FILE_BYTES).read_to_string(&mut text)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    #[test]
    fn an_address_is_its_users_alone_and_goes_with_its_page() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("address");
        let written = AddressFile::write(&path, "http://127.0.0.1:1/?token=a").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "http://127.0.0.1:1/?token=a\n");
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        drop(written);
        assert!(!path.exists());

        // A file that was left is replaced, and the older page does not remove the newer page's file.
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
