use std::fmt::Write as _;

use crate::mesh::{Mesh, UpAxis};

/// Returns a geometry with a tetrahedron that begins at `x` and has these primitives. The ids of its sources are the
/// same for all geometries.
fn geometry(id: &str, x: f64, primitives: &str) -> String {
    format!(
        r##"<geometry id="{id}"><mesh>
          <source id="pos"><float_array id="array" count="12">{x} 0 0  {} 0 0  {x} 2 0  {x} 0 3</float_array>
            <technique_common><accessor source="#array" count="4" stride="3"/></technique_common></source>
          <vertices id="pos"><input semantic="POSITION" source="#pos"/></vertices>{primitives}
        </mesh></geometry>"##,
        x + 1.0
    )
}

const TRIANGLES: &str = r##"<triangles count="4"><input semantic="VERTEX" source="#pos" offset="0"/>
    <p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>"##;

fn file(geometries: &str, nodes: &str, more: &str) -> String {
    format!(
        r##"<COLLADA><library_geometries>{geometries}</library_geometries>{more}
        <library_visual_scenes><visual_scene id="a">{nodes}</visual_scene></library_visual_scenes>
        <scene><instance_visual_scene url="#a"/></scene></COLLADA>"##
    )
}

fn placed(ids: &[&str]) -> String {
    ids.iter().fold("<node>".to_owned(), |mut text, id| {
        write!(text, r##"<instance_geometry url="#{id}"/>"##).unwrap();
        text
    }) + "</node>"
}

fn parse(text: &str) -> Result<Mesh, String> {
    Mesh::parse("a.dae", text.as_bytes(), UpAxis::Ignore).map_err(|error| error.to_string())
}

/// Returns the smallest x coordinate of each tetrahedron.
fn places(mesh: &Mesh) -> Vec<f64> {
    let x = mesh.triangles().chunks(4).map(|four| four.iter().flatten().map(|corner| corner.x));
    x.map(|x| x.fold(f64::INFINITY, f64::min)).collect()
}

#[test]
fn geometries_may_share_the_names_of_their_sources() {
    // The scene, a geometry, its sources and its vertices share one id.
    let geometries = geometry("a", 0.0, TRIANGLES) + &geometry("b", 5.0, TRIANGLES);
    let mesh = parse(&file(&geometries, &placed(&["a", "b", "a"]), "")).unwrap();
    assert_eq!(places(&mesh), [0.0, 5.0, 0.0]);
    // The second geometry has fewer points.
    let short =
        geometry("b", 5.0, "").replace("count=\"12\"", "count=\"3\"").replace("  6 0 0  5 2 0  5 0 3", "");
    let mesh = parse(&file(&(geometry("a", 0.0, TRIANGLES) + &short), &placed(&["a", "b"]), "")).unwrap();
    assert_eq!(places(&mesh), [0.0]);
}

#[test]
fn a_name_of_several_elements_is_refused_where_it_is_used() {
    let twice = geometry("a", 0.0, TRIANGLES) + &geometry("a", 5.0, TRIANGLES);
    let error = parse(&file(&twice, &placed(&["a"]), "")).unwrap_err();
    assert_eq!(error, "mesh a.dae: the id \"a\" belongs to 2 geometry elements; export it again");
    let both = twice + &geometry("b", 7.0, TRIANGLES);
    assert_eq!(places(&parse(&file(&both, &placed(&["b"]), "")).unwrap()), [7.0]);
    let sources = geometry("a", 0.0, TRIANGLES).replace("<vertices", "<source id=\"pos\"/><vertices");
    assert!(
        parse(&file(&sources, &placed(&["a"]), "")).unwrap_err().contains("belongs to 2 source elements")
    );
    // A source that is not in the geometry is searched for in the whole file, where several elements have its id.
    let elsewhere =
        geometry("c", 0.0, TRIANGLES).replace("source=\"#pos\"/></vertices>", "source=\"#far\"/></vertices>");
    let missing = parse(&file(&elsewhere, &placed(&["c"]), "")).unwrap_err();
    assert!(missing.contains("source \"#far\" does not exist"), "{missing}");
    let far = geometry("d", 9.0, "").replace("<source id=\"pos\"", "<source id=\"far\"");
    assert_eq!(places(&parse(&file(&(elsewhere + &far), &placed(&["c"]), "")).unwrap()), [9.0]);
}

#[test]
fn nodes_and_scenes_are_found_by_kind_and_missed_in_words() {
    let library = r##"<library_nodes><node id="a"><instance_geometry url="#a"/></node></library_nodes>"##;
    let shape = geometry("a", 2.0, TRIANGLES);
    let mesh = parse(&file(&shape, r##"<node><instance_node url="#a"/></node>"##, library)).unwrap();
    assert_eq!(places(&mesh), [2.0]);
    for (nodes, words) in [
        (r##"<node><instance_node url="#b"/></node>"##, "node \"#b\" does not exist"),
        (r#"<node><instance_node url="b.dae#a"/></node>"#, "its node \"b.dae#a\" is in another file"),
        (r##"<node><instance_controller url="#c"/></node>"##, "controller \"#c\" deforms a mesh"),
    ] {
        let error = parse(&file(&shape, nodes, library)).unwrap_err();
        assert!(error.contains(words), "{error}");
    }
    let lost = file(&shape, &placed(&["a"]), "").replace("scene url=\"#a\"", "scene url=\"#z\"");
    assert!(parse(&lost).unwrap_err().contains("visual_scene \"#z\" does not exist"));
}

#[test]
fn polygons_of_each_kind_have_their_own_area() {
    // The points form a square with a notch, and a square with a hole, both in the plane of x and y.
    let points = "0 0 0 3 0 0 3 3 0 1.5 1 0 0 3 0  1 0.2 0 2 0.2 0 2 0.6 0 1 0.6 0";
    let with = |primitives: &str| {
        let text = geometry("a", 0.0, primitives).replace("count=\"12\"", "count=\"27\"");
        file(&text.replace("0 0 0  1 0 0  0 2 0  0 0 3", points), &placed(&["a"]), "")
    };
    let input = r##"<input semantic="VERTEX" source="#pos" offset="0"/>"##;
    for (primitives, area) in [
        (format!("<polylist count=\"1\">{input}<vcount>5</vcount><p>0 1 2 3 4</p></polylist>"), 6.0),
        (format!("<polygons count=\"2\">{input}<p>2 3 4 0 1</p><p>5 6 7 8</p></polygons>"), 6.4),
        (format!("<polygons count=\"1\">{input}<ph><p>0 1 2 3 4</p><h>5 6 7 8</h></ph></polygons>"), 5.6),
    ] {
        let mesh = parse(&with(&primitives)).unwrap();
        let got: f64 = mesh.triangles().iter().map(crate::surface::triangle_area).sum();
        assert!((got - area).abs() < 1e-9, "{primitives}: {got}");
    }
    for (primitives, words) in [
        (
            format!("<polylist>{input}<vcount>5</vcount><p>0 1 2</p></polylist>"),
            "has 3 corners, but its vcount announces 5",
        ),
        (
            format!("<polylist>{input}<vcount>3</vcount><p>0 1 2 3</p></polylist>"),
            "has 4 corners, but its vcount announces 3",
        ),
        (
            format!("<triangles>{input}<p>0 1 2 3</p></triangles>"),
            "triangles have 4 corners, which is not a multiple of 3",
        ),
        (
            format!("<triangles count=\"2\">{input}<p>0 1 2</p></triangles>"),
            "the file has 1 triangles, but announces 2",
        ),
        (
            format!("<polygons count=\"1\">{input}<p>0 2 1 4</p></polygons>"),
            "a polygon with 4 corners crosses itself",
        ),
    ] {
        let error = parse(&with(&primitives)).unwrap_err();
        assert!(error.contains(words), "{error}");
    }
    let short = file(&geometry("a", 0.0, TRIANGLES), &placed(&["a"]), "").replace("  0 0 3<", "<");
    assert!(parse(&short).unwrap_err().contains("the file has 9 numbers in a float_array, but announces 12"));
}

#[test]
fn other_encodings_and_blanks_before_the_declaration_are_read() {
    let body = file(&geometry("a", 4.0, TRIANGLES), &placed(&["a"]), "<!-- M\u{fc}ller -->");
    let declared = |encoding: &str| format!("<?xml version=\"1.0\" encoding=\"{encoding}\"?>{body}");
    let latin = |text: &str| text.chars().map(|it| u8::try_from(u32::from(it)).unwrap()).collect::<Vec<_>>();
    let wide = |bytes: fn(u16) -> [u8; 2]| {
        let text = format!("\u{feff}{}", declared("UTF-16"));
        text.encode_utf16().flat_map(bytes).collect::<Vec<_>>()
    };
    for bytes in [
        format!("\n\n{}", declared("utf-8")).into_bytes(),
        format!("\u{feff}{}", declared("utf-8")).into_bytes(),
        latin(&declared("ISO-8859-1")),
        wide(u16::to_le_bytes),
        wide(u16::to_be_bytes),
    ] {
        let mesh = Mesh::parse("a.dae", &bytes, UpAxis::Ignore).unwrap();
        assert_eq!(places(&mesh), [4.0]);
    }
    let undeclared = Mesh::parse("a.dae", &latin(&body), UpAxis::Ignore).unwrap_err().to_string();
    assert!(undeclared.contains("it is not UTF-8"), "{undeclared}");
}
