//! The shapes of a link.

use nalgebra::Isometry3;

/// A shape on a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// The transform from the link's frame to the shape's.
    pub origin: Isometry3<f64>,
    /// The geometry.
    pub geometry: Geometry,
}

/// The geometry of a shape. Lengths are in m; boxes, cylinders and spheres are centered on the shape's frame.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Geometry {
    /// A file with triangles.
    Mesh {
        /// The reference as written: a path, `package://` or `file://`.
        path: String,
        /// The factors along x, y and z; they may be negative.
        scale: [f64; 3],
    },
    /// A box.
    Box {
        /// The lengths along x, y and z.
        size: [f64; 3],
    },
    /// A cylinder along z.
    Cylinder {
        /// The radius.
        radius: f64,
        /// The length.
        length: f64,
    },
    /// A sphere.
    Sphere {
        /// The radius.
        radius: f64,
    },
    /// An element that URDF does not define.
    Other {
        /// The name of the element.
        element: String,
    },
}
