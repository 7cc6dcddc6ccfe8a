//! Improves the positions of cells by their neighbours: cells that are wired to each other have a known distance, and
//! lie on a smooth surface.

use nalgebra::{Cholesky, DMatrix, DVector, Matrix3, Vector3};

/// The distance of two cells that are wired to each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spacing {
    /// The distance of the cells' centres, in m.
    pub distance: f64,
    /// The standard deviation of the distance, in m.
    pub deviation: f64,
}

impl Spacing {
    /// Returns the spacing for a distance in m, with a deviation of 1 %.
    #[must_use]
    pub const fn with_distance(distance: f64) -> Self {
        Self { distance, deviation: distance * 0.01 }
    }
}

/// The estimated place of a cell, with its uncertainty.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LocatedCell {
    pub(crate) position: Vector3<f64>,
    pub(crate) normal: Vector3<f64>,
    pub(crate) covariance: Matrix3<f64>,
}

/// The number of standard deviations by which the length of a wire may be off; longer ones are ignored, as they are
/// cables or lead to mistaken cells.
const MAX_WIRE_LENGTH_DEVIATIONS: f64 = 4.0;
/// The number of times that the positions are recomputed.
const POSITION_UPDATE_ROUNDS: usize = 3;

/// Improves the positions of the cells on one link; `wires` has pairs of indices. Returns the number of wires used.
pub(crate) fn improve_positions(
    cells: &mut [LocatedCell],
    wires: &[(usize, usize)],
    spacing: &Spacing,
) -> usize {
    let pair =
        |cells: &[LocatedCell], &(one, other): &(usize, usize)| Some((*cells.get(one)?, *cells.get(other)?));
    let fits = |wire: &&(usize, usize)| {
        pair(cells, wire).is_some_and(|(one, other)| {
            let way = other.position - one.position;
            let along = way.try_normalize(1e-9).unwrap_or_else(Vector3::x);
            let variance = (along.transpose() * (one.covariance + other.covariance) * along).x;
            let deviation = (variance + spacing.deviation.powi(2)).sqrt();
            (way.norm() - spacing.distance).abs() < MAX_WIRE_LENGTH_DEVIATIONS * deviation
        })
    };
    let wires: Vec<_> = wires.iter().filter(fits).copied().collect();
    if wires.is_empty() {
        return 0;
    }
    let size = 3 * cells.len();
    let measured: Vec<_> = cells.iter().map(|cell| cell.position).collect();
    let mut covariance = None;
    for _ in 0..POSITION_UPDATE_ROUNDS {
        let mut information = DMatrix::<f64>::zeros(size, size);
        let mut gradient = DVector::<f64>::zeros(size);
        for (index, (cell, measured)) in cells.iter().zip(&measured).enumerate() {
            let Some(own) = cell.covariance.try_inverse() else { return 0 };
            information.fixed_view_mut::<3, 3>(3 * index, 3 * index).copy_from(&own);
            gradient.fixed_rows_mut::<3>(3 * index).copy_from(&(own * (cell.position - measured)));
        }
        for wire in &wires {
            let Some((one, other)) = pair(cells, wire) else { continue };
            let way = other.position - one.position;
            let (Some(along), Some(up)) =
                (way.try_normalize(1e-9), (one.normal + other.normal).try_normalize(1e-3))
            else {
                continue;
            };
            // The distance, and the tilt: on an evenly curved surface, the line between two cells is at a right angle
            // to the mean of their normals.
            for (direction, off) in [(along, way.norm() - spacing.distance), (up, way.dot(&up))] {
                let weight = spacing.deviation.powi(-2);
                let block = direction * direction.transpose() * weight;
                let (a, b) = (3 * wire.0, 3 * wire.1);
                for (row, column, sign) in [(a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)] {
                    let mut view = information.fixed_view_mut::<3, 3>(row, column);
                    view += block * sign;
                }
                for (at, sign) in [(a, -1.0), (b, 1.0)] {
                    let mut view = gradient.fixed_rows_mut::<3>(at);
                    view += direction * (off * weight * sign);
                }
            }
        }
        let Some(solved) = Cholesky::new(information) else { return 0 };
        let step = solved.solve(&gradient);
        for (index, cell) in cells.iter_mut().enumerate() {
            cell.position -= step.fixed_rows::<3>(3 * index);
        }
        covariance = Some(solved);
    }
    if let Some(inverse) = covariance.map(|it| it.inverse()) {
        for (index, cell) in cells.iter_mut().enumerate() {
            cell.covariance = inverse.fixed_view::<3, 3>(3 * index, 3 * index).into_owned();
        }
    }
    wires.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_pull_cells_to_their_distance_and_a_wrong_wire_does_not() {
        let cell = |x: f64, z: f64| LocatedCell {
            position: Vector3::new(x, 0.0, z),
            normal: Vector3::z(),
            covariance: Matrix3::identity() * 1e-6,
        };
        let mut cells = [cell(0.0, 0.0), cell(0.030, 0.001), cell(0.057, -0.001), cell(0.5, 0.0)];
        let spacing = Spacing { distance: 0.028, deviation: 0.2e-3 };
        let used = improve_positions(&mut cells, &[(0, 1), (1, 2), (2, 3)], &spacing);
        assert_eq!(used, 2);
        for (one, other) in [(0, 1), (1, 2)] {
            let way = cells[other].position - cells[one].position;
            assert!((way.norm() - 0.028).abs() < 2e-4 && way.z.abs() < 2e-4, "{way}");
        }
        assert!((cells[3].position.x - 0.5).abs() < 1e-12);
        assert!(cells[1].covariance[(0, 0)] < 0.6e-6 && cells[3].covariance[(0, 0)] > 0.9e-6);
    }
}
