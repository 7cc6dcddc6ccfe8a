//! `skinbus skin show`.

use std::path::{Path, PathBuf};

use clap::Args;
use cover::drawing::{Drawing, DrawnCell, page};
use protocol::parameters::RowKind;
use protocol::skin::{Cell, Chain, Skin};
use protocol::usage::{Failure, print};
use robots::{Isometry3, Row, frames, pose_of};
use view::Scene;

use super::super::output::{Overwrite, apart};
use super::super::print::words;
use super::super::robot_file::urdf_of;
use super::super::surface::{Placed, Surface};
use super::super::visuals::Packages;

/// Frames whose origins are nearer have no line between them, in m.
const SHORTEST: f64 = 1e-6;

/// Draw a skin in 3D, as one HTML page that needs nothing else
///
/// Each joint stands as near to 0 as its limits allow. If the skin has robot.urdf, the robot's links are drawn too, as far as
/// their meshes are found; else lines lead from frame to frame. FILE.html#vcan1:72 shows node 72 of vcan1.
#[derive(Args, Debug)]
#[command(after_help = "Example:\n  skinbus skin show skin.toml -o skin.html")]
pub(super) struct Show {
    /// The skin's description
    #[arg(value_name = "SKIN")]
    file: PathBuf,
    #[command(flatten)]
    packages: Packages,
    /// The file to write, whole or not at all; else standard output
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
}

impl Show {
    pub(super) fn run(self) -> Result<(), Failure> {
        let skin = Skin::read(&self.file).map_err(Failure::usage)?;
        let urdf = skin.robot.urdf.as_deref().map(|urdf| urdf_of(&self.file, urdf));
        let read = [Some(self.file.as_path()), urdf.as_deref()].into_iter().flatten();
        apart([("-o", self.output.as_deref())], read)?;
        if let Some(path) = &self.output {
            self.overwrite.check("-o", path)?;
        }
        let page = page(&drawing(&self.file, &skin, &self.packages));
        match &self.output {
            Some(path) => self.overwrite.write("-o", path, &page),
            None => print(&page),
        }
    }
}

/// A skin from a file, as it is drawn.
pub(crate) fn drawing(file: &Path, skin: &Skin, packages: &Packages) -> Drawing {
    let mut robot = Robot::alone(skin);
    if let Some(surface) = Surface::read(file, skin, packages) {
        robot.look(skin, &surface);
    }
    robot.drawing(skin)
}

/// A robot as it stands.
struct Robot {
    /// The joints' positions, by joint.
    positions: Vec<f64>,
    /// Frame 0 of each chain.
    bases: Vec<Isometry3<f64>>,
    /// Its links' surface.
    triangles: Vec<[[f64; 3]; 3]>,
}

impl Robot {
    /// One of which only the skin is known: all chains begin at one place.
    fn alone(skin: &Skin) -> Self {
        let position = |[min, max]: [f64; 2]| 0.0_f64.clamp(min, max);
        Self {
            positions: skin.robot.joints.iter().map(|joint| position(joint.limits)).collect(),
            bases: skin.robot.chains.iter().map(|chain| pose_of(&chain.base)).collect(),
            triangles: Vec::new(),
        }
    }

    /// With what its URDF shows.
    fn look(&mut self, skin: &Skin, surface: &Surface) {
        let Surface { urdf, chains, parts } = surface;
        let named = |name: &str| {
            let known = skin.robot.joints.iter().position(|joint| joint.name == name);
            known.and_then(|index| self.positions.get(index).copied()).unwrap_or_else(|| urdf.rest(name))
        };
        let base = |chain: &robots::Chain| Some(urdf.pose(&chain.root, &named).ok()? * chain.base);
        self.bases = chains.iter().map(|chain| base(chain).unwrap_or_else(Isometry3::identity)).collect();
        let frames: Vec<_> =
            skin.robot.chains.iter().enumerate().map(|(index, chain)| self.frames(index, chain)).collect();
        let drawn = parts
            .iter()
            .filter_map(|Placed { chain, row, part }| Some(part.triangles(frames.get(*chain)?.get(*row)?)));
        self.triangles =
            drawn.flatten().map(|triangle| triangle.map(|corner| corner.coords.into())).collect();
    }

    /// The frames of a chain, 0 to the last row's.
    fn frames(&self, index: usize, chain: &Chain) -> Vec<Isometry3<f64>> {
        let rows: Vec<_> = chain.rows.iter().map(Row::from).collect();
        let position = |joint: &usize| self.positions.get(*joint).copied().unwrap_or_default();
        let positions: Vec<_> = chain.joints.iter().map(position).collect();
        let base = self.bases.get(index).copied().unwrap_or_else(Isometry3::identity);
        frames(&base, &rows, &positions)
    }

    fn drawing(self, skin: &Skin) -> Drawing {
        let chains = skin.robot.chains.iter().enumerate();
        let frames: Vec<_> = chains.map(|(index, chain)| self.frames(index, chain)).collect();
        let cells: Vec<_> = skin.cells.iter().map(|cell| drawn(skin, cell, &frames)).collect();
        let mut segments = Vec::new();
        if self.triangles.is_empty() {
            let origins =
                frames.iter().map(|chain| chain.iter().map(|frame| frame.translation.vector.into()));
            for chain in origins {
                let chain: Vec<[f64; 3]> = chain.collect();
                let lines = chain.iter().zip(chain.iter().skip(1)).map(|(from, to)| [*from, *to]);
                let lines = lines.filter(|[from, to]| distance(from, to) > SHORTEST);
                // Chains that share joints share their lines.
                lines.for_each(|line| {
                    if !segments.contains(&line) {
                        segments.push(line)
                    }
                });
            }
        }
        Drawing {
            name: skin.name.clone(),
            pitch: Scene::of(skin, false).pitch,
            buses: skin.buses.iter().map(|bus| bus.name.clone()).collect(),
            cells,
            segments,
            triangles: self.triangles,
        }
    }
}

fn drawn(skin: &Skin, cell: &Cell, frames: &[Vec<Isometry3<f64>>]) -> DrawnCell {
    let chain = skin.buses.get(cell.bus).map_or(0, |bus| bus.chain);
    let frame = frames.get(chain).and_then(|frames| frames.get(usize::from(cell.row)));
    let frame = frame.copied().unwrap_or_else(Isometry3::identity);
    let mut details = Vec::new();
    let mut detail = |name: &str, value: String| details.push((name.to_owned(), value));
    let joint = skin.joints_of(cell.bus).nth(usize::from(cell.joint).saturating_sub(1));
    if let Some((_, joint)) = joint {
        detail("Joint", format!("{}, {}", cell.joint, joint.name));
    }
    if skin.robot.chains.len() > 1 {
        detail("Chain", skin.chain(cell.bus).name.clone());
    }
    if skin.chain(cell.bus).rows.iter().any(|row| row.kind == RowKind::Fixed) {
        detail("Row", cell.row.to_string());
    }
    detail("In its frame", format!("{} m", words(cell.position.map(|it| (it * 1e5).round() / 1e5 + 0.0))));
    detail("Serial", cell.serial.to_string());
    detail("Hash", format!("{:04X}", skin.parameters(cell).hash()));
    DrawnCell {
        bus: cell.bus,
        node: cell.node.get().into(),
        label: String::new(),
        position: frame.transform_point(&cell.position.into()).coords.into(),
        normal: frame.rotation.transform_vector(&cell.normal.into()).into(),
        neighbors: cell.neighbors.iter().flatten().map(|node| node.get().into()).collect(),
        root: cell.root,
        details,
    }
}

fn distance(one: &[f64; 3], other: &[f64; 3]) -> f64 {
    one.iter().zip(other).map(|(one, other)| (one - other).powi(2)).sum::<f64>().sqrt()
}
