//! Benches of real processes on a bus of their own, embedded or in a real kernel: the common parts of these tests.
//!
//! These tests do not wait for a fixed time: conditions are polled until they hold, or until [`TIMEOUT`] is over, which
//! a slow machine never reaches and a hanging program does.
#![allow(
    missing_docs,
    missing_debug_implementations,
    clippy::missing_errors_doc,
    clippy::missing_panics_doc,
    clippy::new_without_default,
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::wildcard_enum_match_arm,
    reason = "what tests share: it may stop, and short helpers explain themselves"
)]

pub mod browser;
pub mod buses;
pub mod controlled;
pub mod external;
pub mod log;
pub mod page;
mod place;
pub mod readme;
pub mod recorded;
pub mod replay;
mod running;
pub mod served;
pub mod setup;
pub mod slcan;
mod summary;
pub mod sums;
pub mod test_client;
pub mod vcan;
pub mod viewer;
pub mod whole;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant, SystemTime};

use model::generate::{Format, SkinRequest, generate};
use rustix::process::{Pid, Signal, kill_process};

use running::proc;

pub use place::TestDir;
pub use running::{Ended, Running};
pub use summary::Summary;

/// The time limit for operations that should finish at once.
pub const TIMEOUT: Duration = Duration::from_secs(60);

/// A scenario that presses every cell, harder and softer, while the arm stands still; it lasts longer than any machine
/// needs for a test.
pub const PRESSED: &str = r#"version = 1
duration_s = 600.0

[motion]
kind = "hold"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]

[[mode]]
at_s = 0.0
kind = "compare"

[[touch]]
at_s = 0.0
for_s = 600.0
all = true
force_n = 1.5
profile = "step"
"#;

/// Polls until `look` returns a value, and returns it; panics with `what` after [`TIMEOUT`].
pub fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let give_up = Instant::now() + TIMEOUT;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < give_up, "not there after {TIMEOUT:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Finds a program under test, `skinbus`, `cell-node` or `vcan-setup`: beside this test program, or in the folder that
/// `SKINBUS_PROGRAMS` names.
///
/// # Panics
///
/// Panics if the program is missing, or older than a source that it was built from; the message names the command that
/// builds it.
pub fn program(name: &str) -> PathBuf {
    static CHECKED: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());
    let named = std::env::var_os("SKINBUS_PROGRAMS").map(PathBuf::from);
    let own = std::env::current_exe().unwrap();
    let beside = own.parent().and_then(Path::parent).expect("tests lie in target/PROFILE/deps");
    let folder = named.as_deref().unwrap_or(beside);
    let path = folder.join(name);
    if CHECKED.lock().is_ok_and(|checked| checked.contains(&path)) {
        return path;
    }
    let build = match folder.file_name().and_then(|name| name.to_str()) {
        Some("debug") | None => "cargo build --workspace".to_owned(),
        Some(profile) => format!("cargo build --workspace --profile {profile}"),
    };
    let built = fs::metadata(&path).and_then(|metadata| metadata.modified());
    let built = built.unwrap_or_else(|error| panic!("{}: {error}; build it with `{build}`", path.display()));
    if let Some(newer) = sources(&path).into_iter().find(|source| is_newer(source, built)) {
        panic!("{} is older than {}; build it again with `{build}`", path.display(), newer.display());
    }
    if let Ok(mut checked) = CHECKED.lock() {
        checked.insert(path.clone());
    }
    path
}

/// Returns the files that a program was built from, according to cargo.
fn sources(program: &Path) -> Vec<PathBuf> {
    let rule = fs::read_to_string(program.with_extension("d")).unwrap_or_default();
    let (_, sources) = rule.trim_end().split_once(": ").unwrap_or_default();
    // A space within a name is escaped.
    let names = sources.replace("\\ ", "\0");
    names.split(' ').filter(|name| !name.is_empty()).map(|name| name.replace('\0', " ").into()).collect()
}

fn is_newer(source: &Path, than: SystemTime) -> bool {
    fs::metadata(source).and_then(|metadata| metadata.modified()).is_ok_and(|changed| changed > than)
}

/// Returns the path of one of the gateway's examples.
pub fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../gateway/examples").join(name)
}

/// Returns a skin's text: a number of cells on an arm, on one bus.
pub fn skin(cells: usize) -> String {
    generate(&SkinRequest { cells, ..SkinRequest::default() }).unwrap()
}

/// Returns a skin's text: a number of cells on several buses, with a given format.
pub fn skin_of(cells: usize, buses: usize, format: Format) -> String {
    generate(&SkinRequest { cells, buses, format, ..SkinRequest::default() }).unwrap()
}

pub fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Returns true if a process is stopped.
pub fn is_stopped(pid: Pid) -> bool {
    fs::read_to_string(proc(pid, "stat")).is_ok_and(|stat| stat.contains(") T "))
}

pub fn signal(pid: Pid, signal: Signal) {
    kill_process(pid, signal).unwrap();
}

/// Returns true if a bench has reported an event of a cell, alone or with others.
pub fn reports_event(text: &str, cell: u8, what: &str) -> bool {
    reports_event_on(text, "vcan0", cell, what)
}

/// Returns true if a bench has reported an event of a cell on this bus, alone or with others.
pub fn reports_event_on(text: &str, bus: &str, cell: u8, what: &str) -> bool {
    let on_bus = format!(" on {bus} ha");
    let names = |line: &str| {
        let cells = line.strip_prefix("cell ").or_else(|| line.strip_prefix("cells "))?;
        let (cells, rest) = cells.split_once(&on_bus)?;
        rest.ends_with(what).then(|| cells.split(", ").any(|name| name == cell.to_string()))
    };
    text.lines().any(|line| names(line) == Some(true))
}
