//! Signals that ask a command to end.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use protocol::stop;

/// The flag that these signals set from now on: [`stop::flag`].
///
/// # Errors
/// Which signal cannot be caught, and why.
pub fn caught(signals: &[i32]) -> Result<Arc<AtomicBool>, String> {
    let flag = stop::flag();
    for signal in signals {
        signal_hook::flag::register(*signal, Arc::clone(flag))
            .map_err(|error| format!("cannot catch signal {signal}: {error}"))?;
    }
    Ok(Arc::clone(flag))
}
