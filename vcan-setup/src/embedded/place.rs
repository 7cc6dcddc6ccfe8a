//! Creates and removes the socket of a bus in its directory.
//!
//! A process locks the directory while it creates or removes a socket or the directory itself. Under the lock, a socket
//! that a killed server left behind can be distinguished from one that is served, and only one server can replace it.

use std::io;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

use protocol::bus::BusError;
use protocol::bus::embedded::{
    DirectoryError, make_directory, open_directory, remove_directory, seqpacket_socket, socket_address,
    socket_name,
};
use rustix::fs::{AtFlags, FileType, FlockOperation};
use rustix::io::Errno;
use rustix::net::SocketFlags;
use thiserror::Error;

/// The reason why a bus cannot be served under a name.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BusSocketError {
    /// The name is not allowed for a bus.
    #[error(transparent)]
    Name(BusError),
    /// The directory cannot be used.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// Another server serves the bus.
    #[error("the embedded bus {name} is already served at {}: use it, or stop its server first", path.display())]
    Served {
        /// The name of the bus.
        name: String,
        /// The path of its socket.
        path: PathBuf,
    },
    /// A file that is not a socket exists at the path.
    #[error("{} exists and is not a socket: move it away", .0.display())]
    InTheWay(PathBuf),
    /// Another system error.
    #[error("cannot {doing} {}: {source}", path.display())]
    Io {
        /// The path of the socket or the directory.
        path: PathBuf,
        /// A description of the failed operation.
        doing: &'static str,
        /// The system error.
        source: io::Error,
    },
}

/// A listening socket in the directory of embedded buses. Dropping it removes the socket. The directory is removed too
/// if it is empty and was created by a server.
#[derive(Debug)]
pub(super) struct BusSocket {
    pub(super) listener: OwnedFd,
    pub(super) path: PathBuf,
    directory: PathBuf,
    file: String,
    /// The device and inode of the socket file, by which the server recognises its own file before it removes it.
    inode: (u64, u64),
}

/// The maximum number of clients that wait to be accepted. The kernel's own limit is often lower.
const LISTEN_BACKLOG: i32 = 4096;

impl BusSocket {
    pub(super) fn bind(directory: &Path, name: &str) -> Result<Self, BusSocketError> {
        protocol::bus::check_name(name).map_err(BusSocketError::Name)?;
        let file = socket_name(name);
        let path = directory.join(&file);
        let address = socket_address(directory, name)?;
        let failed = |doing| {
            let path = path.clone();
            move |errno: Errno| BusSocketError::Io { path, doing, source: errno.into() }
        };
        let lock = lock_directory(directory)?;
        match rustix::fs::statat(&lock, &file, AtFlags::SYMLINK_NOFOLLOW) {
            Ok(stat) if FileType::from_raw_mode(stat.st_mode) != FileType::Socket => {
                return Err(BusSocketError::InTheWay(path));
            }
            Ok(_) => {
                let probe =
                    seqpacket_socket(SocketFlags::NONBLOCK).map_err(failed("create a socket to probe"))?;
                // Connecting is refused only if the socket has no listener. A full backlog causes another error.
                if rustix::net::connect(&probe, &address) != Err(Errno::CONNREFUSED) {
                    return Err(BusSocketError::Served { name: name.to_owned(), path });
                }
                rustix::fs::unlinkat(&lock, &file, AtFlags::empty()).map_err(failed("remove"))?;
            }
            Err(Errno::NOENT) => {}
            Err(errno) => return Err(failed("query")(errno)),
        }
        let listener = seqpacket_socket(SocketFlags::NONBLOCK).map_err(failed("create"))?;
        rustix::net::bind(&listener, &address).map_err(failed("create"))?;
        rustix::net::listen(&listener, LISTEN_BACKLOG).map_err(failed("listen on"))?;
        let stat = rustix::fs::statat(&lock, &file, AtFlags::SYMLINK_NOFOLLOW).map_err(failed("query"))?;
        let inode = (stat.st_dev, stat.st_ino);
        Ok(Self { listener, path, directory: directory.to_owned(), file, inode })
    }

    fn remove(&self) -> Result<(), Errno> {
        let Ok(directory) = open_directory(&self.directory) else { return Ok(()) };
        rustix::fs::flock(&directory, FlockOperation::LockExclusive)?;
        let stat = rustix::fs::statat(&directory, &self.file, AtFlags::SYMLINK_NOFOLLOW)?;
        if (stat.st_dev, stat.st_ino) == self.inode {
            rustix::fs::unlinkat(&directory, &self.file, AtFlags::empty())?;
            remove_directory(&directory, &self.directory)?;
        }
        Ok(())
    }
}

impl Drop for BusSocket {
    fn drop(&mut self) {
        // An error is ignored: another program may have removed the socket, and the directory stays if it holds other
        // buses or was created by the user.
        let _ = self.remove();
    }
}

/// The maximum number of attempts to lock the directory while other processes remove it.
const MAX_LOCK_ATTEMPTS: u32 = 1_000;

/// Creates the directory if it does not exist, and locks it.
fn lock_directory(path: &Path) -> Result<OwnedFd, BusSocketError> {
    let failed =
        |errno: Errno| BusSocketError::Io { path: path.to_owned(), doing: "lock", source: errno.into() };
    let mut absent = 0;
    loop {
        let directory = match make_directory(path) {
            Ok(directory) => directory,
            // A server that ended may have removed the directory after it was created here, so this is repeated. The
            // limit is needed for a missing parent folder, and for file systems in which no directory can be created,
            // such as /proc.
            Err(error)
                if error.is_absent()
                    && absent < MAX_LOCK_ATTEMPTS
                    && path.parent().is_some_and(Path::exists) =>
            {
                absent += 1;
                continue;
            }
            Err(error) => return Err(error.into()),
        };
        rustix::io::retry_on_intr(|| rustix::fs::flock(&directory, FlockOperation::LockExclusive))
            .map_err(failed)?;
        let locked = rustix::fs::fstat(&directory).map_err(failed)?;
        // The previous holder of the lock may have removed the directory. A lock on the removed directory has no
        // effect.
        if let Ok(present) = rustix::fs::lstat(path)
            && (present.st_dev, present.st_ino) == (locked.st_dev, locked.st_ino)
        {
            return Ok(directory);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_that_cannot_be_made_is_refused_and_not_tried_forever() {
        let error = BusSocket::bind(Path::new("/proc/skinbus"), "vcan0").unwrap_err().to_string();
        assert!(error.ends_with("; set SKINBUS_DIR to a directory of your own"), "{error}");
    }
}
