//! A grid of cubes by which the points near another point are found.

use std::collections::BTreeMap;

use nalgebra::Point3;

/// Indices of points, by the cube that contains the point.
#[derive(Clone, Debug)]
pub(crate) struct PointGrid {
    edge: f64,
    cubes: BTreeMap<[i64; 3], Vec<usize>>,
}

impl PointGrid {
    /// Creates an empty grid whose cubes have this edge length, in m.
    pub(crate) const fn new(edge: f64) -> Self {
        Self { edge, cubes: BTreeMap::new() }
    }

    /// Creates a grid with the given points, whose indices are their positions in the sequence.
    pub(crate) fn with_points<'a>(edge: f64, points: impl IntoIterator<Item = &'a Point3<f64>>) -> Self {
        let mut grid = Self::new(edge);
        for (index, point) in points.into_iter().enumerate() {
            grid.insert(point, index);
        }
        grid
    }

    pub(crate) fn insert(&mut self, point: &Point3<f64>, index: usize) {
        self.cubes.entry(self.cube_at(point)).or_default().push(index);
    }

    /// Returns the coordinates of the cube that contains a point.
    #[expect(clippy::cast_possible_truncation, reason = "saturates far away, where nothing is near")]
    pub(crate) fn cube_at(&self, point: &Point3<f64>) -> [i64; 3] {
        [point.x, point.y, point.z].map(|coordinate| (coordinate / self.edge).floor() as i64)
    }

    /// Returns all cubes that contain points, each with the indices of its points.
    pub(crate) fn filled_cubes(&self) -> impl Iterator<Item = ([i64; 3], &[usize])> {
        self.cubes.iter().map(|(&cube, points)| (cube, points.as_slice()))
    }

    /// Returns the indices of the points in a cube and in the 26 cubes around it. They include all points that are
    /// within an edge length of any point in the cube.
    pub(crate) fn points_around(&self, [x, y, z]: [i64; 3]) -> impl Iterator<Item = usize> {
        let near = |middle: i64| middle.saturating_sub(1)..=middle.saturating_add(1);
        near(x).flat_map(move |x| near(y).map(move |y| [x, y])).flat_map(move |[x, y]| {
            let row = [x, y, z.saturating_sub(1)]..=[x, y, z.saturating_add(1)];
            self.cubes.range(row).flat_map(|(_, points)| points.iter().copied())
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn all_points_within_an_edge_are_found(
            points in proptest::collection::vec(proptest::array::uniform3(-2.0..2.0_f64), 1..80),
        ) {
            let points: Vec<_> = points.into_iter().map(Point3::from).collect();
            let grid = PointGrid::with_points(0.7, &points);
            prop_assert_eq!(grid.filled_cubes().map(|(_, points)| points.len()).sum::<usize>(), points.len());
            for point in &points {
                let found: Vec<_> = grid.points_around(grid.cube_at(point)).collect();
                for (index, other) in points.iter().enumerate() {
                    prop_assert!((point - other).norm() > 0.7 || found.contains(&index));
                }
            }
        }
    }
}
