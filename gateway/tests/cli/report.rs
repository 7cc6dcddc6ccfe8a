//! `skinbus report` as a process: errors for files that are not recordings of a run, and the files on disk afterwards.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use tempfile::TempDir;
use trace::capture::{Reader, SKIN_ATTACHMENT};

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

/// The one-line error of a report that writes no file.
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
    let made =
        "record one with `skinbus run SKIN --record run.mcap`, or name the skin of a capture with --skin";
    assert_eq!(refuses(&folder, "empty.mcap", 2), format!("empty.mcap contains no run: it is empty; {made}"));
    assert_eq!(
        refuses(&folder, "foreign.mcap", 2),
        format!("foreign.mcap contains no run: it has no attachment skin.toml; {made}")
    );
    let begun = refuses(&folder, "begun.mcap", 1);
    assert!(
        begun.starts_with(
            "begun.mcap contains no run that can be shown: it has no attachment skin.toml (its end is missing"
        ),
        "{begun}"
    );
    assert_eq!(
        refuses(&folder, "run.log", 2),
        "run.log is a candump log, which contains only frames: name the skin with --skin, or make a recording, which \
         contains the skin, with `skinbus run SKIN --record run.mcap`"
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
    let exists = "-o run.html: the file exists: name another file, or add --overwrite";
    assert_eq!(refuses(&folder, "run.mcap", 2), exists);
    let itself = refuses(&folder, "run.mcap -o run.mcap --overwrite", 2);
    assert_eq!(itself, "-o run.mcap is also an input of this command: name another file for the output");
    let rate = refuses(&folder, "run.mcap -o new.html --nominal fast", 2);
    assert!(rate.contains("--nominal") && rate.contains("not a bit rate"), "{rate}");
    assert_eq!(fs::read_to_string(folder.path().join("run.html")).unwrap(), "mine");
}

/// A directory with the log and the recording of one run, and its skin.
fn recorded() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let recordings = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/recordings");
    for name in ["classic.log", "classic.mcap", "sums.log", "fd.mcap"] {
        fs::copy(recordings.join(name), folder.path().join(name)).unwrap();
    }
    for name in ["classic", "sums"] {
        let mut reader = Reader::open(&recordings.join(format!("{name}.mcap"))).unwrap();
        reader.next().unwrap();
        let attached = &reader.extras().attachments;
        let (_, skin) = attached.iter().find(|(attachment, _)| attachment == SKIN_ATTACHMENT).unwrap();
        fs::write(folder.path().join(format!("{name}.toml")), skin).unwrap();
    }
    folder
}

/// The page on standard output, and standard error.
fn page(folder: &TempDir, arguments: &str) -> (String, String) {
    let Output { status, stdout, stderr } = gateway(folder.path(), &format!("report {arguments} -o -"));
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(0), "{said}");
    let page = String::from_utf8(stdout).unwrap();
    // Remove the marks that keep command options in one line.
    (page.replace("<span>", "").replace("</span>", ""), said)
}

/// A table of a page, by its title.
fn table<'a>(page: &'a str, title: &str) -> &'a str {
    let (_, rest) = page.split_once(&format!("<h3>{title}")).unwrap();
    rest.split("</table>").next().unwrap()
}

/// Cells of the first row that begins with a text.
fn row<'a>(table: &'a str, first: &str) -> Vec<&'a str> {
    let row = table.split("<tr>").find(|row| row.contains(&format!(">{first}</td>"))).unwrap();
    row.split("</td>").filter_map(|cell| cell.rsplit('>').next()).collect()
}

#[test]
fn a_log_gives_the_accounts_of_the_recording_of_the_same_run_and_names_what_it_lacks() {
    let folder = recorded();
    let before = names(folder.path());
    let (of_run, said) = page(&folder, "classic.mcap");
    assert_eq!(said, "");
    let lacks =
        "joint velocities; ticks and cycle times; the scenario; the command, program and machine of the run";
    let (of_log, said) = page(&folder, "classic.log --skin classic.toml");
    assert_eq!(said, format!("skinbus: classic.log: the capture does not contain: {lacks}\n"));
    assert_eq!(names(folder.path()), before, "-o - writes no file");
    for title in ["Absolute torque errors by joint", "Torque formats: "] {
        assert_eq!(table(&of_log, title), table(&of_run, title));
    }
    let replies = |page: &str| row(table(page, "Replies by bus"), "vcan0")[..7].join(" ");
    assert_eq!(replies(&of_log), replies(&of_run));
    for text in [
        format!("This capture does not contain: {lacks}."),
        "This capture does not contain joint velocities, because joints frames contain only positions."
            .to_owned(),
        "This capture does not contain the durations of ticks and of the central computation".to_owned(),
        "This capture does not contain the counts of skipped ticks and bad cycles.".to_owned(),
        "skinbus view classic.log --skin classic.toml --at ".to_owned(),
    ] {
        assert!(of_log.contains(&text), "{text}");
        assert!(!of_run.contains(&text), "{text}");
    }
    for figure in
        ["positions", "torque-joint1", "torque-error", "touches", "map-force", "active-cells", "load-vcan0"]
    {
        for page in [&of_log, &of_run] {
            assert!(page.contains(&format!("id=\"{figure}\"")), "{figure}");
        }
    }
    for of_loop in [
        "id=\"velocities\"",
        "id=\"cycle-",
        "The control loop",
        "control loop",
        "ticks skipped by",
        "unknown,",
    ] {
        assert!(!of_log.contains(of_loop), "{of_loop}");
    }

    assert!(gateway(folder.path(), "convert classic.log foreign.mcap").status.success());
    let (foreign, said) = page(&folder, "foreign.mcap --skin classic.toml");
    assert_eq!(said, format!("skinbus: foreign.mcap: the capture does not contain: {lacks}\n"));
    assert_eq!(replies(&foreign), replies(&of_log));
    let (sums, said) = page(&folder, "sums.log --skin sums.toml");
    assert!(
        said.contains("the capture does not contain: joint velocities; ")
            && sums.contains("id=\"positions\""),
        "{said}"
    );
}

#[test]
fn a_log_without_stimuli_does_not_say_that_nothing_was_touched() {
    let folder = recorded();
    let log = fs::read_to_string(folder.path().join("classic.log")).unwrap();
    // Kind 7 is the stimuli.
    let is_stimulus = |line: &&str| line.split(' ').nth(2).is_some_and(|frame| frame.starts_with('7'));
    assert!(log.lines().any(|line| is_stimulus(&line)));
    let rest: String =
        log.lines().filter(|line| !is_stimulus(line)).map(|line| format!("{line}\n")).collect();
    fs::write(folder.path().join("rest.log"), rest).unwrap();
    let (page, said) = page(&folder, "rest.log --skin classic.toml");
    assert!(
        said.contains("does not contain: stimuli or sensors, and therefore no central torques; "),
        "{said}"
    );
    for text in [
        "This capture does not contain the stimuli or sensors of the cells that sent torques, which show the forces \
         on them.",
        "This capture does not contain the stimuli or sensors from which central torques are computed.",
        "This capture does not contain the stimuli or sensors of all cells, which show which cells are in contact.",
    ] {
        assert!(page.contains(text), "{text}");
    }
    assert!(!page.contains("The frames show no touch of a cell") && !page.contains("No cell was in contact"));
    assert!(page.contains("id=\"torque-joint1\"") && !page.contains("id=\"torque-error\""));
}

#[test]
fn a_log_of_something_else_and_another_skin_than_the_recorded_one_are_refused() {
    let folder = recorded();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    write("other.log", "(1.000001) can7 123#11\n");
    write("untimed.log", "  vcan0  201   [2]  11 22\n");
    write("words.log", "nothing\n");
    write("empty.log", "");
    for (arguments, said) in [
        (
            "other.log",
            "other.log has no frame of the skin's buses (vcan0): its frames are from can7; name the skin that has this bus",
        ),
        (
            "untimed.log",
            "untimed.log has lines without time stamps, which a report needs: make the log with `candump -L`",
        ),
        ("words.log", "words.log contains no frame: expected a log as `candump -L` writes it"),
        (
            "empty.log",
            "empty.log contains no run: it is empty; record one with `skinbus run SKIN --record run.mcap`",
        ),
        ("nowhere.log", "nowhere.log: "),
        (
            "fd.mcap",
            "fd.mcap was recorded with a skin that differs from sums.toml (cells: 5, recorded: 3): leave out \
             --skin, because the recording contains its skin",
        ),
    ] {
        let refused = refuses(&folder, &format!("{arguments} --skin sums.toml -o out.html"), 2);
        assert!(refused.starts_with(said), "{arguments}: {refused}");
        assert!(!refused.ends_with("of a capture with --skin"), "it was given: {refused}");
    }
    // A skin would not help.
    write("a.dbc", "VERSION \"1.0\"\n\nNS_:\n\nBS_:\n");
    assert!(refuses(&folder, "a.dbc -o out.html", 2).starts_with("a.dbc is a DBC file, "));
    let missing = refuses(&folder, "classic.log --skin nowhere.toml", 2);
    assert!(missing.starts_with("nowhere.toml: "), "{missing}");
    // The recording has the same skin.
    let (with, _) = page(&folder, "classic.mcap --skin classic.toml");
    let (without, _) = page(&folder, "classic.mcap");
    assert_eq!(with.replace(" --skin classic.toml", ""), without);
}
