//! One signal ends every command, even one that waits for reading from or writing to a pipe. Opening a named pipe does
//! not block.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::fmt::Write as _;
use std::fs;
use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// A time that only a hanging program needs.
const TIMEOUT: Duration = Duration::from_secs(60);

fn place() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    mknodat(CWD, path("fifo"), FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
    let skin = Command::new(env!("CARGO_BIN_EXE_skinbus"))
        .args(["skin", "generate", "--cells", "3"])
        .output()
        .unwrap();
    fs::write(path("skin.toml"), skin.stdout).unwrap();
    let lines = (0..40_000).fold(String::new(), |mut log, at| {
        writeln!(log, "({}.{:06}) vcan0 123#{:08X}", at / 1_000, at % 1_000, at).unwrap();
        log
    });
    fs::write(path("run.log"), lines).unwrap();
    folder
}

fn command(folder: &Path, line: &str) -> Command {
    // A shell starts background processes with SIGINT ignored, and children inherit that.
    let mut command = Command::new("env");
    command.args(["--default-signal=INT,TERM", env!("CARGO_BIN_EXE_skinbus")]).args(line.split(' '));
    command.current_dir(folder).env("SKINBUS_DIR", folder.join("bus")).stdin(Stdio::null());
    command
}

/// Waits until a program only waits.
fn until_it_waits(child: &mut Child, line: &str) {
    let (began, mut idle) = (Instant::now(), 0);
    while idle < 10 {
        assert!(began.elapsed() < TIMEOUT, "{line}: always busy");
        assert_eq!(child.try_wait().unwrap(), None, "{line}: it does not wait");
        let stat = fs::read_to_string(format!("/proc/{}/stat", child.id())).unwrap();
        let sleeps = stat.rsplit_once(')').unwrap().1.trim_start().starts_with('S');
        idle = if sleeps { idle + 1 } else { 0 };
        thread::sleep(Duration::from_millis(10));
    }
}

fn end(child: &mut Child, line: &str, signal: Signal) -> ExitStatus {
    kill_process(Pid::from_child(child), signal).unwrap();
    let began = Instant::now();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status;
        }
        if began.elapsed() > TIMEOUT {
            child.kill().unwrap();
            child.wait().unwrap();
            panic!("{line}: {signal:?} does not end it");
        }
        thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_named_pipe_is_refused_in_one_line() {
    let folder = place();
    let lines = [
        "dump fifo",
        "convert fifo out.mcap",
        "report fifo -o out.html",
        "fit fifo",
        "explain fifo --epoch 1 --skin skin.toml",
        "explain run.log --epoch 1 --skin fifo",
        "replay run.log --bus-kind embedded --spawn --skin fifo",
        "recover fifo -o out.mcap",
        "fit fifo",
        "skin dbc fifo",
        "check fifo",
        "cells vcan0 --skin fifo",
        "commission fifo",
        "run fifo",
        "run skin.toml --scenario fifo",
        "replay fifo --bus-kind embedded",
        "explain fifo --epoch 1",
        "explain skin.toml --batch fifo",
        "run skin.toml --firmware fifo --emulate 1",
        "skin import fifo --tip tool",
        "view fifo",
    ];
    for line in lines {
        let ended = command(folder.path(), line).output().unwrap();
        let said = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(2), "{line}: {said}");
        let names = said.contains("named pipe") || said.contains("not a regular file");
        assert!(names && said.contains("fifo"), "{line}: {said}");
        assert_eq!(said.lines().count(), 1, "{line}: {said}");
    }
}

#[test]
fn a_signal_ends_a_command_that_waits_for_a_pipe() {
    let folder = place();
    let lines = [
        "dump -",
        "dump /dev/stdin",
        "convert - out.mcap",
        "report /dev/stdin -o out.html",
        "fit - --skin skin.toml",
        "explain run.log --epoch 1 --skin /dev/stdin",
        "recover /dev/stdin -o out.mcap",
        "fit /dev/stdin",
        "check /dev/stdin",
        "run skin.toml --scenario /dev/stdin",
    ];
    for line in lines {
        for signal in [Signal::INT, Signal::TERM] {
            let (reader, _writer) = std::io::pipe().unwrap();
            let mut child = command(folder.path(), line).stdin(reader).stdout(Stdio::null()).spawn().unwrap();
            until_it_waits(&mut child, line);
            let status = end(&mut child, line, signal);
            assert!(
                status.signal() == Some(signal.as_raw()) || matches!(status.code(), Some(0..=2)),
                "{line}"
            );
        }
    }
}

#[test]
fn a_signal_ends_a_command_whose_reader_takes_nothing() {
    let folder = place();
    for line in ["dump run.log", "dump run.log --json", "convert run.log -", "fit run.log --json"] {
        for signal in [Signal::INT, Signal::TERM] {
            let (mut reader, writer) = std::io::pipe().unwrap();
            let mut child =
                command(folder.path(), line).stdout(writer).stderr(Stdio::null()).spawn().unwrap();
            until_it_waits(&mut child, line);
            let status = end(&mut child, line, signal);
            assert!(matches!(status.code(), Some(0..=2)), "{line}: {status:?}");
            let mut taken = Vec::new();
            reader.read_to_end(&mut taken).unwrap();
            assert!(taken.len() > 4_096, "{line}: it has written before");
        }
    }
}
