//! Checks output files before they are written: the kind of an existing file, and the permissions.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File, FileType, OpenOptions};
use std::io::{self, Write};
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use protocol::input::{descriptor_of_path, parent_folder};
use rustix::fs::{
    AtFlags, CWD, FlockOperation, Mode, OFlags, RenameFlags, fcntl_getfl, fcntl_setfl, flock, linkat, open,
    renameat_with,
};
use rustix::io::Errno;

/// The interval between two attempts to open a FIFO that has no reader.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// The name that stands for standard output. A file that is called `-` is named `./-`.
pub const STANDARD_OUTPUT: &str = "-";

/// The kind of file that exists under the name of an output file.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum OutputTarget {
    /// No file has this name.
    New,
    /// A regular file, which is to be overwritten.
    Existing,
    /// A FIFO, a terminal, `/dev/stdout` or `-`, which is written directly.
    Stream,
}

impl OutputTarget {
    /// Determines which kind of file exists under a name. Returns an error for a regular file unless `force` is true,
    /// and for a symlink to a regular file or to nothing.
    pub(super) fn inspect_target(path: &Path, force: bool) -> io::Result<Self> {
        if path == Path::new(STANDARD_OUTPUT) {
            return Ok(Self::Stream);
        }
        let kind = match fs::symlink_metadata(path) {
            Ok(about) => about.file_type(),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return fs::metadata(parent_folder(path)).map(|_| Self::New).map_err(with_creation_hint);
            }
            Err(error) => return Err(with_creation_hint(error)),
        };
        if kind.is_symlink() {
            let streams = fs::metadata(path).is_ok_and(|about| is_stream(about.file_type()));
            return if streams || descriptor_of_path(path).is_some() {
                Ok(Self::Stream)
            } else {
                let itself = if !force && path.exists() { " and add --overwrite" } else { "" };
                let why = format!(
                    "it is a symlink, which is not followed: name the file that it points to{itself}, or \
                     another file"
                );
                Err(io::Error::new(io::ErrorKind::AlreadyExists, why))
            };
        }
        match kind {
            _ if is_stream(kind) => Ok(Self::Stream),
            _ if kind.is_dir() => Err(with_creation_hint(io::ErrorKind::IsADirectory.into())),
            _ if !kind.is_file() => Err(not_regular_file_error()),
            _ if force => Ok(Self::Existing),
            _ => Err(exists_error()),
        }
    }
}

/// Checks that a file may be written, before there is anything to write.
///
/// # Errors
/// Returns an error, with advice to the user, if it may not.
pub fn check_writable(path: &Path, force: bool) -> io::Result<()> {
    OutputTarget::inspect_target(path, force).map(|_| ())
}

/// Checks that a file may be written and is not a FIFO or a device, before there is anything to write.
///
/// # Errors
/// Returns an error, with advice to the user, if it may not.
pub fn check_writable_regular_file(path: &Path, force: bool) -> io::Result<()> {
    match OutputTarget::inspect_target(path, force)? {
        OutputTarget::New | OutputTarget::Existing => Ok(()),
        OutputTarget::Stream => Err(not_regular_file_error()),
    }
}

fn not_regular_file_error() -> io::Error {
    io::Error::new(io::ErrorKind::AlreadyExists, "it is not a regular file: name another file")
}

/// Returns the error for an output file that exists already.
pub(crate) fn exists_error() -> io::Error {
    let why = "the file exists: name another file, or add --overwrite";
    io::Error::new(io::ErrorKind::AlreadyExists, why)
}

/// Replaces an error of the kind `AlreadyExists` by [`exists_error`], which has advice for the user. Returns other
/// errors unchanged.
pub(super) fn with_exists_hint(error: io::Error) -> io::Error {
    if error.kind() == io::ErrorKind::AlreadyExists { exists_error() } else { error }
}

fn is_stream(kind: FileType) -> bool {
    kind.is_fifo() || kind.is_char_device()
}

/// Opens a FIFO, terminal or other stream. A FIFO is awaited until it has a reader or `stopped` is set.
pub(super) fn open_stream(path: &Path, stopped: &AtomicBool) -> io::Result<File> {
    let descriptor = if path == Path::new(STANDARD_OUTPUT) { Some(1) } else { descriptor_of_path(path) };
    let own: Option<OwnedFd> = match descriptor {
        Some(1) => Some(io::stdout().as_fd().try_clone_to_owned()?),
        Some(2) => Some(io::stderr().as_fd().try_clone_to_owned()?),
        _ => None,
    };
    if let Some(own) = own {
        return Ok(own.into());
    }
    let nonblocking = OFlags::NONBLOCK.bits().cast_signed();
    let file = loop {
        match OpenOptions::new().append(true).custom_flags(nonblocking).open(path) {
            Err(error) if Errno::from_io_error(&error) == Some(Errno::NXIO) => {
                if stopped.load(Ordering::Relaxed) {
                    return Err(io::Error::new(
                        io::ErrorKind::Interrupted,
                        "interrupted while it waited for a program that reads this pipe",
                    ));
                }
                std::thread::sleep(POLL_INTERVAL);
            }
            opened => break opened?,
        }
    };
    if !is_stream(file.metadata()?.file_type()) && descriptor_of_path(path).is_none() {
        return Err(exists_error());
    }
    fcntl_setfl(&file, fcntl_getfl(&file)? - OFlags::NONBLOCK)?;
    Ok(file)
}

/// Returns the path of a file with `suffix` after its stem and with the extension `end`, as in `run-1.mcap`.
#[must_use]
pub fn path_with_suffix(path: &Path, suffix: impl AsRef<OsStr>, end: &OsStr) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(suffix);
    if !end.is_empty() {
        name.push(".");
        name.push(end);
    }
    path.with_file_name(name)
}

/// Creates a file without a name in a folder, for writing and reading.
///
/// # Errors
/// Returns an error if the folder cannot be written, or if the file system does not support unnamed files.
pub(crate) fn create_unnamed_file(folder: &Path, mode: u32) -> io::Result<File> {
    let flags = OFlags::TMPFILE | OFlags::RDWR | OFlags::CLOEXEC;
    Ok(open(folder, flags, Mode::from_raw_mode(mode))?.into())
}

/// Gives a name to a file that has none. Fails if the name exists.
///
/// # Errors
/// Returns an error if the name cannot be given.
pub(crate) fn name_unnamed_file(file: &File, path: &Path) -> io::Result<()> {
    let nameless = format!("/proc/self/fd/{}", file.as_raw_fd());
    Ok(linkat(CWD, nameless, CWD, path, AtFlags::SYMLINK_FOLLOW)?)
}

/// Opens a file that another user may have created: a link is not followed, and a pipe without a writer does not block.
///
/// # Errors
/// Returns an error if the file cannot be opened.
pub(crate) fn open_no_follow(path: &Path) -> io::Result<File> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY).bits().cast_signed();
    OpenOptions::new().read(true).custom_flags(flags).open(path)
}

/// Locks a file exclusively for as long as it is open.
///
/// # Errors
/// Returns an error of the kind [`io::ErrorKind::WouldBlock`] if another process holds the lock, or another error if
/// the file system has no locks.
pub(crate) fn lock_exclusively(file: &File) -> io::Result<()> {
    Ok(flock(file, FlockOperation::NonBlockingLockExclusive)?)
}

/// Returns the device and the inode of a file, which identify it under any name.
pub(crate) fn device_and_inode(about: &fs::Metadata) -> (u64, u64) {
    (about.dev(), about.ino())
}

/// Returns true if `path` is a name of the file with the identity `is`, and not a symlink to it. Returns `None` if the
/// name cannot be queried.
pub(crate) fn still_names_file(path: &Path, is: (u64, u64)) -> Option<bool> {
    match fs::symlink_metadata(path) {
        Ok(about) => Some(device_and_inode(&about) == is),
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            Some(false)
        }
        Err(_) => None,
    }
}

/// The time after which a write that stays blocked is an error.
const RETRY_TIMEOUT: Duration = Duration::from_secs(1);
/// The interval between two attempts to write while writing is blocked.
const RETRY_INTERVAL: Duration = Duration::from_millis(2);

/// Writes as many bytes as the file accepts. Interrupted calls are repeated, blocked ones for up to a second. A call
/// that fails with any other error is repeated once.
///
/// # Errors
/// Returns the error if it persists.
pub(crate) fn write_with_retries(file: &mut impl Write, bytes: &[u8]) -> io::Result<usize> {
    let mut since = None;
    let mut is_second = false;
    loop {
        match file.write(bytes) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                if since.get_or_insert_with(Instant::now).elapsed() >= RETRY_TIMEOUT {
                    return Err(error);
                }
                std::thread::sleep(RETRY_INTERVAL);
            }
            Err(error) if is_second => return Err(error),
            Err(_) => is_second = true,
            Ok(written) => return Ok(written),
        }
    }
}

/// Writes all bytes, and retries like [`write_with_retries`].
///
/// # Errors
/// Returns the error if it persists, and an error if the file accepts no bytes.
pub(crate) fn write_all_with_retries(file: &mut impl Write, mut bytes: &[u8]) -> io::Result<()> {
    while !bytes.is_empty() {
        match write_with_retries(file, bytes)? {
            0 => return Err(io::ErrorKind::WriteZero.into()),
            written => bytes = bytes.get(written..).unwrap_or_default(),
        }
    }
    Ok(())
}

/// Returns a temporary name in the folder of a file. The name contains the process id, so no other program uses it.
pub(crate) fn temporary_name(path: &Path) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}.part", std::process::id()));
    path.with_file_name(name)
}

/// Renames a file. Replaces another file only with `force`.
///
/// # Errors
/// Returns an error if the file cannot be renamed.
pub fn rename(from: &Path, to: &Path, force: bool) -> io::Result<()> {
    if force {
        return fs::rename(from, to);
    }
    match renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE) {
        // The file system cannot rename without replacing, so the name is checked first.
        Err(Errno::INVAL | Errno::NOSYS) if fs::symlink_metadata(to).is_err() => fs::rename(from, to),
        Err(Errno::EXIST | Errno::INVAL | Errno::NOSYS) => Err(exists_error()),
        renamed => Ok(renamed?),
    }
}

/// Writes the folder of a file to the disk, so that the file's name survives a loss of power. Ignores errors of file
/// systems that do not support this.
pub fn sync_folder(path: &Path) {
    let _ = File::open(parent_folder(path)).and_then(|folder| folder.sync_all());
}

/// Returns true for errors that report a full disk or an exceeded quota.
#[must_use]
pub fn is_disk_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

/// Adds advice to an error of creating a file, if the folder or the disk causes it.
#[must_use]
pub fn with_creation_hint(error: io::Error) -> io::Error {
    if is_disk_full(&error) {
        return io::Error::new(
            error.kind(),
            format!("{error}; free some space, or name a file on another disk"),
        );
    }
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
