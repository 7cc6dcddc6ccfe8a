//! A bench of real processes on a bus of its own, embedded or a real kernel's: what all tests of this kind share.
//!
//! Nothing here waits for a time to pass: what is waited for is looked at until it is so, or until
//! [`PATIENCE`] is over, which a slow machine never needs and a hanging program does.
#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::wildcard_enum_match_arm,
    reason = "each test file uses its part of it, and a test may stop"
)]

pub(crate) mod buses;
pub(crate) mod external;
pub(crate) mod guest;
pub(crate) mod log;
pub(crate) mod replay;
pub(crate) mod sums;
pub(crate) mod vcan;
pub(crate) mod whole;

use std::fs;
use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use guest::Guest;
use model::generate::{Format, Wanted, generate};
use protocol::bus::BusKind;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// How long anything may take that should happen at once.
pub(crate) const PATIENCE: Duration = Duration::from_secs(40);

/// Every cell is pressed, harder and softer, while the arm stands.
pub(crate) const PRESSED: &str = r#"version = 1
duration_s = 60.0

[motion]
kind = "hold"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]

[[mode]]
at_s = 0.0
kind = "compare"

[[touch]]
at_s = 0.0
for_s = 60.0
all = true
force_n = 1.5
profile = "step"
"#;

/// Looks until something is there.
pub(crate) fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let give_up = Instant::now() + PATIENCE;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < give_up, "waited {PATIENCE:?} and there is still not: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A program of this build, which `cargo test` of this package alone does not make; or one from the folder that
/// `SKINBUS_PROGRAMS` names.
pub(crate) fn program(name: &str) -> PathBuf {
    if let Some(folder) = std::env::var_os("SKINBUS_PROGRAMS") {
        let path = Path::new(&folder).join(name);
        assert!(path.is_file(), "{} is missing: build it, or unset SKINBUS_PROGRAMS", path.display());
        return path;
    }
    let own = std::env::current_exe().unwrap();
    let folder = own.parent().and_then(Path::parent).expect("tests lie in target/PROFILE/deps");
    let path = folder.join(name);
    let build = match folder.file_name().and_then(|name| name.to_str()) {
        Some("debug") | None => "cargo build --workspace".to_owned(),
        Some(profile) => format!("cargo build --workspace --profile {profile}"),
    };
    assert!(path.is_file(), "{} is missing: `{build}` makes it", path.display());
    path
}

/// An example of the gateway's.
pub(crate) fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../gateway/examples").join(name)
}

/// A directory of its own for a test, and in it its embedded buses.
pub(crate) struct Place {
    directory: TempDir,
    /// What its benches run on.
    kind: BusKind,
}

impl Place {
    pub(crate) fn new() -> Self {
        Self { directory: TempDir::new().unwrap(), kind: BusKind::Embedded }
    }

    /// One whose benches run on `vcan0` of a network that is the test's own.
    pub(crate) fn on_vcan() -> Self {
        vcan::needs("vcan0");
        Self { kind: BusKind::SocketCan, ..Self::new() }
    }

    /// What its benches run on.
    pub(crate) const fn kind(&self) -> BusKind {
        self.kind
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Where its buses are: `SKINBUS_DIR`.
    pub(crate) fn buses(&self) -> PathBuf {
        self.path("buses")
    }

    pub(crate) fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, text).unwrap();
        path
    }

    pub(crate) fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap()
    }

    /// The files in it, in order.
    pub(crate) fn files(&self) -> Vec<String> {
        names(self.directory.path())
    }

    /// `skin.toml`: some cells on an arm, on one bus.
    pub(crate) fn skin(&self, cells: usize) -> PathBuf {
        self.write("skin.toml", &skin(cells))
    }

    /// `scenario.toml`.
    pub(crate) fn scenario(&self, text: &str) -> PathBuf {
        self.write("scenario.toml", text)
    }

    /// `skin.toml` and `scenario.toml` for a bench of eight cells that are all pressed.
    pub(crate) fn pressed(&self) {
        self.skin(8);
        self.scenario(PRESSED);
    }

    /// A command in this place; words are parted by spaces.
    pub(crate) fn command(&self, name: &str, words: &str) -> Command {
        self.command_of(&program(name), words)
    }

    /// The same of any program.
    pub(crate) fn command_of(&self, program: &Path, words: &str) -> Command {
        let mut command = Command::new(program);
        command.args(words.split(' ').filter(|word| !word.is_empty()));
        command.current_dir(self.directory.path()).env("SKINBUS_DIR", self.buses()).env("NO_COLOR", "1");
        command
    }

    pub(crate) fn start(&self, name: &str, words: &str) -> Running {
        Running::start(self.command(name, words))
    }

    /// A bench of `skin.toml` and `scenario.toml` for some seconds, with a log and a summary.
    pub(crate) fn bench(&self, seconds: f64, more: &str) -> Running {
        self.start(
            "gateway",
            &format!(
                "run skin.toml --bus-kind {} --scenario scenario.toml --duration {seconds} \
                 --candump run.log --force --summary run.json {more}",
                self.kind
            ),
        )
    }

    /// The same, once its loop runs.
    pub(crate) fn running_bench(&self, seconds: f64, more: &str) -> Running {
        let bench = self.bench(seconds, more);
        bench.hears_the_loop();
        bench
    }

    /// What a bench left.
    pub(crate) fn summary(&self) -> Summary {
        Summary(serde_json::from_str(&self.read("run.json")).unwrap())
    }

    /// Another client of its bus.
    pub(crate) fn guest(&self) -> Guest {
        Guest::on(self, "vcan0", protocol::can::Format::Fd)
    }

    /// Processes of this place that live, with their command lines.
    pub(crate) fn processes(&self) -> Vec<(Pid, String)> {
        let mark = format!("SKINBUS_DIR={}", self.buses().display());
        let ours = |pid: &Pid| {
            let environment = fs::read(proc(*pid, "environ")).unwrap_or_default();
            environment.split(|&byte| byte == 0).any(|word| word == mark.as_bytes())
        };
        all_processes().into_iter().filter(ours).map(|pid| (pid, command_line(pid))).collect()
    }

    /// Sees that no process and no socket of this place is left, soon.
    pub(crate) fn is_left_clean(&self) {
        let left = || {
            let processes = self.processes();
            if processes.is_empty() && !self.buses().exists() { None } else { Some(processes) }
        };
        let give_up = Instant::now() + PATIENCE;
        while let Some(processes) = left() {
            let sockets = if self.buses().exists() { names(&self.buses()) } else { Vec::new() };
            assert!(Instant::now() < give_up, "left behind: {processes:?} {sockets:?}");
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// A skin's text: some cells on an arm, on one bus.
pub(crate) fn skin(cells: usize) -> String {
    generate(&Wanted { cells, ..Wanted::default() }).unwrap()
}

/// Some cells over some buses in another format.
pub(crate) fn skin_of(cells: usize, buses: usize, format: Format) -> String {
    generate(&Wanted { cells, buses, format, ..Wanted::default() }).unwrap()
}

pub(crate) fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn proc(pid: Pid, file: &str) -> PathBuf {
    PathBuf::from(format!("/proc/{}/{file}", pid.as_raw_nonzero()))
}

fn all_processes() -> Vec<Pid> {
    let entries = fs::read_dir("/proc").unwrap().flatten();
    entries.filter_map(|entry| Pid::from_raw(entry.file_name().to_str()?.parse().ok()?)).collect()
}

fn command_line(pid: Pid) -> String {
    let bytes = fs::read(proc(pid, "cmdline")).unwrap_or_default();
    String::from_utf8_lossy(&bytes).replace('\0', " ").trim_end().to_owned()
}

/// Whether a process is stopped.
pub(crate) fn is_stopped(pid: Pid) -> bool {
    fs::read_to_string(proc(pid, "stat")).is_ok_and(|stat| stat.contains(") T "))
}

pub(crate) fn signal(pid: Pid, signal: Signal) {
    kill_process(pid, signal).unwrap();
}

/// Whether a bench has said of a cell, alone or with others, that it has done something.
pub(crate) fn tells(text: &str, cell: u8, what: &str) -> bool {
    tells_on(text, "vcan0", cell, what)
}

/// The same on another bus.
pub(crate) fn tells_on(text: &str, bus: &str, cell: u8, what: &str) -> bool {
    let on_bus = format!(" on {bus} ha");
    let names = |line: &str| {
        let cells = line.strip_prefix("cell ").or_else(|| line.strip_prefix("cells "))?;
        let (cells, rest) = cells.split_once(&on_bus)?;
        rest.ends_with(what).then(|| cells.split(", ").any(|name| name == cell.to_string()))
    };
    text.lines().any(|line| names(line) == Some(true))
}

/// A process whose words are taken as they come; it ends with the test.
pub(crate) struct Running {
    child: Child,
    out: Output,
    err: Output,
}

/// How a process ended.
#[derive(Debug)]
pub(crate) struct Ended {
    pub(crate) status: ExitStatus,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Ended {
    /// Its exit code.
    pub(crate) fn code(&self) -> Option<i32> {
        self.status.code()
    }

    /// The signal that ended it.
    pub(crate) fn signal(&self) -> Option<i32> {
        self.status.signal()
    }

    /// Sees that it did what it should.
    pub(crate) fn well(self) -> Self {
        assert_eq!(self.code(), Some(0), "{self:#?}");
        self
    }

    /// Sees that it ended with this code and one line, and returns that.
    pub(crate) fn refusal(&self, code: i32) -> &str {
        assert_eq!((self.code(), self.stdout.as_str()), (Some(code), ""), "{self:#?}");
        let line = self.stderr.trim_end_matches('\n');
        assert!(!line.is_empty() && !line.contains('\n'), "one line: {self:#?}");
        line
    }
}

impl Running {
    pub(crate) fn start(mut command: Command) -> Self {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap_or_else(|error| panic!("{command:?}: {error}"));
        let out = Output::of(child.stdout.take().unwrap());
        let err = Output::of(child.stderr.take().unwrap());
        Self { child, out, err }
    }

    pub(crate) fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    pub(crate) fn signal(&self, it: Signal) {
        signal(self.pid(), it);
    }

    /// Waits until it has said something on standard error.
    pub(crate) fn hears(&self, words: &str) {
        self.err.wait_for(words);
    }

    /// Waits until a bench has said of a cell that it has done something.
    pub(crate) fn tells(&self, cell: u8, what: &str) {
        self.err.wait_until(what, |text| tells(text, cell, what));
    }

    /// The same on another bus.
    pub(crate) fn tells_on(&self, bus: &str, cell: u8, what: &str) {
        self.err.wait_until(what, |text| tells_on(text, bus, cell, what));
    }

    /// Waits until a bench's loop runs: then come the lines that say how it goes.
    pub(crate) fn hears_the_loop(&self) {
        self.err.wait_until("how it goes", |text| text.contains(" s  ") || text.contains("\nstarting\n"));
    }

    /// Waits until it has said something on standard output.
    pub(crate) fn prints(&self, words: &str) {
        self.out.wait_for(words);
    }

    /// What it has said on standard error so far.
    pub(crate) fn stderr(&self) -> String {
        self.err.text.lock().unwrap().clone()
    }

    /// Waits until it has ended.
    pub(crate) fn end(self) -> Ended {
        self.end_after(Duration::ZERO)
    }

    /// Waits until it has ended, which takes so long by itself.
    pub(crate) fn end_after(mut self, run: Duration) -> Ended {
        let give_up = Instant::now() + run + PATIENCE;
        // Looking costs an emulated processor 2 % of its time.
        let look = Duration::from_millis(if run.is_zero() { 5 } else { 200 });
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(Instant::now() < give_up, "still running after {PATIENCE:?}: {}", self.stderr());
            std::thread::sleep(look);
        };
        Ended { status, stdout: self.out.whole(), stderr: self.err.whole() }
    }

    /// The processes of its cells, with the numbers that each was told.
    pub(crate) fn cells(&self) -> Vec<(Pid, String)> {
        let mark = format!("--with-parent {}", self.pid().as_raw_nonzero());
        let cell = |pid| {
            let line = command_line(pid) + " ";
            let (_, after) = line.split_once("--node ").or_else(|| line.split_once("--nodes "))?;
            let nodes = after.split(' ').next()?.to_owned();
            line.contains(&format!("{mark} ")).then_some((pid, nodes))
        };
        all_processes().into_iter().filter_map(cell).collect()
    }

    /// The process of one cell.
    pub(crate) fn cell(&self, node: u8) -> Pid {
        let node = node.to_string();
        let found = self.cells().into_iter().find(|(_, nodes)| *nodes == node);
        found.unwrap_or_else(|| panic!("no process of cell {node}: {:?}", self.cells())).0
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// One of a process' outputs, read as it comes.
struct Output {
    text: Arc<Mutex<String>>,
    reader: Option<JoinHandle<()>>,
}

impl Output {
    fn of(mut pipe: impl Read + Send + 'static) -> Self {
        let text = Arc::new(Mutex::new(String::new()));
        let shared = Arc::clone(&text);
        let read = move || {
            let mut bytes = [0; 4096];
            let mut all = Vec::new();
            while let Ok(count @ 1..) = pipe.read(&mut bytes) {
                all.extend_from_slice(&bytes[..count]);
                *shared.lock().unwrap() = String::from_utf8_lossy(&all).into_owned();
            }
        };
        Self { text, reader: Some(std::thread::spawn(read)) }
    }

    fn wait_for(&self, words: &str) {
        self.wait_until(words, |text| text.contains(words));
    }

    fn wait_until(&self, words: &str, said: impl Fn(&str) -> bool) {
        let give_up = Instant::now() + PATIENCE;
        loop {
            let text = self.text.lock().unwrap().clone();
            if said(&text) {
                return;
            }
            let over = self.reader.as_ref().is_none_or(JoinHandle::is_finished);
            assert!(!over && Instant::now() < give_up, "never said {words:?}, but this:\n{text}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Everything, once the other side has closed it.
    fn whole(&mut self) -> String {
        let reader = self.reader.take().unwrap();
        until("the end of an output: somebody still has it open", || reader.is_finished().then_some(()));
        reader.join().unwrap();
        self.text.lock().unwrap().clone()
    }
}

/// The figures of a run's end.
#[derive(Debug)]
pub(crate) struct Summary(pub(crate) Value);

impl Summary {
    /// A number in the first bus: `/replies/due`.
    pub(crate) fn of_bus(&self, pointer: &str) -> u64 {
        self.number(&format!("/buses/0{pointer}"))
    }

    /// A number.
    pub(crate) fn number(&self, pointer: &str) -> u64 {
        self.0.pointer(pointer).and_then(Value::as_u64).unwrap_or_else(|| panic!("{pointer} in {:#}", self.0))
    }

    /// A number that is left out when it is zero.
    pub(crate) fn count(&self, table: &str, key: &str) -> u64 {
        self.0.pointer(table).unwrap()[key].as_u64().unwrap_or(0)
    }

    /// A number with a fraction.
    pub(crate) fn figure(&self, pointer: &str) -> f64 {
        self.0.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("{pointer} in {:#}", self.0))
    }

    /// The sum of a table of counts.
    pub(crate) fn total(&self, table: &str) -> u64 {
        self.0.pointer(table).unwrap().as_object().unwrap().values().map(|it| it.as_u64().unwrap()).sum()
    }

    /// What was odd on a bus, without torques that came too late: those tell of the machine.
    pub(crate) fn odd(&self, bus: usize) -> u64 {
        let table = format!("/buses/{bus}/events");
        self.total(&table) - self.count(&table, "stale torque")
    }

    /// Sees that so many cells owed an answer to every broadcast, unless a machine that was away took some
    /// for dead.
    pub(crate) fn all_were_due(&self, cells: u64, stderr: &str) {
        let (due, all) = (self.of_bus("/replies/due"), cells * self.number("/loop/broadcasts"));
        let away = stderr.contains("fallen silent");
        assert!(due == all || (away && due < all && due > 0), "{due} of {all} due: {:#}", self.0);
    }

    /// The cells of the first bus that were silent at the end.
    pub(crate) fn silent(&self) -> Vec<u64> {
        let cells = self.0["buses"][0]["silent_cells"].as_array().unwrap();
        cells.iter().map(|cell| cell.as_u64().unwrap()).collect()
    }

    /// Sees that everything that was due, sent and written is accounted for on every bus.
    pub(crate) fn adds_up(&self) -> &Self {
        let buses = self.0["buses"].as_array().unwrap().len();
        for bus in 0..buses {
            let of = |pointer: &str| self.number(&format!("/buses/{bus}{pointer}"));
            let reasons =
                ["in_time", "late", "too_late", "skipped", "not_heard", "lost", "in_doubt", "unknown"];
            let replies: u64 = reasons.map(|reason| of(&format!("/replies/{reason}"))).iter().sum();
            assert_eq!(replies, of("/replies/due"), "{:#}", self.0);
            let arrived = of("/uplink/delivered") + of("/uplink/rejected") + of("/uplink/unheard");
            let reasons = ["dropped", "backlog", "outage", "unknown"];
            let lost: u64 = reasons.map(|reason| of(&format!("/uplink/{reason}"))).iter().sum();
            assert_eq!(of("/uplink/sent") + of("/uplink/surplus"), arrived + lost, "{:#}", self.0);
            assert_eq!((of("/replies/unknown"), of("/uplink/unknown")), (0, 0), "{:#}", self.0);
            if !self.0["buses"][bus]["sums"].is_null() {
                let ways = ["first", "resent", "overheard", "stale"].map(|way| of(&format!("/sums/{way}")));
                assert_eq!(ways.iter().sum::<u64>(), of("/sums/received"), "{:#}", self.0);
                let of = |how| of(&format!("/sums/contributions/{how}"));
                assert_eq!(of("due"), of("in_time") + of("late") + of("missing"), "{:#}", self.0);
            }
        }
        self
    }
}
