//! Writing to standard output, whose reader may leave.

use std::io::{self, ErrorKind, Write};

use super::Failure;

/// Writes a text; who read the output may have left, as `head` does, and that is fine.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::run(format!("standard output: {error}")))
        }
        Ok(()) | Err(_) => Ok(()),
    }
}
