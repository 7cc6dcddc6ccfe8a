//! Joins the parts of a split recording into one capture.
//!
//! ```text
//! run-10.mcap run-2.mcap run.mcap ...  ── order ──>  run.mcap run-1.mcap run-2.mcap ...
//! ```
//!
//! Each part stores its number and the identity of its recording. The order of `run*.mcap`, as a shell expands it, is
//! Each part stores its number and the start of its recording, so the parts are sorted whatever their names are; a
//! shell expands `run*.mcap` in another order. Logs, and recordings that other programs split, are sorted by the times
//! of their first frames.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::{CaptureFormat, RecordingExtras};

/// An error in a list of files that is to be read as one recording or capture.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PartsError {
    /// The list of files is empty.
    #[error("no file is given: name a candump log or an MCAP recording")]
    None,
    /// One file is a part of a recording, and another is not.
    #[error("{} is one part of a split recording, but {} is not a part of it: name only parts of that recording", .part.display(), .other.display())]
    Mixed {
        /// The part.
        part: PathBuf,
        /// The other file.
        other: PathBuf,
    },
    /// The list contains both a log and a recording.
    #[error("{} is a candump log, but {} is an MCAP recording: convert the recording to a log first with `skinbus convert`", .log.display(), .mcap.display())]
    Formats {
        /// The log.
        log: PathBuf,
        /// The recording.
        mcap: PathBuf,
    },
    /// One file is text without frames.
    #[error("{} contains no CAN frames: leave it out, or name a candump log or an MCAP recording instead", .0.display())]
    NoFrame(PathBuf),
    /// One file is listed twice.
    #[error("the file {} is named twice: name it once", .0.display())]
    Same(PathBuf),
    /// Standard input (`-`) is listed together with other files.
    #[error("standard input (-) cannot be combined with other files: name only files")]
    StandardInput,
    /// Two parts belong to different recordings.
    #[error(
        "{} and {} belong to different recordings, which began at {} and {} ns: name only the parts of one \
         recording",
        .one.path.display(), .other.path.display(), .one.began, .other.began
    )]
    Different {
        /// One part.
        one: RecordingPart,
        /// The other part.
        other: RecordingPart,
    },
    /// Two files have the same part number of the same recording.
    #[error(
        "{} and {} are both part {} of the recording: name only one of them",
        .one.path.display(), .other.path.display(), .one.number
    )]
    Twice {
        /// One file.
        one: RecordingPart,
        /// The other file.
        other: RecordingPart,
    },
    /// One part is missing between two others.
    #[error(
        "part {} of the recording is missing between {} and {}: name all parts from the first to the last, or only one part",
        .one.number + 1, .one.path.display(), .next.path.display()
    )]
    Missing {
        /// The part before the gap.
        one: RecordingPart,
        /// The part after the gap.
        next: RecordingPart,
    },
}

/// The identity of a part: its file, its number and its recording.
#[derive(Clone, Debug)]
pub struct RecordingPart {
    path: PathBuf,
    /// The start of the recording, in ns since 1970 as text. All parts of a recording have the same start.
    began: String,
    number: u32,
}

impl RecordingPart {
    /// Reads the identity of a part from the metadata of its file. Returns `None` if the file is not a part.
    fn from_extras(path: &Path, extras: &RecordingExtras) -> Option<Self> {
        let (began, number) =
            extras.metadata_value("program", "began_ns").zip(extras.metadata_value("part", "number"))?;
        Some(Self { path: path.to_owned(), began: began.to_owned(), number: number.parse().ok()? })
    }
}

/// A file of a list, with the information by which the list is sorted.
#[derive(Debug)]
pub(super) struct CaptureFile {
    pub(super) path: PathBuf,
    pub(super) format: CaptureFormat,
    part: Option<RecordingPart>,
    /// The time of the file's first frame, in ns since 1970.
    first: Option<u64>,
    /// True if the file has lines but no frame.
    is_text: bool,
}

impl CaptureFile {
    /// Creates the entry for a file. `lines` is the number of lines up to the first frame; 0 for a recording.
    pub(super) fn new(
        path: &Path,
        extras: &RecordingExtras,
        format: CaptureFormat,
        first: Option<u64>,
        lines: u64,
    ) -> Self {
        let (part, is_text) = (RecordingPart::from_extras(path, extras), first.is_none() && lines > 0);
        Self { path: path.to_owned(), format, part, first, is_text }
    }
}

/// Returns the files in the order in which they are read. Parts of one recording are sorted by part number, other files
/// by the times of their first frames.
///
/// # Errors
/// Returns [`PartsError`] if the files are not one capture.
pub(super) fn in_reading_order(mut files: Vec<CaptureFile>) -> Result<Vec<PathBuf>, PartsError> {
    if let Some(text) = files.iter().find(|file| file.is_text) {
        return Err(PartsError::NoFrame(text.path.clone()));
    }
    let mut places = HashSet::new();
    let mut is_again = |file: &&CaptureFile| {
        !places.insert(fs::canonicalize(&file.path).unwrap_or_else(|_| file.path.clone()))
    };
    if let Some(again) = files.iter().find(|file| is_again(file)) {
        return Err(PartsError::Same(again.path.clone()));
    }
    let (parts, others): (Vec<_>, Vec<_>) = files.iter().partition(|file| file.part.is_some());
    match (parts.first(), others.first()) {
        (Some(part), Some(other)) => {
            return Err(PartsError::Mixed { part: part.path.clone(), other: other.path.clone() });
        }
        (Some(_), None) => return order_parts(files.into_iter().filter_map(|file| file.part).collect()),
        (None, _) => {}
    }
    let of = |format| files.iter().find(|file| file.format == format).map(|file| file.path.clone());
    if let (Some(log), Some(mcap)) = (of(CaptureFormat::Candump), of(CaptureFormat::Mcap)) {
        return Err(PartsError::Formats { log, mcap });
    }
    files.sort_by_key(|file| file.first);
    Ok(files.into_iter().map(|file| file.path).collect())
}

/// Returns the files of the parts, by part number.
///
/// # Errors
/// Returns [`PartsError`] if the parts belong to different recordings, if one is missing between two others, or if one
/// occurs twice.
fn order_parts(mut parts: Vec<RecordingPart>) -> Result<Vec<PathBuf>, PartsError> {
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

/// Returns a title for several files, which names the first and the last.
pub(super) fn title(paths: &[PathBuf]) -> String {
    match paths {
        [] => String::new(),
        [one] => one.display().to_string(),
        [first, .., last] => {
            format!("{} to {} ({} parts)", first.display(), last.display(), paths.len())
        }
    }
}
