//! Files of a capture, and the position of its first joints within the run.

use std::path::{Path, PathBuf};

use analysis::compare::{self, JointTrace, PerCapture};
use model::decode::Decoder;
use protocol::input::can_be_read_again;
use protocol::skin::Skin;
use protocol::time::Micros;
use protocol::usage::Failure;
use trace::capture::{CaptureEntry, Reader};

/// Finds the parts of a recording after the first file: `run-1.mcap`, `run-2.mcap` after `run.mcap`.
pub(super) fn recording_parts(first: &Path) -> Result<Vec<PathBuf>, Failure> {
    if first.is_dir() {
        return Err(Failure::usage_error(format!(
            "{} is a directory: name a candump log or an MCAP recording",
            first.display()
        )));
    }
    let mut files = vec![first.to_owned()];
    if !can_be_read_again(first) {
        return Ok(files);
    }
    let Some((began, 0)) = recording_start_and_part(first) else { return Ok(files) };
    let (Some(stem), Some(end)) = (first.file_stem(), first.extension()) else { return Ok(files) };
    for number in 1_u32.. {
        let mut name = stem.to_owned();
        name.push(format!("-{number}."));
        name.push(end);
        let next = first.with_file_name(name);
        if recording_start_and_part(&next).is_none_or(|part| part != (began.clone(), number)) {
            break;
        }
        files.push(next);
    }
    Ok(files)
}

/// Returns the start of a recording, by its metadata, and the number of the part that a file holds.
fn recording_start_and_part(file: &Path) -> Option<(String, u32)> {
    let reader = can_be_read_again(file).then(|| Reader::open(file).ok()).flatten()?;
    let fact = |record, key| reader.extras().metadata_value(record, key).map(str::to_owned);
    Some((fact("program", "began_ns")?, fact("part", "number")?.parse().ok()?))
}

/// Returns for each capture the number of its first joints within the run. Reads a capture that starts in the middle of
/// a run once more for that, if it can be read twice.
pub(super) fn first_joints_numbers(
    files: &PerCapture<Vec<PathBuf>>,
    skin: &Skin,
) -> Result<PerCapture<Option<u64>>, Failure> {
    let unknown = PerCapture { a: None, b: None };
    if ![&files.a, &files.b].iter().all(|files| files.iter().all(|file| can_be_read_again(file))) {
        return Ok(unknown);
    }
    let begins = |files: &[PathBuf]| {
        let is_later = files
            .first()
            .and_then(|first| recording_start_and_part(first))
            .is_some_and(|(_, number)| number > 0);
        !is_later && read_joints(files, skin, true).is_none_or(|trace| trace.first_epoch() == Some(0))
    };
    if begins(&files.a) && begins(&files.b) {
        return Ok(unknown);
    }
    let both = read_joints(&files.a, skin, false).zip(read_joints(&files.b, skin, false));
    Ok(both.map_or(unknown, |(a, b)| compare::first_joints_numbers(&a, &b)))
}

/// Reads the joints of a capture, or only the first. Errors are reported later, when it is compared.
fn read_joints(files: &[PathBuf], skin: &Skin, is_first_enough: bool) -> Option<JointTrace> {
    let mut reader = super::open_capture(files, |file| Box::new(file)).ok()?;
    let mut decoder = Decoder::new(None);
    let mut trace = JointTrace::new(skin);
    while let Ok(Some(entry)) = reader.next() {
        let CaptureEntry::Frame(record) = entry else { continue };
        let nanos = record.time.nanos;
        let decoded = decoder.decode(Micros(nanos / 1_000), record.interface, &record.frame);
        if let Some(message) = decoded.message() {
            trace.record_message(nanos, record.interface, message);
        }
        if is_first_enough && trace.first_epoch().is_some() {
            break;
        }
    }
    Some(trace)
}
