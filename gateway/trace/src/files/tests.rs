use super::*;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::symlink;

use rustix::fs::{CWD, Mode};

fn names(folder: &Path) -> Vec<OsString> {
    let mut names: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    names
}

fn log(path: &Path, force: bool) -> io::Result<LogFile> {
    LogFile::create(path, force, &AtomicBool::new(false))
}

/// Creates a log and a result file under the same name, and returns the error message of each.
fn refusals(path: &Path, force: bool) -> [String; 2] {
    let [whole, log] = [AtomicFile::create(path, force).map(drop), log(path, force).map(drop)];
    [whole, log].map(|refused| refused.unwrap_err().to_string())
}

#[test]
fn a_file_has_its_name_when_it_is_whole_and_leaves_nothing_when_it_never_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.json");
    for (force, text) in [(false, "first"), (true, "second")] {
        let before = names(folder.path());
        drop(AtomicFile::create(&path, force).unwrap());
        assert_eq!(names(folder.path()), before);
        let (whole, mut file) = AtomicFile::create(&path, force).unwrap();
        file.write_all(text.as_bytes()).unwrap();
        assert_eq!(names(folder.path()), before);
        whole.finish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), text);
        assert_eq!(names(folder.path()), ["run.json"]);
    }
}

#[test]
fn what_is_there_is_not_overwritten_and_no_symlink_is_followed_to_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let [file, link, dangling, directory, socket] =
        ["file", "link", "dangling", "directory", "socket"].map(|name| folder.path().join(name));
    fs::write(&file, "mine").unwrap();
    symlink(&file, &link).unwrap();
    symlink("nowhere", &dangling).unwrap();
    fs::create_dir(&directory).unwrap();
    let _socket = std::os::unix::net::UnixListener::bind(&socket).unwrap();
    let before = names(folder.path());
    let exists = "the file exists: name another file, or add --overwrite";
    assert_eq!(refusals(&file, false), [exists; 2]);
    for force in [false, true] {
        for path in [&link, &dangling] {
            // The link's target exists, so it would be refused as well.
            let itself = if path == &link && !force { " and add --overwrite" } else { "" };
            let why = format!(
                "it is a symlink, which is not followed: name the file that it points to{itself}, or another \
                 file"
            );
            assert_eq!(refusals(path, force), [why.clone(), why]);
        }
        let why = "is a directory; name a file in a folder that can be written";
        assert_eq!(refusals(&directory, force), [why; 2]);
        assert_eq!(refusals(&socket, force), ["it is not a regular file: name another file"; 2]);
    }
    assert_eq!(names(folder.path()), before);
    assert_eq!(fs::read_to_string(&file).unwrap(), "mine");
}

#[test]
fn of_a_full_disk_the_hint_is_another_one() {
    // The folder of another file may be on the same full disk, so no other folder is advised.
    let full = with_creation_hint(io::ErrorKind::StorageFull.into());
    assert!(full.to_string().ends_with("; free some space, or name a file on another disk"), "{full}");
    assert_eq!(full.kind(), io::ErrorKind::StorageFull);
}

#[test]
fn who_names_a_place_for_no_file_is_told_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    fs::write(&file, "mine").unwrap();
    for (path, why) in [
        (folder.path().join("none/run.json"), "No such file or directory (os error 2)"),
        (file.join("run.json"), "Not a directory (os error 20)"),
    ] {
        let why = format!("{why}; name a file in a folder that can be written");
        assert_eq!(refusals(&path, false), [why.clone(), why]);
    }
}

#[test]
fn a_name_that_another_program_took_meanwhile_is_left_to_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.json");
    let begun = || {
        let (whole, mut file) = AtomicFile::create(&path, false).unwrap();
        file.write_all(b"mine").unwrap();
        whole
    };
    // A file with a temporary name must behave like one without a name.
    let nameless = begun();
    let mut part = begun();
    let file = OpenOptions::new().write(true).create_new(true).open(temporary_name(&path)).unwrap();
    (part.file, part.is_part) = (Some(file), true);
    assert_eq!(names(folder.path()).len(), 1, "the part");
    fs::write(&path, "another's").unwrap();
    for whole in [nameless, part] {
        assert_eq!(whole.finish().unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read_to_string(&path).unwrap(), "another's");
    }
    assert_eq!(names(folder.path()), ["run.json"]);
}

#[test]
fn a_device_is_written_to_as_it_is() {
    for path in ["/dev/null", "/dev/../dev/null"] {
        let (whole, mut file) = AtomicFile::create(Path::new(path), false).unwrap();
        file.write_all(b"new").unwrap();
        whole.finish().unwrap();
        let mut log = log(Path::new(path), true).unwrap();
        log.append("new\n").unwrap();
        log.finish().unwrap();
    }
}

#[test]
fn a_descriptor_of_this_program_is_written_to_whatever_it_is() {
    use std::io::Seek;
    let mut file = tempfile::tempfile().unwrap();
    file.write_all(b"before\n").unwrap();
    for name in ["/dev/fd", "/proc/self/fd", "/proc/thread-self/fd"] {
        let path = Path::new(name).join(file.as_raw_fd().to_string());
        // The descriptors below `thread-self` are those of the process by another path.
        if name.contains("thread") {
            assert!(log(&path, false).is_err());
            continue;
        }
        let mut log = log(&path, false).unwrap();
        log.append("line\n").unwrap();
        log.finish().unwrap();
    }
    let mut text = String::new();
    file.rewind().unwrap();
    file.read_to_string(&mut text).unwrap();
    assert_eq!(text, "before\nline\nline\n");
}

#[test]
fn a_fifo_is_waited_for_until_somebody_reads_it_or_says_stop() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("fifo");
    let made = rustix::fs::mknodat(CWD, &path, rustix::fs::FileType::Fifo, Mode::RWXU, 0);
    made.unwrap();
    let stopped = LogFile::create(&path, false, &AtomicBool::new(true)).unwrap_err();
    assert_eq!(stopped.to_string(), "interrupted while it waited for a program that reads this pipe");
    let fifo = path.clone();
    let reader = std::thread::spawn(move || {
        BufReader::new(File::open(fifo).unwrap()).lines().map(Result::unwrap).collect::<Vec<_>>()
    });
    let mut log = log(&path, false).unwrap();
    log.append("one\ntwo\n").unwrap();
    log.finish().unwrap();
    assert_eq!(reader.join().unwrap(), ["one", "two"]);
    assert_eq!(names(folder.path()), ["fifo"]);
}

#[test]
fn a_log_is_there_while_it_grows_and_gone_when_nothing_came() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.log");
    drop(log(&path, false).unwrap());
    assert!(names(folder.path()).is_empty());
    let mut growing = log(&path, false).unwrap();
    for lines in ["one\n", "two\nthree\n"] {
        growing.append(lines).unwrap();
        assert!(fs::read_to_string(&path).unwrap().ends_with(lines));
    }
    assert_eq!(growing.bytes(), 14);
    // A run that fails drops its log without finishing it.
    drop(growing);
    assert_eq!(fs::read_to_string(&path).unwrap(), "one\ntwo\nthree\n");
    log(&folder.path().join("empty.log"), false).unwrap().finish().unwrap();
    assert_eq!(names(folder.path()), ["empty.log", "run.log"]);
}

#[test]
fn a_log_takes_another_files_place_with_its_first_line() {
    let folder = tempfile::tempdir().unwrap();
    let [path, other] = ["run.log", "other name"].map(|name| folder.path().join(name));
    fs::write(&path, "old\n").unwrap();
    fs::hard_link(&path, &other).unwrap();
    drop(log(&path, true).unwrap());
    assert_eq!(fs::read_to_string(&path).unwrap(), "old\n");
    let mut new = log(&path, true).unwrap();
    new.append("new\n").unwrap();
    assert_eq!(fs::read_to_string(&path).unwrap(), "new\n");
    assert_eq!(fs::read_to_string(&other).unwrap(), "old\n");
    new.finish().unwrap();
    assert_eq!(names(folder.path()), ["other name", "run.log"]);
    log(&path, true).unwrap().finish().unwrap();
    assert_eq!(fs::read_to_string(&path).unwrap(), "");
}

#[test]
fn two_do_not_write_one_log() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.log");
    let why = "another run is writing this file: name another file, or wait until that run has ended";
    fs::write(&path, "old\n").unwrap();
    for force in [true, false] {
        let mut first = log(&path, force).unwrap();
        for lines in ["", "line\n"] {
            first.append(lines).unwrap();
            for force in [false, true] {
                assert_eq!(log(&path, force).unwrap_err().to_string(), why);
            }
        }
        drop(first);
        fs::remove_file(&path).unwrap();
    }
}

#[test]
fn a_numbered_log_takes_the_first_name_that_is_free() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("demo.log");
    let create = || LogFile::create_numbered(&path, &AtomicBool::new(false)).unwrap();
    let logs = [create(), create(), create()];
    let taken = logs.each_ref().map(|log| log.path().file_name().unwrap().to_owned());
    assert_eq!(taken, ["demo.log", "demo-1.log", "demo-2.log"]);
    // Only the last dot of a name separates the extension.
    let dotted = folder.path().join("a.b.log");
    let logs = [(); 3].map(|()| LogFile::create_numbered(&dotted, &AtomicBool::new(false)).unwrap());
    let taken = logs.each_ref().map(|log| log.path().file_name().unwrap().to_owned());
    assert_eq!(taken, ["a.b.log", "a.b-1.log", "a.b-2.log"]);
    let nowhere = folder.path().join("none/demo.log");
    assert!(LogFile::create_numbered(&nowhere, &AtomicBool::new(false)).is_err());
}

/// A file that returns the given errors first, and accepts one byte per call.
struct Moody(Vec<io::ErrorKind>, Vec<u8>);

impl Write for Moody {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if let Some(error) = self.0.pop() {
            return Err(error.into());
        }
        self.1.extend(bytes.first());
        Ok(bytes.len().min(1))
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn what_interrupts_a_write_is_no_error_and_a_single_one_is_tried_again() {
    use io::ErrorKind::{Interrupted, Other, StorageFull, WouldBlock};
    for moods in
        [vec![Interrupted; 5], vec![WouldBlock; 5], vec![Other, Interrupted, WouldBlock], vec![StorageFull]]
    {
        let mut file = Moody(moods, Vec::new());
        target::write_all_with_retries(&mut file, b"lines").unwrap();
        assert_eq!(file.1, b"lines");
    }
    let mut file = Moody(vec![Other, Other], Vec::new());
    assert_eq!(target::write_all_with_retries(&mut file, b"lines").unwrap_err().kind(), Other);
    assert_eq!(file.1, b"");
}

#[test]
fn a_name_that_cannot_be_looked_at_is_neither_a_files_own_nor_anothers() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.log");
    fs::write(&path, "").unwrap();
    let is = device_and_inode(&fs::metadata(&path).unwrap());
    assert_eq!(still_names_file(&path, is), Some(true));
    assert_eq!(still_names_file(&folder.path().join("other"), is), Some(false));
    assert_eq!(still_names_file(&folder.path().join("n".repeat(300)), is), None);
}
