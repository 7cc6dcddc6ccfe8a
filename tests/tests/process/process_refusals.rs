//! Invalid input is refused before anything begins: one line names it and says what is allowed or what to do; the exit
//! code is 2, and no file is left behind.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use skinbus_tests::process;

use std::os::unix::net::UnixDatagram;

use process::{PRESSED, TestDir, skin};
use protocol::bus::has_socketcan;

/// Returns the message of a refused command, and checks that it leaves no file.
fn refusal(place: &TestDir, program: &str, words: &str, code: i32) -> String {
    let before = place.files();
    let ended = place.start(program, words).end();
    let said = ended.refusal(code).to_owned();
    place.is_left_clean();
    assert_eq!(place.files(), before, "{words}");
    said
}

/// Replaces something in a skin of three cells, and checks that the gateway and a cell refuse it.
fn skin_refusal(old: &str, new: &str, expected: &str) {
    let place = TestDir::new();
    let text = skin(3);
    let at = text.find(old).unwrap_or_else(|| panic!("{old:?} is not in\n{text}"));
    // A table's first line is its header.
    let line = text[..at].matches('\n').count() + 1 + usize::from(new.starts_with("[["));
    place.write("skin.toml", &text.replacen(old, new, 1));
    let run = "run skin.toml --bus-kind embedded --duration 1 --candump run.log --summary run.json";
    let said = refusal(&place, "skinbus", run, 2);
    let at = format!("skinbus: skin.toml:{line}:");
    assert!(said.starts_with(&at) && said.contains(&format!(": {expected}")), "{said}\n{at} {expected}");
    let cell = refusal(&place, "cell-node", "--bus vcan0 --node 1 --skin skin.toml", 2);
    assert_eq!(cell.strip_prefix("cell-node"), said.strip_prefix("skinbus"));
}

#[test]
fn an_invalid_skin_is_refused_with_line_key_value_and_what_is_allowed() {
    for (old, new, expected) in [
        ("node = 2\n", "node = 1\n", "cell[1].node = 1: cell[0] already has this node id on \"vcan0\""),
        ("node = 2\n", "node = 255\n", "cell[1].node = 255: must be 1 to 254"),
        ("joint = 2\n", "joint = 7\n", "cell[0].joint = 7: use a joint from 1 to 6"),
        ("joint = 2\n", "joint = 0\n", "cell[0].joint = 0: use a joint from 1 to 6"),
        (
            "orientation = [0.0, 0.0, 0.0, 1.0]",
            "orientation = [0.0, 0.0, 0.0, 0.9]",
            "cell[0].orientation = [0, 0, 0, 0.9]: this quaternion has length 0.900000; it must be 1 to \
             within 0.001",
        ),
        (
            "position = [",
            "position = [2.0, 0.0, 0.0]#[",
            "cell[0].position = [2, 0, 0]: the distance from node 1 to a joint frame of its chain can reach \
             2.000 m, 0.001 m more than Q1.14 can hold (1.999 m)",
        ),
        (
            "[controller]",
            "[[bus]]\nname = \"vcan0\"\nreply = \"torque\"\nformat = \"fd\"\n\n[controller]",
            "bus[1].name = \"vcan0\": another bus already has this name",
        ),
        ("serial = 100001", "seriall = 100001", "unknown field `seriall`, expected one of"),
        ("control_hz = 500.0", "control_hz = 0.0", "timing.control_hz = 0: must be 1 to 10000 Hz"),
        ("version = 1", "version = 2", "version = 2: this program reads version 1"),
        (
            "bus = \"vcan0\"\nnode = 1",
            "bus = \"vcan9\"\nnode = 1",
            "cell[0].bus = \"vcan9\": the skin has no such bus; its buses are \"vcan0\"",
        ),
    ] {
        skin_refusal(old, new, expected);
    }
}

#[test]
fn a_fault_that_processes_cannot_make_is_refused() {
    let place = TestDir::new();
    place.skin(3);
    place.scenario(&format!(
        "{PRESSED}\n[[fault]]\nat_s = 1.0\nkind = \"drop\"\nprobability = 0.5\nbus = \"vcan0\"\n"
    ));
    let said = refusal(&place, "skinbus", "run skin.toml --scenario scenario.toml --bus-kind embedded", 2);
    assert!(
        said.starts_with("skinbus: the fault \"drop\" of vcan0 at 1 s works only in virtual time"),
        "{said}"
    );
}

#[test]
fn a_scenario_that_does_not_fit_the_skin_is_refused() {
    let place = TestDir::new();
    place.skin(3);
    for (scenario, expected) in [
        (
            PRESSED.replace("all = true", "bus = \"vcan0\"\ncells = [2, 9]"),
            "scenario.toml:16:13: touch[0].cells[1] = 9: ",
        ),
        (
            PRESSED.replace("force_n = 1.5", "force_n = 1e9"),
            "scenario.toml:16:11: touch[0].force_n = 1000000000: ",
        ),
        (
            PRESSED.replace("\"step\"", "\"stepp\""),
            "scenario.toml:17:11: touch[0].profile = \"stepp\": must be \"half-sine\", ",
        ),
        (
            PRESSED.replace("duration_s", "durations"),
            "scenario.toml:2:1: unknown field `durations`, expected one of ",
        ),
    ] {
        place.scenario(&scenario);
        let run = "run skin.toml --scenario scenario.toml --bus-kind embedded --summary run.json";
        let said = refusal(&place, "skinbus", run, 2);
        assert!(said.starts_with(&format!("skinbus: {expected}")), "{said}");
    }
}

#[test]
fn files_that_are_not_there_are_named() {
    let place = TestDir::new();
    place.pressed();
    for (words, expected) in [
        ("run nowhere.toml", "nowhere.toml: No such file or directory (os error 2)"),
        ("run skin.toml --scenario nowhere.toml", "nowhere.toml: No such file or directory (os error 2)"),
        ("run .", ".: it is a folder, but a file is needed"),
        (
            "run skin.toml SKINBUS_CELL_NODE=/nowhere",
            "the program cell-node is not at /nowhere: build it with `cargo build --release`, or set \
             SKINBUS_CELL_NODE to its path",
        ),
        (
            "run skin.toml SKINBUS_VCAN_SETUP=/nowhere",
            "the program vcan-setup is not at /nowhere: build it with `cargo build --release`, or set \
             SKINBUS_VCAN_SETUP to its path",
        ),
    ] {
        let said = refusal(&place, "skinbus", &format!("{words} --bus-kind embedded --candump run.log"), 2);
        assert_eq!(said, format!("skinbus: {expected}"));
    }
    let said = refusal(&place, "cell-node", "--bus vcan0 --node 1 --skin nowhere.toml", 2);
    assert_eq!(said, "cell-node: nowhere.toml: No such file or directory (os error 2)");
}

#[test]
fn a_file_that_is_no_program_is_named() {
    let place = TestDir::new();
    place.pressed();
    let said = refusal(
        &place,
        "skinbus",
        "run skin.toml SKINBUS_CELL_NODE=skin.toml --bus-kind embedded --quiet",
        2,
    );
    assert_eq!(said, "skinbus: cannot start ./skin.toml: Permission denied (os error 13)");
    // A program that starts and is not a cell.
    let said = refusal(
        &place,
        "skinbus",
        "run skin.toml SKINBUS_CELL_NODE=/bin/true --bus-kind embedded --quiet",
        1,
    );
    assert!(
        said.ends_with(" on vcan0 ended while it was starting (exit status: 0); see the message above"),
        "{said}"
    );
}

#[test]
fn files_that_cannot_be_written_are_noticed_before_the_run() {
    let place = TestDir::new();
    place.pressed();
    std::fs::create_dir(place.path("folder")).unwrap();
    for option in ["--candump", "--summary"] {
        for (file, why) in [
            ("nowhere/file", "No such file or directory (os error 2)"),
            ("skin.toml/file", "Not a directory (os error 20)"),
            ("folder", "is a directory"),
            // Not even root may write there.
            ("/sys/file", "Permission denied (os error 13)"),
        ] {
            let said =
                refusal(&place, "skinbus", &format!("run skin.toml --bus-kind embedded {option} {file}"), 2);
            let hint = "name a file in a folder that can be written";
            assert_eq!(said, format!("skinbus: {option} {file}: {why}; {hint}"));
        }
    }
    let both = "run skin.toml --bus-kind embedded --candump file --summary file";
    let said = refusal(&place, "skinbus", both, 2);
    assert_eq!(said, "skinbus: --summary and --candump name the same file: name two different files");
}

#[test]
fn a_run_that_fails_to_start_leaves_old_recordings_and_has_a_summary() {
    let place = TestDir::new();
    place.pressed();
    place.write("run.log", "of yesterday\n");
    place.write("run.json", "{}\n");
    let run = "run skin.toml --bus-kind embedded --candump run.log --summary run.json SKINBUS_CELL_NODE=/bin/true \
               --quiet --overwrite --record run.mcap";
    place.write("run.mcap", "of yesterday\n");
    refusal(&place, "skinbus", run, 1);
    assert_eq!(place.read("run.mcap"), "of yesterday\n");
    assert_eq!(place.read("run.log"), "of yesterday\n");
    assert_eq!(place.summary().0["outcome"], "failed");
}

#[test]
fn a_bus_that_does_not_exist_is_named_with_its_hint() {
    let place = TestDir::new();
    place.write("skin.toml", &skin(3).replace("\"vcan0\"", "\"nosuch0\""));
    let expected = match has_socketcan() {
        true => {
            "there is no interface nosuch0: make it with `vcan-setup up nosuch0`, or plug it in if it is hardware"
        }
        false => {
            "nosuch0: this kernel has no SocketCAN; load it with `modprobe can_raw`, or use the embedded bus \
             (--bus-kind embedded)"
        }
    };
    let said = refusal(&place, "skinbus", "run skin.toml --bus-kind socketcan --candump run.log", 2);
    assert_eq!(said, format!("skinbus: {expected}"));
    let cell = "--bus nosuch0 --node 1 --skin skin.toml --bus-kind";
    assert_eq!(
        refusal(&place, "cell-node", &format!("{cell} socketcan"), 2),
        format!("cell-node: {expected}")
    );
    let said = refusal(&place, "cell-node", &format!("{cell} embedded"), 2);
    assert!(said.starts_with("cell-node: no embedded bus nosuch0 is served in "), "{said}");
    let said = refusal(&place, "cell-node", "--bus vcan7 --node 1 --skin skin.toml", 2);
    assert_eq!(said, "cell-node: the skin file skin.toml has no bus vcan7; its buses are nosuch0");
    let said = refusal(&place, "cell-node", "--bus nosuch0 --nodes 2-9 --skin skin.toml", 2);
    assert_eq!(said, "cell-node: the skin file skin.toml has no cell 4 on bus nosuch0");
}

#[test]
fn buses_are_not_kept_where_others_may_look() {
    let place = TestDir::new();
    place.pressed();
    std::fs::create_dir(place.path("open")).unwrap();
    let mut command = place.command("skinbus", "run skin.toml --bus-kind embedded --candump run.log");
    command.env("SKINBUS_DIR", place.path("open"));
    let ended = process::Running::start(command).end();
    let said = ended.refusal(2);
    assert!(said.contains("so other users can open it: run `chmod 700` on it, or set SKINBUS_DIR"), "{said}");
    assert_eq!(place.files(), ["open", "scenario.toml", "skin.toml"]);
}

#[test]
fn an_unusable_socket_of_an_external_controller_is_named_before_cells_are_started() {
    let place = TestDir::new();
    let kinesthetic = |line: &&str| !line.starts_with("inertia = ") && !line.starts_with("damping = ");
    let text = skin(3);
    let text: String = text.lines().filter(kinesthetic).map(|line| format!("{line}\n")).collect();
    let refused = |socket: &str, expected: &str| {
        let external = format!("kind = \"external\"\nsocket = \"{socket}\"");
        place.write("skin.toml", &text.replace("kind = \"kinesthetic\"", &external));
        let said = refusal(&place, "skinbus", "run skin.toml --bus-kind embedded --candump run.log", 2);
        assert_eq!(said, format!("skinbus: {}", expected.replace("PATH", socket)));
    };
    refused("nowhere/c.sock", "cannot listen on the socket PATH: No such file or directory (os error 2)");
    place.write("plain", "");
    refused("plain", "PATH exists and is not a socket, so it was left unchanged; choose another path");
    let _live = UnixDatagram::bind(place.path("live.sock")).unwrap();
    refused("live.sock", "another program listens on the socket PATH; stop it, or choose another path");
}

#[test]
fn wrong_options_are_one_line() {
    let place = TestDir::new();
    place.pressed();
    let seconds = "use a time above 0 s, up to 1e7 s, such as 10, 500ms, 90s, 10min or 2h; try '--help'";
    let needed = "the following required arguments were not provided";
    for (program, words, expected) in [
        ("skinbus", "run skin.toml --duration 0", format!("invalid value '0' for '--duration <TIME>': {seconds}")),
        ("skinbus", "run skin.toml --duration -1", format!("invalid value '-1' for '--duration <TIME>': {seconds}")),
        ("skinbus", "run skin.toml --duration nan", format!("invalid value 'nan' for '--duration <TIME>': {seconds}")),
        (
            "skinbus",
            "run skin.toml --bus-kind ethernet",
            "invalid value 'ethernet' for '--bus-kind <[BUS=]KIND>': \"ethernet\" is not a bus kind: use \
             auto, socketcan or embedded; try '--help'"
                .to_owned(),
        ),
        (
            "skinbus",
            "run skin.toml --cells-per-process 0",
            "invalid value '0' for '--cells-per-process <N>': 0 is not in 1..=254; try '--help'".to_owned(),
        ),
        ("skinbus", "run", format!("{needed}: <SKIN>; try '--help'")),
        ("skinbus", "run skin.toml --fast", "unexpected argument '--fast' found; a similar argument exists: '--flash'; try '--help'".to_owned()),
        ("cell-node", "--bus vcan0 --skin skin.toml", format!("{needed}: --node <N>; try '--help'")),
        (
            "cell-node",
            "--bus vcan0 --skin skin.toml --nodes 9-3",
            "invalid value '9-3' for '--nodes <A-B>': use two node ids from 1 to 254, the smaller one first, \
             such as 1-64; try '--help'"
                .to_owned(),
        ),
        (
            "cell-node",
            "--bus vcan0 --skin skin.toml --node 0",
            "0 is not a node id: use 1 to 254 (0 is the gateway, 255 is everyone)".to_owned(),
        ),
    ] {
        let said = refusal(&place, program, words, 2);
        assert_eq!(said, format!("{program}: {expected}"), "{words}");
    }
}
