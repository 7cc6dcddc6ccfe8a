//! Covers robot links with hexagonal skin cells: places cells on the visual meshes, wires them, and assigns them to
//! buses.
//!
//! Only the outer surface gets cells. A point is on the outer surface if rays that start just above it leave the link.
//! Meshes may therefore have inner parts, double walls and triangles with the wrong winding. Equal input with an equal
//! seed gives an equal result.
//!
//! ```
//! use cover::mesh::Mesh;
//! use cover::{CoverOptions, LinkMesh, RobotLink, cover};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let tube = LinkMesh::new(Mesh::cylinder(0.05, 0.2)?);
//! let forearm = RobotLink { name: "forearm".to_owned(), parts: vec![tube], ..RobotLink::default() };
//! let skin = cover(&[forearm], &[], &CoverOptions { pitch: 0.04, ..CoverOptions::default() })?;
//! let [figures] = skin.links.as_slice() else { return Err("one link".into()) };
//! assert!(figures.covered > 0.95 && skin.buses == 1);
//! # Ok(())
//! # }
//! ```

mod figures;
mod grid;
pub mod mesh;
mod place;
mod relax;
mod surface;
#[cfg(test)]
mod tests;
mod tree;
mod wire;

use nalgebra::{Isometry3, Point3};
use thiserror::Error;

use mesh::{Mesh, Triangle};
use surface::Surface;
pub use wire::{MAX_CELLS_PER_BUS, PORTS_PER_CELL};

/// The smallest distance between neighbouring cells, in m.
pub const MIN_PITCH: f64 = 1e-3;

/// The largest distance between neighbouring cells, in m.
pub const MAX_PITCH: f64 = 1.0;

/// The maximum number of links, covered ones and obstacles together.
pub const MAX_LINKS: usize = 1000;

/// A rigid body of a robot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotLink {
    /// The name of the link, which is used in errors.
    pub name: String,
    /// The meshes of the link. Those inside of others get no cells.
    pub parts: Vec<LinkMesh>,
    /// The pose of the link's frame in a frame that all links share, in m, for the joint configuration in which the
    /// robot is covered. Surfaces that links hide from each other in this configuration get no cells.
    pub pose: Isometry3<f64>,
}

/// A mesh of a link, with its place on the link.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkMesh {
    /// The mesh.
    pub mesh: Mesh,
    /// The pose of the mesh's frame in the link's frame, in m.
    pub pose: Isometry3<f64>,
    /// The factors by which the coordinates of the mesh are multiplied before the pose is applied. Negative factors
    /// mirror the mesh.
    pub scale: [f64; 3],
}

impl LinkMesh {
    /// Creates a part from a mesh that is not scaled and has the link's frame.
    #[must_use]
    pub fn new(mesh: Mesh) -> Self {
        Self { mesh, pose: Isometry3::identity(), scale: [1.0; 3] }
    }

    /// Returns the triangles of the part in a frame in which the link's frame has the pose `frame`.
    #[must_use]
    pub fn triangles(&self, frame: &Isometry3<f64>) -> Vec<Triangle> {
        let (pose, [x, y, z]) = (frame * self.pose, self.scale);
        let corner = |p: Point3<f64>| pose.transform_point(&Point3::new(p.x * x, p.y * y, p.z * z));
        self.mesh.triangles().iter().map(|triangle| triangle.map(corner)).collect()
    }
}

/// A box on a link in which no cells are placed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeepOut {
    /// The index of the covered link in whose frame the box is given.
    pub link: usize,
    /// The corner of the box with the smallest coordinates, in m.
    pub min: [f64; 3],
    /// The corner of the box with the largest coordinates, in m.
    pub max: [f64; 3],
}

/// Options for covering links with cells.
#[derive(Clone, Debug, PartialEq)]
pub struct CoverOptions {
    /// The distance between the centers of neighbouring cells, in m.
    pub pitch: f64,
    /// The seed of the random numbers that place the cells.
    pub seed: u64,
    /// Boxes in which no cells are placed.
    pub keep_out: Vec<KeepOut>,
    /// The maximum number of cells per bus, 1 to [`MAX_CELLS_PER_BUS`].
    pub nodes_per_bus: usize,
    /// The minimum distance from the center of a cell to other links, in m.
    pub clearance: f64,
}

impl Default for CoverOptions {
    fn default() -> Self {
        Self {
            pitch: 0.028,
            seed: 1,
            keep_out: Vec::new(),
            nodes_per_bus: MAX_CELLS_PER_BUS,
            clearance: 0.005,
        }
    }
}

/// A cell of the skin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CoverCell {
    /// The index of the covered link.
    pub link: usize,
    /// The center of the cell on the mesh, in the link's frame, in m.
    pub position: [f64; 3],
    /// The outward unit normal of the cell in the link's frame. It is the mean normal of the mesh below the cell,
    /// limited to 9 degrees from the mesh's normal at `position`.
    pub normal: [f64; 3],
    /// The index of the cell's bus.
    pub bus: usize,
    /// The node id of the cell on its bus, from 1.
    pub node: u8,
    /// For each port, the node id of the cell that the port is wired to, on the same bus and link. The ports are a
    /// quarter turn apart, counterclockwise as seen from outside. Each wire is at the port nearest to its direction.
    pub neighbors: [Option<u8>; PORTS_PER_CELL],
    /// True if the cell is wired to the gateway. This holds for one cell of each group of wired cells.
    pub root: bool,
}

/// Measures of how well the cells cover a link.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkFigures {
    /// The name of the link.
    pub name: String,
    /// The number of cells.
    pub cells: usize,
    /// The area of the outer surface that other links do not hide, in m².
    pub outer_area: f64,
    /// The share of the outer surface that is in keep-out boxes, 0 to 1; 0 for a link without an outer surface.
    pub kept_out: f64,
    /// The share of the outer surface, including that in keep-out boxes, that is within one pitch of a cell on the same
    /// side, 0 to 1; 0 for a link without an outer surface.
    pub covered: f64,
    /// The median distance from a cell to the nearest other cell on the same side, in m; `None` for fewer than two
    /// cells.
    pub spacing: Option<f64>,
    /// The largest angle between a cell's normal and the mesh's normal at its center, in rad.
    pub tilt: f64,
}

/// The cells that cover the links of a robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Cover {
    /// The cells, ordered by bus and node id, and therefore by link.
    pub cells: Vec<CoverCell>,
    /// The number of buses.
    pub buses: usize,
    /// Measures of how well each link is covered.
    pub links: Vec<LinkFigures>,
}

/// The reason why links cannot be covered.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum CoverError {
    /// The pitch is out of range.
    #[error("pitch {0} m: it must be {MIN_PITCH} to {MAX_PITCH} m")]
    Pitch(f64),
    /// The clearance is out of range.
    #[error("clearance {0} m: it must be 0 to {MAX_PITCH} m")]
    Clearance(f64),
    /// The number of nodes per bus is out of range.
    #[error("{0} nodes per bus: the number must be 1 to {MAX_CELLS_PER_BUS}")]
    Nodes(usize),
    /// There are more links than [`MAX_LINKS`].
    #[error("{0} links are too many (at most {MAX_LINKS}): use --leave-out for links far from the skin")]
    Links(usize),
    /// A keep-out box has no link or invalid sides.
    #[error("keep-out box {index}: {reason}; correct it")]
    KeepOut {
        /// The index of the box in the options.
        index: usize,
        /// A description of what is wrong with the box.
        reason: String,
    },
    /// A coordinate is infinite or NaN after the scale and the pose are applied.
    #[error(
        "link {link}, part {part}: scale {scale:?} and the pose give coordinates that are not finite; correct them"
    )]
    NotFinite {
        /// The name of the link.
        link: String,
        /// The index of the part in the link.
        part: usize,
        /// The scale of the part.
        scale: [f64; 3],
    },
    /// The parts of a link have more triangles in total than a single mesh may have.
    #[error(
        "link {link}: its meshes have {count} triangles, and the maximum is {}; decimate the meshes",
        mesh::MAX_TRIANGLES
    )]
    Triangles {
        /// The name of the link.
        link: String,
        /// The number of triangles.
        count: usize,
    },
    /// The surface of a link is too large for the pitch.
    #[error(
        "link {link}: {area:.3e} m² of triangles need {cells:.0} cells at a pitch of {pitch} m, and the maximum is \
         {most}; correct the mesh's scale{}",
        raised(*.pitch, *.cells, *.most)
    )]
    TooLarge {
        /// The name of the link.
        link: String,
        /// The area of all triangles, including inner ones, in m².
        area: f64,
        /// The number of cells that this area would take.
        cells: f64,
        /// The pitch, in m.
        pitch: f64,
        /// The maximum number of cells.
        most: usize,
    },
}

/// Covers `links` with cells. Surfaces that `links` or `others` hide get no cells.
///
/// # Errors
/// Returns [`CoverError`] if an option is out of range, or if a link is too large for the pitch or not finite.
pub fn cover(links: &[RobotLink], others: &[RobotLink], options: &CoverOptions) -> Result<Cover, CoverError> {
    check(links, others, options)?;
    let mut placed = Vec::with_capacity(links.len());
    let mut figures = Vec::with_capacity(links.len());
    for (index, link) in links.iter().enumerate() {
        let surface = Surface::new(index, links, others, options)?;
        let spots = place::place_cells(&surface, options, index);
        figures.push(figures::coverage_figures(link, &surface, &spots, options.pitch));
        placed.push(spots);
    }
    let (cells, buses) = wire::wire_cells(&placed, options);
    Ok(Cover { cells, buses, links: figures })
}

/// Returns a text with the smallest pitch that is large enough, in m. The text is empty if that exceeds [`MAX_PITCH`].
fn raised(pitch: f64, cells: f64, most: usize) -> String {
    let most = u32::try_from(most).map_or(f64::INFINITY, f64::from);
    // The pitch is rounded up to whole mm.
    let needed = (pitch * (cells / most).sqrt() * 1e3).ceil() / 1e3;
    if needed <= MAX_PITCH { format!(", or raise the pitch to {needed} m") } else { String::new() }
}

fn check(links: &[RobotLink], others: &[RobotLink], options: &CoverOptions) -> Result<(), CoverError> {
    if !(MIN_PITCH..=MAX_PITCH).contains(&options.pitch) {
        return Err(CoverError::Pitch(options.pitch));
    }
    if !(0.0..=MAX_PITCH).contains(&options.clearance) {
        return Err(CoverError::Clearance(options.clearance));
    }
    if !(1..=MAX_CELLS_PER_BUS).contains(&options.nodes_per_bus) {
        return Err(CoverError::Nodes(options.nodes_per_bus));
    }
    if links.len() + others.len() > MAX_LINKS {
        return Err(CoverError::Links(links.len() + others.len()));
    }
    for (index, keep_out) in options.keep_out.iter().enumerate() {
        let wrong = |reason| Err(CoverError::KeepOut { index, reason });
        if keep_out.link >= links.len() {
            return wrong(format!("link {} is not one of the {} covered links", keep_out.link, links.len()));
        }
        for (min, max) in keep_out.min.iter().zip(&keep_out.max) {
            if !min.is_finite() || !max.is_finite() || min > max {
                let (min, max) = (keep_out.min, keep_out.max);
                return wrong(format!(
                    "the minimum {min:?} m must be finite and at most the maximum {max:?} m"
                ));
            }
        }
    }
    Ok(())
}
