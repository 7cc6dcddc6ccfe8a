//! The scene that a page draws: the parts of a skin that do not change, such as the robot's links and the places of
//! cells.

use std::collections::BTreeMap;

use model::surface::Cylinder;
use nalgebra::Vector3;
use protocol::parameters::RowKind;
use protocol::skin::{Chain, Skin};
use serde::Serialize;

use crate::surface::SceneMeshRange;

/// The number of cells from which the pitch is estimated.
const PITCH_SAMPLE_CELLS: usize = 200;
/// The pitch that is assumed for a skin whose cells have no neighbours, in m.
const DEFAULT_CELL_PITCH_M: f64 = 0.028;

/// The scene that the page draws; lengths in m, angles in rad.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scene {
    /// The name of the skin.
    pub name: String,
    /// The joints of the robot.
    pub joints: Vec<SceneJoint>,
    /// The chains of the robot, from base to tip.
    pub chains: Vec<SceneChain>,
    /// The buses, each with the chain whose cells are on it.
    pub buses: Vec<SceneBus>,
    /// The cells, in the skin's order.
    pub cells: Vec<SceneCell>,
    /// The distance between the centres of neighbouring cells, in m.
    pub pitch: f64,
    /// Cylinders that represent links. They are drawn below the cells.
    pub tubes: Vec<LinkCylinder>,
    /// The surface of the robot's links, if it is known. Its triangles are packed by [`surface`](crate::surface).
    pub shells: Vec<SceneMeshRange>,
    /// True if the page may press cells, and halt and resume the robot.
    pub may_press: bool,
}

/// A joint of the robot, with its units.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneJoint {
    /// The name of the joint.
    pub name: String,
    /// The unit of the position: `rad` or `m`.
    pub unit: &'static str,
    /// The unit of the torque: `Nm`, or `N` for a prismatic joint.
    pub torque_unit: &'static str,
}

/// A chain of Denavit-Hartenberg rows.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneChain {
    /// The name of the chain.
    pub name: String,
    /// The pose of frame 0 in the robot's base: a 4 by 4 matrix in column order.
    pub base: Vec<f64>,
    /// The rows of the chain, from base to tip.
    pub rows: Vec<SceneRow>,
}

/// A row of a chain's Denavit-Hartenberg table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneRow {
    /// The joint that moves the row, as an index into [`Scene::joints`]; absent for a fixed row.
    pub joint: Option<usize>,
    /// True for a prismatic joint, whose position is added to `d` and not to `theta`.
    pub slides: bool,
    /// The link length a, in m.
    pub a: f64,
    /// The link twist α, in rad.
    pub alpha: f64,
    /// The link offset d, in m.
    pub d: f64,
    /// The joint angle θ at position 0, in rad.
    pub theta: f64,
}

/// A bus, and the chain whose cells are on it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneBus {
    /// The name of the bus.
    pub name: String,
    /// The index of the chain in [`Scene::chains`].
    pub chain: usize,
}

/// A cell, with its place on the robot.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneCell {
    /// The index of the cell's bus in [`Scene::buses`].
    pub bus: usize,
    /// The node id of the cell.
    pub node: u8,
    /// The number of the row in whose frame the position is given, from 1.
    pub row: u8,
    /// The number of the joint of the chain that moves the cell, from 1.
    pub joint: u8,
    /// The centre of the cell in the frame of the row, in m.
    pub position: [f64; 3],
    /// The outward normal of the cell in the frame of the row.
    pub normal: [f64; 3],
    /// The node id of the neighbour at each port; 0 for a port without a wire.
    pub neighbors: Vec<u8>,
    /// True if the cell is wired to the gateway.
    pub root: bool,
}

/// A cylinder that represents a link, in the frame of a row.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LinkCylinder {
    /// The index of the chain.
    pub chain: usize,
    /// The number of the row, from 1.
    pub row: u8,
    /// The centres of the cylinder's ends, in m.
    pub ends: [[f64; 3]; 2],
    /// The radius of the cylinder, in m.
    pub radius: f64,
}

impl Scene {
    /// Returns the scene that shows a skin.
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
            chains: skin.robot.chains.iter().map(scene_chain).collect(),
            pitch: median_cell_pitch(&cells),
            tubes: link_cylinders(&buses, &cells),
            buses,
            cells,
            shells: Vec::new(),
            may_press,
        }
    }
}

fn scene_chain(chain: &Chain) -> SceneChain {
    let mut joints = chain.joints.iter();
    let rows = chain.rows.iter().map(|row| SceneRow {
        joint: if row.kind == RowKind::Fixed { None } else { joints.next().copied() },
        slides: row.kind == RowKind::Prismatic,
        a: row.table.a,
        alpha: row.table.alpha,
        d: row.table.d,
        theta: row.table.theta_offset,
    });
    SceneChain {
        name: chain.name.clone(),
        base: chain.base.transform_matrix().concat(),
        rows: rows.collect(),
    }
}

/// Returns the median distance from a cell to the nearest other cell on the same link, in m.
fn median_cell_pitch(cells: &[SceneCell]) -> f64 {
    let nearest = |cell: &SceneCell| {
        let same = cells.iter().filter(|other| (other.bus, other.row) == (cell.bus, cell.row));
        let distance =
            |other: &SceneCell| (Vector3::from(other.position) - Vector3::from(cell.position)).norm();
        same.map(distance).filter(|distance| *distance > 1e-6).min_by(f64::total_cmp)
    };
    let each = cells.len().div_ceil(PITCH_SAMPLE_CELLS).max(1);
    let mut all: Vec<_> = cells.iter().step_by(each).filter_map(nearest).collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied().unwrap_or(DEFAULT_CELL_PITCH_M).min(0.1)
}

/// Returns a cylinder for each link that has enough cells to fit one.
fn link_cylinders(buses: &[SceneBus], cells: &[SceneCell]) -> Vec<LinkCylinder> {
    let mut links = BTreeMap::<(usize, u8), Vec<&SceneCell>>::new();
    for cell in cells {
        let chain = buses.get(cell.bus).map_or(0, |bus| bus.chain);
        links.entry((chain, cell.row)).or_default().push(cell);
    }
    links.into_iter().filter_map(|((chain, row), cells)| fit_link_cylinder(chain, row, &cells)).collect()
}

/// Fits a cylinder to the cells of a link. It is made a little longer and thinner than the fit, so that it lies below
/// the cells.
fn fit_link_cylinder(chain: usize, row: u8, cells: &[&SceneCell]) -> Option<LinkCylinder> {
    let placed: Vec<_> = cells.iter().map(|cell| (cell.position, cell.normal)).collect();
    let cylinder = Cylinder::fit(&placed)?;
    let ([from, to], radius) = (cylinder.along, cylinder.radius);
    let ends = [from - radius * 0.2, to + radius * 0.2].map(|along| cylinder.axis_point(along));
    Some(LinkCylinder { chain, row, ends, radius: radius * 0.97 })
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
        assert_eq!(link_cylinders(&scene.buses, &plate), []);
    }

    #[test]
    fn each_row_names_the_joint_that_moves_it() {
        let skin = Skin::parse("ur5", include_str!("../../examples/ur5-253.toml")).unwrap();
        let scene = Scene::from_skin(&skin, false);
        let joints: Vec<_> = scene.chains[0].rows.iter().map(|row| row.joint).collect();
        assert_eq!(joints, (0..6).map(Some).collect::<Vec<_>>());
    }
}
