//! Reduces the number of triangles of a shape by merging corners that are near each other.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Point3, Vector3};

use super::Triangle;

/// The factor by which the cubes of the grid grow if there are still too many triangles.
const CUBE_GROWTH_FACTOR: f64 = 1.12;

/// The coordinates of a cube in the grid.
type Cube = [i64; 3];

/// Reduces the parts of a shape to at most `most` triangles in total. Returns them unchanged if they have no more.
/// Corners of a part that are in the same cube of a grid are replaced by their mean; the cubes are as small as `most`
/// allows. Triangles with coordinates that are not finite are left out.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "a number of triangles")]
pub fn simplify(mut parts: Vec<Vec<Triangle>>, most: usize) -> Vec<Vec<Triangle>> {
    for part in &mut parts {
        part.retain(|triangle| triangle.iter().flat_map(Point3::iter).all(|value| value.is_finite()));
    }
    if parts.iter().map(Vec::len).sum::<usize>() <= most {
        return parts;
    }
    let area: f64 = parts.iter().flatten().map(triangle_area).sum();
    // A flat surface keeps two triangles per cube, so this first size leaves about twice the allowed number.
    let mut size = (area / most.max(1) as f64).sqrt().max(1e-6);
    loop {
        let fewer: Vec<_> = parts.iter().map(|part| merge_corners(part, size)).collect();
        if fewer.iter().map(Vec::len).sum::<usize>() <= most {
            return fewer;
        }
        size *= CUBE_GROWTH_FACTOR;
    }
}

fn triangle_area([a, b, c]: &Triangle) -> f64 {
    (b - a).cross(&(c - a)).norm() / 2.0
}

/// Merges the corners within each cube of this size. Returns the triangles whose corners are in three different cubes,
/// without duplicates.
#[expect(clippy::cast_possible_truncation, reason = "a coordinate over a size that is no smaller than 1 um")]
fn merge_corners(part: &[Triangle], size: f64) -> Vec<Triangle> {
    // The grid begins at the smallest coordinates of the part, so that a cube of the part's size contains all of it.
    let infinite = Point3::new(f64::INFINITY, f64::INFINITY, f64::INFINITY);
    let low = part.iter().flatten().fold(infinite, |low, corner| low.inf(corner));
    let cube = |corner: &Point3<f64>| -> Cube { ((corner - low) / size).map(|it| it.floor() as i64).into() };
    let mut means = BTreeMap::<Cube, (Vector3<f64>, f64)>::new();
    for corner in part.iter().flatten() {
        let (sum, count) = means.entry(cube(corner)).or_insert_with(|| (Vector3::zeros(), 0.0));
        *sum += corner.coords;
        *count += 1.0;
    }
    let mut seen = BTreeSet::new();
    let kept = part.iter().filter_map(|triangle| {
        let cubes = triangle.each_ref().map(cube);
        let [a, b, c] = cubes;
        let mut sorted = cubes;
        sorted.sort_unstable();
        (a != b && b != c && c != a && seen.insert(sorted)).then_some(cubes)
    });
    let mean = |cube: &Cube| means.get(cube).map(|(sum, count)| Point3::from(sum / *count));
    kept.filter_map(|[a, b, c]| Some([mean(&a)?, mean(&b)?, mean(&c)?])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Mesh;

    #[test]
    fn a_sphere_of_fewer_triangles_is_a_sphere_still() {
        let sphere = Mesh::sphere(0.1).unwrap();
        // Each triangle is divided into 64, so that there are enough triangles to be merged.
        let mut fine = sphere.triangles().to_vec();
        for _ in 0..3 {
            let middle = |a: &Point3<f64>, b: &Point3<f64>| {
                Point3::from(((a.coords + b.coords) / 2.0).normalize() * 0.1)
            };
            let cut = fine.iter().flat_map(|[a, b, c]| {
                let [ab, bc, ca] = [middle(a, b), middle(b, c), middle(c, a)];
                [[*a, ab, ca], [ab, *b, bc], [ca, bc, *c], [ab, bc, ca]]
            });
            fine = cut.collect();
        }
        let whole: f64 = fine.iter().map(triangle_area).sum();
        let [few] = simplify(vec![fine.clone()], 2000).try_into().unwrap();
        assert!((800..=2000).contains(&few.len()), "{}", few.len());
        let left: f64 = few.iter().map(triangle_area).sum();
        assert!((left / whole - 1.0).abs() < 0.05, "{left} of {whole} m2");
        for [a, b, c] in &few {
            assert!([a, b, c].iter().all(|corner| (corner.coords.norm() - 0.1).abs() < 0.005));
            let outward = (b - a).cross(&(c - a)).dot(&a.coords);
            assert!(outward > 0.0, "the corners turn as before");
        }
        assert_eq!(simplify(vec![fine.clone()], fine.len()), vec![fine]);
    }

    #[test]
    fn parts_stay_apart_and_nothing_may_be_left() {
        let part = |z: f64| {
            let corner = |x: f64, y: f64| Point3::new(x, y, z);
            vec![[corner(0.0, 0.0), corner(1.0, 0.0), corner(0.0, 1.0)]]
        };
        assert_eq!(simplify(vec![part(0.0), part(0.0)], 2), vec![part(0.0), part(0.0)]);
        assert_eq!(simplify(vec![part(0.0), part(1.0)], 0), [Vec::<Triangle>::new(), Vec::new()]);
    }

    #[test]
    fn triangles_that_cannot_be_drawn_are_left_out() {
        let corner = |x: f64| Point3::new(x, 1.0, 1.0);
        let small = [corner(1.0); 3];
        assert_eq!(simplify(vec![vec![small; 9]], 3), [Vec::<Triangle>::new()], "without an area");
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let part = vec![small, [corner(0.0), corner(bad), corner(2.0)]];
            assert_eq!(simplify(vec![part], 9), [vec![small]]);
        }
        let far =
            [Point3::new(-f64::MAX, 0.0, 0.0), Point3::new(f64::MAX, 0.0, 0.0), Point3::new(0.0, 1.0, 0.0)];
        assert!(simplify(vec![vec![far; 9]], 3).concat().len() <= 3, "it ends");
    }
}
