//! Captures that are larger than the memory of the converter: hundreds of megabytes through a pipe, in a process with a
//! limit of a hundred.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use skinbus_tests::process;

use std::fmt::Write as _;
use std::io::{Read, Write};
use std::process::{Child, Command, Output, Stdio};

use process::program;

/// Lines of the log, 53 bytes each: 212 MB.
const LINES: u64 = 4_000_000;
/// The number of lines that are generated and compared at once.
const LINES_AT_ONCE: u64 = 10_000;

/// Writes the lines from `first` on.
fn piece(text: &mut String, first: u64) {
    text.clear();
    for line in first..first + LINES_AT_ONCE {
        let word = line.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let (sec, micro) = (1_700_000_000 + line / 1_000_000, line % 1_000_000);
        writeln!(text, "({sec}.{micro:06}) vcan{} 20C##5{word:016X}FFFF", line % 2).unwrap();
    }
}

/// Returns the gateway's command with an address space of 100 MB, without the memory that allocators reserve for each
/// thread.
fn bounded(from: &str, to: &str) -> Command {
    let mut command = Command::new("sh");
    let gateway = program("skinbus");
    command.args(["-c", "ulimit -v 100000 && exec \"$0\" \"$@\""]).arg(gateway).args(["convert", from, to]);
    command
}

fn ends(child: Child) {
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&stderr);
    assert!(status.success() && said.contains(&format!(": {LINES} frames, 0 notes")), "{status}: {said}");
}

#[test]
fn a_capture_larger_than_memory_goes_there_and_back() {
    let folder = tempfile::tempdir().unwrap();
    let mcap = folder.path().join("run.mcap");
    let mcap = mcap.to_str().unwrap();
    let mut text = String::new();

    let mut into = bounded("-", mcap).stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut input = into.stdin.take().unwrap();
    for first in (0..LINES).step_by(usize::try_from(LINES_AT_ONCE).unwrap()) {
        piece(&mut text, first);
        input.write_all(text.as_bytes()).unwrap();
    }
    drop(input);
    ends(into);

    let mut out = bounded(mcap, "-").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut output = out.stdout.take().unwrap();
    let mut back = Vec::new();
    for first in (0..LINES).step_by(usize::try_from(LINES_AT_ONCE).unwrap()) {
        piece(&mut text, first);
        back.resize(text.len(), 0);
        output.read_exact(&mut back).unwrap();
        assert!(back == text.as_bytes(), "another line than {first} and those after it");
    }
    assert_eq!(output.read(&mut back).unwrap(), 0, "and nothing else");
    ends(out);
}
