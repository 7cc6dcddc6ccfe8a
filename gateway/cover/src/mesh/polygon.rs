//! Divides polygons into triangles whose total area is that of the polygon.

use earcut::Earcut;
use nalgebra::{Point3, Unit, Vector3};

use super::Triangle;
use crate::surface::{self, tangents};

/// The allowed difference between the area of a polygon and that of its triangles, relative to the former.
const AREA_TOLERANCE: f64 = 1e-6;

/// The maximum total area of the triangles of a polygon that is not planar, relative to the polygon's area in
/// projection. At 2.0 the triangles are tilted by 60 degrees.
const MAX_BENT_AREA_RATIO: f64 = 2.0;

/// The maximum share of a mesh's area in polygons that intersect themselves or are bent. Meshes of real robots have a
/// few such polygons, each of about a square millimetre.
const MAX_FAULTY_AREA_SHARE: f64 = 1e-3;

/// The width of a polygon, relative to its length, below which it counts as having no area.
const MAX_THIN_WIDTH_RATIO: f64 = 1e-6;

/// The triangles of all polygons of a mesh, and the errors of dividing them.
#[derive(Debug, Default)]
pub(super) struct Triangulation {
    pub(super) triangles: Vec<Triangle>,
    /// The total error in area of polygons that intersect themselves or are bent.
    off: f64,
    /// The largest of these errors, and a description of the polygon that has it.
    worst: Option<(f64, String)>,
}

impl Triangulation {
    /// Adds the triangles of a polygon with holes. The polygon need not be planar: it is projected along its mean
    /// normal (Newell's method). A polygon without an area adds no triangles.
    pub(super) fn add_polygon(&mut self, outline: &[Point3<f64>], holes: &[Vec<Point3<f64>>]) {
        if let (&[a, b, c], []) = (outline, holes) {
            self.triangles.push([a, b, c]);
            return;
        }
        let corners = outline.len() + holes.iter().map(Vec::len).sum::<usize>();
        let plane = match Plane::project_polygon(outline) {
            ProjectedPolygon::Flat(plane) => plane,
            ProjectedPolygon::Thin => return,
            ProjectedPolygon::Opposite { area } => {
                self.record_fault(area, &format!("a polygon with {corners} corners crosses itself"));
                return;
            }
        };
        let flat = plane.plane_coordinates(outline);
        let from = self.triangles.len();
        let (expected, got) = if holes.is_empty() && is_fan(&flat) {
            add_fan(outline, &mut self.triangles);
            (area(&flat), area(&flat))
        } else {
            self.cut_ears(&plane, flat, outline, holes)
        };
        let scale = plane.extent * plane.extent;
        let off = (got - expected).abs();
        if off > AREA_TOLERANCE * expected.abs() {
            let share = got / expected;
            let why = format!(
                "a polygon with {corners} corners crosses itself, and its triangles have {share:.4} times its area"
            );
            self.record_fault(off * scale, &why);
            return;
        }
        let added = self.triangles.get(from..).unwrap_or_default();
        let bent = added.iter().map(surface::triangle_area).sum::<f64>() / scale;
        if bent > MAX_BENT_AREA_RATIO * expected {
            let share = bent / expected;
            let why = format!(
                "a polygon with {corners} corners is not flat, and its triangles have {share:.4} times its area"
            );
            self.record_fault((bent - expected) * scale, &why);
        }
    }

    /// Adds the triangles of a polygon, which are found by cutting off its ears. Returns the area of the polygon in its
    /// plane, and that of the triangles.
    fn cut_ears(
        &mut self,
        plane: &Plane,
        mut flat: Vec<[f64; 2]>,
        outline: &[Point3<f64>],
        holes: &[Vec<Point3<f64>>],
    ) -> (f64, f64) {
        let mut corners = outline.to_vec();
        let mut expected = area(&flat);
        let mut starts = Vec::new();
        for hole in holes.iter().filter(|hole| hole.len() >= 3) {
            let flat_hole = plane.plane_coordinates(hole);
            expected -= area(&flat_hole).abs();
            starts.push(flat.len());
            flat.extend(flat_hole);
            corners.extend(hole);
        }
        let mut ears: Vec<usize> = Vec::new();
        Earcut::new().earcut(flat.iter().copied(), &starts, &mut ears);
        let mut got = 0.0;
        for ear in ears.as_chunks::<3>().0 {
            let [Some(a), Some(b), Some(c)] = ear.map(|index| Some((flat.get(index)?, *corners.get(index)?)))
            else {
                continue;
            };
            let area = area(&[*a.0, *b.0, *c.0]);
            got += area.abs();
            self.triangles.push(if area < 0.0 { [a.1, c.1, b.1] } else { [a.1, b.1, c.1] });
        }
        (expected, got)
    }

    fn record_fault(&mut self, off: f64, why: &str) {
        self.off += off;
        if self.worst.as_ref().is_none_or(|(worst, _)| off > *worst) {
            self.worst = Some((off, why.to_owned()));
        }
    }

    /// Returns all triangles. Returns a description of the worst polygon instead, if too much of the area is in
    /// polygons that intersect themselves or are bent.
    pub(super) fn finish(self) -> Result<Vec<Triangle>, String> {
        let whole: f64 = self.triangles.iter().map(surface::triangle_area).sum();
        match self.worst {
            Some((_, why)) if self.off.is_nan() || self.off > MAX_FAULTY_AREA_SHARE * whole => {
                Err(format!("{why}: triangulate it in the program in which it was drawn"))
            }
            _ => Ok(self.triangles),
        }
    }
}

/// Adds a triangle for each edge of a convex polygon: the edge and the first corner.
pub(super) fn add_fan(corners: &[Point3<f64>], triangles: &mut Vec<Triangle>) {
    if let [first, rest @ ..] = corners {
        triangles.extend(rest.windows(2).filter_map(|edge| match *edge {
            [a, b] => Some([*first, a, b]),
            _ => None,
        }));
    }
}

/// The result of projecting a polygon along its mean normal.
enum ProjectedPolygon {
    Flat(Plane),
    /// The polygon has no area.
    Thin,
    /// Parts of the polygon have opposite winding, so that their areas cancel. The value is about the largest possible
    /// area.
    Opposite {
        area: f64,
    },
}

/// The plane in which the projection of a polygon is largest. Lengths in it are relative to the size of the polygon.
struct Plane {
    origin: Point3<f64>,
    axes: (Vector3<f64>, Vector3<f64>),
    extent: f64,
}

impl Plane {
    fn project_polygon(outline: &[Point3<f64>]) -> ProjectedPolygon {
        let [origin, ..] = *outline else { return ProjectedPolygon::Thin };
        let far = |point: &Point3<f64>| (point - origin).norm();
        let farthest = outline.iter().max_by(|a, b| far(a).total_cmp(&far(b))).unwrap_or(&origin);
        let extent = far(farthest);
        let from = |point: &Point3<f64>| (point - origin) / extent;
        let along = from(farthest);
        let width = outline.iter().map(|point| from(point).cross(&along).norm()).fold(0.0, f64::max);
        if width < MAX_THIN_WIDTH_RATIO || !along.norm().is_finite() {
            return ProjectedPolygon::Thin;
        }
        let next = outline.iter().cycle().skip(1);
        let normal: Vector3<f64> = outline.iter().zip(next).map(|(a, b)| from(a).cross(&from(b))).sum();
        match Unit::try_new(normal, MAX_THIN_WIDTH_RATIO * width) {
            Some(normal) => ProjectedPolygon::Flat(Self { origin, axes: tangents(&normal), extent }),
            None => ProjectedPolygon::Opposite { area: width * extent * extent },
        }
    }

    /// Returns the coordinates of points in the plane. The polygon is counterclockwise in these.
    fn plane_coordinates(&self, corners: &[Point3<f64>]) -> Vec<[f64; 2]> {
        let Self { origin, axes: (x, y), extent } = self;
        let flat = |corner: &Point3<f64>| {
            let from = (corner - origin) / *extent;
            [from.dot(x), from.dot(y)]
        };
        corners.iter().map(flat).collect()
    }
}

/// Returns the signed area of the triangle from one point to two others.
fn signed_triangle_area([x, y]: [f64; 2], [ax, ay]: [f64; 2], [bx, by]: [f64; 2]) -> f64 {
    ((ax - x) * (by - y) - (bx - x) * (ay - y)) / 2.0
}

/// Returns the area of a polygon: positive if it is counterclockwise, negative if it is clockwise.
fn area(polygon: &[[f64; 2]]) -> f64 {
    let [first, rest @ ..] = polygon else { return 0.0 };
    rest.windows(2)
        .map(|edge| if let &[a, b] = edge { signed_triangle_area(*first, a, b) } else { 0.0 })
        .sum()
}

/// Returns true if the triangles from the first corner cover exactly the polygon: all of them have the winding of the
/// polygon, and their angles at that corner add up to less than half a turn.
fn is_fan(polygon: &[[f64; 2]]) -> bool {
    let ([first, second, .., last], [_, rest @ ..]) = (polygon, polygon) else { return false };
    let runs_on = rest.windows(2).all(|edge| match *edge {
        [a, b] => signed_triangle_area(*first, a, b) >= 0.0,
        _ => false,
    });
    let turns: f64 =
        rest.windows(2).map(|edge| if let &[a, b] = edge { angle_between(*first, a, b) } else { 0.0 }).sum();
    runs_on && signed_triangle_area(*first, *second, *last) >= 0.0 && turns < core::f64::consts::PI
}

/// Returns the angle between the directions from one point to two others, in rad. Returns 0 if one of them is the point
/// itself.
fn angle_between([x, y]: [f64; 2], [ax, ay]: [f64; 2], [bx, by]: [f64; 2]) -> f64 {
    let ([ax, ay], [bx, by]) = ([ax - x, ay - y], [bx - x, by - y]);
    (ax * by - ay * bx).atan2(ax * bx + ay * by).abs()
}

#[cfg(test)]
mod tests {
    use core::f64::consts::TAU;

    use nalgebra::{Rotation3, Translation3};
    use proptest::prelude::*;

    use super::*;

    fn filled(outline: &[[f64; 2]], holes: &[Vec<[f64; 2]>]) -> Result<Vec<Triangle>, String> {
        // The polygon is not parallel to an axis, and is far from the origin compared with its size.
        let pose = Translation3::new(3.0, -2.0, 1.0) * Rotation3::from_euler_angles(0.4, 1.1, -2.0);
        let points = |ring: &[[f64; 2]]| -> Vec<Point3<f64>> {
            ring.iter().map(|&[x, y]| pose * Point3::new(x, y, 0.0)).collect()
        };
        let holes: Vec<_> = holes.iter().map(|hole| points(hole)).collect();
        let mut filled = Triangulation::default();
        filled.add_polygon(&points(outline), &holes);
        let triangles = filled.finish()?;
        Ok(triangles.iter().map(|triangle| triangle.map(|corner| pose.inverse() * corner)).collect())
    }

    fn total(triangles: &[Triangle]) -> f64 {
        triangles.iter().map(surface::triangle_area).sum()
    }

    fn is_inside([x, y]: [f64; 2], polygon: &[[f64; 2]]) -> bool {
        let edges = polygon.iter().zip(polygon.iter().cycle().skip(1));
        let crosses = |&(&[ax, ay], &[bx, by]): &(&[f64; 2], &[f64; 2])| {
            (ay > y) != (by > y) && x < ax + (y - ay) / (by - ay) * (bx - ax)
        };
        edges.filter(crosses).count() % 2 == 1
    }

    const NOTCHED: [[f64; 2]; 5] = [[0.0, 0.0], [0.3, 0.0], [0.3, 0.25], [0.15, 0.05], [0.0, 0.25]];

    #[test]
    fn a_notch_is_no_surface_wherever_the_corners_begin() {
        for start in 0..5 {
            let mut outline = NOTCHED;
            outline.rotate_left(start);
            for mirrored in [false, true] {
                if mirrored {
                    outline.reverse();
                }
                let triangles = filled(&outline, &[]).unwrap();
                assert_eq!(triangles.len(), 3);
                assert!((total(&triangles) - 0.045).abs() < 1e-12, "{start}: {triangles:?}");
                // The triangles must have the winding of the polygon.
                let up: Vector3<f64> = triangles.iter().map(|[a, b, c]| (b - a).cross(&(c - a))).sum();
                assert_eq!(up.z < 0.0, mirrored);
            }
        }
    }

    #[test]
    fn holes_are_left_out() {
        let square = |half: f64, [x, y]: [f64; 2]| {
            vec![[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]]
        };
        let mut turned = square(0.1, [0.4, 0.3]);
        turned.reverse();
        let holes = [square(0.2, [-0.5, 0.0]), turned];
        let triangles = filled(&square(1.0, [0.0; 2]), &holes).unwrap();
        assert!((total(&triangles) - (4.0 - 0.16 - 0.04)).abs() < 1e-12, "{}", total(&triangles));
        // The hole is outside the polygon.
        let outside = filled(&square(1.0, [0.0; 2]), &[square(0.5, [3.0, 0.0])]).unwrap_err();
        assert!(
            outside.starts_with("a polygon with 8 corners crosses itself, and its triangles"),
            "{outside}"
        );
    }

    #[test]
    fn polygons_that_cross_themselves_are_refused_unless_next_to_nothing() {
        let even = filled(&[[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]], &[]).unwrap_err();
        assert!(even.starts_with("a polygon with 4 corners crosses itself: triangulate"), "{even}");
        let uneven = filled(&[[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 1.0]], &[]).unwrap_err();
        assert!(uneven.contains("corners crosses itself, and its triangles have"), "{uneven}");
        let star: Vec<_> =
            (0..5).map(|at| f64::from(at) * TAU * 0.4).map(|it| [it.cos(), it.sin()]).collect();
        assert!(filled(&star, &[]).unwrap_err().contains("5 corners crosses itself"));
        let mut filled = Triangulation::default();
        let corner = |&[x, y]: &[f64; 2]| Point3::new(x, y, 0.0);
        filled.add_polygon(&[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].each_ref().map(corner), &[]);
        filled.add_polygon(&[[0.0, 0.0], [0.01, 0.01], [0.01, 0.0], [0.0, 0.01]].each_ref().map(corner), &[]);
        assert!((total(&filled.finish().unwrap()) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn polygons_that_are_folded_are_refused() {
        let folded = |lift: f64| {
            let mut filled = Triangulation::default();
            let corner = |[x, y, z]: [f64; 3]| Point3::new(x, y, z);
            filled.add_polygon(
                &[[0.0, 0.0, 0.0], [1.0, 0.0, lift], [1.0, 1.0, 0.0], [0.0, 1.0, lift]].map(corner),
                &[],
            );
            filled.finish()
        };
        assert!(folded(0.2).is_ok());
        assert!(folded(4.0).unwrap_err().starts_with("a polygon with 4 corners is not flat"));
    }

    #[test]
    fn polygons_without_an_area_have_no_triangles() {
        for outline in [&[][..], &[[1.0, 1.0]], &[[0.0, 0.0], [1.0, 0.0]], &[[0.5, 0.5]; 7]] {
            assert_eq!(filled(outline, &[]).unwrap(), Vec::<Triangle>::new());
        }
        assert_eq!(filled(&[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]], &[]).unwrap().len(), 0);
    }

    proptest! {
        /// A star-shaped polygon has its corners in different directions from its center.
        #[test]
        fn triangles_of_any_star_have_its_area_and_are_inside(
            arms in proptest::collection::vec(0.05..1.0_f64, 3..40), start in any::<prop::sample::Index>(),
        ) {
            let turn = TAU / f64::from(u32::try_from(arms.len()).unwrap());
            let mut outline: Vec<_> = (0_u32..)
                .map(|at| (f64::from(at) * turn).sin_cos()).zip(&arms)
                .map(|((sin, cos), arm)| [arm * cos, arm * sin]).collect();
            let start = start.index(outline.len());
            outline.rotate_left(start);
            let triangles = filled(&outline, &[]).unwrap();
            prop_assert_eq!(triangles.len(), outline.len() - 2);
            let own = area(&outline);
            prop_assert!((total(&triangles) - own).abs() < 1e-9 * own, "{} {own}", total(&triangles));
            for [a, b, c] in triangles {
                let middle = (a.coords + b.coords + c.coords) / 3.0;
                if surface::triangle_area(&[a, b, c]) > 1e-6 {
                    prop_assert!(is_inside([middle.x, middle.y], &outline));
                }
            }
        }

        #[test]
        fn no_polygon_stops_the_program(
            corners in proptest::collection::vec(proptest::array::uniform3(-1.0..1.0_f64), 0..12),
            hole in proptest::collection::vec(proptest::array::uniform3(-1.0..1.0_f64), 0..6),
        ) {
            let points = |corners: Vec<[f64; 3]>| -> Vec<_> { corners.into_iter().map(Point3::from).collect() };
            let mut filled = Triangulation::default();
            filled.add_polygon(&points(corners), &[points(hole)]);
            let _ = filled.finish().is_ok();
        }
    }
}
