//! A tree of bounding boxes around triangles, for rays and for the nearest triangle.
//!
//! Existing crates either need a newer compiler than this workspace (`bvh`), or depend on another vector crate and
//! twenty more (`parry3d`). This module is all that is needed here.

use nalgebra::{Point3, Vector3};

use crate::mesh::Triangle;

const MAX_LEAF_TRIANGLES: usize = 4;

/// A bounding box.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BoundingBox {
    pub(crate) min: Point3<f64>,
    pub(crate) max: Point3<f64>,
}

impl BoundingBox {
    fn enclosing<'a>(points: impl Iterator<Item = &'a Point3<f64>>) -> Self {
        let empty = Self {
            min: Point3::from(Vector3::repeat(f64::INFINITY)),
            max: Point3::from(Vector3::repeat(f64::NEG_INFINITY)),
        };
        points.fold(empty, |bounds, point| Self { min: bounds.min.inf(point), max: bounds.max.sup(point) })
    }

    /// Returns the distance of a point from the box, in m; 0 inside.
    fn distance(&self, point: &Point3<f64>) -> f64 {
        (point.sup(&self.min).inf(&self.max) - point).norm()
    }

    /// Returns the position at which a ray enters the box, if it is before `until`.
    fn entry_position(&self, ray: &Ray, until: f64) -> Option<f64> {
        let near = (self.min - ray.origin).component_mul(&ray.inverse);
        let far = (self.max - ray.origin).component_mul(&ray.inverse);
        // `f64::min` and `max` prefer a number to the NaN of a ray that lies in a side of the box.
        let (mut enter, mut leave) = (0.0_f64, until);
        for (&a, &b) in near.iter().zip(far.iter()) {
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter <= leave).then_some(enter)
    }
}

/// A ray. Lengths along it are in m if its direction is a unit vector.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ray {
    origin: Point3<f64>,
    direction: Vector3<f64>,
    inverse: Vector3<f64>,
}

impl Ray {
    pub(crate) fn new(origin: Point3<f64>, direction: Vector3<f64>) -> Self {
        Self { origin, direction, inverse: direction.map(f64::recip) }
    }

    /// Returns the position at which the ray meets a triangle, from either side (Möller and Trumbore).
    fn intersect_triangle(&self, [a, b, c]: &Triangle) -> Option<f64> {
        // Rays through an edge between two triangles must hit at least one of them.
        const EDGE_MARGIN: f64 = 1e-9;
        let (ab, ac) = (b - a, c - a);
        let p = self.direction.cross(&ac);
        let inverse = ab.dot(&p).recip();
        let from = self.origin - a;
        let u = from.dot(&p) * inverse;
        let q = from.cross(&ab);
        let v = self.direction.dot(&q) * inverse;
        let at = ac.dot(&q) * inverse;
        (u >= -EDGE_MARGIN && v >= -EDGE_MARGIN && u + v <= 1.0 + EDGE_MARGIN && at >= 0.0 && at.is_finite())
            .then_some(at)
    }
}

#[derive(Clone, Copy, Debug)]
enum NodeKind {
    /// The range of triangles.
    Leaf(usize, usize),
    /// The two child nodes.
    Fork(usize, usize),
}

/// Triangles with queries for the first one that a ray meets, and for those near a point.
#[derive(Clone, Debug)]
pub(crate) struct TriangleTree {
    /// The nodes; the root comes first.
    nodes: Vec<(BoundingBox, NodeKind)>,
    /// The triangles in the order of the leaves.
    triangles: Vec<Triangle>,
}

impl TriangleTree {
    pub(crate) fn new(mut triangles: Vec<Triangle>) -> Self {
        let count = triangles.len();
        let mut nodes = Vec::new();
        // Each split halves the triangles, so the depth of the tree is the logarithm of their number.
        let mut open = vec![(0, count, None)];
        while let Some((from, to, place)) = open.pop() {
            let Some(part) = triangles.get_mut(from..to).filter(|part| !part.is_empty()) else { continue };
            let bounds = BoundingBox::enclosing(part.iter().flatten());
            let node = nodes.len();
            nodes.push((bounds, NodeKind::Leaf(from, to)));
            // The parent stores the index of its second child; the first one follows the parent directly.
            if let Some((_, NodeKind::Fork(_, second))) =
                place.and_then(|parent: usize| nodes.get_mut(parent))
            {
                *second = node;
            }
            if to - from <= MAX_LEAF_TRIANGLES {
                continue;
            }
            let axis = (bounds.max - bounds.min).imax();
            let middle = (to - from) / 2;
            let key = |triangle: &Triangle| -> f64 {
                triangle.iter().map(|corner| corner.coords.get(axis).copied().unwrap_or_default()).sum()
            };
            part.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)));
            if let Some((_, kind)) = nodes.get_mut(node) {
                *kind = NodeKind::Fork(node + 1, node + 1);
            }
            open.push((from + middle, to, Some(node)));
            open.push((from, from + middle, None));
        }
        Self { nodes, triangles }
    }

    pub(crate) fn triangles(&self) -> &[Triangle] {
        &self.triangles
    }

    pub(crate) fn triangle(&self, index: usize) -> Option<&Triangle> {
        self.triangles.get(index)
    }

    fn leaf_triangles(&self, from: usize, to: usize) -> impl Iterator<Item = (usize, &Triangle)> {
        (from..to).zip(self.triangles.get(from..to).unwrap_or_default())
    }

    /// Returns true if a ray meets a triangle within `until`.
    pub(crate) fn blocks_ray(&self, ray: &Ray, until: f64) -> bool {
        self.find_hit(ray, until, true).is_some()
    }

    /// Returns the position at which a ray first meets a triangle within `until`, and the index of the triangle.
    pub(crate) fn first_hit(&self, ray: &Ray, until: f64) -> Option<(f64, usize)> {
        self.find_hit(ray, until, false)
    }

    /// Returns the first triangle that a ray meets within `until`; with `any`, the first one found.
    fn find_hit(&self, ray: &Ray, until: f64, any: bool) -> Option<(f64, usize)> {
        let mut best = None;
        let mut until = until;
        let mut open = vec![0];
        while let Some(node) = open.pop() {
            let Some((bounds, kind)) = self.nodes.get(node) else { continue };
            if bounds.entry_position(ray, until).is_none() {
                continue;
            }
            match *kind {
                NodeKind::Fork(first, second) => open.extend([second, first]),
                NodeKind::Leaf(from, to) => {
                    for (index, triangle) in self.leaf_triangles(from, to) {
                        if let Some(at) = ray.intersect_triangle(triangle).filter(|&at| at <= until) {
                            until = at;
                            best = Some((at, index));
                            if any {
                                return best;
                            }
                        }
                    }
                }
            }
        }
        best
    }

    /// Returns true if a triangle is closer to a point than `within`, in m.
    pub(crate) fn is_near(&self, point: &Point3<f64>, within: f64) -> bool {
        let mut open = vec![0];
        while let Some(node) = open.pop() {
            let Some((bounds, kind)) = self.nodes.get(node) else { continue };
            if bounds.distance(point) > within {
                continue;
            }
            match *kind {
                NodeKind::Fork(first, second) => open.extend([first, second]),
                NodeKind::Leaf(from, to) => {
                    if self
                        .leaf_triangles(from, to)
                        .any(|(_, triangle)| distance_to_triangle(point, triangle) < within)
                    {
                        return true;
                    }
                }
            }
        }
        false
    }
}

/// Returns the distance of a point from a triangle, in m.
pub(crate) fn distance_to_triangle(point: &Point3<f64>, &[a, b, c]: &Triangle) -> f64 {
    let edge = |from: Point3<f64>, to: Point3<f64>| {
        let along = to - from;
        let share = (point - from).dot(&along) / along.norm_squared();
        // An edge without a length is treated as a point.
        let share = if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 };
        (point - (from + along * share)).norm()
    };
    let nearest = edge(a, b).min(edge(b, c)).min(edge(c, a));
    let normal = (b - a).cross(&(c - a));
    let above = |from: Point3<f64>, to: Point3<f64>| normal.cross(&(to - from)).dot(&(point - from)) >= 0.0;
    let height = (point - a).dot(&normal).abs() / normal.norm();
    if above(a, b) && above(b, c) && above(c, a) && height.is_finite() { height } else { nearest }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn point() -> impl Strategy<Value = Point3<f64>> {
        proptest::array::uniform3(-1.0..1.0).prop_map(Point3::from)
    }

    fn triangles() -> impl Strategy<Value = Vec<Triangle>> {
        let triangle = (point(), point(), point()).prop_map(|(a, b, c)| {
            // The triangles are small, so that some rays miss.
            [a, a + (b - Point3::origin()) * 0.3, a + (c - Point3::origin()) * 0.3]
        });
        proptest::collection::vec(triangle, 0..60)
    }

    proptest! {
        #[test]
        fn the_tree_answers_as_all_triangles_one_by_one(
            triangles in triangles(), from in point(), to in point(), until in 0.0..3.0_f64,
        ) {
            prop_assume!((to - from).norm() > 1e-3);
            let ray = Ray::new(from, (to - from).normalize());
            let tree = TriangleTree::new(triangles.clone());
            prop_assert_eq!(tree.triangles().len(), triangles.len());
            let hits = triangles.iter().filter_map(|triangle| ray.intersect_triangle(triangle));
            let first = hits.filter(|&at| at <= until).min_by(f64::total_cmp);
            prop_assert_eq!(tree.first_hit(&ray, until).map(|(at, _)| at), first);
            prop_assert_eq!(tree.blocks_ray(&ray, until), first.is_some());
            let nearest = triangles.iter().map(|triangle| distance_to_triangle(&from, triangle)).min_by(f64::total_cmp);
            prop_assert_eq!(tree.is_near(&from, until), nearest.is_some_and(|nearest| nearest < until));
        }

        #[test]
        fn no_point_of_a_triangle_is_nearer_than_its_distance(
            (a, b, c) in (point(), point(), point()), from in point(), u in 0.0..1.0_f64, v in 0.0..1.0_f64,
        ) {
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            let on = a + (b - a) * u + (c - a) * v;
            prop_assert!(distance_to_triangle(&from, &[a, b, c]) <= (from - on).norm() + 1e-12);
            prop_assert!(distance_to_triangle(&on, &[a, b, c]) < 1e-9);
        }
    }

    #[test]
    fn triangles_without_an_area_stop_no_ray() {
        let point = Point3::new(0.0, 0.0, 1.0);
        let tree = TriangleTree::new(vec![[point; 3]; 10]);
        assert!(!tree.blocks_ray(&Ray::new(Point3::origin(), Vector3::z()), 9.0));
        assert!(tree.is_near(&Point3::origin(), 1.5));
        assert!(!tree.is_near(&Point3::origin(), 0.5));
    }
}
