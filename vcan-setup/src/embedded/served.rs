//! Serves a bus in a thread of this process.

use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

use protocol::bus::embedded::default_directory;

use super::{BusTotals, ServeError, Server};

/// A bus that is served by a thread of this process. Dropping it stops the thread.
#[derive(Debug)]
pub struct ServerThread {
    path: PathBuf,
    stop: Option<UnixStream>,
    thread: Option<JoinHandle<Result<BusTotals, ServeError>>>,
}

impl ServerThread {
    /// Serves a bus in the default directory.
    ///
    /// # Errors
    /// Returns [`ServeError`] as [`Server::bind`] does.
    pub fn start(name: &str) -> Result<Self, ServeError> {
        Self::start_in(&default_directory(), name)
    }

    /// Serves a bus in another directory.
    ///
    /// # Errors
    /// Returns [`ServeError`] as [`Server::bind`] does.
    pub fn start_in(directory: &Path, name: &str) -> Result<Self, ServeError> {
        let failed = |doing| move |source| ServeError::Io { name: name.to_owned(), doing, source };
        let server = Server::bind_in(directory, name)?;
        let path = server.path().to_owned();
        let (stop, stopped) = UnixStream::pair().map_err(failed("create the socket pair that stops it"))?;
        let thread = std::thread::Builder::new()
            .name(format!("bus {name}"))
            .spawn(move || server.run(stopped))
            .map_err(failed("start a thread"))?;
        Ok(Self { path, stop: Some(stop), thread: Some(thread) })
    }

    /// Returns the path of the socket.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Stops serving, and returns the counts of the bus.
    ///
    /// # Errors
    /// Returns [`ServeError`] if the server had failed before.
    ///
    /// # Panics
    /// If the thread of the server panicked.
    pub fn stop(mut self) -> Result<BusTotals, ServeError> {
        drop(self.stop.take());
        let thread = self.thread.take().expect("stopped once");
        thread.join().expect("the bus's thread does not panic")
    }
}

impl Drop for ServerThread {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // Only `stop` returns the result of the thread.
            let _ = thread.join();
        }
    }
}
