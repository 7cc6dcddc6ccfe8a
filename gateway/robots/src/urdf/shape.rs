//! What a link looks like.

use nalgebra::Isometry3;

/// A shape on a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// From the link's frame to the shape's.
    pub origin: Isometry3<f64>,
    /// What it is.
    pub geometry: Geometry,
}

/// What a shape is. Lengths are in m; boxes, cylinders and spheres are centered on the shape's frame.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Geometry {
    /// A file with triangles.
    Mesh {
        /// As written: a path, `package://`, `file://`.
        path: String,
        /// Factor along x, y and z; may be negative.
        scale: [f64; 3],
    },
    /// A box.
    Box {
        /// Along x, y and z.
        size: [f64; 3],
    },
    /// A cylinder along z.
    Cylinder {
        /// Its radius.
        radius: f64,
        /// Its length.
        length: f64,
    },
    /// A sphere.
    Sphere {
        /// Its radius.
        radius: f64,
    },
    /// Something that URDF does not have.
    Other {
        /// The element's name.
        element: String,
    },
}
