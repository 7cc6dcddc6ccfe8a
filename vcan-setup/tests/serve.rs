//! `vcan-setup serve` as a process.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use protocol::bus::{Bus, BusError, BusKind, Choice, Inbox, Options};
use protocol::can::Frame;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// A server that has said that it is ready.
fn serve(directory: &Path, arguments: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_vcan-setup"));
    command.args(["serve", "vcan0"]).args(arguments).env("SKINBUS_DIR", directory);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    assert_eq!(
        first_line(&mut child),
        format!("serving vcan0 at {}\n", directory.join("vcan0.bus").display())
    );
    child
}

fn first_line(child: &mut Child) -> String {
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    line
}

fn signal(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).unwrap();
}

fn ended(mut child: Child, parent: &TempDir) -> ExitStatus {
    let status = child.wait().unwrap();
    assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 0, "nothing is left behind");
    status
}

#[test]
fn frames_pass_once_the_line_is_printed_and_a_signal_ends_it_well() {
    for end in [Signal::TERM, Signal::INT] {
        let parent = TempDir::new().unwrap();
        let directory = parent.path().join("skinbus");
        let child = serve(&directory, &[]);
        let options = Options { directory: Some(directory), ..Options::default() };
        let [a, b] = [(); 2].map(|()| Bus::open("vcan0", Choice::Only(BusKind::Embedded), &options).unwrap());
        let frame = Frame::fd(0x123, 1, &[1; 16]).unwrap();
        a.send(&[frame]).unwrap();
        let mut inbox = Inbox::new();
        assert!(b.wait(Some(Duration::from_secs(5))).unwrap());
        assert_eq!(b.receive(&mut inbox).unwrap(), 1);
        assert_eq!(inbox.frames().next().unwrap().frame, frame);
        signal(&child, end);
        assert_eq!(ended(child, &parent).code(), Some(0));
    }
}

#[test]
fn the_end_of_standard_input_ends_it_only_when_asked_to() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let mut child = serve(&directory, &["--until-eof"]);
    drop(child.stdin.take());
    assert_eq!(ended(child, &parent).code(), Some(0));

    let mut child = serve(&directory, &[]);
    drop(child.stdin.take());
    std::thread::sleep(Duration::from_millis(50));
    assert_eq!(child.try_wait().unwrap(), None);
    signal(&child, Signal::TERM);
    assert_eq!(ended(child, &parent).code(), Some(0));
}

#[test]
fn a_parent_that_is_killed_takes_it_along_even_while_standard_input_stays_open() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    // The shell's standard input is this test's pipe, which stays open.
    let script =
        format!("exec 3<&0; '{}' serve vcan0 --until-eof <&3 & wait", env!("CARGO_BIN_EXE_vcan-setup"));
    let mut shell = Command::new("sh")
        .args(["-c", &script])
        .env("SKINBUS_DIR", &directory)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut output = BufReader::new(shell.stdout.take().unwrap());
    let mut line = String::new();
    output.read_line(&mut line).unwrap();
    assert!(line.starts_with("serving vcan0 at "), "{line}");
    let input = shell.stdin.take();
    shell.kill().unwrap();
    shell.wait().unwrap();
    // The server has the other end of the output: when that closes, it has ended.
    output.read_to_string(&mut line).unwrap();
    assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 0);
    drop(input);
}

#[test]
fn while_the_server_is_stopped_a_sender_waits_and_then_says_how_many_went_out() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let child = serve(&directory, &[]);
    let send_timeout = Duration::from_millis(50);
    let options = Options { directory: Some(directory), send_timeout, ..Options::default() };
    let [a, b] = [(); 2].map(|()| Bus::open("vcan0", Choice::Only(BusKind::Embedded), &options).unwrap());
    let frames: Vec<_> = (0..5000_u32).map(|n| Frame::classic(1, &n.to_le_bytes()).unwrap()).collect();

    signal(&child, Signal::STOP);
    let before = Instant::now();
    let error = a.send(&frames).unwrap_err();
    assert!(before.elapsed() >= send_timeout);
    assert!(matches!(error.cause, BusError::Full { .. }) && error.cause.may_pass(), "{error}");
    let sent = &frames[..error.sent];
    assert!(sent.len() >= 253, "{error}");

    signal(&child, Signal::CONT);
    let (mut inbox, mut heard) = (Inbox::new(), Vec::new());
    while heard.len() < sent.len() {
        assert!(b.wait(Some(Duration::from_secs(5))).unwrap(), "{} of {} heard", heard.len(), sent.len());
        b.receive(&mut inbox).unwrap();
        heard.extend(inbox.frames().map(|received| received.frame));
    }
    assert_eq!(heard, sent);
    a.send(&frames[..1]).unwrap();
    signal(&child, Signal::TERM);
    ended(child, &parent);
}

#[test]
fn after_a_kill_the_name_can_be_served_again() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let mut child = serve(&directory, &[]);
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(directory.join("vcan0.bus").exists(), "a killed server leaves its socket");
    let child = serve(&directory, &[]);
    signal(&child, Signal::TERM);
    ended(child, &parent);
}

#[test]
fn wrong_use_is_2_and_failure_is_1_each_in_one_line() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let run = |name| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_vcan-setup"));
        let output = command.args(["serve", name]).env("SKINBUS_DIR", &directory).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, said) = run("much-too-long-a-name");
    assert_eq!(code, Some(2));
    assert!(said.contains("\"much-too-long-a-name\" is no bus name: 1 to 15 bytes"), "{said}");

    let child = serve(&directory, &[]);
    let (code, said) = run("vcan0");
    assert_eq!((code, said.lines().count()), (Some(1), 1), "{said}");
    assert!(said.starts_with("vcan-setup: the embedded bus vcan0 is already served at "), "{said}");
    signal(&child, Signal::TERM);
    ended(child, &parent);
}
