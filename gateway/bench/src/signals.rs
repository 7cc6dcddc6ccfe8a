//! Signals that ask a command to end.

use std::io;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use protocol::stop;
use thiserror::Error;

/// A signal that cannot be caught.
#[derive(Debug, Error)]
#[error("cannot catch signal {signal}: {source}")]
pub struct SignalError {
    /// Which.
    pub signal: i32,
    /// Why.
    pub source: io::Error,
}

/// The flag that these signals set from now on: [`stop::flag`].
///
/// # Errors
/// Which signal cannot be caught, and why.
pub fn caught(signals: &[i32]) -> Result<Arc<AtomicBool>, SignalError> {
    let flag = stop::flag();
    for &signal in signals {
        signal_hook::flag::register(signal, Arc::clone(flag))
            .map_err(|source| SignalError { signal, source })?;
    }
    Ok(Arc::clone(flag))
}
