//! Completions and man pages, as used by a shell and `man`; former names; standard output in place of a file.

#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn skinbus(folder: &Path, line: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(line.split(' ')).current_dir(folder).env("SKINBUS_DIR", "/nowhere/skinbus");
    command.output().unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

#[test]
fn bash_completes_commands_and_options() {
    let complete = |words: &str| {
        let script = format!(
            "source <(\"$0\" completions bash) && COMP_WORDS=({words}) && COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)) && \
             _skinbus skinbus \"${{COMP_WORDS[COMP_CWORD]}}\" skinbus && printf '%s\\n' \"${{COMPREPLY[@]}}\""
        );
        let ran = Command::new("bash").args(["-c", &script, env!("CARGO_BIN_EXE_skinbus")]).output().unwrap();
        assert!(ran.status.success(), "{words}: {}", text(&ran.stderr));
        text(&ran.stdout).split_whitespace().map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(complete("skinbus du"), ["dump"]);
    assert_eq!(complete("skinbus frame sti"), ["stimulus"]);
    assert_eq!(complete("skinbus run --rec"), ["--record", "--record-split"]);
    // Former names are not offered.
    assert_eq!(complete("skinbus sha"), [""; 0]);
}

#[test]
fn every_command_has_a_man_page_without_former_names() {
    let folder = tempfile::tempdir().unwrap();
    let made = skinbus(folder.path(), "man .");
    assert!(made.status.success(), "{}", text(&made.stderr));
    let mut names: Vec<_> = fs::read_dir(folder.path())
        .unwrap()
        .map(|it| it.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    for name in ["skinbus.1", "skinbus-dump.1", "skinbus-frame-stimulus.1", "skinbus-skin-import.1"] {
        assert!(names.iter().any(|it| it == name), "{name}: {names:?}");
    }
    let dump = fs::read_to_string(folder.path().join("skinbus-dump.1")).unwrap();
    assert!(dump.contains(".SH OPTIONS") && dump.contains("skinbus dump run.mcap"), "{dump}");
    let all: String = names.iter().map(|it| fs::read_to_string(folder.path().join(it)).unwrap()).collect();
    for former in ["cell\\-node\\fR \\fI", "\\-\\-max", "skinbus shadow", "skinbus ack", "skinbus dbc"] {
        assert!(!all.contains(former), "{former}");
    }
    let again = skinbus(folder.path(), "man .");
    assert_eq!(again.status.code(), Some(2));
    assert!(text(&again.stderr).contains("the file exists: name another file, or add --overwrite"));
}

#[test]
fn former_names_are_refused_in_a_line_that_names_the_present_ones() {
    let folder = tempfile::tempdir().unwrap();
    for (line, now) in [
        (
            "ack vcan0",
            "there is no command ack; use skinbus frame resume --bus BUS, or --skin SKIN for all of its buses",
        ),
        ("sensing vcan0 event", "there is no command sensing; use skinbus frame sensing MODE --bus BUS"),
        (
            "scenario check x.toml --skin s.toml",
            "there is no command scenario; use skinbus check SCENARIO --skin SKIN",
        ),
        ("skin check x.toml", "there is no command skin check; use skinbus check SKIN"),
        (
            "torque s.toml --cell 1",
            "there is no command torque; use skinbus explain SKIN --cell NODE --force N --joints POSITIONS",
        ),
        ("dbc s.toml", "there is no command dbc; use skinbus skin dbc SKIN"),
        ("shadow run.log", "there is no command shadow; use skinbus fit FILE, or buses"),
        ("run s.toml --force", "there is no option --force in run; use --overwrite"),
        (
            "run s.toml --cell-node x",
            "there is no option --cell-node in run; use the environment variable SKINBUS_CELL_NODE",
        ),
        ("dump vcan0 --max 3", "there is no option --max in dump; use -n, --count"),
        ("dump vcan0 --node 3", "there is no option --node in dump; use --cell"),
        ("frame stimulus --node 3", "there is no option --node in frame; use --cell"),
        ("replay x.log --max", "there is no option --max in replay; use --speed max"),
        ("calibrate s.toml --from x.mcap", "there is no option --from in calibrate; use --recording"),
        ("skin import r.urdf --tip t --cells c.csv", "there is no option --cells in skin; use --places"),
        ("dmup x", "there is no command dmup; did you mean dump?"),
    ] {
        let refused = skinbus(folder.path(), line);
        assert_eq!(
            (refused.status.code(), text(&refused.stderr)),
            (Some(2), &*format!("skinbus: {now}\n")),
            "{line}"
        );
    }
}

/// Commands that write a file can write it to standard output, without other output there.
#[test]
fn a_dash_is_standard_output_and_standard_input() {
    let folder = tempfile::tempdir().unwrap();
    let (path, made) = (folder.path(), skinbus(folder.path(), "skin generate --cells 6 -o -"));
    assert!(text(&made.stdout).starts_with("# skinbus skin generate") && made.status.success(), "{made:?}");
    fs::write(path.join("skin.toml"), &made.stdout).unwrap();
    for (line, begins) in [
        ("skin dbc skin.toml -o -", "VERSION"),
        ("skin show skin.toml -o -", "<!doctype html>"),
        ("skin urdf skin.toml -o -", "<?xml"),
    ] {
        let shown = skinbus(path, line);
        assert!(
            shown.status.success() && text(&shown.stdout).starts_with(begins),
            "{line}: {}",
            text(&shown.stderr)
        );
    }
    let through = |line: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
        command
            .args(line.split(' '))
            .current_dir(path)
            .stdin(fs::File::open(path.join("skin.toml")).unwrap());
        command.output().unwrap()
    };
    for line in [
        "check -",
        "fit - --nominal 1M --data 5M --format fd",
        "explain - --cell 1 --force 1 --joints 0,0,0,0,0,0",
    ] {
        let shown = through(line);
        assert!(shown.status.success(), "{line}: {}", text(&shown.stderr));
        assert_eq!(text(&shown.stderr), "", "{line}");
    }
    let names: Vec<_> = fs::read_dir(path).unwrap().map(|it| it.unwrap().file_name()).collect();
    assert_eq!(names, ["skin.toml"]);
}
