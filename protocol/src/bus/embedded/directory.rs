//! The directory of embedded buses, which must be private to the user.

use std::fs::DirBuilder;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, Mode, OFlags};
use rustix::io::Errno;
use rustix::net::SocketAddrUnix;
use thiserror::Error;

/// Name of the file that marks a directory as created by a program. Such a directory is removed with its last bus.
pub const MARKER_FILE: &str = ".skinbus";

/// Returns the default directory of embedded buses: `$SKINBUS_DIR`, else `$XDG_RUNTIME_DIR/skinbus`, else
/// `/tmp/skinbus-<user>`.
#[must_use]
pub fn default_directory() -> PathBuf {
    let set = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    set("SKINBUS_DIR")
        .or_else(|| set("XDG_RUNTIME_DIR").map(|path| path.join("skinbus")))
        .unwrap_or_else(|| PathBuf::from(format!("/tmp/skinbus-{}", rustix::process::geteuid().as_raw())))
}

/// Returns the file name of a bus's socket within the directory.
#[must_use]
pub fn socket_name(bus: &str) -> String {
    format!("{bus}.bus")
}

/// Returns the address of a bus's socket.
///
/// # Errors
/// Returns an error if the path is too long for a socket.
pub fn socket_address(directory: &Path, bus: &str) -> Result<SocketAddrUnix, DirectoryError> {
    let path = directory.join(socket_name(bus));
    SocketAddrUnix::new(&path).map_err(|_| DirectoryError::TooLong(path))
}

/// The error for a directory that cannot be used for embedded buses.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DirectoryError {
    /// The directory belongs to another user, who could replace its sockets.
    #[error("the directory {} for embedded buses belongs to user {owner}, but this program runs as user {us}: set SKINBUS_DIR to a directory of your own", path.display())]
    Owner {
        /// The directory.
        path: PathBuf,
        /// User id of the owner.
        owner: u32,
        /// User id of this process.
        us: u32,
    },
    /// Other users have access to the directory.
    #[error("the directory {} for embedded buses has mode {mode:04o}, so other users can open it: run `chmod 700` on it, or set SKINBUS_DIR to another directory", path.display())]
    Mode {
        /// The directory.
        path: PathBuf,
        /// Permission bits of the directory.
        mode: u32,
    },
    /// The path of the bus's socket is longer than a socket address allows.
    #[error(
        "the path {} is too long for a Unix socket, which allows 107 bytes: set SKINBUS_DIR to a shorter \
         path",
        .0.display()
    )]
    TooLong(PathBuf),
    /// The directory cannot be opened or created. Symbolic links are not followed.
    #[error("cannot use the directory {} for embedded buses: {source}; set SKINBUS_DIR to a directory of your own", path.display())]
    Io {
        /// The directory.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

impl DirectoryError {
    /// Returns true if the directory does not exist.
    #[must_use]
    pub fn is_absent(&self) -> bool {
        matches!(self, Self::Io { source, .. } if source.kind() == io::ErrorKind::NotFound)
    }
}

/// Opens the directory and checks that it is private to this user.
///
/// # Errors
/// Returns an error if it does not exist, is not a directory (a symbolic link is not followed), belongs to
/// another user, or is accessible to others.
pub fn open_directory(path: &Path) -> Result<OwnedFd, DirectoryError> {
    let io = |errno: Errno| DirectoryError::Io { path: path.to_owned(), source: errno.into() };
    let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC | OFlags::RDONLY;
    let directory = rustix::fs::open(path, flags, Mode::empty()).map_err(io)?;
    let stat = rustix::fs::fstat(&directory).map_err(io)?;
    let us = rustix::process::geteuid().as_raw();
    if stat.st_uid != us {
        return Err(DirectoryError::Owner { path: path.to_owned(), owner: stat.st_uid, us });
    }
    let mode = stat.st_mode & 0o7777;
    if mode & 0o077 != 0 {
        return Err(DirectoryError::Mode { path: path.to_owned(), mode });
    }
    Ok(directory)
}

/// Creates the directory with mode 0700 and a [`MARKER_FILE`] if it does not exist, then opens it.
///
/// # Errors
/// Returns the errors of [`open_directory`], or an error if the directory cannot be created.
pub fn make_directory(path: &Path) -> Result<OwnedFd, DirectoryError> {
    let io = |source| DirectoryError::Io { path: path.to_owned(), source };
    match DirBuilder::new().mode(0o700).create(path) {
        Ok(()) => {
            let directory = open_directory(path)?;
            write_marker(&directory).map_err(|errno| io(errno.into()))?;
            Ok(directory)
        }
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => open_directory(path),
        Err(source) => Err(io(source)),
    }
}

/// Writes the [`MARKER_FILE`] into a new directory.
///
/// # Errors
/// Returns an error if the file cannot be written.
pub fn write_marker(directory: impl AsFd) -> Result<(), Errno> {
    let flags = OFlags::CREATE | OFlags::EXCL | OFlags::WRONLY | OFlags::CLOEXEC;
    match rustix::fs::openat(directory, MARKER_FILE, flags, Mode::RUSR | Mode::WUSR) {
        Ok(_) | Err(Errno::EXIST) => Ok(()),
        Err(errno) => Err(errno),
    }
}

/// Removes a directory that contains only the [`MARKER_FILE`]. A directory that the user created has no mark and is not
/// removed. The caller holds the lock on the directory.
///
/// # Errors
/// Returns an error if the directory contains other files, has no mark, or cannot be removed.
pub fn remove_directory(directory: impl AsFd, path: &Path) -> Result<(), Errno> {
    for entry in rustix::fs::Dir::read_from(&directory)? {
        if ![".", "..", MARKER_FILE].map(str::as_bytes).contains(&entry?.file_name().to_bytes()) {
            return Err(Errno::NOTEMPTY);
        }
    }
    rustix::fs::unlinkat(&directory, MARKER_FILE, AtFlags::empty())?;
    // Another process may have added a file meanwhile; the directory is still one that was created here.
    rustix::fs::rmdir(path).inspect_err(|_| {
        let _ = write_marker(&directory);
    })
}
