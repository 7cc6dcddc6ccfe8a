//! A directory of embedded buses that nobody else's bench meets.

use std::fs;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::PathBuf;

use protocol::usage::Failure;

/// A directory of its own; gone with what is in it when this is dropped.
#[derive(Debug)]
pub(super) struct Buses(pub(super) PathBuf);

impl Buses {
    /// Makes one in the folder for temporary files, `skinbus-WHAT-PID`.
    pub(super) fn create(what: &str) -> Result<Self, Failure> {
        let pid = std::process::id();
        // A socket's path has at most 107 bytes; a folder for temporary files may have more.
        let fits = |folder: &PathBuf| folder.as_os_str().len() <= 50;
        let folder = Some(std::env::temp_dir()).filter(fits).unwrap_or_else(|| PathBuf::from("/tmp"));
        for number in 0.. {
            let end = if number == 0 { String::new() } else { format!("-{number}") };
            let path = folder.join(format!("skinbus-{what}-{pid}{end}"));
            match fs::DirBuilder::new().mode(0o700).create(&path) {
                // Of a program of this number that was killed, or of somebody else.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => {
                    let (path, why) = (path.display(), "set SKINBUS_DIR to a directory of your own");
                    return Err(Failure::run(format!("{path}: {error}; {why}")));
                }
                Ok(()) => return Ok(Self(path)),
            }
        }
        Err(Failure::run(
            "no name for a directory of embedded buses is free; set SKINBUS_DIR to one of your own",
        ))
    }
}

impl Drop for Buses {
    fn drop(&mut self) {
        // Nothing more can be done.
        let _ = fs::remove_dir_all(&self.0);
    }
}
