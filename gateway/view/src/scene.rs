//! The scene: the parts of a skin that do not change while it is watched, its robot and the places of its cells.

use std::collections::BTreeMap;

use model::surface::Cylinder;
use nalgebra::Vector3;
use protocol::parameters::RowKind;
use protocol::skin::{Chain, Skin};
use serde::Serialize;

use crate::surface::SceneShell;

/// The pitch is estimated from about this many cells.
const PITCH_SAMPLES: usize = 200;
/// The pitch of a skin whose cells have no neighbours, in m.
const DEFAULT_PITCH: f64 = 0.028;

/// The scene that the page draws; lengths in m, angles in rad.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scene {
    /// The skin's name.
    pub name: String,
    /// The robot's joints.
    pub joints: Vec<SceneJoint>,
    /// Its chains, base to tip.
    pub chains: Vec<SceneChain>,
    /// The buses, and the chain whose skin each carries.
    pub buses: Vec<SceneBus>,
    /// The cells, in the skin's order.
    pub cells: Vec<SceneCell>,
    /// The distance between the centres of neighbouring cells.
    pub pitch: f64,
    /// Links, drawn as tubes below their cells.
    pub tubes: Vec<Tube>,
    /// The robot's surface, if known; [`surface`](crate::surface) has its triangles.
    pub shells: Vec<SceneShell>,
    /// True if the page may press cells, halt and resume.
    pub may_press: bool,
}

/// A joint.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneJoint {
    /// Its name.
    pub name: String,
    /// `rad` or `m`.
    pub unit: &'static str,
    /// `Nm` or `N`.
    pub torque_unit: &'static str,
}

/// A chain of Denavit-Hartenberg rows.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneChain {
    /// Its name.
    pub name: String,
    /// The pose of frame 0 in the robot's base: a 4 by 4 matrix in column order.
    pub base: Vec<f64>,
    /// Its rows, base to tip.
    pub rows: Vec<SceneRow>,
}

/// A Denavit-Hartenberg row.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneRow {
    /// The joint that moves it, as an index into [`Scene::joints`]; absent for a fixed row.
    pub joint: Option<usize>,
    /// True for a prismatic joint: the position is added to `d` instead of `theta`.
    pub slides: bool,
    /// Length.
    pub a: f64,
    /// Twist.
    pub alpha: f64,
    /// Offset.
    pub d: f64,
    /// The angle at position 0.
    pub theta: f64,
}

/// A bus.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneBus {
    /// Its name.
    pub name: String,
    /// The chain, as an index into [`Scene::chains`].
    pub chain: usize,
}

/// A cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneCell {
    /// The cell's bus, as an index into [`Scene::buses`].
    pub bus: usize,
    /// Its node id.
    pub node: u8,
    /// The row in whose frame the cell is given, from 1.
    pub row: u8,
    /// The joint of its chain that moves it, from 1.
    pub joint: u8,
    /// The centre of the cell in that frame.
    pub position: [f64; 3],
    /// The outward normal in that frame.
    pub normal: [f64; 3],
    /// The node id of the neighbour at each port; 0 for a port without a wire.
    pub neighbors: Vec<u8>,
    /// True if the cell is wired to the gateway.
    pub root: bool,
}

/// A cylinder in a row's frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Tube {
    /// The chain.
    pub chain: usize,
    /// The row, from 1.
    pub row: u8,
    /// The centres of its two ends.
    pub ends: [[f64; 3]; 2],
    /// Its radius.
    pub radius: f64,
}

impl Scene {
    /// Returns the scene of a skin.
    #[must_use]
    pub fn from_skin(skin: &Skin, may_press: bool) -> Self {
        let joints = skin.robot.joints.iter().map(|joint| SceneJoint {
            name: joint.name.clone(),
            unit: joint.kind.unit(),
            torque_unit: joint.kind.torque_unit(),
        });
        let cells = skin.cells.iter().map(|cell| SceneCell {
            bus: cell.bus,
            node: cell.node.get(),
            row: cell.row,
            joint: cell.joint,
            position: cell.position,
            normal: cell.normal,
            neighbors: cell.neighbors.iter().map(|node| node.map_or(0, |node| node.get())).collect(),
            root: cell.root,
        });
        let cells: Vec<_> = cells.collect();
        let buses = skin.buses.iter().map(|bus| SceneBus { name: bus.name.clone(), chain: bus.chain });
        let buses: Vec<_> = buses.collect();
        Self {
            name: skin.name.clone(),
            joints: joints.collect(),
            chains: skin.robot.chains.iter().map(chain).collect(),
            pitch: pitch(&cells),
            tubes: tubes(&buses, &cells),
            buses,
            cells,
            shells: Vec::new(),
            may_press,
        }
    }
}

fn chain(chain: &Chain) -> SceneChain {
    let mut joints = chain.joints.iter();
    let rows = chain.rows.iter().map(|row| SceneRow {
        joint: if row.kind == RowKind::Fixed { None } else { joints.next().copied() },
        slides: row.kind == RowKind::Prismatic,
        a: row.table.a,
        alpha: row.table.alpha,
        d: row.table.d,
        theta: row.table.theta_offset,
    });
    SceneChain { name: chain.name.clone(), base: chain.base.matrix().concat(), rows: rows.collect() }
}

/// Returns the median distance from a cell to its nearest neighbour on the same link.
fn pitch(cells: &[SceneCell]) -> f64 {
    let nearest = |cell: &SceneCell| {
        let same = cells.iter().filter(|other| (other.bus, other.row) == (cell.bus, cell.row));
        let distance =
            |other: &SceneCell| (Vector3::from(other.position) - Vector3::from(cell.position)).norm();
        same.map(distance).filter(|distance| *distance > 1e-6).min_by(f64::total_cmp)
    };
    let each = cells.len().div_ceil(PITCH_SAMPLES).max(1);
    let mut all: Vec<_> = cells.iter().step_by(each).filter_map(nearest).collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied().unwrap_or(DEFAULT_PITCH).min(0.1)
}

/// Returns tubes for the links with many cells.
fn tubes(buses: &[SceneBus], cells: &[SceneCell]) -> Vec<Tube> {
    let mut links = BTreeMap::<(usize, u8), Vec<&SceneCell>>::new();
    for cell in cells {
        let chain = buses.get(cell.bus).map_or(0, |bus| bus.chain);
        links.entry((chain, cell.row)).or_default().push(cell);
    }
    links.into_iter().filter_map(|((chain, row), cells)| tube(chain, row, &cells)).collect()
}

/// Fits a cylinder to cells, and makes it a little longer and thinner, so that it lies below them.
fn tube(chain: usize, row: u8, cells: &[&SceneCell]) -> Option<Tube> {
    let placed: Vec<_> = cells.iter().map(|cell| (cell.position, cell.normal)).collect();
    let cylinder = Cylinder::fit(&placed)?;
    let ([from, to], radius) = (cylinder.along, cylinder.radius);
    let ends = [from - radius * 0.2, to + radius * 0.2].map(|along| cylinder.at(along));
    Some(Tube { chain, row, ends, radius: radius * 0.97 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_around_a_link_lie_on_a_tube_and_those_on_a_plate_on_none() {
        let skin = Skin::parse("ur5", include_str!("../../examples/ur5-253.toml")).unwrap();
        let scene = Scene::from_skin(&skin, true);
        assert_eq!((scene.cells.len(), scene.joints.len(), scene.chains[0].rows.len()), (253, 6, 6));
        assert!((0.02..0.035).contains(&scene.pitch), "{}", scene.pitch);
        assert_eq!(scene.tubes.len(), 2, "upper arm and forearm");
        for tube in &scene.tubes {
            let of = |cell: &&SceneCell| cell.row == tube.row;
            let [from, to] = tube.ends.map(Vector3::from);
            let axis = (to - from).normalize();
            for cell in scene.cells.iter().filter(of) {
                let at = Vector3::from(cell.position) - from;
                let off = (at - axis * axis.dot(&at)).norm();
                assert!((off - tube.radius / 0.97).abs() < 0.005, "{off} {}", tube.radius);
            }
        }
        let plate = scene.cells.iter().map(|cell| SceneCell { normal: [0.0, 0.0, 1.0], ..cell.clone() });
        let plate: Vec<_> = plate.collect();
        assert_eq!(tubes(&scene.buses, &plate), []);
    }

    #[test]
    fn each_row_names_the_joint_that_moves_it() {
        let skin = Skin::parse("ur5", include_str!("../../examples/ur5-253.toml")).unwrap();
        let scene = Scene::from_skin(&skin, false);
        let joints: Vec<_> = scene.chains[0].rows.iter().map(|row| row.joint).collect();
        assert_eq!(joints, (0..6).map(Some).collect::<Vec<_>>());
    }
}
