//! Input files. They must be regular files, or pipes that a shell opened for this process. Other files may never end: a
//! named pipe can wait forever for a writer, and a device has no last byte.

use std::fs::{self, File, FileType, OpenOptions};
use std::io::{self, Read};
use std::os::fd::AsFd;
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};

/// The path that stands for standard input. A file of this name is written as `./-`.
pub const STANDARD_INPUT: &str = "-";

/// The descriptors that [`open`] has already returned. Their data can be read only once.
static OPENED_DESCRIPTORS: Mutex<Vec<u32>> = Mutex::new(Vec::new());

/// Records that a descriptor is in use. Returns an error if it already is.
fn claim_descriptor(descriptor: u32) -> io::Result<()> {
    let mut taken = OPENED_DESCRIPTORS.lock().unwrap_or_else(PoisonError::into_inner);
    if taken.contains(&descriptor) {
        return Err(io::Error::other(
            "two arguments name this input, but it can be read only once: use a file for one of them",
        ));
    }
    taken.push(descriptor);
    Ok(())
}

/// Returns true if `path` is `-`, which stands for standard input.
#[must_use]
pub fn is_standard_input(path: &Path) -> bool {
    path == Path::new(STANDARD_INPUT)
}

/// Returns true for a regular file, which [`open`] can open repeatedly. Other inputs can be opened once.
#[must_use]
pub fn can_be_read_again(path: &Path) -> bool {
    !is_standard_input(path) && path.is_file()
}

/// Opens a regular file for reading, or one of this process's own descriptors (`-`, `/dev/stdin`, or `<(...)`
/// of a shell) of any type, but only once. Does not block.
///
/// # Errors
/// Returns an error if the path names a folder, a named pipe, a socket or a device, if it names a descriptor that was
/// opened before, or if it cannot be opened.
pub fn open(path: &Path) -> io::Result<File> {
    if is_standard_input(path) {
        claim_descriptor(0)?;
        return Ok(io::stdin().as_fd().try_clone_to_owned()?.into());
    }
    let flags = (OFlags::NONBLOCK | OFlags::NOCTTY).bits().cast_signed();
    // `open` fails for a socket too, but its error says only that there is no such device.
    let is_socket = fs::metadata(path).is_ok_and(|about| about.file_type().is_socket());
    if is_socket {
        return Err(io::Error::other("it is a socket, but a file is needed"));
    }
    let file = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    let kind = file.metadata()?.file_type();
    if !kind.is_file() {
        claim_descriptor(descriptor_of_path(path).ok_or_else(|| not_readable_error(kind))?)?;
        fcntl_setfl(&file, fcntl_getfl(&file)? - OFlags::NONBLOCK)?;
    }
    Ok(file)
}

fn not_readable_error(kind: FileType) -> io::Error {
    let what = if kind.is_dir() {
        "it is a folder, but a file is needed"
    } else if kind.is_fifo() {
        "it is a named pipe, but a file is needed; a pipe is read as /dev/stdin (< PIPE)"
    } else {
        "it is a device, but a file is needed"
    };
    io::Error::other(what)
}

/// Reads all bytes of a file, opened with [`open`].
///
/// # Errors
/// Returns the errors of [`open`], or an error if the file has more than `longest` bytes.
pub fn read_bytes(path: &Path, longest: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(longest.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > longest {
        return Err(io::Error::other(format!("it is longer than {longest} bytes, the maximum")));
    }
    Ok(bytes)
}

/// Returns the number of the file descriptor of this process that a path such as `/dev/stdout` names; `None` for other
/// paths.
#[must_use]
pub fn descriptor_of_path(path: &Path) -> Option<u32> {
    let own = fs::canonicalize("/proc/self/fd").ok()?;
    let mut path = path.to_owned();
    // The kernel follows at most 40 links as well.
    for _ in 0..40 {
        let folder = fs::canonicalize(parent_folder(&path)).ok()?;
        if folder == own {
            return path.file_name()?.to_str()?.parse().ok();
        }
        path = folder.join(fs::read_link(&path).ok()?);
    }
    None
}

/// Returns the folder that contains a file.
#[must_use]
pub fn parent_folder(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{CWD, FileType as Kind, Mode, mknodat};
    use std::os::fd::AsRawFd;
    use std::os::unix::net::UnixListener;

    fn error(path: &Path) -> String {
        open(path).unwrap_err().to_string()
    }

    #[test]
    fn what_need_not_end_is_not_opened() {
        let folder = std::env::temp_dir().join(format!("skinbus-input-{}", std::process::id()));
        fs::create_dir(&folder).unwrap();
        let (pipe, socket, link) = (folder.join("pipe"), folder.join("socket"), folder.join("link"));
        mknodat(CWD, &pipe, Kind::Fifo, Mode::RUSR, 0).unwrap();
        let _listener = UnixListener::bind(&socket).unwrap();
        std::os::unix::fs::symlink("pipe", &link).unwrap();
        assert!(error(&pipe).starts_with("it is a named pipe"));
        assert!(error(&link).starts_with("it is a named pipe"));
        assert_eq!(error(&socket), "it is a socket, but a file is needed");
        assert_eq!(error(&folder), "it is a folder, but a file is needed");
        assert_eq!(error(Path::new("/dev/zero")), "it is a device, but a file is needed");
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_pipe_of_the_shell_is_read_and_waited_for() {
        let (reader, mut writer) = io::pipe().unwrap();
        let name = format!("/dev/fd/{}", reader.as_raw_fd());
        let mut file = open(Path::new(&name)).unwrap();
        assert!(
            error(Path::new(&name))
                .starts_with("two arguments name this input, but it can be read only once")
        );
        let writing = std::thread::spawn(move || {
            std::thread::sleep(std::time::Duration::from_millis(20));
            io::Write::write_all(&mut writer, b"late")
        });
        drop(reader);
        let mut text = String::new();
        file.read_to_string(&mut text).unwrap();
        assert_eq!(text, "late");
        writing.join().unwrap().unwrap();
    }

    #[test]
    fn more_bytes_than_allowed_are_an_error() {
        let own = std::env::current_exe().unwrap();
        let length = fs::metadata(&own).unwrap().len();
        assert_eq!(read_bytes(&own, length).unwrap().len() as u64, length);
        assert!(read_bytes(&own, length - 1).unwrap_err().to_string().starts_with("it is longer than"));
    }
}
