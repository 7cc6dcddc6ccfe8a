//! Files whose writers are gone: found, made whole, said.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Write};
use std::path::Path;

use super::names;
use super::recover::{RecoverError, Recovered, recover};
use crate::run::file::WholeFile;

/// Makes a whole file of one that broke off, and takes the latter away; one of that name is overwritten with `force`.
/// What it came to, and the new one's bytes.
///
/// # Errors
/// When nothing can be recovered or written; the file stays as it is.
pub fn repair(part: &Path, goal: &Path, force: bool) -> Result<(Recovered, u64), RecoverError> {
    let (recovered, bytes) = copy(part, goal, force, |_| true)?;
    fs::remove_file(part).map_err(RecoverError::Write)?;
    Ok((recovered, bytes.unwrap_or(0)))
}

/// Makes a whole file of another one, unless that is whole itself; one that exists is overwritten with `force`. What it came to, and the new one's bytes if
/// there is a new one.
///
/// # Errors
/// When nothing can be recovered or written.
pub fn copy_unless_sound(
    from: &Path,
    to: &Path,
    force: bool,
) -> Result<(Recovered, Option<u64>), RecoverError> {
    copy(from, to, force, |recovered| !recovered.is_sound())
}

fn copy(
    from: &Path,
    to: &Path,
    force: bool,
    wanted: impl FnOnce(&Recovered) -> bool,
) -> Result<(Recovered, Option<u64>), RecoverError> {
    let from = BufReader::with_capacity(1 << 20, File::open(from).map_err(RecoverError::Read)?);
    let (whole, file) = WholeFile::create(to, force).map_err(RecoverError::Write)?;
    let about = file.try_clone().map_err(RecoverError::Write)?;
    let mut out = BufWriter::new(file);
    let recovered = recover(from, &mut out)?;
    let wanted = wanted(&recovered);
    let finish = || -> io::Result<Option<u64>> {
        if !wanted {
            return Ok(None);
        }
        out.flush()?;
        whole.finish()?;
        Ok(Some(about.metadata()?.len()))
    };
    Ok((recovered, finish().map_err(RecoverError::Write)?))
}

/// Repairs what runs that were killed left in a recording's folder, and says each in a line.
pub fn orphans(path: &Path, mut say: impl FnMut(&str)) {
    // A folder that cannot be read says so when the recording itself is begun.
    for (part, _held) in names::orphans(path).unwrap_or_default() {
        let goal = names::recovered(&names::goal_of(&part));
        let name = part.display();
        match repair(&part, &goal, false) {
            Ok((recovered, _)) => {
                say(&format!(
                    "{name} was left by a run that was killed; repaired, it is {}: {recovered}",
                    goal.display()
                ));
            }
            Err(RecoverError::Empty(_)) => match fs::remove_file(&part) {
                Ok(()) => say(&format!(
                    "{name} was left by a run that was killed; there was nothing in it, it is gone"
                )),
                Err(error) => say(&format!("{name} is empty and cannot be removed: {error}")),
            },
            Err(error) => {
                say(&format!("{name} was left by a run that was killed and cannot be repaired: {error}"))
            }
        }
    }
}
