use super::*;

pub(super) const GOOD: &str = r#"version = 1
name = "two"

[robot]
name = "elbow"
joints = [
  { a = 0.0, alpha = 1.5707963267948966, d = 0.1, theta_offset = 0.0 },
  { a = 0.5, alpha = 0.0, d = 0.0, theta_offset = -0.5 },
]

[timing]
control_hz = 500.0
joint_broadcast_hz = 62.5

[contact]
alpha_c = 1.0
force_threshold_n = 0.1

[[bus]]
name = "vcan0"
reply = "torque"
format = "fd"

[controller]
kind = "kinesthetic"
inertia = [1.0, 1.0]
damping = [4.0, 4.0]
max_speed_rad_s = [2.0, 2.0]

[[cell]]
bus = "vcan0"
node = 1
joint = 2
position = [0.1, 0.0, 0.06]
orientation = [0.0, 0.0, 0.0, 1.0]
neighbors = [2, 0, 0, 0]

[[cell]]
bus = "vcan0"
node = 2
joint = 1
position = [0.0, 0.1, 0.0]
orientation = [0.7071068, 0.0, 0.0, 0.7071068]
alpha_c = 0.5
neighbors = [0, 0, 0, 1]
"#;

/// Returns a skin with one bus. Each element gives the neighbours of a cell and whether it is a root; cells are
/// numbered from 1.
pub(super) fn wired(cells: &[([i64; 4], bool)]) -> Skin {
    Skin::parse("skin.toml", &wired_text("reply = \"torque\"", cells)).unwrap()
}

fn wired_text(reply: &str, cells: &[([i64; 4], bool)]) -> String {
    let (head, _) = GOOD.split_once("[[cell]]").unwrap();
    let mut text = head.replacen("reply = \"torque\"", reply, 1);
    for (at, (neighbors, root)) in cells.iter().enumerate() {
        let node = at + 1;
        text.push_str(&format!(
            "[[cell]]\nbus = \"vcan0\"\nnode = {node}\njoint = 1\nposition = [0.1, 0.0, 0.0]\n\
             orientation = [0.0, 0.0, 0.0, 1.0]\nneighbors = {neighbors:?}\nroot = {root}\n"
        ));
    }
    text
}

fn by_line(error: DocumentError) -> String {
    let DocumentError::InvalidValue { path, line, what, .. } = error else { return error.to_string() };
    format!("{path}:{line}: {what}")
}

fn says(from: &str, to: &str) -> String {
    assert!(GOOD.contains(from), "{from}");
    by_line(Skin::parse("skin.toml", &GOOD.replacen(from, to, 1)).unwrap_err())
}

#[test]
fn a_good_skin_is_read() {
    let skin = Skin::parse("skin.toml", GOOD).unwrap();
    assert_eq!(skin.timing.ticks_per_broadcast, 8);
    assert_eq!(skin.timing.tick_nanos(), 2_000_000);
    let [first, second] = skin.cells.as_slice() else { panic!("{:?}", skin.cells) };
    assert_eq!((first.normal, first.neighbors[0]), ([0.0, 0.0, 1.0], Some(CellId::new(2).unwrap())));
    let [x, y, z] = second.normal;
    assert!(x.abs() < 1e-6 && (y + 1.0).abs() < 1e-6 && z.abs() < 1e-6, "turned about x by a quarter");

    let parameters = skin.parameters(second);
    assert_eq!(parameters.check(), Ok(()));
    assert_eq!((parameters.joint, parameters.joints, parameters.period_us), (1, 2, 16_000));
    assert_eq!(parameters.rows[0].alpha.to_bits(), 16_384, "a quarter turn is exact");
    assert_eq!(parameters.contact.alpha_c.to_bits(), 2_048, "the cell's own");
    assert_eq!(parameters.contact.force_threshold.to_bits(), 103, "0.1 N, rounded up");
    assert_ne!(parameters.hash(), skin.parameters(first).hash());
}

#[test]
fn every_error_names_line_key_value_and_what_is_allowed() {
    assert_eq!(says("version = 1", "version = 2"), "skin.toml:1: version = 2: this program reads version 1");
    assert_eq!(
        says("node = 2", "node = 1"),
        "skin.toml:40: cell[1].node = 1: cell[0] already has this node id on \"vcan0\""
    );
    assert_eq!(
        says("node = 2", "node = 255"),
        "skin.toml:40: cell[1].node = 255: must be 1 to 254; further cells need another bus"
    );
    assert_eq!(says("joint = 1", "joint = 3"), "skin.toml:41: cell[1].joint = 3: use a joint from 1 to 2");
    assert_eq!(
        says("[0.7071068, 0.0, 0.0, 0.7071068]", "[0.5, 0.0, 0.0, 0.5]"),
        "skin.toml:43: cell[1].orientation = [0.5, 0, 0, 0.5]: \
         this quaternion has length 0.707107; it must be 1 to within 0.001"
    );
    assert_eq!(
        says("[0.1, 0.0, 0.06]", "[1.6, 0.0, 0.0]"),
        "skin.toml:34: cell[0].position = [1.6, 0, 0]: the distance from node 1 to a joint frame of its \
         chain can reach 2.100 m, 0.101 m more than Q1.14 can hold (1.999 m)"
    );
    assert_eq!(
        says("[controller]", "[[bus]]\nname = \"vcan0\"\nreply = \"torque\"\nformat = \"fd\"\n[controller]"),
        "skin.toml:25: bus[1].name = \"vcan0\": another bus already has this name"
    );
    assert_eq!(
        says("control_hz", "contrl_hz"),
        "skin.toml:12: unknown field `contrl_hz`, expected `control_hz` or `joint_broadcast_hz`"
    );
    assert_eq!(
        says("62.5", "60.0"),
        "skin.toml:13: timing.joint_broadcast_hz = 60: must divide control_hz = 500 evenly"
    );
    assert_eq!(
        says("62.5", "10.0"),
        "skin.toml:13: timing.joint_broadcast_hz = 10: must be at least 15.3 Hz"
    );
    assert_eq!(
        says("reply = \"torque\"", "reply = \"talk\""),
        "skin.toml:21: bus[0].reply = \"talk\": must be \"torque\" or \"sum\""
    );
    assert_eq!(
        says("inertia = [1.0, 1.0]", "inertia = [1.0]"),
        "skin.toml:26: controller.inertia = 1 values: must have one value for each of the robot's 2 joints"
    );
    assert_eq!(says("a = 0.5", "a = 2.5"), "skin.toml:8: robot.joints[1].a = 2.5: must be in [-2, 2)");
    assert_eq!(
        says("alpha_c = 0.5", "alpha_c = 8.5"),
        "skin.toml:44: cell[1].alpha_c = 8.5: must be in [-8, 8)"
    );
    assert_eq!(
        says("neighbors = [2,", "neighbors = [9,"),
        "skin.toml:36: cell[0].neighbors[0] = 9: must be the node id of another cell on the same bus, or 0"
    );
    assert_eq!(
        says("name = \"vcan0\"", "name = \"a-very-long-name\""),
        "skin.toml:20: bus[0].name = \"a-very-long-name\": a bus name must have 1 to 15 letters, digits, \
         `-`, `_` or `.`"
    );
}

#[test]
fn names_that_mislead_are_refused_and_escaped_in_recordings() {
    let of_skin = GOOD.lines().find(|line| line.starts_with("name = ")).unwrap();
    for (character, code) in
        [("\\u001b", "1B"), ("\\n", "A"), ("\\u202e", "202E"), ("\\ufffe", "FFFE"), ("\\u0000", "0")]
    {
        for line in [of_skin, "name = \"elbow\""] {
            let wrong = format!("{}{character}\"", line.strip_suffix('"').unwrap());
            let error = says(line, &wrong);
            let code = format!("U+{code:0>4} is not a printable character: remove it");
            assert!(error.ends_with(&code), "{error}");
            assert!(!error.contains(char::is_control), "{error:?}");
            let recorded = Skin::parse_recorded("skin.toml", &GOOD.replacen(line, &wrong, 1)).unwrap();
            let names = [recorded.name, recorded.robot.name].concat();
            assert!(names.contains(r"\u{") && !names.contains(char::is_control), "{names:?}");
        }
    }
    let long = format!("name = \"{}\"", "e".repeat(201));
    assert_eq!(
        says("name = \"elbow\"", &long),
        "skin.toml:5: robot.name = 201 characters: a name can have at most 200 characters"
    );
    Skin::parse_recorded("skin.toml", &GOOD.replacen("name = \"elbow\"", &long, 1)).unwrap();
    for name in ["Grüße 機器人", "a b", "\u{1f916}"] {
        let said = GOOD.replacen("\"elbow\"", &format!("\"{name}\""), 1);
        assert_eq!(Skin::parse("skin.toml", &said).unwrap().robot.name, name);
    }
}

#[test]
fn a_robot_may_say_where_its_urdf_is() {
    assert_eq!(Skin::parse("skin.toml", GOOD).unwrap().robot.urdf, None);
    let with = GOOD.replacen("name = \"elbow\"\n", "name = \"elbow\"\nurdf = \"../elbow.urdf\"\n", 1);
    let skin = Skin::parse("skin.toml", &with).unwrap();
    assert_eq!(skin.robot.urdf.as_deref(), Some("../elbow.urdf"));
    let said = says("name = \"elbow\"", "name = \"elbow\"\nurdf = \"\"");
    assert_eq!(said, "skin.toml:6: robot.urdf = \"\": must be the path of a file, relative to the skin file");
}

#[test]
fn a_robot_of_joints_and_chains_names_what_is_wrong_with_them() {
    let (before, rest) = GOOD.split_once("joints = [").unwrap();
    let (_, after) = rest.split_once("]\n").unwrap();
    let joint = "[[robot.joint]]\nname = \"lift\"\nkind = \"prismatic\"\nlimits = [-0.5, 1.0]\n";
    let more = "[[robot.joint]]\nname = \"elbow\"\n";
    let chain = "[[robot.chain]]\nname = \"arm\"\nrows = [{ joint = \"lift\" }, { joint = \"elbow\" }]\n";
    let good = format!("{before}{joint}{more}{chain}{after}");
    let skin = Skin::parse("skin.toml", &good).unwrap();
    let kinds = skin.robot.joints.iter().map(|joint| joint.kind.name()).collect::<Vec<_>>();
    assert_eq!(kinds, ["prismatic", "revolute"]);
    let wrong = |from: &str, to: &str| {
        assert!(good.contains(from), "{from}");
        let DocumentError::InvalidValue { what, .. } =
            Skin::parse("skin.toml", &good.replacen(from, to, 1)).unwrap_err()
        else {
            panic!("{from}")
        };
        what
    };
    let range = "a prismatic joint must stay within -1.999 to 1.999 m";
    let slides = |got: &str| format!("robot.joint[0].limits = {got}: {range}");
    assert_eq!(wrong("-0.5, 1.0", "-2.1, 1.0"), slides("[-2.1, 1]"));
    assert_eq!(wrong("-0.5, 1.0", "-0.5, 2.1"), slides("[-0.5, 2.1]"));
    let own = |got: &str| format!("robot.joint[1].name = {got:?}: each joint must have a unique name");
    assert_eq!(wrong("name = \"elbow\"\n[[robot.chain]]", "name = \"lift\"\n[[robot.chain]]"), own("lift"));
    assert_eq!(wrong("name = \"elbow\"\n[[robot.chain]]", "name = \"\"\n[[robot.chain]]"), own(""));
    let unused = wrong(", { joint = \"elbow\" }", "");
    assert_eq!(unused, "robot.joint[1].name = \"elbow\": no chain contains this joint");
    assert_eq!(wrong(chain, ""), "robot.chain = []: a robot must have at least one chain");
    let both = "robot.joints: give either joints, or [[robot.joint]] and [[robot.chain]], not both";
    assert_eq!(wrong("[robot]\n", "[robot]\njoints = []\n"), both);
}

#[test]
fn a_wire_has_two_ends() {
    assert_eq!(
        says("neighbors = [2, 0, 0, 0]", "neighbors = [2, 2, 0, 0]"),
        "skin.toml:36: cell[0].neighbors[1] = 2: the other end of this wire is missing: \
         name node 1 once more in the neighbors of node 2, or put 0 here"
    );
    assert_eq!(
        says("neighbors = [0, 0, 0, 1]", "neighbors = [0, 0, 0, 0]"),
        "skin.toml:36: cell[0].neighbors[0] = 2: the other end of this wire is missing: \
         name node 1 once more in the neighbors of node 2, or put 0 here"
    );
    assert_eq!(
        says("neighbors = [2, 0, 0, 0]", "neighbors = [0, 0, 0, 0]"),
        "skin.toml:45: cell[1].neighbors[3] = 1: the other end of this wire is missing: \
         name node 2 once more in the neighbors of node 1, or put 0 here"
    );
}

#[test]
fn sums_need_a_tree_that_reaches_everyone_and_fits_the_period() {
    const CHAIN: [([i64; 4], bool); 4] =
        [([2, 0, 0, 0], true), ([1, 3, 0, 0], false), ([2, 4, 0, 0], false), ([3, 0, 0, 0], false)];
    let parse = |reply: &str, cells: &[_]| Skin::parse("skin.toml", &wired_text(reply, cells));
    let bus = |reply: &str| parse(reply, &CHAIN).unwrap().buses[0].reply;
    let fault = |reply: &str, cells: &[_]| by_line(parse(reply, cells).unwrap_err());
    assert_eq!(bus("reply = \"sum\"\nslot_us = 4000"), SkinReply::Sum { slot_us: 4_000, carry: true });
    let without = "reply = \"sum\"\nslot_us = 1\ncarry = false";
    assert_eq!(bus(without), SkinReply::Sum { slot_us: 1, carry: false });
    assert_eq!(
        fault("reply = \"torque\"\ncarry = true", &CHAIN),
        "skin.toml:22: bus[0].carry = true: allowed only with reply = \"sum\""
    );
    assert_eq!(
        fault("reply = \"sum\"\nslot_us = 4001", &CHAIN),
        "skin.toml:22: bus[0].slot_us = 4001: the tree needs 4 slots within the 16000 us between two joint \
         broadcasts: use at most 4000 us"
    );
    let mut cells = CHAIN;
    cells[0].1 = false;
    assert_eq!(
        fault(without, &cells),
        "skin.toml:21: bus[0].reply = \"sum\": sums need a path to the gateway, but no cell of this bus has \
         root = true: set it for one cell"
    );
    let link_down =
        |cells: &[_]| fault(without, cells).split_once(": no path of wires").unwrap().1.to_owned();
    cells = CHAIN;
    (cells[1].0, cells[2].0) = ([1, 0, 0, 0], [0, 4, 0, 0]);
    assert_eq!(
        fault(without, &cells),
        "skin.toml:50: cell[2].node = 3: no path of wires leads from a root of its bus to this cell (and \
         none to 1 other cell), but sums need one: name the neighbors at both ends of each wire, or set root \
         = true for a cell"
    );
    assert_eq!(
        parse("reply = \"torque\"", &cells).unwrap().wires(0).cell_depths()[..4],
        [Some(0), Some(1), None, None]
    );
    assert!(
        link_down(&[([0; 4], true), ([0; 4], false)])
            .starts_with(" leads from a root of its bus to this cell, but")
    );
    let three = [([0; 4], true), ([0; 4], false), ([0; 4], false), ([0; 4], false)];
    assert!(
        link_down(&three)
            .starts_with(" leads from a root of its bus to this cell (and none to 2 other cells), but")
    );
}

#[test]
fn bit_rates_are_optional_and_checked() {
    let format = "format = \"fd\"";
    assert_eq!(Skin::parse("skin.toml", GOOD).unwrap().buses[0].bitrate, None);
    let with = |lines: &str| GOOD.replacen(format, &format!("{format}\n{lines}"), 1);
    let rates = |lines: &str| {
        let skin = Skin::parse("skin.toml", &with(lines)).unwrap();
        (skin.buses[0].bitrate, skin.buses[0].data_bitrate)
    };
    assert_eq!(rates("bitrate = 10000"), (Some(10_000), None));
    let fastest = "bitrate = 1000000\ndata_bitrate = 8_000_000";
    assert_eq!(rates(fastest), (Some(1_000_000), Some(8_000_000)));
    assert_eq!(rates("bitrate = 500000\ndata_bitrate = 500000"), (Some(500_000), Some(500_000)));

    let fault = |lines: &str| by_line(Skin::parse("skin.toml", &with(lines)).unwrap_err());
    let range = "must be 10000 to 1000000 bit/s";
    assert_eq!(fault("bitrate = 9999"), format!("skin.toml:23: bus[0].bitrate = 9999: {range}"));
    assert_eq!(fault("bitrate = 1000001"), format!("skin.toml:23: bus[0].bitrate = 1000001: {range}"));
    assert_eq!(fault("bitrate = -1"), format!("skin.toml:23: bus[0].bitrate = -1: {range}"));
    assert_eq!(
        fault("bitrate = 500000\ndata_bitrate = 499999"),
        "skin.toml:24: bus[0].data_bitrate = 499999: must be 500000 to 8000000 bit/s"
    );
    assert_eq!(
        fault("data_bitrate = 5000000"),
        "skin.toml:23: bus[0].data_bitrate = 5000000: allowed only together with bitrate"
    );
    let classic = with("bitrate = 500000\ndata_bitrate = 500000").replace(format, "format = \"classic\"");
    assert_eq!(
        by_line(Skin::parse("skin.toml", &classic).unwrap_err()),
        "skin.toml:24: bus[0].data_bitrate = 500000: allowed only with format = \"fd\""
    );
}

#[test]
fn a_broken_file_says_where_in_one_line() {
    let error = says("version = 1", "version = = 1");
    assert!(error.starts_with("skin.toml:1: ") && error.lines().count() == 1, "{error}");
    for (from, to, said) in [
        ("joint = 2\n", "", "skin.toml:30: cell[0].joint: must name the joint that moves the cell: 1 to 2"),
        ("joint = 2", "joint = \"two\"", "skin.toml:33: cell[0].joint = \"two\": must be a whole number"),
        ("joint = 2", "joint = 18446744073709551616", "= 18446744073709551616: the number is too large"),
        ("joint = 2", "joint = \"vcan0:2\"", ": write 2, and bus = \"vcan0\" as a separate key"),
        ("version = 1", "version = 1\nevents = 5", ": must be a table: write [events], and its keys below"),
        ("joint = 2", "joint = 2.5", "skin.toml:33: cell[0].joint = 2.5: must be a whole number"),
        ("control_hz = 500.0", "control_hz = \"500\"", "timing.control_hz = \"500\": must be a number"),
        ("[[bus]]", "[bus]", "bus: must be a list of tables: write [[bus]]"),
        (
            "alpha_c = 1.0",
            "alpha_c = pi/2",
            "; write numbers without units or formulas, such as 5000000 or 1.5708",
        ),
    ] {
        let got = says(from, to);
        assert!(got.ends_with(said) && got.lines().count() == 1, "{got}");
    }
    let error = Skin::parse("skin.toml", "name = \"nobody\"\n").unwrap_err().to_string();
    assert_eq!(error, "skin.toml:1:1: key `robot` is missing");
    let error =
        Skin::parse("skin.toml", &GOOD.replacen("[1.0, 1.0]", "[1.0, 0.0]", 1)).unwrap_err().to_string();
    assert_eq!(error, "skin.toml:26:17: controller.inertia[1] = 0: must be above 0");
    assert!(
        Skin::read(Path::new("/nonexistent/skin.toml"))
            .unwrap_err()
            .to_string()
            .contains("/nonexistent/skin.toml")
    );
}

#[test]
fn sensing_is_off_unless_said_and_its_keys_are_checked() {
    let format = "format = \"fd\"";
    let with = |lines: &str| GOOD.replacen(format, &format!("{format}\n{lines}"), 1);
    let sensing = |lines: &str| Skin::parse("skin.toml", &with(lines)).unwrap().buses[0].sensing;
    assert_eq!(sensing(""), Sensing::Off);
    assert_eq!(sensing("sensing = \"off\""), Sensing::Off);
    assert_eq!(sensing("sensing = \"event\""), Sensing::Event);
    let at = |period_ms| Sensing::Continuous { period_ms };
    assert_eq!(sensing("sensing = \"continuous\"\nsensing_hz = 62.5"), at(16));

    let fault = |lines: &str| by_line(Skin::parse("skin.toml", &with(lines)).unwrap_err());
    assert_eq!(
        fault("sensing = \"always\""),
        "skin.toml:23: bus[0].sensing = \"always\": must be \"off\", \"continuous\" or \"event\""
    );
    assert_eq!(
        fault("sensing = \"continuous\""),
        "skin.toml:23: bus[0].sensing = \"continuous\": this mode needs the key sensing_hz too"
    );
    assert_eq!(
        fault("sensing = \"event\"\nsensing_hz = 10"),
        "skin.toml:24: bus[0].sensing_hz = 10: allowed only with sensing = \"continuous\""
    );
    assert_eq!(
        fault("sensing = \"continuous\"\nsensing_hz = 60.0"),
        "skin.toml:24: bus[0].sensing_hz = 60: its period must be a whole number of ms; the nearest rates are \
         58.8235 and 62.5000 Hz"
    );
}

#[test]
fn thresholds_of_events_have_defaults_and_fit_their_words() {
    let with = |lines: &str| GOOD.replacen("[controller]", &format!("[events]\n{lines}\n[controller]"), 1);
    let events = |lines: &str| Skin::parse("skin.toml", &with(lines)).unwrap().events;
    assert_eq!(Skin::parse("skin.toml", GOOD).unwrap().events, Events::default());
    assert_eq!(events("contact_n = 0.25").contact.to_bits(), 256);
    assert_eq!(events("hysteresis = 1.0").hysteresis.to_bits(), 1 << 14);
    assert_eq!(events("temperature_c = 0.0").temperature.to_bits(), 0, "every change");

    let fault = |lines: &str| by_line(Skin::parse("skin.toml", &with(lines)).unwrap_err());
    assert_eq!(fault("contact_n = -1.0"), "skin.toml:25: events.contact_n = -1: must not be negative");
    assert_eq!(fault("contact_n = 32.0"), "skin.toml:25: events.contact_n = 32: must be in [0, 32)");
    assert_eq!(
        fault("hysteresis = 1.5"),
        "skin.toml:25: events.hysteresis = 1.5: must be 0 to 1, as a fraction of each threshold"
    );
    assert_eq!(
        fault("force_n = 1.0"),
        "skin.toml:25: unknown field `force_n`, expected one of `contact_n`, `proximity`, `temperature_c`, \
         `acceleration_g`, `hysteresis`"
    );
}

#[test]
fn a_skin_has_at_most_64_buses() {
    let (head, cells) = GOOD.split_once("[controller]").unwrap();
    let with = |buses: usize| {
        let more: String = (1..buses)
            .map(|at| format!("[[bus]]\nname = \"vcan{at}\"\nreply = \"torque\"\nformat = \"fd\"\n\n"))
            .collect();
        Skin::parse("skin.toml", &format!("{head}{more}[controller]{cells}"))
    };
    assert_eq!(with(64).unwrap().buses.len(), 64);
    let error = by_line(with(65).unwrap_err());
    assert!(error.contains("65 buses") && error.contains("a skin can have at most 64 buses"), "{error}");
}

#[test]
fn only_what_is_not_plain_has_to_be_said() {
    const SHORT: &str = "[robot]
joints = [{ d = 0.1, alpha = 1.5707963267948966 }, { a = 0.5 }]
[[cell]]
node = 1
joint = 2
position = [0.1, 0.0, 0.06]
normal = [0.0, 0.6, 0.8]
";
    let long = SHORT
        .replace("[[cell]]", "[[cell]]\nbus = \"vcan0\"\nroot = false\nneighbors = [0, 0, 0, 0]")
        .replace("joints = [{ ", "name = \"robot\"\njoints = [{ a = 0.0, theta_offset = 0.0, ")
        .replace("{ a = 0.5 }", "{ a = 0.5, d = 0.0, alpha = 0.0, theta_offset = 0.0 }")
        .replace(
            "normal = [0.0, 0.6, 0.8]",
            "orientation = [-0.31622776601683794, 0.0, 0.0, 0.9486832980505138]",
        );
    let head = "version = 1\nname = \"skin\"\n[timing]\ncontrol_hz = 500.0\njoint_broadcast_hz = 62.5\n\
                [[bus]]\nname = \"vcan0\"\nreply = \"torque\"\nformat = \"fd\"\n\
                [controller]\nkind = \"kinesthetic\"\ninertia = [1.0, 1.0]\ndamping = [4.0, 4.0]\n\
                max_speed_rad_s = [2.0, 2.0]\n";
    let short = Skin::parse("skin.toml", SHORT).unwrap();
    let mut long = Skin::parse("skin.toml", &format!("{head}{long}")).unwrap();
    let (given, same) = (short.cells[0].normal, long.cells[0].normal);
    assert!(given.iter().zip(same).all(|(given, same)| (given - same).abs() < 1e-12), "{same:?}");
    assert!(long.cells[0].orientation.take().is_some() && short.cells[0].orientation.is_none());
    long.cells[0].normal = given;
    assert_eq!(short, long);

    let fault =
        |from: &str, to: &str| by_line(Skin::parse("skin.toml", &SHORT.replace(from, to)).unwrap_err());
    assert_eq!(
        fault("0.8]", "0.8]\norientation = [0.0, 0.0, 0.0, 1.0]"),
        "skin.toml:7: cell[0].normal: give either normal or orientation, not both"
    );
    assert_eq!(
        fault("normal = [0.0, 0.6, 0.8]", ""),
        "skin.toml:3: cell[0].normal: missing: give the outward normal of the cell as [x, y, z], or its \
         orientation"
    );
    assert_eq!(
        fault("0.8]", "1.0]"),
        "skin.toml:7: cell[0].normal = [0, 0.6, 1]: this vector has length 1.166190; it must be 1 to within 0.001"
    );
    assert_eq!(
        fault("[[cell]]", "[[bus]]\n[[bus]]\nname = \"vcan1\"\n[[cell]]"),
        "skin.toml:6: cell[0].bus: must name the bus of the cell: one of \"vcan0\", \"vcan1\""
    );
}

#[test]
fn a_scenario_is_known_for_what_it_is() {
    let text = "duration_s = 2.0\n[[touch]]\nall = true\nforce_n = 1.0\n";
    let said = Skin::parse("s.toml", text).unwrap_err().to_string();
    let hint = "this is a scenario, not a skin: give it as `skinbus run SKIN --scenario SCENARIO`";
    assert_eq!(said, format!("s.toml: {hint}"));
    let said = says("[controller]", "[motion]\n[controller]");
    assert!(said.contains("unknown field `motion`"), "a skin with a key too many: {said}");
}
