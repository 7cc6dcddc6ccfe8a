use std::fmt::Write as _;

use nalgebra::Vector3;
use proptest::prelude::*;

use super::*;

/// Returns the smallest and the largest coordinates of a mesh.
fn extent(mesh: &Mesh) -> ([f64; 3], [f64; 3]) {
    let mut corners = mesh.triangles().iter().flatten();
    let first = *corners.next().unwrap();
    let (min, max) = corners.fold((first, first), |(min, max), corner| (min.inf(corner), max.sup(corner)));
    (min.coords.into(), max.coords.into())
}

fn close(a: [f64; 3], b: [f64; 3]) -> bool {
    a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-6)
}

/// Returns the volume that the triangles enclose. It is positive if all of them are counterclockwise as seen from
/// outside.
fn volume(mesh: &Mesh) -> f64 {
    mesh.triangles().iter().map(|[a, b, c]| a.coords.cross(&b.coords).dot(&c.coords) / 6.0).sum()
}

fn message(result: Result<Mesh, MeshError>) -> String {
    let message = result.unwrap_err().to_string();
    assert_eq!(message.lines().count(), 1, "{message}");
    message
}

/// The corners of a tetrahedron whose edges along the axes have the lengths 1, 2 and 3.
const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]];
const FACES: [[usize; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

fn binary_stl() -> Vec<u8> {
    let mut bytes = vec![0; 80];
    bytes.extend(4_u32.to_le_bytes());
    for face in FACES {
        bytes.extend([0; 12]);
        for value in face.into_iter().flat_map(|corner| CORNERS[corner]) {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend([0; 2]);
    }
    bytes
}

fn ascii_stl() -> String {
    let mut text = "solid tetrahedron\n".to_owned();
    for face in FACES {
        text += "facet normal 0 0 0\nouter loop\n";
        for [x, y, z] in face.map(|corner| CORNERS[corner]) {
            writeln!(text, "vertex {x} {y} {z}").unwrap();
        }
        text += "endloop\nendfacet\n";
    }
    text + "endsolid tetrahedron\n"
}

fn obj() -> String {
    let mut text = "mtllib none.mtl\no tetrahedron\n".to_owned();
    for [x, y, z] in CORNERS {
        writeln!(text, "v {x} {y} {z}").unwrap();
    }
    for [a, b, c] in FACES {
        writeln!(text, "f {} {} {}", a + 1, b + 1, c + 1).unwrap();
    }
    text
}

/// Returns a COLLADA file with the tetrahedron, an `asset` element, and the nodes of its scene.
fn dae(asset: &str, nodes: &str) -> String {
    format!(
        r##"<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset>{asset}</asset>
  <library_geometries>
    <geometry id="shape"><mesh>
      <source id="positions">
        <float_array id="numbers" count="12">0 0 0  1 0 0  0 2 0  0 0 3</float_array>
        <technique_common><accessor source="#numbers" count="4" stride="3"/></technique_common>
      </source>
      <source id="normals"><float_array id="more" count="3">0 0 1</float_array></source>
      <vertices id="vertices"><input semantic="POSITION" source="#positions"/></vertices>
      <triangles count="2">
        <input semantic="NORMAL" source="#normals" offset="0"/>
        <input semantic="VERTEX" source="#vertices" offset="1"/>
        <p>0 0 0 2 0 1  0 0 0 1 0 3</p>
      </triangles>
      <polylist count="2">
        <input semantic="VERTEX" source="#vertices" offset="0"/>
        <vcount>3 3</vcount>
        <p>0 3 2 1 2 3</p>
      </polylist>
    </mesh></geometry>
  </library_geometries>
  <library_nodes><node id="again"><scale>2 2 2</scale><instance_geometry url="#shape"/></node></library_nodes>
  <library_visual_scenes><visual_scene id="scene">{nodes}</visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#scene"/></scene>
</COLLADA>"##
    )
}

const PLAIN: &str = r##"<node><instance_geometry url="#shape"/></node>"##;

fn parsed(text: &str, up: UpAxis) -> Mesh {
    Mesh::parse("shape.dae", text.as_bytes(), up).unwrap()
}

#[test]
fn all_formats_give_the_same_mesh() {
    let bytes = [
        ("a.stl", binary_stl()),
        ("B.STL", ascii_stl().into_bytes()),
        ("c.Obj", obj().into_bytes()),
        ("d.DAE", dae("<up_axis>Z_UP</up_axis>", PLAIN).into_bytes()),
    ];
    for (name, bytes) in bytes {
        let mesh = Mesh::parse(name, &bytes, UpAxis::Follow).unwrap();
        assert_eq!(mesh.triangles().len(), 4, "{name}");
        assert!(close(extent(&mesh).1, [1.0, 2.0, 3.0]), "{name}");
        assert!((volume(&mesh) - 1.0).abs() < 1e-9, "{name}: {}", volume(&mesh));
    }
}

#[test]
fn a_binary_stl_may_say_that_it_is_solid() {
    let mut bytes = binary_stl();
    bytes[..12].copy_from_slice(b"solid hand\n\n");
    let mesh = Mesh::parse("a.stl", &bytes, UpAxis::Ignore).unwrap();
    assert!((volume(&mesh) - 1.0).abs() < 1e-9);
    bytes.pop();
    let error = message(Mesh::parse("a.stl", &bytes, UpAxis::Ignore));
    assert!(error.starts_with("mesh a.stl: ") && error.matches("a.stl").count() == 1, "{error}");
}

#[test]
fn a_file_is_read_from_its_path() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tetrahedron.STL");
    fs::write(&path, binary_stl()).unwrap();
    assert_eq!(Mesh::load(&path, UpAxis::Ignore).unwrap().triangles().len(), 4);
    let absent = message(Mesh::load(&folder.path().join("absent.stl"), UpAxis::Ignore));
    assert!(absent.contains("absent.stl: No such file") && absent.ends_with("check the path"), "{absent}");
    assert!(message(Mesh::load(folder.path(), UpAxis::Ignore)).contains("it is not a file"));
}

#[test]
fn unit_axis_and_nested_nodes_of_collada_are_applied() {
    // The tetrahedron is moved by 10 along x. The inner node is rotated about z by a quarter turn.
    let nodes = r##"<node>
        <matrix>1 0 0 10  0 1 0 0  0 0 1 0  0 0 0 1</matrix>
        <node><rotate>0 0 1 90</rotate><translate>100 0 0</translate><instance_geometry url="#shape"/></node>
    </node>"##;
    let asset = r#"<unit name="millimeter" meter="0.001"/><up_axis>Y_UP</up_axis>"#;
    // In the axes of the file, x is from 8 to 10, y from 100 to 101, and z from 0 to 3.
    let as_written = parsed(&dae(asset, nodes), UpAxis::Ignore);
    assert!(close(extent(&as_written).0, [0.008, 0.1, 0.0]), "{:?}", extent(&as_written));
    assert!(close(extent(&as_written).1, [0.01, 0.101, 0.003]));
    // y becomes z, and z becomes -y.
    let turned = parsed(&dae(asset, nodes), UpAxis::Follow);
    assert!(close(extent(&turned).0, [0.008, -0.003, 0.1]), "{:?}", extent(&turned));
    assert!(close(extent(&turned).1, [0.01, 0.0, 0.101]));
    assert!((volume(&turned) - 1e-9).abs() < 1e-15);
}

#[test]
fn collada_without_unit_and_axis_is_in_metres_with_y_up() {
    assert!(close(extent(&parsed(&dae("", PLAIN), UpAxis::Ignore)).1, [1.0, 2.0, 3.0]));
    assert!(close(extent(&parsed(&dae("", PLAIN), UpAxis::Follow)).1, [1.0, 0.0, 2.0]));
    let x_up = parsed(&dae("<up_axis>X_UP</up_axis>", PLAIN), UpAxis::Follow);
    assert!(close(extent(&x_up).0, [-2.0, -3.0, 0.0]) && close(extent(&x_up).1, [0.0, 0.0, 1.0]));
    assert!((volume(&x_up) - 1.0).abs() < 1e-9, "a rotation, not a mirror");
}

#[test]
fn a_mirroring_node_keeps_the_winding() {
    let nodes = r##"<node><scale>-1 1 1</scale><instance_geometry url="#shape"/></node>"##;
    let mesh = parsed(&dae("", nodes), UpAxis::Ignore);
    assert!(close(extent(&mesh).0, [-1.0, 0.0, 0.0]));
    assert!((volume(&mesh) - 1.0).abs() < 1e-9);
}

#[test]
fn nodes_may_be_placed_several_times_but_not_in_a_circle() {
    let nodes = r##"<node><instance_node url="#again"/><instance_geometry url="#shape"/></node>"##;
    let mesh = parsed(&dae("", nodes), UpAxis::Ignore);
    assert_eq!(mesh.triangles().len(), 8);
    assert!(close(extent(&mesh).1, [2.0, 4.0, 6.0]));
    let circle = r##"<node id="a"><instance_node url="#a"/><instance_node url="#a"/></node>"##;
    let circle = message(Mesh::parse("c.dae", dae("", circle).as_bytes(), UpAxis::Ignore));
    assert!(circle.contains("nested more than 64 deep"), "{circle}");
}

#[test]
fn strips_fans_and_polygons_are_cut_into_triangles() {
    for (element, count) in [("tristrips", 2), ("trifans", 2), ("polygons", 2), ("lines", 0)] {
        let element = format!(
            r##"<{element}><input semantic="VERTEX" source="#vertices" offset="0"/><p>0 1 2 3</p></{element}>"##
        );
        let text = dae("", PLAIN).replace("</mesh>", &format!("{element}</mesh>"));
        assert_eq!(parsed(&text, UpAxis::Ignore).triangles().len(), 4 + count, "{element}");
    }
}

#[test]
fn what_is_no_mesh_is_refused_in_one_line() {
    let parse = |name: &str, text: &str| message(Mesh::parse(name, text.as_bytes(), UpAxis::Follow));
    let error = parse("hand.ply", "ply");
    assert_eq!(error, "mesh hand.ply: the extension \"ply\" is not stl, dae or obj; convert the file");
    assert!(parse("hand", "").contains("extension \"\""));
    assert!(parse("a.obj", "# nothing\n").contains("it has no triangle"));
    assert!(parse("a.obj", "v 0 0 0\nf 1 2 3\n").starts_with("mesh a.obj: "));
    assert!(parse("a.stl", "not an STL").starts_with("mesh a.stl: "));
    assert!(parse("a.dae", "<COLLADA>").starts_with("mesh a.dae: "));
    assert_eq!(parse("a.dae", "<svg/>"), "mesh a.dae: this is an SVG drawing: name the file of the mesh");
    assert!(parse("a.dae", "\n\n<COLLADA>\n&</COLLADA>").contains(": line 4: "));
    assert!(parse("a.dae", &dae("", "")).contains("it has no triangle"));
    assert!(parse("a.dae", &dae("<unit meter=\"0\"/>", PLAIN)).contains("its unit is \"0\" m"));
    assert!(parse("a.dae", &dae("<up_axis>UP</up_axis>", PLAIN)).contains("its up_axis is \"UP\""));
    assert!(parse("a.dae", &dae("", PLAIN).replace("#shape", "#none")).contains("geometry \"#none\""));
    assert!(parse("a.dae", &dae("", PLAIN).replace("1 2 3</p>", "1 2 9</p>")).contains("vertex 9 of"));
    assert!(
        parse("a.dae", &dae("", PLAIN).replace("0 0 3</float", "0 0 x</float")).contains("\"x\" in element")
    );
    let nan = parse("a.dae", &dae("", PLAIN).replace("0 0 3</float", "0 0 NaN</float"));
    assert!(nan.contains("triangle 1 has the coordinate NaN, which is not finite"), "{nan}");
    let many = vec![[Point3::origin(); 3]; MAX_TRIANGLES + 1];
    let many = message(Mesh::new("many", many));
    assert_eq!(many, "mesh many: 1000001 triangles are too many (at most 1000000); decimate the mesh");
}

#[test]
fn files_that_stand_for_others_are_named() {
    let parse = |name: &str, text: &str| message(Mesh::parse(name, text.as_bytes(), UpAxis::Ignore));
    for name in ["a.stl", "a.obj", "a.dae"] {
        let lfs = parse(name, "version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 3\n");
        let expected = "a Git LFS pointer to a file, not the file: fetch it with `git lfs pull`";
        assert_eq!(lfs, format!("mesh {name}: this is {expected}"));
        let page = parse(name, "\n<!DOCTYPE html><html><p>404");
        assert!(page.ends_with("if the address is wrong: download the file itself"), "{page}");
        let sdf = parse(name, "<?xml version='1.0'?><sdf/>");
        assert!(sdf.contains("an SDF file of Gazebo"), "{sdf}");
    }
    let renamed = parse("a.stl", "<COLLADA/>");
    assert_eq!(renamed, "mesh a.stl: this is a COLLADA mesh: rename it to .dae, in the URDF too");
    let both = parse("a.obj", "v 0 0 0\n<<<<<<< HEAD\nv 1 0 0\n=======\nv 2 0 0\n>>>>>>> main\n");
    assert!(both.starts_with("mesh a.obj:2: this is a merge conflict of git: keep one side"), "{both}");
}

#[test]
fn a_face_of_an_obj_has_its_own_area() {
    let area = |mesh: &Mesh| mesh.triangles().iter().map(crate::surface::triangle_area).sum::<f64>();
    let text = "# notch\nv 0 0 0\nv 0.3 0 0 1 0.5 0.5\nv 0.3 0.25 0\nv 0.3 0.1 0 2\nv 0 0.25 0\n";
    for face in
        ["f 1 2 3 4 5", "f 5/1 1/2/3 2//1 \\\n 3 4 # all", "f -5 -4 -3 -2 -1", "p 1\nf 1 2\nf 2 3 4 5 1"]
    {
        let mesh = Mesh::parse("a.obj", format!("{text}{face}\n").as_bytes(), UpAxis::Ignore).unwrap();
        assert_eq!(mesh.triangles().len(), 3, "{face}");
        assert!((area(&mesh) - 0.045).abs() < 1e-8, "{face}: {}", area(&mesh));
    }
    let refused =
        |line: &str| message(Mesh::parse("a.obj", format!("{text}{line}\n").as_bytes(), UpAxis::Ignore));
    assert!(refused("f 1 2 6").contains("line 7: vertex 6 does not exist; 5 vertices come before the face"));
    assert!(refused("f 0 1 2").contains("vertex 0 does not exist"));
    assert!(refused("f 1 2 x").contains("\"x\" is not a corner of a face"));
    assert!(refused("v 1 2").contains("a vertex has 2 numbers, not 3"));
    assert!(refused("v 1 2 three").contains("\"three\" is not a number"));
    assert!(refused("f 1 3 2 5").contains("a polygon with 4 corners crosses itself"));
}

#[test]
fn primitives_are_closed_and_as_large_as_said() {
    let cuboid = Mesh::cuboid([0.2, 0.4, 0.6]).unwrap();
    assert!(close(extent(&cuboid).1, [0.1, 0.2, 0.3]) && close(extent(&cuboid).0, [-0.1, -0.2, -0.3]));
    assert!((volume(&cuboid) - 0.048).abs() < 1e-12);
    let cylinder = Mesh::cylinder(0.5, 2.0).unwrap();
    assert!(close(extent(&cylinder).1, [0.5, 0.5, 1.0]));
    assert!((volume(&cylinder) / (core::f64::consts::PI * 0.5) - 1.0).abs() < 0.01);
    let sphere = Mesh::sphere(0.5).unwrap();
    assert!(close(extent(&sphere).0, [-0.5; 3]));
    assert!((volume(&sphere) / (core::f64::consts::PI / 6.0) - 1.0).abs() < 0.01);
    for mesh in [cuboid, cylinder, sphere] {
        let area: Vector3<f64> = mesh.triangles().iter().map(|[a, b, c]| (b - a).cross(&(c - a))).sum();
        assert!(area.norm() < 1e-9, "closed");
    }
    let error = message(Mesh::cylinder(0.1, f64::NAN));
    assert_eq!(error, "cylinder with length NaN m: the size must be above 0 and finite");
    assert!(message(Mesh::cuboid([1.0, -1.0, 1.0])).contains("y -1 m"));
    assert!(message(Mesh::sphere(0.0)).contains("radius 0 m"));
}

proptest! {
    /// Any bytes are read as a mesh or cause an error; none of them cause a panic.
    #[test]
    fn no_bytes_stop_the_program(
        name in prop::sample::select(vec!["a.stl", "a.obj", "a.dae"]),
        at in any::<prop::sample::Index>(), put in any::<[u8; 3]>(), cut in any::<prop::sample::Index>(),
    ) {
        let mut bytes = match name {
            "a.stl" if put[0] < 128 => binary_stl(),
            "a.stl" => ascii_stl().into_bytes(),
            "a.obj" => obj().into_bytes(),
            _ => dae("", PLAIN).into_bytes(),
        };
        let from = at.index(bytes.len() - 3);
        bytes[from..from + 3].copy_from_slice(&put);
        if put[1] < 64 {
            bytes.truncate(cut.index(bytes.len()));
        }
        if let Ok(mesh) = Mesh::parse(name, &bytes, UpAxis::Follow) {
            prop_assert!(mesh.triangles().iter().flatten().flat_map(|corner| corner.iter()).all(|value| value.is_finite()));
        }
    }

    /// Faces may refer to vertices that do not exist, by positive and negative numbers.
    #[test]
    fn no_obj_face_stops_the_program(numbers in proptest::collection::vec(-6..7_i64, 0..9)) {
        let face: Vec<_> = numbers.iter().map(|number| format!("{number}/{number}/{number}")).collect();
        let text = format!("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nvt 0 0\nf {}\n", face.join(" "));
        let _ = Mesh::parse("a.obj", text.as_bytes(), UpAxis::Ignore).is_ok();
    }
}
