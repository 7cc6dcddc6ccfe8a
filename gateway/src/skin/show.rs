//! `gateway skin show`.

use std::path::{Path, PathBuf};

use clap::Args;
use cover::Part;
use cover::drawing::{Drawing, DrawnCell, page};
use protocol::document;
use protocol::parameters::RowKind;
use protocol::skin::{Cell, Chain, ChainRow, Skin};
use protocol::usage::{Failure, print};
use robots::{Isometry3, Row, Urdf, frames, pose_of};

use super::super::output::{Force, apart, note};
use super::super::print::{count, words};
use super::super::robot_file::urdf_of;
use super::visuals::{Packages, Visuals};

/// How large cells are drawn that have no neighbour, in m.
const PITCH: f64 = 0.028;

/// How many cells are asked for their nearest neighbour.
const ASKED: usize = 500;

/// Frames whose origins are nearer have no line between them, in m.
const SHORTEST: f64 = 1e-6;

/// Draw a skin in 3D, as one HTML page that needs nothing else
///
/// Each joint stands as near to 0 as its limits allow. If the skin has robot.urdf, the robot's links are drawn too, as far as
/// their meshes are found; else lines lead from frame to frame. FILE.html#vcan1:72 shows node 72 of vcan1.
#[derive(Args, Debug)]
#[command(after_help = "Example:\n  gateway skin show skin.toml -o skin.html")]
pub(super) struct Show {
    /// The skin's description
    #[arg(value_name = "SKIN")]
    file: PathBuf,
    #[command(flatten)]
    packages: Packages,
    /// The file to write, whole or not at all; else standard output
    #[arg(long, short, value_name = "FILE.html")]
    output: Option<PathBuf>,
    #[command(flatten)]
    force: Force,
}

impl Show {
    pub(super) fn run(self) -> Result<(), Failure> {
        let skin = Skin::read(&self.file).map_err(Failure::usage)?;
        let urdf = skin.robot.urdf.as_deref().map(|urdf| urdf_of(&self.file, urdf));
        let read = [Some(self.file.as_path()), urdf.as_deref()].into_iter().flatten();
        apart([("-o", self.output.as_deref())], read)?;
        if let Some(path) = &self.output {
            self.force.check("-o", path)?;
        }
        let mut robot = Robot::alone(&skin);
        if let Some(path) = &urdf {
            match text(path) {
                Ok(urdf) => robot.look(&skin, &urdf, path, &self.packages),
                Err(error) => note(format_args!("the robot is not drawn: {error}")),
            }
        }
        let page = page(&robot.drawing(&skin));
        match &self.output {
            Some(path) => self.force.write("-o", path, &page),
            None => print(&page),
        }
    }
}

fn text(path: &Path) -> Result<Urdf, String> {
    let file = path.display().to_string();
    let text = document::text(path).map_err(|error| error.to_string())?;
    Urdf::parse(&file, &text).map_err(|error| error.to_string())
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
    fn look(&mut self, skin: &Skin, urdf: &Urdf, file: &Path, packages: &Packages) {
        let named = |name: &str| {
            let known = skin.robot.joints.iter().position(|joint| joint.name == name);
            known.and_then(|index| self.positions.get(index).copied()).unwrap_or_else(|| urdf.rest(name))
        };
        let mut bases = Vec::with_capacity(self.bases.len());
        for chain in &skin.robot.chains {
            let Some(base) = base(urdf, chain, &named) else {
                let (file, name) = (&urdf.file, &chain.name);
                note(format_args!("the robot is not drawn: the rows of chain {name} are none of {file}"));
                return;
            };
            bases.push(base);
        }
        let visuals = Visuals::new(urdf, file, packages);
        let mut missing = Vec::new();
        let mut triangles = Vec::new();
        for link in urdf.links() {
            match visuals.parts(link) {
                Err(error) => missing.push(error),
                Ok(parts) => {
                    let Ok(pose) = urdf.pose(link, &named) else { continue };
                    triangles.extend(parts.iter().flat_map(|part| corners(part, &(pose * part.pose))));
                }
            }
        }
        if let Some(first) = missing.first() {
            note(format_args!("{} not drawn: {first}", count(missing.len(), "link")));
        }
        (self.bases, self.triangles) = (bases, triangles);
    }

    /// The frames of a chain, 0 to the last row's.
    fn frames(&self, index: usize, chain: &Chain) -> Vec<Isometry3<f64>> {
        let rows: Vec<_> = chain.rows.iter().map(row).collect();
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
            pitch: pitch(&cells),
            buses: skin.buses.iter().map(|bus| bus.name.clone()).collect(),
            cells,
            segments,
            triangles: self.triangles,
        }
    }
}

/// Frame 0 of a skin's chain in the root's coordinates: that of the URDF's chain with the same rows.
fn base(urdf: &Urdf, chain: &Chain, position: &dyn Fn(&str) -> f64) -> Option<Isometry3<f64>> {
    // Which link the chain begins at is not in the skin.
    let roots = urdf.links().filter_map(|root| urdf.chain(Some(root), &chain.name).ok());
    let found = roots.into_iter().find(|found| {
        let same = |(one, other): (&ChainRow, &Row)| {
            let other = other.with_limits(one.limits);
            let [one, other] = [one, &other].map(|it| (it.kind, it.table));
            let near = |one: f64, other: f64| (one - other).abs() < 1e-9;
            let (a, b) = (one.1, other.1);
            one.0 == other.0
                && near(a.a, b.a)
                && near(a.d, b.d)
                && near(a.alpha, b.alpha)
                && near(a.theta_offset, b.theta_offset)
        };
        found.rows.len() == chain.rows.len() && chain.rows.iter().zip(&found.rows).all(same)
    })?;
    Some(urdf.pose(&found.root, position).ok()? * found.base)
}

fn row(row: &ChainRow) -> Row {
    let ChainRow { kind, table, .. } = *row;
    Row { kind, a: table.a, alpha: table.alpha, d: table.d, theta_offset: table.theta_offset }
}

/// A part's triangles at a pose.
fn corners<'a>(part: &'a Part, pose: &Isometry3<f64>) -> impl Iterator<Item = [[f64; 3]; 3]> + use<'a> {
    let ([x, y, z], pose) = (part.scale, *pose);
    let corner = move |[i, j, k]: [f64; 3]| pose.transform_point(&[i * x, j * y, k * z].into()).coords.into();
    part.mesh.triangles().iter().map(move |triangle| triangle.map(|point| corner(point.coords.into())))
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

/// The median distance from a cell to the nearest one.
fn pitch(cells: &[DrawnCell]) -> f64 {
    let nearest = |cell: &DrawnCell| {
        let distances = cells.iter().map(|other| distance(&cell.position, &other.position));
        distances.filter(|distance| *distance > SHORTEST).min_by(f64::total_cmp)
    };
    let each = cells.len().div_ceil(ASKED).max(1);
    let mut nearest: Vec<_> = cells.iter().step_by(each).filter_map(nearest).collect();
    nearest.sort_by(f64::total_cmp);
    nearest.get(nearest.len() / 2).copied().unwrap_or(PITCH).min(0.1)
}

fn distance(one: &[f64; 3], other: &[f64; 3]) -> f64 {
    one.iter().zip(other).map(|(one, other)| (one - other).powi(2)).sum::<f64>().sqrt()
}
