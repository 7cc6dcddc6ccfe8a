//! `skinbus convert` as a process: errors for bad input, and the files on disk afterwards.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

mod public;

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

const LOG: &str = "(1.000001) can0 123#11\n# why\n(2.000000) can0 22C##5AABB\n";

/// A directory with files.
struct Folder(TempDir);

impl Folder {
    fn new(files: &[(&str, &[u8])]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in files {
            fs::write(folder.path().join(name), bytes).unwrap();
        }
        Self(folder)
    }

    fn path(&self, name: &str) -> std::path::PathBuf {
        self.0.path().join(name)
    }

    fn gateway(&self, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
        command.args(arguments.split(' ').filter(|word| !word.is_empty())).current_dir(self.0.path());
        command
    }

    /// Standard error of a command that ends with this code.
    fn says(&self, arguments: &str, code: i32) -> String {
        let Output { status, stdout, stderr } =
            self.gateway(arguments).stdin(Stdio::null()).output().unwrap();
        let said = String::from_utf8(stderr).unwrap();
        assert_eq!((status.code(), stdout.len()), (Some(code), 0), "{arguments}: {said}");
        said
    }

    /// The one-line error of a command that changes no file.
    fn refuses(&self, arguments: &str, code: i32) -> String {
        let before = self.all();
        let said = self.says(arguments, code);
        assert_eq!(said.matches('\n').count(), 1, "{arguments}: {said}");
        assert_eq!(self.all(), before, "{arguments}");
        said.trim_end().to_owned()
    }

    /// All files with their content, including hidden ones.
    fn all(&self) -> Vec<(String, Vec<u8>)> {
        let mut all: Vec<_> = fs::read_dir(self.0.path())
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .map(|path| (path.file_name().unwrap().to_string_lossy().into_owned(), fs::read(path).unwrap()))
            .collect();
        all.sort();
        all
    }

    fn text(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }
}

#[test]
fn a_log_becomes_a_recording_and_a_log_again() {
    let folder = Folder::new(&[("run.log", LOG.as_bytes())]);
    assert_eq!(folder.says("convert run.log run.mcap", 0), "run.log -> run.mcap: 2 frames, 1 notes\n");
    assert_eq!(folder.says("convert run.mcap back.log", 0), "run.mcap -> back.log: 2 frames, 1 notes\n");
    assert_eq!(folder.text("back.log"), LOG);
    assert_eq!(folder.all().len(), 3, "and nothing beside them");
    let nine = folder.says("convert run.mcap nine.txt --digits 9 --plain", 0);
    assert_eq!(nine, "run.mcap: 1 note was left out\nrun.mcap -> nine.txt: 2 frames, 0 notes\n");
    assert_eq!(folder.text("nine.txt"), "(1.000001000) can0 123#11\n(2.000000000) can0 22C##5AABB\n");
}

#[test]
fn what_candump_prints_becomes_a_log_and_a_recording_and_what_is_not_in_it_is_said() {
    let console = "\
$ candump -td -a can0 vcan1
 (000.000000)   can0  123   [2]  DE AD                     '..'
 (000.010034)  vcan1  123  [02]  DE AD
 (000.010016)   can0  20000004   [8]  00 08 00 00 00 00 00 00   ERRORFRAME
 (000.000100)   can0  1F334455   [4]  remote request
 (000.000001)  vcan1  123  [02]  DE AF
";
    let folder = Folder::new(&[("forum.txt", console.as_bytes())]);
    let differences = "its times are differences between frames (candump -t d): they are added up, from 0";
    let flags = "its lines lack the FD flags (candump without -x): FD frames are read as frames without \
                 bit-rate switch";
    for to in ["forum.log", "forum.mcap"] {
        let said = folder.says(&format!("convert forum.txt {to}"), 0);
        let expected =
            format!("forum.txt: {differences}\nforum.txt: {flags}\nforum.txt -> {to}: 5 frames, 1 notes\n");
        assert_eq!(said, expected);
    }
    let log = "\
$ candump -td -a can0 vcan1
(0.000000) can0 123#DEAD
(0.010034) vcan1 123##4DEAD
(0.020050) can0 20000004#0008000000000000
(0.020150) can0 1F334455#R4
(0.020151) vcan1 123##4DEAF
";
    assert_eq!(folder.text("forum.log"), log);
    folder.says("convert forum.mcap back.log", 0);
    assert_eq!(folder.text("back.log"), log);
}

#[test]
fn padded_seconds_and_can_xl_come_back_and_indented_lines_are_read() {
    let log = "(0000000012.345678) can0 123#11\n(000.000001) can0 123#\n(12.000000) can0 123#\n\
               (1700000000.000001) can0 00123#80:01:00000000#11223344\n";
    let indented = log.replace('\n', "\n    ");
    let folder = Folder::new(&[("run.log", log.as_bytes()), ("in.log", indented.as_bytes())]);
    folder.says("convert run.log run.mcap", 0);
    let said = folder.says("convert run.mcap back.log", 0);
    assert!(said.contains("1 is a CAN XL frame"), "{said}");
    assert_eq!(folder.text("back.log"), log);
    let said = folder.says("convert in.log in.mcap", 0);
    assert!(said.ends_with("in.log -> in.mcap: 3 frames, 2 notes\n"), "{said}");
}

#[test]
fn standard_input_and_output_are_text_or_a_recording_that_comes_in() {
    let folder = Folder::new(&[("run.log", LOG.as_bytes())]);
    folder.says("convert run.log run.mcap", 0);
    let input = fs::File::open(folder.path("run.mcap")).unwrap();
    let Output { status, stdout, stderr } = folder.gateway("convert - -").stdin(input).output().unwrap();
    assert_eq!((status.code(), stdout), (Some(0), LOG.as_bytes().to_vec()));
    assert_eq!(String::from_utf8(stderr).unwrap(), "standard input -> -: 2 frames, 1 notes\n");
}

#[test]
fn what_is_no_capture_is_refused_by_its_name() {
    let files: [(&str, &[u8]); 5] = [
        ("run.zip", b"PK\x03\x04 and so on"),
        ("empty.log", b""),
        ("words.txt", b"Dear diary,\n\nno frames today.\n"),
        ("run.pcapng", b"\x0A\x0D\x0D\x0A and so on"),
        ("empty.mcap", b"\x89MCAP0\r\n"),
    ];
    let folder = Folder::new(&files);
    assert_eq!(
        folder.refuses("convert run.zip run.mcap", 2),
        "skinbus: run.zip is a zip archive, not a candump log or MCAP recording: unpack it first"
    );
    assert_eq!(folder.refuses("convert empty.log run.mcap", 1), "skinbus: empty.log: the file is empty");
    assert_eq!(
        folder.refuses("convert words.txt run.mcap", 1),
        "skinbus: words.txt: no frame in 3 lines; expected the output of candump, with lines like \
         `(1700000000.123456) vcan0 123#00` or `vcan0  123   [1]  00`"
    );
    assert!(folder.refuses("convert run.pcapng run.mcap", 2).contains("is a packet capture"));
    for (name, begins, what) in [
        ("drive.mf4", "UnFinMF 4.11", "is an MDF file"),
        (
            "drive.asc",
            "date Wed Jan 1 10:00:00.000 2025\nbase hex  timestamps absolute\n",
            "is a Vector ASC log",
        ),
        ("drive.trc", ";$FILEVERSION=2.1\n;$STARTTIME=45000.5\n", "is a PEAK trace"),
        ("drive.csv", "timestamp,arbitration_id,extended,remote,error,dlc,data\n", "is a table in CSV"),
        ("edge.csv", "TimestampEpoch;BusChannel;ID;IDE;DLC\n1.0;1;123;0;8\n", "is a table in CSV"),
        ("lfs.mcap", "version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "is a Git LFS pointer"),
    ] {
        fs::write(folder.path(name), begins).unwrap();
        let said = folder.refuses(&format!("convert {name} run.mcap"), 2);
        assert!(
            said.contains(what)
                && ["can_logconvert", "asc2log", "git lfs"].iter().any(|hint| said.contains(hint)),
            "{said}"
        );
    }
    assert_eq!(
        folder.refuses("convert empty.mcap run.log", 1),
        "skinbus: empty.mcap: it contains no CAN frames"
    );
    let gone = folder.refuses("convert gone.log run.mcap", 2);
    assert_eq!(gone, "skinbus: gone.log: No such file or directory (os error 2)");
    assert_eq!(folder.refuses("convert . run.mcap", 2), "skinbus: .: it is a folder, but a file is needed");
    let nowhere = "No such file or directory (os error 2); name a file in a folder that can be written";
    let said = folder.refuses("convert words.txt none/run.mcap", 2);
    assert_eq!(said, format!("skinbus: none/run.mcap: {nowhere}"));
}

#[test]
fn a_bad_line_is_named_and_kept_and_with_strict_it_is_the_end() {
    let log = LOG.replace("# why", "(1.) can0 123#11");
    let folder = Folder::new(&[("run.log", log.as_bytes())]);
    assert_eq!(
        folder.refuses("convert run.log run.mcap --strict", 1),
        "skinbus: run.log:2: column 4: expected digits of a second; leave out --strict to keep such lines \
         unchanged"
    );
    assert_eq!(
        folder.says("convert run.log run.mcap", 0),
        "run.log:2: column 4: expected digits of a second\nrun.log: 1 line looks like a frame but is \
         malformed: not read\nrun.log -> run.mcap: 2 frames, 1 notes\n"
    );
    folder.says("convert run.mcap back.log", 0);
    assert_eq!(folder.text("back.log"), log);
}

#[test]
fn of_many_bad_lines_some_are_named_and_all_are_counted() {
    let log = format!("{}(1.000000) can0 123#\n", "(1\n".repeat(1_000));
    let folder = Folder::new(&[("run.log", log.as_bytes())]);
    let said = folder.says("convert run.log run.mcap", 0);
    assert_eq!(said.lines().count(), 103, "{said}");
    assert!(said.contains("run.log:100: column 3:") && !said.contains("run.log:101:"), "{said}");
    assert!(said.contains("run.log: 1000 lines look like frames but are malformed"), "{said}");
}

#[test]
fn times_that_run_backwards_are_said_once() {
    let folder =
        Folder::new(&[("run.log", b"(2.000000) can0 123#\n(1.000000) can0 123#\n(0.000000) can0 123#\n")]);
    let said = folder.says("convert run.log run.mcap", 0);
    assert!(
        said.starts_with(
            "run.log: the time stamps go backwards 2 times, first at frame 2; the order of the frames is \
             kept\n"
        ),
        "{said}"
    );
    assert_eq!(said.lines().count(), 2, "{said}");
}

#[test]
fn an_output_that_exists_is_left_alone_unless_it_is_to_be_overwritten() {
    let folder = Folder::new(&[("run.log", LOG.as_bytes()), ("run.mcap", b"precious")]);
    assert_eq!(
        folder.refuses("convert run.log run.mcap", 2),
        "skinbus: run.mcap: the file exists: name another file, or add --overwrite"
    );
    assert_eq!(
        folder.refuses("convert run.log . --overwrite", 2),
        "skinbus: .: unknown file type: use .mcap for a recording, .log or .txt for a candump log, .csv for torques, .columns for \
         NumPy files, or - for standard output"
    );
    folder.says("convert run.log run.mcap --overwrite", 0);
    folder.says("convert run.mcap run.log --overwrite", 0);
    assert_eq!(folder.text("run.log"), LOG);
}

#[test]
fn what_makes_no_sense_is_refused() {
    let folder = Folder::new(&[("run.log", LOG.as_bytes())]);
    let usage = |arguments| folder.refuses(arguments, 2);
    assert!(usage("convert run.log run.asc").starts_with("skinbus: run.asc: unknown file type: use .mcap"));
    assert_eq!(
        usage("convert run.log run.mcap --plain"),
        "skinbus: --plain is only for a candump log: leave it out, because an MCAP recording keeps everything"
    );
    assert!(
        usage("convert run.log run.mcap --digits 9")
            .starts_with("skinbus: --digits is only for a candump log")
    );
    assert!(usage("convert run.log run.txt --digits 7").contains("[possible values: 6, 9]"));
    folder.says("convert run.log run.mcap", 0);
    assert_eq!(
        folder.refuses("convert run.mcap again.mcap", 2),
        "skinbus: run.mcap is already an MCAP recording: copy it instead"
    );
}

/// A recording of several chunks.
fn recording(folder: &Folder) -> Vec<u8> {
    let lines = (0..9_000_u64).map(|line| {
        let bits = line.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        format!("(1.{line:06}) can0 123##5{bits:016X}\n")
    });
    fs::write(folder.path("long.log"), lines.collect::<String>()).unwrap();
    folder.says("convert long.log long.mcap", 0);
    fs::read(folder.path("long.mcap")).unwrap()
}

#[test]
fn of_a_recording_without_its_end_all_that_is_there_is_converted_and_that_is_said() {
    let folder = Folder::new(&[]);
    let whole = recording(&folder);
    let segment = whole.get(..whole.len() / 2).unwrap();
    fs::write(folder.path("cut.mcap"), segment).unwrap();
    let said = folder.says("convert cut.mcap cut.log", 0);
    let expected = format!(
        "cut.mcap: its end is missing: it was cut off after {} bytes, or never finished\n",
        segment.len()
    );
    assert!(said.starts_with(&expected), "{said}");
    let (long, link_down) = (folder.text("long.log"), folder.text("cut.log"));
    assert!(
        long.starts_with(&link_down) && link_down.lines().count() > 2_000,
        "{} lines",
        link_down.lines().count()
    );
    let strict = folder.refuses("convert cut.mcap strict.log --strict", 1);
    let expected = expected.trim_end();
    assert_eq!(strict, format!("skinbus: {expected}; leave out --strict to write the intact part"));
}

#[test]
fn a_damaged_recording_is_refused_and_leaves_nothing() {
    let folder = Folder::new(&[]);
    let mut bytes = recording(&folder);
    let middle = bytes.len() / 2;
    bytes.get_mut(middle..middle + 9).unwrap().fill(0x55);
    fs::write(folder.path("bad.mcap"), &bytes).unwrap();
    let said = folder.refuses("convert bad.mcap bad.log", 1);
    assert!(
        said.starts_with("skinbus: bad.mcap is damaged: ")
            && said.contains(" notes before the damage were read; "),
        "{said}"
    );
    // The part before the damage can be converted to text.
    let Output { status, stdout, .. } = folder.gateway("convert bad.mcap -").output().unwrap();
    assert_eq!(status.code(), Some(1));
    let before = String::from_utf8(stdout).unwrap();
    assert!(folder.text("long.log").starts_with(&before) && before.lines().count() > 2_000);
}

#[test]
fn a_full_disk_is_said_and_a_reader_may_leave() {
    let folder = Folder::new(&[]);
    recording(&folder);
    for command in ["--help", "dump -h"] {
        let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let Output { status, stderr, .. } = folder.gateway(command).stdout(full).output().unwrap();
        let said = "skinbus: standard output: No space left on device (os error 28)\n";
        assert_eq!(
            (status.code(), String::from_utf8(stderr).unwrap().as_str()),
            (Some(1), said),
            "{command}"
        );
    }
    let said = folder.refuses("convert long.mcap /dev/full", 1);
    assert!(said.starts_with("skinbus: /dev/full: No space left on device"), "{said}");
    let mut child =
        folder.gateway("convert long.mcap -").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    assert_eq!((status.code(), String::from_utf8(stderr).unwrap().as_str()), (Some(0), ""));
}

/// Polls until a condition holds.
pub(crate) fn until(what: &str, mut so: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !so() {
        assert!(begun.elapsed() < Duration::from_secs(60), "{what} never came");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Returns true if a process catches SIGINT, by the kernel's report.
pub(crate) fn catches_interrupts(pid: u32) -> bool {
    let status =
        fs::read_to_string(Path::new("/proc").join(pid.to_string()).join("status")).unwrap_or_default();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
    caught.is_some_and(|mask| u64::from_str_radix(mask.trim(), 16).is_ok_and(|mask| mask & 2 != 0))
}

#[test]
fn a_live_capture_that_is_interrupted_is_whole() {
    let folder = Folder::new(&[]);
    let mut child =
        folder.gateway("convert - live.mcap").stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    until("the handler", || catches_interrupts(child.id()));
    let mut input = child.stdin.take().unwrap();
    input.write_all(LOG.as_bytes()).unwrap();
    until("the reading", || rustix::io::ioctl_fionread(&input).is_ok_and(|waiting| waiting == 0));
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    assert_eq!(String::from_utf8(stderr).unwrap(), "standard input -> live.mcap: 2 frames, 1 notes\n");
    assert_eq!(status.code(), Some(0));
    drop(input);
    folder.says("convert live.mcap live.log", 0);
    assert_eq!(folder.text("live.log"), LOG);
}

#[test]
fn lines_of_a_live_capture_are_handed_on_as_they_come() {
    let folder = Folder::new(&[]);
    let mut child = folder
        .gateway("convert - -")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut input = child.stdin.take().unwrap();
    let output = std::io::BufReader::new(child.stdout.take().unwrap());
    let (send, lines) = std::sync::mpsc::channel();
    let reading = std::thread::spawn(move || {
        for line in std::io::BufRead::lines(output) {
            send.send(line.unwrap()).unwrap();
        }
    });
    for line in LOG.lines() {
        writeln!(input, "{line}").unwrap();
        let back = lines.recv_timeout(Duration::from_secs(60));
        assert_eq!(back.as_deref(), Ok(line), "while the input goes on");
    }
    drop(input);
    assert_eq!(child.wait().unwrap().code(), Some(0));
    reading.join().unwrap();
}
