//! Tests of files and chains that are rejected, and of their error messages.

use crate::{CellOnLink, SkinImport, Urdf, UrdfChain};

use super::written::{TestJoint, robot, wrap};

fn parse(xml: &str) -> String {
    Urdf::parse("t.urdf", xml).unwrap_err().to_string()
}

/// Returns the error for the chain from the root to this tip.
fn chain(xml: &str, tip: &str) -> String {
    Urdf::parse("t.urdf", xml).unwrap().chain(None, tip).unwrap_err().to_string()
}

fn good(xml: &str, tip: &str) -> UrdfChain {
    Urdf::parse("t.urdf", xml).unwrap().chain(None, tip).unwrap()
}

/// Returns a URDF with links `a` and `b` and a joint of this type between them.
fn joined(kind: &str, inner: &str) -> String {
    wrap(&format!(
        "<link name=\"a\"/>\n<link name=\"b\"/>\n<joint name=\"j\" type=\"{kind}\"><parent link=\"a\"/><child link=\"b\"/>{inner}</joint>\n"
    ))
}

const LIMIT: &str = "<limit lower=\"-1\" upper=\"1\"/>";

#[test]
fn files_that_are_no_urdf() {
    let empty = "t.urdf: the file is empty; a URDF has a robot element with links and joints";
    assert_eq!(parse(""), empty);
    assert_eq!(parse("\u{feff} \n"), empty);
    assert_eq!(
        parse("robot"),
        "t.urdf:1: not XML: a URDF begins with <?xml or <robot; give the path of the robot's URDF"
    );
    assert_eq!(
        parse("<sdf/>"),
        "t.urdf:1: the outermost element is \"sdf\" (an SDF file of Gazebo); that of a URDF is `robot`: give \
         the path of the robot's URDF"
    );
    assert_eq!(parse("<robot/>"), "t.urdf:1: the robot has no links; a URDF has at least one");
    // Lines are those of the file, whatever stands before the first tag.
    assert_eq!(parse("\n\n<robot>\n</robot>"), "t.urdf:3: the robot has no links; a URDF has at least one");
}

#[test]
fn xacro_is_refused_where_it_was_not_run() {
    let why = "is not expanded: this is a xacro file, a template of a URDF. Generate the URDF with `xacrodoc t.urdf -o NEW.urdf` (pip install xacrodoc), and give its path";
    let bound =
        "<robot xmlns:xacro=\"http://www.ros.org/wiki/xacro\">\n<xacro:arm/><link name=\"a\"/></robot>";
    assert_eq!(parse(bound), format!("t.urdf:2: element <xacro:arm> {why}"));
    assert_eq!(
        parse(&bound.replace(" xmlns:xacro=\"http://www.ros.org/wiki/xacro\"", "")),
        format!("t.urdf:2: element <xacro:arm> {why}")
    );
    let expression = joined("revolute", "<origin xyz=\"${length} 0 0\"/>");
    assert_eq!(parse(&expression), format!("t.urdf:5: expression ${{length}} {why}"));
    // The output of xacro still declares its namespace.
    let run = bound.replace("<xacro:arm/>", "<!-- <xacro:arm/> ${x} -->");
    assert_eq!(Urdf::parse("t.urdf", &run).unwrap().root(), "a");
}

#[test]
fn values_that_are_not_allowed() {
    let value = |inner: &str| parse(&joined("revolute", inner));
    let triple = "t.urdf:5: joint \"j\": xyz = \"1 2\": must be three lengths in m";
    assert_eq!(value("<origin xyz=\"1 2\"/>"), triple);
    assert_eq!(
        value("<origin rpy=\"0 0 inf\"/>"),
        "t.urdf:5: joint \"j\": rpy = \"0 0 inf\": must be three angles in rad"
    );
    assert_eq!(
        value("<axis xyz=\"0 0 0\"/>"),
        "t.urdf:5: joint \"j\": xyz = \"0 0 0\": must be three numbers, not all zero"
    );
    assert!(value("<axis xyz=\"1e300 0 0\"/>").ends_with("must be three numbers, not all zero"));
    assert_eq!(
        value("<limit lower=\"-1,5\"/>"),
        "t.urdf:5: joint \"j\": lower = \"-1,5\": must be one number with a decimal point"
    );
    assert_eq!(
        value("<origin quat_xyzw=\"0 0 0 1\"/>"),
        "t.urdf:5: joint \"j\": quat_xyzw = \"0 0 0 1\": must be given as rpy, the angles in rad"
    );
    assert_eq!(
        parse(&joined("hinge", "")),
        "t.urdf:5: joint \"j\": type = \"hinge\": must be revolute, continuous, prismatic, fixed, floating or planar"
    );
    assert_eq!(parse(&wrap("<link/>")), "t.urdf:3: link has no name: add it");
    assert_eq!(
        parse(&joined("fixed", "").replace("<child link=\"b\"/>", "")),
        "t.urdf:5: joint \"j\" has no child: add it"
    );
}

#[test]
fn links_that_are_no_tree() {
    let joint = |name: &str, parent: &str, child: &str| {
        format!(
            "<joint name=\"{name}\" type=\"fixed\"><parent link=\"{parent}\"/><child link=\"{child}\"/></joint>\n"
        )
    };
    let three = "<link name=\"a\"/><link name=\"b\"/><link name=\"c\"/>\n";
    let tree = |joints: &[String]| parse(&wrap(&(three.to_owned() + &joints.concat())));
    assert_eq!(
        parse(&wrap("<link name=\"a\"/>\n<link name=\"a\"/>\n")),
        "t.urdf:4: two links are named \"a\"; each needs a unique name: rename one"
    );
    assert_eq!(
        tree(&[joint("j", "a", "b"), joint("j", "a", "c")]),
        "t.urdf:5: two joints are named \"j\"; each needs a unique name: rename one"
    );
    assert_eq!(
        tree(&[joint("j", "a", "d")]),
        "t.urdf:4: joint \"j\" has the child \"d\", but there is no such link; similar names: \"a\", \"b\" or \"c\""
    );
    assert_eq!(
        tree(&[joint("j", "d", "a")]).split(',').next().unwrap(),
        "t.urdf:4: joint \"j\" has the parent \"d\""
    );
    assert_eq!(
        tree(&[joint("j", "a", "b")]),
        "t.urdf: the links \"a\" and \"c\" have no parent; only one root is allowed: connect them with a fixed joint"
    );
    assert_eq!(
        tree(&[joint("j", "a", "c"), joint("k", "b", "c")]),
        "t.urdf:5: link \"c\" is the child of the joints \"j\" and \"k\"; only one is allowed: remove the other"
    );
    let cycle = "is its own ancestor; links must form a tree: remove a joint of the cycle";
    assert_eq!(tree(&[joint("j", "b", "c"), joint("k", "c", "b")]), format!("t.urdf: link \"b\" {cycle}"));
    let whole = [joint("j", "b", "c"), joint("k", "c", "a"), joint("l", "a", "b")];
    assert_eq!(tree(&whole), format!("t.urdf: link \"a\" {cycle}"));
    // A joint from a link to itself leaves the other link as the only root.
    let itself = joined("fixed", "").replace("link=\"b\"", "link=\"a\"");
    assert_eq!(parse(&itself), format!("t.urdf: link \"a\" {cycle}"));
}

#[test]
fn joints_that_a_chain_cannot_have() {
    for kind in ["floating", "planar"] {
        assert_eq!(
            chain(&joined(kind, ""), "b"),
            format!(
                "t.urdf:5: joint \"j\" is {kind}; a chain may only have revolute, continuous, prismatic and fixed joints: choose a root below it, or a tip above it"
            )
        );
    }
    assert_eq!(
        chain(&joined("revolute", &format!("{LIMIT}<mimic joint=\"k\"/>")), "b"),
        "t.urdf:5: joint \"j\" mimics \"k\"; the joints of a chain must move independently: choose a tip above it, or make it fixed"
    );
    for limit in ["", "<limit velocity=\"1\"/>"] {
        assert_eq!(
            chain(&joined("revolute", limit), "b"),
            "t.urdf:5: joint \"j\" has no limits: add <limit lower=\"..\" upper=\"..\"/>, or make the joint continuous or fixed"
        );
    }
    for (limit, text) in [
        ("<limit lower=\"0\"/>", "0 to 0"),
        ("<limit lower=\"1\" upper=\"1\"/>", "1 to 1"),
        ("<limit lower=\"1\" upper=\"-1\"/>", "1 to -1"),
        ("<limit lower=\"-inf\" upper=\"1\"/>", "-inf to 1"),
    ] {
        assert_eq!(
            chain(&joined("prismatic", limit), "b"),
            format!(
                "t.urdf:5: joint \"j\" has the limits {text}; the lower must be below the upper, both finite: correct them, or make the joint fixed"
            )
        );
    }
    assert_eq!(
        chain(&joined("fixed", ""), "b"),
        "t.urdf: no joint moves between \"a\" and \"b\", but a chain needs 1 to 14 moving joints: choose a tip \
         farther out, or a root nearer to the base"
    );
    assert_eq!(chain(&joined("fixed", ""), "a"), chain(&joined("fixed", ""), "b").replace("\"b\"", "\"a\""));
}

#[test]
fn chains_that_are_not_there() {
    let joints = vec![TestJoint::hinge([0.1, 0.0, 0.0], [0.0; 3]); 15];
    let xml = robot(&joints);
    assert_eq!(
        chain(&xml, "l15"),
        "t.urdf: 15 joints move between \"l0\" and \"l15\"; the maximum is 14: choose a root and a tip that are \
         nearer to each other"
    );
    assert_eq!(good(&xml, "l14").joints.len(), 14);
    assert_eq!(
        chain(&xml, "L2x"),
        "t.urdf: there is no link \"L2x\"; similar names: \"l2\", \"l0\" or \"l1\""
    );
    let urdf = Urdf::parse("t.urdf", &xml).unwrap();
    assert_eq!(
        urdf.chain(Some("l4"), "l2").unwrap_err().to_string(),
        "t.urdf: link \"l2\" is not below \"l4\"; the path to it is l0 > l1 > l2: choose a root on that path"
    );
    assert!(urdf.pose("x", &|_| 0.0).is_err() && urdf.visuals("x").is_err() && urdf.collisions("x").is_err());
}

#[test]
fn chains_that_are_too_long() {
    let long =
        |x: f64| robot(&[TestJoint::hinge([0.0; 3], [0.0; 3]), TestJoint::hinge([x, 0.0, 0.0], [0.0; 3])]);
    assert_eq!(
        chain(&long(2.5), "l2"),
        "t.urdf: row 1, to joint \"j2\": a = 2.500 m; allowed: [-2, 2) m; choose a tip nearer to the root"
    );
    assert_eq!(good(&long(1.99), "l2").rows.len(), 2);
    let slide =
        |upper: f64| robot(&[TestJoint { limits: [0.0, upper], ..TestJoint::slide([0.0; 3], [0.0; 3]) }]);
    assert_eq!(
        chain(&slide(2.25), "l1"),
        "t.urdf: row 1, to link \"l1\": d with the joint at its limit = 2.250 m; allowed: [-2, 2) m; choose a root behind that joint, or narrow its limits"
    );
    assert_eq!(good(&slide(1.75), "l1").rows.len(), 1);
    let reaching = |x: f64| {
        let hinge = TestJoint::hinge([x, 0.0, 0.0], [0.0; 3]);
        robot(&[hinge.clone(), hinge.clone(), hinge, TestJoint::fixed([0.5, 0.0, 0.0], [0.0; 3])])
    };
    assert_eq!(
        chain(&reaching(0.8), "l4"),
        "t.urdf: link \"l4\" is too far from an earlier link of its chain: the distance can reach 2.100 m, but must be \
         below 1.999 m: choose a root and a tip that are nearer to each other"
    );
    assert_eq!(good(&reaching(0.8), "l3").rows.len(), 3);
    assert_eq!(good(&reaching(0.74), "l4").rows.len(), 3);
}

#[test]
fn what_the_skins_check_refuses_has_the_line_of_its_cell() {
    let urdf = Urdf::parse("t.urdf", &robot(&[TestJoint::hinge([0.0, 0.0, 0.1], [0.0; 3])])).unwrap();
    let chains = [urdf.chain(None, "l1").unwrap()];
    let refused = |cells: &[CellOnLink]| {
        let import = SkinImport { name: "t", command: "", urdf: None, chains: &chains, cells };
        let error = import.toml().unwrap_err();
        assert!(error.is_error_in_cells());
        error.to_string()
    };
    let cell = |line: usize, bus: Option<String>, node: Option<u8>| CellOnLink {
        link: "l1".to_owned(),
        normal: [0.0, 0.0, 1.0],
        bus,
        node,
        line,
        ..CellOnLink::default()
    };
    let nodes = [cell(2, None, Some(1)), cell(5, None, Some(255))];
    assert_eq!(refused(&nodes), "line 5: node = 255: must be 1 to 254; further cells need another bus");
    let buses: Vec<_> = (2..67).map(|line| cell(line, Some(format!("b{line}")), None)).collect();
    assert_eq!(refused(&buses), "bus = 65 buses: a skin can have at most 64 buses");
}
