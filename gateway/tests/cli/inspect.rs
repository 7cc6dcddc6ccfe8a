//! `skinbus skin dbc`, `skinbus explain`, and the tables of `skinbus dump`, as processes.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::path::Path;
use std::process::{Command, Output};

use tempfile::TempDir;

fn gateway(folder: &Path, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split(' ').filter(|word| !word.is_empty())).current_dir(folder);
    command.env("NO_COLOR", "1").env("SKINBUS_DIR", "/nowhere/skinbus").output().unwrap()
}

/// Standard output of a command that succeeds without messages.
fn output(folder: &Path, arguments: &str) -> String {
    let Output { status, stdout, stderr } = gateway(folder, arguments);
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!((status.code(), said.as_str()), (Some(0), ""), "{arguments}");
    String::from_utf8(stdout).unwrap()
}

/// The one-line error of a command that ends with this code and prints nothing else.
fn refusal(folder: &Path, arguments: &str, code: i32) -> String {
    let Output { status, stdout, stderr } = gateway(folder, arguments);
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!((status.code(), stdout.as_slice()), (Some(code), b"".as_slice()), "{arguments}: {said}");
    assert_eq!(said.matches('\n').count(), 1, "{arguments}: {said}");
    said.trim_end().to_owned()
}

/// A directory with skins: `one.toml`, `two.toml` with two buses, `classic.toml`.
fn skins() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let skins =
        [("one", "--cells 3"), ("two", "--cells 4 --buses 2"), ("classic", "--cells 3 --format classic")];
    for (name, what) in skins {
        output(folder.path(), &format!("skin generate {what} -o {name}.toml"));
    }
    folder
}

#[test]
fn a_dbc_goes_to_standard_output_or_into_a_file_that_is_not_there_yet() {
    let folder = skins();
    let folder = folder.path();
    let text = output(folder, "skin dbc one.toml");
    assert!(text.starts_with("VERSION \"1\"\n") && text.contains("\nBO_ 515 torque_3: 16 cell_3\n"));
    assert_eq!(output(folder, "skin dbc one.toml -o one.dbc"), "");
    let written = || std::fs::read_to_string(folder.join("one.dbc")).unwrap();
    assert_eq!(written(), text);
    let said = refusal(folder, "skin dbc classic.toml --joined -o one.dbc", 2);
    assert_eq!(said, "skinbus: -o one.dbc: the file exists: name another file, or add --overwrite");
    assert_eq!(written(), text);
    output(folder, "skin dbc classic.toml --joined -o one.dbc --overwrite");
    assert!(written().contains("Classic: a packet travels in frames of up to 8 bytes under one identifier"));
    let said = refusal(folder, "skin dbc one.toml -o nowhere/one.dbc", 2);
    assert!(said.starts_with("skinbus: -o nowhere/one.dbc: "), "{said}");
    assert!(said.ends_with("; name a file in a folder that can be written"), "{said}");
}

#[test]
fn a_recording_without_a_skin_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("run.log"), "(1.000000) vcan0 123#00\n").unwrap();
    assert!(gateway(folder.path(), "convert run.log run.mcap").status.success());
    let said = refusal(folder.path(), "skin dbc run.mcap", 2);
    assert_eq!(said, "skinbus: run.mcap contains no skin: name a skin file");
}

#[test]
fn of_several_buses_one_is_chosen() {
    let folder = skins();
    let folder = folder.path();
    let said = refusal(folder, "skin dbc two.toml", 2);
    let expected =
        "skinbus: two.toml has 2 buses, but a DBC file describes one: add --bus with one of vcan0, vcan1";
    assert_eq!(said, expected);
    let said = refusal(folder, "skin dbc two.toml --bus can7", 2);
    assert_eq!(said, "skinbus: two.toml has no bus \"can7\"; its buses are vcan0, vcan1");
    for bus in ["vcan0", "vcan1"] {
        let text = output(folder, &format!("skin dbc two.toml --bus {bus}"));
        assert!(text.contains(&format!("BA_ \"DBName\" \"{bus}\";")), "{text}");
    }
}

#[test]
fn a_classic_bus_is_described_only_as_joined_packets() {
    let folder = skins();
    let folder = folder.path();
    let said = refusal(folder, "skin dbc classic.toml", 2);
    let expected = "skinbus: bus vcan0 is classic: a packet consists of several frames with one identifier, \
                    which a DBC cannot tell apart: add --joined to describe whole packets, for a program \
                    that joins their frames first";
    assert_eq!(said, expected);
    let said = refusal(folder, "skin dbc one.toml --joined", 2);
    assert_eq!(said, "skinbus: --joined is for classic buses; on vcan0 a packet is one FD frame");
}

/// Path of a golden log.
fn golden(name: &str) -> String {
    format!("{}/../protocol/tests/golden/{name}", env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn a_capture_in_numbers_is_a_table_or_an_object() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let log = "(1.000000) vcan0 001##500001CCFBE28F5C608C000000706BE4E\n\
               (1.016000) vcan0 20C##5CDFB7B0C000000000000000007014157\n\
               (1.018000) vcan0 20C##5CDFB7B0C000000000000000007014157\n\
               DROPCOUNT: dropped 12 CAN frames on 'vcan0' socket (total drops 12)\n\
               (1.020000) vcan0 20C##5CDFB7B0C000000000000000007014158\n\
               (1.000000) can1 12345678#\n";
    std::fs::write(folder.join("small.log"), log).unwrap();
    let Output { status, stdout, stderr } = gateway(folder, "dump small.log --stats --json");
    let complaint = "small.log:4: 12 frames are missing here, because the recorder lost them\n";
    assert_eq!((status.code(), std::str::from_utf8(&stderr)), (Some(0), Ok(complaint)));
    let numbers: serde_json::Value = serde_json::from_slice(&stdout).unwrap();
    assert_eq!((&numbers["format"], &numbers["frames"]), (&"candump log".into(), &5.into()));
    assert_eq!(numbers["times_backwards"], 0, "buses are read in turn");
    let bus = &numbers["buses"][0];
    assert_eq!(
        (&bus["bus"], &bus["dropped"], &bus["refused"]["crc"]),
        (&"vcan0".into(), &12.into(), &1.into())
    );
    assert_eq!((&bus["epochs"]["first"], &bus["cells"][0]["torques"]), (&7.into(), &2.into()));
    assert_eq!(numbers["buses"][1]["foreign"]["extended"], 1);
    let table = String::from_utf8(gateway(folder, "dump small.log --stats").stdout).unwrap();
    for part in [
        "small.log",
        "candump log, 0.020 s",
        "5 frames",
        "12 ",
        "1 CRC",
        "29-bit identifiers",
        "7 to 7",
        "7..7",
    ] {
        assert!(table.contains(part), "{part}: {table}");
    }
    let said = refusal(folder, "dump small.log --stats --kind torque", 2);
    assert_eq!(said, "skinbus: the argument '--stats' cannot be used with '--kind <KIND>'; try '--help'");
}

#[test]
fn contacts_alone_are_shown_and_json_is_one_object_a_line() {
    let folder = tempfile::tempdir().unwrap();
    let all = output(folder.path(), &format!("dump {} --json", golden("document.log")));
    let touches = output(folder.path(), &format!("dump {} --json --contact", golden("document.log")));
    let kinds = |text: &str| {
        let objects = text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
        objects.map(|object| object["kind"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(kinds(&all).len(), 25);
    assert_eq!(kinds(&touches), ["torque", "stimulus", "torque", "sensors"]);
}

#[test]
fn brief_lines_have_the_time_since_the_first_frame_and_no_raw_one() {
    let folder = tempfile::tempdir().unwrap();
    let shown = output(folder.path(), &format!("dump {} --brief --kind halt,sync", golden("document.log")));
    assert_eq!(shown, "0.001000 vcan0 ok      halt\n0.002000 vcan0 ok      sync\n");
}

#[test]
fn with_strict_the_first_line_that_cannot_be_read_is_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let log = "(1.000000) vcan0 002##50000000000000000000000000000632A\n(1.000000) vcan0 12#11\n(1.0) x\n";
    std::fs::write(folder.join("odd.log"), log).unwrap();
    let Output { status, stderr, .. } = gateway(folder, "convert odd.log even.log --strict");
    let said = "skinbus: odd.log:2: column 18: expected an identifier of 3 or 8 hexadecimal digits";
    assert_eq!(status.code(), Some(1));
    assert!(std::str::from_utf8(&stderr).unwrap().starts_with(said), "{stderr:?}");
    assert!(!folder.join("even.log").exists());
    let Output { status, stdout, .. } = gateway(folder, "dump odd.log");
    assert_eq!((status.code(), std::str::from_utf8(&stdout).unwrap().lines().count()), (Some(0), 1));
}

/// The cell of the document's complete configuration, and another one without contact.
const SKIN: &str = r#"version = 1
name = "document"

[robot]
name = "UR5"
joints = [
  { a = 0.0, alpha = 1.5707963267948966, d = 0.089159, theta_offset = 0.0 },
  { a = -0.425, alpha = 0.0, d = 0.0, theta_offset = 0.0 },
  { a = -0.39225, alpha = 0.0, d = 0.0, theta_offset = 0.0 },
  { a = 0.0, alpha = 1.5707963267948966, d = 0.10915, theta_offset = 0.0 },
  { a = 0.0, alpha = -1.5707963267948966, d = 0.09465, theta_offset = 0.0 },
  { a = 0.0, alpha = 0.0, d = 0.0823, theta_offset = 0.0 },
]

[timing]
control_hz = 500.0
joint_broadcast_hz = 62.5

[contact]
alpha_c = 1.0
alpha_p = 0.0
contact_threshold_n = 0.1
proximity_threshold = 0.05
force_threshold_n = 0.1

[[bus]]
name = "vcan0"
reply = "torque"
format = "fd"

[controller]
kind = "kinesthetic"
inertia = [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]
damping = [4.0, 4.0, 4.0, 2.0, 2.0, 2.0]
max_speed = [2.0, 2.0, 2.0, 3.0, 3.0, 3.0]

[[cell]]
bus = "vcan0"
node = 12
joint = 2
position = [0.1, 0.05, 0.06]
orientation = [-0.4472135955, 0.0, 0.0, 0.894427191]

[[cell]]
bus = "vcan0"
node = 13
joint = 3
position = [0.1, 0.0, 0.06]
orientation = [0.0, 0.0, 0.0, 1.0]
"#;

/// The document's cell gets test mode, a stimulus and joints, and answers.
const PRESSED: &str = "(1.000000) vcan0 50C##10100000000000000000000000C853231
(1.100000) vcan0 70C##1000400040004000000000000008047DA
(1.200000) vcan0 001##500001CCFBE28F5C608C000000706BE4E
(1.200500) vcan0 20C##5CDFB7B0C000000000000000007014157
";

/// A directory with `skin.toml` and `run.log`.
fn pressed() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("skin.toml"), SKIN).unwrap();
    std::fs::write(folder.path().join("run.log"), PRESSED).unwrap();
    folder
}

#[test]
fn the_worked_example_of_the_document_is_explained_in_a_terminal() {
    let folder = pressed();
    let folder = folder.path();
    let text = output(folder, "explain run.log --skin skin.toml --epoch 7 --cell 12");
    for line in [
        "run.log: joints message of epoch 7 on vcan0, 0.200000 s after the first frame",
        "  sensors    contact 1.0000 + 1.0000 + 1.0000 N, proximity 0.0000",
        "  set by     the stimulus at 0.100000 s, in effect from the next joints message on",
        "  contact    F_c = 3.0000 N, at least its threshold of 0.1006 N: counts",
        "  proximity  F_p = 0.0000, below its threshold of 0.0500: does not count",
        "  force      F_z = 1.0000 F_c + 0.0000 F_p = 3.000000 N, at least its threshold of 0.1006 N",
        "  in steps   196608 of 2^-16 N = 3.000000 N",
        "  answered   0.500 ms after the joints message",
        "  vcan0 12: it did not report its configuration hash, which is assumed to be that of the skin, 266D",
        "  vcan0: 1 cells sent nothing, and their contact state is not in the capture; they are assumed not to be in contact",
    ] {
        assert!(text.lines().any(|there| there == line), "{line}\n{text}");
    }
    let words: Vec<_> = text.lines().filter(|line| line.contains("-1075") || line.contains("3195")).collect();
    assert_eq!(words.len(), 2, "{text}");
    let all = output(folder, "explain run.log --skin skin.toml --epoch 7");
    assert!(all.contains("torques of the whole skin: sum of the words in the frames"), "{all}");
    let joint = output(folder, "explain run.log --skin skin.toml --epoch 7 --joint 2");
    assert!(joint.contains("3195") && !joint.contains("-1075"), "{joint}");
}

#[test]
fn an_explanation_is_an_object_too() {
    let folder = pressed();
    let text = output(folder.path(), "explain run.log --skin skin.toml --epoch 7 --joint 2 --json");
    let object: serde_json::Value = serde_json::from_str(&text).unwrap();
    let cell = &object["cells"][0];
    assert_eq!((&object["epoch"], &cell["node"]), (&7.into(), &12.into()));
    assert_eq!(
        (&cell["force"]["force_steps"], &cell["force"]["origin"]["by"]),
        (&196_608.into(), &"stimulus".into())
    );
    assert_eq!((&cell["rows"][0]["word"], cell["rows"].as_array().map(Vec::len)), (&3195.into(), Some(1)));
    assert_eq!(object["total"][0]["word_steps"], 3195);
}

#[test]
fn what_cannot_be_explained_is_one_line() {
    let folder = pressed();
    let folder = folder.path();
    std::fs::write(folder.join("empty.log"), "# nothing\n").unwrap();
    for (arguments, code, expected) in [
        ("explain run.log --epoch 7", 2, "run.log contains no skin: name one with --skin"),
        (
            "explain run.log --skin skin.toml --epoch 8",
            1,
            "run.log: the capture contains no joints message of epoch 8; it contains one of epoch 7 at 0.200 s",
        ),
        (
            "explain run.log --skin skin.toml --epoch 7 --at 0.3 --occurrence 2",
            1,
            "run.log: the capture contains no joints message of epoch 7 (occurrence 2) at 0.300 s or later; it \
             contains one of epoch 7 at 0.200 s",
        ),
        (
            "explain run.log --skin skin.toml --epoch 7 --cell 99",
            2,
            "--cell 99: the skin has no such cell on vcan0",
        ),
        (
            "explain run.log --skin skin.toml --epoch 7 --cell can0:12",
            2,
            "--cell can0:12: the skin has no such bus; it has vcan0",
        ),
        (
            "explain run.log --skin skin.toml --epoch 7 --cell 300",
            2,
            "invalid value '300' for '--cell <[BUS:]NODE>': \"300\" is not a node id: use 1 to 254; try '--help'",
        ),
        (
            "explain empty.log --skin skin.toml --epoch 7",
            1,
            "empty.log: no frame in 1 line; expected the output of candump, with lines like \
             `(1700000000.123456) vcan0 123#00` or `vcan0  123   [1]  00`",
        ),
        (
            "explain nosuch.log --skin skin.toml --epoch 7",
            2,
            "nosuch.log: No such file or directory (os error 2)",
        ),
        (
            "explain run.log --skin skin.toml --epoch 256",
            2,
            "invalid value '256' for '--epoch <E>': 256 is not in 0..=255; try '--help'",
        ),
    ] {
        assert_eq!(refusal(folder, arguments, code), format!("skinbus: {expected}"), "{arguments}");
    }
}

#[test]
fn the_skin_is_the_one_in_the_recording() {
    let folder = pressed();
    let folder = folder.path();
    assert_eq!(gateway(folder, "convert run.log run.mcap").status.code(), Some(0));
    let said = refusal(folder, "explain run.mcap --epoch 7", 2);
    assert_eq!(said, "skinbus: run.mcap contains no skin: name one with --skin");
    let mcap = output(folder, "explain run.mcap --skin skin.toml --epoch 7 --json");
    let log = output(folder, "explain run.log --skin skin.toml --epoch 7 --json");
    assert_eq!(mcap.replace("run.mcap", "run.log"), log);
}

#[test]
fn a_hint_does_not_lead_to_the_next_refusal() {
    let folder = pressed();
    let folder = folder.path();
    std::fs::write(folder.join("words.txt"), "nothing\n").unwrap();
    // No skin, sensing mode or option would help here.
    let description = "skinbus: skin.toml is a skin or a scenario, not a candump log or MCAP recording: it \
                       contains no CAN frames: name a candump log or an MCAP recording";
    let nothing = "skinbus: words.txt: no frame in 1 line; ";
    let read =
        "skinbus: --node-ids skin.toml is also an input of this command: name another file for the output";
    for (arguments, code, begin) in [
        ("calibrate skin.toml --recording skin.toml", 2, description),
        ("calibrate skin.toml --recording words.txt", 1, nothing),
        ("explain words.txt --epoch 7", 1, nothing),
        ("commission skin.toml --node-ids skin.toml --overwrite", 2, read),
        ("calibrate skin.toml --within -1", 2, "skinbus: unexpected argument '-1' found; try '--help'"),
    ] {
        let said = refusal(folder, arguments, code);
        assert!(said.starts_with(begin), "{arguments}: {said}");
    }
}
