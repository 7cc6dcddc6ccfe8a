//! Threads that are started by name.

use std::thread::{self, JoinHandle};

use thiserror::Error;

/// The error of a thread that the system does not grant.
#[derive(Debug, Error)]
#[error("cannot start the thread {name}: {source}")]
pub struct ThreadError {
    /// Name of the thread.
    pub name: String,
    /// Error of the system.
    pub source: std::io::Error,
}

/// Starts a thread with this name.
pub(crate) fn spawn<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, ThreadError> {
    let named = thread::Builder::new().name(name.to_owned());
    named.spawn(work).map_err(|source| ThreadError { name: name.to_owned(), source })
}
