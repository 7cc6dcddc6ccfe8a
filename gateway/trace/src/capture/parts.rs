//! The parts of a split recording, as one.
//!
//! ```text
//!   run-10.mcap run-2.mcap run.mcap ...  ── order ──>  run.mcap run-1.mcap run-2.mcap ...
//! ```
//!
//! Each part says which one it is and of which recording. What a shell makes of `run*.mcap` is put in order by that,
//! whatever the files are called.

use std::path::{Path, PathBuf};

use super::Extras;
use super::reader::{CaptureError, Reader};

/// Which part of which recording a file is.
#[derive(Clone, Debug)]
struct Part {
    path: PathBuf,
    /// When the recording began, in ns since 1970.
    began: String,
    number: u32,
}

impl Part {
    fn of(path: &Path) -> Result<Self, CaptureError> {
        let no_part = || {
            CaptureError::Parts(format!(
                "{} is no part of a recording: several files are read as one only if they are parts of one, as `gateway \
                 run --record` splits it; name this one alone",
                path.display()
            ))
        };
        if path.as_os_str() == "-" {
            return Err(CaptureError::Parts(
                "- is standard input, which cannot be one of several files: name files alone".to_owned(),
            ));
        }
        let reader = Reader::open(path)?;
        let facts = (fact(reader.extras(), "program", "began_ns"), fact(reader.extras(), "part", "number"));
        let (Some(began), Some(number)) = facts else { return Err(no_part()) };
        let number = number.parse().map_err(|_| no_part())?;
        Ok(Self { path: path.to_owned(), began: began.to_owned(), number })
    }
}

fn fact<'a>(extras: &'a Extras, record: &str, key: &str) -> Option<&'a str> {
    let (_, facts) = extras.metadata.iter().find(|(name, _)| name == record)?;
    facts.iter().find(|(name, _)| name == key).map(|(_, value)| value.as_str())
}

/// The parts in their order. One file is taken as it is.
///
/// # Errors
/// When they are not all parts of one recording, one is missing between two others, or is there twice.
pub(super) fn ordered(paths: &[PathBuf]) -> Result<Vec<PathBuf>, CaptureError> {
    if paths.len() < 2 {
        return Ok(paths.to_vec());
    }
    let mut parts = paths.iter().map(|path| Part::of(path)).collect::<Result<Vec<_>, _>>()?;
    parts.sort_by_key(|part| part.number);
    for pair in parts.windows(2) {
        let [one, next] = pair else { continue };
        let (a, b) = (one.path.display(), next.path.display());
        if one.began != next.began {
            return Err(CaptureError::Parts(format!(
                "{a} and {b} are of different recordings, begun at {} and {} ns: name the parts of one",
                one.began, next.began
            )));
        }
        match next.number - one.number {
            0 => {
                return Err(CaptureError::Parts(format!(
                    "{a} and {b} are both part {} of the recording: name one of them",
                    one.number
                )));
            }
            1 => {}
            _ => {
                return Err(CaptureError::Parts(format!(
                    "part {} of the recording is missing between {a} and {b}: name all parts from the first to the \
                     last, or one alone",
                    one.number + 1
                )));
            }
        }
    }
    Ok(parts.into_iter().map(|part| part.path).collect())
}

/// What several files are called together.
pub(super) fn title(paths: &[PathBuf]) -> String {
    match paths {
        [] => String::new(),
        [one] => one.display().to_string(),
        [first, .., last] => {
            format!("{} to {} ({} parts)", first.display(), last.display(), paths.len())
        }
    }
}
