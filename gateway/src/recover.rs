//! Repair of recordings whose writer was killed: `skinbus recover`.

use std::path::PathBuf;

use clap::Args;
use protocol::input;
use protocol::usage::{Failure, printable};
use trace::files::with_creation_hint;
use trace::recording::recover::RecoverError;
use trace::recording::{names, repair};

use super::output::{OverwriteOption, check_distinct_files, print_beside_files};

/// Repair a recording that was cut off
///
/// Copies all intact data into a new file with indexes, and reports the rest. The recording itself is not changed. A
/// run repairs the files that earlier runs left in its recording's directory by itself. Exit code 0: a new file was
/// written, or the recording is intact; 1: failed, recovered no message, or recovered fewer than are known to be lost;
/// 2: wrong use.
#[derive(Args, Debug)]
#[command(after_help = "Example:\n  skinbus recover run.mcap.part -o run.mcap")]
pub(crate) struct RecoverCommand {
    /// MCAP recording to repair; those of other programs are accepted too
    file: PathBuf,
    /// File to write [default: FILE-recovered.mcap]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl RecoverCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let name = self.file.display();
        let file =
            input::open(&self.file).map_err(|error| Failure::usage_error(format!("{name}: {error}")))?;
        if names::is_locked(&file) {
            return Err(Failure::usage_error(format!(
                "{name} is still being recorded: wait until the run ends"
            )));
        }
        if self.output.is_none() && self.file.as_os_str() == "-" {
            return Err(Failure::usage_error(
                "the recording comes from standard input, which has no name: name the new file with -o",
            ));
        }
        let output = self.output.unwrap_or_else(|| names::recovered_name(&names::final_name(&self.file)));
        let out = output.display();
        check_distinct_files([("-o", Some(output.as_path()))], [self.file.as_path()])?;
        self.overwrite.check_writable("-o", &output)?;
        let failure = |error| {
            if let RecoverError::Write(error) = error {
                return Failure::run_error(format!("-o {out}: {}", with_creation_hint(error)));
            }
            Failure::run_error(format!("{name}: {error}"))
        };
        let (recovered, bytes) =
            repair::recover_unless_sound(&file, &output, self.overwrite.overwrite).map_err(failure)?;
        let line = match bytes {
            None if recovered.is_sound() => {
                let rename = if names::final_name(&self.file) == self.file { "" } else { "; rename it" };
                format!(
                    "{name} is intact, there is nothing to recover: {} messages{rename}",
                    recovered.messages
                )
            }
            None => {
                return Err(Failure::run_error(format!(
                    "{name}: no message could be recovered: {recovered}"
                )));
            }
            Some(bytes) => format!("{out}, {bytes} bytes: {recovered}"),
        };
        if recovered.lost_more_than_kept() {
            return Err(Failure::run_error(format!(
                "most of {name} is lost, only a part could be recovered: {line}"
            )));
        }
        print_beside_files([Some(output.as_path())], &format!("{}\n", printable(&line)))
    }
}
