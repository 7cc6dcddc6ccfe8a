//! `skinbus skin urdf`.

use std::path::PathBuf;

use clap::Args;
use protocol::skin::Skin;
use protocol::usage::{Failure, print_text};
use robots::write_urdf;

use super::super::output::{OverwriteOption, check_distinct_files};

/// Write a skin's robot as a URDF: a joint for each row of its chains
///
/// Recordings carry this URDF on /robot_description for a skin without robot.urdf. Each row becomes a joint with its
/// origin, its axis and the limits of the skin; fixed rows become fixed joints, and a link `tip` follows the last row.
/// A link is drawn as a cylinder. Two chains that begin with the same rows share links; the controller's max_speed is
/// the joints' velocity.
#[derive(Args, Debug)]
#[command(after_help = "Example:\n  skinbus skin urdf skin.toml -o robot.urdf")]
pub(super) struct UrdfCommand {
    /// Skin file (TOML) whose robot is written
    #[arg(value_name = "SKIN")]
    file: PathBuf,
    /// Output file; after an error, no incomplete file is left [default: standard output]
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl UrdfCommand {
    pub(super) fn run(self) -> Result<(), Failure> {
        let skin = Skin::read(&self.file).map_err(Failure::usage_error)?;
        check_distinct_files([("-o", self.output.as_deref())], [self.file.as_path()])?;
        let text = write_urdf(&skin).xml;
        match &self.output {
            Some(path) => self.overwrite.write("-o", path, &text),
            None => print_text(&text),
        }
    }
}
