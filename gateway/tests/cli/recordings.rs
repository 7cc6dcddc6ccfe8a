//! Recordings of earlier builds are dumped and explained as expected (tests/recordings/README.md).
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::fs;
use std::path::PathBuf;
use std::process::{Command, Output};

use trace::capture::{Reader, SKIN_ATTACHMENT};

/// Directory of the recordings.
fn recordings() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/recordings")
}

/// Standard output of a command without messages.
fn output(arguments: &str) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split(' ')).current_dir(recordings()).env("NO_COLOR", "1").env("COLUMNS", "100");
    let Output { status, stdout, stderr } = command.output().unwrap();
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!((status.code(), said.as_str()), (Some(0), ""), "{arguments}");
    String::from_utf8(stdout).unwrap()
}

/// Compares line by line with `expected/NAME`, or replaces that file on request.
fn is_expected(name: &str, text: &str) {
    let path = recordings().join("expected").join(name);
    if std::env::var_os("SKINBUS_TAKE_OVER").is_some() {
        fs::write(path, text).unwrap();
        return;
    }
    let expected = fs::read_to_string(path).unwrap();
    for (number, (now, then)) in text.lines().zip(expected.lines()).enumerate() {
        assert_eq!(now, then, "line {} of {name}", number + 1);
    }
    assert_eq!(text.lines().count(), expected.lines().count(), "lines of {name}");
}

#[test]
fn dumps_are_unchanged() {
    for name in ["fd", "classic", "sums", "two", "split", "split-1", "split-2"] {
        is_expected(&format!("{name}.dump.txt"), &output(&format!("dump {name}.mcap --brief")));
    }
}

#[test]
fn a_log_gives_the_same_text_as_the_recording_of_the_same_run() {
    // The times of a log have six digits: ignore them.
    let without_times = |text: &str| -> Vec<String> {
        text.lines().map(|line| line.split_once(' ').unwrap().1.to_owned()).collect()
    };
    for name in ["classic", "sums"] {
        let expected = fs::read_to_string(recordings().join(format!("expected/{name}.dump.txt"))).unwrap();
        assert_eq!(
            without_times(&output(&format!("dump {name}.log --brief"))),
            without_times(&expected),
            "{name}"
        );
    }
}

#[test]
fn explanations_are_unchanged() {
    for (name, options) in [
        ("fd", "--epoch 60"),
        ("classic", "--epoch 60 --cell 1"),
        ("sums", "--epoch 60"),
        ("two", "--epoch 40"),
        ("split-1", "--epoch 80 --cell 2"),
    ] {
        is_expected(&format!("{name}.explain.txt"), &output(&format!("explain {name}.mcap {options}")));
    }
}

#[test]
fn another_skin_than_the_recorded_one_is_remarked() {
    let folder = tempfile::tempdir().unwrap();
    let said = |skin: &str, command: &str| {
        let path = folder.path().join("skin.toml");
        fs::write(&path, skin).unwrap();
        let mut gateway = Command::new(env!("CARGO_BIN_EXE_skinbus"));
        gateway.args(command.split(' ')).arg("--skin").arg(path).current_dir(recordings());
        String::from_utf8(gateway.output().unwrap().stderr).unwrap()
    };
    let mut reader = Reader::open(&recordings().join("fd.mcap")).unwrap();
    reader.next().unwrap();
    let attached = &reader.extras().attachments;
    let (_, own) = attached.iter().find(|(name, _)| name == SKIN_ATTACHMENT).unwrap();
    let own = String::from_utf8(own.clone()).unwrap();
    for command in ["dump fd.mcap --brief", "explain fd.mcap --epoch 9", "fit fd.mcap"] {
        let same = said(&own, command);
        assert!(!same.contains("differs from the skin recorded"), "{command}: {same}");
        let moved = own.replacen("position = [", "position = [0.001, ", 1);
        let start = moved.find("[0.001, ").unwrap() + 8;
        let end = start + moved.get(start..).unwrap().find(", ").unwrap() + 2;
        let moved = [moved.get(..start).unwrap(), moved.get(end..).unwrap()].concat();
        let parameters = said(&moved, command);
        assert!(parameters.contains("differs from the skin recorded in fd.mcap (parameters of cell 1 on vcan0: as described, recorded: different)"), "{command}: {parameters}");
        let without_wires = |line: &&str| !line.starts_with("neighbors") && !line.starts_with("root");
        let cells = own.rsplit_once("[[cell]]").unwrap().0.lines().filter(without_wires);
        let cells: String = cells.map(|line| format!("{line}\n")).collect();
        let fewer = said(&cells, command);
        assert!(
            fewer.contains("differs from the skin recorded in fd.mcap (cells: 2, recorded: 3)"),
            "{command}: {fewer}"
        );
    }
}
