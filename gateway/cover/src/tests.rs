mod panda;

use std::collections::BTreeMap;

use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use proptest::prelude::*;

use super::*;
use crate::mesh::Triangle;

const PITCH: f64 = 0.04;

fn options() -> CoverOptions {
    CoverOptions { pitch: PITCH, ..CoverOptions::default() }
}

fn link(name: &str, parts: Vec<LinkMesh>) -> RobotLink {
    RobotLink { name: name.to_owned(), parts, ..RobotLink::default() }
}

fn single(mesh: Mesh) -> RobotLink {
    link("single", vec![LinkMesh::new(mesh)])
}

fn cube(edge: f64) -> Mesh {
    Mesh::cuboid([edge; 3]).unwrap()
}

/// Covers one link, and checks the wiring.
fn covered(link: RobotLink, options: &CoverOptions) -> Cover {
    let skin = cover(&[link], &[], options).unwrap();
    sound(&skin, options);
    skin
}

fn vectors(cell: &CoverCell) -> (Vector3<f64>, Vector3<f64>) {
    (Vector3::from(cell.position), Vector3::from(cell.normal))
}

/// Checks the properties of every skin's cells.
fn sound(skin: &Cover, options: &CoverOptions) {
    let mut buses: BTreeMap<usize, Vec<&CoverCell>> = BTreeMap::new();
    for cell in &skin.cells {
        buses.entry(cell.bus).or_default().push(cell);
        assert!((vectors(cell).1.norm() - 1.0).abs() < 1e-9);
    }
    for (index, cell) in skin.cells.iter().enumerate() {
        for other in skin.cells[..index].iter().filter(|other| other.link == cell.link) {
            let ((point, normal), (other_point, other_normal)) = (vectors(cell), vectors(other));
            let apart = (point - other_point).norm() / options.pitch;
            assert!(apart >= 0.6 || normal.dot(&other_normal) <= 0.5, "{apart} pitches: {cell:?} {other:?}");
        }
    }
    let cells: usize = skin.links.iter().map(|figures| figures.cells).sum();
    assert_eq!(skin.cells.len(), cells);
    assert_eq!(buses.len(), cells.div_ceil(options.nodes_per_bus));
    assert_eq!(buses.keys().copied().collect::<Vec<_>>(), (0..skin.buses).collect::<Vec<_>>());
    for cells in buses.values() {
        assert!(cells.len() <= options.nodes_per_bus);
        for (index, cell) in cells.iter().enumerate() {
            assert_eq!(usize::from(cell.node), index + 1);
            let mut wires: Vec<_> = cell.neighbors.iter().flatten().collect();
            wires.sort_unstable();
            let count = wires.len();
            wires.dedup();
            assert_eq!(wires.len(), count, "one wire between two cells");
            for &&node in &wires {
                let other = cells[usize::from(node) - 1];
                assert!(node != cell.node && other.link == cell.link);
                let back = other.neighbors.iter().flatten().filter(|&&back| back == cell.node);
                assert_eq!(back.count(), 1, "{} and {node} name each other", cell.node);
                assert!((vectors(cell).0 - vectors(other).0).norm() <= 1.5 * options.pitch);
            }
        }
        let mut reached = vec![0; cells.len()];
        for root in cells.iter().filter(|cell| cell.root) {
            let mut open = vec![root.node];
            while let Some(node) = open.pop() {
                let count = &mut reached[usize::from(node) - 1];
                if *count == i32::from(root.node) {
                    continue;
                }
                assert_eq!(*count, 0, "one root for all that wires join");
                *count = root.node.into();
                open.extend(cells[usize::from(node) - 1].neighbors.iter().flatten());
            }
        }
        assert!(reached.iter().all(|&root| root > 0), "every cell is reached from a root");
    }
}

/// Checks the figures of a well covered link.
fn well(figures: &LinkFigures) {
    let spacing = figures.spacing.unwrap() / PITCH;
    assert!(figures.covered > 0.98, "{figures:?}");
    assert!((0.9..1.1).contains(&spacing), "{figures:?}");
    assert!(figures.tilt.to_degrees() < 9.01, "{figures:?}");
    // A honeycomb has one cell per cell area; edges and bends reduce that here.
    let room = figures.outer_area / (PITCH * PITCH * 0.866);
    let density = f64::from(u32::try_from(figures.cells).unwrap()) / room;
    assert!((0.65..1.05).contains(&density), "{density} of {room}");
}

#[test]
fn a_cube_wears_cells_on_all_sides() {
    let skin = covered(single(cube(0.2)), &options());
    well(&skin.links[0]);
    assert!((skin.links[0].outer_area / 0.24 - 1.0).abs() < 1e-3, "{:?}", skin.links);
    assert_eq!(skin.cells.iter().filter(|cell| cell.root).count(), 1, "wired around its edges");
    for axis in 0..3 {
        for side in [-0.1, 0.1] {
            let on: Vec<_> =
                skin.cells.iter().filter(|cell| (cell.position[axis] - side).abs() < 1e-9).collect();
            assert!((12..=29).contains(&on.len()), "{} on {axis} {side}", on.len());
            assert!(on.iter().all(|cell| (cell.normal[axis] - side * 10.0).abs() < 1e-9));
        }
    }
}

#[test]
fn a_sphere_and_a_cylinder_wear_cells_that_face_outward() {
    let skin = covered(single(Mesh::sphere(0.1).unwrap()), &options());
    well(&skin.links[0]);
    for (position, normal) in skin.cells.iter().map(vectors) {
        assert!((position.norm() - 0.1).abs() < 2e-3);
        assert!(position.angle(&normal).to_degrees() < 9.0);
    }
    let skin = covered(single(Mesh::cylinder(0.06, 0.3).unwrap()), &options());
    well(&skin.links[0]);
    for (position, normal) in skin.cells.iter().map(vectors) {
        assert!(position.dot(&normal) > 0.0);
        assert!((position.xy().norm() - 0.06).abs() < 1e-3 || (position.z.abs() - 0.15).abs() < 1e-9);
    }
}

#[test]
fn the_sides_of_a_thin_plate_are_covered_each_for_itself() {
    let skin = covered(single(Mesh::cuboid([0.2, 0.2, 0.002]).unwrap()), &options());
    well(&skin.links[0]);
    let up = skin.cells.iter().filter(|cell| (cell.normal[2] - 1.0).abs() < 1e-9).count();
    let down = skin.cells.iter().filter(|cell| (cell.normal[2] + 1.0).abs() < 1e-9).count();
    assert_eq!(up + down, skin.cells.len(), "its rim is too narrow for cells");
    assert!(up.abs_diff(down) < 6, "{up} and {down}");
    assert!(skin.cells.iter().all(|cell| (cell.position[2] - cell.normal[2] * 0.001).abs() < 1e-9));
    assert_eq!(skin.cells.iter().filter(|cell| cell.root).count(), 2, "no wire leads through the plate");
}

#[test]
fn a_sheet_without_thickness_is_covered_on_the_side_of_its_winding() {
    let corner = |x: f64, y: f64| Point3::new(x, y, 0.0);
    let (a, b, c, d) = (corner(0.0, 0.0), corner(0.2, 0.0), corner(0.2, 0.2), corner(0.0, 0.2));
    // Each triangle occurs twice.
    let sheet = Mesh::new("sheet", vec![[a, b, c], [a, c, d], [b, c, a], [d, a, c]]).unwrap();
    let skin = covered(single(sheet), &options());
    assert!((skin.links[0].outer_area - 0.04).abs() < 1e-4, "{:?}", skin.links);
    well(&skin.links[0]);
    assert!(skin.cells.iter().all(|cell| (cell.normal[2] - 1.0).abs() < 1e-9));
}

#[test]
fn inner_parts_wear_nothing() {
    let inner = LinkMesh { scale: [0.5; 3], ..LinkMesh::new(cube(0.2)) };
    // The third part is a second wall, just below the outer one.
    let wall = LinkMesh { scale: [0.99; 3], ..LinkMesh::new(cube(0.2)) };
    let skin = covered(link("boxes", vec![inner, LinkMesh::new(cube(0.2)), wall]), &options());
    well(&skin.links[0]);
    assert!((skin.links[0].outer_area / 0.24 - 1.0).abs() < 0.02, "{:?}", skin.links);
    assert!(skin.cells.iter().all(|cell| (vectors(cell).0.amax() - 0.1).abs() < 1e-9));
}

#[test]
fn winding_and_mirrors_do_not_turn_cells_inward() {
    let outward = |skin: &Cover, middle: Vector3<f64>| {
        well(&skin.links[0]);
        assert!(
            skin.cells.iter().map(vectors).all(|(position, normal)| (position - middle).dot(&normal) > 0.0)
        );
    };
    let triangles = cube(0.2).triangles().to_vec();
    let turned = triangles.iter().map(|&[a, b, c]| [c, b, a]).collect();
    outward(&covered(single(Mesh::new("inside out", turned).unwrap()), &options()), Vector3::zeros());
    let mixed =
        triangles.iter().enumerate().map(|(at, &[a, b, c])| if at % 3 == 0 { [c, b, a] } else { [a, b, c] });
    outward(&covered(single(Mesh::new("mixed", mixed.collect()).unwrap()), &options()), Vector3::zeros());
    let pose = Isometry3::from_parts(Translation3::new(0.5, 0.0, 0.0), UnitQuaternion::identity());
    let mirrored = LinkMesh { mesh: cube(0.2), pose, scale: [-1.0, 1.0, 1.5] };
    let skin = covered(link("mirrored", vec![mirrored]), &options());
    outward(&skin, Vector3::new(0.5, 0.0, 0.0));
    assert!((skin.links[0].outer_area / 0.32 - 1.0).abs() < 0.01);
}

#[test]
fn other_links_hide_and_keep_cells_away() {
    // The other cube contains the right half of this one, and the gap to a plate below is too narrow for cells.
    let at = |x, y, z| Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::identity());
    let pose = Isometry3::from_parts(
        Translation3::new(0.3, -0.2, 1.0),
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.7),
    );
    let clad = RobotLink { pose, ..single(cube(0.2)) };
    let holding = RobotLink { pose: pose * at(0.2, 0.0, 0.0), ..single(cube(0.4)) };
    let plate = single(Mesh::cuboid([0.6, 0.6, 0.01]).unwrap());
    let plate = RobotLink { pose: pose * at(0.0, 0.0, -0.115), ..plate };
    let skin = cover(core::slice::from_ref(&clad), &[holding, plate], &options()).unwrap();
    sound(&skin, &options());
    // One whole side and half of three others remain.
    assert!((skin.links[0].outer_area / 0.1 - 1.0).abs() < 0.1, "{:?}", skin.links);
    assert!(skin.links[0].covered > 0.95);
    for cell in &skin.cells {
        assert!(cell.position[0] <= -0.005 && cell.position[2] > -0.0999, "{cell:?}");
    }
    // Two links hide each other, and a link inside another gets no cells.
    let shell = RobotLink { pose, ..single(cube(0.3)) };
    let skin = cover(&[clad, shell], &[], &options()).unwrap();
    sound(&skin, &options());
    assert_eq!((skin.links[0].cells, skin.links[0].spacing, skin.links[0].covered), (0, None, 0.0));
    assert!(skin.links[0].outer_area < 1e-9);
    well(&skin.links[1]);
    assert!(skin.cells.iter().all(|cell| cell.link == 1));
}

/// Returns the 642 corners of an icosahedron whose edges were halved three times.
fn directions() -> Vec<Vector3<f64>> {
    let long = (1.0 + 5.0_f64.sqrt()) / 2.0;
    let turned = |x: f64, y: f64| [[0.0, x, y], [x, y, 0.0], [y, 0.0, x]];
    let corners = [(1.0, long), (1.0, -long), (-1.0, long), (-1.0, -long)];
    let mut all: Vec<_> = corners.into_iter().flat_map(|(x, y)| turned(x, y)).map(Vector3::from).collect();
    all.iter_mut().for_each(|corner| *corner = corner.normalize());
    let mut edge = 1.2;
    for _ in 0..3 {
        let pairs = all.iter().enumerate().flat_map(|(at, a)| all[..at].iter().map(move |b| (a, b)));
        let middles = pairs.filter(|(a, b)| (*a - *b).norm() < edge).map(|(a, b)| (a + b).normalize());
        let middles: Vec<_> = middles.collect();
        all.extend(middles);
        edge /= 1.8;
    }
    assert_eq!(all.len(), 642);
    all
}

/// Returns the number of the first link's cells that nothing can touch: every direction from them meets a link.
fn enclosed(links: &[RobotLink], skin: &Cover) -> usize {
    let directions = directions();
    let parts = links.iter().flat_map(|link| link.parts.iter().map(|part| part.triangles(&link.pose)));
    let tree = tree::TriangleTree::new(parts.flatten().collect());
    let blocked = |cell: &&CoverCell| {
        let (position, normal) = vectors(cell);
        let from = links[0].pose * Point3::from(position + normal * 1e-4);
        directions.iter().all(|direction| tree.blocks_ray(&tree::Ray::new(from, *direction), f64::INFINITY))
    };
    skin.cells.iter().filter(|cell| cell.link == 0).filter(blocked).count()
}

#[test]
fn no_cell_is_where_links_together_enclose_it() {
    let at = |z: f64| Isometry3::translation(0.0, 0.0, z);
    let plate = single(Mesh::cuboid([0.4, 0.4, 0.02]).unwrap());
    // A tube without a bottom is 2 mm above the plate. The plate alone, or the tube alone, blocks only a few rays.
    let closed = Mesh::cylinder(0.1, 0.2).unwrap();
    let tube = |wall: f64, lift: f64| {
        let is_open = |triangle: &&Triangle| triangle.iter().any(|corner| corner.z > -0.1 + 1e-9);
        let open: Vec<_> = closed.triangles().iter().filter(is_open).copied().collect();
        let inner = LinkMesh {
            scale: [1.0 - wall, 1.0 - wall, 1.0 - wall / 2.0],
            ..LinkMesh::new(Mesh::new("tube", open.clone()).unwrap())
        };
        let outer = LinkMesh::new(Mesh::new("tube", open).unwrap());
        let parts = if wall > 0.0 { vec![outer, inner] } else { vec![outer] };
        RobotLink { pose: at(0.11 + lift), ..link("tube", parts) }
    };
    for (wall, lift) in [(0.0, 0.002), (0.05, 0.002), (0.0, 0.0005), (0.0, -0.001)] {
        let tube = tube(wall, lift);
        let below = |cell: &&CoverCell| cell.normal[2] > 0.9 && vectors(cell).0.xy().norm() < 0.095;
        let links = [plate.clone(), tube];
        let skin = cover(&links[..1], &links[1..], &options()).unwrap();
        sound(&skin, &options());
        assert_eq!(skin.cells.iter().filter(below).count(), 0, "{wall} {lift}");
        assert_eq!(enclosed(&links, &skin), 0);
        let outside = skin.cells.iter().filter(|cell| cell.normal[2] > 0.9).count();
        assert!(outside > 60, "{outside}");
        // The same holds if the links are covered in the other order, and inside the tube as on the plate.
        let links = [links[1].clone(), links[0].clone()];
        let skin = cover(&links, &[], &options()).unwrap();
        assert_eq!(enclosed(&links, &skin), 0);
        assert!(skin.cells.iter().filter(|cell| cell.link == 1).filter(below).count() == 0);
    }
    // High above the plate, the tube hides nothing.
    let links = [plate, tube(0.0, 0.3)];
    let skin = cover(&links[..1], &links[1..], &options()).unwrap();
    let alone = cover(&links[..1], &[], &options()).unwrap();
    assert_eq!(skin.cells.len(), alone.cells.len());
}

#[test]
fn keep_out_boxes_hold_no_cell() {
    let keep_out = KeepOut { link: 0, min: [-1.0, -1.0, 0.05], max: [1.0, 1.0, 1.0] };
    let options = CoverOptions { keep_out: vec![keep_out], ..options() };
    let skin = covered(single(cube(0.2)), &options);
    assert!(skin.cells.iter().all(|cell| cell.position[2] < 0.05));
    assert!(skin.links[0].covered < 0.9, "the area in the box counts");
    assert!((0.2..0.5).contains(&skin.links[0].kept_out), "{}", skin.links[0].kept_out);
    let all = CoverOptions { keep_out: vec![KeepOut { min: [-1.0; 3], ..keep_out }], ..options };
    let figures = &covered(single(cube(0.2)), &all).links[0];
    assert!(figures.cells == 0 && figures.kept_out >= 1.0, "{figures:?}");
    let other = CoverOptions { keep_out: vec![KeepOut { link: 1, ..keep_out }], ..all };
    assert_eq!(
        cover(&[single(cube(0.2))], &[], &other).unwrap_err().to_string(),
        "keep-out box 0: link 1 is not one of the 1 covered links; correct it"
    );
}

#[test]
fn the_same_seed_gives_the_same_cells() {
    let skin =
        |seed| covered(single(Mesh::cylinder(0.06, 0.2).unwrap()), &CoverOptions { seed, ..options() });
    assert_eq!(skin(7), skin(7));
    assert_ne!(skin(7).cells, skin(8).cells);
}

#[test]
fn buses_are_patches_along_a_link_and_nodes_follow_it() {
    let options = CoverOptions { nodes_per_bus: 20, ..options() };
    let skin = covered(single(Mesh::cylinder(0.04, 0.6).unwrap()), &options);
    assert!(skin.buses > 3);
    for pair in skin.cells.windows(2) {
        // The axis may have either direction.
        let step = (pair[1].position[2] - pair[0].position[2]).abs();
        assert!(step < 2.2 * PITCH || pair[0].bus == pair[1].bus);
    }
    let middle = |bus: usize| {
        let on: Vec<_> =
            skin.cells.iter().filter(|cell| cell.bus == bus).map(|cell| cell.position[2]).collect();
        let count = f64::from(u32::try_from(on.len()).unwrap());
        on.iter().sum::<f64>() / count
    };
    let middles: Vec<_> = (0..skin.buses).map(middle).collect();
    assert!(middles.is_sorted() || middles.iter().rev().is_sorted(), "{middles:?}");
}

#[test]
fn what_cannot_be_covered_is_refused_in_one_line() {
    let refused = |link: RobotLink, options: CoverOptions| {
        let message = cover(&[link], &[], &options).unwrap_err().to_string();
        assert_eq!(message.lines().count(), 1, "{message}");
        message
    };
    let large = refused(single(cube(1000.0)), options());
    assert!(large.starts_with("link single: 6.000e6 m² of triangles need 4330127019 cells"), "{large}");
    assert!(large.ends_with("the maximum is 6000; correct the mesh's scale"), "{large}");
    let wide = refused(single(cube(2.0)), options());
    let (_, hint) = wide.rsplit_once("or raise the pitch to ").unwrap();
    let pitch = hint.strip_suffix(" m").unwrap().parse().unwrap();
    let raised = CoverOptions { pitch, ..options() };
    assert!(Surface::new(0, &[single(cube(2.0))], &[], &raised).is_ok(), "{wide}");
    let infinite = link("l", vec![LinkMesh { scale: [1.0, f64::INFINITY, 1.0], ..LinkMesh::new(cube(1.0)) }]);
    assert_eq!(
        refused(infinite, options()),
        "link l, part 0: scale [1.0, inf, 1.0] and the pose give coordinates that are not finite; correct them"
    );
    let overflowing = link("l", vec![LinkMesh { scale: [1e200; 3], ..LinkMesh::new(cube(1.0)) }]);
    assert!(refused(overflowing, options()).starts_with("link l: inf m²"));
    let pitch = refused(single(cube(1.0)), CoverOptions { pitch: 0.0, ..options() });
    assert_eq!(pitch, "pitch 0 m: it must be 0.001 to 1 m");
    assert!(
        refused(single(cube(1.0)), CoverOptions { pitch: f64::NAN, ..options() }).starts_with("pitch NaN m")
    );
    assert!(
        refused(single(cube(1.0)), CoverOptions { clearance: -1.0, ..options() })
            .starts_with("clearance -1 m")
    );
    assert!(
        refused(single(cube(1.0)), CoverOptions { nodes_per_bus: 251, ..options() }).starts_with("251 nodes")
    );
}

#[test]
fn links_without_room_for_a_cell_wear_none() {
    let empty = covered(link("empty", Vec::new()), &options());
    assert_eq!((empty.cells.len(), empty.buses, empty.links[0].outer_area), (0, 0, 0.0));
    let point = Point3::new(0.1, 0.2, 0.3);
    let line = [point, point * 2.0, point * 3.0];
    let degenerate = covered(single(Mesh::new("d", vec![[point; 3], line]).unwrap()), &options());
    assert_eq!(degenerate.cells.len(), 0);
    // The triangle is a kilometre long and a micrometre wide.
    let sliver = [Point3::origin(), Point3::new(1e3, 0.0, 0.0), Point3::new(1e3, 1e-6, 0.0)];
    let sliver = covered(single(Mesh::new("s", vec![sliver]).unwrap()), &options());
    assert_eq!(sliver.cells.len(), 0);
    assert!((sliver.links[0].outer_area - 5e-4).abs() < 1e-5);
    // The cube is smaller than a cell, but its sides could hold one.
    let small = covered(single(cube(0.03)), &options());
    assert!(small.cells.len() <= 6 && small.links[0].outer_area > 0.005, "{:?}", small.links);
}

/// Generates triangles of all sizes, including thin ones.
fn soup() -> impl Strategy<Value = Vec<Triangle>> {
    let coordinate = prop_oneof![16 => -0.1..0.1_f64, 2 => Just(0.0), 1 => -0.4..0.4_f64];
    let point = proptest::array::uniform3(coordinate).prop_map(Point3::from);
    proptest::collection::vec(proptest::array::uniform3(point), 1..30)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn any_triangles_are_covered_or_refused(soup in soup(), seed in any::<u64>(), nodes in 1..=MAX_CELLS_PER_BUS) {
        let options = CoverOptions { seed, nodes_per_bus: nodes, pitch: 0.08, ..CoverOptions::default() };
        let (first, second) = soup.split_at(soup.len() / 2);
        let link = |triangles: &[Triangle]| Mesh::new("soup", triangles.to_vec()).map(single).unwrap_or_default();
        match cover(&[link(first), link(second)], &[], &options) {
            Ok(skin) => {
                sound(&skin, &options);
                for figures in &skin.links {
                    prop_assert!((0.0..=1.0).contains(&figures.covered) && figures.tilt.to_degrees() < 9.01);
                }
            }
            Err(error) => prop_assert!(matches!(error, CoverError::TooLarge { .. }), "{}", error),
        }
    }
}
