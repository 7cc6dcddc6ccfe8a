//! Recordings damaged in many ways, by chance and on purpose, through every command that reads one: each command ends
//! with exit code 0, 1 or 2, in bounded memory. `SKINBUS_MUTATIONS=10000` runs that many files instead of a few.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

mod mutate;
mod places;
mod seeds;

use std::fs::{self, File};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use rand_pcg::Pcg64Mcg;

/// Number of files of the quick tests.
const QUICK: u64 = 24;
/// A time that only a hanging program needs.
const TIMEOUT: Duration = Duration::from_secs(120);
/// Address space of a command in KiB. Reserved but unused memory counts here too.
const ADDRESS_SPACE_KIB: &str = "400000";

/// All commands that read a recording.
const COMMANDS: &[&str] = &[
    "dump FILE",
    "dump FILE --stats",
    "dump FILE --json --contact",
    "convert FILE - --direction",
    "report FILE -o OUT.html --overwrite",
    "fit FILE",
    "fit FILE --json --ber 0.0001",
    "explain FILE --epoch 7",
    "explain FILE --epoch 2 --skin skin.toml",
    "replay FILE --bus-kind embedded --expect",
    "recover FILE -o OUT.mcap --overwrite",
];

/// Runs a command without a terminal and with little address space. Returns its status and its messages.
fn run(folder: &Path, line: &str) -> (ExitStatus, String) {
    let said = File::create(folder.join("said")).unwrap();
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -v $1 && shift && exec \"$@\"", "sh", ADDRESS_SPACE_KIB]);
    command.arg(env!("CARGO_BIN_EXE_skinbus")).args(line.split(' '));
    command.current_dir(folder).env("SKINBUS_DIR", folder.join("bus")).env("RUST_BACKTRACE", "0");
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(said).spawn().unwrap();
    let began = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if began.elapsed() > TIMEOUT {
            child.kill().unwrap();
            break child.wait().unwrap();
        }
        thread::sleep(Duration::from_millis(1));
    };
    (status, String::from_utf8_lossy(&fs::read(folder.join("said")).unwrap()).into_owned())
}

/// Runs the commands on a file. With `SKINBUS_MUTATIONS_DIR`, only writes the files there, to try other programs with
/// them.
fn passes(folder: &Path, what: &str, file: &[u8], commands: &[&str]) {
    if let Some(there) = std::env::var_os("SKINBUS_MUTATIONS_DIR") {
        let name: String = what.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        return fs::write(Path::new(&there).join(format!("{name}.mcap")), file).unwrap();
    }
    fs::write(folder.join("m.mcap"), file).unwrap();
    for line in commands {
        let line = line.replace("FILE", "m.mcap").replace("OUT", "out");
        let began = Instant::now();
        let (status, said) = run(folder, &line);
        let bad = !matches!(status.code(), Some(0..=2)) || said.contains("panicked");
        if bad {
            let kept = std::env::temp_dir().join("mutated.mcap");
            fs::write(&kept, file).unwrap();
            panic!(
                "{what}: gateway {line}: exit code {:?}, signal {:?}, {:.1} s, kept as {}: {}",
                status.code(),
                status.signal(),
                began.elapsed().as_secs_f64(),
                kept.display(),
                said.get(..said.len().min(2_000)).unwrap_or_default()
            );
        }
    }
}

/// Number of commands that run at once: replaying commands mostly wait.
const MAX_PARALLEL: usize = 8;

#[test]
fn whatever_a_recording_is_every_command_ends_and_says_why() {
    let skin = seeds::skin();
    let seeds = seeds::all(&skin);
    let count = std::env::var("SKINBUS_MUTATIONS").map_or(QUICK, |count| count.parse().unwrap());
    let whole = seeds.iter().map(|(name, seed)| ((*name).to_owned(), seed.clone()));
    let damaged = (0..count).map(|number| {
        let mut chance = Pcg64Mcg::new(u128::from(number).wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        let (name, seed) = &seeds[usize::try_from(number).unwrap() % seeds.len()];
        let (how, file) = mutate::mutated(seed, &mut chance);
        (format!("{number}, {name}, {how}"), file)
    });
    let files = Mutex::new(whole.chain(damaged));
    thread::scope(|scope| {
        for _ in 0..MAX_PARALLEL {
            scope.spawn(|| {
                let folder = tempfile::tempdir().unwrap();
                fs::write(folder.path().join("skin.toml"), &skin).unwrap();
                // The lock is held while a file is made, which does not panic.
                let next = || files.lock().unwrap().next();
                while let Some((what, file)) = next() {
                    passes(folder.path(), &what, &file, COMMANDS);
                }
            });
        }
    });
}

#[test]
fn a_report_finds_the_skin_behind_the_messages() {
    let folder = tempfile::tempdir().unwrap();
    for (name, seed) in seeds::all(&seeds::skin()) {
        fs::write(folder.path().join("m.mcap"), seed).unwrap();
        let (status, said) = run(folder.path(), "report m.mcap --overwrite");
        let of_a_run = !["converted", "another bridge's"].contains(&name);
        assert_eq!(status.success(), of_a_run, "{name}: {said}");
    }
}

#[test]
fn files_that_unpack_to_far_more_than_they_are_end_in_bounded_memory() {
    let folder = tempfile::tempdir().unwrap();
    let skin = seeds::skin();
    fs::write(folder.path().join("skin.toml"), &skin).unwrap();
    for (name, bomb) in seeds::bombs(&skin) {
        assert!(bomb.len() <= 1 << 20, "{name}: {}", bomb.len());
        passes(folder.path(), name, &bomb, COMMANDS);
    }
}
