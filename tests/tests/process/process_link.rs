//! `vcan-setup link`, with a substitute for the program that it runs; `tests/hosts` has the real one.
#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process::{Running, TestDir, program};

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use rustix::process::Signal;

/// Returns a command with only the folder of the place on `PATH`.
fn command(place: &TestDir, program: &Path, words: &str) -> Command {
    let mut command = place.command_of(program, words);
    command.env("PATH", place.path("")).env_remove("SKINBUS_VCAN_LINK");
    command
}

/// Copies `vcan-setup` beside the programs of a place.
fn copy(place: &TestDir) -> PathBuf {
    let path = place.path("vcan-setup");
    // A separate process copies it, for the reason given at [`Place::script`].
    assert!(Command::new("cp").arg(program("vcan-setup")).arg(&path).status().unwrap().success());
    path
}

#[test]
fn without_its_program_help_and_wrong_use_are_there_and_a_line_says_how_to_install_it() {
    let place = TestDir::new();
    let run = |words| Running::start(command(&place, &copy(&place), words)).end();
    let install = "cargo install --locked --path vcan-setup/link";
    let help = run("link --help").succeeded().stdout;
    for words in ["Usage: vcan-setup link ", "--connect <ENDPOINT>", "--listen tcp/192.168.1.7:7447", install]
    {
        assert!(help.contains(words), "{words}: {help}");
    }
    assert!(run("--help").succeeded().stdout.contains("\n  link "), "among the commands");
    let wrong = run("link vcan0 --conect tcp/a:1");
    assert!(wrong.refusal(2).contains("a similar argument exists: '--connect'"), "{wrong:#?}");
    let absent = run("link vcan0 --listen tcp/127.0.0.1:0");
    let says = "vcan-setup: vcan-link was found neither beside vcan-setup nor on PATH; to install it, run in the \
                project's folder: ";
    assert_eq!(absent.refusal(1), format!("{says}`{install}`"));
}

#[test]
fn its_program_takes_its_place_with_the_same_words_exit_code_and_signals() {
    let place = TestDir::new();
    place.script("vcan-link", "#!/bin/sh\nprintf '%s|' $$ \"$@\"\nexit 7\n");
    let words = ["vcan0", "--host", "a 'b' $c", "--config"].map(OsStr::new);
    let odd = OsStr::from_bytes(b"c\xff.json5");
    for beside in [true, false] {
        let path = if beside { copy(&place) } else { program("vcan-setup") };
        let mut link = command(&place, &path, "link");
        link.args(words).arg(odd);
        let link = Running::start(link);
        let pid = link.pid().as_raw_nonzero();
        let ended = link.end();
        let expected = format!("{pid}|vcan0|--host|a 'b' $c|--config|c\u{fffd}.json5|");
        assert_eq!((ended.code(), ended.stdout.as_str()), (Some(7), expected.as_str()), "{ended:#?}");
        assert_eq!(ended.stderr, "");
    }
    for (name, signal) in [("an odd place", Signal::TERM), ("interrupted", Signal::INT)] {
        // A shell that is interrupted before `exec` ends with an exit code. Tests in the background of a shell ignore SIGINT.
        place.write("ready", "ready\n");
        let script =
            place.script(name, "#!/bin/sh\nexec /usr/bin/env --default-signal /usr/bin/tail -f ready\n");
        let mut link = command(&place, &program("vcan-setup"), "link vcan0");
        let link = Running::start({
            link.env("SKINBUS_VCAN_LINK", script);
            link
        });
        link.wait_for_stdout("ready");
        link.signal(signal);
        assert_eq!(link.end().signal(), Some(signal.as_raw()));
    }
}

#[test]
fn a_program_that_cannot_be_run_is_named() {
    let place = TestDir::new();
    let named = |path: &str| {
        let mut link = command(&place, &program("vcan-setup"), "link vcan0");
        link.env("SKINBUS_VCAN_LINK", path);
        Running::start(link).end()
    };
    let file = place.write("vcan-link", "");
    let found = Running::start(command(&place, &copy(&place), "link vcan0")).end();
    let expected = format!("vcan-setup: cannot run {}: Permission denied (os error 13)", file.display());
    assert_eq!(found.refusal(1), expected);
    let expected = "vcan-setup: cannot run ./vcan-link: Permission denied (os error 13); correct SKINBUS_VCAN_LINK, which names it";
    assert_eq!(named("vcan-link").refusal(1), expected);
    let expected = "vcan-setup: cannot run '/no where': No such file or directory (os error 2); correct SKINBUS_VCAN_LINK, which names it";
    assert_eq!(named("/no where").refusal(1), expected);
}
