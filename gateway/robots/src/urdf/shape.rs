//! The visual and collision shapes of a link.

use nalgebra::Isometry3;

/// A shape on a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// The transform from the frame of the link to the frame of the shape.
    pub origin: Isometry3<f64>,
    /// The geometry of the shape.
    pub geometry: Geometry,
}

/// The geometry of a shape. Lengths are in m. Boxes, cylinders and spheres are centered on the frame of the shape.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Geometry {
    /// A mesh of triangles in a file.
    Mesh {
        /// The reference as written: a path, `package://` or `file://`.
        path: String,
        /// The scale factors along x, y and z, which may be negative.
        scale: [f64; 3],
    },
    /// A box.
    Box {
        /// The full lengths along x, y and z.
        size: [f64; 3],
    },
    /// A cylinder along z.
    Cylinder {
        /// The radius.
        radius: f64,
        /// The length along z.
        length: f64,
    },
    /// A sphere.
    Sphere {
        /// The radius.
        radius: f64,
    },
    /// A geometry element that URDF does not define.
    Other {
        /// The name of the element.
        element: String,
    },
}
