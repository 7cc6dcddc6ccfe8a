//! `skinbus report`.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use analysis::report::run::{self, ReportError};
use analysis::report::{figure::Page, page, svg};
use clap::Args;
use protocol::skin::Skin;
use protocol::usage::{Failure, command_line, ignore_broken_pipe, print_text, printable};
use protocol::wire_time::parse_bit_rate;

use super::input::{first_skin_difference, read_skin};
use super::output::{OverwriteOption, check_distinct_files, is_standard_output, print_note};

/// Write an HTML report on a recorded run, beside figures of docs/explanation/paper.md
///
/// The page is one file that loads nothing, and readable on a phone, on a dark screen and on paper. Pointer, finger or
/// arrow keys show the values of its figures. For a recording that was cut off, the report covers the intact part, and names what is missing on the page
/// and on standard error. A candump log holds only frames and needs its skin; the report names the parts that it lacks.
/// Exit code 0: the report is written; 1: it cannot be written; 2: wrong use, or not a recording of a run.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus report run.mcap -o run.html
  skinbus report run.mcap --svg figures --overwrite
  skinbus report run.mcap run-*.mcap -o all.html
  skinbus report run.log --skin skin.toml -o - > log.html")]
pub(crate) struct ReportCommand {
    /// Recording of a run, from `skinbus run SKIN --record FILE` (all parts of a split one, in any order); or a candump
    /// log or another program's MCAP file, for a shorter report
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Skin file, needed only for a candump log: a recording contains its skin
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// HTML page to write; - for standard output [default: the recording's name with .html]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Also write each figure as an SVG file into this directory, which is created if necessary
    #[arg(long, value_name = "DIR")]
    svg: Option<PathBuf>,
    /// Nominal bit rate for the bus load, such as 500k or 1M [default: the skin's, else 1M]
    #[arg(long, value_name = "RATE", value_parser = parse_bit_rate)]
    nominal: Option<u32>,
    /// Data bit rate of FD frames for the bus load, such as 2M or 5M [default: the skin's, else 5M]
    #[arg(long, value_name = "RATE", value_parser = parse_bit_rate)]
    data: Option<u32>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl ReportCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let first = self.files.iter().min_by_key(|file| (file.as_os_str().len(), file.as_os_str()));
        let page = match first {
            Some(first) if first.as_os_str() != "-" => first.with_extension("html"),
            _ => PathBuf::from("report.html"),
        };
        let output = self.output.clone().unwrap_or(page);
        let read = |file: &Path| Ok::<_, Failure>((file.to_owned(), read_skin(file)?));
        let skin = self.skin.as_deref().map(read).transpose()?;
        let command = command_line().join(" ");
        let options = run::ReportOptions { command, nominal: self.nominal, data: self.data, skin };
        let refused = |error| report_failure(error, options.skin.as_ref());
        if let Err(taken) = self.check_writable(&output, "-o") {
            // Report errors of the input before those of an existing output.
            return Err(run::check_recordings(&self.files, &options).err().map_or(taken, refused));
        }
        let report = run::report(&self.files, &options).map_err(refused)?;
        let mut files = vec![("-o", output.clone(), page::page_html(&report.page))];
        if let Some(folder) = &self.svg {
            for (name, drawing) in svg_drawings(&report.page) {
                let path = folder.join(&name);
                if folder.is_dir() {
                    if path.is_file() && !self.overwrite.overwrite {
                        return Err(Failure::usage_error(format!(
                            "--svg {}: it already contains {name}: name another folder, or overwrite the file with --overwrite",
                            folder.display()
                        )));
                    }
                    self.check_writable(&path, "--svg")?;
                }
                files.push(("--svg", path, drawing));
            }
        }
        let made = self.svg.as_deref().map(create_folder).transpose()?.unwrap_or(false);
        if let Err(failure) = write(&files, self.overwrite) {
            if let Some(folder) = self.svg.filter(|_| made) {
                // This call fails unless the directory is empty, as intended.
                let _ = fs::remove_dir(folder);
            }
            return Err(failure);
        }
        if let Some(missing) = report.missing.as_ref().filter(|_| !report.is_damaged) {
            print_note(format_args!("skinbus: {}: {missing}", report.name));
        }
        for remark in &report.remarks {
            print_note(format_args!("skinbus: {}: {remark}", report.name));
        }
        let figures = svg_drawings(&report.page).count();
        let beside =
            self.svg.map_or_else(String::new, |folder| format!(", also as files in {}", folder.display()));
        let said = format!("{}: {figures} figures{beside}", output.display());
        if !is_standard_output(&output) {
            print_text(&format!("{}\n", printable(&said)))?;
        }
        match report.missing.filter(|_| report.is_damaged) {
            Some(missing) => Err(Failure::run_error(format!("{}: {missing}", report.name))),
            None => Ok(()),
        }
    }

    /// Checks that a file may be written: existing files need `--overwrite`.
    fn check_writable(&self, path: &Path, option: &str) -> Result<(), Failure> {
        check_distinct_files([(option, Some(path))], self.files.iter().map(PathBuf::as_path))?;
        self.overwrite.check_writable(option, path)
    }
}

/// Converts an error of a report into a failure. A file that is not a recording of a run counts as wrong use; an
/// unreadable file does not.
fn report_failure(error: ReportError, skin: Option<&(PathBuf, Skin)>) -> Failure {
    match (error, skin) {
        (error @ (ReportError::Capture(_) | ReportError::Unfinished { .. }), _) => Failure::run_error(error),
        (ReportError::OtherSkin { name, recorded }, Some((file, skin))) => {
            let first = first_skin_difference(skin, &recorded);
            let first =
                first.map_or_else(String::new, |(what, is, was)| format!(" ({what}: {is}, recorded: {was})"));
            Failure::usage_error(format!(
                "{name} was recorded with a skin that differs from {}{first}: leave out --skin, because \
                 the recording contains its skin",
                file.display()
            ))
        }
        (error, _) => Failure::usage_error(error),
    }
}

/// Returns the file names and SVG drawings of all figures.
fn svg_drawings(page: &Page) -> impl Iterator<Item = (String, String)> {
    page.sections.iter().flat_map(|section| {
        let cells = section.drawings.iter().map(|drawing| (drawing.name(), svg::draw_cells(drawing)));
        let figures = section.figures.iter().map(|figure| (figure.name.as_str(), svg::draw_figure(figure)));
        cells.chain(figures).map(|(name, drawing)| (format!("{name}.svg"), drawing))
    })
}

/// Creates a directory. Returns true if it is new.
fn create_folder(folder: &Path) -> Result<bool, Failure> {
    let new = !folder.is_dir();
    let made = fs::create_dir_all(folder).map(|()| new);
    made.map_err(|error| {
        Failure::usage_error(format!(
            "--svg {}: {error}; name a folder that can be written",
            folder.display()
        ))
    })
}

/// Writes all files, or none: each gets its name after all are complete. Each path comes with its option.
fn write(files: &[(&str, PathBuf, String)], overwrite: OverwriteOption) -> Result<(), Failure> {
    let failed = |option: &str, path: &Path, error: io::Error| {
        Failure::run_error(format!("{option} {}: {error}", path.display()))
    };
    let mut whole = Vec::with_capacity(files.len());
    for (option, path, text) in files {
        let (begun, mut file) = overwrite.create(option, path)?;
        let done = file.write_all(text.as_bytes());
        if is_standard_output(path) {
            ignore_broken_pipe(done)?;
        } else {
            done.map_err(|error| failed(option, path, error))?;
            whole.push((option, path, begun));
        }
    }
    whole
        .into_iter()
        .try_for_each(|(option, path, whole)| whole.finish().map_err(|error| failed(option, path, error)))
}
