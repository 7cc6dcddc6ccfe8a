//! The outer surface of a link, represented by samples.

use core::f64::consts::{PI, TAU};

use nalgebra::{Isometry3, Matrix3, Point3, Unit, Vector3};

use crate::grid::Grid;
use crate::mesh::{Affine, MAX_TRIANGLES, Triangle};
use crate::tree::{Ray, TriangleTree};
use crate::{CoverError, KeepOut, RobotLink, CoverOptions};

/// The number of samples per cell area.
const PER_CELL: f64 = 64.0;

/// The maximum number of cells for the triangles of a link.
const MAX_CELLS: usize = 6000;

/// The minimum number of samples, so that the figures of a small link are meaningful.
const MIN_SAMPLES: f64 = 2000.0;

/// The number of rays from a side of a sample. If the first [`FEW`] agree, no others are cast.
const RAYS: u32 = 32;
const FIRST_RAYS: u32 = 8;

/// The minimum share of rays that escape from a side of the outer surface: more than through a screw hole, and less
/// than from between the arms of a fork.
const MIN_ESCAPING_SHARE: f64 = 0.3;

/// The maximum share of rays from inside another link that leave it through gaps of its mesh.
const MAX_LEAKING_SHARE: f64 = 0.1;

/// The minimum share of rays from a side that leave the robot, past all links. A smaller share comes only through the
/// gap between two links, where nothing can touch a cell.
const MIN_REACHED_SHARE: f64 = 0.05;

/// The number of rays for that share. If half of the first [`FEW`] leave, no others are cast.
const REACH_RAYS: u32 = 128;

/// The height above the surface at which rays start, in pitches.
const ABOVE: f64 = 1e-3;

/// The distance up to which other links hide a surface, in pitches.
const HIDING_DISTANCE: f64 = 2.0;

/// The minimum share of the disc below a cell that is surface facing about the same way. It is about half at a straight
/// edge, and near zero on the rim of a sheet.
const MIN_SUPPORT: f64 = 0.4;

/// A point of the outer surface. Each sample represents the same area.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    pub(crate) point: Point3<f64>,
    /// The outward normal of the triangle.
    pub(crate) face: Vector3<f64>,
    /// The outward mean normal of the surface below a cell at the point.
    pub(crate) smooth: Vector3<f64>,
    /// True if a cell may be at the point.
    pub(crate) free: bool,
}

/// The outer surface of a link in its own frame.
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
    /// Samples the outer surface of one of the links.
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
                collect(link, &Isometry3::identity(), &mut own)?;
            } else {
                collect(link, &(frame * link.pose), &mut obstacles)?;
            }
        }
        once(&mut own);
        let pitch = options.pitch;
        let area: f64 = own.iter().map(area).sum();
        let cells = area / cell_area(pitch);
        if cells.is_nan() || cells > real(MAX_CELLS) {
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
            surface.sample(area, (cells * PER_CELL).max(MIN_SAMPLES));
            surface.smooth();
        }
        Ok(surface)
    }

    /// Samples all triangles evenly by area, and keeps the outer samples.
    fn sample(&mut self, area: f64, count: f64) {
        self.share = area / count;
        // Half of the first share is skipped, so that rounding errors do not add a sample.
        let mut due = -0.5;
        let mut taken = 0;
        for &triangle in self.own.triangles() {
            due += self::area(&triangle) / self.share;
            let [a, b, c] = triangle;
            let Some(face) = normal(&triangle) else { continue };
            while due > 0.0 {
                due -= 1.0;
                taken += 1;
                let (mut u, mut v) = scattered(taken);
                if u + v > 1.0 {
                    (u, v) = (1.0 - u, 1.0 - v);
                }
                let point = a + (b - a) * u + (c - a) * v;
                if let Some(face) = self.outward(&point, &face) {
                    let free = self.allowed(&point);
                    self.samples.push(Sample { point, face, smooth: face, free });
                }
            }
        }
    }

    /// Returns the outward normal of a point on a triangle with this normal; `None` if the point is not on the outer
    /// surface.
    fn outward(&self, point: &Point3<f64>, face: &Vector3<f64>) -> Option<Vector3<f64>> {
        let front = self.escaping(point, face);
        // Both sides of a sheet are outer sides. The more open one is chosen, and the front if they are equal.
        let back = if front < 0.95 { self.escaping(point, &-face) } else { 0.0 };
        let (side, share) = if back > front { (-face, back) } else { (*face, front) };
        let is_outer = share >= MIN_ESCAPING_SHARE
            && !self.inside_another(&(point + side * (ABOVE * self.pitch)))
            && self.is_reached(point, &side);
        is_outer.then_some(side)
    }

    /// Returns the share of rays from just above a point that escape, weighted by the cosine to the normal.
    fn escaping(&self, point: &Point3<f64>, side: &Vector3<f64>) -> f64 {
        let rays = self.rays(point, side);
        share(|ray| self.escapes(&rays(*ray), HIDING_DISTANCE * self.pitch))
    }

    /// Returns true if something can touch the point from this side: enough rays leave the robot.
    fn is_reached(&self, point: &Point3<f64>, side: &Vector3<f64>) -> bool {
        let rays = self.rays(point, side);
        let leaves = |ray: &u32| self.escapes(&rays(*ray), f64::INFINITY);
        let few = count((0..FIRST_RAYS).filter(leaves));
        if 2 * few >= FIRST_RAYS {
            return true;
        }
        let mut needed = (MIN_REACHED_SHARE * f64::from(REACH_RAYS)).ceil() - f64::from(few);
        let left = (FIRST_RAYS..REACH_RAYS).filter(leaves).find(|_| {
            needed -= 1.0;
            needed <= 0.0
        });
        needed <= 0.0 || left.is_some()
    }

    /// Returns rays by number, from just above a point to a side, with a density proportional to the cosine to the
    /// normal.
    fn rays(&self, point: &Point3<f64>, side: &Vector3<f64>) -> impl Fn(u32) -> Ray {
        let origin = point + side * (ABOVE * self.pitch);
        let ((s, t), side) = (tangents(side), *side);
        move |ray| {
            let (u, v) = scattered(ray);
            let (radius, (sin, cos)) = (u.sqrt(), (TAU * v).sin_cos());
            Ray::new(origin, s * (radius * cos) + t * (radius * sin) + side * (1.0 - u).sqrt())
        }
    }

    /// Returns true if a ray meets neither its own link, nor another link within `until`.
    fn escapes(&self, ray: &Ray, until: f64) -> bool {
        !self.own.blocks(ray, f64::INFINITY) && !self.others.blocks(ray, until)
    }

    fn inside_another(&self, point: &Point3<f64>) -> bool {
        let mut leaking = 0;
        for ray in 0..RAYS {
            let (u, v) = scattered(ray);
            let (height, (sin, cos)) = (2.0 * u - 1.0, (TAU * v).sin_cos());
            let radius = (1.0 - height * height).sqrt();
            let ray = Ray::new(*point, Vector3::new(radius * cos, radius * sin, height));
            if !self.others.blocks(&ray, f64::INFINITY) {
                leaking += 1;
            }
            if f64::from(leaking) > MAX_LEAKING_SHARE * f64::from(RAYS) {
                return false;
            }
        }
        true
    }

    /// Returns true if neither a box nor another link excludes cells at a point.
    fn allowed(&self, point: &Point3<f64>) -> bool {
        !self.keeps_out(point) && !self.others.near(point, self.clearance)
    }

    /// Returns true if a point is in a keep-out box.
    pub(crate) fn keeps_out(&self, point: &Point3<f64>) -> bool {
        let inside = |keep_out: &&KeepOut| {
            let sides = keep_out.min.iter().zip(&keep_out.max);
            sides.zip(point.iter()).all(|((min, max), at)| (min..=max).contains(&at))
        };
        self.keep_out.iter().any(inside)
    }

    /// Computes the mean normal around each sample, and checks that there is enough surface below a cell.
    fn smooth(&mut self) {
        let radius = self.pitch / 2.0;
        let grid = Grid::with_points(radius, self.samples.iter().map(|sample| &sample.point));
        let min = MIN_SUPPORT * PI * radius * radius / self.share;
        let mut smoothed = Vec::new();
        for (cube, members) in grid.cubes() {
            let near: Vec<_> = grid.around(cube).filter_map(|index| self.samples.get(index)).collect();
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

    /// Returns the point of the mesh above or below `point`, near a sample, with the mesh's outward normal there;
    /// `None` if a cell may not be there.
    pub(crate) fn project(
        &self,
        point: &Point3<f64>,
        sample: &Sample,
    ) -> Option<(Point3<f64>, Vector3<f64>)> {
        let up = sample.smooth;
        let reach = self.pitch / 4.0;
        let origin = point + up * ((sample.point - point).dot(&up) + reach);
        let (at, triangle) = self.own.first(&Ray::new(origin, -up), 2.0 * reach)?;
        let point = origin - up * at;
        let face = self.outward(&point, &normal(self.own.triangle(triangle)?)?)?;
        (face.dot(&up) > 0.0 && self.allowed(&point)).then_some((point, face))
    }
}

/// Returns the share of rays that pass, from the first few if those agree.
fn share(escapes: impl Fn(&u32) -> bool) -> f64 {
    let few = count((0..FIRST_RAYS).filter(&escapes));
    if few == 0 || few == FIRST_RAYS {
        return f64::from(few) / f64::from(FIRST_RAYS);
    }
    f64::from(few + count((FIRST_RAYS..RAYS).filter(&escapes))) / f64::from(RAYS)
}

/// Counts rays.
fn count(rays: impl Iterator<Item = u32>) -> u32 {
    rays.fold(0, |count, _| count + 1)
}

/// Returns points of the unit square that are distributed evenly for any number of points (a sequence of Roberts).
fn scattered(index: u32) -> (f64, f64) {
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

/// Returns the area of a triangle, in m².
pub(crate) fn area([a, b, c]: &Triangle) -> f64 {
    (b - a).cross(&(c - a)).norm() / 2.0
}

/// Returns the normal of a triangle, if it has an area.
pub(crate) fn normal([a, b, c]: &Triangle) -> Option<Vector3<f64>> {
    Unit::try_new((b - a).cross(&(c - a)), 0.0).map(Unit::into_inner)
}

/// Collects the triangles of a link, in a frame in which its own is at `pose`.
fn collect(link: &RobotLink, pose: &Isometry3<f64>, triangles: &mut Vec<Triangle>) -> Result<(), CoverError> {
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

/// Removes duplicate triangles, whatever the order of their corners.
fn once(triangles: &mut Vec<Triangle>) {
    let mut seen = std::collections::HashSet::with_capacity(triangles.len());
    triangles.retain(|triangle| {
        // Adding zero converts -0 to 0.
        let mut corners =
            triangle.map(|corner| [corner.x, corner.y, corner.z].map(|value| (value + 0.0).to_bits()));
        corners.sort_unstable();
        seen.insert(corners)
    });
}

#[expect(clippy::cast_precision_loss, reason = "counts")]
pub(crate) const fn real(count: usize) -> f64 {
    count as f64
}
