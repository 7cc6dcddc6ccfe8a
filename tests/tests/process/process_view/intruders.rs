//! The page of a run under attack by users of the machine with another user id and without the token.
//!
//! By default one run of some seconds is attacked. A campaign compares runs with and without intruders, in turn:
//! `SKINBUS_INTRUDERS=5x12 cargo test -p skinbus-tests --test process intruders -- --nocapture` runs five pairs of 12 s
//! each.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Resource, Rlimit, getrlimit, getuid, setrlimit};

use skinbus_tests::process::page::{Address, Page, address};
use skinbus_tests::process::{PRESSED, Running, Summary, TestDir, program, skin};

/// The kinds of attacks; each intruder repeats one of them.
const KINDS: [&str; 6] = ["no token", "old token", "slow heads", "silence", "storm", "foreign host"];
/// The id of a user without permissions.
const NOBODY: u32 = 65_534;
/// The exit code of an intruder whose commands were accepted.
const LET_IN: i32 = 9;
/// All commands that a page may send to a run.
const COMMANDS: [&str; 7] = [
    r#"{"do":"halt"}"#,
    r#"{"do":"press","cell":1,"force_n":30}"#,
    r#"{"do":"kill","cell":3}"#,
    r#"{"do":"stop","cell":4}"#,
    r#"{"do":"restart","cell":5}"#,
    r#"{"do":"bus","bus":"vcan0","down":true}"#,
    r#"{"do":"resume"}"#,
];

/// A process that attacks a page until it is dropped.
struct Intruder(Child);

impl Intruder {
    fn start(kind: &str, host: &str) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        let (_, module) = module_path!().split_once("::").unwrap();
        command.args([&format!("{module}::intruder"), "--exact", "--ignored"]);
        command.env("SKINBUS_INTRUDER", kind).env("SKINBUS_INTRUDER_OF", host).current_dir("/");
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let is_root = getuid().is_root();
        if is_root {
            command.uid(NOBODY).gid(NOBODY);
        }
        match command.spawn() {
            Ok(child) => Self(child),
            // Other users may not reach the folder of this program.
            Err(error) if is_root && error.kind() == ErrorKind::PermissionDenied => {
                Self(command.uid(0).gid(0).spawn().unwrap())
            }
            Err(error) => panic!("{error}"),
        }
    }

    /// Checks that it still attacks, and was never accepted.
    fn is_kept_out(&mut self) -> bool {
        self.0.try_wait().unwrap().is_none()
    }
}

impl Drop for Intruder {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The program of an intruder.
#[test]
#[ignore = "another test starts it as a process"]
fn intruder() {
    let (Ok(kind), Ok(host)) = (std::env::var("SKINBUS_INTRUDER"), std::env::var("SKINBUS_INTRUDER_OF"))
    else {
        return;
    };
    let files = getrlimit(Resource::Nofile).maximum;
    let _ = setrlimit(Resource::Nofile, Rlimit { current: files, maximum: files });
    let mut held = Vec::new();
    loop {
        match kind.as_str() {
            "no token" => intrude(&host, &host, ""),
            "old token" => intrude(&host, &host, "?token=00112233445566778899aabbccddeeff"),
            "foreign host" => intrude(&host, "evil.example", "?token=00112233445566778899aabbccddeeff"),
            "slow heads" => hold(&host, &mut held, 1_000, b"GET /?token=wrong HTTP/1.1\r\nX: ", b"a"),
            "silence" => hold(&host, &mut held, 100, b"", b""),
            _ => {
                for _ in 0..5 {
                    let Ok(mut stream) = TcpStream::connect(&host) else { continue };
                    let _ = write!(stream, "GET / HTTP/1.1\r\nHost: {host}\r\n\r\n");
                }
            }
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Requests a WebSocket, and sends commands without waiting for the answer.
fn intrude(address: &str, host: &str, query: &str) {
    let Ok(mut stream) = TcpStream::connect(address) else { return };
    let _ = stream.set_read_timeout(Some(Duration::from_secs(1)));
    let mut bytes = format!(
        "GET /live{query} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    .into_bytes();
    let head = bytes.len();
    for command in COMMANDS {
        let length = u8::try_from(command.len()).unwrap();
        assert!(length < 126);
        // A text frame, masked with zeros.
        bytes.extend([0x81, 0x80 | length, 0, 0, 0, 0]);
        bytes.extend(command.as_bytes());
    }
    // At once, or one after the other.
    let is_whole = query.is_empty();
    let _ = stream.write_all(if is_whole { &bytes } else { &bytes[..head] });
    let mut answer = [0; 12];
    if stream.read_exact(&mut answer).is_ok() && answer.starts_with(b"HTTP/1.1 101") {
        std::process::exit(LET_IN);
    }
    if !is_whole {
        let _ = stream.write_all(&bytes[head..]);
    }
}

/// Holds a number of connections, and sends a further piece on some of them.
fn hold(address: &str, held: &mut Vec<TcpStream>, count: usize, begin: &[u8], more: &[u8]) {
    while held.len() < count {
        let Ok(mut stream) = TcpStream::connect(address) else { return };
        let _ = stream.set_nonblocking(true);
        let _ = stream.write(begin);
        held.push(stream);
    }
    for _ in 0..count / 20 {
        let mut stream = held.remove(0);
        let is_open = stream.read(&mut [0; 256]).is_err_and(|error| error.kind() == ErrorKind::WouldBlock);
        if is_open && (more.is_empty() || stream.write(more).is_ok()) {
            held.push(stream);
        }
    }
}

/// The outcome of a run.
struct Outcome {
    summary: Summary,
    /// The number of pages that were opened with the token, and of attempts.
    pages: [usize; 2],
    /// The longest time from the first attempt to the page, in ms.
    longest_ms: u128,
}

/// Runs for a number of seconds, and opens pages with the token as long as the run lasts.
fn run(seconds: u64, with_intruders: bool) -> Outcome {
    let place = TestDir::new();
    // Intruders that take processor time must not halt the robot.
    place.write("skin.toml", &(skin(12) + "\n[safety]\nbad_cycles = 10000\n"));
    place.scenario(&PRESSED.replace("600.0", "3600.0"));
    let words = "run skin.toml --bus-kind embedded --scenario scenario.toml --view --duration 3600 --summary run.json --quiet";
    let run = place.start("skinbus", words);
    let address = address(&run);
    let intruders = KINDS.iter().filter(|_| with_intruders).map(|kind| Intruder::start(kind, &address.host));
    let mut intruders: Vec<_> = intruders.collect();
    let mut outcome = [0, 0];
    let mut longest = Duration::ZERO;
    let (mut began, mut first) = (Instant::now(), true);
    while first || began.elapsed() < Duration::from_secs(seconds) {
        let asked = Instant::now();
        let mut page = open(&address, &mut outcome);
        longest = longest.max(asked.elapsed());
        page.wait_for_snapshot("all cells pressed", |it| {
            it.cells.iter().all(|cell| cell.0 == 2 && cell.2 > 0)
        });
        let mut seen = 0;
        page.wait_for_snapshot("snapshots", |_| {
            seen += 1;
            seen > 10
        });
        if first {
            // The time counts from when everything runs.
            (first, began) = (false, Instant::now());
        }
    }
    for (intruder, kind) in intruders.iter_mut().zip(KINDS) {
        assert!(intruder.is_kept_out(), "{kind}");
    }
    drop(intruders);
    run.signal(rustix::process::Signal::INT);
    let ended = run.end();
    assert_eq!(ended.code(), Some(0), "{ended:#?}");
    let said: Vec<_> = ended.stderr.lines().filter(|line| !line.starts_with("view: http://")).collect();
    assert!(!said.iter().any(|line| line.starts_with("view: ") || line.contains("halt")), "{said:#?}");
    let summary = place.summary();
    assert_eq!(summary.0["halts"], serde_json::json!([]));
    assert_eq!(summary.0["cell_errors"], serde_json::json!([]));
    assert_eq!(summary.0["buses"][0]["outages"]["times"], 0);
    assert_eq!(summary.silent(), [0_u64; 0]);
    summary.adds_up();
    place.is_left_clean();
    Outcome { summary, pages: outcome, longest_ms: longest.as_millis() }
}

/// Opens a page; among thousands of connections one may be refused before its head is read.
fn open(address: &Address, [opened, tries]: &mut [usize; 2]) -> Page {
    skinbus_tests::process::until("a page, for somebody who has the token", || {
        *tries += 1;
        let page = Page::attempt(address).ok()?;
        *opened += 1;
        Some(page)
    })
}

#[test]
fn intruders_keep_nobody_out_and_are_not_obeyed() {
    let campaign = std::env::var("SKINBUS_INTRUDERS").ok();
    let Some((pairs, seconds)) = campaign.as_deref().map(|it| it.split_once('x').expect("PAIRSxSECONDS"))
    else {
        run(3, true);
        return;
    };
    let (pairs, seconds): (usize, u64) = (pairs.parse().unwrap(), seconds.parse().unwrap());
    let mut table = Vec::new();
    for pair in 0..pairs {
        // Each second pair in the other order.
        let order = if pair % 2 == 0 { [false, true] } else { [true, false] };
        let mut both = order.map(|with| (with, run(seconds, with)));
        both.sort_by_key(|(with, _)| *with);
        table.push(both);
    }
    println!("{:>9} {:>30} {:>30}", "pairs", "without, median (all)", "with, median (all)");
    for (name, figure) in FIGURES {
        let column = |with: usize| {
            let mut all: Vec<_> = table.iter().map(|pair| figure(&pair[with].1)).collect();
            let listed = all.iter().map(|it| format!("{it:.0}")).collect::<Vec<_>>().join(" ");
            all.sort_by(f64::total_cmp);
            format!("{:.1} ({listed})", all[all.len() / 2])
        };
        println!("{name:>28} {:>36} {:>36}", column(0), column(1));
    }
}

#[test]
fn a_page_that_may_open_few_files_still_lets_in_who_has_the_token() {
    let place = TestDir::new();
    place.skin(4);
    let mut command = place.command_of(Path::new("sh"), "-c");
    let gateway = program("skinbus");
    let words = format!("ulimit -n 64; exec {} view skin.toml --wait --bus-kind embedded", gateway.display());
    command.arg(words);
    let served = Running::start(command);
    let address = address(&served);
    let mut held = Vec::new();
    for _ in 0..100 {
        // All of them stay connected, however many the server refuses.
        hold(&address.host, &mut held, 200, b"GET / HTTP/1.1\r\nX: ", b"a");
    }
    let mut page = open(&address, &mut [0, 0]);
    page.wait_for_snapshot("a snapshot", |it| it.cells.len() == 4);
    hold(&address.host, &mut held, 400, b"GET / HTTP/1.1\r\nX: ", b"a");
    page.wait_for_snapshot("another one", |it| it.cells.len() == 4);
    served.signal(rustix::process::Signal::INT);
    served.end().succeeded();
}

type Figure = fn(&Outcome) -> f64;

/// The figures of a run.
const FIGURES: [(&str, Figure); 11] = [
    ("late p50, us", |it| it.at("/loop/late_us/p50")),
    ("late p99, us", |it| it.at("/loop/late_us/p99")),
    ("late max, us", |it| it.at("/loop/late_us/max")),
    ("ticks skipped", |it| it.at("/loop/ticks_skipped")),
    ("epochs complete, %", |it| 100.0 * it.at("/buses/0/epochs_complete") / it.at("/buses/0/epochs_due")),
    ("replies late or skipped", |it| it.at("/buses/0/replies/late") + it.at("/buses/0/replies/skipped")),
    ("replies lost, unknown", |it| it.at("/buses/0/replies/lost") + it.at("/buses/0/replies/unknown")),
    ("packets dropped, unknown", |it| it.at("/buses/0/uplink/dropped") + it.at("/buses/0/uplink/unknown")),
    ("pages opened", |it| it.pages[0] as f64),
    ("tries turned away", |it| (it.pages[1] - it.pages[0]) as f64),
    ("longest to a page, ms", |it| it.longest_ms as f64),
];

impl Outcome {
    fn at(&self, pointer: &str) -> f64 {
        self.summary
            .0
            .pointer(pointer)
            .and_then(serde_json::Value::as_f64)
            .unwrap_or_else(|| panic!("{pointer}"))
    }
}
