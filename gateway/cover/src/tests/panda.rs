//! Tests on the links of a real robot. What the crate computes is compared with a slow and independent computation:
//! random points of the mesh, and rays that are tested against every triangle.

#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::print_stdout,
    reason = "a test may stop, and its figures are what it is about"
)]

use std::env;
use std::path::PathBuf;

use crate::mesh::{Mesh, Triangle, UpAxis};
use crate::{Cover, CoverCell, CoverOptions, LinkMesh, RobotLink, cover};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const PITCH: f64 = 0.028;
const NAMES: [&str; 9] = ["link0", "link1", "link2", "link3", "link4", "link5", "link6", "link7", "hand"];
const COVERED: core::ops::Range<usize> = 3..7;

/// Returns the robot with bent elbow and wrist: each joint's origin and roll as in `panda.urdf`, and an angle.
fn robot() -> Vec<RobotLink> {
    let folder =
        env::var("SKINBUS_ROBOTS").expect("SKINBUS_ROBOTS is the folder of example-robot-data's robots");
    let folder = PathBuf::from(folder).join("panda_description/meshes/visual");
    let right = core::f64::consts::FRAC_PI_2;
    let joints = [
        ([0.0, 0.0, 0.333], 0.0, 0.0),
        ([0.0, 0.0, 0.0], -right, -0.785),
        ([0.0, -0.316, 0.0], right, 0.0),
        ([0.0825, 0.0, 0.0], right, -2.356),
        ([-0.0825, 0.384, 0.0], -right, 0.0),
        ([0.0, 0.0, 0.0], right, 1.571),
        ([0.088, 0.0, 0.0], right, 0.785),
        ([0.0, 0.0, 0.107], 0.0, -0.785),
    ];
    let mut pose = Isometry3::identity();
    let mut poses = vec![pose];
    for ([x, y, z], roll, angle) in joints {
        let turn = UnitQuaternion::from_euler_angles(roll, 0.0, 0.0);
        pose *= Isometry3::from_parts(Translation3::new(x, y, z), turn);
        pose *= Isometry3::rotation(Vector3::z() * angle);
        poses.push(pose);
    }
    let link = |(name, pose): (&str, Isometry3<f64>)| {
        let mesh = Mesh::load(&folder.join(format!("{name}.dae")), UpAxis::Ignore).unwrap();
        RobotLink { name: name.to_owned(), parts: vec![LinkMesh::new(mesh)], pose }
    };
    NAMES.into_iter().zip(poses).map(link).collect()
}

fn triangles(link: &RobotLink, pose: &Isometry3<f64>) -> Vec<Triangle> {
    let meshes = link.parts.iter().flat_map(|part| part.mesh.triangles());
    meshes.map(|triangle| triangle.map(|corner| pose * corner)).collect()
}

fn normal([a, b, c]: &Triangle) -> Vector3<f64> {
    (b - a).cross(&(c - a))
}

/// Returns true if a ray meets a triangle within `until`, by the volumes of the tetrahedra between them.
fn meets(from: &Point3<f64>, direction: &Vector3<f64>, until: f64, triangle: &Triangle) -> bool {
    let [a, b, c] = triangle.map(|corner| corner - from);
    let volumes = [a.cross(&b).dot(direction), b.cross(&c).dot(direction), c.cross(&a).dot(direction)];
    if volumes.iter().any(|volume| *volume < 0.0) && volumes.iter().any(|volume| *volume > 0.0) {
        return false;
    }
    let at = a.dot(&normal(triangle)) / direction.dot(&normal(triangle));
    (0.0..=until).contains(&at)
}

fn direction(dice: &mut Pcg64Mcg) -> Vector3<f64> {
    loop {
        let direction: Vector3<f64> = Vector3::from_fn(|_, _| dice.random_range(-1.0..1.0));
        if (0.01..=1.0).contains(&direction.norm()) {
            return direction.normalize();
        }
    }
}

/// Returns the share of rays into the half space above `up` that are free: own triangles block at any distance, others
/// within two pitches.
fn open(
    from: &Point3<f64>,
    up: &Vector3<f64>,
    own: &[Triangle],
    others: &[Triangle],
    dice: &mut Pcg64Mcg,
) -> f64 {
    let rays = 16;
    let mut free = 0;
    for _ in 0..rays {
        // The rays are weighted by the cosine.
        let ray = (direction(dice) + up * 1.001).normalize();
        let blocked = own.iter().any(|triangle| meets(from, &ray, f64::INFINITY, triangle))
            || others.iter().any(|triangle| meets(from, &ray, 2.0 * PITCH, triangle));
        free += i32::from(!blocked);
    }
    f64::from(free) / f64::from(rays)
}

/// Returns true if a point is inside another link: hardly any ray leaves it.
fn inside(from: &Point3<f64>, others: &[Vec<Triangle>], dice: &mut Pcg64Mcg) -> bool {
    others.iter().any(|other| {
        let mut corners = other.iter().flatten();
        let first = *corners.next().unwrap();
        let (min, max) =
            corners.fold((first, first), |(min, max), corner| (min.inf(corner), max.sup(corner)));
        let leaves =
            |ray: &Vector3<f64>| !other.iter().any(|triangle| meets(from, ray, f64::INFINITY, triangle));
        let boxed = from.inf(&min) == min && from.sup(&max) == max;
        boxed && (0..40).map(|_| direction(dice)).filter(leaves).nth(3).is_none()
    })
}

/// Returns the triangles with a corner within three pitches of a point; the robot's triangles are much smaller than a
/// pitch.
fn near(point: &Point3<f64>, others: &[Vec<Triangle>]) -> Vec<Triangle> {
    let near = |triangle: &&Triangle| triangle.iter().any(|corner| (corner - point).norm() < 3.0 * PITCH);
    others.iter().flatten().filter(near).copied().collect()
}

/// Returns the distance of a point from a triangle's plane, if it is above the triangle.
fn height(point: &Point3<f64>, triangle: &Triangle) -> Option<f64> {
    let [a, b, c] = triangle;
    let up = normal(triangle);
    let above = |a: &Point3<f64>, b: &Point3<f64>| up.cross(&(b - a)).dot(&(point - a)) >= -1e-12;
    (above(a, b) && above(b, c) && above(c, a)).then(|| ((point - a).dot(&up) / up.norm()).abs())
}

fn vectors(cell: &CoverCell) -> (Point3<f64>, Vector3<f64>) {
    (Point3::from(cell.position), Vector3::from(cell.normal))
}

#[test]
#[ignore = "needs example-robot-data"]
fn panda_wears_a_skin_of_the_real_pitch() {
    let all = robot();
    let covered = &all[COVERED];
    let others: Vec<_> =
        all.iter().filter(|link| covered.iter().all(|one| one.name != link.name)).cloned().collect();
    let start = std::time::Instant::now();
    let skin = cover(covered, &others, &CoverOptions { pitch: PITCH, ..CoverOptions::default() }).unwrap();
    println!("{} cells on {} buses in {:.1} s", skin.cells.len(), skin.buses, start.elapsed().as_secs_f64());
    for index in 0..covered.len() {
        measure(&skin, &all, index);
    }
}

fn measure(skin: &Cover, all: &[RobotLink], index: usize) {
    let (link, figures) = (&all[COVERED][index], &skin.links[index]);
    let own = triangles(link, &Isometry3::identity());
    let frame = link.pose.inverse();
    let rest = all.iter().filter(|other| other.name != link.name);
    let rest: Vec<_> = rest.map(|other| triangles(other, &(frame * other.pose))).collect();
    let cells: Vec<_> = skin.cells.iter().filter(|cell| cell.link == index).map(vectors).collect();
    assert_eq!(cells.len(), figures.cells);
    let mut dice = Pcg64Mcg::seed_from_u64(99);

    let mut spacing: Vec<f64> = Vec::new();
    let mut tilt = 0.0_f64;
    for (point, up) in &cells {
        let same = cells.iter().filter(|(other, facing)| other != point && facing.dot(up) > 0.0);
        spacing.extend(same.map(|(other, _)| (other - point).norm()).min_by(f64::total_cmp));
        // At an edge two triangles touch the cell; the one with the better angle counts.
        let at = own.iter().filter(|triangle| height(point, triangle).is_some_and(|height| height < 1e-6));
        let angle = |triangle: &Triangle| {
            let angle = normal(triangle).angle(up);
            angle.min(core::f64::consts::PI - angle)
        };
        tilt = tilt.max(at.map(angle).min_by(f64::total_cmp).expect("every cell is on the mesh"));
        assert!(!inside(&(point + up * 1e-4), &rest, &mut dice), "{} at {point}", link.name);
        assert!(
            open(&(point + up * 1e-4), up, &own, &[], &mut dice) > 0.15,
            "{} at {point} faces in",
            link.name
        );
    }
    spacing.sort_by(f64::total_cmp);
    let median = spacing[spacing.len() / 2] / PITCH;

    let mut areas: Vec<f64> = Vec::new();
    let mut area = 0.0;
    for triangle in &own {
        area += normal(triangle).norm() / 2.0;
        areas.push(area);
    }
    let (points, mut outer, mut served) = (400, 0, 0);
    for _ in 0..points {
        let at = dice.random_range(0.0..area);
        let triangle = &own[areas.partition_point(|&sum| sum <= at)];
        let [a, b, c] = triangle;
        let (u, v): (f64, f64) = (dice.random_range(0.0..1.0), dice.random_range(0.0..1.0));
        let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
        let point = a + (b - a) * u + (c - a) * v;
        let up = normal(triangle).normalize();
        let hiding = near(&point, &rest);
        let side = [up, -up].into_iter().find(|up| {
            let from = point + up * 3e-5;
            open(&from, up, &own, &hiding, &mut dice) >= 0.3 && !inside(&from, &rest, &mut dice)
        });
        if let Some(up) = side {
            outer += 1;
            let covers = |(cell, facing): &(Point3<f64>, Vector3<f64>)| {
                (cell - point).norm() <= PITCH && facing.dot(&up) > -0.5
            };
            served += i32::from(cells.iter().any(covers));
        }
    }
    let outer_area = area * f64::from(outer) / f64::from(points);
    let share = f64::from(served) / f64::from(outer);
    println!(
        "{}: {} cells, {outer_area:.4} m² outer ({:.4}), {:.1} % covered ({:.1}), spacing {median:.3} pitches ({:.3}), \
         tilt {:.2} degrees ({:.2})",
        link.name,
        cells.len(),
        figures.outer_area,
        share * 100.0,
        figures.covered * 100.0,
        figures.spacing.unwrap() / PITCH,
        tilt.to_degrees(),
        figures.tilt.to_degrees(),
    );
    assert!(share >= 0.9);
    assert!((0.85..=1.15).contains(&median));
    assert!(tilt.to_degrees() <= 10.0);
    assert!((outer_area / figures.outer_area - 1.0).abs() < 0.1);
    assert!((share - figures.covered).abs() < 0.03);
}
