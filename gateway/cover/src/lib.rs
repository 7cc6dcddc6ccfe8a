//! Covers robot links with hexagonal skin cells: where they lie on the visual meshes, how they are wired, and on
//! which bus each is.
//!
//! Only the outer surface wears cells: a point belongs to it when rays from just above it escape. Meshes may have
//! inner parts, double walls and triangles that are wound the wrong way. The same input and seed give the same
//! cells.
//!
//! ```
//! use cover::mesh::Mesh;
//! use cover::{Link, Options, Part, cover};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let tube = Part::new(Mesh::cylinder(0.05, 0.2)?);
//! let forearm = Link { name: "forearm".to_owned(), parts: vec![tube], ..Link::default() };
//! let skin = cover(&[forearm], &[], &Options { pitch: 0.04, ..Options::default() })?;
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
pub use wire::{MAX_NODES, PORTS};

/// The smallest pitch, in m.
pub const MIN_PITCH: f64 = 1e-3;

/// The largest pitch, in m.
pub const MAX_PITCH: f64 = 1.0;

/// The most links, covered ones and obstacles together.
pub const MAX_LINKS: usize = 1000;

/// A rigid body of a robot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Link {
    /// What errors call it.
    pub name: String,
    /// What it is made of; inner parts wear no cells.
    pub parts: Vec<Part>,
    /// Where its frame is at the joint configuration at which it is covered, in a frame that all links share, in m.
    /// Where links hide each other then, they wear no cells.
    pub pose: Isometry3<f64>,
}

/// A mesh of a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// The mesh.
    pub mesh: Mesh,
    /// Where the mesh's frame is in the link's frame, in m.
    pub pose: Isometry3<f64>,
    /// By which factors its coordinates are multiplied first; negative ones mirror it.
    pub scale: [f64; 3],
}

impl Part {
    /// A mesh at the origin of the link's frame, as large as it is.
    #[must_use]
    pub fn new(mesh: Mesh) -> Self {
        Self { mesh, pose: Isometry3::identity(), scale: [1.0; 3] }
    }

    /// Its triangles where `frame` is the link's frame.
    #[must_use]
    pub fn triangles(&self, frame: &Isometry3<f64>) -> Vec<Triangle> {
        let (pose, [x, y, z]) = (frame * self.pose, self.scale);
        let corner = |p: Point3<f64>| pose.transform_point(&Point3::new(p.x * x, p.y * y, p.z * z));
        self.mesh.triangles().iter().map(|triangle| triangle.map(corner)).collect()
    }
}

/// A box that holds no cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeepOut {
    /// In which of the covered links' frames, from 0.
    pub link: usize,
    /// Its smallest coordinates, in m.
    pub min: [f64; 3],
    /// Its largest coordinates, in m.
    pub max: [f64; 3],
}

/// How to cover.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// From one cell's middle to the next one's, in m.
    pub pitch: f64,
    /// Where chance begins.
    pub seed: u64,
    /// Boxes that hold no cell.
    pub keep_out: Vec<KeepOut>,
    /// The most cells of one bus, 1 to [`MAX_NODES`].
    pub nodes_per_bus: usize,
    /// How far each cell's middle is at least from other links, in m.
    pub clearance: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self { pitch: 0.028, seed: 1, keep_out: Vec::new(), nodes_per_bus: MAX_NODES, clearance: 0.005 }
    }
}

/// A cell of the skin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// On which of the covered links it is, from 0.
    pub link: usize,
    /// Its middle, on the mesh, in the link's frame, in m.
    pub position: [f64; 3],
    /// Which way it faces, away from the link: a unit vector in the link's frame. It is the mean of the mesh's
    /// normals below the cell, and at most 9 degrees off the mesh's normal at `position`.
    pub normal: [f64; 3],
    /// On which bus it is, from 0.
    pub bus: usize,
    /// Its number on the bus, from 1.
    pub node: u8,
    /// By port, the node that it is wired to, on the same bus and link. Ports are a quarter of a turn from each
    /// other, counterclockwise when seen from outside; each wire has the port nearest to its direction.
    pub neighbors: [Option<u8>; PORTS],
    /// Whether it is wired to the gateway: one cell of all that wires join.
    pub root: bool,
}

/// How well a link is covered.
#[derive(Clone, Debug, PartialEq)]
pub struct Figures {
    /// The link's name.
    pub name: String,
    /// How many cells it wears.
    pub cells: usize,
    /// Its outer surface, without what other links hide, in m².
    pub outer_area: f64,
    /// How much of the outer surface is in keep-out boxes, 0 to 1; 0 when there is no outer surface.
    pub kept_out: f64,
    /// How much of the outer surface, keep-out boxes included, is within one pitch of a cell on the same side, 0 to
    /// 1; 0 when there is no outer surface.
    pub covered: f64,
    /// The median, over its cells, of the distance to the nearest cell on the same side, in m; `None` with fewer
    /// than two cells.
    pub spacing: Option<f64>,
    /// The largest angle between a cell's normal and the mesh's normal there, in rad.
    pub tilt: f64,
}

/// A skin.
#[derive(Clone, Debug, PartialEq)]
pub struct Skin {
    /// Sorted by bus and node, which is also by link.
    pub cells: Vec<Cell>,
    /// How many buses there are.
    pub buses: usize,
    /// By covered link.
    pub links: Vec<Figures>,
}

/// Why links cannot be covered.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum CoverError {
    /// The pitch cannot be that of cells.
    #[error("pitch {0} m: it is {MIN_PITCH} to {MAX_PITCH} m; correct it")]
    Pitch(f64),
    /// The clearance is no distance.
    #[error("clearance {0} m: it is 0 to {MAX_PITCH} m; correct it")]
    Clearance(f64),
    /// A bus cannot have so many nodes.
    #[error("{0} nodes per bus: it is 1 to {MAX_NODES}; correct it")]
    Nodes(usize),
    /// There are too many links.
    #[error("{0} links, at most {MAX_LINKS}: add those far from the skin to --leave-out")]
    Links(usize),
    /// A box is of no link, or inside out.
    #[error("keep-out box {index}: {reason}; correct it")]
    KeepOut {
        /// Its place in the options, from 0.
        index: usize,
        /// What is wrong.
        reason: String,
    },
    /// A scale or a pose is not a number, or so large that a coordinate becomes infinite.
    #[error(
        "link {link}, part {part}: coordinates are not finite after scale {scale:?} and its pose; correct them"
    )]
    NotFinite {
        /// The link's name.
        link: String,
        /// The part's place in the link, from 0.
        part: usize,
        /// Its scale.
        scale: [f64; 3],
    },
    /// The parts of a link together have more triangles than a mesh may have.
    #[error("link {link}: its parts have {count} triangles, at most {}; decimate them", mesh::MAX_TRIANGLES)]
    Triangles {
        /// The link's name.
        link: String,
        /// How many there are.
        count: usize,
    },
    /// The surface is too large for the pitch.
    #[error(
        "link {link}: {area:.3e} m² of triangles would take {cells:.0} cells at a pitch of {pitch} m, at most {most}; \
         correct the mesh's scale{}",
        raised(*.pitch, *.cells, *.most)
    )]
    TooLarge {
        /// The link's name.
        link: String,
        /// Area of all triangles, inner ones too, in m².
        area: f64,
        /// Cells that this would take.
        cells: f64,
        /// The pitch, in m.
        pitch: f64,
        /// The most cells.
        most: usize,
    },
}

/// Covers `links` with cells, where neither they nor `others` hide them.
///
/// # Errors
/// When an option is out of its range, or a link is too large for the pitch or not finite.
pub fn cover(links: &[Link], others: &[Link], options: &Options) -> Result<Skin, CoverError> {
    check(links, others, options)?;
    let mut placed = Vec::with_capacity(links.len());
    let mut figures = Vec::with_capacity(links.len());
    for (index, link) in links.iter().enumerate() {
        let surface = Surface::new(index, links, others, options)?;
        let spots = place::place(&surface, options, index);
        figures.push(figures::figures(link, &surface, &spots, options.pitch));
        placed.push(spots);
    }
    let (cells, buses) = wire::wire(&placed, options);
    Ok(Skin { cells, buses, links: figures })
}

/// Formats the pitch in m that is large enough; nothing where none is.
fn raised(pitch: f64, cells: f64, most: usize) -> String {
    let most = u32::try_from(most).map_or(f64::INFINITY, f64::from);
    // In whole mm, upwards.
    let needed = (pitch * (cells / most).sqrt() * 1e3).ceil() / 1e3;
    if needed <= MAX_PITCH { format!(", or raise the pitch to {needed} m") } else { String::new() }
}

fn check(links: &[Link], others: &[Link], options: &Options) -> Result<(), CoverError> {
    if !(MIN_PITCH..=MAX_PITCH).contains(&options.pitch) {
        return Err(CoverError::Pitch(options.pitch));
    }
    if !(0.0..=MAX_PITCH).contains(&options.clearance) {
        return Err(CoverError::Clearance(options.clearance));
    }
    if !(1..=MAX_NODES).contains(&options.nodes_per_bus) {
        return Err(CoverError::Nodes(options.nodes_per_bus));
    }
    if links.len() + others.len() > MAX_LINKS {
        return Err(CoverError::Links(links.len() + others.len()));
    }
    for (index, keep_out) in options.keep_out.iter().enumerate() {
        let wrong = |reason| Err(CoverError::KeepOut { index, reason });
        if keep_out.link >= links.len() {
            return wrong(format!("link {} is none of the {} covered ones", keep_out.link, links.len()));
        }
        for (min, max) in keep_out.min.iter().zip(&keep_out.max) {
            if !min.is_finite() || !max.is_finite() || min > max {
                return wrong(format!("its sides go from {:?} to {:?} m", keep_out.min, keep_out.max));
            }
        }
    }
    Ok(())
}
