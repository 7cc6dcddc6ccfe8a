//! File names that are not UTF-8, for each command that takes a file.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use protocol::can::Format;
use protocol::candump::{Direction, Record, Timestamp};
use protocol::message::{Joints, Message};
use protocol::packet::Epoch;
use tempfile::TempDir;
use trace::recording::file::FileWriter;

use super::{golden, output, text};

/// Words of a command that takes a file, its exit code, and the files that it writes. `@x` names a file that is not
/// UTF-8; `~` is a blank in a word. A command has one row for each file that it takes.
const COMMANDS: &[(&str, i32, &[&str])] = &[
    ("dump @c.log", 0, &[]),
    ("dump @run.mcap --skin @skin.toml -n 3", 0, &[]),
    ("convert @c.log @new.mcap", 0, &["new.mcap"]),
    ("convert @run.mcap @new.log", 0, &["new.log"]),
    ("recover @torn.mcap -o @whole.mcap", 0, &["whole.mcap"]),
    ("explain @run.mcap --epoch 3", 0, &[]),
    ("report @run.mcap", 0, &["run.html"]),
    ("report @run.mcap -o @page.html --svg @figures", 0, &["page.html", "figures"]),
    ("skin dbc @skin.toml -o @skin.dbc", 0, &["skin.dbc"]),
    ("fit @c.log --nominal 1M --data 5M", 0, &[]),
    ("fit @skin.toml", 0, &[]),
    ("check @skin.toml", 0, &[]),
    ("compare @run.mcap @run.mcap", 0, &[]),
    ("completions bash", 0, &[]),
    ("man @pages", 2, &[]),
    ("skin show @skin.toml -o @skin.html", 0, &["skin.html"]),
    ("skin urdf @skin.toml -o @skin.urdf", 0, &["skin.urdf"]),
    ("skin generate --cells 8 -o @other.toml", 0, &["other.toml"]),
    ("skin import @arm.urdf --tip hand -o @arm.toml", 0, &["arm.toml"]),
    ("check @scenario.toml --skin @skin.toml", 0, &[]),
    ("explain @skin.toml --cell 1 --joints 0~0~0~0~0~0 --force 5", 0, &[]),
    ("explain @skin.toml --batch @rows.csv", 2, &[]),
    ("experiment fig9 --quick -q -o @results", 0, &["results"]),
    // Without a bus, the commands fail only after reading their files.
    ("calibrate @skin.toml --dry-run", 0, &[]),
    ("calibrate @skin.toml --recording @run.mcap -o @found.toml --page @found.html", 2, &[]),
    ("calibrate @skin.toml --recording @run.mcap --data-sheet @sheet.toml", 2, &[]),
    ("view @nothing.mcap", 2, &[]),
    ("replay @run.mcap --skin @skin.toml --summary @summary.json", 2, &[]),
    (
        "run @skin.toml --scenario @scenario.toml --record @new.mcap --candump @new.log --summary @s.json",
        2,
        &[],
    ),
    ("demo --duration 1 --candump @demo.log --record @demo.mcap --summary @demo.json", 2, &[]),
    ("commission @skin.toml --node-ids @ids.toml", 2, &[]),
    ("conformance --bus vcan0 --bus-kind embedded --cell 3 --save @saved.json --junit @cell.xml", 2, &[]),
    ("conformance --bus vcan0 --bus-kind embedded --cell 3 --restore @saved.json", 2, &[]),
    ("cells vcan0 --bus-kind embedded --skin @skin.toml", 2, &[]),
    ("frame resume --skin @skin.toml --bus-kind embedded", 2, &[]),
];

/// Commands that take no file.
const WITHOUT: &[&str] = &["frame", "sensing", "help"];

/// Names of the commands in a help text.
fn commands(help: &str) -> Vec<String> {
    // The program's own commands are in groups, before its options.
    let is_end = |line: &&str| !line.starts_with("Options:");
    let listed = help.lines().skip_while(|line| !line.starts_with("Usage:")).take_while(is_end);
    let is_of_arguments = help.contains("\nArguments:\n");
    let named =
        listed.filter(|_| !is_of_arguments).filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    named.filter_map(|line| Some(line.split_whitespace().next()?.to_owned())).collect()
}

fn gateway(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    // On any machine: no bus can be served or attached to.
    command.current_dir(folder).env("NO_COLOR", "1").env("SKINBUS_DIR", "/nowhere/skinbus");
    command
}

/// A name that is not UTF-8, with the same extension.
fn odd(name: &str) -> OsString {
    let mut whole = OsStr::from_bytes(b"n\xff-").to_owned();
    whole.push(name);
    whole
}

/// A word of a row.
fn word(word: &str) -> OsString {
    word.strip_prefix('@').map_or_else(|| word.replace('~', " ").into(), odd)
}

struct Place(TempDir);

impl Place {
    /// Creates a directory with all files that are read.
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        let skin =
            model::generate::generate(&model::generate::SkinRequest { cells: 8, ..Default::default() })
                .unwrap();
        fs::write(place.path("skin.toml"), &skin).unwrap();
        fs::write(place.path("scenario.toml"), "duration_s = 1\n").unwrap();
        fs::copy(golden("session.log"), place.path("c.log")).unwrap();
        fs::copy(format!("{}/examples/panda.urdf", env!("CARGO_MANIFEST_DIR")), place.path("arm.urdf"))
            .unwrap();
        let mut mcap = FileWriter::new(fs::File::create(place.path("run.mcap")).unwrap()).unwrap();
        mcap.attach("skin.toml", "application/toml", 7, skin.as_bytes()).unwrap();
        let mut topic = mcap.channel::<Record<'_>>("/can/vcan0", &[]).unwrap();
        for epoch in 0..60_u8 {
            let nanos = 1_000_000_000 + u64::from(epoch) * 16_000_000;
            let joints = Joints { positions: Default::default(), in_use: 6 };
            let message = Message::Joints { epoch: Epoch(epoch), joints };
            for frame in message.encode().frames(Format::Fd) {
                let (time, direction) = (Timestamp::with_nine_digits(nanos), Some(Direction::Received));
                mcap.write(&mut topic, nanos, &Record { time, interface: "vcan0", frame, direction })
                    .unwrap();
            }
        }
        mcap.finish().unwrap();
        let whole = fs::read(place.path("run.mcap")).unwrap();
        fs::write(place.path("torn.mcap"), &whole[..whole.len() - 100]).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(odd(name))
    }
}

#[test]
fn each_command_takes_names_that_are_not_utf_8() {
    let place = Place::new();
    let mut wrong = Vec::new();
    for (words, code, written) in COMMANDS {
        let mut command = gateway(place.0.path());
        command.args(words.split(' ').map(word));
        let Output { status, stderr, .. } = command.output().unwrap();
        let said = text(&stderr);
        if status.code() != Some(*code) || said.contains("panicked") {
            wrong.push(format!("{words}: {status}, {said}"));
        }
        for name in *written {
            let path = place.path(name);
            if !path.exists() {
                wrong.push(format!("{words}: no {}", path.display()));
            } else if path.is_dir() {
                fs::remove_dir_all(path).unwrap();
            } else {
                fs::remove_file(path).unwrap();
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn no_command_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let help = |words: &[&str]| {
        let mut command = gateway(folder.path());
        command.args(words).arg("--help");
        output(command)
    };
    let mut all = Vec::new();
    for name in commands(&help(&[])) {
        let below = if WITHOUT.contains(&name.as_str()) { Vec::new() } else { commands(&help(&[&name])) };
        let below = below.into_iter().filter(|below| below != "help");
        let before = all.len();
        all.extend(below.map(|below| format!("{name} {below}")));
        if all.len() == before {
            all.push(name);
        }
    }
    assert!(all.len() > 20, "{all:?}");
    let is_there = |name: &&String| {
        let named = COMMANDS.iter().any(|(words, ..)| words.starts_with(&format!("{name} ")));
        named || WITHOUT.contains(&name.as_str())
    };
    let missing: Vec<_> = all.iter().filter(|name| !is_there(name)).collect();
    assert!(missing.is_empty(), "add a row for {missing:?}");
}

/// The command line is repeated as a shell reads it.
#[test]
fn results_have_the_command_as_it_can_be_typed_again() {
    let place = Place::new();
    let run = |words: &[&OsStr]| {
        let mut command = gateway(place.0.path());
        assert_eq!(command.args(words).output().unwrap().status.code(), Some(0));
    };
    let results = odd("results");
    run(&[OsStr::new("experiment"), OsStr::new("fig9"), OsStr::new("--quick"), OsStr::new("-qo"), &results]);
    let page = fs::read_to_string(place.path("results").join("report.html")).unwrap();
    assert!(
        page.contains(r"-qo $&#39;n\xff-results&#39;") || page.contains(r"-qo $'n\xff-results'"),
        "{page}"
    );
}

/// If the system starts no thread, commands report it or work without.
#[test]
fn without_threads_no_command_panics() {
    let place = Place::new();
    for words in [
        "dump @c.log",
        "convert @c.log @new.mcap",
        "report @run.mcap --overwrite",
        "calibrate @skin.toml --dry-run",
        "calibrate @skin.toml --recording @run.mcap",
        "view @run.mcap --listen 127.0.0.1:0",
        "experiment list",
    ] {
        let mut command = gateway(place.0.path());
        // A stack that does not fit into the address space.
        command.env("RUST_MIN_STACK", (1_u64 << 48).to_string());
        command.args(words.split(' ').map(word));
        let Output { status, stderr, .. } = command.output().unwrap();
        assert!(matches!(status.code(), Some(0..=2)), "{words}: {status}, {}", text(&stderr));
        assert!(!text(&stderr).contains("panicked"), "{words}: {}", text(&stderr));
    }
}
