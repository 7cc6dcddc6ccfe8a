//! Signals that ask a command to end.

use std::io;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use protocol::stop;
use thiserror::Error;

/// The error of a signal that cannot be caught.
#[derive(Debug, Error)]
#[error("cannot catch signal {signal}: {source}")]
pub struct SignalError {
    /// Number of the signal.
    pub signal: i32,
    /// Cause.
    pub source: io::Error,
}

/// Catches signals and returns the flag that they set: [`stop::stop_flag`].
///
/// # Errors
/// Returns [`SignalError`] with the signal that cannot be caught.
pub fn catch_signals(signals: &[i32]) -> Result<Arc<AtomicBool>, SignalError> {
    let flag = stop::stop_flag();
    for &signal in signals {
        signal_hook::flag::register(signal, Arc::clone(flag))
            .map_err(|source| SignalError { signal, source })?;
    }
    Ok(Arc::clone(flag))
}
