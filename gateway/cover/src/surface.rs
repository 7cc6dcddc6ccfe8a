//! Finds the outer surface of a link, and represents it by samples.

use core::f64::consts::{PI, TAU};

use nalgebra::{Isometry3, Matrix3, Point3, Unit, Vector3};

use crate::grid::PointGrid;
use crate::mesh::{Affine, MAX_TRIANGLES, Triangle};
use crate::tree::{Ray, TriangleTree};
use crate::{CoverError, CoverOptions, KeepOut, RobotLink};

/// The number of samples on the area of a cell.
const SAMPLES_PER_CELL: f64 = 64.0;

/// The maximum area of the triangles of a link, as a number of cells.
const MAX_CELLS: usize = 6000;

/// The minimum number of samples, so that the measures of a small link are precise enough.
const MIN_SAMPLES: f64 = 2000.0;

/// The number of rays that are cast from each side of the surface at a sample point. No more are cast if the first
/// [`MIN_RAYS_PER_TEST`] agree.
const RAYS_PER_TEST: u32 = 32;
const MIN_RAYS_PER_TEST: u32 = 8;

/// The minimum share of rays that leave the link, for a side that counts as outer surface. Through a screw hole a
/// smaller share leaves; from between the arms of a fork a larger one.
const MIN_ESCAPING_RAY_SHARE: f64 = 0.3;

/// The maximum share of rays that leave another link from its inside, through gaps of its mesh.
const MAX_LEAKING_RAY_SHARE: f64 = 0.1;

/// The minimum share of rays that leave the whole robot from a side on which cells are placed. A smaller share leaves
/// only through the gap between two links, where nothing can touch a cell.
const MIN_REACHED_RAY_SHARE: f64 = 0.05;

/// The number of rays by which [`MIN_REACHED_RAY_SHARE`] is tested. Further rays are not cast if half of the first
/// [`MIN_RAYS_PER_TEST`] leave.
const REACH_TEST_RAYS: u32 = 128;

/// The height above the surface from which rays start, in pitches.
const RAY_START_HEIGHT_PITCHES: f64 = 1e-3;

/// The distance up to which other links hide a surface from rays, in pitches.
const LINK_HIDING_DISTANCE_PITCHES: f64 = 2.0;

/// The minimum share of the disc below a cell that must be surface of a similar direction. The share is about a half at
/// a straight edge, and near zero on the rim of a sheet.
const MIN_SUPPORT_SHARE: f64 = 0.4;

/// A point of the outer surface. Each sample represents the same area.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    pub(crate) point: Point3<f64>,
    /// The outward normal of the triangle on which the point is.
    pub(crate) face: Vector3<f64>,
    /// The mean outward normal of the surface that a cell at this point would cover.
    pub(crate) smooth: Vector3<f64>,
    /// True if a cell may be placed at the point.
    pub(crate) free: bool,
}

/// The outer surface of a link, in the frame of the link.
#[derive(Debug)]
pub(crate) struct Surface<'a> {
    own: TriangleTree,
    others: TriangleTree,
    keep_out: Vec<&'a KeepOut>,
    clearance: f64,
    pitch: f64,
    pub(crate) samples: Vec<Sample>,
    /// The area that each sample represents, in m².
    pub(crate) share: f64,
}

/// Returns the area of a hexagonal cell, in m².
pub(crate) fn cell_area(pitch: f64) -> f64 {
    pitch * pitch * 0.75_f64.sqrt()
}

impl<'a> Surface<'a> {
    /// Finds the outer surface of one of the links, and samples it.
    pub(crate) fn new(
        index: usize,
        links: &[RobotLink],
        others: &[RobotLink],
        options: &'a CoverOptions,
    ) -> Result<Self, CoverError> {
        let mut own = Vec::new();
        let mut obstacles = Vec::new();
        let frame = links.get(index).map_or_else(Isometry3::identity, |link| link.pose.inverse());
        for (other, link) in links.iter().chain(others).enumerate() {
            if other == index {
                collect_link_triangles(link, &Isometry3::identity(), &mut own)?;
            } else {
                collect_link_triangles(link, &(frame * link.pose), &mut obstacles)?;
            }
        }
        remove_duplicates(&mut own);
        let pitch = options.pitch;
        let area: f64 = own.iter().map(triangle_area).sum();
        let cells = area / cell_area(pitch);
        if cells.is_nan() || cells > count_to_f64(MAX_CELLS) {
            let link = links.get(index).map_or_else(String::new, |link| link.name.clone());
            return Err(CoverError::TooLarge { link, area, cells, pitch, most: MAX_CELLS });
        }
        let mut surface = Self {
            own: TriangleTree::new(own),
            others: TriangleTree::new(obstacles),
            keep_out: options.keep_out.iter().filter(|keep_out| keep_out.link == index).collect(),
            clearance: options.clearance,
            pitch,
            samples: Vec::new(),
            share: 0.0,
        };
        if area > 0.0 {
            surface.sample_triangles(area, (cells * SAMPLES_PER_CELL).max(MIN_SAMPLES));
            surface.smooth_normals();
        }
        Ok(surface)
    }

    /// Samples all triangles with equal density, and keeps the samples on the outer surface.
    fn sample_triangles(&mut self, area: f64, count: f64) {
        self.share = area / count;
        // The first sample is placed in the middle of its share, so that rounding errors do not add a sample at the
        // end.
        let mut due = -0.5;
        let mut taken = 0;
        for &triangle in self.own.triangles() {
            due += triangle_area(&triangle) / self.share;
            let [a, b, c] = triangle;
            let Some(face) = triangle_normal(&triangle) else { continue };
            while due > 0.0 {
                due -= 1.0;
                taken += 1;
                let (mut u, mut v) = quasirandom_point(taken);
                if u + v > 1.0 {
                    (u, v) = (1.0 - u, 1.0 - v);
                }
                let point = a + (b - a) * u + (c - a) * v;
                if let Some(face) = self.outward_normal(&point, &face) {
                    let free = self.allows_cell_at(&point);
                    self.samples.push(Sample { point, face, smooth: face, free });
                }
            }
        }
    }

    /// Returns the outward normal at a point of a triangle whose normal is `face`. Returns `None` if the point is not
    /// on the outer surface.
    fn outward_normal(&self, point: &Point3<f64>, face: &Vector3<f64>) -> Option<Vector3<f64>> {
        let front = self.escaping_ray_share(point, face);
        // Both sides of a thin sheet are outer sides. The side from which more rays leave is chosen, and the front if
        // both are equal.
        let back = if front < 0.95 { self.escaping_ray_share(point, &-face) } else { 0.0 };
        let (side, share) = if back > front { (-face, back) } else { (*face, front) };
        let is_outer = share >= MIN_ESCAPING_RAY_SHARE
            && !self.is_inside_other_link(&(point + side * (RAY_START_HEIGHT_PITCHES * self.pitch)))
            && self.is_touchable(point, &side);
        is_outer.then_some(side)
    }

    /// Returns the share of rays that leave the link from just above a point. Rays are weighted by the cosine of the
    /// angle to the normal.
    fn escaping_ray_share(&self, point: &Point3<f64>, side: &Vector3<f64>) -> f64 {
        let rays = self.ray_generator(point, side);
        share_of_rays(|ray| self.ray_escapes(&rays(*ray), LINK_HIDING_DISTANCE_PITCHES * self.pitch))
    }

    /// Returns true if something could touch the point from this side, because enough rays leave the robot.
    fn is_touchable(&self, point: &Point3<f64>, side: &Vector3<f64>) -> bool {
        let rays = self.ray_generator(point, side);
        let leaves = |ray: &u32| self.ray_escapes(&rays(*ray), f64::INFINITY);
        let few = count_rays((0..MIN_RAYS_PER_TEST).filter(leaves));
        if 2 * few >= MIN_RAYS_PER_TEST {
            return true;
        }
        let mut needed = (MIN_REACHED_RAY_SHARE * f64::from(REACH_TEST_RAYS)).ceil() - f64::from(few);
        let left = (MIN_RAYS_PER_TEST..REACH_TEST_RAYS).filter(leaves).find(|_| {
            needed -= 1.0;
            needed <= 0.0
        });
        needed <= 0.0 || left.is_some()
    }

    /// Returns a function that creates a ray from its number. The rays start just above a point; their density is
    /// proportional to the cosine of the angle to the normal.
    fn ray_generator(&self, point: &Point3<f64>, side: &Vector3<f64>) -> impl Fn(u32) -> Ray {
        let origin = point + side * (RAY_START_HEIGHT_PITCHES * self.pitch);
        let ((s, t), side) = (tangents(side), *side);
        move |ray| {
            let (u, v) = quasirandom_point(ray);
            let (radius, (sin, cos)) = (u.sqrt(), (TAU * v).sin_cos());
            Ray::new(origin, s * (radius * cos) + t * (radius * sin) + side * (1.0 - u).sqrt())
        }
    }

    /// Returns true if a ray hits neither the link itself nor, within the distance `until` in m, another link.
    fn ray_escapes(&self, ray: &Ray, until: f64) -> bool {
        !self.own.blocks_ray(ray, f64::INFINITY) && !self.others.blocks_ray(ray, until)
    }

    fn is_inside_other_link(&self, point: &Point3<f64>) -> bool {
        let mut leaking = 0;
        for ray in 0..RAYS_PER_TEST {
            let (u, v) = quasirandom_point(ray);
            let (height, (sin, cos)) = (2.0 * u - 1.0, (TAU * v).sin_cos());
            let radius = (1.0 - height * height).sqrt();
            let ray = Ray::new(*point, Vector3::new(radius * cos, radius * sin, height));
            if !self.others.blocks_ray(&ray, f64::INFINITY) {
                leaking += 1;
            }
            if f64::from(leaking) > MAX_LEAKING_RAY_SHARE * f64::from(RAYS_PER_TEST) {
                return false;
            }
        }
        true
    }

    /// Returns true if cells are allowed at a point, because it is in no keep-out box and far enough from other links.
    fn allows_cell_at(&self, point: &Point3<f64>) -> bool {
        !self.is_in_keep_out_box(point) && !self.others.is_near(point, self.clearance)
    }

    /// Returns true if a point is in a keep-out box.
    pub(crate) fn is_in_keep_out_box(&self, point: &Point3<f64>) -> bool {
        let inside = |keep_out: &&KeepOut| {
            let sides = keep_out.min.iter().zip(&keep_out.max);
            sides.zip(point.iter()).all(|((min, max), at)| (min..=max).contains(&at))
        };
        self.keep_out.iter().any(inside)
    }

    /// Computes the mean normal around each sample, and checks that a cell there would have enough surface below it.
    fn smooth_normals(&mut self) {
        let radius = self.pitch / 2.0;
        let grid = PointGrid::with_points(radius, self.samples.iter().map(|sample| &sample.point));
        let min = MIN_SUPPORT_SHARE * PI * radius * radius / self.share;
        let mut smoothed = Vec::new();
        for (cube, members) in grid.filled_cubes() {
            let near: Vec<_> = grid.points_around(cube).filter_map(|index| self.samples.get(index)).collect();
            for &member in members {
                let Some(sample) = self.samples.get(member) else { continue };
                let mut sum = Vector3::zeros();
                let mut support = 0_u32;
                for other in &near {
                    if other.face.dot(&sample.face) > 0.5 && (other.point - sample.point).norm() <= radius {
                        sum += other.face;
                        support += 1;
                    }
                }
                let mean = Unit::try_new(sum, 0.0).map_or(sample.face, Unit::into_inner);
                smoothed.push((member, mean, f64::from(support) >= min));
            }
        }
        for (member, mean, supported) in smoothed {
            if let Some(sample) = self.samples.get_mut(member) {
                sample.smooth = mean;
                sample.free &= supported;
            }
        }
    }

    /// Returns the point of the mesh directly above or below `point`, and the outward normal of the mesh there. Returns
    /// `None` if no cell may be placed there.
    pub(crate) fn project_to_mesh(
        &self,
        point: &Point3<f64>,
        sample: &Sample,
    ) -> Option<(Point3<f64>, Vector3<f64>)> {
        let up = sample.smooth;
        let reach = self.pitch / 4.0;
        let origin = point + up * ((sample.point - point).dot(&up) + reach);
        let (at, triangle) = self.own.first_hit(&Ray::new(origin, -up), 2.0 * reach)?;
        let point = origin - up * at;
        let face = self.outward_normal(&point, &triangle_normal(self.own.triangle(triangle)?)?)?;
        (face.dot(&up) > 0.0 && self.allows_cell_at(&point)).then_some((point, face))
    }
}

/// Returns the share of rays for which `escapes` is true. Only the first [`MIN_RAYS_PER_TEST`] rays are cast if they
/// all agree.
fn share_of_rays(escapes: impl Fn(&u32) -> bool) -> f64 {
    let few = count_rays((0..MIN_RAYS_PER_TEST).filter(&escapes));
    if few == 0 || few == MIN_RAYS_PER_TEST {
        return f64::from(few) / f64::from(MIN_RAYS_PER_TEST);
    }
    f64::from(few + count_rays((MIN_RAYS_PER_TEST..RAYS_PER_TEST).filter(&escapes)))
        / f64::from(RAYS_PER_TEST)
}

/// Counts the rays of an iterator.
fn count_rays(rays: impl Iterator<Item = u32>) -> u32 {
    rays.fold(0, |count, _| count + 1)
}

/// Returns the point with this number of a sequence (by Roberts) whose beginnings are all distributed evenly over the
/// unit square.
fn quasirandom_point(index: u32) -> (f64, f64) {
    let at = f64::from(index);
    ((0.5 + at * 0.754_877_666_246_692_8).fract(), (0.5 + at * 0.569_840_290_998_053_3).fract())
}

/// Returns two unit vectors that are perpendicular to a unit vector and to each other.
pub(crate) fn tangents(normal: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let mut axis = Vector3::zeros();
    if let Some(smallest) = axis.get_mut(normal.iamin()) {
        *smallest = 1.0;
    }
    let s = normal.cross(&axis).normalize();
    (s, normal.cross(&s))
}

pub(crate) fn triangle_area([a, b, c]: &Triangle) -> f64 {
    (b - a).cross(&(c - a)).norm() / 2.0
}

/// Returns the unit normal of a triangle; `None` for a triangle without an area.
pub(crate) fn triangle_normal([a, b, c]: &Triangle) -> Option<Vector3<f64>> {
    Unit::try_new((b - a).cross(&(c - a)), 0.0).map(Unit::into_inner)
}

/// Adds the triangles of a link, in a frame in which the link has the pose `pose`.
fn collect_link_triangles(
    link: &RobotLink,
    pose: &Isometry3<f64>,
    triangles: &mut Vec<Triangle>,
) -> Result<(), CoverError> {
    let count = link.parts.iter().map(|part| part.mesh.triangles().len()).sum();
    if count > MAX_TRIANGLES {
        return Err(CoverError::Triangles { link: link.name.clone(), count });
    }
    for (index, part) in link.parts.iter().enumerate() {
        let pose = pose * part.pose;
        let map = Affine {
            linear: pose.rotation.to_rotation_matrix().into_inner()
                * Matrix3::from_diagonal(&Vector3::from(part.scale)),
            shift: pose.translation.vector,
        };
        let from = triangles.len();
        triangles.extend(part.mesh.triangles().iter().map(|triangle| map.map(triangle)));
        let new = triangles.get(from..).unwrap_or_default();
        if new.iter().flatten().any(|corner| corner.iter().any(|value| !value.is_finite())) {
            return Err(CoverError::NotFinite { link: link.name.clone(), part: index, scale: part.scale });
        }
    }
    Ok(())
}

/// Removes repeated triangles, also those whose corners are in another order.
fn remove_duplicates(triangles: &mut Vec<Triangle>) {
    let mut seen = std::collections::HashSet::with_capacity(triangles.len());
    triangles.retain(|triangle| {
        // Adding zero turns -0 into 0, so that both compare as equal.
        let mut corners =
            triangle.map(|corner| [corner.x, corner.y, corner.z].map(|value| (value + 0.0).to_bits()));
        corners.sort_unstable();
        seen.insert(corners)
    });
}

#[expect(clippy::cast_precision_loss, reason = "counts")]
pub(crate) const fn count_to_f64(count: usize) -> f64 {
    count as f64
}
