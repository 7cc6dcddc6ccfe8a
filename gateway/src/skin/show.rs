//! `skinbus skin show`.

use std::path::{Path, PathBuf};

use clap::Args;
use protocol::parameters::RowKind;
use protocol::skin::{Cell, Skin};
use protocol::usage::{Failure, print_text};
use view::{Scene, StaticSkinPage};

use super::super::output::{OverwriteOption, check_distinct_files};
use super::super::print::space_separated;
use super::super::robot_file::urdf_path;
use super::super::surface::robot_meshes;
use super::super::visuals::PackageOptions;

/// Maximum number of triangles of the robot in a page; larger meshes are simplified.
const MAX_TRIANGLES: usize = 12_000;

/// Draw a skin in 3D, as one self-contained HTML page
///
/// Joints are drawn at 0, or as near to 0 as their limits allow. If the skin has robot.urdf, the robot's links are
/// drawn by their meshes, as far as these are found; otherwise as tubes between the frames of the joints.
/// FILE.html#vcan1:72 shows node 72 of vcan1.
#[derive(Args, Debug)]
#[command(after_help = "Example:\n  skinbus skin show skin.toml -o skin.html")]
pub(super) struct ShowCommand {
    /// Skin file (TOML) to draw
    #[arg(value_name = "SKIN")]
    file: PathBuf,
    #[command(flatten)]
    packages: PackageOptions,
    /// Output file; after an error, no incomplete file is left [default: standard output]
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl ShowCommand {
    pub(super) fn run(self) -> Result<(), Failure> {
        let skin = Skin::read(&self.file).map_err(Failure::usage_error)?;
        let urdf = skin.robot.urdf.as_deref().map(|urdf| urdf_path(&self.file, urdf));
        let read = [Some(self.file.as_path()), urdf.as_deref()].into_iter().flatten();
        check_distinct_files([("-o", self.output.as_deref())], read)?;
        if let Some(path) = &self.output {
            self.overwrite.check_writable("-o", path)?;
        }
        let page = still_page(&self.file, &skin, &self.packages).to_html();
        match &self.output {
            Some(path) => self.overwrite.write("-o", path, &page),
            None => print_text(&page),
        }
    }
}

/// Reads the meshes of a skin's robot, and returns the skin as a page shows it.
pub(crate) fn still_page(file: &Path, skin: &Skin, packages: &PackageOptions) -> StaticSkinPage {
    let position = |[min, max]: [f64; 2]| 0.0_f64.clamp(min, max);
    StaticSkinPage {
        scene: Scene::from_skin(skin, false),
        surface: robot_meshes(file, skin, packages, MAX_TRIANGLES),
        positions: skin.robot.joints.iter().map(|joint| position(joint.limits)).collect(),
        details: skin.cells.iter().map(|cell| details(skin, cell)).collect(),
        moved: Vec::new(),
        shades: None,
        findings: Vec::new(),
    }
}

fn details(skin: &Skin, cell: &Cell) -> Vec<(String, String)> {
    let mut details = Vec::new();
    let mut detail = |name: &str, value: String| details.push((name.to_owned(), value));
    let joint = skin.joints_on_bus(cell.bus).nth(usize::from(cell.joint).saturating_sub(1));
    if let Some((_, joint)) = joint {
        detail("Joint", format!("{}, {}", cell.joint, joint.name));
    }
    if skin.robot.chains.len() > 1 {
        detail("Chain", skin.chain(cell.bus).name.clone());
    }
    if skin.chain(cell.bus).rows.iter().any(|row| row.kind == RowKind::Fixed) {
        detail("Row", cell.row.to_string());
    }
    detail(
        "In its frame",
        format!("{} m", space_separated(cell.position.map(|it| (it * 1e5).round() / 1e5 + 0.0))),
    );
    detail("Serial", cell.serial.to_string());
    detail("Hash", format!("{:04X}", skin.parameters(cell).hash()));
    details
}
