//! Finds and repairs the files of runs that were killed.

use std::fs::{File, Permissions};
use std::io::{self, BufReader, BufWriter, Seek};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{Gid, fchown};

use super::names::{self, PartFile};
use super::recover::{RecoverError, RecoveryResult, recover};
use crate::files::is_disk_full;
use crate::files::{AtomicFile, create_unnamed_file, parent_folder};

/// The maximum number of names to try for a new file if other programs create files of the same names.
const MAX_ATTEMPTS: u32 = 100;

/// The result of repairing a recording.
#[derive(Clone, Debug)]
pub struct RepairResult {
    /// The result of the recovery.
    pub recovered: RecoveryResult,
    /// The new file and its length in bytes; `None` if the old one held no messages.
    pub new: Option<(PathBuf, u64)>,
    /// The name under which the original is kept, if it is damaged before its end; `None` if it was removed.
    pub original: Option<PathBuf>,
}

/// Makes a complete file from one that was not finished. The original is removed, or kept under another name if it is
/// damaged before its end. `goal` returns a name for the new file at each attempt. An existing file is replaced only if
/// `force` is true.
///
/// # Errors
/// Returns [`RecoverError`] if nothing can be recovered or written. The original then stays as it is.
pub fn repair(
    part: &Path,
    from: &File,
    mut goal: impl FnMut() -> PathBuf,
    force: bool,
) -> Result<RepairResult, RecoverError> {
    let something = |recovered: &RecoveryResult| {
        let RecoveryResult {
            messages,
            unfinished_bytes: unfinished,
            damaged,
            orphaned_messages: homeless,
            ..
        } = *recovered;
        messages + unfinished + damaged.0 + homeless > 0
    };
    let mut attempts = 0;
    let repaired = loop {
        attempts += 1;
        let path = goal();
        match recover_into_file(from, &path, force, something) {
            Err(RecoverError::Write(error))
                if error.kind() == io::ErrorKind::AlreadyExists && attempts < MAX_ATTEMPTS => {}
            copied => {
                let (recovered, bytes) = copied?;
                break RepairResult { recovered, new: bytes.map(|bytes| (path, bytes)), original: None };
            }
        }
    };
    if repaired.recovered.is_undamaged() {
        names::remove(part, from).map_err(RecoverError::Write)?;
        return Ok(repaired);
    }
    let original = Some(names::keep_damaged(part, from).map_err(RecoverError::Write)?);
    Ok(RepairResult { original, ..repaired })
}

/// Returns the error message for a file that was not finished and cannot be repaired.
pub(super) fn unrepaired_message(PartFile { path, goal, .. }: &PartFile, error: &RecoverError) -> String {
    let path = path.display();
    let is = |kind: fn(&io::Error) -> bool| matches!(error, RecoverError::Write(error) if kind(error));
    let why = if is(|error| error.kind() == io::ErrorKind::AlreadyExists) {
        names::name_conflict_message(goal)
    } else {
        format!("{path}: {error}")
    };
    let more = if is(is_disk_full) { " -o FILE`, a file on another disk" } else { "`" };
    format!("{why}; the recorded data is in {path}: repair it with `skinbus recover {path}{more}")
}

/// Recovers a file into a new one, unless the file is sound or holds no messages. Returns the result, and the length of
/// the new file in bytes if one was made. Replaces an existing file only if `force` is true.
///
/// # Errors
/// Returns [`RecoverError`] if nothing can be recovered or written.
pub fn recover_unless_sound(
    from: &File,
    to: &Path,
    force: bool,
) -> Result<(RecoveryResult, Option<u64>), RecoverError> {
    recover_into_file(from, to, force, |recovered| !recovered.is_sound() && recovered.messages > 0)
}

fn recover_into_file(
    from: &File,
    to: &Path,
    force: bool,
    is_worth_it: impl FnOnce(&RecoveryResult) -> bool,
) -> Result<(RecoveryResult, Option<u64>), RecoverError> {
    let (whole, file) = AtomicFile::create(to, force).map_err(RecoverError::Write)?;
    restrict_permissions(from, &file).map_err(RecoverError::Write)?;
    let mut out = BufWriter::new(file);
    let mut from = from;
    // The file is read twice. A pipe can be read only once, so it is copied first.
    let kept = if from.rewind().is_err() {
        Some(pipe_to_unnamed_file(from, parent_folder(to)).map_err(RecoverError::Read)?)
    } else {
        None
    };
    let recovered = recover(BufReader::with_capacity(1 << 20, kept.as_ref().unwrap_or(from)), &mut out)?;
    if !is_worth_it(&recovered) {
        return Ok((recovered, None));
    }
    let finish = || -> io::Result<u64> {
        let file = out.into_inner()?;
        whole.finish()?;
        Ok(file.metadata()?.len())
    };
    Ok((recovered, Some(finish().map_err(RecoverError::Write)?)))
}

/// Copies the rest of a pipe into an unnamed file.
fn pipe_to_unnamed_file(mut from: &File, folder: &Path) -> io::Result<File> {
    let mut file = create_unnamed_file(folder, 0o600)?;
    io::copy(&mut from, &mut file)?;
    file.rewind()?;
    Ok(file)
}

/// Gives a copy no more permissions than the original has.
fn restrict_permissions(from: &File, copy: &File) -> io::Result<()> {
    let (original, about) = (from.metadata()?, copy.metadata()?);
    if !original.is_file() || !about.is_file() {
        return Ok(());
    }
    let mut mode = original.mode() & about.mode() & 0o777;
    if original.gid() != about.gid() && fchown(copy, None, Some(Gid::from_raw(original.gid()))).is_err() {
        // The group of the copy is another one, so it gets no permissions.
        mode &= 0o707;
    }
    copy.set_permissions(Permissions::from_mode(mode))
}

/// Repairs the files of killed runs in the folder of a recording. Reports each of them to `say` in a line, and also
/// `.part` files of other programs.
pub fn repair_orphans(path: &Path, mut say: impl FnMut(&str)) {
    // An unreadable folder is reported when the recording begins.
    for (part, found) in names::find_part_files(path).unwrap_or_default() {
        let name = part.display();
        let held = match found {
            Ok(held) => held,
            Err(why) => {
                let hint = why.may_be_recording().then(|| {
                    format!("; if it is an unfinished recording, `skinbus recover {name} -o NAME` copies it")
                });
                say(&format!("{name} was neither repaired nor removed: {why}{}", hint.unwrap_or_default()));
                continue;
            }
        };
        let leftover = "was left by a run that was killed";
        match repair(&part, &held, || names::recovered_name(&names::final_name(&part)), false) {
            Ok(RepairResult { recovered, new: Some((path, _)), original }) => {
                let kept = original.map(|path| format!("; the damaged original is {}", path.display()));
                let kept = kept.unwrap_or_default();
                say(&format!("{name} {leftover}; it was repaired as {}: {recovered}{kept}", path.display()));
            }
            Ok(RepairResult { new: None, .. }) => {
                say(&format!("{name} {leftover}; it held no messages and was removed"));
            }
            Err(error) => say(&format!("{name} {leftover} and cannot be repaired: {error}")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_repaired_where_it_is_is_repaired_elsewhere() {
        let folder = tempfile::tempdir().unwrap();
        let (part, _file) = PartFile::create(folder.path().join("run.mcap")).unwrap();
        let line = |kind: io::ErrorKind| unrepaired_message(&part, &RecoverError::Write(kind.into()));
        let full = line(io::ErrorKind::StorageFull);
        assert!(full.ends_with("run.mcap.part -o FILE`, a file on another disk"), "{full}");
        let taken = line(io::ErrorKind::AlreadyExists);
        assert!(
            taken.contains("run.mcap: another program has meanwhile created a file with this name; "),
            "{taken}"
        );
        assert!(taken.ends_with("run.mcap.part`") && !taken.contains("--overwrite"), "{taken}");
    }
}
