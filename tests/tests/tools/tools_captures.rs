//! Captures beside third-party tools: each reads our files, and we read its files.
//!
//! `tests/tools/install` installs the tools; `tests/run` does that, and then runs these tests.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fmt::Write as _;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use process::program;
use protocol::can::{FD_FORMAT, Format};
use protocol::candump::{Direction, Record};
use tempfile::TempDir;
use trace::capture::{CaptureEntry, NoteKind, Reader};

/// Frames of every kind that all tools read, on two buses, in candump's notation.
const PORTABLE: &str = "\
(1700000000.000001) vcan0 123#DEADBEEF
(1700000000.000002) can1 000#
(1700000000.000003) vcan0 7FF#1122334455667788
(1700000000.250000) vcan0 00000123#01
(1700000000.250001) can1 1FFFFFFF#0102
(1700000000.999999) can1 5A1#R
(1700000001.000000) vcan0 1F334455#R
(1700000001.000001) vcan0 210##500
(1700000001.000002) can1 210##4
(1700000001.000003) vcan0 210##7AABBCC
(1700000001.000004) vcan0 1F334455##5AA
(1700000001.000005) vcan0 20C##5001000F80100000000000000070175D6
(1700000001.000006) can1 7FE##5000102030405060708090A0B0C0D0E0F101112131415161718191A1B1C1D1E1F202122232425262728292A2B2C2D2E2F303132333435363738393A3B3C3D3E3F
";

/// Frames that only some tools read: error frames, lengths of remote frames, directions, 9 digits, raw DLCs, notes.
const RICH: &str = "\
# taken in the laboratory
(1700000000.000001) vcan0 123#DEADBEEF
(1700000000.000002003) can1 123#DEADBEEF
(1700000000.000003) can1 20000004#0001000000000000
(1700000000.000004) can1 123#R4 R
(1700000000.000005) can1 123#1122334455667788_E T
DROPCOUNT: dropped 12 CAN frames on 'can1' socket (total drops 40)
(1700000000.000006) can1 210##50102030405060708090A0B
(1700000000.000007) nonsense
";

/// A folder with the files for the tools.
struct Place(TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        fs::write(place.path("portable.log"), PORTABLE).unwrap();
        fs::write(place.path("rich.log"), RICH).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Returns the content that a tool prints; words with a dot are files in this folder.
    fn run(&self, tool: &Path, arguments: &str, input: Option<&str>) -> String {
        let mut command = Command::new(tool);
        command.args(arguments.split(' ').filter(|word| !word.is_empty())).current_dir(self.0.path());
        command.stdin(input.map_or_else(Stdio::null, |name| File::open(self.path(name)).unwrap().into()));
        let output = command.output().unwrap_or_else(|error| {
            panic!("{} cannot be run ({error}): tests/tools/install makes it ready", tool.display())
        });
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{tool:?} {arguments}: {}: {said}", output.status);
        String::from_utf8(output.stdout).unwrap()
    }

    fn gateway(&self, arguments: &str) -> String {
        self.run(&program("skinbus"), arguments, None)
    }

    fn debian(&self, tool: &str, arguments: &str) -> String {
        self.run(Path::new(tool), arguments, None)
    }

    /// Runs a program with the tools' Python.
    fn python(&self, arguments: &str) -> String {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/captures.py");
        self.run(&of_python("python"), &format!("{} {arguments}", script.display()), None)
    }
}

fn of_python(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/tools/bin").join(name);
    assert!(path.exists(), "{} is missing: tests/tools/install makes it ready", path.display());
    path
}

/// Calls `take` with each entry of a capture.
fn each(path: &Path, mut take: impl FnMut(&CaptureEntry<'_>)) {
    let mut reader = Reader::open(path).unwrap();
    while let Some(entry) = reader.next().unwrap() {
        take(&entry);
    }
    assert_eq!(reader.extras().unfinished, None);
}

fn frames<T>(path: &Path, mut of: impl FnMut(&Record<'_>) -> T) -> Vec<T> {
    let mut all = Vec::new();
    each(path, |entry| {
        if let CaptureEntry::Frame(record) = entry {
            all.push(of(record));
        }
    });
    all
}

fn hex(bytes: &[u8]) -> String {
    let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    if hex.is_empty() { "-".to_owned() } else { hex }
}

fn lines(text: &str) -> Vec<String> {
    text.lines().map(str::to_owned).collect()
}

/// Formats a frame as the script prints python-can's; fields that python-can does not have are left out.
fn of_can(record: &Record<'_>) -> String {
    let Record { time, interface, frame, .. } = record;
    let fd = frame.format() == Format::Fd;
    let flags = [frame.is_extended(), frame.is_remote(), fd, frame.flags() & 1 != 0, frame.flags() & 2 != 0];
    let flags: String = flags.map(|flag| if flag { '1' } else { '0' }).iter().collect();
    let (micros, id) = (time.nanos / 1_000, frame.id());
    format!("{micros} {interface} {id:X} {flags} {} {}", frame.len(), hex(frame.data()))
}

#[test]
#[ignore = "needs tests/tools/install"]
fn python_can_reads_our_log_and_we_read_its() {
    let place = Place::new();
    place.gateway("convert portable.log run.mcap");
    place.gateway("convert run.mcap ours.log --plain");
    let ours = frames(&place.path("ours.log"), of_can);
    assert_eq!(ours.len(), PORTABLE.lines().count());
    assert_eq!(lines(&place.python("can-read ours.log")), ours);

    place.python("can-copy ours.log theirs.log");
    assert_eq!(frames(&place.path("theirs.log"), of_can), ours);
    // It writes a direction, and no FDF.
    let theirs =
        frames(&place.path("theirs.log"), |record| (record.direction, record.frame.flags() & FD_FORMAT));
    assert!(theirs.iter().all(|of| *of == (Some(Direction::Received), 0)), "{theirs:?}");
    place.gateway("convert theirs.log theirs.mcap");
    place.gateway("convert theirs.mcap again.log");
    assert_eq!(fs::read(place.path("again.log")).unwrap(), fs::read(place.path("theirs.log")).unwrap());
}

#[test]
#[ignore = "needs tests/tools/install"]
fn log2asc_reads_our_log() {
    let place = Place::new();
    place.gateway("convert portable.log run.mcap");
    place.gateway("convert run.mcap ours.log");
    let asc = place.debian("log2asc", "-I ours.log vcan0 can1");
    let theirs: Vec<_> = asc.lines().filter(|line| line.contains(" Rx ")).collect();
    let ours = frames(&place.path("ours.log"), |record| {
        let id = format!("{:X}{}", record.frame.id(), if record.frame.is_extended() { "x" } else { "" });
        let data = record.frame.data().iter().map(|byte| format!(" {byte:02X}")).collect::<String>();
        let channel = if record.interface == "vcan0" { "1" } else { "2" };
        (id, channel, data, record.frame.is_remote(), record.frame.format() == Format::Fd)
    });
    assert_eq!(theirs.len(), ours.len(), "{asc}");
    for (line, (id, channel, data, remote, fd)) in theirs.iter().zip(ours) {
        let words: Vec<_> = line.split_whitespace().collect();
        assert!(words.contains(&id.as_str()), "{id} in {line}");
        assert_eq!((words[1] == "CANFD", words[if fd { 2 } else { 1 }]), (fd, channel), "{line}");
        assert_eq!(words.contains(&"r"), remote, "{line}");
        assert!(line.contains(&data), "{data} in {line}");
    }
}

#[test]
#[ignore = "needs tests/tools/install"]
fn tshark_reads_our_log() {
    let place = Place::new();
    // The log contains an error frame as well.
    let error = "(1700000002.000000) vcan0 20000004#0001000000000000\n";
    fs::write(place.path("more.log"), format!("{PORTABLE}{error}")).unwrap();
    place.gateway("convert more.log run.mcap");
    place.gateway("convert run.mcap ours.log --plain");
    let fields = "frame.time_epoch can.id can.flags.xtd can.flags.rtr can.flags.err canfd.flags.brs canfd.flags.esi can.len data.data";
    let fields: String = fields.split(' ').map(|field| format!(" -e {field}")).collect();
    let theirs = lines(&place.debian("tshark", &format!("-r ours.log -T fields{fields}")));
    let bit = |set: bool| if set { "1" } else { "0" };
    let ours = frames(&place.path("ours.log"), |Record { time, frame, .. }| {
        let (fd, flags) = (frame.format() == Format::Fd, frame.flags());
        let seconds = format!("{}.{:09}", time.nanos / 1_000_000_000, time.nanos % 1_000_000_000);
        if frame.is_error() {
            // It shows the classes of the error instead.
            return format!("{seconds}\t\t\t\t1\t\t\t{}\t", frame.len());
        }
        let (classic, fd) = (|set| if fd { "" } else { bit(set) }, |set| if fd { bit(set) } else { "" });
        let mut line = format!("{seconds}\t{}", frame.id());
        for field in [
            bit(frame.is_extended()),
            classic(frame.is_remote()),
            classic(false),
            fd(flags & 1 != 0),
            fd(flags & 2 != 0),
        ] {
            write!(line, "\t{field}").unwrap();
        }
        write!(line, "\t{}\t{}", frame.len(), hex(frame.data()).replace('-', "")).unwrap();
        line
    });
    assert_eq!(theirs, ours);
}

#[test]
#[ignore = "needs tests/tools/install"]
fn cantools_decodes_our_log_by_our_dbc() {
    let place = Place::new();
    fs::write(place.path("skin.toml"), place.gateway("skin generate --cells 12")).unwrap();
    fs::write(place.path("skin.dbc"), place.gateway("skin dbc skin.toml")).unwrap();
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../protocol/tests/golden/document.log");
    fs::copy(golden, place.path("golden.log")).unwrap();
    place.gateway("convert golden.log run.mcap");
    place.gateway("convert run.mcap ours.log --plain");
    let decoded = place.run(&of_python("cantools"), "decode --single-line skin.dbc", Some("ours.log"));
    let ours = frames(&place.path("ours.log"), |record| record.to_string());
    let theirs: Vec<_> = decoded.lines().filter_map(|line| line.split_once(" :: ")).collect();
    assert_eq!(theirs.iter().map(|(frame, _)| *frame).collect::<Vec<_>>(), ours);
    let torque = "torque_12(torque_1: 1.0 Nm, torque_2: -0.5 Nm, torque_3: 0.000244140625 Nm,";
    assert!(theirs[0].1.starts_with(torque), "{:?}", theirs[0]);
    let unknown: Vec<_> = theirs.iter().filter(|(_, words)| words.contains("Unknown frame id")).collect();
    assert!(unknown.is_empty(), "{unknown:?}");
}

#[test]
#[ignore = "needs tests/tools/install"]
fn what_each_tool_reads_beyond_that_is_as_docs_captures_says() {
    let place = Place::new();
    let script = format!("{}/tools/captures.py can-read odd.log", env!("CARGO_MANIFEST_DIR"));
    let tools = [
        (PathBuf::from("log2asc"), "-I odd.log vcan0".to_owned(), [" Rx ", " Tx "], "0.000003"),
        (of_python("python"), script, ["1700000000000001 ", "1700000000000004 "], "1700000000000004"),
        (
            PathBuf::from("tshark"),
            "-r odd.log -T fields -e frame.time_epoch".to_owned(),
            ["1700000000.", "-"],
            ".000004",
        ),
    ];
    // The first two frames of the portable subset, and one more entry; the flag tells if the tool reads both at their
    // times.
    let odd = [
        (
            "directions",
            "(1700000000.000001) vcan0 123#11 R\n(1700000000.000004) vcan0 123#11 T\n",
            [true, true, false],
        ),
        (
            "notes",
            "(1700000000.000001) vcan0 123#11\n# a\n(1700000000.000004) vcan0 123#11\n",
            [true, false, false],
        ),
        (
            "nine digits",
            "(1700000000.000001000) vcan0 123#11\n(1700000000.000004000) vcan0 123#11\n",
            [false, true, false],
        ),
        (
            "odd lengths",
            "(1700000000.000001) vcan0 123##411\n(1700000000.000004) vcan0 123##40102030405060708090A0B\n",
            [true, true, false],
        ),
    ];
    for (what, log, expected) in odd {
        fs::write(place.path("odd.log"), log).unwrap();
        for ((tool, arguments, marks, last), expected) in tools.iter().zip(expected) {
            let mut command = Command::new(tool);
            command.args(arguments.split(' ')).current_dir(place.0.path());
            let output = command.output().unwrap_or_else(|error| panic!("{}: {error}", tool.display()));
            let text = String::from_utf8_lossy(&output.stdout);
            let frames: Vec<_> =
                text.lines().filter(|line| marks.iter().any(|mark| line.contains(mark))).collect();
            let both = output.status.success() && frames.len() == 2 && frames[1].contains(last);
            assert_eq!(both, expected, "{}, {what}: {text}", tool.display());
        }
    }
}

/// Returns everything in a recording as the script prints it, with the digits of its channels.
fn of_ros(path: &Path) -> Vec<String> {
    let stamp = |nanos: u64| format!("{nanos} {}.{:09}", nanos / 1_000_000_000, nanos % 1_000_000_000);
    let mut all = Vec::new();
    let mut first = None;
    each(path, |entry| {
        if let CaptureEntry::Frame(record) = entry {
            first = first.or(Some(record.time.nanos));
        }
    });
    each(path, |entry| {
        all.push(match entry {
            CaptureEntry::Frame(Record { time, interface, frame, direction }) => {
                let flags =
                    [frame.is_extended(), frame.is_remote(), frame.is_error(), frame.format() == Format::Fd];
                let flags: String = flags.map(|flag| if flag { '1' } else { '0' }).iter().collect();
                let direction = match direction {
                    None => 0,
                    Some(Direction::Received) => 1,
                    Some(Direction::Sent) => 2,
                };
                format!(
                    "/can/{interface} {} {interface} {:X} {flags} {} {} {} {direction} {}",
                    stamp(time.nanos),
                    frame.id(),
                    frame.flags(),
                    frame.len(),
                    frame.raw_dlc(),
                    hex(frame.data())
                )
            }
            CaptureEntry::Note(note) => {
                // Notes before the first frame are stored under its time.
                let nanos = if note.nanos == 0 { first.unwrap() } else { note.nanos };
                let bus = if note.interface.is_empty() { "-" } else { note.interface };
                let (kind, frames, text, bytes) = match &note.kind {
                    NoteKind::Text => (0, 0, note.text, &[][..]),
                    NoteKind::Dropped(frames) => (1, *frames, note.text, &[][..]),
                    NoteKind::CanXl => (2, 0, note.text, &[][..]),
                    NoteKind::Unreadable(why) => (3, 0, why.as_bytes(), note.text),
                };
                let (line, text, bytes) = (note.line, hex(text), hex(bytes));
                format!("/can/notes {} {bus} {kind} {frames} {line} {text} {bytes}", stamp(nanos))
            }
        });
    });
    all
}

fn sorted(mut lines: Vec<String>) -> Vec<String> {
    lines.sort();
    lines
}

#[test]
#[ignore = "needs tests/tools/install"]
fn the_mcap_library_and_rosbags_read_every_field_of_our_recording() {
    let place = Place::new();
    for name in ["portable", "rich"] {
        place.gateway(&format!("convert {name}.log {name}.mcap"));
        let ours = of_ros(&place.path(&format!("{name}.mcap")));
        assert_eq!(
            ours.len(),
            fs::read_to_string(place.path(&format!("{name}.log"))).unwrap().lines().count()
        );
        assert_eq!(lines(&place.python(&format!("mcap-read {name}.mcap"))), ours);
        // It sorts by time, with an order of its own at equal times.
        assert_eq!(sorted(lines(&place.python(&format!("bag-read {name}.mcap")))), sorted(ours));
    }
}

#[test]
#[ignore = "needs tests/tools/install"]
fn we_read_recordings_that_other_libraries_write() {
    let place = Place::new();
    place.gateway("convert rich.log ours.mcap");
    place.gateway("convert ours.mcap nine.log --digits 9");
    let expected = fs::read_to_string(place.path("nine.log")).unwrap();
    assert_eq!(expected.lines().count(), RICH.lines().count());
    for packing in ["none", "lz4", "zstd"] {
        place.python(&format!("mcap-copy ours.mcap {packing}.mcap {packing}"));
        place.gateway(&format!("convert {packing}.mcap {packing}.log --direction"));
        assert_eq!(fs::read_to_string(place.path(&format!("{packing}.log"))).unwrap(), expected, "{packing}");
    }
    place.python("mcap-loose ours.mcap loose.mcap");
    place.gateway("convert loose.mcap loose.log --direction");
    assert_eq!(fs::read_to_string(place.path("loose.log")).unwrap(), RICH);
}
