//! Folders of columns, and tables in them.

use super::*;
use crate::columns::{ColumnSpec, GroupRange, GroupedTable, Row, Table};

const DESCRIPTION: &str = "{\n  \"skinbus_columns\": 1\n}";

fn words(path: &Path) -> Vec<u8> {
    fs::read(path).unwrap().split_off(128)
}

#[test]
fn the_folder_gets_its_name_when_it_is_complete() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.columns");
    let folder = ColumnFolder::create(&path, false).unwrap();
    let columns = [ColumnSpec::single("at_ns", Element::I64), ColumnSpec::wide("words", Element::I16, 2)];
    let mut table = Table::create(&folder, "torques", &columns).unwrap();
    table.push(Row::default().count(u64::MAX).words(&[-1], 2)).unwrap();
    assert!(table.push(Row::default().i64(1)).is_err(), "a row without words");
    assert_eq!(table.finish().unwrap(), 1);
    assert!(!path.exists());
    folder.finish(DESCRIPTION).unwrap();
    assert_eq!(words(&path.join("torques.at_ns.npy")), i64::MAX.to_le_bytes());
    assert_eq!(words(&path.join("torques.words.npy")), [255, 255, 0, 0]);
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1, "no temporary folder");
}

#[test]
fn a_folder_that_is_not_finished_leaves_nothing() {
    let place = tempfile::tempdir().unwrap();
    let folder = ColumnFolder::create(&place.path().join("run.columns"), false).unwrap();
    let _column = folder.create_column("a", "b", Element::U8, None).unwrap();
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    drop(folder);
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 0);
}

#[test]
fn rows_of_a_group_stay_in_their_order_whatever_their_number() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.columns");
    let folder = ColumnFolder::create(&path, false).unwrap();
    let columns = [ColumnSpec::single("cell", Element::U8), ColumnSpec::single("number", Element::I64)];
    let mut table = GroupedTable::create(&folder, "torques", &columns).unwrap();
    // Groups of 0, 1, 127, 128, 129 and 1000 rows, one row of each in turn.
    let counts = [0, 1, 127, 128, 129, 1_000];
    for number in 0..1_000 {
        for (cell, _) in (0_u8..).zip(counts).filter(|(_, count)| number < *count) {
            table.push(u32::from(cell), Row::default().u8(cell).i64(number)).unwrap();
        }
    }
    let ranges = table.finish().unwrap();
    folder.finish(DESCRIPTION).unwrap();
    let mut begin = 0;
    for (group, count) in (1..).zip([1, 127, 128, 129, 1_000]) {
        assert_eq!(ranges[group as usize - 1], GroupRange { group, begin, end: begin + count });
        begin += count;
    }
    let numbers = words(&path.join("torques.number.npy"));
    let expected: Vec<u8> =
        counts.into_iter().flat_map(|count| (0..count).flat_map(i64::to_le_bytes)).collect();
    assert_eq!(numbers, expected);
    assert_eq!(words(&path.join("torques.cell.npy")).iter().filter(|cell| **cell == 5).count(), 1_000);
}

#[test]
fn only_a_folder_of_columns_is_replaced() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.columns");
    let refused = |path: &Path, overwrite| check_columns_writable(path, overwrite).unwrap_err().to_string();
    fs::create_dir(&path).unwrap();
    assert_eq!(refused(&path, true), "the folder contains other files: name another folder");
    fs::write(path.join(DESCRIPTION_FILE), "{\"other\": 1}").unwrap();
    assert_eq!(refused(&path, true), "the folder contains other files: name another folder");
    fs::write(path.join(DESCRIPTION_FILE), DESCRIPTION).unwrap();
    assert_eq!(refused(&path, false), "the file exists: name another file, or add --overwrite");
    fs::write(path.join("thesis.txt"), "mine").unwrap();
    assert_eq!(
        refused(&path, true),
        "the folder contains thesis.txt, which is not a column file: move that file away, or name another \
         folder"
    );
    fs::remove_file(path.join("thesis.txt")).unwrap();
    fs::write(path.join("old.npy"), "").unwrap();
    let folder = ColumnFolder::create(&path, true).unwrap();
    folder.finish(DESCRIPTION).unwrap();
    assert!(!path.join("old.npy").exists());
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1, "the former folder is gone");
    let file = place.path().join("file.columns");
    fs::write(&file, "mine").unwrap();
    assert_eq!(refused(&file, true), "it exists and is not a folder of columns: name another folder");
    let link = place.path().join("link.columns");
    std::os::unix::fs::symlink(&path, &link).unwrap();
    assert_eq!(refused(&link, true), "it exists and is not a folder of columns: name another folder");
    let none = place.path().join("none/run.columns");
    assert!(refused(&none, true).ends_with("name a file in a folder that can be written"));
}

#[test]
fn what_a_killed_conversion_left_is_removed_and_nothing_else() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.columns");
    let part = temporary_name(&path);
    fs::create_dir(&part).unwrap();
    fs::write(part.join("frames.at_ns.npy"), "old").unwrap();
    fs::write(part.join(DESCRIPTION_FILE), DESCRIPTION).unwrap();
    let folder = ColumnFolder::create(&path, false).unwrap();
    assert_eq!(fs::read_dir(&part).unwrap().count(), 0);
    let refused = || {
        let error = ColumnFolder::create(&path, false).unwrap_err().to_string();
        assert!(
            error.contains(".part exists, but was not left by an interrupted conversion: move it away"),
            "{error}"
        );
    };
    refused();
    assert!(part.exists(), "it is still written");
    drop(folder);
    assert!(!part.exists());
    for name in ["thesis.txt", "old.npy"] {
        let other = part.join(name);
        if name == "old.npy" {
            fs::create_dir_all(&other).unwrap();
        } else {
            fs::create_dir(&part).unwrap();
            fs::write(&other, "mine").unwrap();
        }
        refused();
        assert!(other.exists(), "{name}");
        fs::remove_dir_all(&part).unwrap();
    }
    let others = place.path().join("others");
    fs::create_dir(&others).unwrap();
    std::os::unix::fs::symlink(&others, &part).unwrap();
    refused();
    assert!(part.is_symlink() && others.exists());
}

#[test]
fn a_folder_whose_columns_are_not_all_removed_is_still_one_of_columns() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.columns");
    fs::create_dir_all(path.join("no_file.npy")).unwrap();
    fs::write(path.join("a.npy"), "").unwrap();
    fs::write(path.join(DESCRIPTION_FILE), DESCRIPTION).unwrap();
    remove_columns(&path);
    assert!(!path.join("a.npy").exists() && has_description(&path));
    fs::remove_dir(path.join("no_file.npy")).unwrap();
    remove_columns(&path);
    assert!(!path.exists());
}
