//! The reach of a cell: its maximum distance from the origins of the frames below it in its chain.
//!
//! A kernel computes the moment of a unit force on the cell about the origin of each of these frames. No such moment
//! exceeds the reach. To find the reach, the algorithm follows the possible positions of the cell from its row down to
//! the base, as the convex hull of circles. A revolute joint spreads the positions around its axis, and a prismatic
//! joint along its axis. Fixed rows only move them, so long rows that fold back do not increase the reach.

use super::robot::{ChainRow, DenavitHartenberg};
use crate::parameters::RowKind;

/// Maximum reach in m: the range of Q1.14, 2 m, less a margin for accumulated rounding.
pub const MAX_REACH: f64 = 2.0 - 1e-3;

type Vector = [f64; 3];

/// A circle: the points at one distance from a centre, in the plane perpendicular to a unit axis.
#[derive(Clone, Copy, Debug)]
struct Circle {
    center: Vector,
    axis: Vector,
    radius: f64,
}

fn dot([a, b, c]: Vector, [x, y, z]: Vector) -> f64 {
    a * x + b * y + c * z
}

/// Transforms a vector by `Rz(theta) Tz(d) Tx(a) Rx(alpha)`, from the frame of a row to the frame below. If `is_point`
/// is false, the vector is a direction, which translations do not change.
fn transform_vector(
    row: &DenavitHartenberg,
    d: f64,
    theta: f64,
    [x, y, z]: Vector,
    is_point: bool,
) -> Vector {
    let (sine, cosine) = row.alpha.sin_cos();
    let (a, d) = if is_point { (row.a, d) } else { (0.0, 0.0) };
    let [x, y, z] = [x + a, cosine * y - sine * z, sine * y + cosine * z + d];
    let (sine, cosine) = theta.sin_cos();
    [cosine * x - sine * y, sine * x + cosine * y, z]
}

impl Circle {
    fn transform_down(self, row: &DenavitHartenberg, d: f64, theta: f64) -> Self {
        let center = transform_vector(row, d, theta, self.center, true);
        Self { center, axis: transform_vector(row, d, theta, self.axis, false), radius: self.radius }
    }

    /// Returns the maximum distance of a point of the circle from the origin.
    fn farthest_distance(&self) -> f64 {
        let along = dot(self.center, self.axis);
        let across = (dot(self.center, self.center) - along * along).max(0.0).sqrt();
        (across + self.radius).hypot(along)
    }

    /// Returns the maximum distance of a point of the circle from the z axis, and the range of the points along that
    /// axis.
    fn z_axis_distance_and_range(&self) -> (f64, [f64; 2]) {
        let [x, y, z] = self.center;
        let [ax, ay, _] = self.axis;
        let height = self.radius * ax.hypot(ay);
        (x.hypot(y) + self.radius, [z - height, z + height])
    }
}

/// Returns an upper bound in m of the distance between a point and the origin of each frame below it. `rows` are the
/// rows from the base to the row that carries the point, and `position` is in the frame of that row. Prismatic joints
/// move within their limits; revolute joints turn freely. At the first revolute joint only the distance from its axis
/// counts. No moment of a unit force at the point exceeds the bound.
#[must_use]
pub fn max_frame_distance(rows: &[ChainRow], position: [f64; 3]) -> f64 {
    let mut circles = vec![Circle { center: position, axis: [0.0, 0.0, 1.0], radius: 0.0 }];
    let farthest = |circles: &[Circle]| circles.iter().map(Circle::farthest_distance).fold(0.0, f64::max);
    let mut most = farthest(&circles);
    // A simpler bound without directions: no distance grows by more than the length of a row.
    let mut sphere = most;
    let first = rows.iter().position(|row| row.kind == RowKind::Revolute).unwrap_or(rows.len());
    for (index, row) in rows.iter().enumerate().skip(first).rev() {
        let [min, max] = row.limits;
        let table = &row.table;
        let slides: &[f64] = if row.kind == RowKind::Prismatic { &[min, max] } else { &[0.0] };
        let carried = slides.iter().flat_map(|slide| {
            circles
                .iter()
                .map(move |circle| circle.transform_down(table, table.d + slide, table.theta_offset))
        });
        let carried: Vec<_> = carried.collect();
        // An offset along the first axis has no moment about it.
        let along = slides.iter().map(|slide| (table.d + slide).abs()).fold(0.0, f64::max);
        sphere += table.a.hypot(if index == first { 0.0 } else { along });
        circles = carried;
        if row.kind == RowKind::Revolute {
            let spans = circles.iter().map(Circle::z_axis_distance_and_range);
            let start = (0.0, [f64::INFINITY, f64::NEG_INFINITY]);
            let (radius, [low, high]) = spans.fold(start, |(most, [low, high]), (radius, [from, to])| {
                (f64::max(most, radius), [f64::min(low, from), f64::max(high, to)])
            });
            let radius = radius.min(sphere);
            circles = [low, high]
                .map(|z| Circle {
                    center: [0.0, 0.0, z.clamp(-sphere, sphere)],
                    axis: [0.0, 0.0, 1.0],
                    radius,
                })
                .to_vec();
        }
        let from_here = if index == first {
            circles.iter().map(|circle| circle.z_axis_distance_and_range().0).fold(0.0, f64::max)
        } else {
            farthest(&circles)
        };
        let from_here = from_here.min(sphere);
        if index > first {
            sphere = from_here;
        }
        most = most.max(from_here);
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::{FRAC_PI_2, TAU};

    fn turning(a: f64, alpha: f64, d: f64) -> ChainRow {
        let table = DenavitHartenberg { a, alpha, d, theta_offset: 0.0 };
        ChainRow { kind: RowKind::Revolute, table, limits: [-TAU, TAU] }
    }

    fn fixed(a: f64, alpha: f64, d: f64) -> ChainRow {
        ChainRow { kind: RowKind::Fixed, limits: [0.0; 2], ..turning(a, alpha, d) }
    }

    fn is_near(got: f64, target: f64) {
        assert!((got - target).abs() < 1e-12, "{got}, not {target}");
    }

    #[test]
    fn a_stretched_arm_reaches_as_far_as_its_links_are_long() {
        let arm = [turning(0.5, 0.0, 0.3), turning(0.4, 0.0, 0.0)];
        is_near(max_frame_distance(&arm, [0.1, 0.0, 0.0]), 1.0);
    }

    #[test]
    fn rows_that_fold_back_do_not_count() {
        let arm = [turning(0.0, FRAC_PI_2, 0.0), fixed(0.9, 0.0, 0.0), fixed(-0.9, 0.0, 0.0)];
        is_near(max_frame_distance(&arm, [0.1, 0.0, 0.0]), 0.8);
        let there_and_back = [turning(0.2, 0.0, 0.0), fixed(0.0, 0.0, 0.8), fixed(0.0, 0.0, -0.8)];
        is_near(max_frame_distance(&there_and_back, [0.1, 0.0, 0.0]), (0.1_f64).hypot(0.8));
    }

    #[test]
    fn a_slide_reaches_from_end_to_end() {
        let slide =
            ChainRow { kind: RowKind::Prismatic, limits: [-0.1, 0.7], ..turning(0.0, FRAC_PI_2, 0.2) };
        let arm = [turning(0.0, 0.0, 0.0), slide];
        is_near(max_frame_distance(&arm, [0.3, 0.0, 0.0]), (0.3_f64).hypot(0.9));
        is_near(max_frame_distance(&[slide, turning(0.4, 0.0, 0.0)], [0.3, 0.0, 0.0]), 0.7);
        is_near(max_frame_distance(&[slide], [0.3, 0.0, 0.0]), 0.3);
        let arm = [turning(0.0, FRAC_PI_2, 0.0), slide];
        is_near(max_frame_distance(&arm, [0.3, 0.0, 0.0]), (0.3_f64).hypot(0.9));
    }

    #[test]
    fn a_point_is_carried_by_the_transform_of_its_row() {
        let row = DenavitHartenberg { a: 0.5, alpha: FRAC_PI_2, d: 9.0, theta_offset: 0.0 };
        // Rx takes y to z and z to -y; Tx and Tz follow; Rz takes x to y.
        let carried = transform_vector(&row, 0.25, FRAC_PI_2, [1.0, 2.0, 3.0], true);
        carried.iter().zip([3.0, 1.5, 2.25]).for_each(|(got, target)| is_near(*got, target));
        let tilted = DenavitHartenberg { alpha: FRAC_PI_2 / 2.0, ..row };
        let half = 0.5_f64.sqrt();
        let carried = transform_vector(&tilted, 0.0, 0.0, [0.0, 1.0, 2.0], false);
        carried.iter().zip([0.0, -half, 3.0 * half]).for_each(|(got, target)| is_near(*got, target));
    }
}
