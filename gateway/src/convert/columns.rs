//! Captures as folders of NumPy files.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use analysis::columns::{ColumnError, ColumnOrigin, SourceFile, write_columns};
use analysis::explain::series::EpochSeriesError;
use protocol::input::is_standard_input;
use protocol::stop;
use protocol::usage::Failure;
use trace::columns::ColumnFolder;

use super::torques::buses_with_sums;
use super::{ConvertCommand, WITHOUT_STRICT_HINT};
use crate::input::{LossCounts, named_or_recorded_skin, no_frame_failure};
use crate::output::{check_distinct_files, print_note, write_refused_failure};

/// Returns true for the name of a folder of columns.
pub(super) fn is_columns(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "columns")
}

impl ConvertCommand {
    /// Writes every frame, and the torques of every epoch, as columns.
    pub(super) fn write_columns(self) -> Result<(), Failure> {
        let to = self.to.display();
        self.check_text_options("a folder of columns")?;
        check_distinct_files([("", Some(self.to.as_path()))], self.from.iter().map(PathBuf::as_path))?;
        let refused = |error| write_refused_failure("", &self.to, &error);
        trace::columns::check_columns_writable(&self.to, self.overwrite.overwrite).map_err(refused)?;
        let skin = named_or_recorded_skin(&self.from, self.skin.as_deref())?;
        // Changes of a file while it is read must not go unnoticed.
        let files = self.from.iter().filter(|file| !is_standard_input(file));
        let sources = files.map(source_file).collect::<Result<Vec<_>, _>>()?;
        let skin_file = self.skin.as_deref().map(source_file).transpose()?;
        let (mut reader, bar, live) = self.open()?;
        let stopped = stop::stop_flag();
        let name = reader.name().to_owned();
        let folder = ColumnFolder::create(&self.to, self.overwrite.overwrite).map_err(refused)?;
        let written = write_columns(&mut reader, &skin, folder);
        bar.finish_and_clear();
        let not_written =
            |error: std::io::Error| Failure::run_error(format!("{to}: {error}; no folder was kept"));
        let written = written.map_err(|error| match error {
            ColumnError::Write(error) | ColumnError::Capture(EpochSeriesError::Consumer(error)) => {
                not_written(error)
            }
            error
            @ ColumnError::Capture(EpochSeriesError::Capture(_) | EpochSeriesError::NotFound { .. }) => {
                Failure::run_error(error)
            }
        })?;
        let accounts = written.accounts.clone();
        if stopped.load(Ordering::Relaxed) && !live {
            let frames = accounts.frames;
            return Err(Failure::run_error(format!(
                "interrupted after {frames} frames: {to} is not written"
            )));
        }
        if accounts.frames == 0 {
            return Err(no_frame_failure(&reader));
        }
        if let Some(why) = reader.extras().unfinished.as_ref().filter(|_| self.strict) {
            return Err(Failure::run_error(format!("{name}: {why}; {WITHOUT_STRICT_HINT}")));
        }
        let origin = ColumnOrigin {
            program: env!("CARGO_PKG_VERSION"),
            sources: &sources,
            skin_file: skin_file.as_ref(),
        };
        written.finish(&origin, &skin, &reader).map_err(not_written)?;
        let missing = LossCounts {
            lines: accounts.unreadable_lines,
            messages: accounts.unreadable_messages,
            frames: accounts.lost,
            can_xl: accounts.can_xl,
        };
        missing.print_counts(&reader, "left out");
        if let Some(buses) = buses_with_sums(&skin) {
            print_note(format_args!(
                "{name}: the cells on {buses} answer with sums, so distributed torques and errors are NaN"
            ));
        }
        let (frames, epochs) = (accounts.frames, accounts.epochs);
        print_note(format_args!("{name} -> {to}: {frames} frames, {epochs} epochs"));
        Ok(())
    }
}

fn source_file(path: impl AsRef<Path>) -> Result<SourceFile, Failure> {
    let path = path.as_ref();
    SourceFile::of(path).map_err(|error| Failure::usage_error(format!("{}: {error}", path.display())))
}
