//! The surface that the cells of a link lie on, a cylinder around the link or a plate, and its flat map.

use nalgebra::{Matrix3, Vector3};

/// The smallest number of cells on a link to which a cylinder is fitted.
const MIN_CYLINDER_CELLS: usize = 6;

/// A cell on a link: its centre in m and its unit normal, in the link's frame.
pub type SurfaceCell = ([f64; 3], [f64; 3]);

/// A cylinder in a link's frame; lengths in m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cylinder {
    /// A point on its axis.
    pub middle: [f64; 3],
    /// The unit vector along its axis.
    pub axis: [f64; 3],
    /// Radius in m, 0.005 to 0.5.
    pub radius: f64,
    /// Positions of the first and the last cell along the axis, from `middle`.
    pub along: [f64; 2],
}

impl Cylinder {
    /// Fits a cylinder to the cells by least squares. The axis is perpendicular to the cells' normals as well as
    /// possible, and passes through the points that lie one radius below the cells, along their normals. Returns `None`
    /// for fewer than 6 cells, and for cells that face one way, as on a plate.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "a number of cells")]
    pub fn fit(cells: &[SurfaceCell]) -> Option<Self> {
        if cells.len() < MIN_CYLINDER_CELLS {
            return None;
        }
        let count = cells.len() as f64;
        let cells: Vec<_> = cells.iter().map(position_and_normal).collect();
        let spread: Matrix3<f64> = cells.iter().map(|(_, normal)| normal * normal.transpose()).sum();
        let eigen = (spread / count).symmetric_eigen();
        let mut values: Vec<_> = eigen.eigenvalues.iter().copied().zip(0..).collect();
        values.sort_by(|one, other| one.0.total_cmp(&other.0));
        let &[(along, column), (across, _), _] = values.as_slice() else { return None };
        // The normals of a cylinder spread evenly over both directions perpendicular to the axis.
        if along > 0.1 || across < 0.2 {
            return None;
        }
        let axis: Vector3<f64> = eigen.eigenvectors.column(column).into();
        let flat = |vector: &Vector3<f64>| vector - axis * axis.dot(vector);
        let [mean_at, mean_normal] = cells.iter().fold([Vector3::zeros(); 2], |[at, normal], (p, n)| {
            [at + flat(p) / count, normal + flat(n) / count]
        });
        let (mut both, mut square) = (0.0, 0.0);
        for (position, normal) in &cells {
            let normal = flat(normal) - mean_normal;
            both += (flat(position) - mean_at).dot(&normal);
            square += normal.norm_squared();
        }
        let radius = both / square;
        if !(0.005..0.5).contains(&radius) {
            return None;
        }
        let along = cells.iter().map(|(position, _)| axis.dot(position));
        let (from, to) =
            along.fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), at| (from.min(at), to.max(at)));
        let middle = mean_at - mean_normal * radius;
        Some(Self { middle: middle.into(), axis: axis.into(), radius, along: [from, to] })
    }

    /// Returns the point on the axis at the distance `along` in m from `middle`.
    #[must_use]
    pub fn axis_point(&self, along: f64) -> [f64; 3] {
        (Vector3::from(self.middle) + Vector3::from(self.axis) * along).into()
    }
}

/// The cells of a link, laid flat and seen from outside.
#[derive(Clone, Debug, PartialEq)]
pub struct FlatMap {
    /// Position of each cell, to the right and down, in m. On a cylinder, 0 to the right is where the link's x axis
    /// passes through the surface (or its y axis, if the cylinder lies along x).
    pub places: Vec<[f64; 2]>,
    /// The radius in m of the unrolled cylinder; `None` for a plate.
    pub radius: Option<f64>,
}

/// Maps the cells of a link to a plane. A cylinder is unrolled, with the angle around its axis to the right; a plate is
/// seen along its mean normal. `tip` is the direction from the link to the tip of the arm; its component in the surface
/// points down.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "a number of cells")]
pub fn lay_flat(cells: &[SurfaceCell], tip: [f64; 3]) -> FlatMap {
    let tip = Vector3::from(tip);
    if let Some(cylinder) = Cylinder::fit(cells) {
        let axis = Vector3::from(cylinder.axis);
        let axis = if axis.dot(&tip) < 0.0 { -axis } else { axis };
        let front = perpendicular(&axis);
        let right = front.cross(&axis);
        let places = cells.iter().map(|cell| {
            let position = position_and_normal(cell).0;
            let out = position - Vector3::from(cylinder.middle);
            let angle = out.dot(&right).atan2(out.dot(&front));
            [angle * cylinder.radius, axis.dot(&position)]
        });
        return FlatMap { places: places.collect(), radius: Some(cylinder.radius) };
    }
    let mean = cells.iter().fold(Vector3::zeros(), |sum, cell| sum + position_and_normal(cell).1);
    let normal = (mean / cells.len().max(1) as f64).try_normalize(1e-6).unwrap_or_else(Vector3::z);
    let down =
        (tip - normal * normal.dot(&tip)).try_normalize(1e-6).unwrap_or_else(|| perpendicular(&normal));
    let right = normal.cross(&down);
    let places = cells.iter().map(|cell| {
        let position = position_and_normal(cell).0;
        [right.dot(&position), down.dot(&position)]
    });
    FlatMap { places: places.collect(), radius: None }
}

/// Returns the unit vector perpendicular to `axis` that is nearest to the x axis, or to the y axis if `axis` is close
/// to x.
fn perpendicular(axis: &Vector3<f64>) -> Vector3<f64> {
    let chosen = if axis.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    (chosen - axis * axis.dot(&chosen)).normalize()
}

fn position_and_normal((position, normal): &SurfaceCell) -> (Vector3<f64>, Vector3<f64>) {
    (Vector3::from(*position), Vector3::from(*normal))
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::{FRAC_PI_2, TAU};

    /// Six rings of twelve cells around the axis through (0.1, 0.2, z).
    fn ring() -> Vec<SurfaceCell> {
        let cells = (0..72_u32).map(|at| {
            let (angle, z) = (f64::from(at % 12) / 12.0 * TAU, f64::from(at / 12) * 0.03);
            let normal = [angle.cos(), angle.sin(), 0.0];
            ([0.1 + 0.05 * normal[0], 0.2 + 0.05 * normal[1], z], normal)
        });
        cells.collect()
    }

    #[test]
    fn a_ring_of_cells_lies_on_its_cylinder() {
        let cylinder = Cylinder::fit(&ring()).unwrap();
        assert!((cylinder.radius - 0.05).abs() < 1e-9, "{cylinder:?}");
        let [x, y, _] = cylinder.middle;
        assert!((x - 0.1).abs() < 1e-9 && (y - 0.2).abs() < 1e-9, "{cylinder:?}");
        let [from, to] = cylinder.along.map(|along| cylinder.axis_point(along)[2]);
        assert!((from.min(to)).abs() < 1e-9 && (from.max(to) - 0.15).abs() < 1e-9, "{from} {to}");
        assert_eq!(Cylinder::fit(&ring()[..5]), None, "too few");
    }

    #[test]
    fn a_cylinder_is_unrolled_as_seen_from_outside_with_the_tip_below() {
        let flat = lay_flat(&ring(), [0.0, 0.0, 1.0]);
        assert_eq!(flat.radius.map(|radius| (radius * 1e6).round()), Some(50_000.0));
        // The first cell faces x. With z down and x towards the reader, y points left.
        let [first, side, below] = [0, 3, 12].map(|at| flat.places[at]);
        assert!(first[0].abs() < 1e-9 && (below[1] - first[1] - 0.03).abs() < 1e-9, "{first:?} {below:?}");
        assert!((side[0] + FRAC_PI_2 * 0.05).abs() < 1e-9, "{side:?}");
        let upwards = lay_flat(&ring(), [0.0, 0.0, -1.0]);
        assert!((upwards.places[3][0] - FRAC_PI_2 * 0.05).abs() < 1e-9, "turned about, y is to the right");
    }

    #[test]
    fn a_plate_keeps_its_distances() {
        let cells: Vec<SurfaceCell> =
            (0..4).map(|at| ([f64::from(at) * 0.03, 0.5, 0.1], [0.0, 0.0, 1.0])).collect();
        let flat = lay_flat(&cells, [1.0, 0.0, 0.0]);
        assert_eq!(flat.radius, None);
        for pair in flat.places.windows(2) {
            assert!(
                (pair[1][1] - pair[0][1] - 0.03).abs() < 1e-12 && (pair[1][0] - pair[0][0]).abs() < 1e-12
            );
        }
    }
}
