//! Buses of the Linux kernel's vcan, and standard tools such as can-utils.
//!
//! `tests/vcan` runs the tests that need it, each in a network of its own with `lo` and `vcan0` (MTU 72, up).

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom};
use std::os::fd::AsFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use model::generate::{SkinRequest, generate};
use protocol::bus::BusKind;
use protocol::can::Frame;
use protocol::candump::{CandumpLine, parse, parse_frame};
use protocol::id::{Id, Kind};

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use super::{TestDir, until};

impl TestDir {
    /// Creates a directory whose benches run on `vcan0` of a network that is the test's own.
    pub fn on_vcan() -> Self {
        own_network();
        Self::on(BusKind::SocketCan)
    }
}

/// Moves this thread, and the processes it starts from now on, into a new network with `lo` and `vcan0`. In a lab
/// machine the network is the machine's, with its controllers: there `SKINBUS_NETWORK` is `here`.
pub fn own_network() {
    match std::env::var("SKINBUS_NETWORK").as_deref() {
        Ok("new") => {
            // The network lasts as long as a thread or a process is in it.
            let mut holder = command("unshare --net cat").stdin(Stdio::piped()).spawn().unwrap();
            let network = until("a new network", || {
                let [own, new] =
                    ["thread-self", &holder.id().to_string()].map(|id| format!("/proc/{id}/ns/net"));
                let new = File::open(new).ok()?;
                (new.metadata().ok()?.ino() != fs::metadata(own).ok()?.ino()).then_some(new)
            });
            move_into_link_name_space(network.as_fd(), Some(LinkNameSpaceType::Network)).unwrap();
            drop(holder.stdin.take());
            holder.wait().unwrap();
            tool("ip link set lo up");
            tool("ip link add vcan0 type vcan");
            tool("ip link set vcan0 mtu 72 up");
        }
        Ok("here") => {
            // Not /sys, which may show another network.
            let found = tool("ip -json link show vcan0").stdout;
            assert_eq!(serde_json::from_slice::<serde_json::Value>(&found).unwrap()[0]["mtu"], 72, "vcan0");
        }
        _ => panic!("this test needs vcan in a network of its own: `tests/vcan` runs it there"),
    }
}

/// Runs a command such as `ip link set vcan0 down`, and panics if it fails.
pub fn tool(words: &str) -> Output {
    let output = command(words).output().unwrap_or_else(|error| missing(words, &error));
    assert!(output.status.success(), "{words}: {output:?}");
    output
}

/// Returns a command of which spaces separate the arguments.
pub fn command(words: &str) -> Command {
    let mut words = words.split(' ');
    let mut command = Command::new(words.next().unwrap());
    command.args(words).stdin(Stdio::null());
    command
}

fn missing(words: &str, error: &std::io::Error) -> ! {
    panic!("{words}: {error}; install can-utils, iproute2 and util-linux")
}

/// An interface of a test's own, beside `vcan0`; the kernel's routes to and from it are removed with it.
pub struct Vcan(&'static str);

impl Vcan {
    /// Creates an interface that carries CAN FD, and is up.
    pub fn make(name: &'static str) -> Self {
        Self::with_mtu(name, 72)
    }

    pub fn with_mtu(name: &'static str, mtu: u32) -> Self {
        tool(&format!("ip link add {name} type vcan"));
        tool(&format!("ip link set {name} mtu {mtu} up"));
        Self(name)
    }

    /// Removes the interface while it may be in use.
    pub fn remove(&self) {
        tool(&format!("ip link del {}", self.0));
    }
}

impl Drop for Vcan {
    fn drop(&mut self) {
        // The interface may be gone already.
        let _ = command(&format!("ip link del {}", self.0)).stderr(Stdio::null()).status();
    }
}

/// Routes frames of one bus that match a filter to the other one, changed by `change`. The kernel's rules are for CAN
/// FD frames here, and the routed frames are seen by every socket on that bus (vcan needs that to be requested).
pub fn route(from: &str, to: &str, filter: &str, change: &str) {
    tool(format!("cangw -A -s {from} -d {to} -X -e -f {filter} {change}").trim_end());
}

/// Returns the number of frames that the kernel has dropped on their way from senders to sockets, of any interface: the
/// second column, in hexadecimal, of a line for each processor.
pub fn backlog_drops() -> u64 {
    let text = fs::read_to_string("/proc/net/softnet_stat").unwrap();
    text.lines().map(|line| u64::from_str_radix(line.split(' ').nth(1).unwrap(), 16).unwrap()).sum()
}

/// Returns a skin of a few cells at a rate that an emulated machine can follow.
pub fn small_skin(cells: usize) -> String {
    generate(&SkinRequest { cells, broadcast_hz: 20.0, ..SkinRequest::default() }).unwrap()
}

/// Runs `cansend vcan0 $(skinbus frame ...)`, as a user would.
pub fn cansend(place: &TestDir, frame: &str) {
    let printed = place.start("skinbus", &format!("frame {frame}")).end().succeeded().stdout;
    for line in printed.lines() {
        tool(&format!("cansend vcan0 {line}"));
    }
}

/// Returns the number of frames for which an interface's queue had no room, which senders see as ENOBUFS.
pub fn refused(name: &str) -> u64 {
    let shown = tool(&format!("tc -statistics -json qdisc show dev {name}")).stdout;
    serde_json::from_slice::<serde_json::Value>(&shown).unwrap()[0]["drops"].as_u64().unwrap()
}

/// `vcan0`, which is restored when this is dropped, however a test ends.
pub struct Vcan0;

impl Vcan0 {
    pub fn down(&self) {
        tool("ip link set vcan0 down");
    }

    pub fn up(&self) {
        tool("ip link set vcan0 up");
    }

    /// Makes `vcan0` refuse all frames, so that senders get ENOBUFS: its transmit queue has no room, like that of a
    /// real controller without any acknowledge.
    pub fn fill(&self) {
        tool("tc qdisc add dev vcan0 root pfifo limit 0");
    }

    pub fn empty(&self) {
        tool("tc qdisc del dev vcan0 root");
    }
}

impl Drop for Vcan0 {
    fn drop(&mut self) {
        // The queue may not exist.
        let _ = command("tc qdisc del dev vcan0 root").stderr(Stdio::null()).status();
        let _ = command("ip link set vcan0 mtu 72 up").status();
    }
}

/// Another program that runs beside a test, and ends with it.
pub struct BackgroundProcess(pub Child);

impl BackgroundProcess {
    pub fn start(words: &str) -> Self {
        let mut command = command(words);
        command.stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().unwrap_or_else(|error| missing(words, &error)))
    }
}

impl Drop for BackgroundProcess {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// `candump -L`, which has room for 300 MB of frames and preempts no process: otherwise it would be woken by every
/// single frame on one processor.
pub struct Candump {
    child: BackgroundProcess,
    bus: String,
    log: PathBuf,
    marks: u32,
}

impl Candump {
    /// Starts candump, and returns once it listens.
    pub fn start(bus: &str, log: &Path) -> Self {
        // -d: frames that its socket drops are a line of the log, which fails every test that counts frames. The two
        // filters pass every frame and every error frame, which are otherwise left out.
        let words = format!("chrt --batch 0 candump -L -d -r 300000000 {bus},0:0,#FFFFFFFF");
        let mut command = command(&words);
        command.stdout(File::create(log).unwrap()).stderr(Stdio::null());
        let child = BackgroundProcess(command.spawn().unwrap_or_else(|error| missing(&words, &error)));
        let candump = Self { child, bus: bus.to_owned(), log: log.to_owned(), marks: 0 };
        // The kernel's lists of listeners do not name the process of an entry.
        until("candump to listen", || {
            tool(&format!("cansend {bus} {}", mark(0)));
            candump.tail().contains(&mark(0)).then_some(())
        });
        candump
    }

    /// Returns the last part of candump's log, which may be long.
    fn tail(&self) -> String {
        let mut log = File::open(&self.log).unwrap();
        let len = log.metadata().unwrap().len();
        log.seek(SeekFrom::Start(len.saturating_sub(16_384))).unwrap();
        let mut tail = String::new();
        log.read_to_string(&mut tail).unwrap();
        tail
    }

    /// Waits until candump has logged all frames until now. For this it sends a frame that is foreign to all clients
    /// and stays in the log.
    pub fn catch_up(&mut self) {
        self.marks += 1;
        let mark = mark(self.marks);
        tool(&format!("cansend {} {mark}", self.bus));
        until("candump to see a frame", || self.tail().contains(&mark).then_some(()));
    }

    /// Returns all frames that candump has logged from its start until now.
    pub fn frames(mut self) -> Vec<Frame> {
        self.catch_up();
        drop(self.child);
        let frames = frames_of(&self.log);
        let [first, last] = [0, self.marks].map(|number| parse_frame(&mark(number)).unwrap());
        let begin = frames.iter().rposition(|frame| *frame == first).unwrap() + 1;
        let end = frames.iter().rposition(|frame| *frame == last).unwrap();
        frames[begin..end].to_vec()
    }
}

/// Returns a frame that no other client sends.
fn mark(number: u32) -> String {
    format!("1BADCAFE#{number:08X}")
}

/// Returns the frames of a log, and panics if it has any other line, such as `DROPCOUNT`.
pub fn frames_of(log: &Path) -> Vec<Frame> {
    let text = fs::read_to_string(log).unwrap();
    let frame = |line: &str| match parse(line) {
        Ok(CandumpLine::Frame(record)) => record.frame,
        other => panic!("{}: {line}: {other:?}", log.display()),
    };
    text.lines().map(frame).collect()
}

/// Groups frames by sender and kind, in the order in which each was sent: this order is the same in two views of a bus.
pub fn by_identifier(frames: &[Frame]) -> BTreeMap<u32, Vec<Frame>> {
    let mut all = BTreeMap::<_, Vec<Frame>>::new();
    for frame in frames {
        all.entry(frame.raw_id()).or_default().push(*frame);
    }
    all
}

/// Checks that the gateway records the frames that `candump` sees, in the same order by sender. Cells that are being
/// ended may still send a heartbeat when the gateway no longer listens.
pub fn same_by_sender(ours: &[Frame], theirs: &[Frame]) {
    let (ours, theirs) = (by_identifier(ours), by_identifier(theirs));
    assert_eq!(ours.keys().collect::<Vec<_>>(), theirs.keys().collect::<Vec<_>>());
    for (id, theirs) in &theirs {
        let ours = &ours[id];
        let kind = Id::from_bits(u16::try_from(*id).unwrap()).kind;
        assert!(theirs.len() == ours.len() || kind == Kind::Network, "frames of {id:03X}");
        assert!(theirs.starts_with(ours), "{id:03X} comes in another order");
    }
}
