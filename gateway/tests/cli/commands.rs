//! `skinbus dump`, `frame`, `ack` and `skin` as processes.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

mod live;
mod names;
mod terminal;

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use protocol::can::{Format, Frame};
use protocol::candump;
use protocol::message::Message;
use protocol::packet::{Lengths, Packet, Reassembler, Reassembly, data_frame_id};
use protocol::time::Micros;
use tempfile::TempDir;

/// The documents that spell out frames.
const DOCUMENT: &str = concat!(
    include_str!("../../../docs/reference/protocol.md"),
    include_str!("../../../docs/reference/cell.md"),
    include_str!("../../../docs/reference/sensing.md"),
);
const FD: &str = include_str!("../../../protocol/tests/golden/fd.log");

fn gateway(arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split(' ').filter(|word| !word.is_empty()));
    command.env("NO_COLOR", "1").env("SKINBUS_DIR", "/nowhere/skinbus");
    command
}

fn golden(name: &str) -> String {
    format!("{}/../protocol/tests/golden/{name}", env!("CARGO_MANIFEST_DIR"))
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// Standard output of a command that succeeds without messages.
fn output(mut command: Command) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap();
    assert_eq!((status.code(), text(&stderr)), (Some(0), ""), "{command:?}");
    text(&stdout).to_owned()
}

/// The one-line error of a command that ends with this code and prints nothing else.
fn refusal(arguments: &str, code: i32) -> String {
    let Output { status, stdout, stderr } = gateway(arguments).output().unwrap();
    let said = text(&stderr);
    assert_eq!((status.code(), text(&stdout)), (Some(code), ""), "{arguments}: {said}");
    assert_eq!(said.matches('\n').count(), 1, "{arguments}: {said}");
    said.trim_end().to_owned()
}

/// The decoded part of each line.
fn decoded(shown: &str) -> Vec<&str> {
    shown.lines().map(|line| line.split_once('\t').unwrap().1).collect()
}

#[test]
fn a_log_is_shown_as_it_is_with_its_meaning_beside_it() {
    for name in ["fd.log", "classic.log", "bad.log", "session.log"] {
        let log = std::fs::read_to_string(golden(name)).unwrap();
        let frames: Vec<&str> = log.lines().filter(|line| line.starts_with('(')).collect();
        let shown = output(gateway(&format!("dump {}", golden(name))));
        let raw: Vec<&str> = shown.lines().map(|line| line.split_once('\t').unwrap().0).collect();
        assert_eq!(raw, frames, "{name}");
    }
    let shown = output(gateway(&format!("dump {} -n 5", golden("document.log"))));
    let expected = "(1700000000.001000) vcan0 20C##5001000F80100000000000000070175D6\t\
                    ok      torque 12 epoch 7: 1.0000 -0.5000 0.0002 0.0000 0.0000 0.0000 Nm";
    assert_eq!((shown.lines().count(), shown.lines().next()), (5, Some(expected)));
}

#[test]
fn times_names_and_directions_are_those_of_the_log() {
    let mut child = gateway("dump -").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let log = "(0000000012.000034567)   can0  123#11.22 T\r\n# more\n\n(1.000000) slcan0 20c##1 R";
    child.stdin.take().unwrap().write_all(log.as_bytes()).unwrap();
    let Output { status, stdout, .. } = child.wait_with_output().unwrap();
    let expected = "(0000000012.000034567) can0 123#1122 T\tforeign no packet: 2 data bytes, not 8\n\
                    (1.000000) slcan0 20C##1 R\tforeign no packet: 0 data bytes, not 16\n";
    assert_eq!((status.code(), text(&stdout)), (Some(0), expected));
}

#[test]
fn filters_pick_by_kind_node_and_time() {
    let dump = |filters: &str| {
        let shown = output(gateway(&format!("dump {} {filters}", golden("session.log"))));
        decoded(&shown).into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let torques = [
        "ok      torque 12 epoch 7: -0.2625 0.7800 0.0000 0.0000 0.0000 0.0000 Nm",
        "ok      torque 12 epoch 8: 0.0000 0.0000 0.0000 0.0000 0.0000 0.0000 Nm",
    ];
    assert_eq!(dump("--kind torque"), torques);
    assert_eq!(dump("--kind torque -n 1"), torques[..1]);
    assert_eq!(dump("--kind sync,report --cell gateway"), ["ok      sync", "ok      report"]);
    let none = format!("dump {} --cell 13", golden("session.log"));
    let Output { stdout, stderr, .. } = gateway(&none).output().unwrap();
    assert!(stdout.is_empty() && text(&stderr).ends_with("session.log contains no frame from or to 13\n"));
    assert_eq!(dump("--cell 12,gateway").len(), dump("").len());
    assert_eq!(dump("--from 0.002 --to 0.005"), dump("")[2..5], "1 ms apart");
    let classic = output(gateway(&format!("dump {} --from 0.0005 -n 2", golden("classic.log"))));
    let pair =
        ["segment joints", "ok      joints epoch 255: -3.1416 3.1415 -0.0001 0.0001 1.5708 -1.5708 rad"];
    assert_eq!(decoded(&classic), pair);
    let only_fd = output(gateway(&format!("dump {} --format fd -n 1", golden("classic.log"))));
    assert_eq!(decoded(&only_fd), ["foreign no packet: 8 data bytes, not 16"]);
}

#[test]
fn lines_that_cannot_be_read_are_named_and_the_others_shown() {
    let directory = TempDir::new().unwrap();
    let file = directory.path().join("odd.log");
    let log = b"(1.000000) vcan0 000##500000000000000000000000000000A6A\n\
                (1.000000) vcan0 12#11\n\
                DROPCOUNT: dropped 12 CAN frames on 'vcan0' socket (total drops 40)\n\
                (1.000000) vcan0 \xff\n\
                (1.000000) vcan0 00242###81000000000011.\n\
                (1.000000) vcan0 1F334455#R4\n";
    std::fs::write(&file, log).unwrap();
    let Output { status, stdout, stderr } = gateway("dump").arg(&file).output().unwrap();
    assert_eq!(status.code(), Some(0));
    assert_eq!(decoded(text(&stdout)), ["ok      halt", "foreign remote frame"]);
    let name = file.display();
    let expected = format!(
        "{name}:2: column 18: expected an identifier of 3 or 8 hexadecimal digits\n{name}:3: 12 frames are \
         missing here, because the recorder lost them\n{name}:4: column 18: expected an identifier of 3 or 8 \
         hexadecimal digits\n{name}: 2 of 6 lines could not be read\n{name}: CAN XL frames are not shown: \
         1\n"
    );
    assert_eq!(text(&stderr), expected);
}

#[test]
fn a_reader_that_leaves_ends_it_quietly() {
    let directory = TempDir::new().unwrap();
    let file = directory.path().join("long.log");
    let (_, frame) = FD.lines().find(|line| line.starts_with('(')).unwrap().split_once(' ').unwrap();
    let lines: Vec<_> = (0..40_000).map(|second| format!("({second}.000000) {frame}\n")).collect();
    std::fs::write(&file, lines.concat()).unwrap();
    let mut child = gateway("dump").arg(&file).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::with_capacity(16, child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert!(line.ends_with("\tok      halt\n"), "{line}");
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    assert_eq!((status.code(), text(&stderr)), (Some(0), ""));
}

#[test]
fn frames_are_those_of_the_document() {
    let pose = "0.1 0.05 0.06 0 0.8 0.6";
    let half_pi = "1.5707963267948966";
    for (arguments, tag) in [
        ("halt".to_owned(), None),
        ("sync".to_owned(), None),
        ("resume".to_owned(), None),
        ("joints --epoch 7 --rad 0 -1.2 1.0 -1.4 -1.57 0".to_owned(), None),
        ("joints --epoch 7 --words 0 0xCF1C 0x28BE 0xC6F5 0xC008 0".to_owned(), None),
        ("configure --cell 12 --write mount 2 6".to_owned(), Some(1)),
        (format!("configure --cell 12 --write pose {pose}"), Some(2)),
        ("configure --cell 12 --write contact 1 0 0.1 0.05 0.1".to_owned(), Some(3)),
        ("configure --cell 12 --write timing 16000".to_owned(), Some(4)),
        (format!("configure --cell 12 --write row1 0 0.089159 {half_pi} 0"), Some(5)),
        ("configure --cell 12 --write row2 -0.425 0 0 0".to_owned(), Some(6)),
        ("configure --cell 12 --write row3 -0.39225 0 0 0".to_owned(), Some(7)),
        (format!("configure --cell 12 --write row4 0 0.10915 {half_pi} 0"), Some(8)),
        (format!("configure --cell 12 --write row5 0 0.09465 -{half_pi} 0"), Some(9)),
        ("configure --cell 12 --write row6 0 0.0823 0 0".to_owned(), Some(10)),
        ("configure --cell 12 --write commit 266D".to_owned(), Some(11)),
        ("configure --cell 12 --write mode 1".to_owned(), Some(12)),
        ("stimulus --cell 12 --force 3.0".to_owned(), None),
        ("stimulus --cell 12".to_owned(), None),
    ] {
        let tag = tag.map(|tag| format!(" --tag {tag}")).unwrap_or_default();
        let line = output(gateway(&format!("frame {arguments}{tag}")));
        let (id, data) = line.trim_end().split_once("##1").unwrap();
        let there = [1, 5].iter().any(|flags| DOCUMENT.contains(&format!("{id}##{flags}{data}")));
        assert!(there, "{arguments}: {line}is not in the document");
    }
    // The document writes these frames with exactly these flags.
    let line = output(gateway("frame stimulus --cell 12 --force 3.0"));
    assert!(DOCUMENT.contains(&format!("cansend vcan0 {}", line.trim_end())), "{line}");
}

#[test]
fn frames_mean_what_was_requested() {
    for (arguments, meaning) in [
        ("report", "report"),
        (
            "stimulus --cell everyone --epoch 7 --force 1 --proximity 0.5 --temperature 25 -40",
            "stimulus everyone from epoch 7 on: force 1.000 N (0.334 0.333 0.333), proximity 0.5000, temperature 25.00 -40.00 °C",
        ),
        (
            "stimulus --cell 254 --acceleration 0 -1 0.5",
            "stimulus 254 from the next joints on: acceleration 0.0000 -1.0000 0.5000 g",
        ),
        ("configure --cell everyone --read identity --tag 255", "configure everyone tag 255: read identity"),
        (
            "configure --cell 1 --write 99 1 -1 0x7FFF",
            "configure 1 tag 0: write parameter 99: words 1 -1 32767 0 0 0",
        ),
    ] {
        for format in [Format::Fd, Format::Classic] {
            let name = if format == Format::Fd { "fd" } else { "classic" };
            let lines = output(gateway(&format!("frame {arguments} --format {name}")));
            let frames: Vec<_> = lines.lines().map(|line| candump::parse_frame(line).unwrap()).collect();
            Message::decode(&packet(&frames, format)).unwrap();
            let log: String = lines.lines().map(|line| format!("(1.000000) vcan0 {line}\n")).collect();
            let directory = TempDir::new().unwrap();
            let file = directory.path().join("frames.log");
            std::fs::write(&file, log).unwrap();
            let shown = output(gateway(&format!("dump {}", file.display())));
            assert_eq!(*decoded(&shown).last().unwrap(), format!("ok      {meaning}"), "{arguments}");
        }
    }
}

/// Decodes a packet from one FD frame or two classic ones.
fn packet(frames: &[Frame], format: Format) -> Packet {
    match (format, frames) {
        (Format::Fd, [frame]) => Packet::from_fd(frame).unwrap(),
        (Format::Classic, [first, second]) => {
            let mut segment = Reassembler::NONE;
            let mut push = |frame: &Frame| {
                segment.push(Micros(0), data_frame_id(frame).unwrap(), Lengths::ALL, frame.data()).unwrap()
            };
            assert_eq!(push(first), Reassembly::Waiting);
            let Reassembly::Complete(packet) = push(second) else { panic!("{frames:?}") };
            packet
        }
        (Format::Fd | Format::Classic, _) => panic!("{frames:?}"),
    }
}

#[test]
fn wrong_use_is_one_line_and_exit_code_2() {
    for (arguments, expected) in [
        (
            "frame stimulus --cell 300",
            "invalid value '300' for '--cell <[BUS:]NODE>': use a node id from 1 to 254, BUS:NODE, or everyone; \
             try '--help'",
        ),
        (
            "frame stimulus --cell 12 --force 100",
            "--force 100: use -96 to 95.997 N, the most that a cell's three contact sensors can report",
        ),
        (
            "frame stimulus",
            "the following required arguments were not provided: --cell <[BUS:]NODE>; try '--help'",
        ),
        (
            "frame joints --epoch 256 --rad 0",
            "invalid value '256' for '--epoch <E>': 256 is not in 0..=255; try '--help'",
        ),
        ("frame configure --cell 12 --write mode 2", "mode = 2: 0 measures, 1 obeys stimuli"),
        (
            "dump run.log --from -1",
            "invalid value '-1' for '--from <S>': use a time from 0 s to 1e9 s, such as 10, 500ms, 90s, 10min or 2h; \
             try '--help'",
        ),
        ("dump / ", "/ is a directory: name a candump log or buses"),
        (
            "skin generate --cells 255",
            "255 cells do not fit on one bus: a bus has 254 node ids; use --buses 2",
        ),
        ("check /nowhere.toml", "/nowhere.toml: No such file or directory (os error 2)"),
        (
            "run skin.toml scenario.toml",
            "unexpected argument scenario.toml after the skin: to use a scenario, write --scenario scenario.toml",
        ),
        ("skin chek", "unrecognized subcommand 'chek'; try '--help'"),
        ("dump nosuch.mcap", "there is no file and no bus named nosuch.mcap: correct the path"),
        ("dump a/b.log", "there is no file and no bus named a/b.log: correct the path"),
    ] {
        assert_eq!(refusal(arguments, 2), format!("skinbus: {expected}"), "{arguments}");
    }
    for command in ["dump", "fit"] {
        let said = refusal(&format!("{command} nosuch --bus-kind embedded"), 2);
        let expected = "skinbus: there is no file nosuch, and opening it as a bus failed: no embedded bus nosuch is \
                        served in ";
        assert!(said.starts_with(expected), "{said}");
    }
    let said = refusal("list", 2);
    assert!(said.starts_with("skinbus: there is no command list; the commands are demo, run, "), "{said}");
    assert!(said.contains(", cells, "), "{said}");
    let skin = format!("{}/Cargo.toml", env!("CARGO_MANIFEST_DIR"));
    let said = refusal(&format!("dump {skin}"), 1);
    assert!(said.contains("Cargo.toml: no frame in "), "{said}");
}

#[test]
fn the_example_is_what_the_command_in_its_header_prints() {
    let example = include_str!("../../examples/ur5-253.toml");
    let command = example.lines().next().unwrap().strip_prefix("# skinbus ").unwrap();
    assert!(output(gateway(command)) == example, "generate it with skinbus {command}");
}

#[test]
fn a_generated_skin_is_a_whole_file_and_checked_in_a_few_lines() {
    let directory = TempDir::new().unwrap();
    let file = directory.path().join("skin.toml");
    let generate = "skin generate --cells 3 --buses 2 --reply sum";
    assert_eq!(output(gateway(&format!("{generate} -o {}", file.display()))), "");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), output(gateway(generate)));
    assert_eq!(names(directory.path()), ["skin.toml"]);
    let nowhere = directory.path().join("none/skin.toml");
    let nowhere = format!("-o {}", nowhere.display());
    let why = "No such file or directory (os error 2); name a file in a folder that can be written";
    assert_eq!(refusal(&format!("{generate} {nowhere}"), 2), format!("skinbus: {nowhere}: {why}"));

    let shown = output(gateway(&format!("check {}", file.display())));
    let (hash, lines): (Vec<_>, Vec<_>) = shown.lines().partition(|line| line.starts_with("hash of "));
    let expected = [
        "ur5-3: 3 cells, 2 buses",
        "robot: UR5, 6 joints",
        "timing: control loop 500 Hz, joints 62.5 Hz (every 16000 us), kinesthetic controller",
        "bus vcan0 (fd, sum in slots of 6000 us): 2 cells: 2 on joint 2; root: cell 1",
        "bus vcan1 (fd, sum in slots of 12000 us): 1 cell: 1 on joint 3; root: cell 1",
    ];
    assert_eq!((hash.len(), lines), (1, expected.to_vec()));

    let skin = protocol::skin::Skin::read(&file).unwrap();
    let shown = output(gateway(&format!("check --list {}", file.display())));
    let hash = skin.parameters(&skin.cells[2]).hash();
    let ([x, y, z], line) = (skin.cells[2].position, shown.lines().last().unwrap());
    assert!(line.starts_with(&format!("vcan1 1 joint 3 at {x} {y} {z} m normal ")), "{line}");
    assert!(line.ends_with(&format!(" ports - - - - root serial 200001 hash {hash:04X}")), "{line}");
    assert_eq!(output(gateway(&format!("check --cell 2 {}", file.display()))).lines().count(), 1);
    let said = refusal(&format!("check --cell 9 {}", file.display()), 2);
    assert!(said.ends_with("does not have this cell on vcan0, vcan1; --list lists all cells"), "{said}");
}

#[test]
fn a_check_shows_bit_rates_and_cells_at_one_place() {
    let directory = TempDir::new().unwrap();
    let file = directory.path().join("skin.toml");
    let text = output(gateway("skin generate --cells 3 --buses 2"));
    let text = text.replacen("format = \"fd\"", "format = \"fd\"\nbitrate = 500000", 1);
    let last = &text[text.rfind("[[cell]]").unwrap()..];
    let another = last.replace("node = 1", "node = 7").replace("serial = 200001", "serial = 200007");
    std::fs::write(&file, format!("{text}\n{another}")).unwrap();
    let shown = output(gateway(&format!("check {}", file.display())));
    assert!(shown.contains("bus vcan0 (fd, 500000 bit/s, torque): 2 cells"), "{shown}");
    assert!(shown.contains("note: cells 1 on vcan1 and 7 on vcan1 have the same position"), "{shown}");
}

/// Checks a scenario file beside a skin of three cells. Returns the output.
fn checked(scenario: &str, options: &str) -> Output {
    let directory = TempDir::new().unwrap();
    let [skin, file] = ["skin.toml", "s.toml"].map(|name| directory.path().join(name));
    output(gateway(&format!("skin generate --cells 3 -o {}", skin.display())));
    std::fs::write(&file, scenario).unwrap();
    let line = format!("check s.toml --skin skin.toml {options}");
    gateway(&line).current_dir(directory.path()).output().unwrap()
}

#[test]
fn a_scenario_is_shown_in_the_order_of_time() {
    let scenario = "[[fault]]\nat_s = 3.0\nkind = \"kill\"\ncells = [2]\n\
                    [[touch]]\nat_s = 1.0\nfor_s = 0.5\nall = true\nforce_n = 2.0\nprofile = \"ramp\"\n\
                    [[touch]]\ncells = [1, 3]\nforce_n = 3.0\n";
    let Output { status, stdout, stderr } = checked(scenario, "--json");
    assert_eq!((status.code(), text(&stderr)), (Some(0), ""));
    let plan: serde_json::Value = serde_json::from_slice(&stdout).unwrap();
    assert_eq!((&plan["duration_s"], &plan["motion"]["kind"]), (&10.0.into(), &"kinesthetic".into()));
    let events: Vec<_> =
        plan["events"].as_array().unwrap().iter().map(|it| (&it["what"], &it["cells"])).collect();
    let cells = |nodes: &[u8]| serde_json::json!(nodes);
    let expected = [("touch", cells(&[1, 3])), ("touch", cells(&[1, 2, 3])), ("kill", cells(&[2]))];
    let expected = expected.map(|(what, cells)| (serde_json::json!(what), cells));
    assert_eq!(events, expected.each_ref().map(|(what, cells)| (what, cells)));
    assert_eq!((&plan["events"][1]["force_n"], &plan["events"][1]["for_s"]), (&2.0.into(), &0.5.into()));
    let Output { stdout, .. } = checked(scenario, "");
    let shown = text(&stdout);
    let rows: Vec<_> = shown.lines().filter(|line| line.contains("vcan0")).collect();
    assert!(
        rows.len() == 3 && rows[1].contains("1-3") && rows[1].contains("force_n 2.0, profile ramp"),
        "{shown}"
    );
}

#[test]
fn a_scenario_shows_the_points_of_a_profile_as_they_are_followed() {
    let scenario = "[[touch]]\ncells = [\"vcan0:1\", 3]\nprofile = [[0.5, 2.0], [2.0, 0.5]]\n";
    let plan: serde_json::Value = serde_json::from_slice(&checked(scenario, "--json").stdout).unwrap();
    let values = ["profile", "force_n", "for_s", "cells"].map(|key| &plan["events"][0][key]);
    let points = serde_json::json!([[0.0, 0.0], [0.5, 2.0], [2.0, 0.5]]);
    assert_eq!(values, [&points, &2.0.into(), &2.0.into(), &serde_json::json!([1, 3])]);
    let shown = |scenario: &str| text(&checked(scenario, "").stdout).to_owned();
    let few = shown(scenario);
    assert!(few.contains("force_n 2.0, profile [0.0,0.0] [0.5,2.0] [2.0,0.5]"), "{few}");
    let many: Vec<_> = (1..30).map(|at| format!("[{at}.0, 1.0]")).collect();
    let many = shown(&format!("[[touch]]\nall = true\nprofile = [{}]\n", many.join(", ")));
    assert!(many.contains("profile [0.0,0.0] [1.0,1.0] ... [29.0,1.0] (30 in all)"), "{many}");
}

#[test]
fn what_is_wrong_with_a_scenario_has_a_line_and_a_column() {
    let said = |scenario: &str| {
        let Output { status, stderr, .. } = checked(scenario, "");
        assert_eq!(status.code(), Some(2));
        text(&stderr).trim_end().to_owned()
    };
    let wrong = said("[[touch]]\ncells = [1, 9]\nforce_n = 3.0\n");
    assert_eq!(
        wrong,
        "skinbus: s.toml:2:13: touch[0].cells[1] = 9: no cell of \"vcan0\" has node id 9: it has 1-3"
    );
    let drop = "[[fault]]\nat_s = 1.0\nkind = \"drop\"\nprobability = 0.5\n";
    let refused = said(drop);
    assert!(
        refused.starts_with("skinbus: the fault \"drop\" of vcan0 at 1 s works only in virtual time"),
        "{refused}"
    );
}

#[test]
fn times_are_taken_with_and_without_a_unit() {
    let shown = |from: &str| output(gateway(&format!("dump {} --from {from}", golden("session.log"))));
    assert_eq!(shown("0.002"), shown("2ms"));
    assert_ne!(shown("2ms"), shown("2s"));
    for wrong in ["10x", "s", "0s", "-1min"] {
        let said = refusal(&format!("run skin.toml --duration={wrong}"), 2);
        let allowed = "use a time above 0 s, up to 1e7 s, such as 10, 500ms, 90s, 10min or 2h";
        assert!(said.contains(allowed), "{said}");
    }
    let said = refusal("run nosuch.toml --duration 10s --record-split 1.5min --record x.mcap", 2);
    assert!(said.contains("nosuch.toml: No such file"), "both are taken: {said}");
}

#[test]
fn a_report_says_that_it_is_no_recording_before_that_the_page_is_there() {
    let directory = TempDir::new().unwrap();
    let file = directory.path().join("x.json");
    std::fs::write(&file, "{}").unwrap();
    std::fs::write(file.with_extension("html"), "").unwrap();
    let said = refusal(&format!("report {}", file.display()), 2);
    assert!(said.contains("x.json is a candump log, which contains only frames"), "{said}");
}

fn names(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

/// The check reads the skin's URDF as a recording run does.
#[test]
fn a_check_refuses_what_a_recorded_run_would_refuse() {
    let folder = TempDir::new().unwrap();
    let skin = folder.path().join("skin.toml");
    let text = output(gateway("skin generate --cells 8"));
    let with = |urdf: &str| text.replacen("[robot]\n", &format!("[robot]\nurdf = \"{urdf}\"\n"), 1);
    std::fs::write(folder.path().join("empty.urdf"), "").unwrap();
    for (urdf, why) in
        [("/dev/zero", "it is a device"), ("nothing.urdf", "No such file"), ("empty.urdf", "empty.urdf")]
    {
        std::fs::write(&skin, with(urdf)).unwrap();
        let said = refusal(&format!("check {}", skin.display()), 2);
        assert!(said.starts_with("skinbus: robot.urdf: ") && said.contains(why), "{said}");
    }
}

#[test]
fn every_command_has_help_with_an_example() {
    let commands = "dump, frame, frame halt, frame resume, frame sync, frame report, frame joints, frame stimulus, frame \
                    configure, frame sensing, skin generate, skin dbc, check, skin import, skin show, explain, fit, \
                    completions, man";
    for command in commands.split(", ") {
        let help = output(gateway(&format!("{command} --help")));
        assert!(
            help.contains("Example") && help.contains(&format!("  skinbus {command}")),
            "{command}: {help}"
        );
    }
}

#[test]
fn what_is_no_file_or_too_long_is_not_read() {
    let urdf = format!("{}/examples/panda.urdf", env!("CARGO_MANIFEST_DIR"));
    let folder = tempfile::tempdir().unwrap();
    let long = folder.path().join("long.toml");
    std::fs::File::create(&long).unwrap().set_len((16 << 20) + 1).unwrap();
    let long = long.to_str().unwrap();
    let too_long = "it is longer than 16777216 bytes, the maximum";
    for (file, why) in [("/dev/zero", "it is a device, but a file is needed"), (long, too_long)] {
        for command in [
            format!("check {file}"),
            format!("skin import {file} --tip hand"),
            format!("skin import {urdf} --tip hand --places {file}"),
        ] {
            let said = refusal(&command, 2);
            assert!(said.contains(&format!("{file}: {why}")), "{said}");
        }
    }
}
