//! Files that are not quite XML, or not quite URDF: those that are accepted, and the errors for those that are not.

use crate::{Urdf, decode_text};

use super::written::wrap;

const ARM: &str = r#"<link name="a"/><link name="b"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><limit lower="-1" upper="1"/></joint>
"#;

fn read(xml: &str) -> Urdf {
    Urdf::parse("t.urdf", xml).unwrap_or_else(|error| panic!("{error}\n{xml}"))
}

fn refused(xml: &str) -> String {
    let message = Urdf::parse("t.urdf", xml).unwrap_err().to_string();
    assert_eq!(message.lines().count(), 1, "{message}");
    message
}

#[test]
fn prefixes_that_nothing_binds_are_read() {
    let plain = read(&wrap(ARM));
    for inner in [
        r#"<link drake:ignore="1" name="a"/>"#,
        r#"<link name="a"/><gazebo><sensor:camera name="c"><sensor:pose/></sensor:camera></gazebo>"#,
        r#"<link name="a"/><s:link name="ghost"/>"#,
    ] {
        assert_eq!(read(&wrap(&ARM.replace(r#"<link name="a"/>"#, inner))), plain, "{inner}");
    }
}

#[test]
fn what_changes_no_value_is_read() {
    let good = wrap(ARM);
    let plain = read(&good);
    let robot = "<robot name=\"test\">";
    for (from, to) in [
        (robot, "<robot name=\"test\"><!-- a -- b --><!------ c ------>"),
        ("<?xml version=\"1.0\"?>", "<?xml version=\"1.0\"?><!DOCTYPE robot>"),
        ("<?xml version=\"1.0\"?>", "<?xml version=\"1.0\"?><!DOCTYPE robot SYSTEM \"urdf.dtd\">"),
        ("</robot>\n", "</robot>\n\0\0"),
        (
            robot,
            "<robot name=\"test\" xmlns:xacro=\"x\"><xacro:property name=\"w\" value=\"${2 * v}\"/><xacro:arg name=\"n\" default=\"$(find p)\"/>",
        ),
        (robot, "<robot name=\"test\"><xacro:property name=\"w\" value=\".2\"/>"),
    ] {
        assert!(good.contains(from));
        assert_eq!(read(&good.replace(from, to)), plain, "{to}");
    }
}

#[test]
fn other_faults_have_their_line_and_what_to_do() {
    let good = wrap(ARM);
    for (from, to, expected) in [
        ("</robot>\n", "</robot>\n<robot/>", "t.urdf:6: there is content after the root element: delete it"),
        (
            "</robot>",
            "",
            "t.urdf:4: the root element is not closed, so the file is incomplete: copy or download it again",
        ),
        (
            "<link name=\"b\"/>",
            "\n<link name=\"b&c\"/>",
            "t.urdf:4: the & does not begin an XML entity: write &amp; instead",
        ),
        (
            "<robot",
            "<!-- x -->\n<?xml version=\"1.0\"?><robot",
            "t.urdf:3: the XML declaration is not at the beginning of the file: delete it",
        ),
        ("</joint>", "</link>", "t.urdf:4: </link> does not close the open <joint>: correct one of the two"),
        ("type=", "name=", "t.urdf:4: an element has the attribute name twice: delete one"),
        (
            "<robot",
            "<!DOCTYPE r [<!ENTITY a \"1\">]>\n<robot",
            "t.urdf:2: the <!DOCTYPE contains definitions, which this program does not read: delete it, and \
             replace its entities by their values",
        ),
    ] {
        assert_eq!(refused(&good.replacen(from, to, 1)), expected);
    }
    // Blank lines before the first tag count.
    assert!(refused("\n\n<robot>\n&</robot>").starts_with("t.urdf:4: the & "));
    // An element with many attributes is refused before the parser compares each of them with all others.
    let many: String = (0..50_000).map(|number| format!(" a{number}=''")).collect();
    let expected = "t.urdf:3: element link has 50001 attributes, but at most 256 are allowed: delete some";
    assert_eq!(refused(&wrap(&format!("<link name=\"a\"{many}/>"))), expected);
}

#[test]
fn a_file_of_another_kind_is_named() {
    let lfs = "version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 3\n";
    assert_eq!(
        refused(lfs),
        "t.urdf: this is a Git LFS pointer to a file, not the file: fetch it with `git lfs pull`"
    );
    let page = "t.urdf: this is a web page (HTML), which a server may send if the address is wrong: download the file itself";
    assert_eq!(refused("<!DOCTYPE html>\n<html lang=en><p>404"), page);
    assert_eq!(
        refused(&wrap(&format!("{ARM}<<<<<<< HEAD\n=======\n>>>>>>> main\n"))),
        "t.urdf:5: this is a merge conflict of git: keep one side, and delete the other side and the lines <<<<<<<, \
         ======= and >>>>>>>"
    );
    let other = |element: &str, kind: &str| {
        let expected = format!(
            "t.urdf:1: the outermost element is {element:?}{kind}; that of a URDF is `robot`: give the path of the robot's URDF"
        );
        assert_eq!(refused(&format!("<{element}/>")), expected);
    };
    other("sdf", " (an SDF file of Gazebo)");
    other("mujoco", " (an MJCF file of MuJoCo)");
    other("COLLADA", " (a COLLADA mesh)");
    other("x", "");
    let srdf =
        "<robot name=\"r\">\n<group name=\"arm\"><chain base_link=\"a\" tip_link=\"b\"/></group></robot>";
    assert_eq!(
        refused(srdf),
        "t.urdf:1: this is an SRDF file (MoveIt), which has no links: give the path of the robot's URDF"
    );
}

#[test]
fn a_declared_encoding_is_read() {
    let declared = |name: &str| {
        let comment = "<!-- M\u{fc}ller -->\n<robot";
        let declaration = format!("<?xml version=\"1.0\" encoding=\"{name}\"?>");
        wrap(ARM).replace("<?xml version=\"1.0\"?>", &declaration).replace("<robot", comment)
    };
    let latin =
        |text: &str| text.chars().map(|letter| u8::try_from(u32::from(letter)).unwrap()).collect::<Vec<_>>();
    let mut expected = read(&declared("UTF-8"));
    for bytes in [latin(&declared("ISO-8859-1")), latin(&declared("windows-1252"))] {
        let decoded = decode_text("t.urdf", &bytes).unwrap();
        assert_eq!(decoded, declared("UTF-8"), "the declaration is of the text, too");
        expected.file = "t.urdf".to_owned();
        assert_eq!(read(&decoded), expected);
    }
    let message = decode_text("t.urdf", &latin(&declared("UTF-8"))).unwrap_err().to_string();
    assert!(
        message.starts_with("t.urdf:2: it is not UTF-8, declared as utf-8: save it as UTF-8"),
        "{message}"
    );
}

#[test]
fn utf_16_is_refused_as_by_ros_with_a_command_that_repairs_it() {
    let declared =
        wrap(ARM).replace("<?xml version=\"1.0\"?>", "<?xml version=\"1.0\" encoding=\"UTF-16\"?>");
    for (mark, name) in [("\u{feff}", "utf-16"), ("", "utf-16le")] {
        let wide: Vec<_> = format!("{mark}{declared}").encode_utf16().flat_map(u16::to_le_bytes).collect();
        assert_eq!(
            decode_text("t.urdf", &wide).unwrap_err().to_string(),
            format!(
                "t.urdf: the file is UTF-16, which ROS cannot read either: save it as UTF-8, for example with `iconv -f {name} -t utf-8 FILE > NEW`"
            )
        );
    }
    // The command leaves the declaration unchanged.
    assert_eq!(decode_text("t.urdf", declared.as_bytes()).unwrap(), declared);
    read(&declared);
}

#[test]
fn xacro_that_is_used_is_named() {
    let refused =
        |inner: &str| refused(&wrap(&format!("<xacro:property name=\"w\" value=\"1\"/>\n{inner}\n{ARM}")));
    for (inner, what) in [
        ("<gazebo><x>${w}</x></gazebo>", "expression ${w}"),
        ("<gazebo file=\"a/$(find p)/b\"/>", "expression $(find p)"),
        ("<xacro:arm name=\"a\"/>", "element <xacro:arm>"),
        ("<xacro:if value=\"1\"/>", "element <xacro:if>"),
    ] {
        let message = refused(inner);
        assert!(
            message.starts_with(&format!("t.urdf:4: {what} is not expanded: this is a xacro file")),
            "{message}"
        );
        assert!(message.contains("`xacrodoc t.urdf -o NEW.urdf` (pip install xacrodoc)"), "{message}");
    }
}

#[test]
fn a_faulty_shape_is_an_error_when_it_is_used() {
    for (shape, expected) in [
        (
            "<geometry><mesh filename=\"a.stl\" scale=\"0.001\"/></geometry>",
            "scale = \"0.001\": must be three factors, as in \"0.001 0.001 0.001\"",
        ),
        (
            "<geometry><mesh filename=\"a.stl\" scale=\"1 1 1 1\"/></geometry>",
            "scale = \"1 1 1 1\": must be three factors",
        ),
        ("<geometry><mesh/></geometry>", "has no filename: add it"),
        ("<geometry><mesh filename=\"\"/></geometry>", "has no filename: add it"),
        ("<geometry><mesh filename=\"$(find p)/a.stl\"/></geometry>", "expression $(find p) is not expanded"),
        ("<geometry><box/></geometry>", "has no size: add it"),
        ("<geometry><box size=\"1 2\"/></geometry>", "size = \"1 2\": must be three lengths in m"),
        ("<geometry><sphere/></geometry>", "has no radius: add it"),
        (
            "<origin xyz=\"1, 2, 3\"/><geometry><sphere radius=\"1\"/></geometry>",
            "three lengths in m, separated by blanks, not commas",
        ),
    ] {
        for element in ["visual", "collision"] {
            let link = format!("<link name=\"a\">\n<{element}>{shape}</{element}></link>");
            let urdf = read(&wrap(&ARM.replace("<link name=\"a\"/>", &link)));
            assert!(urdf.chain(None, "b").is_ok() && urdf.visuals("b").unwrap().is_empty());
            let (visuals, collisions) = (urdf.visuals("a"), urdf.collisions("a"));
            let (used, other) =
                if element == "visual" { (visuals, collisions) } else { (collisions, visuals) };
            assert!(other.unwrap().is_empty());
            let message = used.unwrap_err().to_string();
            assert!(message.starts_with("t.urdf:4: ") && message.contains(expected), "{message}");
        }
    }
}

#[test]
fn a_control_character_that_the_parser_quotes_leaves_one_line() {
    // `refused` checks that the message is one line.
    let message = refused("<robot name=\"r\"><link name=\"a\" /\n></robot>");
    assert!(message.contains("\\u{a}"), "{message}");
}
