//! Threads that are started with a name, or not at all.

use std::thread::{self, JoinHandle};

use thiserror::Error;

/// The system gives no thread.
#[derive(Debug, Error)]
#[error("cannot start the thread {name}: {source}")]
pub struct ThreadError {
    /// The thread's name.
    pub name: String,
    /// The system's error.
    pub source: std::io::Error,
}

/// Starts a thread of this name.
pub(crate) fn spawn<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, ThreadError> {
    let named = thread::Builder::new().name(name.to_owned());
    named.spawn(work).map_err(|source| ThreadError { name: name.to_owned(), source })
}
