//! A run repairs the files that earlier runs left in its recording's folder, and touches no other files.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::fs::{self, File, Permissions};
use std::io::Write;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt, symlink};
use std::path::Path;
use std::sync::atomic::AtomicBool;

use crate::record::{McapOutput, RecordOptions, RecordingOutputs};
use rustix::fs::{FlockOperation, Mode, flock};
use tempfile::TempDir;
use trace::recording::file::FileWriter;
use trace::recording::names::PartFile;
use trace::ros2::standard::JointState;

/// Content of the file of a writer that has not finished.
fn begun(mut writer: FileWriter<Vec<u8>>) -> Vec<u8> {
    let mut joints = writer.channel::<JointState<'_>>("/arm/joint_states", &[]).unwrap();
    let state = JointState { nanos: 1, names: &[], position: &[1.0], velocity: &[], effort: &[] };
    writer.write(&mut joints, 1, &state).unwrap();
    writer.flush().unwrap();
    writer.into_inner()
}

/// Leaves the file of a run that was killed while it recorded.
fn left(folder: &TempDir, name: &str) {
    let (_, mut file) = PartFile::create(folder.path().join(name)).unwrap();
    let there = usize::try_from(file.metadata().unwrap().len()).unwrap();
    let bytes = begun(FileWriter::with_file_identity(Vec::new(), &file.metadata().unwrap()).unwrap());
    file.write_all(&bytes[there..]).unwrap();
}

/// Claims the files of the next run. Returns its messages.
fn claims(folder: &Path, name: &str) -> (Result<RecordingOutputs, String>, Vec<String>) {
    let mcap = McapOutput {
        path: folder.join(name),
        split: trace::recording::series::SplitLimits::default(),
        attachments: Vec::new(),
        robot: None,
        command_line: Vec::new(),
    };
    let options = RecordOptions { mcap: Some(mcap), ..RecordOptions::default() };
    let mut said = Vec::new();
    let claimed = RecordingOutputs::open_outputs(&options, &AtomicBool::new(false), |line| {
        said.push(line.replace(&format!("{}/", folder.display()), ""));
    });
    (claimed.map_err(|error| error.to_string()), said)
}

#[test]
fn what_a_killed_run_left_is_repaired_and_nobody_may_read_more_of_it_than_before() {
    let folder = tempfile::tempdir().unwrap();
    left(&folder, "run.mcap");
    let part = folder.path().join("run.mcap.part");
    fs::set_permissions(&part, Permissions::from_mode(0o600)).unwrap();
    fs::write(folder.path().join("run-recovered.mcap"), "somebody's").unwrap();
    let (claimed, said) = claims(folder.path(), "run.mcap");
    assert!(claimed.is_ok() && said.len() == 1, "{said:?}");
    let repaired = "run.mcap.part was left by a run that was killed; it was repaired as run-recovered-1.mcap: 1 messages";
    assert!(said[0].starts_with(repaired), "{said:?}");
    let about = fs::metadata(folder.path().join("run-recovered-1.mcap")).unwrap();
    assert_eq!(about.mode() & 0o777, 0o600);
    assert_eq!(fs::read(folder.path().join("run-recovered.mcap")).unwrap(), b"somebody's");
}

#[test]
fn an_original_that_is_damaged_before_its_end_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    for number in ["", "-1"] {
        left(&folder, "run.mcap");
        let part = folder.path().join("run.mcap.part");
        let mut bytes = fs::read(&part).unwrap();
        // Flips a bit of the only chunk.
        let chunk = bytes.windows(4).position(|at| at == b"zstd").unwrap();
        bytes[chunk + 60] ^= 0x10;
        File::options().write(true).open(&part).unwrap().write_all(&bytes).unwrap();
        let (claimed, said) = claims(folder.path(), "next.mcap");
        assert!(claimed.is_ok() && said.len() == 1, "{said:?}");
        let repaired = format!("it was repaired as run-recovered{number}.mcap: 0 messages");
        let kept = format!(" damaged bytes are lost; the damaged original is run.mcap.damaged{number}");
        assert!(said[0].contains(&repaired) && said[0].ends_with(&kept), "{said:?}");
        assert!(!part.exists());
        assert_eq!(fs::read(folder.path().join(format!("run.mcap.damaged{number}"))).unwrap(), bytes);
        drop(claimed);
        assert_eq!(claims(folder.path(), "next.mcap").1, [""; 0], "nothing is repaired twice");
    }
}

#[test]
fn what_was_killed_before_it_recorded_anything_is_taken_away() {
    let folder = tempfile::tempdir().unwrap();
    let (part, file) = PartFile::create(folder.path().join("run.mcap")).unwrap();
    drop((part, file));
    let (claimed, said) = claims(folder.path(), "run.mcap");
    assert!(claimed.is_ok());
    assert_eq!(
        said,
        ["run.mcap.part was left by a run that was killed; it held no messages and was removed"]
    );
}

#[test]
fn what_is_not_ours_is_named_and_stays_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let away = tempfile::tempdir().unwrap();
    // A recording of this project that another program is copying, and a recording of another program.
    left(&folder, "copy.mcap");
    let ours = fs::read(path("copy.mcap.part")).unwrap();
    fs::rename(path("copy.mcap.part"), away.path().join("original")).unwrap();
    fs::write(path("copy.mcap.part"), &ours).unwrap();
    // A copy with the inode of its original, which was deleted.
    left(&folder, "again.mcap");
    let mut again = fs::read(path("again.mcap.part")).unwrap();
    let born = again.windows(7).position(|bytes| bytes == b"born_ns").unwrap();
    again[born + 11] = if again[born + 11] == b'1' { b'2' } else { b'1' };
    fs::write(path("again.mcap.part"), again).unwrap();
    fs::write(path("download.mcap.part"), begun(FileWriter::new(Vec::new()).unwrap())).unwrap();
    fs::write(path("empty.mcap.part"), "").unwrap();
    fs::write(path("text.mcap.part"), "not even that").unwrap();
    fs::create_dir(path("folder.mcap.part")).unwrap();
    rustix::fs::mknodat(
        rustix::fs::CWD,
        path("pipe.mcap.part"),
        rustix::fs::FileType::Fifo,
        Mode::from_raw_mode(0o600),
        0,
    )
    .unwrap();
    let _socket = std::os::unix::net::UnixListener::bind(path("socket.mcap.part")).unwrap();
    symlink(away.path().join("original"), path("link.mcap.part")).unwrap();
    symlink("nowhere", path("lost.mcap.part")).unwrap();
    left(&folder, "two.mcap");
    fs::hard_link(path("two.mcap.part"), away.path().join("two")).unwrap();
    left(&folder, "locked.mcap");
    let held = File::open(path("locked.mcap.part")).unwrap();
    flock(&held, FlockOperation::LockExclusive).unwrap();
    let all = || {
        let mut all: Vec<_> = fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| {
                let path = entry.unwrap().path();
                let about = fs::symlink_metadata(&path).unwrap();
                let bytes = if about.is_file() { fs::read(&path).unwrap() } else { Vec::new() };
                (path, about.ino(), about.mode(), bytes)
            })
            .collect();
        all.sort();
        all
    };
    let before = all();
    let (claimed, said) = claims(folder.path(), "run.mcap");
    drop(claimed.unwrap());
    assert_eq!(all(), before, "{said:?}");
    let reason = |name: &str| {
        let begin = format!("{name}.mcap.part was neither repaired nor removed: ");
        let mut lines = said.iter().filter_map(|line| line.strip_prefix(&begin));
        let why = lines.next().unwrap_or_else(|| panic!("{name}: {said:?}"));
        assert_eq!(lines.next(), None);
        why.split(';').next().unwrap().to_owned()
    };
    for name in ["again", "copy", "download", "empty", "text"] {
        assert_eq!(reason(name), "it was not created here by a run of this program");
    }
    for name in ["folder", "pipe", "socket"] {
        assert_eq!(reason(name), "it is not a regular file");
    }
    assert_eq!(["link", "lost"].map(reason), ["it is a symlink", "it is a symlink"]);
    assert_eq!(reason("two"), "it has 2 hard links");
    assert_eq!(reason("locked"), "another program is writing it");
    assert_eq!(said.len(), 12);
    assert!(fs::symlink_metadata(path("pipe.mcap.part")).unwrap().file_type().is_fifo());
    // No recording starts under the name of one of them.
    let (claimed, _) = claims(folder.path(), "download.mcap");
    let why = claimed.unwrap_err();
    assert!(why.ends_with("was not left by a killed run: move it away, or record to another name"), "{why}");
    assert_eq!(all(), before);
}

#[test]
fn a_file_that_takes_a_name_meanwhile_keeps_it() {
    let folder = tempfile::tempdir().unwrap();
    let goal = folder.path().join("run.mcap");
    let (part, _file) = PartFile::create(goal.clone()).unwrap();
    fs::remove_file(&part.path).unwrap();
    fs::write(&part.path, "somebody's").unwrap();
    let expected = format!("another program has replaced {}", part.path.display());
    assert_eq!(part.finish(true).unwrap_err().to_string(), expected);
    assert!(part.open().is_err());
    part.remove();
    assert_eq!(fs::read(&part.path).unwrap(), b"somebody's");
    assert!(!goal.exists());
}
