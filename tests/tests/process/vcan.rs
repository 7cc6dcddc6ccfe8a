//! A real kernel's vcan, and the stock tools beside us.
//!
//! `tests/vcan` runs the programs that need it: each alone in a network of its own, where `vcan0` is there with
//! MTU 72 and up, and nobody else's interfaces are.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use protocol::can::Frame;
use protocol::candump::{Line, parse};

use super::until;

/// Sees that an interface is there and that it is nobody else's.
pub(crate) fn needs(interface: &str) {
    let ours = std::env::var_os("SKINBUS_OWN_NETWORK").is_some();
    // Not /sys, which may show another network.
    let ip = command(&format!("ip -json link show {interface}")).output().map(|output| output.stdout);
    let found: serde_json::Value = serde_json::from_slice(&ip.unwrap_or_default()).unwrap_or_default();
    assert!(
        ours && found[0]["mtu"] == 72,
        "this test needs {interface} with MTU 72 in a network of its own: `tests/vcan testrelease` runs it there"
    );
}

/// Another program, which must do what it is told: `ip link set vcan0 down`.
pub(crate) fn tool(words: &str) -> Output {
    let output = command(words).output().unwrap_or_else(|error| missing(words, &error));
    assert!(output.status.success(), "{words}: {output:?}");
    output
}

/// The same, to be started; words are parted by spaces.
pub(crate) fn command(words: &str) -> Command {
    let mut words = words.split(' ');
    let mut command = Command::new(words.next().unwrap());
    command.args(words).stdin(Stdio::null());
    command
}

fn missing(words: &str, error: &std::io::Error) -> ! {
    panic!("{words}: {error}; install can-utils, iproute2 and util-linux")
}

/// Another program that runs beside a test, and ends with it.
pub(crate) struct Beside(pub(crate) Child);

impl Beside {
    pub(crate) fn start(words: &str) -> Self {
        let mut command = command(words);
        command.stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().unwrap_or_else(|error| missing(words, &error)))
    }
}

impl Drop for Beside {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// `candump -L`, which has room for 16 MB of frames and takes the processor only when nobody else wants it:
/// on one processor it would else be woken by every single frame.
pub(crate) struct Candump {
    child: Beside,
    bus: String,
    log: PathBuf,
}

impl Candump {
    /// When this returns, it listens.
    pub(crate) fn start(bus: &str, log: &Path) -> Self {
        // -d: what its socket drops is a line of the log, which no test that counts frames lets pass.
        let words = format!("chrt --idle 0 candump -L -d -r 16000000 {bus}");
        let mut command = command(&words);
        command.stdout(File::create(log).unwrap()).stderr(Stdio::null());
        let child = Beside(command.spawn().unwrap_or_else(|error| missing(&words, &error)));
        let lists = format!("/proc/{}/net/can/rcvlist_all", child.0.id());
        let listens = || fs::read_to_string(&lists).is_ok_and(|list| list.contains(bus)).then_some(());
        until("candump's socket", listens);
        Self { child, bus: bus.to_owned(), log: log.to_owned() }
    }

    /// What was on the bus until now.
    pub(crate) fn frames(self) -> Vec<Frame> {
        // When it has seen this one, it has seen all that came before.
        tool(&format!("cansend {} {LAST}", self.bus));
        let has_seen_it = || fs::read_to_string(&self.log).unwrap().trim_end().ends_with(LAST).then_some(());
        until("candump to see the last frame", has_seen_it);
        drop(self.child);
        let mut frames = frames_of(&self.log);
        frames.pop();
        frames
    }
}

/// A frame that nobody sends.
const LAST: &str = "1BADCAFE#4C415354";

/// The frames of a log; every other line is a mistake, `DROPCOUNT` too.
pub(crate) fn frames_of(log: &Path) -> Vec<Frame> {
    let text = fs::read_to_string(log).unwrap();
    let frame = |line: &str| match parse(line) {
        Ok(Line::Frame(record)) => record.frame,
        other => panic!("{}: {line}: {other:?}", log.display()),
    };
    text.lines().map(frame).collect()
}
