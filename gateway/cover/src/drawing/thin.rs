//! Fewer triangles that look alike from afar.

use std::collections::{BTreeMap, BTreeSet};

type Point = [f64; 3];

/// At most `most` triangles: corners in one cube are merged to the first of them, with larger cubes until few enough
/// triangles are left. Those that are not finite are left out.
pub(super) fn thinned(triangles: &[[Point; 3]], most: usize) -> Vec<[Point; 3]> {
    let finite = |triangle: &&[Point; 3]| triangle.iter().flatten().all(|value| value.is_finite());
    let triangles: Vec<_> = triangles.iter().filter(finite).copied().collect();
    if triangles.len() <= most {
        return triangles;
    }
    let values = || triangles.iter().flatten().flatten().copied();
    let size = values().fold(f64::MIN, f64::max) - values().fold(f64::MAX, f64::min);
    let mut edge = size / 256.0;
    // Each round has a third less detail; in the end all corners are one.
    while edge.is_finite() && edge > 0.0 {
        let merged = merged(&triangles, edge);
        if merged.len() <= most {
            return merged;
        }
        edge *= 1.25;
    }
    Vec::new()
}

#[expect(clippy::cast_possible_truncation, reason = "saturates, which only merges more")]
fn merged(triangles: &[[Point; 3]], edge: f64) -> Vec<[Point; 3]> {
    let mut first = BTreeMap::new();
    let mut seen = BTreeSet::new();
    let mut left = Vec::new();
    for &triangle in triangles {
        let mut cubes = triangle.map(|corner| {
            let cube = corner.map(|value| (value / edge).floor() as i64);
            first.entry(cube).or_insert(corner);
            cube
        });
        let corners = cubes.map(|cube| first.get(&cube).copied().unwrap_or_default());
        cubes.sort_unstable();
        let [a, b, c] = cubes;
        if a != b && b != c && seen.insert(cubes) {
            left.push(corners);
        }
    }
    left
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;

    #[test]
    fn a_sphere_stays_a_sphere_with_fewer_triangles() {
        let sphere = Mesh::sphere(0.3).unwrap();
        let all: Vec<[Point; 3]> =
            sphere.triangles().iter().map(|triangle| triangle.map(|corner| corner.coords.into())).collect();
        assert_eq!(thinned(&all, all.len()), all, "few enough");
        let few = thinned(&all, 800);
        assert!((300..=800).contains(&few.len()), "{} of {}", few.len(), all.len());
        let radius = |corner: &Point| corner.iter().map(|value| value * value).sum::<f64>().sqrt();
        assert!(few.iter().flatten().all(|corner| (radius(corner) - 0.3).abs() < 1e-6));
    }

    #[test]
    fn what_cannot_be_drawn_is_left_out() {
        let point = [1.0; 3];
        assert_eq!(thinned(&[[point; 3]; 9], 3), [[[0.0; 3]; 3]; 0]);
        assert_eq!(thinned(&[[[f64::NAN; 3]; 3]; 9], 9), [[[0.0; 3]; 3]; 0]);
    }
}
