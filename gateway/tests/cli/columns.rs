//! `skinbus convert RUN.mcap RUN.columns`: compared with the CSV file, and what is refused.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Output, Stdio};
use std::thread;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

use super::recorded::{folder, skinbus};

/// Length of the header of a column.
const HEADER_BYTES: usize = 128;

/// The last line of a command that ends with this code.
fn said(folder: &TempDir, arguments: &str, code: i32) -> String {
    let Output { status, stderr, .. } = skinbus(folder.path(), arguments);
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(code), "{arguments}: {said}");
    said.trim_end().lines().last().unwrap_or_default().to_owned()
}

/// The bytes of a column's rows, of which each element has `N` bytes.
fn column<const N: usize>(folder: &TempDir, name: &str) -> Vec<[u8; N]> {
    let bytes = fs::read(folder.path().join(name)).unwrap();
    assert!(bytes.starts_with(b"\x93NUMPY\x01\x00") && bytes[HEADER_BYTES - 1] == b'\n', "{name}");
    bytes[HEADER_BYTES..].chunks_exact(N).map(|chunk| chunk.try_into().unwrap()).collect()
}

fn numbers(folder: &TempDir, name: &str) -> Vec<f64> {
    column(folder, name).into_iter().map(f64::from_le_bytes).collect()
}

fn integers(folder: &TempDir, name: &str) -> Vec<i64> {
    column(folder, name).into_iter().map(i64::from_le_bytes).collect()
}

fn description(folder: &TempDir, name: &str) -> Value {
    let text = fs::read_to_string(folder.path().join(name).join("columns.json")).unwrap();
    assert!(text.starts_with("{\n  \"skinbus_columns\": 2,\n"), "{text}");
    serde_json::from_str(&text).unwrap()
}

/// Compares a folder of columns with a CSV file of the same capture. Returns the number of epochs.
fn compared(folder: &TempDir, columns: &str, csv: &str) -> usize {
    let mut reader = csv::Reader::from_path(folder.path().join(csv)).unwrap();
    let rows: Vec<BTreeMap<String, String>> = reader.deserialize().map(|row| row.unwrap()).collect();
    let joints = description(folder, columns)["joints"].as_array().unwrap().clone();
    for (table, unit) in [
        ("positions", "position_unit"),
        ("distributed", "torque_unit"),
        ("central", "torque_unit"),
        ("error", "torque_unit"),
    ] {
        let values = numbers(folder, &format!("{columns}/epochs.{table}.npy"));
        assert_eq!(values.len(), rows.len() * joints.len(), "{columns}: {table}");
        for (row, values) in rows.iter().zip(values.chunks(joints.len())) {
            for (joint, value) in joints.iter().zip(values) {
                let (name, unit) = (joint["name"].as_str().unwrap(), joint[unit].as_str().unwrap());
                let text = &row[&format!(
                    "{}_{name}_{unit}",
                    table.trim_end_matches("ions").replace("posit", "position")
                )];
                let same = match text.as_str() {
                    "" => value.is_nan(),
                    text => text.parse::<f64>().unwrap().to_bits() == value.to_bits(),
                };
                assert!(same, "{columns}, {table}, {name}: {text} in the CSV file, {value} here");
            }
        }
    }
    let at = integers(folder, &format!("{columns}/epochs.at_ns.npy"));
    let began = description(folder, columns)["began_ns"].as_i64().unwrap();
    for (row, at) in rows.iter().zip(at) {
        let seconds = trace::capture::seconds_since(began.cast_unsigned(), at.cast_unsigned());
        assert_eq!(row["time_s"], format!("{seconds:.9}"));
    }
    rows.len()
}

#[test]
fn epochs_have_the_values_of_the_csv_file() {
    let parts = "split.mcap split-1.mcap split-2.mcap";
    let folder = folder(&[
        "fd.mcap",
        "classic.mcap",
        "classic.log",
        "two.mcap",
        "sums.mcap",
        "split.mcap",
        "split-1.mcap",
        "split-2.mcap",
    ]);
    for (capture, skin, epochs) in [
        ("fd.mcap", "", 100),
        ("classic.mcap", "", 100),
        ("classic.log", " --skin classic.toml", 100),
        ("two.mcap", "", 100),
        ("sums.mcap", "", 100),
        (parts, "", 150),
        ("split-2.mcap split.mcap split-1.mcap", "", 150),
    ] {
        said(&folder, &format!("convert {capture} out.csv --overwrite{skin}"), 0);
        let last = said(&folder, &format!("convert {capture} out.columns --overwrite{skin}"), 0);
        assert!(last.ends_with(&format!(" frames, {epochs} epochs")), "{last}");
        assert_eq!(compared(&folder, "out.columns", "out.csv"), epochs, "{capture}");
    }
    let names: Vec<_> =
        fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert!(!names.iter().any(|name| name.to_string_lossy().ends_with(".part")), "{names:?}");
}

#[test]
fn torques_are_sorted_by_cell_and_belong_to_their_joints() {
    let folder = folder(&["two.mcap"]);
    said(&folder, "convert two.mcap two.columns", 0);
    let about = description(&folder, "two.columns");
    let groups = |table: &str| about["tables"][table]["groups"].as_array().unwrap().clone();
    let begin_of_bus: BTreeMap<_, _> = groups("joints")
        .iter()
        .map(|group| (group["bus"].as_u64(), group["begin"].as_i64().unwrap()))
        .collect();
    let at = integers(&folder, "two.columns/torques.at_ns.npy");
    let rows = integers(&folder, "two.columns/torques.joints_row.npy");
    let epochs = column::<1>(&folder, "two.columns/torques.epoch.npy");
    let joints_at = integers(&folder, "two.columns/joints.at_ns.npy");
    let joints_epoch = column::<1>(&folder, "two.columns/joints.epoch.npy");
    let mut counted = 0;
    for group in groups("torques") {
        let range = ["begin", "end"].map(|key| usize::try_from(group[key].as_u64().unwrap()).unwrap());
        assert!(range[0] < range[1]);
        assert!(at[range[0]..range[1]].is_sorted());
        for torque in range[0]..range[1] {
            if rows[torque] >= 0 {
                let joints = usize::try_from(begin_of_bus[&group["bus"].as_u64()] + rows[torque]).unwrap();
                assert_eq!(joints_epoch[joints], epochs[torque]);
                assert!(joints_at[joints] <= at[torque]);
                counted += 1;
            }
        }
    }
    assert_eq!(counted, 328, "172 on one bus and 156 on the other");
    let frames = about["accounts"]["frames"].as_u64().unwrap();
    assert_eq!(column::<4>(&folder, "two.columns/frames.id.npy").len() as u64, frames);
    assert_eq!(integers(&folder, "two.columns/frames.data_offsets.npy").len() as u64, frames + 1);
}

#[test]
fn what_has_no_columns_is_refused_in_one_line_and_nothing_is_written() {
    let folder = folder(&["fd.mcap", "classic.log"]);
    let place = folder.path();
    fs::write(place.join("foreign.log"), "(1.000001) can7 123#11\n").unwrap();
    fs::write(place.join("empty.log"), "").unwrap();
    fs::create_dir(place.join("mine.columns")).unwrap();
    fs::write(place.join("mine.columns/thesis.txt"), "mine").unwrap();
    said(&folder, "convert fd.mcap here.columns", 0);
    fs::create_dir(place.join("sealed")).unwrap();
    fs::set_permissions(place.join("sealed"), fs::Permissions::from_mode(0o500)).unwrap();
    let before = fs::read_dir(place).unwrap().count();
    for (arguments, code, line) in [
        ("classic.log out.columns", 2, "skinbus: classic.log contains no skin: name one with --skin"),
        ("empty.log out.columns --skin fd.toml", 1, "skinbus: empty.log: the file is empty"),
        (
            "foreign.log out.columns --skin fd.toml",
            1,
            "skinbus: foreign.log: the skin has none of the capture's buses (can7), only vcan0: name the skin of \
             this capture",
        ),
        (
            "fd.mcap out.columns --plain",
            2,
            "skinbus: --plain is only for a candump log, but out.columns is a folder of columns: leave it out",
        ),
        (
            "fd.mcap here.columns",
            2,
            "skinbus: here.columns: the file exists: name another file, or add --overwrite",
        ),
        (
            "fd.mcap mine.columns --overwrite",
            2,
            "skinbus: mine.columns: the folder contains other files: name another folder",
        ),
        (
            "fd.mcap none/out.columns",
            2,
            "skinbus: none/out.columns: No such file or directory (os error 2); name a file in a folder that can be \
             written",
        ),
    ] {
        assert_eq!(said(&folder, &format!("convert {arguments}"), code), line);
    }
    // Root may write everywhere.
    if !rustix::process::geteuid().is_root() {
        let line = said(&folder, "convert fd.mcap sealed/out.columns", 2);
        assert!(line.ends_with("name a file in a folder that can be written"), "{line}");
    }
    let bytes = fs::read(place.join("fd.mcap")).unwrap();
    let mut damaged = bytes.clone();
    let middle = damaged.len() / 2;
    damaged[middle..middle + 64].fill(0x55);
    fs::write(place.join("damaged.mcap"), damaged).unwrap();
    let line = said(&folder, "convert damaged.mcap out.columns --skin fd.toml", 1);
    assert!(line.contains("damaged.mcap is damaged"), "{line}");
    assert_eq!(fs::read_dir(place).unwrap().count(), before + 1, "nothing was written");
    assert_eq!(fs::read_to_string(place.join("mine.columns/thesis.txt")).unwrap(), "mine");
    // A recording without its end gives its intact part.
    fs::write(place.join("begun.mcap.part"), &bytes[..middle]).unwrap();
    let line = said(&folder, "convert begun.mcap.part out.columns --strict --skin fd.toml", 1);
    assert!(line.contains("its end is missing") && !place.join("out.columns").exists(), "{line}");
    said(&folder, "convert begun.mcap.part out.columns --skin fd.toml", 0);
    assert!(description(&folder, "out.columns")["unfinished"].is_string());
}

#[test]
fn an_interrupted_conversion_leaves_nothing_and_a_pipe_may_end_at_any_time() {
    let folder = folder(&["classic.mcap", "classic.log"]);
    let log = fs::read(folder.path().join("classic.log")).unwrap();
    fs::write(folder.path().join("long.log"), log.repeat(400)).unwrap();
    let convert = |capture: &str, stdin: Stdio| {
        // A shell starts background processes with SIGINT ignored, and children inherit that.
        let mut command = Command::new("env");
        command.args(["--default-signal=INT", env!("CARGO_BIN_EXE_skinbus"), "convert", capture]);
        command.args(["out.columns", "--skin", "classic.toml"]).current_dir(folder.path());
        command.stdin(stdin).stderr(Stdio::piped()).spawn().unwrap()
    };
    let left = || {
        let names = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name());
        names.filter(|name| name.to_string_lossy().contains("columns")).count()
    };
    let child = convert("long.log", Stdio::null());
    while left() == 0 {
        thread::sleep(Duration::from_millis(1));
    }
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.ends_with(" frames: out.columns is not written\n"), "{said}");
    assert_eq!(left(), 0);
    let mut child = convert("-", Stdio::piped());
    child.stdin.take().unwrap().write_all(&log).unwrap();
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    assert!(status.success(), "{}", String::from_utf8_lossy(&stderr));
    assert_eq!(description(&folder, "out.columns")["tables"]["epochs"]["rows"], 100);
}

#[test]
fn frames_of_a_bus_that_the_skin_does_not_have_are_kept() {
    let folder = folder(&["classic.mcap", "classic.log"]);
    let mut log = fs::read_to_string(folder.path().join("classic.log")).unwrap();
    log.push_str("(1900000000.000001) can7 123#1122\n(1900000000.000002) can7 12345678#R2\n");
    fs::write(folder.path().join("more.log"), log).unwrap();
    said(&folder, "convert more.log more.columns --skin classic.toml", 0);
    let about = description(&folder, "more.columns");
    let last = about["buses"].as_array().unwrap().last().unwrap();
    assert_eq!((last["name"].as_str(), last["is_in_skin"].as_bool()), (Some("can7"), Some(false)));
    let flags = column::<1>(&folder, "more.columns/frames.flags.npy");
    assert_eq!(flags[flags.len() - 2..], [[0], [3]], "extended, remote");
    let offsets = integers(&folder, "more.columns/frames.data_offsets.npy");
    let ends: Vec<_> = offsets[offsets.len() - 3..].windows(2).map(|pair| pair[1] - pair[0]).collect();
    assert_eq!(ends, [2, 0]);
}
