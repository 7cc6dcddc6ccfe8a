//! Outputs of commands besides standard output: standard error, and files that exist only if they are complete.

use std::fmt::Display;
use std::fs::{self, File};
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};

use clap::Args;
use protocol::usage::{Failure, eprint_line, eprint_lines, ignore_broken_pipe, print_raw, print_text};
use trace::files::{
    AtomicFile, STANDARD_OUTPUT, check_writable, is_disk_full, parent_folder, with_creation_hint,
};

/// The option that allows existing files to be overwritten.
#[derive(Args, Clone, Copy, Debug)]
pub(crate) struct OverwriteOption {
    /// Overwrite existing files
    #[arg(long)]
    pub(crate) overwrite: bool,
}

impl OverwriteOption {
    /// Creates the file that an option names, so that errors show up before there is anything to write.
    pub(crate) fn create(self, option: &str, path: &Path) -> Result<(AtomicFile, File), Failure> {
        AtomicFile::create(path, self.overwrite).map_err(|error| write_refused_failure(option, path, &error))
    }

    /// Checks that the file which an option names can be written, before its content is computed.
    pub(crate) fn check_writable(self, option: &str, path: &Path) -> Result<(), Failure> {
        check_writable(path, self.overwrite).map_err(|error| write_refused_failure(option, path, &error))
    }

    /// Writes the file that an option names. On an error, a former file stays unchanged.
    pub(crate) fn write(self, option: &str, path: &Path, text: &str) -> Result<(), Failure> {
        let (whole, file) = self.create(option, path)?;
        write_and_finish(option, whole, file, text)
    }
}

/// Returns true for the name of standard output, `-`.
pub(crate) fn is_standard_output(path: &Path) -> bool {
    path == Path::new(STANDARD_OUTPUT)
}

/// Prints a table. Prints it on standard error if one of these files is standard output, which then carries only that
/// file.
pub(crate) fn print_beside_files<'a>(
    files: impl IntoIterator<Item = Option<&'a Path>>,
    text: &str,
) -> Result<(), Failure> {
    if files.into_iter().flatten().any(is_standard_output) {
        eprint_lines(text);
        return Ok(());
    }
    print_text(text)
}

/// Prints a table like [`print_beside_files`], in colours if standard output supports them.
pub(crate) fn print_table<'a>(
    files: impl IntoIterator<Item = Option<&'a Path>>,
    text: impl FnOnce(bool) -> String,
) -> Result<(), Failure> {
    let mut files = files.into_iter();
    if let Some(file) = files.find(|file| file.is_some_and(is_standard_output)) {
        return print_beside_files([file], &text(false));
    }
    if !is_coloured(&io::stdout()) {
        return print_text(&text(false));
    }
    // A terminal in place of a file may show colours too. Names in the text are already escaped.
    print_raw(&text(true))
}

/// Writes the whole content of a created file.
pub(crate) fn write_and_finish(
    option: &str,
    whole: AtomicFile,
    mut file: File,
    text: &str,
) -> Result<(), Failure> {
    if is_standard_output(whole.path()) {
        return ignore_broken_pipe(file.write_all(text.as_bytes()));
    }
    let name = option_and_path(option, whole.path());
    let written = file.write_all(text.as_bytes()).and_then(|()| whole.finish());
    written.map_err(|error: io::Error| Failure::run_error(format!("{name}: {}", with_creation_hint(error))))
}

/// Returns the error for a file that cannot be written, which counts as wrong use unless the disk is full.
pub(crate) fn write_refused_failure(option: &str, path: &Path, error: &io::Error) -> Failure {
    let text = format!("{}: {error}", option_and_path(option, path));
    if is_disk_full(error) { Failure::run_error(text) } else { Failure::usage_error(text) }
}

fn option_and_path(option: &str, path: &Path) -> String {
    format!("{option} {}", path.display()).trim_start().to_owned()
}

/// Checks that the files to be written differ from each other and from all files that the command reads, because
/// `--overwrite` must not replace those.
pub(crate) fn check_distinct_files<'a>(
    written: impl IntoIterator<Item = (&'a str, Option<&'a Path>)>,
    read: impl IntoIterator<Item = &'a Path>,
) -> Result<(), Failure> {
    // Two of the names may be the same terminal.
    let is_stream = |path: &Path| fs::metadata(path).is_ok_and(|about| !about.is_file() && !about.is_dir());
    let read: Vec<_> = read.into_iter().filter(|path| !is_standard_output(path)).map(absolute_path).collect();
    let mut before = Vec::new();
    for (option, path) in written {
        let Some(path) = path.filter(|path| !is_stream(path)) else { continue };
        let there = absolute_path(path);
        if read.contains(&there) {
            let name = option_and_path(option, path);
            return Err(Failure::usage_error(format!(
                "{name} is also an input of this command: name another file for the output"
            )));
        }
        if let Some((other, _)) = before.iter().find(|(_, place)| *place == there) {
            return Err(Failure::usage_error(format!(
                "{option} and {other} name the same file: name two different files"
            )));
        }
        before.push((option, there));
    }
    Ok(())
}

/// Returns the absolute path of a file, which need not exist. Two names of the same file give the same path.
fn absolute_path(path: &Path) -> PathBuf {
    let inside = || Some(fs::canonicalize(parent_folder(path)).ok()?.join(path.file_name()?));
    fs::canonicalize(path).ok().or_else(inside).unwrap_or_else(|| path.to_owned())
}

/// Returns true if output there may be coloured: on a terminal, unless NO_COLOR is set.
pub(crate) fn is_coloured(out: &impl IsTerminal) -> bool {
    out.is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

/// Prints a line on standard error, or drops it if that is closed.
pub(crate) fn print_note(text: impl Display) {
    eprint_line(&text.to_string());
}
