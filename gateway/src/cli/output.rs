//! Where commands write beside standard output: standard error, and files that are whole or not there.

use std::fmt::Display;
use std::io::{self, Write};
use std::path::Path;

use gateway::run::file::WholeFile;
use protocol::usage::Failure;

/// Says something on standard error; if that is closed, nobody wants to know.
pub(crate) fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "{text}");
}

/// Writes a whole file that an option names, or leaves what was there.
pub(crate) fn write_file(option: &str, path: &Path, text: &str) -> Result<(), Failure> {
    let write = || {
        let (whole, mut file) = WholeFile::create(path)?;
        file.write_all(text.as_bytes())?;
        whole.finish()
    };
    write().map_err(|error: io::Error| Failure::run(format!("{option} {}: {error}", path.display())))
}
