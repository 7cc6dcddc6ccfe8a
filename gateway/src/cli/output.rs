//! Where commands write: standard output, whose reader may leave, and files that are whole or not there.

use std::fmt::Display;
use std::io::{self, ErrorKind, Write};
use std::path::Path;

use gateway::run::file::WholeFile;

use super::Failure;

/// The end of writing: who read the output may have left, as `head` does, and that is fine.
pub(crate) fn written(done: io::Result<()>) -> Result<(), Failure> {
    match done {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::run(format!("standard output: {error}")))
        }
        Ok(()) | Err(_) => Ok(()),
    }
}

/// Writes a text to standard output.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    written(out.write_all(text.as_bytes()).and_then(|()| out.flush()))
}

/// Says something on standard error; if that is closed, nobody wants to know.
pub(crate) fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "{text}");
}

/// Writes a whole file, or leaves what was there.
pub(crate) fn write_file(path: &Path, text: &str) -> Result<(), Failure> {
    let write = || {
        let (whole, mut file) = WholeFile::create(path)?;
        file.write_all(text.as_bytes())?;
        whole.finish()
    };
    write().map_err(|error: io::Error| Failure::run(format!("{}: {error}", path.display())))
}
