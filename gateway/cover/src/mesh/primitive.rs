//! Creates meshes of boxes, cylinders and spheres in the position that URDF defines: centered on the origin, with the
//! axis of a cylinder along z.

use core::f64::consts::{PI, TAU};

use nalgebra::Point3;

use super::{Mesh, MeshError, Triangle};

/// The number of corners around a cylinder or a sphere. They are 5 degrees apart, so the normal of each face is within
/// 2.5 degrees of the true one.
const CIRCLE_SEGMENTS: u32 = 72;

fn check_positive(shape: &'static str, what: &'static str, value: f64) -> Result<f64, MeshError> {
    if value.is_finite() && value > 0.0 { Ok(value) } else { Err(MeshError::Size { shape, what, value }) }
}

/// Returns the two triangles between four corners, which are given in order. Triangles without an area are left out.
fn quad_triangles([a, b, c, d]: [Point3<f64>; 4]) -> impl Iterator<Item = Triangle> {
    [[a, b, c], [a, c, d]].into_iter().filter(|[a, b, c]| a != b && b != c && c != a)
}

impl Mesh {
    /// Creates a box with these edge lengths, in m.
    ///
    /// # Errors
    /// Returns [`MeshError::Size`] if a length is not above 0.
    pub fn cuboid(size: [f64; 3]) -> Result<Self, MeshError> {
        let [x, y, z] = size;
        let x = check_positive("box", "x", x)? / 2.0;
        let y = check_positive("box", "y", y)? / 2.0;
        let z = check_positive("box", "z", z)? / 2.0;
        let point = |[i, j, k]: [f64; 3]| Point3::new(i * x, j * y, k * z);
        let sides = [
            [[1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0]],
            [[-1.0, 1.0, -1.0], [-1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, 1.0]],
            [[1.0, 1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, 1.0, 1.0], [1.0, 1.0, 1.0]],
            [[-1.0, -1.0, -1.0], [1.0, -1.0, -1.0], [1.0, -1.0, 1.0], [-1.0, -1.0, 1.0]],
            [[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]],
            [[-1.0, 1.0, -1.0], [1.0, 1.0, -1.0], [1.0, -1.0, -1.0], [-1.0, -1.0, -1.0]],
        ];
        Self::new("box", sides.into_iter().flat_map(|side| quad_triangles(side.map(point))).collect())
    }

    /// Creates a cylinder with this radius and length, in m, closed at both ends.
    ///
    /// # Errors
    /// Returns [`MeshError::Size`] if a size is not above 0.
    pub fn cylinder(radius: f64, length: f64) -> Result<Self, MeshError> {
        let radius = check_positive("cylinder", "radius", radius)?;
        let top = check_positive("cylinder", "length", length)? / 2.0;
        // The profile goes from the center of one end, along the wall, to the center of the other end.
        let profile = [(0.0, -top), (radius, -top), (radius, top), (0.0, top)];
        Self::new("cylinder", surface_of_revolution(&profile))
    }

    /// Creates a sphere with this radius, in m.
    ///
    /// # Errors
    /// Returns [`MeshError::Size`] if the radius is not above 0.
    pub fn sphere(radius: f64) -> Result<Self, MeshError> {
        let radius = check_positive("sphere", "radius", radius)?;
        let half = CIRCLE_SEGMENTS / 2;
        let profile: Vec<_> = (0..=half)
            .map(|step| {
                let angle = PI * f64::from(step) / f64::from(half);
                let ring = if step == 0 || step == half { 0.0 } else { radius * angle.sin() };
                (ring, -radius * angle.cos())
            })
            .collect();
        Self::new("sphere", surface_of_revolution(&profile))
    }
}

/// Returns the surface that results from rotating a profile about z. A profile is a list of radii and heights.
fn surface_of_revolution(profile: &[(f64, f64)]) -> Vec<Triangle> {
    let point = |(radius, z): (f64, f64), step: u32| {
        let angle = TAU * f64::from(step % CIRCLE_SEGMENTS) / f64::from(CIRCLE_SEGMENTS);
        Point3::new(radius * angle.cos(), radius * angle.sin(), z)
    };
    let strips = profile.iter().zip(profile.iter().skip(1));
    let quads = strips.flat_map(|(&low, &high)| {
        (0..CIRCLE_SEGMENTS).flat_map(move |step| {
            quad_triangles([point(low, step), point(low, step + 1), point(high, step + 1), point(high, step)])
        })
    });
    quads.collect()
}
