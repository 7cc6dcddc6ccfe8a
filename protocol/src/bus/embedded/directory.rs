//! Where embedded buses live, and that the place is private.

use std::fs::DirBuilder;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, Mode, OFlags};
use rustix::io::Errno;
use rustix::net::SocketAddrUnix;
use thiserror::Error;

/// The file in a directory that a program made for its buses, and so may remove with the last of them.
pub const MARK: &str = ".skinbus";

/// Where embedded buses live unless told otherwise: `$SKINBUS_DIR`, else `$XDG_RUNTIME_DIR/skinbus`, else
/// `/tmp/skinbus-<user>`.
#[must_use]
pub fn usual_directory() -> PathBuf {
    let set = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    set("SKINBUS_DIR")
        .or_else(|| set("XDG_RUNTIME_DIR").map(|path| path.join("skinbus")))
        .unwrap_or_else(|| PathBuf::from(format!("/tmp/skinbus-{}", rustix::process::geteuid().as_raw())))
}

/// The file name of a bus's socket within its directory.
#[must_use]
pub fn socket_name(bus: &str) -> String {
    format!("{bus}.bus")
}

/// The socket's address.
///
/// # Errors
/// When the path is longer than a socket's can be.
pub fn address(directory: &Path, bus: &str) -> Result<SocketAddrUnix, DirectoryError> {
    let path = directory.join(socket_name(bus));
    SocketAddrUnix::new(&path).map_err(|_| DirectoryError::TooLong(path))
}

/// Why a directory is not used for embedded buses.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DirectoryError {
    /// Somebody else's.
    #[error("{} belongs to user {owner}, and this is user {us}: set SKINBUS_DIR to a directory of your own", path.display())]
    Owner {
        /// The directory.
        path: PathBuf,
        /// Whose it is.
        owner: u32,
        /// Who asks.
        us: u32,
    },
    /// Open to others.
    #[error("{} has mode {mode:04o}, and the bus is private: `chmod 700` it, or set SKINBUS_DIR to another directory", path.display())]
    Mode {
        /// The directory.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// No socket can have this path.
    #[error("{} is too long for a socket, whose path has at most 107 bytes: set SKINBUS_DIR to a shorter one", .0.display())]
    TooLong(PathBuf),
    /// It cannot be opened or made; a link is not followed.
    #[error("cannot use {} as the directory of embedded buses: {source}; set SKINBUS_DIR to a directory of your own", path.display())]
    Io {
        /// The directory.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

impl DirectoryError {
    /// Whether it is not there at all.
    #[must_use]
    pub fn is_absent(&self) -> bool {
        matches!(self, Self::Io { source, .. } if source.kind() == io::ErrorKind::NotFound)
    }
}

/// Opens the directory and sees that it is ours alone.
///
/// # Errors
/// When it is not there, not a directory (a link is none), somebody else's, or open to others.
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

/// Makes the directory (mode 0700) unless it is there, then opens it. One that was made here has a [`MARK`].
///
/// # Errors
/// As [`open_directory`], or when it cannot be made.
pub fn make_directory(path: &Path) -> Result<OwnedFd, DirectoryError> {
    let io = |source| DirectoryError::Io { path: path.to_owned(), source };
    match DirBuilder::new().mode(0o700).create(path) {
        Ok(()) => {
            let directory = open_directory(path)?;
            mark(&directory).map_err(|errno| io(errno.into()))?;
            Ok(directory)
        }
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => open_directory(path),
        Err(source) => Err(io(source)),
    }
}

/// Leaves the [`MARK`] in a directory that was made here.
///
/// # Errors
/// When it cannot be written.
pub fn mark(directory: impl AsFd) -> Result<(), Errno> {
    let flags = OFlags::CREATE | OFlags::EXCL | OFlags::WRONLY | OFlags::CLOEXEC;
    match rustix::fs::openat(directory, MARK, flags, Mode::RUSR | Mode::WUSR) {
        Ok(_) | Err(Errno::EXIST) => Ok(()),
        Err(errno) => Err(errno),
    }
}

/// Removes a directory in which there is nothing but the [`MARK`]: the user's own directory has none and stays.
/// Whoever calls this holds the lock on it.
///
/// # Errors
/// When there is something else in it, no mark, or it cannot be removed.
pub fn remove_directory(directory: impl AsFd, path: &Path) -> Result<(), Errno> {
    for entry in rustix::fs::Dir::read_from(&directory)? {
        if ![".", "..", MARK].map(str::as_bytes).contains(&entry?.file_name().to_bytes()) {
            return Err(Errno::NOTEMPTY);
        }
    }
    rustix::fs::unlinkat(&directory, MARK, AtFlags::empty())?;
    // Somebody may have put a file in it meanwhile; it is still one that was made here.
    rustix::fs::rmdir(path).inspect_err(|_| {
        let _ = mark(&directory);
    })
}
