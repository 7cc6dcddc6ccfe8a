//! `skinbus convert RUN.mcap torques.csv`: rows compared with `skinbus explain --json` of their epochs.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::float_cmp, reason = "0, and counts")]

use std::collections::BTreeMap;
use std::fs;
use std::process::Output;

use serde_json::Value;
use tempfile::TempDir;

use super::recorded::{folder, skinbus};

/// Number of rows from one compared row to the next.
const ROW_INTERVAL: usize = 9;

/// The one-line message of a command that ends with this code.
fn said(folder: &TempDir, arguments: &str, code: i32) -> String {
    let Output { status, stderr, .. } = skinbus(folder.path(), arguments);
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!((status.code(), said.matches('\n').count()), (Some(code), 1), "{arguments}: {said}");
    said.trim_end().to_owned()
}

type Row = BTreeMap<String, String>;

fn rows(folder: &TempDir, name: &str) -> Vec<Row> {
    let mut reader = csv::Reader::from_path(folder.path().join(name)).unwrap();
    reader.deserialize().map(|row| row.unwrap()).collect()
}

/// Returns true if two numbers are equal; serde_json may be off in the last digit.
fn same(one: f64, other: &Value) -> bool {
    let other = other.as_f64().unwrap();
    (one - other).abs() <= 4e-16 * other.abs()
}

/// Compares rows with `skinbus explain` for their epochs. Returns the number of torques other than 0.
fn compared(folder: &TempDir, rows: &[Row], capture: &str) -> usize {
    let (mut loaded, mut next) = (0, 0.0);
    for row in rows.iter().step_by(ROW_INTERVAL).chain(rows.last()) {
        let seconds: f64 = row["time_s"].parse().unwrap();
        assert!(seconds >= next, "in order of time");
        next = seconds;
        let epoch = &row["epoch"];
        let at = (seconds - 0.004).max(0.0);
        let ended = skinbus(folder.path(), &format!("explain {capture} --epoch {epoch} --at {at:.6} --json"));
        let explained: Value = serde_json::from_slice(&ended.stdout).unwrap();
        let number =
            |column: &str| row[column].parse::<f64>().unwrap_or_else(|error| panic!("{column}: {error}"));
        for total in explained["total"].as_array().unwrap() {
            let (joint, unit) = (&total["joint"], total["unit"].as_str().unwrap());
            for (column, key) in
                [("distributed", "words_nm"), ("central", "central_nm"), ("error", "difference_nm")]
            {
                let value = number(&format!("{column}_joint{joint}_{unit}"));
                assert!(same(value, &total[key]), "{capture}, epoch {epoch}, joint {joint}, {key}");
                loaded += usize::from(value != 0.0);
            }
        }
        for bus in explained["buses"].as_array().unwrap() {
            for (joint, position) in
                bus["joints"].as_array().unwrap().iter().zip(bus["position_rad"].as_array().unwrap())
            {
                assert!(same(number(&format!("position_joint{joint}_rad")), position), "{capture}");
            }
        }
        let is_open = |cell: &Value| cell["force"].is_null() || cell["answered_after_ns"].is_null();
        let is_saturated = |cell: &Value| {
            let words = cell["rows"].as_array().unwrap().iter().filter_map(|row| row["word"].as_i64());
            words.into_iter().any(|word| word == i64::from(i16::MAX) || word == i64::from(i16::MIN))
        };
        let count = |is: &dyn Fn(&Value) -> bool| {
            explained["cells"].as_array().unwrap().iter().filter(|cell| is(cell)).count().to_string()
        };
        assert_eq!(row["open_cells"], count(&is_open), "{capture}, epoch {epoch}");
        assert_eq!(row["saturated_cells"], count(&is_saturated), "{capture}, epoch {epoch}");
    }
    loaded
}

#[test]
fn rows_are_what_explain_says_of_their_epochs_in_recordings_logs_and_parts() {
    let parts = "split.mcap split-1.mcap split-2.mcap";
    let folder = folder(&[
        "fd.mcap",
        "classic.mcap",
        "classic.log",
        "two.mcap",
        "split.mcap",
        "split-1.mcap",
        "split-2.mcap",
    ]);
    for (capture, skin, epochs) in [
        ("fd.mcap", "", 100),
        ("classic.mcap", "", 100),
        ("classic.log", " --skin classic.toml", 100),
        ("two.mcap", "", 100),
        (parts, "", 150),
        ("split-1.mcap", "", 0),
    ] {
        let last = said(&folder, &format!("convert {capture} out.csv --overwrite{skin}"), 0);
        let rows = rows(&folder, "out.csv");
        assert!(last.ends_with(&format!(" -> out.csv: {} epochs", rows.len())), "{last}");
        assert!(rows.len() == epochs || epochs == 0 && !rows.is_empty(), "{capture}: {}", rows.len());
        assert!(
            compared(&folder, &rows, &format!("{capture}{skin}")) > 0,
            "{capture}: something was touched"
        );
    }
    // The parts give the same as the whole, in any order.
    said(&folder, &format!("convert {parts} a.csv"), 0);
    said(&folder, "convert split-2.mcap split.mcap split-1.mcap b.csv", 0);
    assert_eq!(
        fs::read(folder.path().join("a.csv")).unwrap(),
        fs::read(folder.path().join("b.csv")).unwrap()
    );
}

#[test]
fn torques_that_come_in_sums_are_empty_and_the_central_ones_are_there() {
    let folder = folder(&["sums.mcap"]);
    let Output { status, stderr, .. } = skinbus(folder.path(), "convert sums.mcap sums.csv");
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(0), "{said}");
    assert!(
        said.contains("the cells on vcan0 answer with sums, so distributed torques and errors are empty"),
        "{said}"
    );
    let rows = rows(&folder, "sums.csv");
    assert!(
        rows.iter().all(|row| row["distributed_joint2_Nm"].is_empty() && row["error_joint2_Nm"].is_empty())
    );
    assert!(rows.iter().any(|row| row["central_joint2_Nm"].parse::<f64>().unwrap() != 0.0));
}

#[test]
fn torques_are_empty_in_an_epoch_that_a_bus_of_the_joint_lacks() {
    let folder = folder(&["two.mcap"]);
    skinbus(folder.path(), "convert two.mcap two.log");
    let log = fs::read_to_string(folder.path().join("two.log")).unwrap();
    let is_joints = |line: &str, bus: &str| line.contains(&format!(" {bus} 001#"));
    // In classic CAN, joints of six words have two frames.
    let (first, second) = {
        let mut frames = (0..).zip(log.lines()).filter(|(_, line)| is_joints(line, "vcan1")).skip(2 * 40);
        (frames.next().unwrap().0, frames.next().unwrap().0)
    };
    let without = |is_left_out: &dyn Fn(usize, &str) -> bool| {
        let lines = log.lines().enumerate().filter(|(at, line)| !is_left_out(*at, line));
        let lines: String = lines.map(|(_, line)| format!("{line}\n")).collect();
        fs::write(folder.path().join("part.log"), lines).unwrap();
        skinbus(folder.path(), "convert part.log part.csv --skin two.toml --overwrite");
        rows(&folder, "part.csv")
    };
    let torques = ["distributed_joint2_Nm", "central_joint2_Nm", "error_joint2_Nm"];
    let cut = without(&|at, _| at == first || at == second);
    let empty: Vec<_> = cut.iter().filter(|row| torques.iter().any(|name| row[*name].is_empty())).collect();
    assert_eq!((cut.len(), empty.len()), (100, 1));
    assert!(torques.iter().all(|name| empty[0][*name].is_empty()), "{:?}", empty[0]);
    assert!(!empty[0]["position_joint2_rad"].is_empty(), "vcan0 had the joints");
    // A bus that is not in the capture changes nothing on joints that another one has.
    let one = without(&|_, line| line.contains(" vcan1 "));
    assert!(one.len() == 100 && one.iter().all(|row| torques.iter().all(|name| !row[*name].is_empty())));
}

#[test]
fn what_has_no_torques_is_refused_in_one_line_and_nothing_is_written() {
    let folder = folder(&["fd.mcap", "classic.log", "two.mcap"]);
    fs::write(folder.path().join("foreign.log"), "(1.000001) can7 123#11\n").unwrap();
    fs::write(folder.path().join("mine.csv"), "mine").unwrap();
    for (arguments, code, line) in [
        ("classic.log out.csv", 2, "skinbus: classic.log contains no skin: name one with --skin"),
        (
            "foreign.log out.csv --skin fd.toml",
            1,
            "skinbus: foreign.log: the skin has none of the capture's buses (can7), only vcan0: name the skin of \
             this capture",
        ),
        ("- out.csv", 2, "skinbus: standard input can be read only once: name the skin with --skin"),
        (
            "fd.mcap out.csv --plain",
            2,
            "skinbus: --plain is only for a candump log, but out.csv is a CSV file: leave it out",
        ),
        (
            "fd.mcap out.log --skin fd.toml",
            2,
            "skinbus: --skin fd.toml is only for CSV and columns: name an OUT that ends in .csv or .columns",
        ),
        ("fd.mcap mine.csv", 2, "skinbus: mine.csv: the file exists: name another file, or add --overwrite"),
        (
            "fd.mcap fd.csv/out.csv",
            2,
            "skinbus: fd.csv/out.csv: No such file or directory (os error 2); name a file in a folder that can be written",
        ),
    ] {
        assert_eq!(said(&folder, &format!("convert {arguments}"), code), line);
    }
    assert!(!folder.path().join("out.csv").exists());
    assert_eq!(fs::read_to_string(folder.path().join("mine.csv")).unwrap(), "mine");
    // A damaged recording leaves no file.
    let bytes = fs::read(folder.path().join("fd.mcap")).unwrap();
    let mut damaged = bytes.clone();
    let middle = damaged.len() / 2;
    damaged[middle..middle + 64].fill(0x55);
    fs::write(folder.path().join("damaged.mcap"), damaged).unwrap();
    let line = said(&folder, "convert damaged.mcap out.csv --skin fd.toml", 1);
    assert!(line.contains("damaged.mcap is damaged"), "{line}");
    assert!(!folder.path().join("out.csv").exists());
    // A truncated recording gives its intact part.
    fs::write(folder.path().join("begun.mcap"), &bytes[..middle]).unwrap();
    let line = said(&folder, "convert begun.mcap strict.csv --strict --skin fd.toml", 1);
    assert!(line.contains("its end is missing") && !folder.path().join("strict.csv").exists(), "{line}");
    let Output { status, .. } = skinbus(folder.path(), "convert begun.mcap begun.csv --skin fd.toml");
    assert_eq!(status.code(), Some(0));
    let cut = rows(&folder, "begun.csv");
    assert!(!cut.is_empty() && cut.len() < 100, "{}", cut.len());
}
