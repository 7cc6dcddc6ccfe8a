//! The commands as processes, as far as they need neither CAN in the kernel nor changes of an interface.
#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process::program;
use skinbus_tests::process::served;
use skinbus_tests::process::setup::{CommandOutput, while_sending};

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use protocol::bus::{Bus, BusKind, BusOptions, KindChoice, has_socketcan};
use protocol::id::{CellId, Id, Kind, Node};
use serde_json::Value;
use served::Served;
use tempfile::TempDir;

/// A folder with a copy of the program, and otherwise only the files that a test adds.
struct Folder(TempDir);

impl Folder {
    fn new() -> Self {
        let folder = Self(TempDir::new().unwrap());
        // A separate process copies it: a child that another test starts meanwhile would inherit the open file, and
        // until its `exec` the copy would be busy and could not be run.
        let mut copy = Command::new("cp");
        copy.arg(program("vcan-setup")).arg(folder.program());
        assert!(copy.status().unwrap().success());
        folder
    }

    fn program(&self) -> PathBuf {
        self.0.path().join("vcan-setup")
    }

    fn buses(&self) -> PathBuf {
        self.0.path().join("buses")
    }

    fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(self.program());
        command.args(arguments.split_whitespace()).env("SKINBUS_DIR", self.buses());
        command.current_dir(self.0.path());
        command
    }

    fn run(&self, arguments: &str) -> CommandOutput {
        CommandOutput::run(&mut self.command(arguments))
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.0.path().join(name), text).unwrap();
    }

    /// Serves a bus, and returns once it is served.
    fn serve(&self, name: &str) -> Served {
        let (served, line) = Served::start(&mut self.command(&format!("serve {name}")));
        assert!(line.starts_with("serving "), "{line}");
        served
    }
}

/// Returns the skin of the README, with some lines changed.
fn skin(changes: &[(&str, &str)]) -> String {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let text = std::fs::read_to_string(root.join("gateway/examples/ur5-253.toml")).unwrap();
    changes.iter().fold(text, |text, (from, to)| {
        assert!(text.contains(from), "{from}");
        text.replace(from, to)
    })
}

#[test]
fn wrong_use_is_said_in_one_line() {
    let folder = Folder::new();
    folder.write("broken.toml", "version = 2\n");
    folder.write("rates.toml", &skin(&[("format = \"fd\"", "format = \"fd\"\nbitrate = 5")]));
    for (arguments, says) in [
        ("up", "the following required arguments were not provided: <SKIN.toml|NAME>...; try '--help'"),
        (
            "up --pear x",
            "unexpected argument '--pear' found; a similar argument exists: '--peer'; try '--help'",
        ),
        (
            "up vcan0 --namespace x",
            "the following required arguments were not provided: --peer <PEER>; try '--help'",
        ),
        ("up vcan0 vcan1 --peer x", "--peer makes one pair of interfaces: give exactly one NAME"),
        (
            "up lo",
            "lo is the loopback interface, which vcan-setup does not change: choose another name, as in \
             `vcan-setup up vcan0`",
        ),
        ("down lo", "lo is the loopback interface that vcan-setup did not make, so it stays unchanged"),
        (
            "up a23456789012345678",
            "\"a23456789012345678\" is not a valid bus name: use 1 to 15 bytes without spaces, '/' or ':', \
             and not '.' or '..'",
        ),
        (
            "up vcan%d",
            "\"vcan%d\" is not a valid name of an interface: use letters, digits, '-', '_' and '.', as in \
             vcan0",
        ),
        (
            "up vcan0 --peer .x",
            "\".x\" is not a valid name of an interface: use letters, digits, '-', '_' and '.', as in vcan0",
        ),
        ("up nosuch.toml", "nosuch.toml: No such file or directory (os error 2)"),
        ("status ./broken.toml", "./broken.toml:1:1: key `robot` is missing"),
        ("doctor rates.toml", "rates.toml:36:11: bus[0].bitrate = 5: must be 10000 to 1000000 bit/s"),
        (
            "doctor --bus-kind vcan",
            "invalid value 'vcan' for '--bus-kind <KIND>': \"vcan\" is not a bus kind: use auto, socketcan \
             or embedded; try '--help'",
        ),
        (
            "up vcan0 --peer vcan1 --namespace nosuch",
            "there is no network namespace nosuch in /run/netns: `ip netns` lists namespaces, `sudo ip netns \
             add nosuch` creates it; a process id or a path is accepted too",
        ),
    ] {
        let said = folder.run(arguments);
        assert_eq!(said.err, format!("vcan-setup: {says}\n"), "{arguments}");
        assert_eq!((said.code, said.out.as_str()), (2, ""), "{arguments}");
    }
}

#[test]
fn a_plan_is_said_in_words_and_as_commands_and_nothing_is_done() {
    let folder = Folder::new();
    folder.write("skin.toml", &skin(&[("\"vcan0\"", "\"nosuchcan1\"")]));
    let said = folder.run("up --dry-run skin.toml nosuchcan2");
    let plan = |name| {
        format!(
            "would make {name}, a vcan with MTU 72, and bring it up\n    ip link add {name} mtu 72 type vcan && ip link \
             set {name} alias skinbus up\n"
        )
    };
    assert_eq!(said.out, plan("nosuchcan1") + &plan("nosuchcan2"));
    assert_eq!((said.code, said.err.as_str()), (0, ""));
    let said = folder.run("up --dry-run nosuchcan1 --peer nosuchcan2");
    assert!(
        said.out.starts_with("would make nosuchcan1 and its other end nosuchcan2, a vxcan pair"),
        "{said:?}"
    );
    let said = folder.run("down skin.toml");
    assert_eq!((said.code, said.out.as_str()), (0, "nosuchcan1 does not exist\n"), "so nothing was made");
}

#[test]
fn a_cause_is_told_once() {
    let folder = Folder::new();
    folder.write("file", "");
    let mut command = folder.command("serve vcan0");
    let said = CommandOutput::run(command.env("SKINBUS_DIR", folder.0.path().join("file/buses")));
    assert_eq!(said.err.matches("Not a directory").count(), 1, "{said:?}");
}

#[test]
fn names_that_are_not_utf_8_are_files_and_no_buses() {
    let folder = Folder::new();
    let skin = folder.0.path().join(OsStr::from_bytes(b"n\xff.toml"));
    std::fs::write(&skin, self::skin(&[])).unwrap();
    for (words, codes) in [
        ("status", [0, 1]),
        ("doctor --bus-kind embedded", [0, 1]),
        ("up --dry-run", [0, 1]),
        ("down --dry-run", [0, 1]),
    ] {
        let file = CommandOutput::run(folder.command(words).arg(skin.file_name().unwrap()));
        assert!(codes.contains(&file.code), "{words}: {file:?}");
        let name = CommandOutput::run(folder.command(words).arg(OsStr::from_bytes(b"vcan\xff")));
        let said = r"vcan-setup: $'vcan\xff' is not a bus name: it is not UTF-8";
        assert_eq!((name.code, name.err.trim_end()), (2, said), "{words}");
    }
    let space = CommandOutput::run(
        folder
            .command("up vcan0 --peer vcan1 --dry-run --namespace")
            .arg(OsStr::from_bytes(b"/nowhere/\xff")),
    );
    assert!([1, 2].contains(&space.code) && !space.err.contains("panicked"), "{space:?}");
}

/// A stack size for which no address space has room: the system starts no thread.
#[test]
fn without_threads_nothing_panics() {
    let folder = Folder::new();
    folder.write("skin.toml", &skin(&[]));
    for (words, said) in [
        ("serve vcan0 --until-eof", "cannot start a thread"),
        ("doctor skin.toml --bus-kind embedded --json", "cannot start a thread"),
    ] {
        let ended =
            CommandOutput::run(folder.command(words).env("RUST_MIN_STACK", (1_u64 << 48).to_string()));
        assert_eq!(ended.code, 1, "{words}: {ended:?}");
        assert!(ended.out.contains(said) || ended.err.contains(said), "{words}: {ended:?}");
        assert!(!ended.err.contains("panicked"), "{words}: {ended:?}");
    }
}

#[test]
fn help_has_examples() {
    let folder = Folder::new();
    for command in ["", "up", "down", "status", "doctor", "serve"] {
        let said = folder.run(&format!("{command} --help"));
        assert!(said.code == 0 && said.out.contains("Example"), "{command}: {said:?}");
    }
}

#[test]
fn status_shows_embedded_buses_and_which_are_served() {
    let folder = Folder::new();
    let status = |arguments: &str| {
        let said = folder.run(&format!("status --json {arguments}"));
        let json: Value = serde_json::from_str(&said.out).unwrap();
        (said.code, json["embedded"].clone(), said.err)
    };
    assert_eq!(status("").1, serde_json::json!([]));
    let served = folder.serve("nosuchcan1");
    let path = folder.buses().join("nosuchcan1.bus").display().to_string();
    let expected = |served| serde_json::json!([{"name": "nosuchcan1", "path": path, "served": served}]);
    assert_eq!(status("nosuchcan1"), (0, expected(true), String::new()));
    let table = folder.run("status nosuchcan1").out;
    assert!(table.contains("nosuchcan1  embedded bus  this user  served"), "{table}");
    drop(served);
    let (code, embedded, err) = status("nosuchcan1");
    assert_eq!((code, embedded), (1, expected(false)), "its server was killed");
    assert_eq!(
        err,
        "vcan-setup: not found: nosuchcan1; `vcan-setup serve nosuchcan1` serves an embedded bus, `vcan-setup doctor \
         nosuchcan1` shows what an interface needs\n"
    );
    assert_eq!(status("nosuchcan2").1, serde_json::json!([]));
}

/// Returns the findings of one level that `doctor` reports on the embedded bus.
fn findings(said: &CommandOutput, level: &str) -> Vec<String> {
    let json: Value = serde_json::from_str(&said.out).unwrap();
    assert_eq!(json["bus_kind"], "embedded");
    assert_eq!(json["would_run"], said.code == 0);
    let all = json["findings"].as_array().unwrap().iter().filter(|it| it["level"] == level);
    all.map(|it| it["text"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn the_doctor_wants_the_cells_program_and_a_private_directory() {
    let folder = Folder::new();
    folder.write("skin.toml", &skin(&[("\"vcan0\"", "\"nosuchcan1\"")]));
    let doctor = || folder.run("doctor skin.toml --bus-kind embedded --json");
    let beside = folder.0.path().join("cell-node");
    let missing =
        format!("cell-node is not at {}: the gateway starts it from its own directory", beside.display());
    assert_eq!(findings(&doctor(), "fault"), [missing]);
    folder.write("cell-node", "");
    assert_eq!(findings(&doctor(), "fault"), Vec::<String>::new());
    let text = folder.run("doctor skin.toml --bus-kind embedded");
    assert!(text.code == 0 && text.out.ends_with("\nA bench would run, on the embedded bus.\n"), "{text:?}");

    std::fs::create_dir(folder.buses()).unwrap();
    std::fs::set_permissions(folder.buses(), std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    let said = doctor();
    assert!(findings(&said, "fault")[0].contains("has mode 0755, so other users can open it"), "{said:?}");
    assert_eq!(folder.run("doctor skin.toml --bus-kind embedded").code, 1);
}

#[test]
fn the_doctor_rates_the_kernel_by_the_choice() {
    let folder = Folder::new();
    folder.write("cell-node", "");
    let said = folder.run("doctor nosuchcan1 --bus-kind socketcan");
    let expected = match has_socketcan() {
        true => "fault there is no interface nosuchcan1\n",
        false => ") does not support CAN, which --bus-kind socketcan needs\n        ",
    };
    assert!(said.out.contains(expected) && said.out.contains("No bench would run"), "{said:?}");
    assert_eq!((said.code, said.err.as_str()), (1, ""));
}

/// Runs the doctor while a process sends on the bus continuously.
fn doctor_hears(folder: &Folder, arguments: &str, ids: &[Id]) -> CommandOutput {
    let options = BusOptions { filters: vec![], directory: Some(folder.buses()), ..BusOptions::default() };
    let bus = Bus::open("nosuchcan1", KindChoice::Only(BusKind::Embedded), &options).unwrap();
    while_sending(&bus, ids, || {
        folder.run(&format!("doctor skin.toml --bus-kind embedded --json {arguments}"))
    })
}

#[test]
fn the_doctor_hears_gateways_and_cells() {
    let folder = Folder::new();
    folder.write("skin.toml", &skin(&[("\"vcan0\"", "\"nosuchcan1\"")]));
    folder.write("cell-node", "");
    let _served = folder.serve("nosuchcan1");
    let joints = Id::command(protocol::id::Command::Joints);
    let heartbeat = |node| Id::new(Kind::Network, Node::Cell(CellId::new(node).unwrap()));
    let stimulus = Id::new(Kind::Stimulus, Node::Cell(CellId::new(7).unwrap()));

    let said = doctor_hears(&folder, "", &[stimulus]);
    assert_eq!(findings(&said, "fault"), Vec::<String>::new(), "somebody at a shell is no gateway");
    let said = doctor_hears(&folder, "", &[joints]);
    let other_gateway = "another gateway sends joints messages on the embedded bus nosuchcan1";
    assert_eq!(findings(&said, "fault"), [other_gateway]);
    let cells = [heartbeat(3), heartbeat(12)];
    let said = doctor_hears(&folder, "", &cells);
    assert_eq!(findings(&said, "fault"), ["cells are already on the embedded bus nosuchcan1: 3, 12"]);
    let said = doctor_hears(&folder, "--no-spawn", &cells);
    assert_eq!(findings(&said, "fault"), Vec::<String>::new());
    assert!(findings(&said, "note")[0].starts_with(
        "2 cells are on the embedded bus nosuchcan1; these cells of the skin sent nothing: 1, 2, 4, 5"
    ));
    let said = doctor_hears(&folder, "--no-spawn", &[]);
    assert!(findings(&said, "fault")[0].starts_with("no cell sends on the embedded bus nosuchcan1"));
}
