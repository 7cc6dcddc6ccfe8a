//! The parts of a split recording, as one.
//!
//! ```text
//!   run-10.mcap run-2.mcap run.mcap ...  ── order ──>  run.mcap run-1.mcap run-2.mcap ...
//! ```
//!
//! Each part says which one it is and of which recording. What a shell makes of `run*.mcap` is put in order by that,
//! whatever the files are called.

use std::path::{Path, PathBuf};

use thiserror::Error;

use super::Extras;

/// Why several files are not the parts of one recording.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PartsError {
    /// Not even one.
    #[error("no file is named: name a capture")]
    None,
    /// One is no part of anything.
    #[error(
        "{} is no part of a recording: several files are read as one only if they are parts of one, as `gateway run \
         --record` splits it; name this one alone",
        .0.display()
    )]
    NoPart(PathBuf),
    /// One has no name.
    #[error("- is standard input, which cannot be one of several files: name files alone")]
    StandardInput,
    /// Two belong to different recordings.
    #[error(
        "{} and {} are of different recordings, begun at {} and {} ns: name the parts of one",
        .one.path.display(), .other.path.display(), .one.began, .other.began
    )]
    Different {
        /// One of them.
        one: Part,
        /// The other one.
        other: Part,
    },
    /// Two are the same part.
    #[error(
        "{} and {} are both part {} of the recording: name one of them",
        .one.path.display(), .other.path.display(), .one.number
    )]
    Twice {
        /// One of them.
        one: Part,
        /// The other one.
        other: Part,
    },
    /// One is missing between two others.
    #[error(
        "part {} of the recording is missing between {} and {}: name all parts from the first to the last, or one alone",
        .one.number + 1, .one.path.display(), .next.path.display()
    )]
    Missing {
        /// The one before.
        one: Part,
        /// The next one that is there.
        next: Part,
    },
}

/// Which part of which recording a file is.
#[derive(Clone, Debug)]
pub struct Part {
    path: PathBuf,
    /// When the recording began, in ns since 1970.
    began: String,
    number: u32,
}

impl Part {
    /// By what the file has beside its frames.
    pub(super) fn of(path: &Path, extras: &Extras) -> Result<Self, PartsError> {
        let facts = extras.fact("program", "began_ns").zip(extras.fact("part", "number"));
        let part = facts.and_then(|(began, number)| {
            Some(Self { path: path.to_owned(), began: began.to_owned(), number: number.parse().ok()? })
        });
        part.ok_or_else(|| PartsError::NoPart(path.to_owned()))
    }
}

/// The files of parts, in their order.
///
/// # Errors
/// When they are not all parts of one recording, one is missing between two others, or is there twice.
pub(super) fn ordered(mut parts: Vec<Part>) -> Result<Vec<PathBuf>, PartsError> {
    parts.sort_by_key(|part| part.number);
    for pair in parts.windows(2) {
        let [one, next] = pair else { continue };
        let (one, next) = (one.clone(), next.clone());
        if one.began != next.began {
            return Err(PartsError::Different { one, other: next });
        }
        match next.number - one.number {
            0 => return Err(PartsError::Twice { one, other: next }),
            1 => {}
            _ => return Err(PartsError::Missing { one, next }),
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
