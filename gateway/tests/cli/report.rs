//! `skinbus report` as a process: its errors for files that are no recording of a run, and the files on the disk afterwards.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use tempfile::TempDir;

const LOG: &str = "(1.000001) vcan0 123#11\n(2.000000) vcan0 22C##5AABB\n";

fn gateway(folder: &Path, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split(' ')).current_dir(folder).output().unwrap()
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// The one line that a report refuses with; nothing is written.
fn refuses(folder: &TempDir, arguments: &str, code: i32) -> String {
    let before = names(folder.path());
    let Output { status, stdout, stderr } = gateway(folder.path(), &format!("report {arguments}"));
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!(
        (status.code(), stdout.len(), said.matches('\n').count()),
        (Some(code), 0, 1),
        "{arguments}: {said}"
    );
    assert_eq!(names(folder.path()), before, "{arguments}");
    said.trim_end().strip_prefix("skinbus: ").unwrap().to_owned()
}

#[test]
fn what_is_no_recording_of_a_run_is_refused_in_one_line_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| fs::write(folder.path().join(name), bytes).unwrap();
    write("empty.mcap", b"");
    write("run.log", LOG.as_bytes());
    write("begun.mcap", b"\x89MCAP0\r\n");
    write("picture.mcap", b"PK\x03\x04 and more");
    assert!(gateway(folder.path(), "convert run.log foreign.mcap").status.success());
    let made = "`skinbus run SKIN --record run.mcap` makes what a report needs";
    assert_eq!(refuses(&folder, "empty.mcap", 2), format!("empty.mcap holds no run: it is empty; {made}"));
    assert_eq!(
        refuses(&folder, "foreign.mcap", 2),
        format!("foreign.mcap holds no run: skin.toml is not attached to it; {made}")
    );
    let begun = refuses(&folder, "begun.mcap", 1);
    assert!(
        begun.starts_with(
            "begun.mcap holds no run that can be shown: skin.toml is not attached to it (it has no end"
        ),
        "{begun}"
    );
    assert_eq!(
        refuses(&folder, "run.log", 2),
        format!("run.log is no MCAP recording, and frames alone are not enough: {made}")
    );
    assert!(refuses(&folder, "picture.mcap", 2).contains("is a zip archive"));
    let mut damaged = fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/recordings/fd.mcap")).unwrap();
    let skin = damaged.windows(9).position(|bytes| bytes == b"skin.toml").unwrap();
    damaged[skin + 200] ^= 0xFF;
    write("damaged.mcap", &damaged);
    let said = refuses(&folder, "damaged.mcap", 1);
    assert!(said.starts_with("damaged.mcap is damaged: the checksum of an attachment"), "{said}");
    assert!(refuses(&folder, "nowhere.mcap", 2).starts_with("nowhere.mcap: "));
    assert!(refuses(&folder, ". -o out.html", 2).starts_with(".: "));
}

#[test]
fn what_would_be_overwritten_or_is_no_bit_rate_is_refused_before_anything_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let recording = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/recordings/fd.mcap");
    fs::copy(recording, folder.path().join("run.mcap")).unwrap();
    fs::write(folder.path().join("run.html"), "mine").unwrap();
    let exists = "-o run.html: it exists: name another file, or overwrite it with --overwrite";
    assert_eq!(refuses(&folder, "run.mcap", 2), exists);
    let itself = refuses(&folder, "run.mcap -o run.mcap --overwrite", 2);
    assert_eq!(itself, "-o run.mcap is a file that this command reads: name another file");
    let rate = refuses(&folder, "run.mcap -o new.html --nominal fast", 2);
    assert!(rate.contains("--nominal") && rate.contains("not a bit rate"), "{rate}");
    assert_eq!(fs::read_to_string(folder.path().join("run.html")).unwrap(), "mine");
}
