//! `skinbus compare` as a process: recordings against themselves, their logs, changed and damaged ones, and refusals.
#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic, reason = "a test may stop")]

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use protocol::can::Format;
use protocol::candump::{self, CandumpLine, Record};
use protocol::packet::Packet;
use serde_json::Value;
use tempfile::TempDir;
use trace::capture::{Reader, SKIN_ATTACHMENT};

const NAMES: [&str; 5] = ["fd.mcap", "classic.mcap", "sums.mcap", "two.mcap", "split.mcap"];

fn recordings() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/recordings")
}

fn command(folder: &Path, arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split(' ')).current_dir(folder).env("NO_COLOR", "1");
    command.env_remove("COLUMNS").env("SKINBUS_DIR", "/nowhere/skinbus");
    command
}

fn gateway(folder: &Path, arguments: &str) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = command(folder, arguments).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// The one-line error of a command that ends with this code and prints nothing else.
fn refusal(folder: &Path, arguments: &str, code: i32) -> String {
    let (ended, text, said) = gateway(folder, arguments);
    assert_eq!((ended, text.as_str()), (Some(code), ""), "{arguments}: {said}");
    assert_eq!(said.matches('\n').count(), 1, "{arguments}: {said}");
    said.trim_end().strip_prefix("skinbus: ").unwrap().to_owned()
}

fn json(folder: &Path, arguments: &str) -> (Option<i32>, Value) {
    let (code, text, said) = gateway(folder, &format!("compare {arguments} --json"));
    (code, serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}{said}")))
}

/// A directory with the recordings, `fd.log`, and the skin of both, `fd.toml`.
fn folder() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for entry in fs::read_dir(recordings()).unwrap().map(Result::unwrap).filter(|it| it.path().is_file()) {
        fs::copy(entry.path(), folder.path().join(entry.file_name())).unwrap();
    }
    assert_eq!(gateway(folder.path(), "convert fd.mcap fd.log").0, Some(0));
    for name in ["fd", "sums", "two"] {
        let mut reader = Reader::open(&folder.path().join(format!("{name}.mcap"))).unwrap();
        reader.next().unwrap();
        let (_, skin) = reader.extras().attachments.iter().find(|(name, _)| name == SKIN_ATTACHMENT).unwrap();
        fs::write(folder.path().join(format!("{name}.toml")), skin).unwrap();
    }
    folder
}

/// Copies the frames of a log, changed or dropped by `change`.
fn edit(folder: &Path, (from, to): (&str, &str), mut change: impl FnMut(&mut Record<'_>) -> bool) {
    let mut edited = String::new();
    for line in fs::read_to_string(folder.join(from)).unwrap().lines() {
        let CandumpLine::Frame(mut record) = candump::parse(line).unwrap() else { continue };
        if change(&mut record) {
            candump::write_record(&mut edited, &record).unwrap();
            edited.push('\n');
        }
    }
    fs::write(folder.join(to), edited).unwrap();
}

/// Adds one step to the second word of a torque of the log.
fn torque_off_by_one(folder: &Path, to: &str, place: usize) {
    let mut torques = 0;
    edit(folder, ("fd.log", to), |record| {
        let id = record.frame.id();
        if (0x201..=0x2FE).contains(&id) {
            torques += 1;
            if torques == place {
                let mut packet = Packet::from_fd(&record.frame).unwrap();
                packet.words = packet.words.with_word(1, packet.words.as_slice()[1] + 1);
                record.frame = packet.frames(Format::Fd).next().unwrap();
            }
        }
        true
    });
    assert!(torques > place);
}

#[test]
fn a_recording_is_equal_to_itself_and_to_its_log() {
    let folder = folder();
    let folder = folder.path();
    for name in NAMES {
        let (code, text, said) = gateway(folder, &format!("compare {name} {name}"));
        assert_eq!((code, said.as_str()), (Some(0), ""), "{name}: {text}");
        assert!(text.starts_with("equal: "), "{text}");
    }
    for pair in
        ["fd.mcap fd.log", "fd.log fd.log --skin fd.toml", "classic.mcap classic.log", "sums.log sums.mcap"]
    {
        let (code, object) = json(folder, pair);
        assert_eq!(
            (code, &object["equal"], &object["first"]),
            (Some(0), &Value::Bool(true), &Value::Null),
            "{object}"
        );
        assert!(object["epochs"]["compared"].as_u64().unwrap() > 60, "{object}");
        let replies = &object[if pair.starts_with("sums") { "sums" } else { "torques" }];
        assert!(replies["equal"].as_u64().unwrap() > 10, "{pair}: {object}");
    }
    // Both buses, one of them classic.
    let (_, object) = json(folder, "two.mcap two.mcap");
    assert_eq!(object["captures"]["a"]["restarts"], 1, "{object}");
}

#[test]
fn a_word_that_is_one_step_off_is_found_with_its_epoch_cell_and_joint() {
    let folder = folder();
    let folder = folder.path();
    torque_off_by_one(folder, "off.log", 30);
    let (code, text, said) = gateway(folder, "compare fd.mcap off.log");
    assert_eq!((code, said.as_str()), (Some(1), ""), "{text}");
    let (_, object) = json(folder, "fd.mcap off.log");
    let first = &object["first"];
    assert_eq!(object["differs"], serde_json::json!(["torques"]));
    assert_eq!(
        (&object["torques"]["different"], &first["joint"], &first["steps"]),
        (&1.into(), &2.into(), &1.into())
    );
    assert_eq!(first["words"]["b"].as_i64().unwrap() - first["words"]["a"].as_i64().unwrap(), 1);
    let times = ["a", "b"].map(|run| first["time_s"][run].as_f64().unwrap());
    assert!((times[0] - times[1]).abs() < 1e-3, "{first}");
    let (epoch, cell) = (&first["epoch"], &first["cell"]);
    assert!(text.starts_with(&format!("different: torques; first at epoch {epoch} (")), "{text}");
    assert!(text.contains("the difference is 1 step"), "{text}");
    // The commands that the output names work.
    let line = format!("skinbus explain off.log --epoch {epoch} --cell vcan0:{cell} --skin SKIN");
    assert!(text.contains(&line), "{text}");
    let explained = line.replace("SKIN", "fd.toml").replace("skinbus ", "");
    assert_eq!(gateway(folder, &explained).0, Some(0), "{explained}");
    for (options, code) in [("--tolerance 1", 0), ("--tolerance 0", 1)] {
        assert_eq!(gateway(folder, &format!("compare fd.mcap off.log {options}")).0, Some(code));
    }
    for line in text.lines().filter(|line| !line.contains("skinbus explain")) {
        assert!(line.chars().count() <= 80, "{line}");
    }
}

#[test]
fn parts_are_found_beside_the_first_one_and_a_later_one_is_aligned_by_its_joints() {
    let folder = folder();
    let folder = folder.path();
    let (code, object) = json(folder, "split.mcap split-2.mcap");
    assert_eq!((code, &object["a"]), (Some(0), &"split.mcap to split-2.mcap (3 parts)".into()), "{object}");
    let first = &object["captures"]["b"]["first"];
    assert_eq!((first, &object["epochs"]["before"]["only_a"]), (&96.into(), &96.into()), "{object}");
    assert_eq!(object["epochs"]["compared"], 54);
    // Standard input is read once.
    let file = fs::File::open(folder.join("split.mcap")).unwrap();
    let mut child = command(folder, "compare split-1.mcap - --json");
    let Output { status, stdout, .. } = child.stdin(Stdio::from(file)).output().unwrap();
    let object: Value = serde_json::from_slice(&stdout).unwrap();
    assert_eq!((status.code(), &object["epochs"]["compared"]), (Some(1), &0.into()), "{object}");
    // A part of another recording does not belong to this one.
    fs::copy(folder.join("fd.mcap"), folder.join("split-1.mcap")).unwrap();
    let (_, object) = json(folder, "split.mcap split.mcap");
    assert_eq!(object["a"], "split.mcap");
}

#[test]
fn standard_input_is_one_of_the_two() {
    let folder = folder();
    let folder = folder.path();
    let mut child =
        command(folder, "compare fd.mcap -").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(&fs::read(folder.join("fd.log")).unwrap()).unwrap();
    let Output { status, stdout, .. } = child.wait_with_output().unwrap();
    let text = String::from_utf8(stdout).unwrap();
    assert_eq!(status.code(), Some(0), "{text}");
    assert!(text.contains("B  standard input (candump log)"), "{text}");
    // A recording whose skin is known only after it has been read.
    let file = fs::File::open(folder.join("sums.mcap")).unwrap();
    let mut child = command(folder, "compare fd.log - --skin fd.toml");
    let Output { status, stderr, .. } = child.stdin(Stdio::from(file)).output().unwrap();
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(2), "{said}");
    assert!(said.contains("were recorded with different skins"), "{said}");
}

#[test]
fn two_skins_and_what_is_no_capture_are_refused_in_one_line() {
    let folder = folder();
    let folder = folder.path();
    for (name, bytes) in
        [("empty.log", &b""[..]), ("notes.txt", b"hello\n"), ("x.zip", b"PK\x03\x04abcdefgh")]
    {
        fs::write(folder.join(name), bytes).unwrap();
    }
    fs::write(folder.join("other.log"), "(1.000000) can7 123#11\n").unwrap();
    fs::write(folder.join("quiet.log"), "(1.000000) vcan0 123#11\n").unwrap();
    let skin = fs::read_to_string(folder.join("fd.toml")).unwrap();
    let moved = skin.replace("\nposition = [", "\nposition = [0.01, ").lines().fold(
        String::new(),
        |mut all, line| {
            let place = line.strip_prefix("position = [0.01, ").and_then(|rest| rest.split_once(", "));
            all += &place.map_or_else(|| line.to_owned(), |(_, rest)| format!("position = [0.01, {rest}"));
            all + "\n"
        },
    );
    fs::write(folder.join("moved.toml"), moved).unwrap();
    for (arguments, code, begin) in [
        (
            "fd.mcap sums.mcap",
            2,
            "fd.mcap and sums.mcap were recorded with different skins (cells: 3, in the other: 5)",
        ),
        ("fd.mcap fd.log --skin sums.toml", 2, "sums.toml and fd.mcap were recorded with different skins ("),
        ("fd.log fd.log --skin moved.toml", 2, "fd.log was recorded with another skin than "),
        ("fd.log fd.log", 2, "neither fd.log nor fd.log contains a skin: name the skin file with --skin"),
        ("fd.toml fd.log", 2, "fd.toml is a skin or a scenario, not a candump log or MCAP recording: "),
        (
            "fd.mcap other.log",
            2,
            "other.log: the skin has none of the capture's buses (can7), only vcan0: name the skin of this capture",
        ),
        ("fd.mcap quiet.log", 1, "quiet.log: the capture contains no joints message on vcan0"),
        ("fd.mcap empty.log", 1, "empty.log: the file is empty"),
        ("empty.log fd.mcap", 1, "empty.log: the file is empty"),
        ("fd.mcap notes.txt", 1, "notes.txt: no frame in 1 line"),
        ("fd.mcap x.zip", 2, "x.zip is "),
        ("fd.mcap nowhere.mcap", 2, "nowhere.mcap: "),
        ("fd.mcap .", 2, ". is a directory: "),
        ("- -", 2, "both inputs are - (standard input), which can be read only once"),
        (
            "fd.mcap fd.mcap --junit fd.mcap --overwrite",
            2,
            "--junit fd.mcap is also an input of this command",
        ),
    ] {
        let said = refusal(folder, &format!("compare {arguments}"), code);
        assert!(said.starts_with(begin), "{arguments}: {said}");
    }
}

#[test]
fn what_was_cut_off_lacks_the_rest_and_damage_ends_with_1() {
    let folder = folder();
    let folder = folder.path();
    let object = fs::read(folder.join("fd.mcap")).unwrap();
    fs::write(folder.join("cut.mcap"), &object[..object.len() / 2]).unwrap();
    let (code, text, said) = gateway(folder, "compare fd.mcap cut.mcap");
    assert_eq!((code, said.lines().count()), (Some(1), 1), "{said}{text}");
    assert!(
        said.starts_with("cut.mcap: ") && text.starts_with("different: epochs; first at epoch "),
        "{said}{text}"
    );
    // Compared with itself it is equal, and reported as truncated.
    let (code, text, said) = gateway(folder, "compare cut.mcap cut.mcap");
    assert_eq!((code, said.lines().count()), (Some(0), 2), "{said}{text}");
    let mut damaged = object;
    let middle = damaged.len() / 2;
    damaged[middle..middle + 64].fill(0xA5);
    fs::write(folder.join("damaged.mcap"), damaged).unwrap();
    let (code, _, said) = gateway(folder, "compare fd.mcap damaged.mcap");
    assert_eq!(code, Some(1));
    assert!(said.contains("damaged.mcap"), "{said}");
    // A log that ends in the middle of a line.
    let log = fs::read_to_string(folder.join("fd.log")).unwrap();
    fs::write(folder.join("cut.log"), &log[..log.len() / 2]).unwrap();
    let (_, text, said) = gateway(folder, "compare fd.mcap cut.log");
    assert!(text.contains("after the other"), "{said}{text}");
}

#[test]
fn a_report_for_servers_has_a_case_for_each_aspect_and_replaces_no_file_unasked() {
    let folder = folder();
    let folder = folder.path();
    torque_off_by_one(folder, "off.log", 30);
    assert_eq!(gateway(folder, "compare fd.mcap off.log --junit out.xml").0, Some(1));
    let xml = fs::read_to_string(folder.join("out.xml")).unwrap();
    assert!(
        xml.contains("<testsuite name=\"fd.mcap and off.log\" tests=\"7\" failures=\"1\" skipped=\"0\""),
        "{xml}"
    );
    assert!(xml.contains("name=\"torques\"><failure message=\""), "{xml}");
    assert!(xml.contains("first difference: torque of cell "), "{xml}");
    let said = refusal(folder, "compare fd.mcap fd.log --junit out.xml", 2);
    assert!(said.starts_with("--junit out.xml: the file exists"), "{said}");
    assert_eq!(gateway(folder, "compare fd.mcap fd.log --junit out.xml --overwrite").0, Some(0));
    let xml = fs::read_to_string(folder.join("out.xml")).unwrap();
    assert!(xml.contains("failures=\"0\""), "{xml}");
}

#[test]
fn lost_replies_are_counted_by_cell_and_may_be_allowed() {
    let folder = folder();
    let folder = folder.path();
    let mut torques = 0;
    edit(folder, ("fd.log", "lost.log"), |record| {
        let is_torque = (0x201..=0x2FE).contains(&record.frame.id());
        torques += usize::from(is_torque);
        !is_torque || torques != 20 && torques != 30
    });
    let (code, object) = json(folder, "lost.log fd.mcap");
    assert_eq!((code, &object["torques"]["missing_in_a"]), (Some(1), &2.into()), "{object}");
    assert!(object["captures"]["a"]["lost"].as_u64().unwrap() >= 2, "{object}");
    assert!(!object["cells"].as_array().unwrap().is_empty());
    assert_eq!(json(folder, "lost.log fd.mcap --allow-missing 2").0, Some(0));
    assert_eq!(json(folder, "lost.log fd.mcap --allow-missing 1").0, Some(1));
}
